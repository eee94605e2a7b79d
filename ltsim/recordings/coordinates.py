"""Readers of lists of points (names with coordinates x, y, z), used by all commands.

`read_points` reads delimited text or a workbook. A header names the columns, with or without units:
``target,x_mm,y_mm,z_mm``, ``Name;X [m];Y [m];Z [m]``, ``Punkt;Rechtswert;Hochwert;Höhe``. Standard deviations are in
columns such as ``sigma_x_mm`` or ``sX``, or in one column ``sigma`` for all axes. A line without header has a name and
three numbers. Three or four standard deviations (x, y, z, length of this vector) and the nine numbers of a covariance
may follow, as SpatialAnalyzer writes them.

`read_coordinates` reads coordinates with the covariance matrix of all points: a list with ``NAME.covariance.csv`` in
its folder (matrix [mm^2] with ``TARGET.x`` in header and first column), or an XML result of gama-local.
"""

import csv
import io
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.core.errors import RecordError
from ltsim.core.limits import require_small_joint_covariance
from ltsim.core.notation import escape_cell_text, names_text, unescape_cell_text
from ltsim.core.units import MILLIMETRE, SI_PER_UNIT
from ltsim.recordings.covariance_file import read_covariance_matrix
from ltsim.recordings.epoch_coordinates import AXIS_NAMES, EpochCoordinates, without_fixed_points
from ltsim.recordings.files import SourceLocation, read_file_beginning, safe_excerpt
from ltsim.recordings.spreadsheets import cells
from ltsim.recordings.spreadsheets.header import (
    COORDINATE_ROLES,
    READING_ROLES,
    SIGMA_ROLES,
    TableColumn,
    count_recognised_titles,
    header_columns,
    title_words_and_unit,
)
from ltsim.recordings.spreadsheets.sheets import SheetRow, TableSheet, read_sheets, rows_of_file_beginning
from ltsim.recordings.spreadsheets.title_words import COMMON_SIGMA_ROLE
from ltsim.recordings.xml import XmlNode, band_matrix_entries, parse_xml

RESULT_TARGETS_FILE = "targets.csv"
MIN_EIGENVALUE_PER_ROW = -1e-9
"""Smallest permitted eigenvalue of a correlation matrix, divided by its number of rows; rounding may make a zero
eigenvalue negative.
"""
MAX_COORDINATE_READ_AS_METRES = 500.0
"""Limit of the largest coordinate of a list without unit: below it the unit is the metre, otherwise the millimetre."""
MIN_NATIONAL_GRID_COORDINATE = 1e6
"""Limit of the largest coordinate of a list without unit: above it the list is in a national grid, in metres."""
NATIONAL_GRID_TITLES = ("rechtswert", "hochwert", "easting", "northing", "east", "north", "e", "n")
"""Column titles, in lower case, of coordinates in a national grid, which without a unit are read in metres."""
HEADERLESS_FIELD_COUNTS = (4, 7, 8, 16, 17)
"""Possible numbers of fields in a line without header: name, x, y, z, then 3 or 4 sigmas, then a covariance."""
POINT_NAME_ROLES = ("target", "station", "", "time", "date")
"""Contents of columns that may name the points of a list; the first that a header contains is used."""
EXPECTED_POINT_LIST_TEXT = (
    "expected a header that names the point and its coordinates, such as target,x_mm,y_mm,z_mm or "
    "Name;X [m];Y [m];Z [m], or lines of a name, x, y and z"
)


