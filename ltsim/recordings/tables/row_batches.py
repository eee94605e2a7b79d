"""Conversion of consecutive rows below a header to columns of pointings, all rows together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from sys import intern

import numpy as np

from ltsim.recordings.files import MAX_CELL_TEXT_LENGTH, SourceLocation, safe_excerpt
from ltsim.recordings.spreadsheets import cells
from ltsim.recordings.spreadsheets.angle_cells import parse_packed_degrees, unreadable_angle_sentence
from ltsim.recordings.spreadsheets.header import (
    DISTANCE_ROLES,
    HORIZONTAL_ROLES,
    READING_ROLES,
    UNITS_BY_ROLE,
    VERTICAL_ROLES,
    TableColumn,
)
from ltsim.recordings.spreadsheets.sheets import SheetRow, TableSheet
from ltsim.recordings.tables.pointing_table import DigitTexts, UnconvertedPointings, join_pointings, to_digit_texts

MAX_READING_MAGNITUDE = 10**9
"""Smallest magnitude of a reading that is refused, in any unit."""


@dataclass
class RowBatch:
    """Consecutive rows below a header: line numbers, cells, and for each row the station of the lines above."""

    line: list[int] = field(default_factory=list)
    fields: list[tuple[str, ...]] = field(default_factory=list)
    station: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.line)

    def add_row(self, row: SheetRow, station: str) -> None:
        """Addition of a row; `station` applies if no cell of the row names a station."""
        self.line.append(row.line)
        self.fields.append(row.fields)
        self.station.append(station)

    def single_rows(self) -> Iterator[RowBatch]:
        """Batches with one row each, for all rows of this batch."""
        for line, fields, station in zip(self.line, self.fields, self.station, strict=True):
            yield RowBatch([line], [fields], [station])


class RowBatchReader:
    """Reader of rows below a header of a sheet.

    After reading, `lacks_station_names` is True if a row has no station. `cell_units` is the unit of symbols in the
    cells of a column, by its title.
    """

    def __init__(self, sheet: TableSheet, columns: Sequence[TableColumn]) -> None:
        self.sheet, self.columns = sheet, columns
        self.faces = (1, 2) if any(c.face for c in columns) else (0,)
        self.lacks_station_names = False
        self.cell_units: dict[str, str] = {}

    def read(self, row_batch: RowBatch) -> UnconvertedPointings:
        """Pointings in the rows of a batch; a row that names no station has the station given in `row_batch`.

        Raises RecordError for an invalid cell; among several invalid cells, the error may name another than the first.
        """
        width = len(self.columns)
        padded_rows = [fields if len(fields) == width else pad_cells(fields, width) for fields in row_batch.fields]
        table = list(zip(*padded_rows, strict=True))
        if self.faces == (0,):
            return self._pointings_of_face(0, row_batch, table)
        pointings = join_pointings([self._pointings_of_face(face, row_batch, table) for face in self.faces])
        angles = pointings.digit_texts_of_roles((*HORIZONTAL_ROLES, *VERTICAL_ROLES)) != b""
        by_row = np.arange(2 * len(row_batch)).reshape(2, -1).T.ravel()
        return pointings.reordered_pointings(by_row[angles[by_row]].tolist())

    def _pointings_of_face(
        self, face: int, row_batch: RowBatch, table: Sequence[Sequence[str]]
    ) -> UnconvertedPointings:
        """Pointings in one face, one for each row, from the columns of this face and the columns for both faces.

        `face` is 0 if the columns do not distinguish faces. `table` is the cells of each column.
        """
        columns = [c for c in self.columns if c.face in (0, face)]
        cells_by_role = {c.role: table[c.position] for c in reversed(columns) if c.role}
        empty_cells = ("",) * len(row_batch)
        stations = [
            name or block
            for name, block in zip(cells_by_role.get("station", empty_cells), row_batch.station, strict=True)
        ]
        self.lacks_station_names |= "" in stations
        faces = [0] * len(row_batch)
        if "face" in cells_by_role:
            faces = self._parse_faces(cells_by_role["face"], row_batch.line)
        digit_texts_by_role: dict[str, DigitTexts] = {}
        for c in columns:
            if c.role in READING_ROLES:
                digits = self._parse_numbers(c.cell_texts(table), c, row_batch.line)
                filled = digits != b""
                if filled.any():
                    earlier_digits = digit_texts_by_role.get(c.role)
                    digit_texts_by_role[c.role] = (
                        digits if earlier_digits is None else np.where(filled, digits, earlier_digits)
                    )
        additional_cells = {
            c.title: self._checked_texts(table[c.position], row_batch.line) for c in columns if c.is_additional
        }
        return UnconvertedPointings(
            [self.sheet.file] * len(row_batch),
            row_batch.line,
            [intern(name or "S1") for name in stations],
            list(map(intern, cells_by_role.get("target", empty_cells))),
            [face] * len(row_batch) if face else faces,
            _joined_cells(cells_by_role.get("date"), cells_by_role.get("time")) or [*empty_cells],
            _joined_cells(cells_by_role.get("date"), cells_by_role.get("round")) or [*empty_cells],
            [self.sheet.thousands_separator] * len(row_batch),
            digit_texts_by_role,
            additional_cells,
        )

    def _parse_faces(self, texts: Sequence[str], lines: Sequence[int]) -> list[int]:
        """Face (1 or 2) in each cell; 0 for an empty cell. Raises RecordError."""
        faces = {text: cells.parse_face(text) if text else 0 for text in {*texts}}
        for text, line in zip(texts, lines, strict=True) if None in faces.values() else ():
            if faces[text] is None:
                raise self._source_location(line).error(f"found '{safe_excerpt(text)}', expected 1 or 2", "face")
        return [faces[text] or 0 for text in texts]

    def _parse_numbers(self, texts: Sequence[str], column: TableColumn, lines: Sequence[int]) -> DigitTexts:
        """Numbers (n,) in n cells of a column of readings, as decimal digits; an empty text for a missing reading.

        Cells with thousands separators, units, or degrees with minutes and seconds are converted. `lines` are the line
        numbers of the cells. Raises RecordError for a cell that is not a number, and for cells in different units.
        """
        texts = ["" if text in cells.MISSING_VALUE_TEXTS else text for text in texts]
        plain_values = (
            cells.plain_numbers(texts) if column.unit != "dms" and not self.sheet.thousands_separator else None
        )
        lower_bound = 0.0 if column.role in DISTANCE_ROLES else -np.inf
        if plain_values is not None and not np.any(
            (np.abs(plain_values) >= MAX_READING_MAGNITUDE) | (plain_values <= lower_bound)
        ):
            return to_digit_texts(texts)
        numbers, unit = cells.split_common_unit(texts)
        if unit in UNITS_BY_ROLE[column.role] and column.unit in ("", unit):
            texts = numbers
        elif not column.unit and any(map(cells.is_sexagesimal, texts)):
            unit = "deg"
        else:
            unit = ""
        if unit and self.cell_units.setdefault(column.title, unit) != unit:
            what = f"found '{safe_excerpt(texts[0])}' in {unit}, expected one unit in all cells"
            raise self._source_location(lines[0]).error(what, safe_excerpt(column.title))
        return to_digit_texts(
            [self._parse_number(text, column, line) if text else "" for text, line in zip(texts, lines, strict=True)]
        )

    def _parse_number(self, text: str, column: TableColumn, line: int) -> str:
        """Number in one cell, as text of its decimal digits; raises RecordError."""
        packed = column.unit == "dms"
        exact_value = (
            parse_packed_degrees(text) if packed else cells.parse_number_or_angle(text, self.sheet.thousands_separator)
        )
        location = self._source_location(line)
        if packed and exact_value is None:
            what = "degrees, minutes and seconds, such as 33°12'07.5\" or 33.12075"
            raise location.error(f"found '{safe_excerpt(text)}', expected {what}", safe_excerpt(column.title))
        if exact_value is None or not abs(exact_value) < MAX_READING_MAGNITUDE:
            is_angle = column.role in (*HORIZONTAL_ROLES, *VERTICAL_ROLES)
            appearance = f" ({sentence})" if is_angle and (sentence := unreadable_angle_sentence(text)) else ""
            message = f"found '{safe_excerpt(text)}', expected a number{appearance}"
            raise location.error(message, safe_excerpt(column.title))
        if column.role in DISTANCE_ROLES and not exact_value > 0:
            what = f"found {safe_excerpt(text)}, expected a distance above 0, or an empty cell if none was measured"
            raise location.error(what, safe_excerpt(column.title))
        return str(exact_value)

    def _checked_texts(self, texts: Sequence[str], lines: Sequence[int]) -> list[str]:
        """Cells of an additional column, checked to be short texts; equal texts share memory. Raises RecordError."""
        distinct = dict.fromkeys(texts)
        joined_text = "".join(distinct)
        if (
            not joined_text.isprintable()
            or "<" in joined_text
            or ">" in joined_text
            or max(map(len, distinct)) > MAX_CELL_TEXT_LENGTH
        ):
            for text, line in zip(texts, lines, strict=True):
                self._source_location(line).checked_text(text)
        return list(map(intern, texts)) if 2 * len(distinct) < len(texts) else list(texts)

    def _source_location(self, line: int) -> SourceLocation:
        """Location of a line in the file of the sheet."""
        return SourceLocation(self.sheet.file, line)


def pad_cells(fields: Sequence[str], width: int) -> Sequence[str]:
    """Cells of a row, extended by empty cells or shortened at the end, so that there are `width` cells."""
    return (*fields[:width], *[""] * (width - len(fields)))


def _joined_cells(first_cells: Sequence[str] | None, second_cells: Sequence[str] | None) -> list[str] | None:
    """Cells of two columns, joined by blanks; the cells of one column if the other is None; None if both are None."""
    if first_cells is None or second_cells is None:
        return list(first_cells or second_cells or ()) or None
    return [" ".join(filter(None, pair)) for pair in zip(first_cells, second_cells, strict=True)]
