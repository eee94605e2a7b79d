"""From rows of text to pointings as printed: blocks, free text, two faces in one row, further columns."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal

from ltsim.errors import RecordError
from ltsim.recording.conventions import Hints
from ltsim.recording.files import check_text, shown
from ltsim.recording.tables import cells
from ltsim.recording.tables.dialect import Row, Sheet
from ltsim.recording.tables.header import (
    DISTANCE,
    HORIZONTAL,
    ROLE_OF,
    VERTICAL,
    Column,
    assignments,
    columns_of,
    is_header,
    mapped,
    words_of,
)

READINGS = (HORIZONTAL, VERTICAL, DISTANCE)
_STATION = re.compile(r"#?\s*([^\W\d_]+)\s*[:=;,\t ]\s*(\S.*?)[\s;,]*")


@dataclass(frozen=True)
class Printed:
    """One pointing as its row prints it: angles and distance in the units of their columns, None where empty."""

    file: object
    line: int
    station: str
    target: str
    face: int | None
    horizontal: Decimal | None
    vertical: Decimal | None
    distance: Decimal | None
    moment: str = ""
    repeat: str = ""
    further: dict[str, str] = field(default_factory=dict)


@dataclass
class Table:
    """All pointings of a file or folder, the columns they came from, and what was left out."""

    columns: list[Column]
    pointings: list[Printed] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    nameless: bool = False
    notes: list[str] = field(default_factory=list)

    def column(self, kind: Sequence[str]) -> Column | None:
        """The first column of one of the roles."""
        return next((c for c in self.columns if c.role in kind), None)


def table_of(sheets: Sequence[Sheet], hints: Hints, file: object) -> Table:
    """The pointings of all sheets.

    Raises
    ------
    RecordError
        Where a header does not say what its columns hold, headers differ in what they hold, or a cell is wrong.
    """
    whole: Table | None = None
    for sheet in sheets:
        start = _header_at(sheet, hints)
        if start is None:
            if len(sheets) > 1 and not _looks_measured(sheet):
                continue
            raise RecordError(_unnamed(sheet), file=sheet.file)
        one = _SheetReader(sheet, hints, several=len(sheets) > 1).read(start)
        if whole is None:
            whole = one
        elif [(c.role, c.unit) for c in one.columns if c.role] != [(c.role, c.unit) for c in whole.columns if c.role]:
            message = "its columns differ from those of the files or sheets before, expected the same roles and units"
            raise RecordError(message, file=sheet.file)
        else:
            whole.pointings += one.pointings
            whole.left_out += one.left_out
            whole.nameless |= one.nameless
    if whole is None or not whole.pointings:
        raise RecordError("holds no pointings", file=file)
    return whole


def header_of(row: Row, hints: Hints, file: object = None) -> list[Column] | None:
    """The columns that a row names as a header; None where it is none."""
    if hints.columns is not None:
        return mapped(row.fields, hints.columns, file) if any(row.fields) else None
    columns = columns_of(row.fields)
    return columns if is_header(columns) and not any(cells.is_value(f) for f in row.fields) else None


def _header_at(sheet: Sheet, hints: Hints) -> int | None:
    """Place of the first header; -1 where `hints.columns` counts the columns of a table without one."""
    if hints.columns is not None:
        asked = assignments(hints.columns, sheet.file)
        if all(title.isdigit() for *_, title, _ in asked):
            first = next((i for i, row in enumerate(sheet.rows) if not row.comment), 0)
            return first if not any(map(cells.is_value, sheet.rows[first].fields)) else first - 1
    return next((i for i, row in enumerate(sheet.rows) if header_of(row, hints, sheet.file) is not None), None)


def _looks_measured(sheet: Sheet) -> bool:
    return any(sum(map(cells.is_value, row.fields)) > 2 for row in sheet.rows[:50])


class _SheetReader:
    """Reads one sheet row by row: the header that holds, the station that the last block named."""

    def __init__(self, sheet: Sheet, hints: Hints, *, several: bool) -> None:
        self.sheet, self.hints = sheet, hints
        self.station = sheet.name if several else hints.station or ""
        self.table = Table([])
        self.wanted: list[int] = []

    def read(self, start: int) -> Table:
        rows = self.sheet.rows
        for row in rows[: max(start, 0)]:
            self._other(row)
        if start < 0:
            width = len(rows[start + 1].fields)
            numbered = Row(0, tuple(str(i + 1) for i in range(width)))
            self.table.columns = header_of(numbered, self.hints, self.sheet.file) or []
            self.wanted = list(range(width))
        for i, row in enumerate(rows[max(start, 0) :]):
            measured = self._has_values(row)
            again = header_of(row, self.hints, self.sheet.file) if not measured else None
            if again is not None:
                self.table.columns = again
                self.wanted = [c.place for c in again if any(c.role in kind for kind in READINGS)]
            elif row.comment or not measured:
                self._other(row)
            else:
                self._pointing(row, last=i + max(start, 0) == len(rows) - 1)
        self.table.notes += _doubled(self.table.columns)
        return self.table

    def _has_values(self, row: Row) -> bool:
        """Whether a cell of the readings, or what stands in its place, is a number."""
        return any(cells.is_value(row.fields[i]) for i in self.wanted if i < len(row.fields))

    def _other(self, row: Row) -> None:
        """A line that is no pointing: it names the station of a block, or is left out."""
        text = " ".join(field for field in row.fields if field)
        found = _STATION.fullmatch(text)
        if found is not None and ROLE_OF.get(words_of(found.group(1))[0]) == "station":
            self.station = found.group(2)
        elif not row.comment:
            self.table.left_out.append(f"line {row.line} of {self.sheet.file.name} ('{shown(text, 30)}')")

    def _pointing(self, row: Row, *, last: bool) -> None:
        columns, file = self.table.columns, self.sheet.file
        if last and self.sheet.open_end:
            if self.hints.growing:
                return  # it may not be whole yet
            self._check_cut(row)
        if len(row.fields) > len(columns) and any(row.fields[len(columns) :]):
            message = f"{len(row.fields)} fields, expected {len(columns)} as in the header"
            raise RecordError(message, file=file, row=row.line)
        cell = {c.place: row.fields[c.place] if c.place < len(row.fields) else "" for c in columns}
        for face in (1, 2) if any(c.face for c in columns) else (0,):
            one = self._one(row, [c for c in columns if c.face in (0, face)], cell, face)
            if face == 0 or any(v is not None for v in (one.horizontal, one.vertical)):
                self.table.pointings.append(one)

    def _check_cut(self, row: Row) -> None:
        """The last line without a line break: whole if it ends as the one before it does."""
        before = next((p for p in reversed(self.sheet.rows[:-1]) if len(p.fields) == len(self.table.columns)), None)
        ends = [len(r.fields[-1].replace(",", ".").partition(".")[2]) for r in (row, before) if r is not None]
        if len(row.fields) != len(self.table.columns) or (len(ends) == 2 and ends[0] < ends[1]):
            raise RecordError("the file ends inside this row: it was cut", file=self.sheet.file, row=row.line)

    def _one(self, row: Row, columns: list[Column], cell: dict[int, str], face: int) -> Printed:
        file = self.sheet.file

        def text(*roles: str) -> str:
            return next((cell[c.place] for c in columns if c.role in roles), "")

        def number(roles: Sequence[str]) -> Decimal | None:
            column = next((c for c in columns if c.role in roles), None)
            if column is None or not cell[column.place]:
                return None
            found = cells.value(cell[column.place])
            if found is None or not abs(found) < 10**9:
                message = f"found '{shown(cell[column.place])}', expected a number"
                raise RecordError(message, file=file, row=row.line, column=shown(column.title))
            return found

        station, target = text("station") or self.station, text("target")
        self.table.nameless |= not station
        return Printed(
            file,
            row.line,
            station or "S1",
            target,
            face or _face(text("face"), row, file),
            number(HORIZONTAL),
            number(VERTICAL),
            number(DISTANCE),
            moment=" ".join(filter(None, (text("date"), text("time")))),
            repeat=text("repeat"),
            further={c.title: check_text(cell[c.place], file=file, row=row.line) for c in columns if _is_further(c)},
        )


def _is_further(column: Column) -> bool:
    return bool(column.title) and (not column.role or "_" in column.role)


def _face(text: str, row: Row, file: object) -> int | None:
    if not text:
        return None
    found = cells.face(text)
    if found is None:
        raise RecordError(f"found '{shown(text)}', expected 1 or 2", file=file, row=row.line, column="face")
    return found


def _doubled(columns: Sequence[Column]) -> list[str]:
    """A word on columns whose header could have been a role that another column has."""
    taken = {c.role: c.title for c in columns if c.role}
    lost = [(c.title, ROLE_OF.get(words_of(c.title)[0], "")) for c in columns if not c.role]
    return [
        f"column '{shown(title)}' is kept as a further one; the {role} is read from '{shown(taken[role])}'"
        for title, role in lost
        if role in taken
    ]


def _unnamed(sheet: Sheet) -> str:
    """The sentence for a header that says nothing, with the option to type."""
    head = next((row for row in sheet.rows if len(row.fields) > 2 and not any(map(cells.is_value, row.fields))), None)
    body = [row.fields for row in sheet.rows if sum(map(cells.is_value, row.fields)) > 1]
    if not body:
        return "holds no row with two numbers or more: nothing that could be a pointing"
    width = max(map(len, body))
    named = head is not None and len(head.fields) == width
    titles = head.fields if head is not None and named else tuple(str(i + 1) for i in range(width))
    guess = ",".join(_guess(titles, [b for b in body if len(b) == width]))
    what = f"the header {shown(', '.join(titles), 80)}" if named else "a table without a header"
    return f'{what} does not say what its columns hold; say it, for instance --columns "{guess}"'


def _guess(titles: Sequence[str], body: Sequence[Sequence[str]]) -> list[str]:
    """Names first, then a face, then three numbers: an angle, a vertical angle, a distance."""
    columns = list(zip(*body[:400], strict=True))
    texts = [i for i, column in enumerate(columns) if not all(map(cells.is_value, column))]
    faces = [i for i, column in enumerate(columns) if i not in texts and all(map(cells.face, column))]
    numbers = [i for i in range(len(columns)) if i not in texts and i not in faces][:3]
    texts.sort(key=lambda i: len(set(columns[i])))
    roles = ("station", "target")[-len(texts) :] if texts else ()
    said = [f"{role}={titles[i]}" for role, i in zip(roles, texts, strict=False)]
    said += [f"face={titles[i]}" for i in faces[:1]]
    largest = {i: max(abs(cells.value(cell) or Decimal(0)) for cell in columns[i]) for i in numbers}
    angle = "rad" if numbers and largest[numbers[0]] < 7 else "deg" if numbers and largest[numbers[0]] <= 360 else "gon"
    lowest = min((cells.value(c) or Decimal(0) for c in columns[numbers[1]]), default=Decimal(0)) if numbers[1:] else 0
    vertical = "elevation" if lowest < 0 else "vertical"
    roles_left = (f"azimuth={{}}[{angle}]", f"{vertical}={{}}[{angle}]", "distance={}[{}]")
    for i, form in zip(numbers, roles_left, strict=False):
        said.append(form.format(titles[i], "m" if largest[i] < 200 else "mm"))
    return said
