"""Pointings from the rows of a table, which may contain several headers, lines that name stations, and free text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from ltsim.core.errors import RecordError
from ltsim.core.limits import MAX_TABLE_HEADERS
from ltsim.recordings.files import SourceLocation, is_number, safe_excerpt
from ltsim.recordings.hints import Hints
from ltsim.recordings.spreadsheets import cells
from ltsim.recordings.spreadsheets.header import (
    READING_ROLES,
    TableColumn,
    count_recognised_titles,
    has_named_coordinates,
    header_columns,
    is_header,
    title_role,
    title_words_and_unit,
)
from ltsim.recordings.spreadsheets.sheets import SheetRow, TableSheet
from ltsim.recordings.spreadsheets.title_units import require_readable_units
from ltsim.recordings.spreadsheets.title_words import SUMMARY_ROW_FIRST_WORDS
from ltsim.recordings.tables.angle_columns import N_ROWS_TESTED_FOR_ANGLE_PARTS, with_untitled_angle_parts
from ltsim.recordings.tables.blocks import StationContext
from ltsim.recordings.tables.column_assignments import mapped_columns, parse_assignments
from ltsim.recordings.tables.column_suggestions import unrecognised_header_sentence
from ltsim.recordings.tables.pointing_table import (
    ROWS_PER_BATCH,
    PointingTable,
    UnconvertedPointings,
    join_pointings,
)
from ltsim.recordings.tables.row_batches import RowBatch, RowBatchReader, pad_cells

POSITIONAL_ROLES = ("station", "target", "azimuth", "vertical", "distance")
"""Contents of the columns, in order, of a table without header."""
MIN_HEADER_TITLES = 2
"""Smallest number of known titles in a header: those of two angles, or of an angle and a distance."""


def read_pointing_table(
    sheets: Sequence[TableSheet], hints: Hints, file: object, *, positional: bool = False
) -> PointingTable:
    """Pointings and columns of all sheets of a file or folder.

    With `positional`, a sheet without header may also have lines with names and three numbers. Raises RecordError for a
    header without known titles, for headers with different roles, and for an invalid cell. Errors name `file`, or the
    file of a sheet.
    """
    joined_table, parts = PointingTable([]), []
    header_indices = [find_header(sheet, hints) for sheet in sheets]
    headers = [_header_at(sheet, start, hints) for sheet, start in zip(sheets, header_indices, strict=True)]
    has_polar = any(header and not has_named_coordinates(header) for header in headers)
    for sheet, start, header in zip(sheets, header_indices, headers, strict=True):
        if has_polar and header and has_named_coordinates(header):
            name = safe_excerpt(sheet.station or sheet.file.name)
            joined_table.notes.append(
                f"the coordinates in '{name}' are not used (to use them, give --frame or --control)"
            )
            continue
        reader = _SheetReader(sheet, hints)
        if start is not None or positional:
            table = reader.read_without_header() if start is None else reader.read(start)
            joined_table.add_sheet(table, sheet.file)
            parts.append(table.pointings)
        elif len(sheets) == 1 or any(row.n_numeric_fields > 2 for row in sheet.rows[:50]):
            raise RecordError(
                unrecognised_header_sentence(sheet, partial(_is_readable_with_columns, sheet, hints)), file=sheet.file
            )
    if not any(map(len, parts)):
        unread = (
            f": {joined_table.unread_lines[0]} has no number in a column of readings"
            if joined_table.unread_lines
            else ""
        )
        raise RecordError(f"the file contains no pointings{unread or ' below its header'}", file=file)
    joined_table.pointings = join_pointings(parts)
    joined_table.columns = [replace(c, unit=joined_table.cell_units.get(c.title, c.unit)) for c in joined_table.columns]
    return joined_table


def parse_header(row: SheetRow, hints: Hints, file: object = None) -> list[TableColumn] | None:
    """Columns with titles from `row`, and contents from title or `hints.columns`; None if the row is not a header."""
    if hints.columns is not None:
        return mapped_columns(row.fields, hints.columns, file) if any(row.fields) else None
    if count_recognised_titles(row.fields) < MIN_HEADER_TITLES or any(map(cells.is_numeric, row.fields)):
        return None
    columns = header_columns(row.fields)
    return columns if is_header(columns, allows_unnamed=hints.station is not None) else None


def _header_at(sheet: TableSheet, row: int | None, hints: Hints) -> list[TableColumn]:
    """Columns of the header in the row with this index; empty for a table without header (None or -1)."""
    return [] if row is None or row < 0 else parse_header(sheet.rows[row], hints, sheet.file) or []


def find_header(sheet: TableSheet, hints: Hints) -> int | None:
    """Index of the first row that is a header; None if there is none.

    If `hints.columns` assigns contents to numbered columns of a table without header, the header counts as the row
    before the first row: the result is the index of the first row minus 1.
    """
    if hints.columns is not None and sheet.rows:
        assignments = parse_assignments(hints.columns, sheet.file)
        if all(title.isdigit() for *_, title, _ in assignments):
            first = next((i for i, row in enumerate(sheet.rows) if not row.is_comment), 0)
            return first if not sheet.rows[first].n_numeric_fields else first - 1
    return next((i for i, row in enumerate(sheet.rows) if parse_header(row, hints, sheet.file) is not None), None)


class _SheetReader:
    """Reader of a sheet; its state is the current header, the current station, and rows that are not yet converted."""

    def __init__(self, sheet: TableSheet, hints: Hints) -> None:
        self.sheet, self.hints = sheet, hints
        self.station_context = StationContext(sheet.station or hints.station or "")
        self.table = PointingTable([])
        self.parts: list[UnconvertedPointings] = []
        self.header: list[TableColumn] = []
        """Columns of the current header."""
        self.columns: list[TableColumn] = []
        """Columns of the current header, and of heights that lines without a pointing give."""
        self.station_position: int | None = None
        """Position of the column of stations; None without such a column."""
        self.n_unnamed = 0
        """Number of rows without a station, which have the station of the row above."""
        self.reading_positions: list[int] = []
        """Positions of the columns with readings."""
        self.n_headers = 0
        self.row_batch = RowBatch()
        """Rows of pointings that are not converted yet."""

    def read(self, header_row: int) -> PointingTable:
        """Pointings in the rows below the header in the row with index `header_row`; -1 for a table without header."""
        sheet_rows = self.sheet.rows
        for row in sheet_rows[: max(header_row, 0)]:
            self._process_line_without_pointing(row)
        if header_row < 0:
            numbered = SheetRow(0, tuple(str(i + 1) for i in range(len(sheet_rows[header_row + 1].fields))))
            self._start_header(parse_header(numbered, self.hints, self.sheet.file) or [], None)
        return self._read_rows(sheet_rows[max(header_row, 0) :])

    def read_without_header(self) -> PointingTable:
        """Pointings in lines with station, target and three numbers, or with target and three numbers."""
        first_row = next((row for row in self.sheet.rows if not row.is_comment), None)
        roles = POSITIONAL_ROLES[1:] if first_row is not None and len(first_row.fields) == 4 else POSITIONAL_ROLES
        for row in self.sheet.rows:
            if not row.is_comment and len(row.fields) != len(roles):
                message = f"{len(row.fields)} fields, expected station, target, two angles and a distance"
                raise SourceLocation(self.sheet.file, row.line).error(message)
        self.table.is_positional = True
        self._start_header([TableColumn(i, role, role) for i, role in enumerate(roles)], None)
        return self._read_rows(self.sheet.rows, reads_all=True)

    def _start_header(self, columns: list[TableColumn], row: int | None) -> None:
        """Replacement of the current header by one with these `columns`, found in `row`; raises RecordError."""
        self.n_headers += 1
        if self.n_headers > MAX_TABLE_HEADERS:
            raise SourceLocation(self.sheet.file, row).error(
                f"the file holds more than {MAX_TABLE_HEADERS} headers, the limit for reading"
            )
        if self.hints.columns is None:
            require_readable_units(columns, SourceLocation(self.sheet.file, row))
        self.header = columns
        columns = [*columns, *self.station_context.missing_height_columns(columns)]
        if columns != self.columns:
            self._convert_rows()
        self.table.add_header(columns, self.sheet.file, row)
        self.columns = columns
        self.reading_positions = [c.position for c in columns if c.role in READING_ROLES]
        self.station_position = next((c.position for c in columns if c.role == "station"), None)

    def _read_rows(self, sheet_rows: Sequence[SheetRow], *, reads_all: bool = False) -> PointingTable:
        """Pointings in `sheet_rows`; with `reads_all` every row that is not a comment is taken as a pointing."""
        last_index = len(sheet_rows) - 1
        for i, row in enumerate(sheet_rows):
            measured = (reads_all and not row.is_comment) or self._is_measured(row)
            again = parse_header(row, self.hints, self.sheet.file) if not measured else None
            if again is not None:
                below = sheet_rows[i + 1 : i + 1 + N_ROWS_TESTED_FOR_ANGLE_PARTS]
                self._start_header(again if self.hints.columns else with_untitled_angle_parts(again, below), row.line)
            elif row.is_comment or not measured:
                self._process_line_without_pointing(row)
            elif i < last_index or not self.sheet.has_incomplete_end:
                self._add_pointing(row)
            elif not self.hints.is_growing:  # otherwise it may not be whole yet
                self._convert_rows()
                self.sheet.require_complete_end(len(self.header), requires_line_break=self.table.is_positional)
                self._add_pointing(row)
        self._convert_rows()
        self.table.notes += _duplicate_role_warnings(self.columns)
        if self.n_unnamed:
            self.table.notes.append(
                f"{self.n_unnamed} rows without a station are assigned to the station of the row above"
            )
        self.table.pointings = join_pointings(self.parts) if self.parts else UnconvertedPointings()
        return self.table

    def _is_measured(self, row: SheetRow) -> bool:
        """True if a row contains a pointing: a column of readings has a value, and the row is not a sum or mean."""
        fields = row.fields
        if self._is_summary(fields) or self._has_missing_fields(row):
            return False
        for place in self.reading_positions:
            if place < len(fields) and (is_number(fields[place]) or cells.is_numeric(fields[place])):
                return True
        return False

    def _has_missing_fields(self, row: SheetRow) -> bool:
        """True if a row has fewer fields than the header, and blanks between fields do not show which are empty."""
        return len(row.fields) < len(self.header) and self.sheet.has_blanks_between_fields

    def _is_summary(self, fields: Sequence[str]) -> bool:
        """True if a row begins with a word for a sum or mean, and lacks the target or a reading."""
        first_text = next(filter(None, fields), "")
        if first_text.rstrip(" :=").casefold() not in SUMMARY_ROW_FIRST_WORDS.split():
            return False
        needed = [*self.reading_positions, *(c.position for c in self.columns if c.role == "target")]
        return any(place >= len(fields) or not fields[place] for place in needed)

    def _process_line_without_pointing(self, row: SheetRow) -> None:
        """Update of station and heights by a line that is not a pointing; a line without them is reported as unused."""
        n_heights = len(self.station_context.height_columns)
        if self.station_context.read_line(row):
            if self.header and len(self.station_context.height_columns) > n_heights:
                self._start_header(self.header, row.line)
        elif self._has_missing_fields(row) and row.n_numeric_fields > 1:
            raise self._field_count_error(row)
        elif not row.is_comment:
            self.table.unread_lines.append(f"line {row.line} of {self.sheet.file.name} ('{row}')")

    def _add_pointing(self, row: SheetRow) -> None:
        """Addition of a row of a pointing to the rows that are converted later."""
        if len(self.row_batch.line) == ROWS_PER_BATCH:
            self._convert_rows()
        width = len(self.header)
        if any(row.fields[width:]):
            raise self._field_count_error(row)
        if len(self.columns) > width:
            heights = [self.station_context.heights.get(c.role, "") for c in self.columns[width:]]
            row = row._replace(fields=(*pad_cells(row.fields, width), *heights))
        if self.station_position is not None:
            station = row.fields[self.station_position] if self.station_position < len(row.fields) else ""
            self.n_unnamed += not station and bool(self.station_context.station)
            self.station_context.station = station or self.station_context.station
        self.row_batch.add_row(row, self.station_context.station)

    def _field_count_error(self, row: SheetRow) -> RecordError:
        """Error on a row with more or fewer fields than the header, after conversion of the rows above."""
        self._convert_rows()
        message = f"{len(row.fields)} fields, expected {len(self.header)} as in the header"
        if self.sheet.has_blanks_between_fields:
            message += "; titles and cells with blanks need another separator, such as ;"
        return SourceLocation(self.sheet.file, row.line).error(message)

    def _convert_rows(self) -> None:
        """Conversion, together, of all rows that are not yet converted to columns of pointings.

        If this fails, rows are converted one by one, to report the first error.
        """
        row_batch, self.row_batch = self.row_batch, RowBatch()
        if not row_batch.line:
            return
        reader = RowBatchReader(self.sheet, self.columns)
        try:
            converted = [reader.read(row_batch)]
        except RecordError:
            converted = [reader.read(row) for row in row_batch.single_rows()]
        self.table.lacks_station_names |= reader.lacks_station_names
        self.table.add_cell_units(reader.cell_units, self.sheet.file)
        self.parts.append(join_pointings(converted))
        while (
            len(self.parts) > 1
            and 2 * len(self.parts[-1]) > len(self.parts[-2])
            and len(self.parts[-2]) < ROWS_PER_BATCH
        ):
            self.parts[-2:] = [join_pointings(self.parts[-2:])]


def _duplicate_role_warnings(columns: Sequence[TableColumn]) -> list[str]:
    """Notes on columns that become additional columns because an earlier column already has their content."""
    title_by_role = {c.role: c.title for c in columns if c.role}
    unused_columns = [(c.title, title_role(title_words_and_unit(c.title)[0])) for c in columns if not c.role]
    return [
        f"column '{safe_excerpt(title)}' is read as an additional column, because the {role} is in "
        f"'{safe_excerpt(title_by_role[role])}'"
        for title, role in unused_columns
        if role in title_by_role
    ]


def _is_readable_with_columns(sheet: TableSheet, hints: Hints, columns: str) -> bool:
    """True if a sheet can be read with this value of the option ``--columns``."""
    hints = replace(hints, columns=columns)
    try:
        start = find_header(sheet, hints)
        return start is not None and len(_SheetReader(sheet, hints).read(start).pointings) > 0
    except RecordError:
        return False
