"""From a file to rows of text: encoding, separator, quotes, comments, sheets of a workbook."""

import csv
import io
import zipfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date, datetime, time
from functools import cached_property
from pathlib import Path
from typing import Any

from ltsim.errors import RecordError
from ltsim.recording.files import MAX_BYTES, MAX_LINES, FilePlace, is_number, read_bytes, read_lines, shown
from ltsim.recording.tables.cells import grouping_of, is_value

SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".asc", ".xlsx")
WORKBOOK = b"PK\x03\x04"
SEPARATORS = ("\t", ";", ",", " ")
SAMPLE = 400
MAX_FIELDS = 500
MAX_CELLS = 3_000_000
_MOMENTS = (datetime, date, time)


@dataclass(frozen=True)
class Row:
    """Fields of one line; a line that begins with # is a comment."""

    line: int
    fields: tuple[str, ...]
    comment: bool = False

    @property
    def values(self) -> int:
        """How many fields hold a number or an angle."""
        return sum(map(is_value, self.fields))

    def cell(self, place: int) -> str:
        """A field; empty where the row is too short for it."""
        return self.fields[place] if place < len(self.fields) else ""

    def check_width(self, width: int, file: object) -> None:
        """Raise RecordError where the row has another number of cells than the header."""
        if len(self.fields) != width:
            raise FilePlace(file, self.line).wrong(f"{len(self.fields)} fields, expected {width} as in the header")

    def __str__(self) -> str:
        return shown(" ".join(field for field in self.fields if field), 30)


@dataclass(frozen=True)
class Sheet:
    """Rows of a text file or of one sheet of a workbook; blank lines are left out.

    `open_end` says that the last line had no line break, `station` which set-up all rows belong to where that is known.
    """

    file: Path
    rows: tuple[Row, ...]
    station: str = ""
    open_end: bool = False

    @cached_property
    def grouping(self) -> str:
        """The mark that groups the thousands of its numbers; raises RecordError where there are two."""
        return grouping_of((row.fields for row in self.rows), self.file)

    def check_whole(self, width: int, *, strict: bool = False) -> None:
        """Raise RecordError where the last line has no line break and does not end as the one before it does.

        `strict` is for what programs write, who end every line.
        """
        if not self.open_end:
            return
        row = self.rows[-1]
        before = next((p for p in reversed(self.rows[:-1]) if len(p.fields) == width), None)
        ends = [len(r.fields[-1].replace(",", ".").partition(".")[2]) for r in (row, before) if r is not None]
        if strict or len(row.fields) != width or (len(ends) == 2 and ends[0] < ends[1]):
            raise FilePlace(self.file, row.line).wrong("the file ends inside this row: it was cut")


def is_folder(path: Path) -> bool:
    """Whether this is a folder of tables and no recording of ltsim."""
    try:
        return path.is_dir() and not (path / "observations.csv").exists() and bool(files_of(path))
    except OSError:
        return False


def files_of(path: Path) -> list[Path]:
    """The file itself, or the tables of a folder by name."""
    if not path.is_dir():
        return [path]
    return sorted(f for f in path.iterdir() if f.is_file() and f.suffix.lower() in SUFFIXES and f.name[0] != ".")


def sheets_of(path: Path) -> list[Sheet]:
    """Every sheet of a file or of a folder's files; of several each is named as its set-up.

    Raises RecordError for a file that is no text and no workbook, or lacks the library that reads workbooks.
    """
    found = []
    for file in files_of(path):
        found += _workbook(file) if file.suffix.lower() == ".xlsx" else [text_sheet(file)]
    return found if len(found) > 1 else [replace(sheet, station="") for sheet in found]


def text_sheet(file: Path) -> Sheet:
    """A text file as a sheet; raises RecordError."""
    lines = read_lines(file, liberal=True)
    return Sheet(file, tuple(_rows(lines, file)), file.stem, open_end=bool(lines[-1]))


def _rows(lines: Sequence[str], file: Path) -> Iterator[Row]:
    separator = _separator_of(lines)
    for i, line in enumerate(lines):
        comment = line.lstrip().startswith("#")
        text = line.lstrip().lstrip("#") if comment else line
        says_separator = len(line) == 5 and line.lower().startswith("sep=")  # exports of some spreadsheets
        if text.strip() and not says_separator:
            fields = _split(text, separator)
            if len(fields) > MAX_FIELDS:
                raise FilePlace(file, i + 1).wrong(f"{len(fields)} fields, expected at most {MAX_FIELDS}")
            yield Row(i + 1, fields, comment)


def rows_of_head(head: str) -> list[Row]:
    """The first lines of a file as rows, comments among them, for whoever asks whether the file is his."""
    lines = [line for line in head.splitlines() if line.strip()]
    separator = _separator_of(lines)
    return [Row(i + 1, _split(line.lstrip("# "), separator), line.startswith("#")) for i, line in enumerate(lines[:60])]


