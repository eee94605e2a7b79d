"""The one way in which this room compiles a function."""

from collections.abc import Callable
from typing import TypeVar, cast

import llvmlite.binding
import numba
from numba import types
from numba.extending import overload

from ltsim.core.arrays import Floats

R = TypeVar("R")

if llvmlite.binding.llvm_version_info[0] >= 17:
    # Otherwise rows of one array are tested for overlap over all turns of the loop around, which is never passed.
    llvmlite.binding.set_option("ltsim", "-hoist-runtime-checks=false")


def compiled(function: Callable[..., R]) -> Callable[..., R]:
    """Compile at the first call and cache the machine code next to the source.

    Sums keep their order; only a product and a sum may be fused. Runs outside the interpreter lock.
    """

    def compiled_kernel(cache: bool) -> Callable[..., R]:
        compiler = numba.njit(cache=cache, nogil=True, error_model="numpy", fastmath={"contract"})
        return cast(Callable[..., R], compiler(function))

    try:
        return compiled_kernel(cache=True)
    except RuntimeError:  # neither the package's folder nor a home can be written to
        return compiled_kernel(cache=False)


def inlined(function: Callable[..., R]) -> Callable[..., R]:
    """Compile inline into the caller, so that a loop around the call still becomes vector instructions."""
    compiler = numba.njit(inline="always", error_model="numpy", fastmath={"contract"})
    return cast(Callable[..., R], compiler(function))


def at(value: Floats | float, trial: int) -> float:
    """A trial's own value: of a number that all trials share, or of a row with one for each of them."""
    return value if isinstance(value, float) else float(value[trial])


@overload(at, strict=False)
def _at(value: object, trial: object) -> Callable[..., object]:
    """The choice is made by type when a kernel is compiled: what trials share costs nothing."""
    if isinstance(value, types.Float):
        return lambda value, trial: value
    return lambda value, trial: value[trial]
