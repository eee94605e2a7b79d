"""Registry of the plotting modules, loaded lazily, so that results do not import matplotlib."""

from collections.abc import Callable
from typing import Any

_loaders: list[Callable[[str], Any]] = []


def register_plotting(load: Callable[[str], Any]) -> None:
    """Registration of the function that imports a plotting module by its name within `ltsim.reports`."""
    _loaders[:] = [load]


def plotting_module(module: str) -> Any:
    """A plotting module, imported by the registered function."""
    return _loaders[0](module)
