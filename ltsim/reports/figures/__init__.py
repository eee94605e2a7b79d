"""Figures of reports, in modules that are imported on first use, since matplotlib is slow to import.

Sections call `figures.points.displacement_figure(...)` when a picture is drawn.
"""

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


def _import_figure_module(name: str) -> Any:
    """Module of figures with this name; raises AttributeError for another name."""
    if name in FIGURE_MODULES:
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")


if not TYPE_CHECKING:
    __getattr__ = _import_figure_module
