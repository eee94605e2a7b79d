"""Limit of linear algebra to one thread: on small matrices further threads only wait."""

from collections.abc import Callable
from contextvars import ContextVar
from functools import cache, wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController

DecoratedParameters = ParamSpec("DecoratedParameters")
DecoratedReturn = TypeVar("DecoratedReturn")


_IS_LIMITED: ContextVar[bool] = ContextVar("whether a caller has set the limit already", default=False)


@cache
def _thread_pool_controller() -> ThreadpoolController:
    """Controller of the threads of linear-algebra libraries, created once, which takes milliseconds."""
    return ThreadpoolController()


def single_threaded(
    function: Callable[DecoratedParameters, DecoratedReturn],
) -> Callable[DecoratedParameters, DecoratedReturn]:
    """Decorator that limits the libraries' threads to one: faster for small matrices, and sums keep their order."""

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