@dataclass(frozen=True)
class PointList:
    """Points of a file (n names with coordinates), in the order of the file."""

    names: tuple[str, ...]
    points: Floats
    """Coordinates (n, 3) [m] of the n points; NaN for a missing coordinate."""
    covariance: Floats
    """Covariance matrix (n, 3, 3) [m^2] of the coordinates of each of the n points; NaN if not given."""
    notes: tuple[str, ...] = ()
    additional_columns: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Texts of all columns except names, coordinates and their precision, by column header; one text for each point."""
    line_numbers: tuple[int, ...] = ()
    """Line number in the file of each point."""
    n_contradictory_rows: int = 0
    """Number of ignored rows, which repeat the name of an earlier row with different coordinates."""
    max_repeated_point_distance_m: float = 0.0
    """Largest distance [m] between an ignored row and the first row with its name."""

    @property
    def coordinate_sigmas(self) -> Floats:
        """Standard deviations (n, 3) [m] of the coordinates of the n points; NaN if not given."""
        return np.sqrt(np.einsum("nii->ni", self.covariance))

    @property
    def coordinates_by_name(self) -> dict[str, Floats]:
        """Coordinates x, y, z (3,) [m] by name of the point, without points that lack a coordinate."""
        is_complete = np.asarray(np.isfinite(self.points).all(axis=1))
        return {self.names[i]: self.points[i] for i in np.flatnonzero(is_complete).tolist()}


def read_points(path: str | Path, *, refuses_contradictions: bool = True) -> PointList:
    """Points in a file with their coordinates.

    If the header gives no unit, the size of the numbers decides (metres or millimetres), and a note reports it.

    Parameters
    ----------
    path : str or Path
    refuses_contradictions : bool
        True to refuse a name that occurs again with different coordinates; False to use its first row, with a note.

    Raises
    ------
    RecordError
        File, row, content of the cell, and expected content.
    """
    path = Path(path)
    for sheet in read_sheets(path):
        header = _header_columns(sheet.rows) or _headerless_columns(sheet)
        if header is not None:
            return _PointRowReader(sheet, *header).points(refuses_contradictions=refuses_contradictions)
    raise RecordError(f"the file is not a list of coordinates, {EXPECTED_POINT_LIST_TEXT}", file=path)


def is_point_list(file_beginning: str) -> bool:
    """True if a file that begins with the text `file_beginning` is a list of points, with or without header."""
    first_rows = rows_of_file_beginning(file_beginning)
    header = _header_columns(first_rows)
    data_rows = [row for row in first_rows[0 if header is None else header[0] :] if not row.is_comment]
    if header is not None:
        return not data_rows or data_rows[0].n_numeric_fields > 1
    sample = [_drop_trailing_field(row) for row in data_rows[: max(1, min(6, len(data_rows)) - 1)]]
    return bool(sample) and all(len(r) in HEADERLESS_FIELD_COUNTS and all(map(cells.is_numeric, r[1:])) for r in sample)


def _drop_trailing_field(row: SheetRow) -> Sequence[str]:
    """Fields of a row without an empty last field, which a separator at the end of the line creates."""
    return row.fields[:-1] if row.fields and not row.fields[-1] else row.fields


def _headerless_columns(sheet: TableSheet) -> tuple[int, list[TableColumn]] | None:
    """Number of header rows, 0, and columns of a list of points without header; None for other content."""
    first_row = next((row for row in sheet.rows if not row.is_comment), None)
    if first_row is None or not all(map(cells.is_numeric, _drop_trailing_field(first_row)[1:])):
        return None
    width = len(_drop_trailing_field(first_row))
    if width not in HEADERLESS_FIELD_COUNTS:
        raise SourceLocation(sheet.file, first_row.line).error(f"{width} fields, {EXPECTED_POINT_LIST_TEXT}")
    names = ["target", *COORDINATE_ROLES, *(SIGMA_ROLES[axis] for axis in COORDINATE_ROLES if width > 6)]
    covariance = [f"covariance {i}" for i in range(9 * (width > 15))]
    names += [""] * (width - len(names) - len(covariance)) + covariance
    return 0, [TableColumn(place, name, name) for place, name in enumerate(names)]


def _header_columns(sheet_rows: Sequence[SheetRow]) -> tuple[int, list[TableColumn]] | None:
    """Number of rows before the first point, and columns with contents by the header; None if there is no header."""
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
    """Reader of the points in a sheet from row index `first_row` on; `columns` are the columns with their roles."""

    def __init__(self, sheet: TableSheet, first_row: int, columns: list[TableColumn]) -> None:
        self.sheet, self.rows, self.columns = sheet, sheet.rows[first_row:], columns
        self.width = columns[-1].position + 1
        sigmas = ("sigma", "covariance")
        self.numbers = {c.role: c for c in self.columns if c.role in COORDINATE_ROLES or c.role.startswith(sigmas)}
        self.name = next(c for c in columns if c.role == "target")

    def points(self, *, refuses_contradictions: bool) -> PointList:
        """Points in the sheet, with notes on the assumed unit and on ignored rows; raises RecordError."""
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
                what = f"the point {safe_excerpt(name)} occurs again with different coordinates"
                if refuses_contradictions:
                    raise SourceLocation(self.sheet.file, row.line).error(what)
                notes.append(f"{what} in {self.sheet.file.name}; the first coordinates are used")
                ignored.append((before, values))
        if not places:
            raise RecordError("the file contains no points", file=self.sheet.file)
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
        """Name of the point in one row, and the numbers in the columns of coordinates; NaN for an empty cell."""
        where = SourceLocation(self.sheet.file, row.line)
        if len(_drop_trailing_field(row)) != self.width:
            row.check_width(self.width, self.sheet.file)
        coordinates = []
        for role, column in self.numbers.items():
            text = row.cell(column.position)
            number = cells.parse_number_or_angle(text, self.sheet.thousands_separator)
            if text and (number is None or abs(number) >= 10**11):
                raise where.error(
                    f"found '{safe_excerpt(text)}', expected a number", safe_excerpt(column.title or role)
                )
            if number is not None and number < 0 and (role == COMMON_SIGMA_ROLE or role in SIGMA_ROLES.values()):
                message = f"the standard deviation {safe_excerpt(text)} is negative"
                raise where.error(message, safe_excerpt(column.title or role))
            coordinates.append(np.nan if number is None else float(number))
        return where.checked_name(unescape_cell_text(row.cell(self.name.position)), "point"), coordinates

    def _unit_factors(self, table: Floats) -> tuple[Floats, list[str]]:
        """Factors (k,) that convert k columns of `table` (n points, k) to m or m^2, and notes on the assumed unit."""
        axes = [c for c in self.numbers.values() if c.role in COORDINATE_ROLES]
        largest = np.nanmax(np.abs(table[:, [role in COORDINATE_ROLES for role in self.numbers]]), initial=0.0)
        declared_unit = next((c.unit for c in axes if c.unit in SI_PER_UNIT and c.unit), "")
        is_grid = largest >= MIN_NATIONAL_GRID_COORDINATE or any(
            title_words_and_unit(c.title)[0] in NATIONAL_GRID_TITLES for c in axes
        )
        unit = declared_unit or ("m" if is_grid or largest < MAX_COORDINATE_READ_AS_METRES else "mm")
        notes = [] if declared_unit else [f"coordinates are interpreted as {unit} (the largest is {largest:.6g})"]
        scales = [SI_PER_UNIT[c.unit if c.unit in SI_PER_UNIT and c.unit else unit] for c in self.numbers.values()]
        return np.array(scales) ** [1 + role.startswith("covariance") for role in self.numbers], notes


def _point_covariances(numbers_by_column: Mapping[str, Floats], n_points: int) -> Floats:
    """Covariances (n, 3, 3) [m^2] of n points, from columns (n,) of covariances or else of standard deviations.

    `numbers_by_column` contains the columns by role, such as `sigma_x_mm`. The result is NaN for a point without
    standard deviations.
    """
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


def _target_list_path(path: Path) -> Path:
    """Path of the file `targets.csv` if `path` is a folder of results; otherwise `path` unchanged."""
    return file if (file := path / RESULT_TARGETS_FILE).is_file() and not (path / "observations.csv").exists() else path


def is_coordinate_file(path: Path) -> bool:
    """True for a list of points, an XML result of gama-local, or a folder of results with `targets.csv`."""
    path = _target_list_path(path)
    if not path.is_file():
        return False
    beginning = read_file_beginning(path, 4096).lstrip()
    return "<gama-local-adjustment" in beginning if beginning.startswith("<") else is_point_list(beginning)


def read_coordinates(path: Path, *, allows_fixed: bool = False, requires_sigmas: bool = True) -> EpochCoordinates:
    """Coordinates of one epoch with their covariance matrix, from a file or a folder of results; raises RecordError.

    With `allows_fixed`, coordinates that define the frame may have the variance 0. Otherwise points with such
    coordinates alone are left out, with a note. Unless `requires_sigmas`, the covariance matrix of a list without any
    standard deviation is NaN.
    """
    if not path.exists():
        raise RecordError("there is no such file", file=path)
    folder, path = path, _target_list_path(path)
    is_xml = read_file_beginning(path, 256).lstrip().startswith("<")
    epoch = _coordinates_from_gama(path) if is_xml else _coordinates_from_list(path, requires_sigmas=requires_sigmas)
    if len(set(epoch.names)) < len(epoch.names):
        twice = next(name for name in epoch.names if epoch.names.count(name) > 1)
        raise RecordError(f"the file contains the point '{safe_excerpt(twice)}' twice", file=path)
    if not epoch.has_covariance:
        return epoch
    if not allows_fixed:
        epoch = without_fixed_points(epoch)
    sigma = np.sqrt(np.maximum(np.diag(epoch.covariance), 0.0))
    if allows_fixed:
        sigma[sigma == 0.0] = 1.0
    if not sigma.all():
        position = divmod(int(np.argmin(sigma)), len(epoch.axes))
        what = f"{safe_excerpt(epoch.names[position[0]])}.{epoch.axes[position[1]]}"
        raise RecordError(f"the variance of {what} is 0; leave out coordinates that are held fixed", file=path)
    if np.linalg.eigvalsh(epoch.covariance / np.outer(sigma, sigma))[0] < MIN_EIGENVALUE_PER_ROW * len(sigma):
        raise RecordError("the file contains a covariance matrix that is not positive definite; correct it", file=path)
    return epoch if folder == path else replace(epoch, title=folder.name)


def _coordinates_from_gama(path: Path) -> EpochCoordinates:
    """Adjusted points in an XML result of gama-local, with the covariance matrix from its upper band [mm^2]."""
    elements = {node.tag: node for node in parse_xml(path).descendants("adjusted", "cov-mat", "description")}
    if not {"adjusted", "cov-mat"} <= elements.keys():
        raise RecordError("the file contains no <adjusted> points with their <cov-mat>", file=path)
    entries = [{cell.tag.lower(): cell for cell in point} for point in elements["adjusted"]]
    axis_sets = {"".join(axis for axis in AXIS_NAMES if axis in row) for row in entries}
    if len(axis_sets) != 1 or not (axes := axis_sets.pop()):
        raise RecordError(
            "the file contains points with different axes (xy, xyz); give points with the same axes", file=path
        )
    points = np.zeros((len(entries), 3))
    points[:, [AXIS_NAMES.index(axis) for axis in axes]] = [
        [_parse_number(row[axis]) for axis in axes] for row in entries
    ]
    band = {cell.tag: cell for cell in elements["cov-mat"]}
    size, width = (_parse_number(band[key]) if key in band else -1 for key in ("dim", "band"))
    require_small_joint_covariance(int(size), path)
    row, column, values = band_matrix_entries(
        elements["cov-mat"], size, width, [_parse_number(c) for c in elements["cov-mat"] if c.tag == "flt"]
    )
    if size < (n_used := len(entries) * len(axes)):
        raise RecordError(f"the file contains a <cov-mat> that is smaller than its {n_used} coordinates", file=path)
    matrix = np.zeros((int(size), int(size)))
    matrix[row, column] = matrix[column, row] = values
    title = elements["description"].text if "description" in elements else ""
    names = tuple(SourceLocation(path).checked_name(row["id"].text if "id" in row else "", "target") for row in entries)
    return EpochCoordinates(title or path.name, names, axes, points, matrix[:n_used, :n_used] * MILLIMETRE**2)


def _parse_number(cell: XmlNode) -> float:
    return cell.location.parse_number(cell.text, f"<{cell.tag}>")


def _coordinates_from_list(path: Path, *, requires_sigmas: bool) -> EpochCoordinates:
    """Coordinates in a list of points, with covariances from `NAME.covariance.csv` or from columns of the list.

    Unless `requires_sigmas`, the covariance matrix of a list without any standard deviation is NaN.
    """
    point_list = read_points(path)
    measured = np.isfinite(point_list.points)
    axes = "".join(
        axis for axis, any_ in zip(AXIS_NAMES, np.asarray(measured.any(axis=0)).tolist(), strict=True) if any_
    )
    indices = [AXIS_NAMES.index(axis) for axis in axes]
    if not measured[:, indices].all():
        row, axis = np.argwhere(~measured[:, indices])[0]
        raise SourceLocation(path, point_list.line_numbers[row], axes[axis]).error("found '', expected a number")
    require_small_joint_covariance(len(axes) * len(point_list.names), path)
    points = np.where(measured, point_list.points, 0.0)
    companion = path.with_suffix(".covariance.csv")
    if companion.is_file():
        covariance = (
            read_covariance_matrix(companion, [f"{name}.{axis}" for name in point_list.names for axis in axes])
            * MILLIMETRE**2
        )
        return EpochCoordinates(path.stem, point_list.names, axes, points, covariance, point_list.notes)
    blocks = point_list.covariance[:, indices][:, :, indices]
    has_sigma = np.asarray(np.isfinite(blocks).all(axis=2))
    if not has_sigma.all() and (requires_sigmas or has_sigma.any()):
        raise RecordError(_missing_sigmas_sentence(has_sigma, point_list.names, axes, companion.name), file=path)
    blocks_of_pairs = np.zeros(2 * blocks.shape[:2])
    blocks_of_pairs[range(len(blocks)), :, range(len(blocks))] = blocks
    covariance = blocks_of_pairs.reshape(blocks[:, :, 0].size, -1)
    if not has_sigma.any():
        return EpochCoordinates(path.stem, point_list.names, axes, points, covariance, point_list.notes)
    note = f"{path.name} has no covariance between points ({companion.name}): they are treated as independent"
    return EpochCoordinates(path.stem, point_list.names, axes, points, covariance, (*point_list.notes, note))


def _missing_sigmas_sentence(has_sigma: Bools, names: Sequence[str], axes: str, covariance_file: str) -> str:
    """Sentence on missing standard deviations of n points along d axes; `has_sigma` (n, d) flags existing ones."""
    has_any_sigma = np.asarray(has_sigma.any(axis=0)).tolist()
    missing_axes = [axis for axis, has_any in zip(axes, has_any_sigma, strict=True) if not has_any]
    which = "the coordinates"
    if has_sigma.any():
        incomplete = [safe_excerpt(names[i]) for i in np.flatnonzero(~has_sigma.all(axis=1)).tolist()]
        which += f" along {', '.join(missing_axes)}" if missing_axes else f" of {names_text(incomplete)}"
    first_axis = (*missing_axes, axes[0])[0]
    return f"{which} have no standard deviations; add {covariance_file} or a column sigma_{first_axis}_mm"


def covariance_csv_text(coordinates: Sequence[str], covariance: Floats) -> str:
    """Text of ``NAME.covariance.csv`` [mm^2] from a covariance [m^2]; `coordinates` are names like ``TARGET.x``."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="")
    names = list(map(escape_cell_text, coordinates))
    writer.writerow(["", *names])
    for name, row in zip(names, covariance / MILLIMETRE**2, strict=True):
        stream.write("\n")
        writer.writerow([name])
        stream.write(",%.12g" * len(row) % tuple(row.tolist()))
    return stream.getvalue() + "\n"
