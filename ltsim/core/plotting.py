"""Lazy import of the plotting modules, so that results do not import matplotlib."""

from collections.abc import Callable
from typing import Any

_plotting_loaders: list[Callable[[str], Any]] = []
"""List with the function that imports a module of `ltsim.reports` by its name; empty before `register_plotting_loader`.
"""


def register_plotting_loader(import_module: Callable[[str], Any]) -> None:
    """Registration of `import_module`, a function that imports a module of `ltsim.reports` by its name."""
    _plotting_loaders[:] = [import_module]


def plotting_module(module_name: str) -> Any:
    """Module of `ltsim.reports` with the name `module_name`, imported by the registered function."""
    return _plotting_loaders[0](module_name)
