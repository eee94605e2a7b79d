"""Rows of a text file or a workbook: encoding, separator, quotes, comments, sheets."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, chain, starmap
from pathlib import Path
from typing import NamedTuple, overload

from ltsim.core.errors import RecordError
from ltsim.core.limits import (
    MAX_TABLE_COLUMNS,
)
from ltsim.recordings.files import SourceLocation, read_lines, safe_excerpt
from ltsim.recordings.spreadsheets.cells import (
    detect_thousands_separator,
    is_number_or_angle_with_point,
    is_numeric,
)
from ltsim.recordings.spreadsheets.workbooks import workbook_rows_by_sheet

TABLE_SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".asc", ".xlsx")
"""Suffixes of the names of files that may be tables."""
ZIP_SIGNATURE = b"PK\x03\x04"
"""First bytes of a zip archive, such as a workbook."""
FIELD_SEPARATORS = ("\t", ";", ",", " ")
"""Possible separators of fields; among equally likely ones the first is used."""
UNAMBIGUOUS_SEPARATORS = FIELD_SEPARATORS[:2]
"""Separators that numbers do not contain; one that is in all lines equally often is that of the fields."""
N_SEPARATOR_SAMPLE_LINES = 400
"""Number of lines from which the separator is detected."""
MAX_SEPARATOR_SAMPLE_CHARACTERS = 100_000
"""Number of characters from which the separator is detected."""


_BLANKS_BEFORE_UNIT_PATTERN = re.compile(r"(?<=\S)[ \t]+(?=[(\[][^\s()\[\]]+[)\]](?:\s|$))")
"""Pattern of blanks between a title and its unit in brackets."""


class SheetRow(NamedTuple):
    """Row of a table: line number, fields, and whether the line is a comment (begins with #)."""

    line: int
    fields: tuple[str, ...]
    is_comment: bool = False

    @property
    def n_numeric_fields(self) -> int:
        """Number of fields that are numbers or angles."""
        return sum(map(is_numeric, self.fields))

    def cell(self, position: int) -> str:
        """Text of the field at `position` (from 0); '' if the row is shorter."""
        return self.fields[position] if position < len(self.fields) else ""

    def check_width(self, width: int, file: object) -> None:
        """Check that the row has `width` fields, the number in the header; raises RecordError."""
        if len(self.fields) != width:
            raise SourceLocation(file, self.line).error(f"{len(self.fields)} fields, expected {width} as in the header")

    def __str__(self) -> str:
        return safe_excerpt(" ".join(field for field in self.fields if field), 30)


class TextRows(Sequence[SheetRow]):
    """Rows of a text file, split into fields only when accessed, which saves 80 % of the memory."""

    def __init__(self, lines: Sequence[tuple[int, str]], separator: str) -> None:
        self._lines, self.separator = lines, separator

    def __len__(self) -> int:
        return len(self._lines)

    @overload
    def __getitem__(self, place: int) -> SheetRow: ...

    @overload
    def __getitem__(self, place: slice) -> TextRows: ...

    def __getitem__(self, place: int | slice) -> SheetRow | TextRows:
        if isinstance(place, slice):
            return TextRows(self._lines[place], self.separator)
        return self._split_line(*self._lines[place])

    def __iter__(self) -> Iterator[SheetRow]:
        return starmap(self._split_line, self._lines)

    def _split_line(self, line_number: int, line: str) -> SheetRow:
        if "#" in line and line.lstrip().startswith("#"):
            return SheetRow(line_number, _split_fields(line.lstrip().lstrip("#"), self.separator), is_comment=True)
        return SheetRow(line_number, _split_fields(line, self.separator))

    @property
    def rows_with_comma_and_point(self) -> TextRows:
        """Rows in which a field may contain both a comma and a point."""
        is_comma_separated = self.separator == ","  # fields then hold commas in quotes alone
        mixed = [
            line
            for line in self._lines
            if "," in line[1] and "." in line[1] and ('"' in line[1] or not is_comma_separated)
        ]
        return TextRows(mixed, self.separator)


@dataclass(frozen=True)
class TableSheet:
    """Rows, without blank lines, of a text file or of one sheet of a workbook.

    `has_incomplete_end` is True if the last line has no line break. `station` is the name of the sheet or file; it is
    the name of the set-up of its rows if there are several sheets.
    """

    file: Path
    rows: Sequence[SheetRow]
    station: str = ""
    has_incomplete_end: bool = False

    @property
    def has_blanks_between_fields(self) -> bool:
        """True if fields are separated by blanks, so that a missing cell cannot be noticed."""
        return isinstance(self.rows, TextRows) and self.rows.separator == " "

    @cached_property
    def thousands_separator(self) -> str:
        """Thousands separator in the numbers, '' for none; raises RecordError for two different ones."""
        number_rows = self.rows.rows_with_comma_and_point if isinstance(self.rows, TextRows) else self.rows
        return detect_thousands_separator((row.fields for row in number_rows), self.file)

    def require_complete_end(self, width: int, *, requires_line_break: bool = False) -> None:
        """Check that the last line is complete; raises RecordError.

        It is complete if it has a line break. Unless `requires_line_break`, it is also complete if it has `width`
        fields and its last number has at least as many decimals as in the line before.
        """
        if not self.has_incomplete_end:
            return
        row = self.rows[-1]
        earlier = map(self.rows.__getitem__, range(len(self.rows) - 2, -1, -1))
        before = next((candidate for candidate in earlier if len(candidate.fields) == width), None)
        decimals = [len(r.fields[-1].replace(",", ".").partition(".")[2]) for r in (row, before) if r is not None]
        if requires_line_break or len(row.fields) != width or (len(decimals) == 2 and decimals[0] < decimals[1]):
            raise SourceLocation(self.file, row.line).error("the file ends inside this row and is incomplete")


def is_table_folder(path: Path) -> bool:
    """True for a folder with tables that is not in the native format."""
    try:
        return path.is_dir() and not (path / "observations.csv").exists() and bool(table_files(path))
    except OSError:
        return False


def table_files(path: Path) -> list[Path]:
    """Paths of the tables in a folder, in alphabetical order; `path` alone if it is not a folder."""
    if not path.is_dir():
        return [path]
    return sorted(
        f for f in path.iterdir() if not f.is_dir() and f.suffix.lower() in TABLE_SUFFIXES and f.name[0] != "."
    )


def read_sheets(path: Path) -> list[TableSheet]:
    """Sheets of a file, or of all tables in a folder; with several sheets, their names are the names of the set-ups.

    Raises RecordError for a file that is neither text nor a workbook, and for a workbook if the library to read it is
    not installed.
    """
    sheets = []
    for file in table_files(path):
        sheets += _read_workbook(file) if file.suffix.lower() == ".xlsx" else [read_text_sheet(file)]
    return sheets if len(sheets) > 1 else [replace(sheet, station="") for sheet in sheets]


def read_text_sheet(file: Path) -> TableSheet:
    """Sheet with the rows of a text file; raises RecordError."""
    lines = read_lines(file, replaces_undecodable=True)
    return TableSheet(file, _non_blank_rows(lines, file), file.stem, has_incomplete_end=bool(lines[-1]))


def _non_blank_rows(lines: Sequence[str], file: Path) -> TextRows:
    """Rows of the lines that are not blank; raises RecordError for a line with more than `MAX_TABLE_COLUMNS` fields."""
    separator = _detect_separator(lines)
    non_blank = []
    for i, line in enumerate(lines):
        is_separator_line = len(line) == 5 and line.lower().startswith("sep=")  # exports of some spreadsheets
        if line.strip().lstrip("#").strip() and not is_separator_line:
            if len(line) >= MAX_TABLE_COLUMNS:
                _require_few_fields(_split_fields(line, separator), i + 1, file)
            non_blank.append((i + 1, line))
    return TextRows(non_blank, separator)


def _require_few_fields(fields: Sequence[str], line: int, file: Path) -> None:
    """Check that a row has at most `MAX_TABLE_COLUMNS` fields; raises RecordError, which names `file` and `line`."""
    if len(fields) > MAX_TABLE_COLUMNS:
        raise SourceLocation(file, line).error(f"{len(fields)} fields, expected at most {MAX_TABLE_COLUMNS}")


def rows_of_file_beginning(file_beginning: str) -> list[SheetRow]:
    """First rows, with comments, of a file that begins with the text `file_beginning`; they show its format."""
    lines = [line for line in file_beginning.splitlines() if line.strip()]
    separator = _detect_separator(lines)
    return [
        SheetRow(i + 1, _split_fields(line.lstrip("# "), separator), line.startswith("#"))
        for i, line in enumerate(lines[:60])
    ]


def _detect_separator(lines: Sequence[str]) -> str:
    """Most plausible separator: with it lines of equal length have the most numeric fields.

    Lines have equal length if they have the same number of fields. Lines of three or more fields are compared first. A
    tie is decided by lines of two or more fields, then by the number of fields in the first line, then by the order of
    `FIELD_SEPARATORS`.
    """
    lines_and_offsets = zip(
        lines[:N_SEPARATOR_SAMPLE_LINES],
        accumulate(map(len, lines[:N_SEPARATOR_SAMPLE_LINES]), initial=0),
        strict=False,
    )
    sample = [
        line
        for line, before in lines_and_offsets
        if before < MAX_SEPARATOR_SAMPLE_CHARACTERS and line.strip() and line.lstrip()[0] != "#"
    ]
    for separator in UNAMBIGUOUS_SEPARATORS:
        if sample and all(line.count(separator) == sample[0].count(separator) > 2 for line in sample):
            return separator
    width = {s: max((len(_split_fields(line, s)) for line in sample[:1]), default=0) for s in FIELD_SEPARATORS[:3]}
    return max(
        FIELD_SEPARATORS,
        key=lambda s: (_max_numeric_field_count(sample, s, 3), _max_numeric_field_count(sample, s, 2), width.get(s, 0)),
    )


def _max_numeric_field_count(lines: Sequence[str], separator: str, min_columns: int) -> int:
    """Number of numeric fields in the largest group of lines that have equally many (at least `min_columns`) fields."""
    wide_rows = [fields for fields in (_split_fields(line, separator) for line in lines) if len(fields) >= min_columns]
    is_number_cell = is_number_or_angle_with_point if separator == "," else is_numeric
    counts: Counter[int] = Counter()
    for fields in wide_rows:
        counts[len(fields)] += sum(map(is_number_cell, fields))
    return max(counts.values(), default=0)


def _split_fields(line: str, separator: str) -> tuple[str, ...]:
    """Fields of a line, without the quotation marks of CSV."""
    if separator == " ":
        return tuple(_BLANKS_BEFORE_UNIT_PATTERN.sub("", line).split() if "[" in line or "(" in line else line.split())
    plain_fields = tuple(map(str.strip, line.split(separator)))
    if '"' in line and any('"' in text and text != '"' for text in plain_fields):  # a sign of seconds is no quote
        try:
            fields = next(csv.reader([line], delimiter=separator, strict=True), [])
            return tuple(field.strip() for field in fields)
        except csv.Error:
            pass  # an inch or second sign, no quotes
    return plain_fields


def read_small_table(path: Path) -> tuple[list[str], list[tuple[int, dict[str, str]]]]:
    """Header of a small table written by a user, and line number and cells by title of each row.

    Raises RecordError if a title occurs twice, or if a row has more or fewer cells than the header.
    """
    lines = [row for row in read_text_sheet(path).rows if not row.is_comment]
    if not lines:
        raise RecordError("the file contains only comments, expected a header and rows", file=path)
    header, *rows = lines
    duplicate_title = next((name for name in header.fields if header.fields.count(name) > 1), None)
    if duplicate_title is not None:
        raise SourceLocation(path, header.line).error(
            "this column appears twice in the header", safe_excerpt(duplicate_title)
        )
    for row in rows:
        row.check_width(len(header.fields), path)
    return list(header.fields), [(r.line, dict(zip(header.fields, r.fields, strict=True))) for r in rows]


def _read_workbook(file: Path) -> list[TableSheet]:
    """Sheets of a workbook (xlsx), with their names, that are not empty; raises RecordError."""
    sheets = [
        TableSheet(file, tuple(_workbook_row(*line) for line in cells), name)
        for name, cells in workbook_rows_by_sheet(file)
    ]
    for row in chain.from_iterable(sheet.rows for sheet in sheets):
        _require_few_fields(row.fields, row.line, file)
    return [sheet for sheet in sheets if sheet.rows]


def _workbook_row(line: int, fields: Sequence[str]) -> SheetRow:
    """Row of a workbook; it is a comment if its first cell begins with # and is not an error value such as #N/A."""
    is_comment = fields[0].startswith("#") and not fields[0].startswith(("#REF!", "#N/A", "#VALUE!", "#DIV/0!"))
    return SheetRow(line, (fields[0].lstrip("# ") if is_comment else fields[0], *fields[1:]), is_comment)
