"""Areas of the floor where tripods may stand: TOML table `[floor]` of a plan file.

Outlines are polygons seen from above.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import shapely
from pydantic import Field, model_validator

from ltsim.core.arrays import Bools, Floats
from ltsim.core.errors import InputError
from ltsim.core.limits import MAX_FLOOR_PLAN_ELEMENTS
from ltsim.core.units import MILLIMETRE
from ltsim.recordings.setup import Finite, NonNegative, Positive, TomlSection

PlanPoint = tuple[Finite, Finite]
"""Coordinates x and y [mm] of a point on the floor."""
PlanOutline = Annotated[tuple[PlanPoint, ...], Field(min_length=3, max_length=500)]
"""Corners [mm] of a polygon on the floor, in order around it."""
HeightRange = tuple[Positive, Positive]
"""Lowest and highest height [mm] above the floor."""
MIN_HEAD_ROOM = 0.3
"""Smallest free height [m] above the centre of the tracker head."""
N_DEFAULT_TRIPOD_POSITIONS = 250
"""Approximate number of grid positions for tripods if no grid spacing is given. Positions of stations are refined
without the grid afterwards."""
EDGE_TOLERANCE = 1e-9
"""Largest distance [m] from the edge of an area of a position that counts as on the edge."""


class FloorArea(TomlSection):
    """Area of the floor where tripods may stand, table `[[floor.areas]]`."""

    name: str = ""
    """Name of the area, for figures and messages."""
    corners_mm: PlanOutline
    """Coordinates x and y of the corners, in order around the area."""
    holes_mm: Annotated[tuple[PlanOutline, ...], Field(max_length=MAX_FLOOR_PLAN_ELEMENTS)] = ()
    """Outlines of openings in the area, such as a pit, where no tripod may stand."""
    height_mm: HeightRange | None = None
    """Lowest and highest height of the centre of the tracker head in this area; default: values for the whole floor."""
    ceiling_mm: Positive | None = None
    """Height of a structure above this area, such as a gallery; tracker heads stay 300 mm below it. If the structure
    can hide targets, it must also be declared as an obstacle."""


class FloorKeepOut(TomlSection):
    """Area that must be kept free of tripods, such as the path of a crane; table `[[floor.keep_outs]]`."""

    name: str = ""
    """Name of the area, for figures."""
    corners_mm: PlanOutline
    """Coordinates x and y of the corners, in order around the area."""
    clear_mm: NonNegative = 0.0
    """Width of the strip around the outline of the area that must be free of tripods too."""


class Door(TomlSection):
    """Door, in front of which an area must be kept free of tripods; table `[[floor.doors]]`."""

    name: str = ""
    """Name of the door, for figures."""
    from_mm: PlanPoint
    """Coordinates x and y of one side of the opening."""
    to_mm: PlanPoint
    """Coordinates x and y of the other side of the opening."""
    clear_mm: NonNegative = 1500.0
    """Distance from the opening of the door within which no tripod may stand."""


class Floor(TomlSection):
    """Floor on which tripods may stand, table `[floor]`; by default the whole hall except a margin along its walls."""

    corners_mm: PlanOutline | None = None
    """Coordinates x and y of the corners of the floor, in order around it; default: corners of the hall."""
    margin_mm: NonNegative = 600.0
    """Distance of tripods from the walls if neither `corners_mm` nor areas are given."""
    height_mm: HeightRange | None = None
    """Lowest and highest height of the centre of the tracker head; default: range of the heights of the scenario's
    stations."""
    areas: Annotated[tuple[FloorArea, ...], Field(max_length=MAX_FLOOR_PLAN_ELEMENTS)] = ()
    """Areas where tripods may stand, tables `[[floor.areas]]`, in place of `corners_mm`."""
    keep_outs: Annotated[tuple[FloorKeepOut, ...], Field(max_length=MAX_FLOOR_PLAN_ELEMENTS)] = ()
    """Areas to be kept free of tripods, tables `[[floor.keep_outs]]`."""
    doors: Annotated[tuple[Door, ...], Field(max_length=MAX_FLOOR_PLAN_ELEMENTS)] = ()
    """Doors with an area to be kept free of tripods, tables `[[floor.doors]]`."""

    @model_validator(mode="after")
    def _check_heights_and_outline(self) -> Floor:
        for heights in (self.height_mm, *(area.height_mm for area in self.areas)):
            if heights is not None and heights[0] > heights[1]:
                raise ValueError("height_mm must give the lower height first")
        if self.areas and self.corners_mm is not None:
            raise ValueError("the floor must have either corners_mm or areas, not both")
        return self


def areas_and_keep_outs(
    floor_spec: Floor, hall_size_mm: tuple[float, float, float], heights: tuple[float, float]
) -> tuple[tuple[StandingArea, ...], tuple[KeepOutArea, ...]]:
    """Areas where tripods may stand, and areas to be kept free, both in metres.

    `floor_spec` is the table `[floor]`. `heights` are the lowest and highest height [m] of the tracker head where
    neither this table nor the area gives heights. Raises InputError for an outline that crosses itself or leaves the
    hall, and for a ceiling below all heights of the tracker head.
    """
    mm = MILLIMETRE
    default_heights = (
        heights if floor_spec.height_mm is None else (floor_spec.height_mm[0] * mm, floor_spec.height_mm[1] * mm)
    )
    floor_areas = floor_spec.areas or (
        FloorArea(corners_mm=floor_spec.corners_mm or _floor_outline_within_margin(floor_spec, hall_size_mm)),
    )
    areas = []
    for i, part in enumerate(floor_areas, 1):
        key = f"floor.areas.{i}.corners_mm" if floor_spec.areas else "floor.corners_mm"
        low, high = default_heights if part.height_mm is None else (part.height_mm[0] * mm, part.height_mm[1] * mm)
        if part.ceiling_mm is not None:
            high = min(high, part.ceiling_mm * mm - MIN_HEAD_ROOM)
        if low > high:
            raise InputError(
                f"floor.areas.{i}.ceiling_mm is {part.ceiling_mm:g}, but tracker heads are at {low / mm:g} mm or more; "
                "set a lower height_mm for the area"
            )
        outline = _outline_in_metres(key, part.corners_mm, hall_size_mm)
        holes = tuple(
            _outline_in_metres(f"floor.areas.{i}.holes_mm.{k}", hole) for k, hole in enumerate(part.holes_mm, 1)
        )
        areas.append(StandingArea(outline, (low, high), holes))
    free = [
        KeepOutArea(_outline_in_metres(f"floor.keep_outs.{i}.corners_mm", place.corners_mm), place.clear_mm * mm)
        for i, place in enumerate(floor_spec.keep_outs, 1)
    ]
    free += [KeepOutArea(np.array([door.from_mm, door.to_mm]) * mm, door.clear_mm * mm) for door in floor_spec.doors]
    return tuple(areas), tuple(free)


def _floor_outline_within_margin(floor_spec: Floor, hall_size_mm: tuple[float, float, float]) -> tuple[PlanPoint, ...]:
    """Corners [mm] of the floor of the hall without the margin along its walls.

    Raises InputError if the margin leaves no floor.
    """
    (wide, deep, _), margin = hall_size_mm, floor_spec.margin_mm
    if 2 * margin >= min(wide, deep):
        raise InputError(f"floor.margin_mm of {margin:g} leaves no floor in a hall of {wide:g} x {deep:g} mm")
    return (margin, margin), (wide - margin, margin), (wide - margin, deep - margin), (margin, deep - margin)


def _outline_in_metres(
    outline_key: str, corners_mm: tuple[PlanPoint, ...], hall_size_mm: tuple[float, float, float] | None = None
) -> np.ndarray:
    """Corners (k, 2) [m] of an outline, from its k corners [mm]; `outline_key` is its key in the plan file.

    Raises InputError, with this key, if the outline crosses itself, or leaves the hall if `hall_size_mm` is given.
    """
    outline = np.array(corners_mm, dtype=np.float64) * MILLIMETRE
    problem = invalid_outline_reason(outline)
    if problem:
        raise InputError(f"{outline_key} is not an outline: {problem}")
    if hall_size_mm is not None:
        hall = np.array(hall_size_mm[:2]) * MILLIMETRE
        beyond = np.flatnonzero(np.any((outline < -1e-3) | (outline > hall + 1e-3), axis=1))
        if len(beyond):
            x, y = corners_mm[beyond[0]]
            raise InputError(
                f"{outline_key} has the corner ({x:g}, {y:g}), outside the hall of "
                f"{hall_size_mm[0]:g} x {hall_size_mm[1]:g} mm"
            )
    return outline


@dataclass(frozen=True)
class StandingArea:
    """Area of the floor where tripods may stand, in metres."""

    outline: Floats
    """Corners (k, 2) [m] of the area, in order around it."""
    head_height_range: tuple[float, float]
    """Lowest and highest height [m] of the centre of the tracker head in this area."""
    holes: tuple[Floats, ...] = ()
    """Openings in the area, each as its k corners (k, 2) [m]."""

    def contains_instrument(self, position: Floats) -> Bools:
        """Flags (N,) of the instrument positions among N (N, 3) [m] over this area and between its limits of height."""
        low, high = self.head_height_range
        return np.asarray(
            self.covers_positions(position[:, :2])
            & (position[:, 2] > low - EDGE_TOLERANCE)
            & (position[:, 2] < high + EDGE_TOLERANCE)
        )

    def covers_positions(self, positions: Floats) -> Bools:
        """Flags (N,) of those of N positions (N, 2) [m] on the floor that are in the area and outside its openings."""
        is_covered = is_inside_outline(self.outline, positions)
        for hole in self.holes:
            is_covered &= ~is_inside_outline(hole, positions)
        return is_covered


@dataclass(frozen=True)
class KeepOutArea:
    """Area to be kept free of tripods: an outline seen from above, or a line segment, with a clearance around it."""

    outline: Floats
    """Corners (k, 2) [m] of the outline, or ends (2, 2) [m] of a line segment."""
    clearance: float = 0.0
    """Width [m] of the strip around the outline that must be free too."""

    def blocks_positions(self, positions: Floats) -> Bools:
        """Flags (N,) of those of N positions (N, 2) [m] on the floor that are in the area or its clearance."""
        is_near = distance_to_outline(self.outline, positions) < self.clearance + EDGE_TOLERANCE
        return is_near | is_inside_outline(self.outline, positions) if len(self.outline) > 2 else is_near

    def is_crossed_by_path(self, path: Floats) -> bool:
        """True if a straight path, given by its ends (2, 2) [m], crosses the outline or the segment.

        The clearance is not considered.
        """
        shape = shapely.polygons(self.outline) if len(self.outline) > 2 else shapely.linestrings(self.outline)
        return bool(shapely.intersects(shape, shapely.linestrings(path)))


def distance_to_outline(outline: Floats, positions: Floats) -> Floats:
    """Distance (N,) [m] of N positions (N, 2) from the edges of an outline with k corners (k, 2), or of a segment."""
    edges = shapely.linearrings(outline) if len(outline) > 2 else shapely.linestrings(outline)
    return np.asarray(shapely.distance(edges, shapely.points(positions)))


def is_inside_outline(outline: Floats, positions: Floats) -> Bools:
    """Flags (N,) of N positions (N, 2) [m] inside an outline (k, 2) [m] or within `EDGE_TOLERANCE` of it."""
    return np.asarray(shapely.distance(shapely.polygons(outline), shapely.points(positions)) < EDGE_TOLERANCE)


def invalid_outline_reason(outline: Floats) -> str:
    """Reason, as text, why k corners (k, 2) [m] are not a valid outline; empty for a valid one.

    A valid outline does not cross itself, and its area is not zero.
    """
    count, then = len(outline), np.roll(outline, -1, axis=0)
    same_rows = np.flatnonzero(np.linalg.norm(outline - np.roll(outline, 1, axis=0), axis=1) < EDGE_TOLERANCE)
    if len(same_rows):
        return f"its corner {same_rows[0] + 1} coincides with the corner before it"
    edges = shapely.linestrings(np.stack([outline, then], axis=1))
    first, second = np.nonzero(np.triu(shapely.dwithin(edges[:, None], edges, EDGE_TOLERANCE), 2))
    for i, j in zip(first.tolist(), second.tolist(), strict=True):
        if (i, j) != (0, count - 1):  # first and last side have a corner in common
            return (
                f"its sides after corners {i + 1} and {j + 1} cross or touch; give the corners in order around the area"
            )
    return "" if shapely.area(shapely.polygons(outline)) > EDGE_TOLERANCE else "its corners lie on one line"


def tripod_grid_spacing(standing_areas: Sequence[StandingArea], requested_step_mm: float | None) -> float:
    """Spacing [m] of the grid of tripod positions, from `requested_step_mm` [mm] or, if this is None, from the floor.

    By default about `N_DEFAULT_TRIPOD_POSITIONS` positions cover the areas, at least half a metre from each other.
    """
    if requested_step_mm is not None:
        return requested_step_mm * MILLIMETRE
    total_area = sum(float(np.prod(np.ptp(area.outline, axis=0))) for area in standing_areas)
    return max(round(float(np.sqrt(total_area / N_DEFAULT_TRIPOD_POSITIONS)), 1), 0.5)


def height_range_text(lowest: float, highest: float) -> str:
    """Text of a range of heights [m], in millimetres: `1400 to 1800 mm`, or `1500 mm` if both heights are equal."""
    low, high = f"{lowest / MILLIMETRE:g}", f"{highest / MILLIMETRE:g}"
    return f"{low} mm" if low == high else f"{low} to {high} mm"


def grid_over_area(standing_area: StandingArea, grid_spacing: float, n_heights: int) -> Floats:
    """Grid of N instrument positions (N, 3) [m] over the bounding rectangle of an area, with this spacing [m].

    At each grid point there are `n_heights` positions from the lowest to the highest height of the area; one position
    if both heights are equal.
    """
    low, high = standing_area.outline.min(axis=0), standing_area.outline.max(axis=0)
    n_grid_points = np.maximum(np.ceil((high - low) / grid_spacing).astype(int), 1)
    axes = [np.linspace(a, b, n + 1) for a, b, n in zip(low, high, n_grid_points, strict=True)]
    bottom, top = standing_area.head_height_range
    levels = np.linspace(bottom, top, n_heights if top - bottom > EDGE_TOLERANCE else 1)
    return np.stack([g.ravel() for g in np.meshgrid(*axes, levels, indexing="ij")], axis=1)
