"""Limit of linear-algebra libraries to one thread, which is faster for small matrices."""

from collections.abc import Callable
from contextvars import ContextVar
from functools import cache, wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController

DecoratedParameters = ParamSpec("DecoratedParameters")
"""Parameters of the decorated function."""
DecoratedReturn = TypeVar("DecoratedReturn")
"""Type of the result of the decorated function."""


_IS_THREAD_COUNT_LIMITED: ContextVar[bool] = ContextVar("whether a caller has set the limit already", default=False)
"""Flag, True while a calling function has already limited linear algebra to one thread."""


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
