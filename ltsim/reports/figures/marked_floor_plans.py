"""Floor plans with marks: places of findings, and changes of reflectors."""

from collections.abc import Mapping, Sequence
from math import hypot

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from ltsim.core.units import MILLIMETRE
from ltsim.planning.plan_change import PlanChange
from ltsim.reports import style
from ltsim.reports.figures.floor_plan import MapLabel, floor_plan
from ltsim.reports.workshop import PlacedWorkshop
from ltsim.scene.floor import Floor

MIN_DRAWN_HALF_WIDTH = 0.015
"""Half-width with which a place of the hall is drawn at least, over the size of the hall."""
MAX_MARK_SHARING_DISTANCE = 0.04
"""Distance within which changes share a mark, over the size of the hall."""


@style.with_figure_style
def marked_floor_plan(
    workshop: PlacedWorkshop,
    marked_names: Sequence[str],
    pairs: Sequence[tuple[str, str]] = (),
    area: Mapping[str, tuple[float, float]] | None = None,
) -> Figure:
    """Floor plan with red rings around marked stations and targets, and an arrow between the targets of each pair.

    A place of the hall is an `area`: by axis its centre and half-width [m]; a strip where it has one axis.
    """
    figure = floor_plan(workshop)
    ax = figure.axes[0]
    if area and len(area) == 2:
        (x, wide), (y, high) = area["x"], area["y"]
        least = MIN_DRAWN_HALF_WIDTH * workshop.largest_extent
        ax.add_patch(Ellipse((x, y), 2 * max(wide, least), 2 * max(high, least), color=style.RED, alpha=0.35, zorder=8))
        ax.scatter(x, y, marker="+", s=90, color=style.RED, zorder=9)
    elif area:
        ((axis, (centre, half)),) = area.items()
        span = ax.axvspan if axis == "x" else ax.axhspan
        span(centre - half, centre + half, color=style.RED, alpha=0.35, zorder=8)
    names = [*workshop.stations, *workshop.targets]
    place = dict(
        zip(names, np.concatenate([workshop.station_positions, workshop.target_points])[:, :2].tolist(), strict=True)
    )
    for name in marked_names:
        if name in place:
            x, y = place[name]
            ax.scatter(x, y, s=180, facecolors="none", edgecolors=style.RED, linewidths=2.0, zorder=9)
    for start, end in pairs:
        arrow = {"arrowstyle": "<|-|>", "color": style.RED, "lw": 1.6, "shrinkA": 5, "shrinkB": 5}
        ax.annotate("", place[end], place[start], arrowprops=arrow, zorder=9)
    return figure


@style.with_figure_style
def reflector_changes_figure(
    workshop: PlacedWorkshop, changes: Sequence[PlanChange], floor: Floor | None = None
) -> Figure:
    """Floor plan with numbered changes of reflectors: moves as arrows, omitted ones as crosses."""
    current = dict(zip(workshop.targets, workshop.target_points[:, :2].tolist(), strict=True))

    def marks(ax: Axes) -> list[MapLabel]:
        labels = []
        kinds = (True, "D", style.PURPLE, "new place, by number"), (False, "x", style.RED, "can go, by number")
        for new, marker, colour, word in kinds:
            numbers: dict[tuple[float, float], list[int]] = {}
            for number, change in enumerate(changes, 1):
                if (change.position_mm is not None) != new:
                    continue
                there = change.position_mm
                x, y = (v * MILLIMETRE for v in there[:2]) if there else current[change.reflector]
                near = next(
                    (
                        p
                        for p in numbers
                        if hypot(p[0] - x, p[1] - y) < MAX_MARK_SHARING_DISTANCE * workshop.largest_extent
                    ),
                    (x, y),
                )
                numbers.setdefault(near, []).append(number)
                if new and change.reflector:
                    arrow = {"arrowstyle": "-|>", "color": style.PURPLE, "lw": 1.3, "shrinkA": 3, "shrinkB": 4}
                    ax.annotate("", near, xytext=current[change.reflector], arrowprops=arrow, zorder=8)
            if numbers:
                at = np.array([*numbers]).T
                ax.scatter(at[0], at[1], marker=marker, s=40, color=colour, zorder=9, label=word)
            labels += [MapLabel(", ".join(map(str, n)), np.array(at), 8.0, bold=True) for at, n in numbers.items()]
        return labels

    return floor_plan(workshop, floor=floor, draw_marks=marks)
