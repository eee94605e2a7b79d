"""Figures of reports, in modules that are imported when a picture is drawn, since matplotlib is slow to import.

Sections refer to a function as `figures.points.displacement_figure`. The first call of such a function imports its
module, so that a text without pictures does not import matplotlib.
"""

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ltsim.reports.figures import (
        campaign as campaign,
        floor_plan as floor_plan,
        marked_floor_plans as marked_floor_plans,
        parameters as parameters,
        points as points,
        residuals as residuals,
    )

FIGURE_MODULES = ("campaign", "floor_plan", "marked_floor_plans", "parameters", "points", "residuals")
"""Names of the modules in this package that draw figures."""


class _DeferredModule:
    """Module of figures whose functions import it when they are called."""

    def __init__(self, path: str) -> None:
        self._path = path

    def __getattr__(self, function_name: str) -> Callable[..., Any]:
        def draw(*arguments: Any, **options: Any) -> Any:
            return getattr(import_module(self._path), function_name)(*arguments, **options)

        return draw


def _deferred_figure_module(name: str) -> _DeferredModule:
    """Module of figures with this name, not yet imported; raises AttributeError for another name."""
    if name in FIGURE_MODULES:
        return _DeferredModule(f"{__name__}.{name}")
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")


if not TYPE_CHECKING:
    __getattr__ = _deferred_figure_module
