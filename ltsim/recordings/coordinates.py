"""Readers of lists of coordinates (names with x, y, z), which every command uses for such files.

`read_points` takes delimited text of any dialect, or a workbook. A header names the columns and perhaps their units:
``target,x_mm,y_mm,z_mm``, ``Name;X [m];Y [m];Z [m]``, ``Punkt;Rechtswert;Hochwert;Höhe``; standard deviations are in
``sigma_x_mm`` and so on (``sX``), or in one column ``sigma`` for all axes. Without a header a line has a name and three
numbers, after which three or four standard deviations (x, y, z and their length) and the nine numbers of a covariance
may follow, as SpatialAnalyzer writes them.

`read_coordinates` reads one epoch with its full covariance: such a list with ``NAME.covariance.csv`` in the same folder
(the matrix [mm^2], its header and first column the coordinates as ``TARGET.x``), or results of gama-local (XML).
"""

import csv
import io
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import RecordError
from ltsim.core.limits import require_small_joint_covariance
from ltsim.core.results import escape_formula, unescape_formula
from ltsim.core.units import MILLIMETRE, SI_PER_UNIT
from ltsim.recordings.covariance_file import read_covariance_matrix
from ltsim.recordings.files import SourceLocation, quoted_text, read_head
from ltsim.recordings.tables import cells
from ltsim.recordings.tables.header import (
    COORDINATE_ROLES,
    READING_ROLES,
    SIGMA_ROLES,
    TableColumn,
    count_recognised_titles,
    header_columns,
    title_words_and_unit,
)
from ltsim.recordings.tables.sheets import SheetRow, TableSheet, head_rows, read_sheets
from ltsim.recordings.tables.title_words import COMMON_SIGMA_ROLE
from ltsim.recordings.xml import XmlNode, band_matrix_entries, parse_xml

AXIS_NAMES = "xyz"
TARGETS_FILE = "targets.csv"
MIN_EIGENVALUE_PER_ROW = -1e-9
"""Smallest accepted eigenvalue of a correlation matrix, divided by its number of rows: rounding may make 0 negative."""
MAX_COORDINATE_IN_METRES = 500.0
"""Largest coordinate of a list without unit, as a number, below which it is in metres, otherwise in millimetres."""
MIN_NATIONAL_GRID_COORDINATE = 1e6
"""Largest coordinate of a list without unit, as a number, from which the list is in a national grid, in metres."""
GEODETIC_TITLES = ("rechtswert", "hochwert", "easting", "northing", "east", "north", "e", "n")
"""Column titles, in lower case, of coordinates in national grids, which are in metres if the list gives no unit."""
HEADERLESS_FIELD_COUNTS = (4, 7, 8, 16, 17)
"""Numbers of fields in lines without header: name, x, y, z; with 3 or 4 sigmas; with these and a covariance."""
POINT_NAME_ROLES = ("target", "station", "", "time", "date")
"""Possible roles of the column that names the points; the first role that a header contains is used."""
POINT_LIST_CONTENT_TEXT = (
    "expected a header that names the point and its coordinates, such as target,x_mm,y_mm,z_mm or "
    "Name;X [m];Y [m];Z [m], or lines of a name, x, y and z"
)


