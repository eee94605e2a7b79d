"""A list of points in the hall's axes: name, place, and which of them matter how much."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ltsim.errors import RecordError, as_setup_error
from ltsim.recording.files import check_name, comma_number, shown, table_rows
from ltsim.recording.setup import Finite, NonNegative, Positive, Section

PLACE = ("x_mm", "y_mm", "z_mm")


class Point(Section):
    """A point to measure; with ``points = "points.csv"`` the file has these keys as its columns.

    Cells of the file are separated by commas, semicolons or tabs; with the latter two a decimal comma is read too.
    Lines before the header that begin with # are remarks.
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
    """The points of a CSV file; raises SetupError."""
    with as_setup_error():
        return _points(path)


def _points(path: Path) -> tuple[Point, ...]:
    header, rows = table_rows(path)
    _check_header(header, path)
    found: dict[str, Point] = {}
    for line, cells in rows:
        point = _point(cells, path, line)
        if point.name in found:
            raise RecordError(f"the point '{shown(point.name)}' stands twice", file=path, row=line)
        found[point.name] = point
    if not found:
        raise RecordError("holds no points below its header", file=path)
    return tuple(found.values())


def _check_header(header: list[str], path: Path) -> None:
    known = list(Point.model_fields)
    wanted = f"expected {', '.join(known[:4])} and, optional, {', '.join(known[4:])}"
    for name in known[:4]:
        if name not in header:
            raise RecordError(f"has no column {name}; {wanted}", file=path)
    for name in header:
        if name not in known or header.count(name) > 1:
            what = "twice" if name in known else "too many"
            raise RecordError(f"has the column '{shown(name)}' {what}; {wanted}", file=path)


def _point(cells: Mapping[str, str], path: Path, line: int) -> Point:
    def value(column: str, usual: float | None = None) -> float | None:
        if column not in PLACE and not cells.get(column):
            return usual
        found = comma_number(cells[column], file=path, row=line, column=column)
        if column not in PLACE and not (found > 0 or (found == 0 and column == "weight")):
            raise RecordError(f"found {found:g}, expected a positive number", file=path, row=line, column=column)
        return found

    name = check_name(cells["name"], "target", file=path, row=line, column="name")
    numbers = {column: value(column) for column in PLACE}
    numbers |= {"weight": value("weight", 1.0), "tolerance_mm": value("tolerance_mm")}
    return Point.model_validate({"name": name, "group": cells.get("group", ""), **numbers})
