"""One figure a function, in modules by what they show; each is loaded when it is first used, since drawing takes time.

Sections say `figures.points.displacement_figure(...)` where a picture is drawn, and load nothing before.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ltsim.reports.figures import (
        campaign as campaign,
        floor_plan as floor_plan,
        parameters as parameters,
        points as points,
        residuals as residuals,
    )

MODULES = ("campaign", "floor_plan", "parameters", "points", "residuals")


def _load(name: str) -> Any:
    if name in MODULES:
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"there are no figures '{name}'")


if not TYPE_CHECKING:
    __getattr__ = _load