def _separator_of(lines: Sequence[str]) -> str:
    """The separator that makes most values of most lines of one width; of equals the first of `SEPARATORS`.

    Lines of three columns count before those of two, and those before the mere number of columns.
    """
    sample = [line for line in lines[:SAMPLE] if line.strip() and not line.lstrip().startswith("#")]
    if sample and all(line.count("\t") == sample[0].count("\t") > 2 for line in sample):
        return "\t"
    width = {s: max((len(_split(line, s)) for line in sample[:1]), default=0) for s in SEPARATORS[:3]}
    return max(SEPARATORS, key=lambda s: (_values(sample, s, 3), _values(sample, s, 2), width.get(s, 0)))


def _values(lines: Sequence[str], separator: str, least: int) -> int:
    """Cells that hold values in the lines of one width, of `least` columns at least, that hold most."""
    rows = [fields for fields in (_split(line, separator) for line in lines) if len(fields) >= least]
    test = is_number if separator == "," else is_value
    counts: Counter[int] = Counter()
    for fields in rows:
        counts[len(fields)] += sum(map(test, fields))
    return max(counts.values(), default=0)


def _split(line: str, separator: str) -> tuple[str, ...]:
    """The fields of one line; quotes count where they are quotes of CSV."""
    if separator == " ":
        return tuple(line.split())
    if '"' in line:
        try:
            fields = next(csv.reader([line], delimiter=separator, strict=True), [])
            return tuple(field.strip() for field in fields)
        except csv.Error:
            pass  # an inch or second sign, no quotes
    return tuple(field.strip() for field in line.split(separator))


def table_rows(path: Path) -> tuple[list[str], list[tuple[int, dict[str, str]]]]:
    """The header of a small table that a person wrote, and its rows by column, each with its line.

    Raises RecordError when a row has more or fewer cells than the header.
    """
    header, *rows = [row for row in text_sheet(path).rows if not row.comment]
    for row in rows:
        row.check_width(len(header.fields), path)
    return list(header.fields), [(r.line, dict(zip(header.fields, r.fields, strict=True))) for r in rows]


def _workbook(file: Path) -> list[Sheet]:
    """The sheets of a workbook (xlsx) that hold something.

    Raises RecordError for what is no workbook, is damaged, unpacks to too much, or lacks the library that reads
    workbooks.
    """
    try:
        from openpyxl import load_workbook
    except ImportError:
        message = 'is a workbook, which needs the library openpyxl: pip install "ltsim[xlsx]", or save it as CSV'
        raise RecordError(message, file=file) from None
    packed = io.BytesIO(read_bytes(file))  # of a damaged file the library would leave its own handle open
    try:
        _check_size(file, packed)
        book = load_workbook(packed, read_only=True, data_only=True)
        try:
            found = [Sheet(file, tuple(_rows_of(book[name], file)), name) for name in book.sheetnames]
        finally:
            book.close()
    except RecordError:
        raise
    except OSError as problem:
        raise RecordError(f"cannot be read ({problem.strerror or 'damaged'})", file=file) from None
    except Exception as problem:  # the library raises whatever its parts raise
        what = f"is no workbook that can be read ({type(problem).__name__}): it is damaged; save it again, or as CSV"
        raise RecordError(what, file=file) from None
    return [sheet for sheet in found if sheet.rows]


def _check_size(file: Path, packed: io.BytesIO) -> None:
    """Raise RecordError where a workbook unpacks to more than a recording ever holds."""
    with zipfile.ZipFile(packed) as parts:
        for part in parts.infolist():
            if part.file_size > MAX_BYTES:
                raise RecordError(f"unpacks to more than {MAX_BYTES >> 20} MiB a sheet, the most read", file=file)
            if part.filename.endswith("sharedStrings.xml") and parts.read(part).count(b"<si") > MAX_LINES:
                raise RecordError(f"holds more than {MAX_LINES} texts, more than is read", file=file)


def _rows_of(sheet: Any, file: Path) -> Iterator[Row]:
    """Rows that hold something, dates in ISO form, numbers with their shortest digits."""
    sheet.reset_dimensions()  # what the file says of them need not be so
    count = 0
    for i, cells in enumerate(sheet.iter_rows(values_only=True)):
        count += len(cells)
        if i >= MAX_LINES or count > MAX_CELLS:
            what = f"holds a sheet up to row {i + 1}, more than is read; delete the cells far away from the table"
            raise RecordError(what, file=file)
        fields = [_text(cell) for cell in cells]
        while fields and not fields[-1]:
            fields.pop()
        if fields:
            comment = fields[0].startswith("#") and not fields[0].startswith(("#REF!", "#N/A", "#VALUE!", "#DIV/0!"))
            yield Row(i + 1, (fields[0].lstrip("# ") if comment else fields[0], *fields[1:]), comment)


def _text(cell: object) -> str:
    """A cell of a workbook; a day without a clock as a date alone."""
    if isinstance(cell, datetime) and cell.time() == time():
        cell = cell.date()
    return "" if cell is None else cell.isoformat() if isinstance(cell, _MOMENTS) else str(cell).strip()
