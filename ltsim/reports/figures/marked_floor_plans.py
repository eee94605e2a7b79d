"""Floor plans with markers: stations and targets of the findings of a diagnosis, and changes of reflectors."""

from collections.abc import Mapping, Sequence
from math import hypot

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from ltsim.core.units import MILLIMETRE
from ltsim.planning.reflector_changes import ReflectorChangeEntry
from ltsim.reports import style
from ltsim.reports.figures.floor_plan import MapLabel, floor_plan
from ltsim.reports.workshop_scene import WorkshopScene
from ltsim.scene.floor import Floor

MIN_MARKED_AREA_HALF_WIDTH = 0.015
"""Smallest half-width with which a marked area of the hall is drawn, as a fraction of the size of the hall."""
MAX_MARKER_SHARING_DISTANCE = 0.04
"""Largest distance between two changes of reflectors that share a marker, as a fraction of the size of the hall."""


@style.with_figure_style
def marked_floor_plan(
    workshop: WorkshopScene,
    marked_names: Sequence[str],
    target_pairs: Sequence[tuple[str, str]] = (),
    area: Mapping[str, tuple[float, float]] | None = None,
) -> Figure:
    """Floor plan with red rings around marked stations and targets, and an arrow between the targets of each pair.

    `area` is a shaded part of the hall: centre and half-width [m] for the axes `x` and `y`. If only one axis is given,
    the part is a strip across the hall.
    """
    figure = floor_plan(workshop)
    ax = figure.axes[0]
    if area and len(area) == 2:
        (x, half_width_x), (y, half_width_y) = area["x"], area["y"]
        min_half_width = MIN_MARKED_AREA_HALF_WIDTH * workshop.largest_extent
        ax.add_patch(
            Ellipse(
                (x, y),
                2 * max(half_width_x, min_half_width),
                2 * max(half_width_y, min_half_width),
                color=style.RED,
                alpha=0.35,
                zorder=8,
            )
        )
        ax.scatter(x, y, marker="+", s=90, color=style.RED, zorder=9)
    elif area:
        ((axis, (centre, half_width)),) = area.items()
        draw_strip = ax.axvspan if axis == "x" else ax.axhspan
        draw_strip(centre - half_width, centre + half_width, color=style.RED, alpha=0.35, zorder=8)
    names = [*workshop.stations, *workshop.targets]
    position_by_name = dict(
        zip(names, np.concatenate([workshop.station_positions, workshop.target_points])[:, :2].tolist(), strict=True)
    )
    for name in marked_names:
        if name in position_by_name:
            x, y = position_by_name[name]
            ax.scatter(x, y, s=180, facecolors="none", edgecolors=style.RED, linewidths=2.0, zorder=9)
    for start, end in target_pairs:
        arrow = {"arrowstyle": "<|-|>", "color": style.RED, "lw": 1.6, "shrinkA": 5, "shrinkB": 5}
        ax.annotate("", position_by_name[end], position_by_name[start], arrowprops=arrow, zorder=9)
    return figure


@style.with_figure_style
def reflector_changes_floor_plan(
    workshop: WorkshopScene, planned_changes: Sequence[ReflectorChangeEntry], floor: Floor | None = None
) -> Figure:
    """Floor plan with numbered changes of reflectors: moves as arrows, reflectors that can be omitted as crosses."""
    position_by_target = dict(zip(workshop.targets, workshop.target_points[:, :2].tolist(), strict=True))

    def draw_markers(ax: Axes) -> list[MapLabel]:
        """Draw the numbered markers of the changes, with entries for the legend; returns the labels of the markers."""
        labels = []
        kinds = (
            (True, "D", style.PURPLE, "new position, by number"),
            (False, "x", style.RED, "reflector to omit, by number"),
        )
        for has_new_place, marker, colour, word in kinds:
            numbers_by_position: dict[tuple[float, float], list[int]] = {}
            for number, change in enumerate(planned_changes, 1):
                if (change.position_mm is not None) != has_new_place:
                    continue
                new_position_mm = change.position_mm
                x, y = (
                    (v * MILLIMETRE for v in new_position_mm[:2])
                    if new_position_mm
                    else position_by_target[change.reflector]
                )
                mark_position = next(
                    (
                        p
                        for p in numbers_by_position
                        if hypot(p[0] - x, p[1] - y) < MAX_MARKER_SHARING_DISTANCE * workshop.largest_extent
                    ),
                    (x, y),
                )
                numbers_by_position.setdefault(mark_position, []).append(number)
                if has_new_place and change.reflector:
                    arrow = {"arrowstyle": "-|>", "color": style.PURPLE, "lw": 1.3, "shrinkA": 3, "shrinkB": 4}
                    ax.annotate(
                        "", mark_position, xytext=position_by_target[change.reflector], arrowprops=arrow, zorder=8
                    )
            if numbers_by_position:
                at = np.array([*numbers_by_position]).T
                ax.scatter(at[0], at[1], marker=marker, s=40, color=colour, zorder=9, label=word)
            labels += [
                MapLabel(", ".join(map(str, n)), np.array(at), 8.0, is_bold=True)
                for at, n in numbers_by_position.items()
            ]
        return labels

    return floor_plan(workshop, floor=floor, draw_markers=draw_markers)
