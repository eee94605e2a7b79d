"""The table [floor] of a plan file: areas for tripods, what stays free, doors."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from ltsim.errors import SetupError
from ltsim.planning.outlines import Area, KeepOut, fault
from ltsim.recording.setup import Finite, NonNegative, Positive, Section
from ltsim.units import MILLIMETRE

Corner = tuple[Finite, Finite]
Corners = Annotated[tuple[Corner, ...], Field(min_length=3, max_length=500)]
Heights = tuple[Positive, Positive]
HEAD_ROOM = 0.3
"""[m] that the head of an instrument needs above its centre."""


class FloorArea(Section):
    """One area where tripods may stand."""

    name: str = ""
    """What pictures and messages call it."""
    corners_mm: Corners
    """x and y of its corners, in order round it."""
    holes_mm: tuple[Corners, ...] = ()
    """Outlines that are cut out of it, such as a pit."""
    height_mm: Heights | None = None
    """Lowest and highest centre of the head here; as the whole floor's where it is not given."""
    ceiling_mm: Positive | None = None
    """Height of what hangs above this area, such as a gallery: heads stay 300 mm below it. To hide sights
    too, give it as an obstacle."""


class FreePlace(Section):
    """A place that stays free of tripods, such as the way of a crane."""

    name: str = ""
    """What pictures call it."""
    corners_mm: Corners
    """x and y of its corners, in order round it."""
    clear_mm: NonNegative = 0.0
    """Distance that stays free around it."""


class Door(Section):
    """A door, before which no tripod stands."""

    name: str = ""
    """What pictures call it."""
    from_mm: Corner
    """x and y of one side of the opening."""
    to_mm: Corner
    """x and y of the other side."""
    clear_mm: NonNegative = 1500.0
    """Distance that stays free before it."""


class Floor(Section):
    """Where tripods may stand; by default the whole floor but a margin along the walls."""

    corners_mm: Corners | None = None
    """Corners of the floor, x and y, in order round it; the room's without it."""
    margin_mm: NonNegative = 600.0
    """Distance to keep from the walls, where neither corners nor areas are given."""
    height_mm: Heights | None = None
    """Lowest and highest centre of the head; those of the scenario's stations where it is not given."""
    areas: tuple[FloorArea, ...] = ()
    """Tables `[[floor.areas]]`, in place of `corners_mm`: a tripod stands in one of them."""
    keep_outs: tuple[FreePlace, ...] = ()
    """Tables `[[floor.keep_outs]]`."""
    doors: tuple[Door, ...] = ()
    """Tables `[[floor.doors]]`."""

    @model_validator(mode="after")
    def _fits(self) -> Floor:
        for heights in (self.height_mm, *(area.height_mm for area in self.areas)):
            if heights is not None and heights[0] > heights[1]:
                raise ValueError("it should give the lower height_mm first")
        if self.areas and self.corners_mm is not None:
            raise ValueError("it should have either corners_mm or areas")
        return self


def ground_of(
    floor: Floor, size_mm: tuple[float, float, float], heights: tuple[float, float]
) -> tuple[tuple[Area, ...], tuple[KeepOut, ...]]:
    """Areas where tripods may stand and what is kept free in them [m].

    Parameters
    ----------
    size_mm : (float, float, float)
        Of the room.
    heights : (float, float), [m]
        Of heads, where neither the floor nor the area states them.

    Raises
    ------
    SetupError
        In one sentence, for an outline that crosses itself, leaves the room, or a ceiling too low for any head.
    """
    mm = MILLIMETRE
    usual = heights if floor.height_mm is None else (floor.height_mm[0] * mm, floor.height_mm[1] * mm)
    parts = floor.areas or (FloorArea(corners_mm=floor.corners_mm or _room(floor, size_mm)),)
    areas = []
    for i, part in enumerate(parts, 1):
        key = f"floor.areas.{i}.corners_mm" if floor.areas else "floor.corners_mm"
        low, high = usual if part.height_mm is None else (part.height_mm[0] * mm, part.height_mm[1] * mm)
        if part.ceiling_mm is not None:
            high = min(high, part.ceiling_mm * mm - HEAD_ROOM)
        if low > high:
            raise SetupError(
                f"floor.areas.{i}.ceiling_mm is {part.ceiling_mm:g}, but heads stand at {low / mm:g} mm and more; "
                "give the area a lower height_mm"
            )
        outline = _outline(key, part.corners_mm, size_mm)
        holes = tuple(_outline(f"floor.areas.{i}.holes_mm.{k}", hole) for k, hole in enumerate(part.holes_mm, 1))
        areas.append(Area(outline, (low, high), holes))
    free = [
        KeepOut(_outline(f"floor.keep_outs.{i}.corners_mm", place.corners_mm), place.clear_mm * mm)
        for i, place in enumerate(floor.keep_outs, 1)
    ]
    free += [KeepOut(np.array([door.from_mm, door.to_mm]) * mm, door.clear_mm * mm) for door in floor.doors]
    return tuple(areas), tuple(free)


def _room(floor: Floor, size_mm: tuple[float, float, float]) -> tuple[Corner, ...]:
    """The room's corners, less the margin."""
    (wide, deep, _), margin = size_mm, floor.margin_mm
    if 2 * margin >= min(wide, deep):
        raise SetupError(f"floor.margin_mm of {margin:g} leaves no floor in a workshop of {wide:g} x {deep:g} mm")
    return (margin, margin), (wide - margin, margin), (wide - margin, deep - margin), (margin, deep - margin)


def _outline(key: str, corners_mm: tuple[Corner, ...], size_mm: tuple[float, float, float] | None = None) -> np.ndarray:
    """Corners (k, 2) [m] of an outline that is simple and, where a room is given, within it."""
    outline = np.array(corners_mm, dtype=np.float64) * MILLIMETRE
    problem = fault(outline)
    if problem:
        raise SetupError(f"{key} is no outline: {problem}")
    if size_mm is not None:
        room = np.array(size_mm[:2]) * MILLIMETRE
        beyond = np.flatnonzero(np.any((outline < -1e-3) | (outline > room + 1e-3), axis=1))
        if len(beyond):
            x, y = corners_mm[beyond[0]]
            raise SetupError(
                f"{key} has the corner ({x:g}, {y:g}), outside the room of {size_mm[0]:g} x {size_mm[1]:g} mm"
            )
    return outline
