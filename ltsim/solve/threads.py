"""Limit of linear algebra to one thread: on small matrices further threads only wait."""

from collections.abc import Callable
from contextvars import ContextVar
from functools import cache, wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController

P = ParamSpec("P")
R = TypeVar("R")


_LIMITED: ContextVar[bool] = ContextVar("whether a caller has set the limit already", default=False)


@cache
def _pools() -> ThreadpoolController:
    """Controller of the threads of linear-algebra libraries, created once, which takes milliseconds."""
    return ThreadpoolController()


def single_threaded(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator that limits the libraries' threads to one: faster for small matrices, and sums keep their order."""

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        if _LIMITED.get():
            return function(*args, **kwargs)
        token = _LIMITED.set(True)
        try:
            with _pools().limit(limits=1):
                return function(*args, **kwargs)
        finally:
            _LIMITED.reset(token)

    return limited
