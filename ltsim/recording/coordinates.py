"""Lists of coordinates: the one reader of names with x, y, z, wherever a file of them is asked for.

`read_points` takes delimited text of any dialect, or a workbook. A header names the columns and perhaps their units:
``target,x_mm,y_mm,z_mm``, ``Name;X [m];Y [m];Z [m]``, ``Punkt;Rechtswert;Hochwert;Höhe``; standard deviations stand in
``sigma_x_mm`` and so on (``sX``), or in one column ``sigma`` for all axes. Without a header a line is a name and three
numbers, which three or four standard deviations (x, y, z and their length) and the nine numbers of a covariance may
follow, as SpatialAnalyzer writes them.

`read_coordinates` reads one epoch with its full covariance: such a list with ``NAME.covariance.csv`` beside it (the
matrix [mm^2], its header and first column the coordinates as ``TARGET.x``), or adjustment results of gama-local (XML).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from ltsim.arrays import Floats, Ints
from ltsim.errors import RecordError
from ltsim.recording.files import check_name, decoded, number, shown
from ltsim.recording.formats.xml import parse, tag
from ltsim.recording.tables import cells
from ltsim.recording.tables.header import PLACE, READINGS, SIGMA_OF, Column, columns_of, words_of
from ltsim.recording.tables.sheets import Row, Sheet, check_whole, check_width, separator_of, sheets_of, split
from ltsim.units import FACTOR, MILLIMETRE

AXES = "xyz"
SYMMETRIC = 1e-6
"""Share by which entries across the diagonal may differ by rounding."""
DEFINITE = -1e-9
"""Smallest eigenvalue of correlations that rounding explains."""
LARGEST_M = 500.0
"""The largest coordinate of a list that states no unit and is taken for metres."""
GRID = 1e6
"""Numbers as large as these are coordinates of a national grid, in metres."""
GEODETIC = ("rechtswert", "hochwert", "easting", "northing", "east", "north", "e", "n")
"""Words of surveyors' lists, which are in metres where they state no unit."""
WIDTHS = (4, 7, 8, 16, 17)
SIGMA_OF_ALL = ("sigma", "stddev", "std", "sigmamm", "sigmaxyz")
EXPECTED = (
    "expected a header that names the point and its coordinates, such as target,x_mm,y_mm,z_mm or "
    "Name;X [m];Y [m];Z [m], or lines of a name, x, y and z"
)
Unit = Literal["mm", "m"]


@dataclass(frozen=True)
class Points:
    """A list of n named points, in the order of its file."""

    names: tuple[str, ...]
    points: Floats
    """(n, 3) [m]; NaN where the list leaves a coordinate out."""
    covariance: Floats
    """(n, 3, 3) [m^2]; NaN where none is stated."""
    notes: tuple[str, ...] = ()
    further: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """(n,) texts of each further column by its header."""
    lines: tuple[int, ...] = ()
    """(n,) line of the file that each stands in."""

    @property
    def sigma(self) -> Floats:
        """Standard deviations (n, 3) [m]; NaN where none is stated."""
        return np.sqrt(np.einsum("nii->ni", self.covariance))

    @property
    def by_name(self) -> dict[str, Floats]:
        """Coordinates (3,) [m] of the points that have all three."""
        whole = np.asarray(np.isfinite(self.points).all(axis=1))
        return {name: p for name, p, is_whole in zip(self.names, self.points, whole.tolist(), strict=True) if is_whole}


def read_points(path: str | Path, unit: Unit | None = None, *, strict: bool = True) -> Points:
    """Read a list of points.

    Parameters
    ----------
    path : str or Path
    unit : "mm" or "m", optional
        Of coordinates whose header states none; without it metres where none reaches 500, otherwise millimetres, which
        a note says.
    strict : bool
        Refuse a point that is listed twice with other coordinates; otherwise the first are taken, and a note says so.

    Returns
    -------
    Points

    Raises
    ------
    RecordError
        One sentence: file, row, what was found and what is expected.
    """
    path = Path(path)
    for sheet in sheets_of(path):
        found = _header_of(sheet.rows)
        if found is not None:
            place, columns = found
            return _assembled(sheet, columns, sheet.rows[place + 1 :], unit, strict)
        columns = _without_header(sheet)
        if columns:
            return _assembled(sheet, columns, sheet.rows, unit, strict)
    raise RecordError(f"is no list of coordinates, {EXPECTED}", file=path)


def recognises(head: str) -> bool:
    """Whether the first lines of a file are those of a list of points without a header, or its header."""
    lines = [line for line in head.splitlines() if line.strip()]
    separator = separator_of(lines)
    rows = [Row(i + 1, split(line.lstrip("# "), separator), line.startswith("#")) for i, line in enumerate(lines[:60])]
    found = _header_of(rows)
    if found is not None:
        below = next((row for row in rows[found[0] + 1 :] if not row.comment), None)
        return below is None or sum(map(cells.is_value, below.fields)) > 1
    return _is_positional([r.fields for r in rows if not r.comment][:6])