@dataclass(frozen=True)
class PointList:
    """List of n named points, in the order of its file."""

    names: tuple[str, ...]
    points: Floats
    """Coordinates (n, 3) [m] of the n points; NaN for a coordinate that the list does not give."""
    covariance: Floats
    """Covariance matrix [m^2] of the coordinates of each of the n points, (n, 3, 3); NaN if not given."""
    notes: tuple[str, ...] = ()
    additional_columns: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Texts of each additional column by its header, one text for each point."""
    line_numbers: tuple[int, ...] = ()
    """Line number of each point in the file."""
    n_contradictory_rows: int = 0
    """Number of rows that repeat a name with other coordinates and are ignored."""
    max_contradiction_m: float = 0.0
    """Largest distance [m] between an ignored row and the first row with the same name."""

    @property
    def sigma(self) -> Floats:
        """Standard deviations (n, 3) [m] of the coordinates of the n points; NaN if not given."""
        return np.sqrt(np.einsum("nii->ni", self.covariance))

    @property
    def coordinates_by_name(self) -> dict[str, Floats]:
        """Coordinates x, y, z (3,) [m] by name of the point; points with a missing coordinate are left out."""
        is_whole = np.asarray(np.isfinite(self.points).all(axis=1))
        return {name: p for name, p, whole in zip(self.names, self.points, is_whole.tolist(), strict=True) if whole}


def read_points(path: str | Path, *, refuses_contradictions: bool = True) -> PointList:
    """List of points from a file.

    Without a unit in the header the unit is the metre or the millimetre, by size, and a note reports which.

    Parameters
    ----------
    path : str or Path
    refuses_contradictions : bool
        True to refuse a point that is listed again with other coordinates; False to use its first ones, with a note.

    Raises
    ------
    RecordError
        One sentence: file, row, the content there and the expected content.
    """
    path = Path(path)
    for sheet in read_sheets(path):
        header = _header_columns(sheet.rows) or _headerless_columns(sheet)
        if header is not None:
            return _PointRowReader(sheet, *header).points(refuses_contradictions=refuses_contradictions)
    raise RecordError(f"is not a list of coordinates, {POINT_LIST_CONTENT_TEXT}", file=path)


def recognises(file_beginning: str) -> bool:
    """True if a file that begins with the text `file_beginning` is a list of points, with or without a header."""
    first_rows = head_rows(file_beginning)
    header = _header_columns(first_rows)
    data_rows = [row for row in first_rows[0 if header is None else header[0] :] if not row.is_comment]
    if header is not None:
        return not data_rows or data_rows[0].n_numeric_fields > 1
    sample = [_drop_trailing_field(row) for row in data_rows[: max(1, min(6, len(data_rows)) - 1)]]
    return bool(sample) and all(len(r) in HEADERLESS_FIELD_COUNTS and all(map(cells.is_value, r[1:])) for r in sample)


def _drop_trailing_field(row: SheetRow) -> Sequence[str]:
    """Fields of a row without the empty one after a separator at the end of the line."""
    return row.fields[:-1] if row.fields and not row.fields[-1] else row.fields


def _headerless_columns(sheet: TableSheet) -> tuple[int, list[TableColumn]] | None:
    """Number of rows before the first point (0), and columns of a list without header; None for other content."""
    first_row = next((row for row in sheet.rows if not row.is_comment), None)
    if first_row is None or not all(map(cells.is_value, _drop_trailing_field(first_row)[1:])):
        return None
    width = len(_drop_trailing_field(first_row))
    if width not in HEADERLESS_FIELD_COUNTS:
        raise SourceLocation(sheet.file, first_row.line).error(f"{width} fields, {POINT_LIST_CONTENT_TEXT}")
    names = ["target", *COORDINATE_ROLES, *(SIGMA_ROLES[axis] for axis in COORDINATE_ROLES if width > 6)]
    covariance = [f"covariance {i}" for i in range(9 * (width > 15))]
    names += [""] * (width - len(names) - len(covariance)) + covariance
    return 0, [TableColumn(place, name, name) for place, name in enumerate(names)]


def _header_columns(sheet_rows: Sequence[SheetRow]) -> tuple[int, list[TableColumn]] | None:
    """Number of rows before the first point, and columns that the header names; None if there is no such header."""
    for place, row in enumerate(sheet_rows):
        if not count_recognised_titles(row.fields) or row.n_numeric_fields:
            continue
        columns = header_columns(row.fields)
        roles = {c.role for c in columns}
        if {"x", "y"} <= roles and "z" not in roles:
            columns = [replace(c, role="z") if c.role == "elevation" else c for c in columns]
        others = {*READING_ROLES} - {*COORDINATE_ROLES, "elevation"}
        if not roles & {*COORDINATE_ROLES} or roles & others or {"station", "target"} <= roles:
            continue
        first = next((c for role in POINT_NAME_ROLES for c in columns if c.role == role and c.title), None)
        if first is not None:
            return place + 1, [replace(c, role="target") if c is first else c for c in columns]
    return None


class _PointRowReader:
    """Reader of the points in a sheet from row index `first_row` on; `columns` give the role of each column."""

    def __init__(self, sheet: TableSheet, first_row: int, columns: list[TableColumn]) -> None:
        self.sheet, self.rows, self.columns = sheet, sheet.rows[first_row:], columns
        self.width = columns[-1].position + 1
        sigmas = ("sigma", "covariance")
        self.numbers = {c.role: c for c in self.columns if c.role in COORDINATE_ROLES or c.role.startswith(sigmas)}
        self.name = next(c for c in columns if c.role == "target")

    def points(self, *, refuses_contradictions: bool) -> PointList:
        """List of the points in the sheet, with notes on the assumed unit and on ignored rows; raises RecordError."""
        self.sheet.require_complete_end(self.width)
        places, row_indices, numbers = dict[str, int](), list[int](), array("d")
        n, notes, ignored = len(self.numbers), list[str](), list[tuple[Sequence[float], list[float]]]()
        for index, row in enumerate(self.rows):
            if row.is_comment or not any(row.fields):
                continue
            name, values = self._name_and_numbers(row)
            if (place := places.setdefault(name, len(row_indices))) == len(row_indices):
                row_indices.append(index)
                numbers.extend(values)
            elif not np.array_equal(before := numbers[n * place : n * place + n], values, equal_nan=True):
                what = f"the point {quoted_text(name)} was listed before with other coordinates"
                if refuses_contradictions:
                    raise SourceLocation(self.sheet.file, row.line).error(what)
                notes.append(f"{what} in {self.sheet.file.name}; the first coordinates are used")
                ignored.append((before, values))
        if not places:
            raise RecordError("holds no points", file=self.sheet.file)
        table = np.array(numbers).reshape(len(places), -1)
        scale, decisions = self._unit_factors(table)
        numbers_by_column = dict(zip(self.numbers, (table * scale).T, strict=True))
        points = np.stack([numbers_by_column.get(a, np.full(len(places), np.nan)) for a in COORDINATE_ROLES], axis=1)
        additional = [c for c in self.columns if c.is_additional and c.role not in self.numbers]
        texts = {c.title: tuple(self.rows[i].cell(c.position) for i in row_indices) for c in additional}
        lines = tuple(self.rows[i].line for i in row_indices)
        axes = [role in COORDINATE_ROLES for role in self.numbers]
        gaps_m = np.array([np.subtract(*pair) for pair in ignored]).reshape(-1, len(axes)) * scale
        largest_gap_m = float(np.nanmax(np.linalg.norm(gaps_m[:, axes], axis=1), initial=0.0))
        covariance, sentences = _point_covariances(numbers_by_column, len(places)), (*notes, *decisions)
        return PointList(tuple(places), points, covariance, sentences, texts, lines, len(notes), largest_gap_m)

    def _name_and_numbers(self, row: SheetRow) -> tuple[str, list[float]]:
        """Name of the point in one row, and its numbers; NaN for an empty cell."""
        where = SourceLocation(self.sheet.file, row.line)
        if len(_drop_trailing_field(row)) != self.width:
            row.check_width(self.width, self.sheet.file)
        coordinates = []
        for role, column in self.numbers.items():
            text = row.cell(column.position)
            number = cells.parse_value(text, self.sheet.thousands_separator)
            if text and (number is None or abs(number) >= 10**11):
                raise where.error(f"found '{quoted_text(text)}', expected a number", quoted_text(column.title or role))
            coordinates.append(np.nan if number is None else float(number))
        return where.name(unescape_formula(row.cell(self.name.position)), "point"), coordinates

    def _unit_factors(self, table: Floats) -> tuple[Floats, list[str]]:
        """Factors (k,) from the k columns of `table` (n points, k) to m or m^2, and notes on the assumed unit."""
        axes = [c for c in self.numbers.values() if c.role in COORDINATE_ROLES]
        largest = np.nanmax(np.abs(table[:, [role in COORDINATE_ROLES for role in self.numbers]]), initial=0.0)
        declared_unit = next((c.unit for c in axes if c.unit in SI_PER_UNIT and c.unit), "")
        is_grid = largest >= MIN_NATIONAL_GRID_COORDINATE or any(
            title_words_and_unit(c.title)[0] in GEODETIC_TITLES for c in axes
        )
        unit = declared_unit or ("m" if is_grid or largest < MAX_COORDINATE_IN_METRES else "mm")
        notes = [] if declared_unit else [f"coordinates are interpreted as {unit} (the largest is {largest:.6g})"]
        scales = [SI_PER_UNIT[c.unit if c.unit in SI_PER_UNIT and c.unit else unit] for c in self.numbers.values()]
        return np.array(scales) ** [1 + role.startswith("covariance") for role in self.numbers], notes


def _point_covariances(numbers_by_column: Mapping[str, Floats], n_points: int) -> Floats:
    """Covariance (n, 3, 3) [m^2] of n points, from columns (n,), by role, of full matrices or standard deviations."""
    if "covariance 0" in numbers_by_column:
        full = np.stack([numbers_by_column[f"covariance {i}"] for i in range(9)], axis=1).reshape(n_points, 3, 3)
        return np.asarray((full + full.transpose(0, 2, 1)) / 2)
    sigma = [
        numbers_by_column.get(SIGMA_ROLES[axis], numbers_by_column.get(COMMON_SIGMA_ROLE, np.full(n_points, np.nan)))
        for axis in COORDINATE_ROLES
    ]
    covariance = np.zeros((n_points, 3, 3))
    covariance[:, range(3), range(3)] = np.square(sigma).T
    covariance[~np.isfinite(sigma).any(axis=0)] = np.nan
    return covariance


@dataclass(frozen=True)
class EpochCoordinates:
    """Coordinates of T points of one epoch along the d axes that were measured, with their joint covariance matrix."""

    title: str
    names: tuple[str, ...]
    """Names of the T points."""
    axes: str
    """Measured axes, a selection of `xyz`."""
    points: Floats
    """Coordinates (T, 3) [m] of the T points; 0 along axes that were not measured."""
    covariance: Floats
    """Joint covariance (T d, T d) [m^2] of T points along d axes; rows are ordered by point, then by axis."""
    notes: tuple[str, ...] = ()

    @property
    def axis_indices(self) -> Ints:
        """Indices (d,) of the d measured axes: 0 for x, 1 for y, 2 for z."""
        return np.array([AXIS_NAMES.index(axis) for axis in self.axes])


def _targets_path(path: Path) -> Path:
    """Path of the list of targets if `path` is a folder of results; otherwise `path` itself."""
    return path / TARGETS_FILE if (path / TARGETS_FILE).is_file() and not (path / "observations.csv").exists() else path


def is_coordinate_file(path: Path) -> bool:
    """True for a list of coordinates, a result of gama-local, or a folder of results with coordinates of targets."""
    path = _targets_path(path)
    if not path.is_file():
        return False
    beginning = read_head(path, 4096).lstrip()
    return "<gama-local-adjustment" in beginning if beginning.startswith("<") else recognises(beginning)


def read_coordinates(path: Path) -> EpochCoordinates:
    """Coordinates of one epoch with their covariance, from a file or a folder of results; raises RecordError."""
    if not path.exists():
        raise RecordError("there is no such file", file=path)
    folder, path = path, _targets_path(path)
    is_xml = read_head(path, 256).lstrip().startswith("<")
    epoch = _coordinates_from_gama(path) if is_xml else _coordinates_from_list(path)
    if len(set(epoch.names)) < len(epoch.names):
        twice = next(name for name in epoch.names if epoch.names.count(name) > 1)
        raise RecordError(f"contains the point '{quoted_text(twice)}' twice", file=path)
    sigma = np.sqrt(np.maximum(np.diag(epoch.covariance), 0.0))
    if not sigma.all():
        position = divmod(int(np.argmin(sigma)), len(epoch.axes))
        what = f"{quoted_text(epoch.names[position[0]])}.{epoch.axes[position[1]]}"
        raise RecordError(f"the variance of {what} is 0; leave out coordinates that are held fixed", file=path)
    if np.linalg.eigvalsh(epoch.covariance / np.outer(sigma, sigma))[0] < MIN_EIGENVALUE_PER_ROW * len(sigma):
        raise RecordError("has a covariance matrix that is not positive definite; correct its entries", file=path)
    return epoch if folder == path else replace(epoch, title=folder.name)


def _coordinates_from_gama(path: Path) -> EpochCoordinates:
    """Adjusted points in a result file of gama-local, with their covariance matrix from its upper band [mm^2]."""
    elements = {node.tag: node for node in parse_xml(path).descendants("adjusted", "cov-mat", "description")}
    if not {"adjusted", "cov-mat"} <= elements.keys():
        raise RecordError("contains no <adjusted> points with their <cov-mat>", file=path)
    point_cells = [{cell.tag.lower(): cell for cell in point} for point in elements["adjusted"]]
    axis_sets = {"".join(axis for axis in AXIS_NAMES if axis in row) for row in point_cells}
    if len(axis_sets) != 1 or not (axes := axis_sets.pop()):
        raise RecordError("contains points with different axes (xy, xyz); give points with the same axes", file=path)
    points = np.zeros((len(point_cells), 3))
    points[:, [AXIS_NAMES.index(axis) for axis in axes]] = [
        [_parse_number(row[axis]) for axis in axes] for row in point_cells
    ]
    band = {cell.tag: cell for cell in elements["cov-mat"]}
    size, width = (_parse_number(band[key]) if key in band else -1 for key in ("dim", "band"))
    require_small_joint_covariance(int(size), path)
    row, column, values = band_matrix_entries(
        elements["cov-mat"], size, width, [_parse_number(c) for c in elements["cov-mat"] if c.tag == "flt"]
    )
    if size < (n_used := len(point_cells) * len(axes)):
        raise RecordError(f"has a <cov-mat> whose size does not match its {n_used} coordinates", file=path)
    matrix = np.zeros((int(size), int(size)))
    matrix[row, column] = matrix[column, row] = values
    title = elements["description"].text if "description" in elements else ""
    names = tuple(SourceLocation(path).name(row["id"].text if "id" in row else "", "target") for row in point_cells)
    return EpochCoordinates(title or path.name, names, axes, points, matrix[:n_used, :n_used] * MILLIMETRE**2)


def _parse_number(cell: XmlNode) -> float:
    return cell.location.number(cell.text, f"<{cell.tag}>")


def _coordinates_from_list(path: Path) -> EpochCoordinates:
    """Coordinates from a list, along the axes it contains; covariance from `NAME.covariance.csv` or its columns."""
    listed = read_points(path)
    measured = np.isfinite(listed.points)
    axes = "".join(
        axis for axis, any_ in zip(AXIS_NAMES, np.asarray(measured.any(axis=0)).tolist(), strict=True) if any_
    )
    indices = [AXIS_NAMES.index(axis) for axis in axes]
    if not measured[:, indices].all():
        row, axis = np.argwhere(~measured[:, indices])[0]
        raise SourceLocation(path, listed.line_numbers[row], axes[axis]).error("found '', expected a number")
    require_small_joint_covariance(len(axes) * len(listed.names), path)
    points = np.where(measured, listed.points, 0.0)
    companion = path.with_suffix(".covariance.csv")
    if companion.is_file():
        covariance = (
            read_covariance_matrix(companion, [f"{name}.{axis}" for name in listed.names for axis in axes])
            * MILLIMETRE**2
        )
        return EpochCoordinates(path.stem, listed.names, axes, points, covariance, listed.notes)
    blocks = listed.covariance[:, indices][:, :, indices]
    if not np.isfinite(blocks).all():
        message = f"the coordinates have no standard deviations; add {companion.name} or a column sigma_{axes[0]}_mm"
        raise RecordError(message, file=path)
    blocks_of_pairs = np.zeros(2 * blocks.shape[:2])
    blocks_of_pairs[range(len(blocks)), :, range(len(blocks))] = blocks
    covariance = blocks_of_pairs.reshape(blocks[:, :, 0].size, -1)
    note = f"{path.name} has no covariance between points ({companion.name}): they are treated as independent"
    return EpochCoordinates(path.stem, listed.names, axes, points, covariance, (*listed.notes, note))


def covariance_text(coordinates: Sequence[str], covariance: Floats) -> str:
    """Content of ``NAME.covariance.csv`` [mm^2] from a covariance [m^2] of coordinates with names like ``TARGET.x``."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    names = list(map(escape_formula, coordinates))
    writer.writerow(["", *names])
    for name, row in zip(names, covariance / MILLIMETRE**2, strict=True):
        writer.writerow([name, *(f"{entry:.12g}" for entry in row.tolist())])
    return stream.getvalue()
