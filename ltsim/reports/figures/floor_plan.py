"""Floor plan seen from above, as Figure 5 of the paper, with names of stations and targets."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import hypot
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Ellipse, Polygon

from ltsim.core.arrays import Bools, Floats
from ltsim.core.units import DEGREE, MILLIMETRE
from ltsim.planning.plan_change import PlanChange
from ltsim.reports import style
from ltsim.reports.figures.obstacles import draw_obstacles
from ltsim.reports.workshop import PlacedWorkshop
from ltsim.scene.floor import Floor, FloorArea, distance_to_outline

TURNS = np.radians([0, 180, 90, 270])
GAP = 6.0
"""Distance [pt] from a place to its name."""
LETTER = (0.62, 1.25)
"""Width and height of a letter, over the font size."""
HALO = {"boxstyle": "square,pad=0", "facecolor": "#FFFFFFB0", "edgecolor": "none"}
"""Background of a name."""


@dataclass(frozen=True)
class Label:
    """Name with its place (2,) in data units and size [pt]; direction `away` [rad] is tried first."""

    text: str
    place: Floats
    size: float = 7.0
    bold: bool = False
    colour: str = "#4A5056"
    away: float = 0.0


def place_labels(figure: Figure, ax: Axes, labels: Sequence[Label], markers: Floats) -> None:
    """Write labels next to markers (n, 2) where they fit, in order of priority; the limits of the axes must be set."""
    figure.draw_without_rendering()
    point = figure.dpi / 72.0
    spots = ax.transData.transform(markers).reshape(-1, 2) / point
    edge, below = ax.get_window_extent().p0 / point
    right, top = 72.0 * figure.get_size_inches()
    numbers = [[-1e4, -1e4, edge, 1e4], [-1e4, -1e4, 1e4, below]]  # tick labels of the axes
    numbers += [[right, -1e4, 1e4, 1e4], [-1e4, top, 1e4, 1e4]]  # outside the figure
    taken = np.concatenate([np.concatenate([spots - 3.0, spots + 3.0], axis=1), numbers])
    for label in labels:
        half = 0.5 * label.size * np.array([LETTER[0] * len(label.text), LETTER[1]])
        for turn in label.away + TURNS:
            way = np.array([np.cos(turn), np.sin(turn)])
            offset = way * GAP + half * np.clip(1.5 * way, -1.0, 1.0)  # the box does not cover the mark
            middle = ax.transData.transform(label.place) / point + offset
            box = np.concatenate([middle - half, middle + half])
            if not ((box[:2] < taken[:, 2:]) & (box[2:] > taken[:, :2])).all(axis=1).any():
                taken = np.concatenate([taken, box[None]])
                ax.annotate(
                    label.text, tuple(label.place), xytext=tuple(offset), textcoords="offset points", ha="center",
                    va="center", fontsize=label.size, fontweight="bold" if label.bold else "normal",
                    color=label.colour, zorder=8, in_layout=False, bbox=HALO,
                )  # fmt: skip
                break


LEVELS = ((0.9, "v", style.ORANGE, "low"), (3.2, "s", style.SKY, "middle"), (np.inf, "^", style.BLUE, "high"))
MAX_LABELS = 60
FEW_DOTS = 150
"""Number of targets above which their marks are rasterised."""
MAX_PLACES = 16
MAX_STACKED = 4
NEAR = 0.05
"""Distance within which targets share a label, over the size of the floor."""
WIDE = 4.3
HEIGHTS = (3.6, 6.6)
ROW = 0.16
"""Width of the axes, limits of the height of the figure, and additional height per listed place [inch]."""
ON_A_WALL = 0.35
"""Distance [m] from a side of the floor within which a target belongs to its wall."""


@style.styled
def floor_plan(
    workshop: PlacedWorkshop,
    *,
    reference: Floats | None = None,
    coordinates: bool = False,
    ground: Floor | None = None,
    marks: Callable[[Axes], list[Label]] = lambda ax: [],
) -> Figure:
    """Top view in metres: circles are the shadow cones of both openings on the floor, the tick is azimuth zero.

    Parameters
    ----------
    workshop : PlacedWorkshop
    reference : (k, 3) float, optional, [m]
        Stations of another layout, to compare with.
    coordinates : bool
        True to list the places of the tripods below the figure.
    ground : Floor, optional
        Areas for tripods, areas to keep free, and doors of a plan.
    marks : function, optional
        Function that draws further marks, with labels for the legend, and returns their names.
    """
    low, high = _limits(workshop)
    tall = (high[1] - low[1]) / (high[0] - low[0])
    figure, ax = style.panel(float(np.clip(WIDE * tall + 1.2, *HEIGHTS)), layout="compressed")
    ax.set_aspect("equal")
    style.quiet_axis(ax, grid="both")
    ax.add_patch(
        Polygon(workshop.floor, closed=True, facecolor="#F7F8F9", edgecolor="#B5BBC0", linewidth=0.8, zorder=0)
    )
    _walls(ax, workshop)
    names = _ground(ax, ground) if ground is not None else []
    draw_obstacles(ax, workshop.obstacles)
    _shadows(ax, workshop)
    _gauge(ax, workshop)
    visible = _sight_matrix(workshop)
    if visible is None:
        _targets(ax, workshop)
    else:
        _pies(ax, workshop, visible)
    if reference is not None and len(reference):
        ax.scatter(
            reference[:, 0], reference[:, 1], s=46, facecolors="white", edgecolors=style.GREY, linewidths=1.4, zorder=5,
            label="station of the reference",
        )  # fmt: skip
    _stations(ax, workshop, [style.INK] * len(workshop.stations) if visible is None else style.CYCLE)
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    marked = marks(ax)
    labels_of = [*marked, *_station_labels(workshop), *names]
    if len(workshop.targets) <= MAX_LABELS:
        labels_of += _target_labels(workshop)
    handles, labels = ax.get_legend_handles_labels()
    if coordinates and len(workshop.stations) <= MAX_PLACES:
        blank, places = _places(workshop, entries=len(labels))
        handles, labels = [*handles, *blank], [*labels, *places]
        figure.set_figheight(figure.get_figheight() + ROW * len(places))
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    spots = [*workshop.position[:, :2], *workshop.points[:, :2], *(label.place for label in marked)]
    place_labels(figure, ax, labels_of, np.array(spots))
    return figure


def _walls(ax: Axes, workshop: PlacedWorkshop) -> None:
    """Draw the sides of the floor with at least two targets nearest to them."""
    word: str | None = "wall with targets"
    sides = np.stack([workshop.floor, np.roll(workshop.floor, -1, axis=0)], axis=1)
    away = np.array([distance_to_outline(side, workshop.points[:, :2]) for side in sides])
    nearest = np.where(away.min(axis=0) < ON_A_WALL, away.argmin(axis=0), -1)
    for number, side in enumerate(sides):
        if np.sum(nearest == number) >= 2:
            ax.plot(*side.T, color=style.INK, linewidth=3.0, zorder=1, label=word)
            word = None


def _ground(ax: Axes, ground: Floor) -> list[Label]:
    """Draw areas for tripods, areas to keep free, and doors; returns their names."""
    mm, names = MILLIMETRE, []
    areas = ground.areas or ((FloorArea(corners_mm=ground.corners_mm),) if ground.corners_mm else ())
    for i, area in enumerate(areas):
        corners = np.array(area.corners_mm) * mm
        word = "area for tripods" if i == 0 else None
        ax.add_patch(
            Polygon(corners, facecolor="#009E7318", edgecolor=style.GREEN, linewidth=0.9, zorder=0.5, label=word)
        )
        for hole in area.holes_mm:
            ax.add_patch(
                Polygon(np.array(hole) * mm, facecolor="white", edgecolor=style.GREEN, linewidth=0.9, zorder=0.6)
            )
        names.append(Label(area.name, corners.min(axis=0), 7.0, colour="#00664B", away=0.25 * np.pi))
    for i, place in enumerate(ground.keep_outs):
        corners = np.array(place.corners_mm) * mm
        word = "kept free" if i == 0 else None
        ax.add_patch(
            Polygon(corners, facecolor="#FFFFFFCC", edgecolor=style.PURPLE, hatch="////", zorder=0.7, label=word)
        )
        names.append(Label(place.name, corners.mean(axis=0), 7.0, colour="#8A3A66", away=0.5 * np.pi))
    for i, door in enumerate(ground.doors):
        ends = np.array([door.from_mm, door.to_mm]) * mm
        ax.plot(*ends.T, color="white", linewidth=5.0, zorder=1.5)
        ax.plot(*ends.T, color=style.PURPLE, linewidth=2.0, zorder=1.6, label="door" if i == 0 else None)
        names.append(Label(door.name, ends.mean(axis=0), 7.0, colour="#8A3A66"))
    return [label for label in names if label.text]


def _limits(workshop: PlacedWorkshop) -> Floats:
    """Limits (2, 2) of x and y that show the whole floor and the inner circles."""
    radius = workshop.shadow_radius(workshop.openings[0])[:, None]
    places = np.concatenate([workshop.floor, workshop.position[:, :2] - radius, workshop.position[:, :2] + radius])
    low, high = places.min(axis=0), places.max(axis=0)
    margin = 0.13 * float((high - low).max())  # room for the names of targets on the walls
    return np.stack([low - margin, high + margin])


def _shadows(ax: Axes, workshop: PlacedWorkshop) -> None:
    for k, opening in enumerate(workshop.openings):
        inner, outer = {"facecolor": "#D55E0022"}, {"facecolor": "none", "linestyle": (0, (3, 2))}
        how: dict[str, Any] = {"edgecolor": style.RED, "linewidth": 0.9, "zorder": 1} | (outer if k else inner)
        for s, radius in enumerate(workshop.shadow_radius(opening)):
            word = f"shadow, cone of {opening / DEGREE:.0f}°" if s == 0 else None
            ax.add_patch(Circle(tuple(workshop.position[s, :2]), radius, label=word, **how))


def _sight_matrix(workshop: PlacedWorkshop) -> Bools | None:
    """Matrix (S, T) of visible pairs; None if unknown, if all are visible, or with more stations than colours."""
    count = len(workshop.stations), len(workshop.targets)
    if workshop.sights is None or count[0] > len(style.CYCLE) or not len(workshop.hidden):
        return None
    visible = np.zeros(count, dtype=bool)
    visible[workshop.sights.station, workshop.sights.target] = True
    return visible


def _pies(ax: Axes, workshop: PlacedWorkshop, visible: Bools) -> None:
    """Draw each target as a circle with a slice in the colour of each station that sees it."""
    x, y = workshop.points[:, :2].T
    size = 62 if len(workshop.targets) <= MAX_LABELS else 34
    label = "target: slices are the\nstations that see it"
    ax.scatter(x, y, s=size, facecolors="white", edgecolors=style.INK, linewidths=0.7, zorder=4, label=label)
    turn = 2 * np.pi / len(visible)
    for s, sees in enumerate(visible):
        angle = 0.5 * np.pi - turn * np.linspace(s, s + 1, 24)
        slice_ = np.vstack([[0.0, 0.0], np.stack([np.cos(angle), np.sin(angle)], axis=1), [0.0, 0.0]])
        reach = float(np.abs(slice_).max())  # a marker is scaled by its farthest corner
        look = {"s": 0.8 * size * reach**2, "marker": slice_.tolist(), "color": style.CYCLE[s]}
        ax.scatter(x[sees], y[sees], linewidths=0, zorder=5, **look)
    none = ~visible.any(axis=0)
    if none.any():
        ax.scatter(x[none], y[none], marker="x", s=size, color=style.RED, zorder=5, label="not visible")


def _gauge(ax: Axes, workshop: PlacedWorkshop) -> None:
    for k, (a, b) in enumerate(workshop.gauge):
        ends = workshop.points[[a, b], :2]
        ax.plot(
            ends[:, 0], ends[:, 1], color=style.GREEN, linewidth=1.2, zorder=2, label="gauge length" if k == 0 else None
        )


def _targets(ax: Axes, workshop: PlacedWorkshop) -> None:
    """Draw targets with marks by height."""
    height = workshop.points[:, 2] - workshop.floor_height
    low = -np.inf
    for high, marker, colour, word in LEVELS:
        here = (height > low) & (height <= high)
        span = f"{word} target, up to {high:g} m" if np.isfinite(high) else f"{word} target, above {low:g} m"
        if here.any():
            ax.scatter(
                workshop.points[here, 0],
                workshop.points[here, 1],
                marker=marker,
                s=26,
                color=colour,
                zorder=4,
                edgecolors="white",
                linewidths=0.5,
                label=span,
                rasterized=len(workshop.targets) > FEW_DOTS,
            )
        low = high


def _target_labels(workshop: PlacedWorkshop) -> list[Label]:
    """Labels of targets, one for those above each other, preferably away from the middle of the floor."""
    middle, size = workshop.floor.mean(axis=0), np.ptp(workshop.floor, axis=0)
    stacks: dict[tuple[float, ...], list[int]] = defaultdict(list)
    for i, cell in enumerate(np.round(workshop.points[:, :2] / (NEAR * size.max())).tolist()):
        stacks[tuple(cell)].append(i)
    labels = []
    for members in stacks.values():
        place, names = workshop.points[members[0], :2], [style.shorten(workshop.targets[i], 16) for i in members]
        away = (place - middle) / size
        sideways = abs(away[0]) > abs(away[1])
        turn = (0.0 if away[0] > 0 else np.pi) if sideways else (0.5 if away[1] > 0 else 1.5) * np.pi
        text = " ".join(names) if len(names) < MAX_STACKED else f"{names[0]} +{len(names) - 1}"
        labels.append(Label(text, place, away=turn))
    return labels


def _stations(ax: Axes, workshop: PlacedWorkshop, colours: Sequence[str]) -> None:
    length = 0.075 * float(np.ptp(workshop.floor, axis=0).max())
    tick: Floats = length * np.stack([np.cos(workshop.yaw), np.sin(workshop.yaw)], axis=1)
    arrow = {"arrowstyle": "-|>", "color": style.INK, "lw": 1.3, "shrinkA": 0, "shrinkB": 0}
    for place, end in zip(workshop.position[:, :2], tick, strict=True):
        ax.annotate("", tuple(place + end), tuple(place), zorder=6, arrowprops=arrow)
    x, y = workshop.position[:, :2].T
    marker, chosen = "s" if colours is style.CYCLE else "o", list(colours[: len(workshop.stations)])
    look: dict[str, Any] = {"s": 64, "edgecolors": "white", "linewidths": 0.8, "zorder": 7}
    ax.scatter(x, y, marker=marker, color=chosen, label="station, tick to azimuth 0", **look)


def _station_labels(workshop: PlacedWorkshop) -> list[Label]:
    return [
        Label(style.shorten(name, 16), place[:2], 9.0, bold=True, colour=style.INK, away=float(yaw) + 1.25 * np.pi)
        for name, place, yaw in zip(workshop.stations, workshop.position, workshop.yaw, strict=True)
    ]


def _places(workshop: PlacedWorkshop, entries: int) -> tuple[list[Line2D], list[str]]:
    """Entries of the second column of a legend, whose first column has `entries` lines."""
    lines = [
        f"{style.shorten(name, 10)}: {x:.3f}, {y:.3f}, {z:.3f} m, {yaw / DEGREE % 360:.0f}°"
        for name, (x, y, z), yaw in zip(workshop.stations, workshop.position, workshop.yaw, strict=True)
    ]
    words = ["station: x, y, z, azimuth 0", *lines]
    words = [""] * (len(words) - entries) + words + [""] * (entries - len(words))
    return [Line2D([], [], linestyle="none") for _ in words], words


@style.styled
def whereabouts(
    workshop: PlacedWorkshop,
    marked: Sequence[str],
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
        least = MIN_AREA * workshop.size
        ax.add_patch(Ellipse((x, y), 2 * max(wide, least), 2 * max(high, least), color=style.RED, alpha=0.35, zorder=8))
        ax.scatter(x, y, marker="+", s=90, color=style.RED, zorder=9)
    elif area:
        ((axis, (centre, half)),) = area.items()
        span = ax.axvspan if axis == "x" else ax.axhspan
        span(centre - half, centre + half, color=style.RED, alpha=0.35, zorder=8)
    names = [*workshop.stations, *workshop.targets]
    place = dict(zip(names, np.concatenate([workshop.position, workshop.points])[:, :2].tolist(), strict=True))
    for name in marked:
        if name in place:
            x, y = place[name]
            ax.scatter(x, y, s=180, facecolors="none", edgecolors=style.RED, linewidths=2.0, zorder=9)
    for start, end in pairs:
        arrow = {"arrowstyle": "<|-|>", "color": style.RED, "lw": 1.6, "shrinkA": 5, "shrinkB": 5}
        ax.annotate("", place[end], place[start], arrowprops=arrow, zorder=9)
    return figure


MIN_AREA = 0.015
"""Half-width with which a place of the hall is drawn at least, over the size of the hall."""
SAME_PLACE = 0.04
"""Distance within which changes share a mark, over the size of the hall."""


@style.styled
def reflector_changes(workshop: PlacedWorkshop, changes: Sequence[PlanChange], ground: Floor | None = None) -> Figure:
    """Floor plan with numbered changes of reflectors: moves as arrows, omitted ones as crosses."""
    current = dict(zip(workshop.targets, workshop.points[:, :2].tolist(), strict=True))

    def marks(ax: Axes) -> list[Label]:
        labels = []
        kinds = (True, "D", style.PURPLE, "new place, by number"), (False, "x", style.RED, "can go, by number")
        for new, marker, colour, word in kinds:
            numbers: dict[tuple[float, float], list[int]] = {}
            for number, change in enumerate(changes, 1):
                if (change.position_mm is not None) != new:
                    continue
                there = change.position_mm
                x, y = (v * MILLIMETRE for v in there[:2]) if there else current[change.reflector]
                near = next((p for p in numbers if hypot(p[0] - x, p[1] - y) < SAME_PLACE * workshop.size), (x, y))
                numbers.setdefault(near, []).append(number)
                if new and change.reflector:
                    arrow = {"arrowstyle": "-|>", "color": style.PURPLE, "lw": 1.3, "shrinkA": 3, "shrinkB": 4}
                    ax.annotate("", near, xytext=current[change.reflector], arrowprops=arrow, zorder=8)
            if numbers:
                at = np.array([*numbers]).T
                ax.scatter(at[0], at[1], marker=marker, s=40, color=colour, zorder=9, label=word)
            labels += [Label(", ".join(map(str, n)), np.array(at), 8.0, bold=True) for at, n in numbers.items()]
        return labels

    return floor_plan(workshop, ground=ground, marks=marks)
