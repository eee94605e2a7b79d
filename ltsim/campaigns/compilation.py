"""Decorators that compile functions of campaigns to machine code (Numba)."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar, cast

from ltsim.core.arrays import Floats
from ltsim.core.library_settings import without_settings_file

NUMBA_SETTINGS_FILE_NAME = ".numba_config.yaml"
"""Name of Numba's file of settings."""
with without_settings_file(NUMBA_SETTINGS_FILE_NAME):
    import llvmlite.binding
    import numba
    import numba.core.config
    from numba import types
    from numba.core.caching import FunctionCache
    from numba.core.registry import cpu_target
    from numba.extending import overload
numba.core.config._config_fname = ""  # no file is read at later compilations

ReturnType = TypeVar("ReturnType")
"""Type of the result of a function that is compiled."""

if llvmlite.binding.llvm_version_info[0] >= 17:
    # Otherwise rows of one array are checked for overlap over all iterations of the outer loop, which always fails.
    llvmlite.binding.set_option("ltsim", "-hoist-runtime-checks=false")


def compile_function(function: Callable[..., ReturnType]) -> Callable[..., ReturnType]:
    """Compiled version of a function: compiled at the first call, with the machine code cached next to the source.

    Sums keep the order of the source; the compiler may only fuse a product with the following sum. The function
    releases Python's global interpreter lock.
    """

    def compiled_kernel(caches_code: bool) -> Callable[..., ReturnType]:
        compiler = numba.njit(cache=caches_code, nogil=True, error_model="numpy", fastmath={"contract"})
        return cast(Callable[..., ReturnType], compiler(function))

    try:
        kernel = compiled_kernel(caches_code=True)
    except RuntimeError:  # neither the package's folder nor the home folder can be written to
        return compiled_kernel(caches_code=False)
    _discard_unreadable_cache(function)
    return kernel


def _discard_unreadable_cache(function: Callable[..., object]) -> None:
    """Removal of the cached machine code of a function if the index of the cache cannot be read.

    This occurs after a change of the version of Numba or ltsim: the index names modules of the old version, and Numba
    reads it before it compares the date of the source.
    """
    cache: Any = FunctionCache(function)  # type: ignore[no-untyped-call]
    try:
        cache.load_overload(types.void(), cpu_target.target_context)  # reads the index, whatever the signature
    except Exception:
        with suppress(OSError):
            cache.flush()


def compile_inlined(function: Callable[..., ReturnType]) -> Callable[..., ReturnType]:
    """Compiled version of a function that is inlined into its caller, so that loops in the caller are vectorised."""
    compiler = numba.njit(inline="always", error_model="numpy", fastmath={"contract"})
    return cast(Callable[..., ReturnType], compiler(function))


def value_of_trial(value: Floats | float, trial: int) -> float:
    """Value of a quantity in a trial: `value` if all trials share a number, else the entry of an array (trials,)."""
    return value if isinstance(value, float) else float(value[trial])


@overload(value_of_trial, strict=False)
def _compiled_value_of_trial(value: object, trial: object) -> Callable[..., object]:
    """Compiled form of `value_of_trial`: returns a number unchanged, and of an array the entry of the trial."""
    if isinstance(value, types.Float):
        return lambda value, trial: value
    return lambda value, trial: value[trial]
