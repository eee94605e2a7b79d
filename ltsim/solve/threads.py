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


_IS_LIMITED: ContextVar[bool] = ContextVar("whether a caller has set the limit already", default=False)
"""Flag of a context in which a calling function has limited the threads already."""


@cache
def _thread_pool_controller() -> ThreadpoolController:
    """Controller of the threads of linear-algebra libraries, created once because creation takes milliseconds."""
    return ThreadpoolController()


def single_threaded(
    function: Callable[DecoratedParameters, DecoratedReturn],
) -> Callable[DecoratedParameters, DecoratedReturn]:
    """Decorator that limits linear algebra in a function to one thread.

    This is faster for small matrices, and results are reproducible because the order of summation does not change.
    """

    @wraps(function)
    def wrapper(*args: DecoratedParameters.args, **kwargs: DecoratedParameters.kwargs) -> DecoratedReturn:
        if _IS_LIMITED.get():
            return function(*args, **kwargs)
        token = _IS_LIMITED.set(True)
        try:
            with _thread_pool_controller().limit(limits=1):
                return function(*args, **kwargs)
        finally:
            _IS_LIMITED.reset(token)

    return wrapper
