"""A list of points in the hall's axes: name, place, and which of them matter how much."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from ltsim.errors import RecordError, as_setup_error
from ltsim.recording.coordinates import Points, read_points as read_coordinates
from ltsim.recording.files import comma_number, shown
from ltsim.recording.setup import Finite, NonNegative, Positive, Section
from ltsim.units import MILLIMETRE


class Point(Section):
    """A point to measure; with ``points = "points.csv"`` the file has these keys as its columns.

    The file is a list of coordinates in any dialect that is read: ``Name;X [m];Y [m];Z [m]`` does as well.
    """

    name: str
    """Its name."""
    x_mm: Finite
    """Place in the hall's axes."""
    y_mm: Finite
    """As x_mm."""
    z_mm: Finite
    """As x_mm."""
    group: str = ""
    """Points that a tolerance names together."""
    weight: NonNegative = 1.0
    """How much its squared error counts among those of the others."""
    tolerance_mm: Positive | None = None
    """Largest error that it may have, at the goal's level."""


def read_points(path: Path) -> tuple[Point, ...]:
    """The points of a list of coordinates in any dialect, with the keys above as further columns; raises SetupError."""
    with as_setup_error():
        return _points(path)


def _points(path: Path) -> tuple[Point, ...]:
    found = read_coordinates(path)
    known = list(Point.model_fields)[4:]
    for name in found.further:
        if name not in known:
            what = f"has the column '{shown(name)}' too many; expected name, x, y, z and, optional, {', '.join(known)}"
            raise RecordError(what, file=path)
    return tuple(_point(found, i, path) for i in range(len(found.names)))


def _point(found: Points, i: int, path: Path) -> Point:
    where: dict[str, Any] = {"file": path, "row": found.lines[i]}

    def further(column: str, usual: float | None) -> float | None:
        text = found.further[column][i] if column in found.further else ""
        if not text:
            return usual
        value = comma_number(text, column=column, **where)
        if not (value > 0 or (value == 0 and column == "weight")):
            raise RecordError(f"found {value:g}, expected a positive number", column=column, **where)
        return value

    place = dict(zip(("x_mm", "y_mm", "z_mm"), (found.points[i] / MILLIMETRE).round(9).tolist(), strict=True))
    missing = next((column for column, value in place.items() if not math.isfinite(value)), None)
    if missing:
        raise RecordError("found nothing, expected a number", column=missing, **where)
    group = found.further["group"][i] if "group" in found.further else ""
    rest = {"weight": further("weight", 1.0), "tolerance_mm": further("tolerance_mm", None)}
    return Point.model_validate({"name": found.names[i], "group": group, **place, **rest})