def _is_positional(rows: Sequence[Sequence[str]]) -> bool:
    whole = rows[: max(1, len(rows) - 1)]
    return bool(whole) and all(len(r) in WIDTHS and all(map(cells.is_value, r[1:])) for r in map(_filled, whole))


def _filled(fields: Sequence[str]) -> Sequence[str]:
    """Fields without the empty one that a separator at the end of the line makes."""
    return fields[:-1] if fields and not fields[-1] else fields


def _without_header(sheet: Sheet) -> list[Column]:
    """Columns of lines of a name and numbers; none where the first ones are something else."""
    body = [_filled(row.fields) for row in sheet.rows if not row.comment]
    if not body or not all(map(cells.is_value, body[0][1:])):
        return []
    if len(body[0]) not in WIDTHS:
        first = next(row for row in sheet.rows if not row.comment)
        raise RecordError(f"{len(body[0])} fields, {EXPECTED}", file=sheet.file, row=first.line)
    names = ["target", *PLACE, *(SIGMA_OF[a] for a in PLACE[: 3 * (len(body[0]) > 6)])]
    names += [f"covariance {i}" for i in range(9)] if len(body[0]) > 15 else []
    at = [*range(7)[: len(names)], *range(len(body[0]) - 9, len(body[0]))][: len(names)]
    named = dict(zip(at, names, strict=True))
    return [Column(place, named.get(place, ""), named.get(place, "")) for place in range(len(body[0]))]


def _header_of(rows: Sequence[Row]) -> tuple[int, list[Column]] | None:
    """The first row that names coordinates, its place and its columns."""
    for place, row in enumerate(rows):
        if any(map(cells.is_value, row.fields)):
            continue
        columns = columns_of(row.fields)
        roles = {c.role for c in columns}
        if {"x", "y"} <= roles and "z" not in roles and "elevation" in roles:
            columns = [replace(c, role="z") if c.role == "elevation" else c for c in columns]
        if not roles & {*PLACE} or roles & ({*READINGS} - {*PLACE, "elevation"}) or {"station", "target"} <= roles:
            continue
        if "target" not in roles:
            other = "station" if "station" in roles else ""
            first = next((c for c in columns if c.role == other and c.title), None)
            if first is None:
                continue
            columns = [replace(c, role="target") if c is first else c for c in columns]
        return place, columns
    return None


def _assembled(sheet: Sheet, columns: list[Column], rows: Sequence[Row], unit: Unit | None, strict: bool) -> Points:
    """The points of a sheet's rows by its columns."""
    column = {c.role: c for c in columns if c.role}
    width = max(c.place for c in columns) + 1
    check_whole(sheet, width)
    kept: dict[str, tuple[Row, list[float]]] = {}
    notes = []
    wanted = [role for role in column if role in PLACE or role.startswith(("sigma_", "covariance"))]
    overall = next((c for c in columns if not c.role and words_of(c.title)[0] in SIGMA_OF_ALL), None)
    for row in rows:
        if row.comment or not any(row.fields):
            continue
        if len(_filled(row.fields)) != width:
            check_width(row, width, sheet.file)
        name, values = _values(row, column, wanted, overall, sheet)
        if name in kept and not np.array_equal(kept[name][1], values, equal_nan=True):
            what = f"the point {shown(name)} was listed before with other coordinates"
            if strict:
                raise RecordError(what, file=sheet.file, row=row.line)
            notes.append(f"{what} in {sheet.file.name}: the first are taken")
        kept.setdefault(name, (row, values))
    if not kept:
        raise RecordError("holds no points", file=sheet.file)
    table = np.array([values for _, values in kept.values()])
    scale, said = _scales(column, [*wanted, *([overall] if overall else [])], table, unit)
    numbers = dict(zip([*wanted, *(["sigma"] if overall else [])], (table * scale).T, strict=True))
    nothing = np.full(len(kept), np.nan)
    points = np.stack([numbers.get(axis, nothing) for axis in PLACE], axis=1)
    further = [c for c in columns if c.is_further and c.role not in wanted and c is not overall]
    texts = {c.title: tuple(_cell(row, c) for row, _ in kept.values()) for c in further}
    lines = tuple(row.line for row, _ in kept.values())
    return Points(tuple(kept), points, _covariance(numbers, len(kept)), (*notes, *said), texts, lines)


def _values(
    row: Row, column: Mapping[str, Column], wanted: Sequence[str], overall: Column | None, sheet: Sheet
) -> tuple[str, list[float]]:
    """Name and numbers of one row; NaN where a cell is empty."""
    name = check_name(_cell(row, column["target"]), "point", file=sheet.file, row=row.line)
    values = []
    for one in [*(column[role] for role in wanted), *([overall] if overall else [])]:
        text = _cell(row, one)
        found = cells.value(text, sheet.grouping) if text else None
        if (text and found is None) or (found is not None and not abs(found) < 10**11):
            what = f"found '{shown(text)}', expected a number"
            raise RecordError(what, file=sheet.file, row=row.line, column=shown(one.title))
        values.append(float("nan") if found is None else float(found))
    return name, values


def _cell(row: Row, column: Column) -> str:
    return row.fields[column.place] if column.place < len(row.fields) else ""


