"""Single reflectors moved, added or left out, on the floor seen from above."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot

from matplotlib.figure import Figure

from ltsim.pages.figures.floor_plan import floor_plan
from ltsim.pages.style import INK, PURPLE, RED, styled
from ltsim.pages.workshop import Workshop
from ltsim.planning.floor import Floor
from ltsim.planning.schema import ChangeEntry
from ltsim.units import MILLIMETRE

ONE_MARK = 0.04
"""Share of the hall's size within which places have one mark, seen from above."""


@styled
def reflector_changes(workshop: Workshop, changes: Sequence[ChangeEntry], ground: Floor | None = None) -> Figure:
    """The floor plan with each change and its number: moves as arrows, crosses are left out."""
    figure = floor_plan(workshop, ground=ground)
    ax = figure.axes[0]
    place = dict(zip(workshop.targets, workshop.points[:, :2].tolist(), strict=True))
    numbers: dict[tuple[float, float], list[int]] = {}
    for number, change in enumerate(changes, 1):
        if change.position_mm is None:
            x, y = place[change.reflector]
            ax.scatter(x, y, marker="x", s=60, color=RED, linewidths=1.6, zorder=9)
            continue
        x, y = (v * MILLIMETRE for v in change.position_mm[:2])
        near = next((p for p in numbers if hypot(p[0] - x, p[1] - y) < ONE_MARK * workshop.size), (x, y))
        numbers.setdefault(near, []).append(number)
        if change.reflector:
            arrow = {"arrowstyle": "-|>", "color": PURPLE, "lw": 1.3, "shrinkA": 3, "shrinkB": 9}
            ax.annotate("", near, xytext=place[change.reflector], arrowprops=arrow, zorder=9)
    for (x, y), own in numbers.items():
        ring = {"boxstyle": "round,pad=0.25", "facecolor": "white", "edgecolor": PURPLE, "linewidth": 1.2}
        ax.text(x, y, ", ".join(map(str, own)), fontsize=7, ha="center", va="center", color=INK, bbox=ring, zorder=11)
    return figure
