"""Rows below one header, converted to columns of pointings at once: faces, numbers, further columns."""

from collections.abc import Sequence
from sys import intern

import numpy as np

from ltsim.recordings.files import MAX_TEXT, FilePlace, shown
from ltsim.recordings.tables import cells
from ltsim.recordings.tables.header import DISTANCE, HORIZONTAL, READINGS, VERTICAL, TableColumn
from ltsim.recordings.tables.printed import Digits, Printed, as_digits, as_floats, joined
from ltsim.recordings.tables.sheets import Row, Sheet

LARGEST = 10**9
"""Numbers of readings lie below it in size, in whatever unit."""


class RunReader:
    """Reads rows below one header of a sheet. `nameless` and `marked` are those of `PointingTable`."""

    def __init__(self, sheet: Sheet, columns: Sequence[TableColumn]) -> None:
        self.sheet, self.columns = sheet, columns
        self.faces = (1, 2) if any(c.face for c in columns) else (0,)
        self.nameless = False
        self.marked: set[str] = set()

    def read(self, run: Sequence[tuple[Row, str]]) -> Printed:
        """Pointings of rows, each with the station of its block where its row names none.

        Raises RecordError for a cell that is wrong: of one row for the first of its cells, of several for any of them.
        """
        rows, width = [row for row, _ in run], len(self.columns)
        padded = [row.fields if len(row.fields) == width else _padded(row.fields, width) for row in rows]
        table = list(zip(*padded, strict=True))
        stations = [station for _, station in run]
        if self.faces == (0,):
            return self._of_face(0, rows, table, stations)
        both = joined([self._of_face(face, rows, table, stations) for face in self.faces])
        angles = both.of((*HORIZONTAL, *VERTICAL)) != b""
        by_row = np.arange(2 * len(rows)).reshape(2, -1).T.ravel()
        return both.take(by_row[angles[by_row]].tolist())

    def _of_face(
        self, face: int, rows: Sequence[Row], table: Sequence[Sequence[str]], stations: Sequence[str]
    ) -> Printed:
        """One pointing a row: the columns of one face (0: of the only one) and those of both."""
        columns = [c for c in self.columns if c.face in (0, face)]
        text = {c.role: table[c.place] for c in reversed(columns) if c.role}
        nothing = ("",) * len(rows)
        named = [name or block for name, block in zip(text.get("station", nothing), stations, strict=True)]
        self.nameless |= "" in named
        faces = self._faces(text["face"], rows) if "face" in text else [0] * len(rows)
        numbers: dict[str, Digits] = {}
        for c in columns:
            if c.role in READINGS:
                digits = self._numbers([c.text(row) for row in rows] if c.parts else table[c.place], c, rows)
                filled = digits != b""
                if filled.any():
                    before = numbers.get(c.role)
                    numbers[c.role] = digits if before is None else np.where(filled, digits, before)
        further = {c.title: self._texts(table[c.place], rows) for c in columns if c.is_further}
        return Printed(
            [self.sheet.file] * len(rows),
            [row.line for row in rows],
            [intern(name or "S1") for name in named],
            list(map(intern, text.get("target", nothing))),
            [face] * len(rows) if face else faces,
            _both(text.get("date"), text.get("time")) or [*nothing],
            _both(text.get("date"), text.get("round")) or [*nothing],
            [self.sheet.grouping] * len(rows),
            numbers,
            further,
        )

    def _faces(self, texts: Sequence[str], rows: Sequence[Row]) -> list[int]:
        """Faces as stated; 0 for an empty cell."""
        faces = {text: cells.face(text) if text else 0 for text in {*texts}}
        for text, row in zip(texts, rows, strict=True) if None in faces.values() else ():
            if faces[text] is None:
                raise self._place(row).wrong(f"found '{shown(text)}', expected 1 or 2", "face")
        return [faces[text] or 0 for text in texts]

    def _numbers(self, texts: Sequence[str], column: TableColumn, rows: Sequence[Row]) -> Digits:
        """Digits (n,) of a column of readings: its cells where all are plain numbers, otherwise each cell converted."""
        if column.unit != "dms" and not self.sheet.grouping and cells.are_numbers(texts):
            digits = as_digits(texts)
            values = as_floats(digits)
            if not np.any(np.abs(values) >= LARGEST) and not (column.role in DISTANCE and np.any(values <= 0)):
                return digits
        converted = [self._number(text, column, row) if text else "" for text, row in zip(texts, rows, strict=True)]
        if not column.unit and any(map(cells.is_marked, texts)):
            self.marked.add(column.title)
        return as_digits(converted)

    def _number(self, text: str, column: TableColumn, row: Row) -> str:
        """Digits of one cell."""
        packed = column.unit == "dms"
        number = cells.packed(text) if packed else cells.value(text, self.sheet.grouping)
        where = self._place(row)
        if packed and number is None:
            what = "degrees, minutes and seconds, such as 33°12'07.5\" or 33.12075"
            raise where.wrong(f"found '{shown(text)}', expected {what}", shown(column.title))
        if number is None or not abs(number) < LARGEST:
            raise where.wrong(f"found '{shown(text)}', expected a number", shown(column.title))
        if column.role in DISTANCE and not number > 0:
            what = f"found {shown(text)}, expected a distance above 0, or nothing where none was measured"
            raise where.wrong(what, shown(column.title))
        return str(number)

    def _texts(self, texts: Sequence[str], rows: Sequence[Row]) -> list[str]:
        """Cells of a further column; equal ones are one object where many are."""
        distinct = dict.fromkeys(texts)
        whole = "".join(distinct)
        if not whole.isprintable() or "<" in whole or ">" in whole or max(map(len, distinct)) > MAX_TEXT:
            for text, row in zip(texts, rows, strict=True):
                self._place(row).text(text)
        return list(map(intern, texts)) if 2 * len(distinct) < len(texts) else list(texts)

    def _place(self, row: Row) -> FilePlace:
        return FilePlace(self.sheet.file, row.line)


def _padded(fields: Sequence[str], width: int) -> Sequence[str]:
    """Cells of a row for each column of the header."""
    return (*fields[:width], *[""] * (width - len(fields)))


def _both(one: Sequence[str] | None, other: Sequence[str] | None) -> list[str] | None:
    """Cells of two columns joined by a blank; None where the table has neither."""
    if one is None or other is None:
        return list(one or other or ()) or None
    return [" ".join(filter(None, pair)) for pair in zip(one, other, strict=True)]
