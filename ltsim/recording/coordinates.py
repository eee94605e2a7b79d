"""Coordinates of one epoch with their full covariance, as an adjustment elsewhere left them.

Two forms are read:

* adjustment results of gama-local (XML), points with x and y, with z, or with all three alike;
* a CSV table ``target,x_mm,y_mm,z_mm`` (an axis that was not measured is left out) with the covariance beside it: in
  ``NAME.covariance.csv`` the matrix [mm^2], its header and first column the coordinates as ``TARGET.x``; otherwise the
  columns ``sigma_x_mm`` and so on, which say nothing of what points have in common.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ltsim.arrays import Floats, Ints
from ltsim.errors import RecordError
from ltsim.recording.files import check_name, decoded, number, shown, table_rows
from ltsim.recording.formats.xml import parse, tag
from ltsim.units import MILLIMETRE

AXES = "xyz"
SYMMETRIC = 1e-6
"""Share by which entries across the diagonal may differ by rounding."""
DEFINITE = -1e-9
"""Smallest eigenvalue of correlations that rounding explains."""


@dataclass(frozen=True)
class Coordinates:
    """Points of one epoch along the d axes that were measured."""

    title: str
    names: tuple[str, ...]
    """(T,)."""
    axes: str
    """The measured ones of x, y, z."""
    points: Floats
    """(T, 3) [m]: 0 along the other axes."""
    covariance: Floats
    """(T d, T d) [m^2]: point by point, axis by axis."""
    notes: tuple[str, ...] = ()

    @property
    def along(self) -> Ints:
        """(d,) numbers of the measured axes."""
        return np.array([AXES.index(axis) for axis in self.axes])


def holds_coordinates(path: Path) -> bool:
    """Whether a file is one of `read_coordinates`."""
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        head = decoded(stream.read(4096)).lstrip()
    if head.startswith("<"):
        return "<gama-local-adjustment" in head
    header = [cell.strip() for cell in head.partition("\n")[0].split(",")]
    return "target" in header and any(f"{axis}_mm" in header for axis in AXES) and "distance_mm" not in header


def read_coordinates(path: Path) -> Coordinates:
    """The coordinates of a file.

    Raises
    ------
    RecordError
        One sentence: what is wrong, and where.
    """
    if not path.exists():
        raise RecordError("there is no such file", file=path)
    if not holds_coordinates(path):
        known = "adjustment results of gama-local, or a CSV table with columns target, x_mm, y_mm, z_mm"
        raise RecordError(f"is no list of coordinates, expected {known}", file=path)
    with path.open("rb") as stream:
        is_xml = decoded(stream.read(256)).lstrip().startswith("<")
    found = _from_gama(path) if is_xml else _from_table(path)
    if len(set(found.names)) < len(found.names):
        twice = next(name for name in found.names if found.names.count(name) > 1)
        raise RecordError(f"holds the point '{shown(twice)}' twice", file=path)
    sigma = np.sqrt(np.maximum(np.diag(found.covariance), 0.0))
    if not sigma.all():
        at = divmod(int(np.argmin(sigma)), len(found.axes))
        what = f"{shown(found.names[at[0]])}.{found.axes[at[1]]}"
        raise RecordError(f"states no variance of {what}; leave out what is held fixed", file=path)
    if np.linalg.eigvalsh(found.covariance / np.outer(sigma, sigma))[0] < DEFINITE * len(sigma):
        raise RecordError(
            "has a covariance that is negative in some direction: some of its entries are wrong", file=path
        )
    return found


def _from_gama(path: Path) -> Coordinates:
    """Adjusted points and the upper band of their covariance [mm^2]."""
    root = parse(path)
    inside = {tag(element): element for element in root.iter()}
    if "adjusted" not in inside or "cov-mat" not in inside:
        raise RecordError("holds no <adjusted> points with their <cov-mat>", file=path)
    rows = [{tag(cell): (cell.text or "").strip() for cell in point} for point in inside["adjusted"]]
    places = [{key.lower(): text for key, text in row.items() if key.lower() in AXES} for row in rows]
    axes = "".join(axis for axis in AXES if places and axis in places[0])
    if not axes or any("".join(a for a in AXES if a in place) != axes for place in places):
        raise RecordError("holds points with other coordinates than the first has; give those of one kind", file=path)
    points = np.zeros((len(places), 3))
    for point, place in zip(points, places, strict=True):
        for axis in axes:
            point[AXES.index(axis)] = number(place[axis], file=path, column=f"<{axis}>")
    band = {tag(cell): (cell.text or "").strip() for cell in inside["cov-mat"]}
    size, width = (int(number(band.get(key, ""), file=path, column=f"<{key}>")) for key in ("dim", "band"))
    values = [number(cell.text or "", file=path, column="<flt>") for cell in inside["cov-mat"] if tag(cell) == "flt"]
    used = len(rows) * len(axes)
    if size < used or len(values) != sum(min(width + 1, size - i) for i in range(size)):
        raise RecordError(f"has a <cov-mat> of another size than its {used} coordinates ask for", file=path)
    matrix, at = np.zeros((size, size)), 0
    for i in range(size):
        last = min(i + width + 1, size)
        matrix[i, i:last] = matrix[i:last, i] = values[at : at + last - i]
        at += last - i
    title = " ".join((inside["description"].text or "").split()) if "description" in inside else ""
    names = tuple(check_name(row.get("id", ""), "target", file=path) for row in rows)
    return Coordinates(title or path.name, names, axes, points, matrix[:used, :used] * MILLIMETRE**2)


def _from_table(path: Path) -> Coordinates:
    header, rows = _table(path)
    axes = "".join(axis for axis in AXES if f"{axis}_mm" in header)
    names = tuple(check_name(cells["target"], "target", file=path, row=line) for line, cells in rows)
    points = np.zeros((len(rows), 3))
    for point, (line, cells) in zip(points, rows, strict=True):
        for axis in axes:
            column = f"{axis}_mm"
            point[AXES.index(axis)] = number(cells[column], file=path, row=line, column=column) * MILLIMETRE
    beside = path.with_suffix(".covariance.csv")
    if beside.is_file():
        covariance = _matrix(beside, [f"{name}.{axis}" for name in names for axis in axes])
        return Coordinates(path.stem, names, axes, points, covariance * MILLIMETRE**2)
    stated = [f"sigma_{axis}_mm" for axis in axes]
    missing = [column for column in stated if column not in header]
    if missing:
        raise RecordError(f"states no precision: neither {beside.name} nor the column {missing[0]} is there", file=path)
    sigma = [number(cells[column], file=path, row=line, column=column) for line, cells in rows for column in stated]
    note = (
        f"{path.name} states no covariance between points ({beside.name}): what all have in common counts as their own"
    )
    return Coordinates(path.stem, names, axes, points, np.diag(np.square(sigma)) * MILLIMETRE**2, (note,))


def _table(path: Path) -> tuple[list[str], list[tuple[int, dict[str, str]]]]:
    """Header and rows, each with its line, of a table with at least one row."""
    header, rows = table_rows(path)
    if not rows:
        raise RecordError("holds a header only", file=path)
    return header, rows


def _matrix(path: Path, wanted: Sequence[str]) -> Floats:
    """The entries of a covariance, its coordinates by name in any order."""
    header, rows = _table(path)
    first, *names = header
    missing = [name for name in wanted if name not in names]
    if missing or [cells[first] for _, cells in rows] != names:
        what = f"the coordinate {shown(missing[0])}" if missing else "rows in the order of its columns"
        raise RecordError(f"lacks {what}", file=path)
    matrix = np.array([[number(cells[n], file=path, row=line, column=n) for n in names] for line, cells in rows])
    size = np.sqrt(np.abs(np.diag(matrix)))
    if np.abs(matrix - matrix.T).max() > SYMMETRIC * float(np.outer(size, size).max()):
        raise RecordError("is not symmetric", file=path)
    at = [names.index(name) for name in wanted]
    return 0.5 * (matrix + matrix.T)[np.ix_(at, at)]
