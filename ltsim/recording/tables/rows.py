"""From rows of text to pointings as printed: blocks, free text, two faces in one row, further columns."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from functools import partial

from ltsim.errors import RecordError
from ltsim.recording.conventions import Hints
from ltsim.recording.files import MAX_TEXT, FilePlace, shown
from ltsim.recording.tables import cells
from ltsim.recording.tables.advice import unnamed
from ltsim.recording.tables.header import (
    DISTANCE,
    HORIZONTAL,
    PLACE,
    READINGS,
    VERTICAL,
    TableColumn,
    assignments,
    columns_of,
    is_header,
    mapped,
    role_of,
    words_of,
)
from ltsim.recording.tables.sheets import Row, Sheet

POSITIONS = ("station", "target", "azimuth", "vertical", "distance")
"""Roles of a table without a header whose lines are names and three numbers."""
_STATION = re.compile(r"#?\s*([^\W\d_]+)\s*[:=;,\t ]\s*(\S.*?)[\s;,]*")


@dataclass(frozen=True, slots=True)
class Printed:
    """One pointing as its row prints it: numbers by role in the units of their columns, those that are not empty."""

    where: FilePlace
    station: str
    target: str
    face: int | None
    values: dict[str, Decimal]
    moment: str = ""
    further: dict[str, str] = field(default_factory=dict)
    grouping: str = ""
    round: str = ""
    """Which round of its station it belongs to: a number, perhaps with a day."""


@dataclass
class PointingTable:
    """All pointings of a file or folder, the columns they came from, and what was left out."""

    columns: list[TableColumn]
    pointings: list[Printed] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    nameless: bool = False
    positional: bool = False
    marks: dict[str, str] = field(default_factory=dict)
    """Name of the mark under each set-up whose own name differs from it."""
    notes: list[str] = field(default_factory=list)
    marked: set[str] = field(default_factory=set)
    """Headers without a unit over angles with marks of degrees and minutes."""

    def column(self, kind: Sequence[str]) -> TableColumn | None:
        """The first column of one of the roles."""
        return next((c for c in self.columns if c.role in kind), None)

    @property
    def holds_places(self) -> bool:
        """Whether it holds coordinates in place of readings."""
        return {*PLACE} <= {c.role for c in self.columns}

    def take(self, columns: Sequence[TableColumn], file: object, row: int | None = None) -> None:
        """A further header: of the same roles and units, perhaps with more columns that are kept.

        Raises RecordError where it holds other readings, or in other units.
        """
        said = [[(c.role, c.unit, c.face) for c in all_ if c.role in READINGS] for all_ in (self.columns, columns)]
        if said[0] and said[0] != said[1]:
            message = "its columns differ from those of the headers before, expected the same roles and units"
            raise FilePlace(file, row).wrong(message)
        titles = {c.title for c in self.columns}
        self.columns += [c for c in columns if c.title not in titles]

    def add(self, other: PointingTable, file: object) -> None:
        """The pointings of a further sheet; raises RecordError."""
        self.take(other.columns, file)
        self.pointings += other.pointings
        self.left_out += other.left_out
        self.notes += [note for note in other.notes if note not in self.notes]
        self.nameless |= other.nameless
        self.marked |= other.marked
        self.positional |= other.positional


def table_of(sheets: Sequence[Sheet], hints: Hints, file: object, *, positional: bool = False) -> PointingTable:
    """The pointings of all sheets; `positional` takes lines of names and three numbers without a header.

    Raises RecordError where a header does not say what its columns hold, headers differ in what they hold, or a cell is
    wrong.
    """
    whole = PointingTable([])
    for sheet in sheets:
        start = header_at(sheet, hints)
        reader = _SheetReader(sheet, hints)
        if start is not None:
            whole.add(reader.read(start), sheet.file)
        elif positional:
            whole.add(reader.read_positional(), sheet.file)
        elif len(sheets) == 1 or any(row.values > 2 for row in sheet.rows[:50]):
            raise RecordError(unnamed(sheet, partial(_serves, sheet, hints)), file=sheet.file)
    if not whole.pointings:
        raise RecordError("holds no pointings", file=file)
    whole.columns = [replace(c, unit="deg") if c.title in whole.marked else c for c in whole.columns]
    return whole


def header_of(row: Row, hints: Hints, file: object = None) -> list[TableColumn] | None:
    """The columns that a row names as a header; None where it is none."""
    if hints.columns is not None:
        return mapped(row.fields, hints.columns, file) if any(row.fields) else None
    if any(map(cells.is_value, row.fields)):
        return None
    columns = columns_of(row.fields)
    return columns if is_header(columns) else None


def header_at(sheet: Sheet, hints: Hints) -> int | None:
    """Place of the first header; -1 where `hints.columns` counts the columns of a table without one."""
    if hints.columns is not None and sheet.rows:
        asked = assignments(hints.columns, sheet.file)
        if all(title.isdigit() for *_, title, _ in asked):
            first = next((i for i, row in enumerate(sheet.rows) if not row.comment), 0)
            return first if not sheet.rows[first].values else first - 1
    return next((i for i, row in enumerate(sheet.rows) if header_of(row, hints, sheet.file) is not None), None)


class _SheetReader:
    """Reads one sheet row by row: the header that holds, the station that the last block named."""

    def __init__(self, sheet: Sheet, hints: Hints) -> None:
        self.sheet, self.hints = sheet, hints
        self.station = sheet.station or hints.station or ""
        self.table = PointingTable([])
        self.columns: list[TableColumn] = []
        self.wanted: list[int] = []

    def read(self, start: int) -> PointingTable:
        """The rows below the header in row `start`; -1 counts columns."""
        rows = self.sheet.rows
        for row in rows[: max(start, 0)]:
            self._other(row)
        if start < 0:
            numbered = Row(0, tuple(str(i + 1) for i in range(len(rows[start + 1].fields))))
            self._head(header_of(numbered, self.hints, self.sheet.file) or [], None)
        return self._read(rows[max(start, 0) :])

    def read_positional(self) -> PointingTable:
        """Lines of station, target and three numbers; of the target alone where they are shorter by one."""
        body = [row for row in self.sheet.rows if not row.comment]
        roles = POSITIONS[1:] if body and len(body[0].fields) == 4 else POSITIONS
        for row in body:
            if len(row.fields) != len(roles):
                message = f"{len(row.fields)} fields, expected station, target, two angles and a distance"
                raise FilePlace(self.sheet.file, row.line).wrong(message)
        self.table.positional = True
        self._head([TableColumn(i, role, role) for i, role in enumerate(roles)], None)
        return self._read(self.sheet.rows, every=True)

    def _head(self, columns: list[TableColumn], row: int | None) -> None:
        self.table.take(columns, self.sheet.file, row)
        self.columns = columns
        self.wanted = [c.place for c in columns if c.role in READINGS]

    def _read(self, rows: Sequence[Row], *, every: bool = False) -> PointingTable:
        for i, row in enumerate(rows):
            measured = (every and not row.comment) or any(cells.is_value(row.cell(place)) for place in self.wanted)
            again = header_of(row, self.hints, self.sheet.file) if not measured else None
            if again is not None:
                self._head(again, row.line)
            elif row.comment or not measured:
                self._other(row)
            else:
                self._pointing(row, last=i == len(rows) - 1)
        self.table.notes += _doubled(self.columns)
        return self.table

    def _other(self, row: Row) -> None:
        """A line that is no pointing: it names the station of a block, or is left out."""
        line = " ".join(field for field in row.fields if field).rstrip(" \t;,")
        found = _STATION.fullmatch(line) if len(line) <= MAX_TEXT else None
        if found is not None and role_of(found.group(1)) == "station":
            self.station = found.group(2)
        elif not row.comment:
            self.table.left_out.append(f"line {row.line} of {self.sheet.file.name} ('{row}')")

    def _pointing(self, row: Row, *, last: bool) -> None:
        columns, where = self.columns, FilePlace(self.sheet.file, row.line)
        if last and self.sheet.open_end:
            if self.hints.growing:
                return  # it may not be whole yet
            self.sheet.check_whole(len(columns), strict=self.table.positional)
        if any(row.fields[len(columns) :]):
            raise where.wrong(f"{len(row.fields)} fields, expected {len(columns)} as in the header")
        for face in (1, 2) if any(c.face for c in columns) else (0,):
            one = self._one(row, [c for c in columns if c.face in (0, face)], face, where)
            if face == 0 or any(role in one.values for role in (*HORIZONTAL, *VERTICAL)):
                self.table.pointings.append(one)

    def _one(self, row: Row, columns: list[TableColumn], face: int, where: FilePlace) -> Printed:
        text = {c.role: row.cell(c.place) for c in reversed(columns) if c.role}

        def both(*roles: str) -> str:
            return " ".join(filter(None, (text.get(role) for role in roles)))

        station, told = text.get("station") or self.station, text.get("face", "")
        self.table.nameless |= not station
        stated = cells.face(told) if told else None
        if told and stated is None:
            raise where.wrong(f"found '{shown(told)}', expected 1 or 2", "face")
        read = [(c, cell) for c in columns if c.role in READINGS and (cell := c.text(row))]
        self.table.marked |= {c.title for c, cell in read if not c.unit and cells.is_marked(cell)}
        return Printed(
            where,
            station or "S1",
            text.get("target", ""),
            face or stated,
            {c.role: self._number(cell, c, where) for c, cell in read},
            moment=both("date", "time"),
            further={c.title: where.text(row.cell(c.place)) for c in columns if c.is_further},
            grouping=self.sheet.grouping,
            round=both("date", "round"),
        )

    def _number(self, text: str, column: TableColumn, where: FilePlace) -> Decimal:
        packed = column.unit == "dms"
        found = cells.packed(text) if packed else cells.value(text, self.sheet.grouping)
        if packed and found is None:
            what = "degrees, minutes and seconds, such as 33°12'07.5\" or 33.12075"
            raise where.wrong(f"found '{shown(text)}', expected {what}", shown(column.title))
        if found is None or not abs(found) < 10**9:
            raise where.wrong(f"found '{shown(text)}', expected a number", shown(column.title))
        if column.role in DISTANCE and not found > 0:
            what = f"found {shown(text)}, expected a distance above 0, or nothing where none was measured"
            raise where.wrong(what, shown(column.title))
        return found


def _doubled(columns: Sequence[TableColumn]) -> list[str]:
    """A word on columns whose header could have been a role that another column has."""
    taken = {c.role: c.title for c in columns if c.role}
    lost = [(c.title, role_of(words_of(c.title)[0])) for c in columns if not c.role]
    return [
        f"column '{shown(title)}' is kept as a further one; the {role} is read from '{shown(taken[role])}'"
        for title, role in lost
        if role in taken
    ]


def _serves(sheet: Sheet, hints: Hints, columns: str) -> bool:
    """Whether a sheet can be read by an assignment of columns."""
    hints = replace(hints, columns=columns)
    try:
        start = header_at(sheet, hints)
        return start is not None and bool(_SheetReader(sheet, hints).read(start).pointings)
    except RecordError:
        return False
