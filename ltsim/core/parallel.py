"""Parallel worker processes, and the limit of linear algebra to one thread.

The workers exit with their parent process, even if it is killed. One thread is faster for small matrices.
"""

import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController

from ltsim.core.arguments import check_argument_bounds
from ltsim.core.errors import WorkerError, option_text

PARENT_CHECK_INTERVAL_S = 1.0
"""Time [s] between two checks of a worker process whether its parent process still exists."""
PYTHON_SAFE_PATH_ENVIRONMENT_VARIABLE = "PYTHONSAFEPATH"
"""Name of the environment variable that keeps the working folder off Python's module search path."""
ReturnType = TypeVar("ReturnType")
"""Type of the result of a function that worker processes call."""
DecoratedParameters = ParamSpec("DecoratedParameters")
"""Parameters of the decorated function."""
DecoratedReturn = TypeVar("DecoratedReturn")
"""Type of the result of the decorated function."""


_IS_THREAD_COUNT_LIMITED: ContextVar[bool] = ContextVar("whether a caller has set the limit already", default=False)
"""Flag, True while a calling function has already limited linear algebra to one thread."""


def run_parallel(
    function: Callable[..., ReturnType],
    argument_tuples: Iterable[tuple[Any, ...]],
    n_processes: int,
    *,
    keeps_order: bool = True,
    calls_per_batch: int = 1,
) -> Iterator[ReturnType]:
    """Results of a function for each tuple of arguments, computed by `n_processes` worker processes.

    If `n_processes` is 1, the calling process computes the results. The function must be importable by its name.
    Results are yielded in the order of the calls, or as soon as they are ready if `keeps_order` is false. Each worker
    receives `calls_per_batch` calls together. WorkerError is raised if a worker process ends early, InputError for
    fewer than one process.
    """
    check_argument_bounds(jobs=n_processes)
    if n_processes == 1:
        yield from (function(*arguments) for arguments in argument_tuples)
        return
    from joblib import Parallel, delayed, parallel_config  # most runs need one process
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    return_as = "generator" if keeps_order else "generator_unordered"
    watching = {"initializer": _start_worker, "initargs": (os.getpid(),)}
    with parallel_config(backend="loky", inner_max_num_threads=1, **watching):
        pool = Parallel(n_jobs=n_processes, return_as=return_as, batch_size=calls_per_batch)
    with _without_working_folder(), _blocked_keyboard_interrupts():
        results = pool(delayed(function)(*arguments) for arguments in argument_tuples)
    try:
        with _without_working_folder():
            for result in results:  # noqa: UP028 - `yield from` would close `results`, with a warning
                yield result
    except TerminatedWorkerError:
        raise WorkerError(
            f"a worker process was killed, possibly because memory ran out; use fewer {option_text('jobs')}"
        ) from None
    finally:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # joblib warns of results that a caller has no use for
            results.close()


@contextmanager
def _without_working_folder() -> Iterator[None]:
    """Context in which worker processes start without the working folder on their module search path.

    A file `numpy.py` in the working folder would otherwise be imported in place of numpy.
    """
    old_value = os.environ.get(PYTHON_SAFE_PATH_ENVIRONMENT_VARIABLE)
    os.environ[PYTHON_SAFE_PATH_ENVIRONMENT_VARIABLE] = "1"
    try:
        yield
    finally:
        if old_value is None:
            del os.environ[PYTHON_SAFE_PATH_ENVIRONMENT_VARIABLE]
        else:
            os.environ[PYTHON_SAFE_PATH_ENVIRONMENT_VARIABLE] = old_value


@contextmanager
def _blocked_keyboard_interrupts() -> Iterator[None]:
    """Context in which worker processes and threads start with a signal mask that blocks Ctrl-C.

    A terminal sends Ctrl-C to all processes of a command. A worker that it reaches while it imports its modules would
    print a traceback. The calling thread receives the signal at the end of the context.
    """
    if not hasattr(signal, "pthread_sigmask"):  # as on Windows
        yield
        return
    from multiprocessing import resource_tracker

    from joblib.externals.loky.backend import resource_tracker as loky_resource_tracker

    for tracker in (loky_resource_tracker, resource_tracker):  # processes whose start unblocks Ctrl-C in this process
        tracker.ensure_running()
    old_mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, old_mask)


def _start_worker(parent_process_id: int) -> None:
    """Start of a worker process, which ignores Ctrl-C and ends when the process `parent_process_id` ends.

    Programs that the worker starts receive Ctrl-C as usual, because only a handler is replaced.
    """
    signal.signal(signal.SIGINT, lambda *_: None)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    _start_parent_watcher(parent_process_id)


def _start_parent_watcher(parent_process_id: int) -> None:
    """Start of a thread that ends this process when the process `parent_process_id` no longer exists."""

    def end_with_parent() -> None:
        while os.getppid() == parent_process_id:
            time.sleep(PARENT_CHECK_INTERVAL_S)
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


@cache
def _thread_pool_controller() -> ThreadpoolController:
    """Controller of the number of threads of the linear-algebra libraries, created once to save time."""
    return ThreadpoolController()


def single_threaded(
    function: Callable[DecoratedParameters, DecoratedReturn],
) -> Callable[DecoratedParameters, DecoratedReturn]:
    """Decorator that limits the linear-algebra libraries to one thread while a function runs.

    One thread is faster for small matrices, and the results are reproducible because the order of summation is fixed.
    """

    @wraps(function)
    def wrapper(*args: DecoratedParameters.args, **kwargs: DecoratedParameters.kwargs) -> DecoratedReturn:
        if _IS_THREAD_COUNT_LIMITED.get():
            return function(*args, **kwargs)
        token = _IS_THREAD_COUNT_LIMITED.set(True)
        try:
            with _thread_pool_controller().limit(limits=1):
                return function(*args, **kwargs)
        finally:
            _IS_THREAD_COUNT_LIMITED.reset(token)

    return wrapper
