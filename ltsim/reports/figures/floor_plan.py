"""Floor plan of a hall, seen from above like Figure 5 of Sensors 2021, 21, 7479, with names of stations and targets."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon

from ltsim.core.arrays import Bools, Floats
from ltsim.core.units import DEGREE, MILLIMETRE
from ltsim.reports import style
from ltsim.reports.figures.obstacles import draw_obstacles
from ltsim.reports.workshop_scene import WorkshopScene
from ltsim.scene.floor import Floor, FloorArea, distance_to_outline

MARKER_LABEL_DIRECTIONS = np.radians([0, 180, 90, 270])
"""Directions [rad] from a marker to its label, relative to the preferred direction, in the order of the trials."""
LABEL_DISTANCE_PT = 6.0
"""Distance [pt] from a marker to its label."""
LETTER_SIZE_RATIOS = (0.62, 1.25)
"""Width and height of a letter of a label, as fractions of the font size."""
MIN_SIDE_RATIO_OF_VERTICAL_LABEL = 2.0
"""Smallest ratio of height to width of an area with a vertical label; a horizontal one does not fit into it."""
LABEL_BOX_SETTINGS = {"boxstyle": "square,pad=0", "facecolor": "#FFFFFFB0", "edgecolor": "none"}
"""Matplotlib settings of the box behind a label."""


@dataclass(frozen=True)
class MapLabel:
    """Label of a marker or an area on a floor plan."""

    text: str
    anchor: Floats
    """Position (2,) of the marker in data units."""
    font_size: float = 7.0
    """Font size of the label [pt]."""
    is_bold: bool = False
    colour: str = "#4A5056"
    preferred_direction: float = 0.0
    """Direction [rad], counter-clockwise from the x axis, from the marker to its label if there is space there."""
    is_vertical: bool = False
    """True for a vertical label, which is read from the right."""


def draw_labels(figure: Figure, ax: Axes, labels: Sequence[MapLabel], markers: Floats) -> None:
    """Write labels that cover neither the n markers (n, 2) nor earlier labels; a label without space is omitted.

    The limits of the axes must be set before.
    """
    figure.draw_without_rendering()
    pixels_per_pt = figure.dpi / 72.0
    marker_positions = ax.transData.transform(markers).reshape(-1, 2) / pixels_per_pt
    edge, below = ax.get_window_extent().p0 / pixels_per_pt
    right, top = 72.0 * figure.get_size_inches()
    forbidden_boxes = [[-1e4, -1e4, edge, 1e4], [-1e4, -1e4, 1e4, below]]  # tick labels of the axes
    forbidden_boxes += [[right, -1e4, 1e4, 1e4], [-1e4, top, 1e4, 1e4]]  # outside the figure
    taken_boxes = np.concatenate(
        [np.concatenate([marker_positions - 3.0, marker_positions + 3.0], axis=1), forbidden_boxes]
    )
    for label in labels:
        half_size = 0.5 * label.font_size * np.array([LETTER_SIZE_RATIOS[0] * len(label.text), LETTER_SIZE_RATIOS[1]])
        half_size = half_size[::-1] if label.is_vertical else half_size
        for direction in label.preferred_direction + MARKER_LABEL_DIRECTIONS:
            unit_vector = np.array([np.cos(direction), np.sin(direction)])
            offset = unit_vector * LABEL_DISTANCE_PT + half_size * np.clip(
                1.5 * unit_vector, -1.0, 1.0
            )  # the box does not cover the mark
            box_centre = ax.transData.transform(label.anchor) / pixels_per_pt + offset
            box = np.concatenate([box_centre - half_size, box_centre + half_size])
            if not ((box[:2] < taken_boxes[:, 2:]) & (box[2:] > taken_boxes[:, :2])).all(axis=1).any():
                taken_boxes = np.concatenate([taken_boxes, box[None]])
                ax.annotate(
                    label.text, tuple(label.anchor), xytext=tuple(offset), textcoords="offset points", ha="center",
                    va="center", fontsize=label.font_size, fontweight="bold" if label.is_bold else "normal",
                    color=label.colour, zorder=8, in_layout=False, bbox=LABEL_BOX_SETTINGS,
                    rotation=90.0 if label.is_vertical else 0.0,
                )  # fmt: skip
                break


TARGET_HEIGHT_CLASSES = (
    (0.9, "v", style.ORANGE, "low"),
    (3.2, "s", style.SKY, "middle"),
    (np.inf, "^", style.BLUE, "high"),
)
"""Classes of targets by height: upper limit [m] above the floor, marker, colour, name."""
MAX_LABELLED_TARGETS = 60
"""Largest number of targets whose names are shown on a floor plan."""
MAX_VECTOR_MARKERS = 150
"""Largest number of targets whose markers are drawn as vectors; the markers of more targets are rasterised."""
MAX_LISTED_STATIONS = 16
"""Largest number of stations whose coordinates are listed below a floor plan."""
MIN_STACKED_TARGETS_OF_SHORT_LABEL = 4
"""Smallest number of targets above each other that share a short label: one name, number of the others (`T1 +3`)."""
MAX_LABEL_SHARING_DISTANCE = 0.05
"""Largest horizontal distance between targets that share a label, as a fraction of the size of the floor."""
FLOOR_PLAN_WIDTH_INCH = 4.3
"""Width of the axes of a floor plan [inch]."""
FLOOR_PLAN_HEIGHT_RANGE_INCH = (3.6, 6.6)
"""Smallest and largest height of the figure of a floor plan [inch]."""
LISTED_STATION_HEIGHT_INCH = 0.16
"""Additional height of the figure per listed station [inch]."""
MAX_WALL_DISTANCE = 0.35
"""Largest distance [m] of a target on a wall from the side of the floor there."""


@style.with_figure_style
def floor_plan(
    workshop: WorkshopScene,
    *,
    reference: Floats | None = None,
    lists_coordinates: bool = False,
    floor: Floor | None = None,
    draw_markers: Callable[[Axes], list[MapLabel]] = lambda ax: [],
) -> Figure:
    """Floor plan of a hall in metres; circles on the floor are what a tracker cannot see below it (shadow cones).

    The tick of a station points to azimuth zero.

    Parameters
    ----------
    workshop : WorkshopScene
    reference : (k, 3) float, optional, [m]
        Positions of the stations of another layout, drawn for comparison.
    lists_coordinates : bool
        True to list the positions of the tripods below the figure.
    floor : Floor, optional
        Areas for tripods, areas to keep free, and doors of a plan.
    draw_markers : function, optional
        Function that draws further markers, with entries for the legend, and returns the labels of the markers.
    """
    low, high = _axis_limits(workshop)
    aspect_ratio = (high[1] - low[1]) / (high[0] - low[0])
    figure, ax = style.new_panel(
        float(np.clip(FLOOR_PLAN_WIDTH_INCH * aspect_ratio + 1.2, *FLOOR_PLAN_HEIGHT_RANGE_INCH)), layout="compressed"
    )
    ax.set_aspect("equal")
    style.set_grid(ax, grid_axis="both")
    ax.add_patch(
        Polygon(workshop.floor_corners, closed=True, facecolor="#F7F8F9", edgecolor="#B5BBC0", linewidth=0.8, zorder=0)
    )
    _draw_walls(ax, workshop)
    area_labels = _draw_floor_areas(ax, floor) if floor is not None else []
    draw_obstacles(ax, workshop.obstacle_triangles)
    _draw_shadow_cones(ax, workshop)
    _draw_gauge(ax, workshop)
    is_visible = _sight_matrix(workshop)
    if is_visible is None:
        _draw_targets(ax, workshop)
    else:
        _draw_visibility_pies(ax, workshop, is_visible)
    if reference is not None and len(reference):
        ax.scatter(
            reference[:, 0], reference[:, 1], s=46, facecolors="white", edgecolors=style.GREY, linewidths=1.4, zorder=5,
            label="station of the reference",
        )  # fmt: skip
    _draw_stations(
        ax, workshop, [style.INK_COLOUR] * len(workshop.stations) if is_visible is None else style.COLOUR_CYCLE
    )
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    mark_labels = draw_markers(ax)
    map_labels = [*mark_labels, *_station_labels(workshop), *area_labels]
    if len(workshop.targets) <= MAX_LABELLED_TARGETS:
        map_labels += _target_labels(workshop)
    handles, labels = ax.get_legend_handles_labels()
    if lists_coordinates and len(workshop.stations) <= MAX_LISTED_STATIONS:
        empty_handles, station_texts = _listed_stations_legend(workshop, n_other_entries=len(labels))
        handles, labels = [*handles, *empty_handles], [*labels, *station_texts]
        figure.set_figheight(figure.get_figheight() + LISTED_STATION_HEIGHT_INCH * len(station_texts))
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    marker_positions = [
        *workshop.station_positions[:, :2],
        *workshop.target_points[:, :2],
        *(label.anchor for label in mark_labels),
    ]
    draw_labels(figure, ax, map_labels, np.array(marker_positions))
    return figure


def _draw_walls(ax: Axes, workshop: WorkshopScene) -> None:
    """Draw as walls the sides of the floor that are the nearest side of at least two targets."""
    legend_label: str | None = "wall with targets"
    wall_ends = np.stack([workshop.floor_corners, np.roll(workshop.floor_corners, -1, axis=0)], axis=1)
    distances = np.array([distance_to_outline(side, workshop.target_points[:, :2]) for side in wall_ends])
    nearest = np.where(distances.min(axis=0) < MAX_WALL_DISTANCE, distances.argmin(axis=0), -1)
    for number, side in enumerate(wall_ends):
        if np.sum(nearest == number) >= 2:
            ax.plot(*side.T, color=style.INK_COLOUR, linewidth=3.0, zorder=1, label=legend_label)
            legend_label = None


def _draw_floor_areas(ax: Axes, floor: Floor) -> list[MapLabel]:
    """Draw areas for tripods, areas to keep free, and doors; returns the labels of all of them."""
    mm, labels = MILLIMETRE, []
    areas = floor.areas or ((FloorArea(corners_mm=floor.corners_mm),) if floor.corners_mm else ())
    for i, area in enumerate(areas):
        corners = np.array(area.corners_mm) * mm
        legend_label = "area for tripods" if i == 0 else None
        ax.add_patch(
            Polygon(
                corners, facecolor="#009E7318", edgecolor=style.GREEN, linewidth=0.9, zorder=0.5, label=legend_label
            )
        )
        for hole in area.holes_mm:
            ax.add_patch(
                Polygon(np.array(hole) * mm, facecolor="white", edgecolor=style.GREEN, linewidth=0.9, zorder=0.6)
            )
        labels.append(MapLabel(area.name, corners.min(axis=0), 7.0, colour="#00664B", preferred_direction=0.25 * np.pi))
    for i, place in enumerate(floor.keep_outs):
        corners = np.array(place.corners_mm) * mm
        legend_label = "area to keep free" if i == 0 else None
        ax.add_patch(
            Polygon(
                corners, facecolor="#FFFFFFCC", edgecolor=style.PURPLE, hatch="////", zorder=0.7, label=legend_label
            )
        )
        width, height = np.ptp(corners, axis=0)
        is_vertical = bool(height > MIN_SIDE_RATIO_OF_VERTICAL_LABEL * width)
        label = MapLabel(place.name, corners.mean(axis=0), 7.0, colour="#8A3A66", preferred_direction=0.5 * np.pi)
        labels.append(replace(label, is_vertical=is_vertical))
    for i, door in enumerate(floor.doors):
        ends = np.array([door.from_mm, door.to_mm]) * mm
        ax.plot(*ends.T, color="white", linewidth=5.0, zorder=1.5)
        ax.plot(*ends.T, color=style.PURPLE, linewidth=2.0, zorder=1.6, label="door" if i == 0 else None)
        labels.append(MapLabel(door.name, ends.mean(axis=0), 7.0, colour="#8A3A66"))
    return [label for label in labels if label.text]


def _axis_limits(workshop: WorkshopScene) -> Floats:
    """Limits of the axes of the floor plan, lower (x, y) and upper (x, y), shape (2, 2) [m].

    The limits enclose the floor and, around each station, the circle on the floor that the tracker cannot see because
    of its lowest elevation.
    """
    radius = workshop.shadow_radii_on_floor[:, None]
    places = np.concatenate(
        [workshop.floor_corners, workshop.station_positions[:, :2] - radius, workshop.station_positions[:, :2] + radius]
    )
    low, high = places.min(axis=0), places.max(axis=0)
    margin = 0.13 * float((high - low).max())  # room for the names of targets on the walls
    return np.stack([low - margin, high + margin])


def _draw_shadow_cones(ax: Axes, workshop: WorkshopScene) -> None:
    """Draw the circles in which the shadow cones (what a tracker cannot see below it) meet the floor."""
    patch_style: dict[str, Any] = {"facecolor": "#D55E0022", "edgecolor": style.RED, "linewidth": 0.9, "zorder": 1}
    for s, radius in enumerate(workshop.shadow_radii_on_floor):
        label = f"shadow, cone of {workshop.shadow_cone_opening / DEGREE:.0f}°" if s == 0 else None
        ax.add_patch(Circle(tuple(workshop.station_positions[s, :2]), radius, label=label, **patch_style))


def _sight_matrix(workshop: WorkshopScene) -> Bools | None:
    """Matrix (S, T), True where one of S stations sees one of T targets.

    None if visibility is unknown, if no line of sight is blocked, or if there are more stations than colours.
    """
    shape = len(workshop.stations), len(workshop.targets)
    if workshop.sights is None or shape[0] > len(style.COLOUR_CYCLE) or not len(workshop.blocked_sights):
        return None
    is_visible = np.zeros(shape, dtype=bool)
    is_visible[workshop.sights.station_indices, workshop.sights.target_indices] = True
    return is_visible


def _draw_visibility_pies(ax: Axes, workshop: WorkshopScene, is_visible: Bools) -> None:
    """Draw each target as a circle with a slice in the colour of each station that sees it (mask `is_visible`)."""
    x, y = workshop.target_points[:, :2].T
    marker_size = 62 if len(workshop.targets) <= MAX_LABELLED_TARGETS else 34
    label = "target: slices are the\nstations that see it"
    ax.scatter(
        x, y, s=marker_size, facecolors="white", edgecolors=style.INK_COLOUR, linewidths=0.7, zorder=4, label=label
    )
    slice_angle = 2 * np.pi / len(is_visible)
    for s, sees_target in enumerate(is_visible):
        angle = 0.5 * np.pi - slice_angle * np.linspace(s, s + 1, 24)
        slice_ = np.vstack([[0.0, 0.0], np.stack([np.cos(angle), np.sin(angle)], axis=1), [0.0, 0.0]])
        farthest_corner = float(np.abs(slice_).max())  # a marker is scaled by its farthest corner
        marker_style = {
            "s": 0.8 * marker_size * farthest_corner**2,
            "marker": slice_.tolist(),
            "color": style.COLOUR_CYCLE[s],
        }
        ax.scatter(x[sees_target], y[sees_target], linewidths=0, zorder=5, **marker_style)
    is_hidden = ~is_visible.any(axis=0)
    if is_hidden.any():
        ax.scatter(
            x[is_hidden], y[is_hidden], marker="x", s=marker_size, color=style.RED, zorder=5, label="not visible"
        )


def _draw_gauge(ax: Axes, workshop: WorkshopScene) -> None:
    """Draw the gauge (reflectors at known distances): its reference lengths as lines."""
    for k, (a, b) in enumerate(workshop.gauge_pairs):
        ends = workshop.target_points[[a, b], :2]
        ax.plot(
            ends[:, 0], ends[:, 1], color=style.GREEN, linewidth=1.2, zorder=2, label="gauge length" if k == 0 else None
        )


def _draw_targets(ax: Axes, workshop: WorkshopScene) -> None:
    """Draw targets with markers that depend on the height above the floor."""
    height = workshop.target_points[:, 2] - workshop.floor_height
    lower_limit = -np.inf
    for upper_limit, marker, colour, class_name in TARGET_HEIGHT_CLASSES:
        is_in_class = (height > lower_limit) & (height <= upper_limit)
        legend_label = (
            f"{class_name} target, up to {upper_limit:g} m"
            if np.isfinite(upper_limit)
            else f"{class_name} target, above {lower_limit:g} m"
        )
        if is_in_class.any():
            ax.scatter(
                workshop.target_points[is_in_class, 0],
                workshop.target_points[is_in_class, 1],
                marker=marker,
                s=26,
                color=colour,
                zorder=4,
                edgecolors="white",
                linewidths=0.5,
                label=legend_label,
                rasterized=len(workshop.targets) > MAX_VECTOR_MARKERS,
            )
        lower_limit = upper_limit


def _target_labels(workshop: WorkshopScene) -> list[MapLabel]:
    """Labels of the targets, on the side away from the middle of the floor; targets above each other share a label."""
    floor_centre, size = workshop.floor_corners.mean(axis=0), np.ptp(workshop.floor_corners, axis=0)
    targets_by_cell: dict[tuple[float, ...], list[int]] = defaultdict(list)
    for i, cell in enumerate(
        np.round(workshop.target_points[:, :2] / (MAX_LABEL_SHARING_DISTANCE * size.max())).tolist()
    ):
        targets_by_cell[tuple(cell)].append(i)
    labels = []
    for members in targets_by_cell.values():
        place, names = (
            workshop.target_points[members[0], :2],
            [style.shortened_name(workshop.targets[i], 16) for i in members],
        )
        offset = (place - floor_centre) / size
        is_sideways = abs(offset[0]) > abs(offset[1])
        direction = (0.0 if offset[0] > 0 else np.pi) if is_sideways else (0.5 if offset[1] > 0 else 1.5) * np.pi
        text = " ".join(names) if len(names) < MIN_STACKED_TARGETS_OF_SHORT_LABEL else f"{names[0]} +{len(names) - 1}"
        labels.append(MapLabel(text, place, preferred_direction=direction))
    return labels


def _draw_stations(ax: Axes, workshop: WorkshopScene, colours: Sequence[str]) -> None:
    """Draw each station as a marker, with an arrow towards azimuth zero."""
    arrow_length = 0.075 * float(np.ptp(workshop.floor_corners, axis=0).max())
    ticks: Floats = arrow_length * np.stack([np.cos(workshop.station_yaws), np.sin(workshop.station_yaws)], axis=1)
    arrow = {"arrowstyle": "-|>", "color": style.INK_COLOUR, "lw": 1.3, "shrinkA": 0, "shrinkB": 0}
    for place, end in zip(workshop.station_positions[:, :2], ticks, strict=True):
        ax.annotate("", tuple(place + end), tuple(place), zorder=6, arrowprops=arrow)
    x, y = workshop.station_positions[:, :2].T
    marker, station_colours = "s" if colours is style.COLOUR_CYCLE else "o", list(colours[: len(workshop.stations)])
    marker_style: dict[str, Any] = {"s": 64, "edgecolors": "white", "linewidths": 0.8, "zorder": 7}
    ax.scatter(x, y, marker=marker, color=station_colours, label="station, tick to azimuth 0", **marker_style)


def _station_labels(workshop: WorkshopScene) -> list[MapLabel]:
    """Labels of the stations with their names, on the side away from azimuth zero."""
    return [
        MapLabel(
            style.shortened_name(name, 16),
            place[:2],
            9.0,
            is_bold=True,
            colour=style.INK_COLOUR,
            preferred_direction=float(yaw) + 1.25 * np.pi,
        )
        for name, place, yaw in zip(workshop.stations, workshop.station_positions, workshop.station_yaws, strict=True)
    ]


def _listed_stations_legend(workshop: WorkshopScene, n_other_entries: int) -> tuple[list[Line2D], list[str]]:
    """Empty legend handles, and texts with the positions of the stations, for the second column of a legend.

    The first column has `n_other_entries` entries; the shorter column is filled with empty texts.
    """
    lines = [
        f"{style.shortened_name(name, 10)}: {x:.3f}, {y:.3f}, {z:.3f} m, {yaw / DEGREE % 360:.0f}°"
        for name, (x, y, z), yaw in zip(
            workshop.stations, workshop.station_positions, workshop.station_yaws, strict=True
        )
    ]
    texts = ["station: x, y, z, azimuth 0", *lines]
    texts = [""] * (len(texts) - n_other_entries) + texts + [""] * (n_other_entries - len(texts))
    return [Line2D([], [], linestyle="none") for _ in texts], texts
