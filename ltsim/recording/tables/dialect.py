"""From a file to rows of text: separator, quotes, comments, sheets of a workbook."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date, datetime, time
from pathlib import Path
from typing import Any

from ltsim.errors import RecordError
from ltsim.recording.files import MAX_BYTES, MAX_LINES, is_number, read_lines
from ltsim.recording.tables.cells import is_value

SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".asc", ".xlsx")
WORKBOOK = b"PK\x03\x04"
SEPARATORS = ("\t", ";", ",", " ")
SAMPLE = 400
MAX_FIELDS = 500


@dataclass(frozen=True)
class Row:
    """Fields of one line; a line that begins with # is a comment."""

    line: int
    fields: tuple[str, ...]
    comment: bool = False


@dataclass(frozen=True)
class Sheet:
    """Rows of a text file or of one sheet of a workbook; blank lines are left out.

    `open_end` says that the last line had no line break.
    """

    file: Path
    name: str
    rows: tuple[Row, ...]
    open_end: bool = False


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
    """Every sheet of a file or of a folder's files.

    Raises
    ------
    RecordError
        For a file that is no text and no workbook, or lacks the library that reads workbooks.
    """
    found: list[Sheet] = []
    for file in files_of(path):
        found += _workbook(file) if file.suffix.lower() == ".xlsx" else [_text(file)]
    return found


def _text(file: Path) -> Sheet:
    lines = read_lines(file, latin=True)
    separator = separator_of(lines)
    rows = []
    for i, line in enumerate(lines):
        comment = line.lstrip().startswith("#")
        text = line.lstrip().lstrip("#") if comment else line
        if text.strip() and not _says_separator(line):
            fields = split(text, separator)
            if len(fields) > MAX_FIELDS:
                raise RecordError(f"{len(fields)} fields, expected at most {MAX_FIELDS}", file=file, row=i + 1)
            rows.append(Row(i + 1, fields, comment))
    return Sheet(file, file.stem, tuple(rows), open_end=bool(lines[-1]))


def _says_separator(line: str) -> bool:
    """The first line of some spreadsheets' exports: ``sep=;``."""
    return line.lower().startswith("sep=") and len(line) == 5


def separator_of(lines: Sequence[str]) -> str:
    """The separator that makes most values of most lines of one width; of equals the first of `SEPARATORS`."""
    sample = [line for line in lines[:SAMPLE] if line.strip() and not line.lstrip().startswith("#")]
    return max(SEPARATORS, key=lambda s: _values(sample, s))


def _values(lines: Sequence[str], separator: str) -> int:
    """Cells that hold values in the lines of one width, of three columns at least, that hold most."""
    rows = [fields for fields in (split(line, separator) for line in lines) if len(fields) > 2]
    test = is_number if separator == "," else is_value
    counts: Counter[int] = Counter()
    for fields in rows:
        counts[len(fields)] += sum(map(test, fields))
    return max(counts.values(), default=0)


def split(line: str, separator: str) -> tuple[str, ...]:
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


def _workbook(file: Path) -> list[Sheet]:
    try:
        from openpyxl import load_workbook
    except ImportError:
        message = 'is a workbook, which needs the library openpyxl: pip install "ltsim[xlsx]", or save it as CSV'
        raise RecordError(message, file=file) from None
    if file.is_file() and file.stat().st_size > MAX_BYTES:
        raise RecordError(f"is larger than {MAX_BYTES >> 20} MiB, the most that is read", file=file)
    try:
        book = load_workbook(file, read_only=True, data_only=True)
    except OSError as problem:
        raise RecordError(f"cannot be read ({problem.strerror})", file=file) from None
    except Exception as problem:  # the library raises whatever its parts raise
        raise RecordError(f"is no workbook that can be read ({type(problem).__name__})", file=file) from None
    try:
        return [sheet for name in book.sheetnames if (sheet := _sheet(book[name], file, name)).rows]
    finally:
        book.close()


def _sheet(sheet: Any, file: Path, name: str) -> Sheet:
    rows = []
    for i, cells in enumerate(sheet.iter_rows(values_only=True, max_row=MAX_LINES, max_col=MAX_FIELDS)):
        fields = [_shown(cell) for cell in cells]
        while fields and not fields[-1]:
            fields.pop()
        if fields:
            comment = fields[0].startswith("#")
            rows.append(Row(i + 1, (fields[0].lstrip("# "), *fields[1:]), comment))
    return Sheet(file, name, tuple(rows))


def _shown(cell: object) -> str:
    """One cell as text that says the same: shortest digits of a number, ISO form of a date."""
    if cell is None:
        return ""
    if isinstance(cell, (datetime, date, time)):
        return cell.isoformat()
    return str(cell).strip()
