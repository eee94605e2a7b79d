"""Pointings from rows of text: headers, blocks of a station, free text; runs of rows become columns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from sys import intern

import numpy as np

from ltsim.core.errors import RecordError
from ltsim.core.limits import MAX_TABLE_HEADERS
from ltsim.recordings.conventions import Hints
from ltsim.recordings.files import MAX_TEXT_LENGTH, SourceLocation, is_number, quoted_text
from ltsim.recordings.tables import cells
from ltsim.recordings.tables.advice import unrecognised_header_sentence
from ltsim.recordings.tables.blocks import TableBlock
from ltsim.recordings.tables.header import (
    DISTANCE_ROLES,
    HORIZONTAL_ROLES,
    READING_ROLES,
    ROLE_UNITS,
    VERTICAL_ROLES,
    TableColumn,
    count_role_titles,
    header_columns,
    is_header,
    mapped_columns,
    parse_assignments,
    title_role,
    title_words_and_unit,
)
from ltsim.recordings.tables.printed import (
    ROWS_PER_BATCH,
    Digits,
    PointingTable,
    PrintedPointings,
    join_pointings,
    to_digits,
)
from ltsim.recordings.tables.sheets import SheetRow, TableSheet

MAX_READING_MAGNITUDE = 10**9
"""Magnitude below which all readings must be, in any unit."""


@dataclass
class HeaderRun:
    """Rows below one header, by column: line numbers, cells, and the station of the block for rows that name none."""

    line: list[int] = field(default_factory=list)
    fields: list[tuple[str, ...]] = field(default_factory=list)
    station: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.line)

    def add_row(self, row: SheetRow, station: str) -> None:
        """Addition of a row."""
        self.line.append(row.line)
        self.fields.append(row.fields)
        self.station.append(station)

    def single_rows(self) -> Iterator[HeaderRun]:
        """Runs with one row each."""
        for line, fields, station in zip(self.line, self.fields, self.station, strict=True):
            yield HeaderRun([line], [fields], [station])


class RunReader:
    """Reader of the rows below one header of a sheet. `nameless` and `cell_units` are those of `PointingTable`."""

    def __init__(self, sheet: TableSheet, columns: Sequence[TableColumn]) -> None:
        self.sheet, self.columns = sheet, columns
        self.faces = (1, 2) if any(c.face for c in columns) else (0,)
        self.nameless = False
        self.cell_units: dict[str, str] = {}

    def read(self, run: HeaderRun) -> PrintedPointings:
        """Pointings of rows; a row that names no station has the station of its block.

        Raises RecordError for a wrong cell: the first one in a run of one row, any one in a longer run.
        """
        width = len(self.columns)
        padded = [fields if len(fields) == width else _pad_cells(fields, width) for fields in run.fields]
        table = list(zip(*padded, strict=True))
        if self.faces == (0,):
            return self._pointings_of_face(0, run, table)
        pointings = join_pointings([self._pointings_of_face(face, run, table) for face in self.faces])
        angles = pointings.digits_of_roles((*HORIZONTAL_ROLES, *VERTICAL_ROLES)) != b""
        by_row = np.arange(2 * len(run)).reshape(2, -1).T.ravel()
        return pointings.take(by_row[angles[by_row]].tolist())

    def _pointings_of_face(self, face: int, run: HeaderRun, table: Sequence[Sequence[str]]) -> PrintedPointings:
        """Pointings, one per row, from the columns of one face (0: the only face) and the common columns."""
        columns = [c for c in self.columns if c.face in (0, face)]
        text = {c.role: table[c.position] for c in reversed(columns) if c.role}
        nothing = ("",) * len(run)
        stations = [name or block for name, block in zip(text.get("station", nothing), run.station, strict=True)]
        self.nameless |= "" in stations
        faces = self._faces(text["face"], run.line) if "face" in text else [0] * len(run)
        numbers: dict[str, Digits] = {}
        for c in columns:
            if c.role in READING_ROLES:
                digits = self._numbers(c.texts(table), c, run.line)
                filled = digits != b""
                if filled.any():
                    before = numbers.get(c.role)
                    numbers[c.role] = digits if before is None else np.where(filled, digits, before)
        further = {c.title: self._texts(table[c.position], run.line) for c in columns if c.is_additional}
        return PrintedPointings(
            [self.sheet.file] * len(run),
            run.line,
            [intern(name or "S1") for name in stations],
            list(map(intern, text.get("target", nothing))),
            [face] * len(run) if face else faces,
            _joined_cells(text.get("date"), text.get("time")) or [*nothing],
            _joined_cells(text.get("date"), text.get("round")) or [*nothing],
            [self.sheet.thousands_separator] * len(run),
            numbers,
            further,
        )

    def _faces(self, texts: Sequence[str], lines: Sequence[int]) -> list[int]:
        """Faces in the file; 0 for an empty cell."""
        faces = {text: cells.parse_face(text) if text else 0 for text in {*texts}}
        for text, line in zip(texts, lines, strict=True) if None in faces.values() else ():
            if faces[text] is None:
                raise self._place(line).error(f"found '{quoted_text(text)}', expected 1 or 2", "face")
        return [faces[text] or 0 for text in texts]

    def _numbers(self, texts: Sequence[str], column: TableColumn, lines: Sequence[int]) -> Digits:
        """Digits (n,) of a column of readings: the cells if all are plain numbers, otherwise each cell converted."""
        values = cells.plain_numbers(texts) if column.unit != "dms" and not self.sheet.thousands_separator else None
        lower_bound = 0.0 if column.role in DISTANCE_ROLES else -np.inf
        if values is not None and not np.any((np.abs(values) >= MAX_READING_MAGNITUDE) | (values <= lower_bound)):
            return to_digits(texts)
        numbers, unit = cells.split_common_unit(texts)
        if unit in ROLE_UNITS[column.role] and column.unit in ("", unit):
            texts = numbers
        elif not column.unit and any(map(cells.is_sexagesimal, texts)):
            unit = "deg"
        else:
            unit = ""
        if unit and self.cell_units.setdefault(column.title, unit) != unit:
            what = f"found '{quoted_text(texts[0])}' in {unit}, expected one unit in all cells"
            raise self._place(lines[0]).error(what, quoted_text(column.title))
        return to_digits(
            [self._number(text, column, line) if text else "" for text, line in zip(texts, lines, strict=True)]
        )

    def _number(self, text: str, column: TableColumn, line: int) -> str:
        """Digits of the number in one cell."""
        packed = column.unit == "dms"
        number = cells.parse_packed_degrees(text) if packed else cells.parse_value(text, self.sheet.thousands_separator)
        location = self._place(line)
        if packed and number is None:
            what = "degrees, minutes and seconds, such as 33°12'07.5\" or 33.12075"
            raise location.error(f"found '{quoted_text(text)}', expected {what}", quoted_text(column.title))
        if number is None or not abs(number) < MAX_READING_MAGNITUDE:
            raise location.error(f"found '{quoted_text(text)}', expected a number", quoted_text(column.title))
        if column.role in DISTANCE_ROLES and not number > 0:
            what = f"found {quoted_text(text)}, expected a distance above 0, or an empty cell without one"
            raise location.error(what, quoted_text(column.title))
        return str(number)

    def _texts(self, texts: Sequence[str], lines: Sequence[int]) -> list[str]:
        """Cells of an additional column; equal texts are stored once."""
        distinct = dict.fromkeys(texts)
        joined_text = "".join(distinct)
        if (
            not joined_text.isprintable()
            or "<" in joined_text
            or ">" in joined_text
            or max(map(len, distinct)) > MAX_TEXT_LENGTH
        ):
            for text, line in zip(texts, lines, strict=True):
                self._place(line).text(text)
        return list(map(intern, texts)) if 2 * len(distinct) < len(texts) else list(texts)

    def _place(self, line: int) -> SourceLocation:
        return SourceLocation(self.sheet.file, line)


def _pad_cells(fields: Sequence[str], width: int) -> Sequence[str]:
    """Cells of a row, extended with empty ones to the width of the header."""
    return (*fields[:width], *[""] * (width - len(fields)))


def _joined_cells(first: Sequence[str] | None, second: Sequence[str] | None) -> list[str] | None:
    """Cells of two columns joined by a blank; None if the table has neither column."""
    if first is None or second is None:
        return list(first or second or ()) or None
    return [" ".join(filter(None, pair)) for pair in zip(first, second, strict=True)]


POSITIONAL_ROLES = ("station", "target", "azimuth", "vertical", "distance")
"""Roles of the columns in a table without header whose lines are names and three numbers."""
MIN_TITLES = 2
"""Smallest number of columns in a header of readings: two angles, or an angle and a distance."""


def read_pointing_table(
    sheets: Sequence[TableSheet], hints: Hints, file: object, *, positional: bool = False
) -> PointingTable:
    """Pointings of all sheets; with `positional`, also lines with names and three numbers but no header.

    Raises RecordError for a header without recognised titles, for headers with different roles, and for a wrong cell.
    """
    whole, parts = PointingTable([]), []
    for sheet in sheets:
        start = find_header(sheet, hints)
        reader = _SheetReader(sheet, hints)
        if start is not None or positional:
            table = reader.read_positional() if start is None else reader.read(start)
            whole.add_sheet(table, sheet.file)
            parts.append(table.pointings)
        elif len(sheets) == 1 or any(row.n_values > 2 for row in sheet.rows[:50]):
            raise RecordError(unrecognised_header_sentence(sheet, partial(_is_readable, sheet, hints)), file=sheet.file)
    if not any(map(len, parts)):
        unread = f": {whole.unread[0]} has no number in a column of readings" if whole.unread else ""
        raise RecordError(f"contains no pointings{unread or ' below its header'}", file=file)
    whole.pointings = join_pointings(parts)
    whole.columns = [replace(c, unit=whole.cell_units.get(c.title, c.unit)) for c in whole.columns]
    return whole


def parse_header(row: SheetRow, hints: Hints, file: object = None) -> list[TableColumn] | None:
    """Columns that a row names as a header; None if it is no header."""
    if hints.columns is not None:
        return mapped_columns(row.fields, hints.columns, file) if any(row.fields) else None
    if count_role_titles(row.fields) < MIN_TITLES or any(map(cells.is_value, row.fields)):
        return None
    columns = header_columns(row.fields)
    return columns if is_header(columns) else None


def find_header(sheet: TableSheet, hints: Hints) -> int | None:
    """Index of the first header row; -1 if `hints.columns` numbers the columns of a table without header."""
    if hints.columns is not None and sheet.rows:
        asked = parse_assignments(hints.columns, sheet.file)
        if all(title.isdigit() for *_, title, _ in asked):
            first = next((i for i, row in enumerate(sheet.rows) if not row.is_comment), 0)
            return first if not sheet.rows[first].n_values else first - 1
    return next((i for i, row in enumerate(sheet.rows) if parse_header(row, hints, sheet.file) is not None), None)


class _SheetReader:
    """Reader of one sheet.

    Its state is the current header, the current block, and the rows since the header.
    """

    def __init__(self, sheet: TableSheet, hints: Hints) -> None:
        self.sheet, self.hints = sheet, hints
        self.block = TableBlock(sheet.station or hints.station or "")
        self.table = PointingTable([])
        self.parts: list[PrintedPointings] = []
        self.header: list[TableColumn] = []
        """Columns of the current header."""
        self.columns: list[TableColumn] = []
        """Columns of the current header, and of the heights of the block."""
        self.wanted: list[int] = []
        self.headers = 0
        self.run = HeaderRun()
        """Rows of pointings that are not converted yet."""

    def read(self, header_row: int) -> PointingTable:
        """Pointings of the rows below the header in row `header_row`; -1 for numbered columns."""
        rows = self.sheet.rows
        for row in rows[: max(header_row, 0)]:
            self._process_other_line(row)
        if header_row < 0:
            numbered = SheetRow(0, tuple(str(i + 1) for i in range(len(rows[header_row + 1].fields))))
            self._start_header(parse_header(numbered, self.hints, self.sheet.file) or [], None)
        return self._read_rows(rows[max(header_row, 0) :])

    def read_positional(self) -> PointingTable:
        """Pointings of lines with station, target and three numbers; lines shorter by one have no station."""
        first = next((row for row in self.sheet.rows if not row.is_comment), None)
        roles = POSITIONAL_ROLES[1:] if first is not None and len(first.fields) == 4 else POSITIONAL_ROLES
        for row in self.sheet.rows:
            if not row.is_comment and len(row.fields) != len(roles):
                message = f"{len(row.fields)} fields, expected station, target, two angles and a distance"
                raise SourceLocation(self.sheet.file, row.line).error(message)
        self.table.positional = True
        self._start_header([TableColumn(i, role, role) for i, role in enumerate(roles)], None)
        return self._read_rows(self.sheet.rows, reads_all=True)

    def _start_header(self, columns: list[TableColumn], row: int | None) -> None:
        self.headers += 1
        if self.headers > MAX_TABLE_HEADERS:
            raise SourceLocation(self.sheet.file, row).error(
                f"holds more than {MAX_TABLE_HEADERS} headers, the limit for reading"
            )
        self.header = columns
        columns = [*columns, *self.block.height_columns_after(columns)]
        if columns != self.columns:
            self._convert_rows()
        self.table.add_header(columns, self.sheet.file, row)
        self.columns = columns
        self.wanted = [c.position for c in columns if c.role in READING_ROLES]

    def _read_rows(self, rows: Sequence[SheetRow], *, reads_all: bool = False) -> PointingTable:
        last_index = len(rows) - 1
        for i, row in enumerate(rows):
            measured = (reads_all and not row.is_comment) or self._is_measured(row)
            again = parse_header(row, self.hints, self.sheet.file) if not measured else None
            if again is not None:
                self._start_header(again, row.line)
            elif row.is_comment or not measured:
                self._process_other_line(row)
            elif i < last_index or not self.sheet.has_incomplete_end:
                self._add_pointing(row)
            elif not self.hints.incomplete_tail:  # otherwise it may not be whole yet
                self._convert_rows()
                self.sheet.require_complete_end(len(self.header), requires_all=self.table.positional)
                self._add_pointing(row)
        self._convert_rows()
        self.table.notes += _duplicate_role_warnings(self.columns)
        self.table.pointings = join_pointings(self.parts) if self.parts else PrintedPointings()
        return self.table

    def _is_measured(self, row: SheetRow) -> bool:
        """True if a cell of a reading has a value; in a pointing it is usually the first."""
        fields = row.fields
        for place in self.wanted:
            if place < len(fields) and (is_number(fields[place]) or cells.is_value(fields[place])):
                return True
        return False

    def _process_other_line(self, row: SheetRow) -> None:
        """Processing of a line that is no pointing: it describes a block, or is ignored."""
        n_heights = len(self.block.height_columns)
        if self.block.read_line(row):
            if self.header and len(self.block.height_columns) > n_heights:
                self._start_header(self.header, row.line)
        elif not row.is_comment:
            self.table.unread.append(f"line {row.line} of {self.sheet.file.name} ('{row}')")

    def _add_pointing(self, row: SheetRow) -> None:
        if len(self.run.line) == ROWS_PER_BATCH:
            self._convert_rows()
        width = len(self.header)
        if len(row.fields) > width and any(row.fields[width:]):
            self._convert_rows()
            message = f"{len(row.fields)} fields, expected {width} as in the header"
            raise SourceLocation(self.sheet.file, row.line).error(message)
        if len(self.columns) > width:
            heights = [self.block.heights.get(c.role, "") for c in self.columns[width:]]
            row = row._replace(fields=(*_pad_cells(row.fields, width), *heights))
        self.run.add_row(row, self.block.station)

    def _convert_rows(self) -> None:
        """Conversion of the rows since the last header to columns at once.

        If that fails, row by row to report the first error.
        """
        run, self.run = self.run, HeaderRun()
        if not run.line:
            return
        reader = RunReader(self.sheet, self.columns)
        try:
            converted = [reader.read(run)]
        except RecordError:
            converted = [reader.read(row) for row in run.single_rows()]
        self.table.nameless |= reader.nameless
        self.table.add_cell_units(reader.cell_units, self.sheet.file)
        self.parts.append(join_pointings(converted))
        while (
            len(self.parts) > 1
            and 2 * len(self.parts[-1]) > len(self.parts[-2])
            and len(self.parts[-2]) < ROWS_PER_BATCH
        ):
            self.parts[-2:] = [join_pointings(self.parts[-2:])]


def _duplicate_role_warnings(columns: Sequence[TableColumn]) -> list[str]:
    """Warnings about columns whose role is already taken by another column."""
    taken = {c.role: c.title for c in columns if c.role}
    unused_columns = [(c.title, title_role(title_words_and_unit(c.title)[0])) for c in columns if not c.role]
    return [
        f"column '{quoted_text(title)}' is a further column, because the {role} is read from "
        f"'{quoted_text(taken[role])}'"
        for title, role in unused_columns
        if role in taken
    ]


def _is_readable(sheet: TableSheet, hints: Hints, columns: str) -> bool:
    """True if a sheet can be read with an assignment of columns."""
    hints = replace(hints, columns=columns)
    try:
        start = find_header(sheet, hints)
        return start is not None and len(_SheetReader(sheet, hints).read(start).pointings) > 0
    except RecordError:
        return False