def _scales(
    column: Mapping[str, Column], wanted: Sequence[str | Column], table: Floats, unit: Unit | None
) -> tuple[Floats, list[str]]:
    """What brings each number to metres, and what was decided."""
    of = [column[role] if isinstance(role, str) else role for role in wanted]
    axes = [c for c in of if c.role in PLACE]
    largest = np.nanmax(np.abs(table[:, [c.role in PLACE for c in of]]), initial=0.0)
    stated = next((c.unit for c in axes if c.unit in FACTOR and c.unit), "")
    surveyed = largest >= GRID or any(words_of(c.title)[0] in GEODETIC for c in axes)
    chosen = stated or unit or ("m" if surveyed or largest < LARGEST_M else "mm")
    notes = [] if stated or unit else [f"coordinates taken as {chosen}: the largest is {largest:.6g}"]
    scales = [FACTOR[c.unit if c.unit in FACTOR and c.unit else chosen] for c in of]
    power = [2.0 if c.role.startswith("covariance") else 1.0 for c in of]
    return np.array(scales) ** power, notes


def _covariance(numbers: Mapping[str, Floats], count: int) -> Floats:
    """The covariance (n, 3, 3) [m^2] that a list states: in full, by axis, or one for all."""
    if "covariance 0" in numbers:
        full = np.stack([numbers[f"covariance {i}"] for i in range(9)], axis=1).reshape(count, 3, 3)
        return np.asarray((full + full.transpose(0, 2, 1)) / 2)
    sigma = [numbers.get(SIGMA_OF[axis], numbers.get("sigma", np.full(count, np.nan))) for axis in PLACE]
    found = np.zeros((count, 3, 3))
    found[:, range(3), range(3)] = np.square(sigma).T
    found[~np.isfinite(sigma).any(axis=0)] = np.nan
    return found


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
    return "<gama-local-adjustment" in head if head.startswith("<") else recognises(head)


def read_coordinates(path: Path) -> Coordinates:
    """The coordinates of one epoch with their covariance.

    Raises
    ------
    RecordError
        One sentence: what is wrong, and where.
    """
    if not path.exists():
        raise RecordError("there is no such file", file=path)
    with path.open("rb") as stream:
        is_xml = decoded(stream.read(256)).lstrip().startswith("<")
    found = _from_gama(path) if is_xml else _from_list(path)
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


def _from_list(path: Path) -> Coordinates:
    """A list of points along the axes that it has, with the covariance beside it or its own."""
    found = read_points(path)
    measured = np.isfinite(found.points)
    axes = "".join(axis for axis, any_ in zip(AXES, np.asarray(measured.any(axis=0)).tolist(), strict=True) if any_)
    at = [AXES.index(axis) for axis in axes]
    if not measured[:, at].all():
        row, axis = np.argwhere(~measured[:, at])[0]
        raise RecordError("found '', expected a number", file=path, row=found.lines[row], column=axes[axis])
    points = np.where(measured, found.points, 0.0)
    beside = path.with_suffix(".covariance.csv")
    if beside.is_file():
        covariance = _matrix(beside, [f"{name}.{axis}" for name in found.names for axis in axes]) * MILLIMETRE**2
        return Coordinates(path.stem, found.names, axes, points, covariance, found.notes)
    blocks = found.covariance[:, at][:, :, at]
    if not np.isfinite(blocks).all():
        what = f"states no precision: neither {beside.name} nor the column sigma_{axes[0]}_mm is there"
        raise RecordError(what, file=path)
    covariance = np.zeros((blocks.shape[0] * len(at),) * 2)
    for i, block in enumerate(blocks):
        covariance[i * len(at) : (i + 1) * len(at), i * len(at) : (i + 1) * len(at)] = block
    common = f"{path.name} states no covariance between points ({beside.name})"
    note = f"{common}: what all have in common counts as their own"
    return Coordinates(path.stem, found.names, axes, points, covariance, (*found.notes, note))


def _matrix(path: Path, wanted: Sequence[str]) -> Floats:
    """The entries of a covariance, its coordinates by name in any order."""
    sheet = sheets_of(path)[0]
    (first, *body) = [row for row in sheet.rows if not row.comment]
    names = first.fields[1:]
    missing = [name for name in wanted if name not in names]
    if missing or [row.fields[0] for row in body] != list(names):
        what = f"the coordinate {shown(missing[0])}" if missing else "rows in the order of its columns"
        raise RecordError(f"lacks {what}", file=path)
    if any(len(row.fields) != len(first.fields) for row in body):
        raise RecordError("holds rows of another length than its header", file=path)
    matrix = np.array([[number(text, file=path, row=row.line) for text in row.fields[1:]] for row in body])
    size = np.sqrt(np.abs(np.diag(matrix)))
    if np.abs(matrix - matrix.T).max() > SYMMETRIC * float(np.outer(size, size).max()):
        raise RecordError("is not symmetric", file=path)
    at = [names.index(name) for name in wanted]
    return 0.5 * (matrix + matrix.T)[np.ix_(at, at)]
