"""Sheets of a workbook (xlsx) as rows of text; what unpacks to more than a recording ever holds is refused."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator
from datetime import date, datetime, time
from pathlib import Path

from ltsim.errors import RecordError
from ltsim.recording.files import MAX_BYTES, MAX_LINES, read_bytes

MAX_CELLS = 3_000_000
_ROWS = re.compile(rb"<(?:\w+:)?row\b")
_ROW = re.compile(rb"<(?:\w+:)?row\b[^>]*?\br=\"(\d{1,9})\"")
_CELL = re.compile(rb"<(?:\w+:)?c\b[^>]*?\br=\"([A-Z]{1,3})\d")
_STRING = re.compile(rb"<(?:\w+:)?si\b")
_PARTS = re.compile(r"xl/(worksheets/[^/]*\.xml|sharedStrings\.xml)", re.IGNORECASE)
Fields = tuple[int, tuple[str, ...], bool]


def rows_of_sheets(file: Path) -> list[tuple[str, list[Fields]]]:
    """Name and rows (line, fields, whether a comment) of every sheet that holds something.

    Raises
    ------
    RecordError
        For what is no workbook, is damaged, unpacks to too much, or lacks the library that reads workbooks.
    """
    try:
        from openpyxl import load_workbook
    except ImportError:
        message = 'is a workbook, which needs the library openpyxl: pip install "ltsim[xlsx]", or save it as CSV'
        raise RecordError(message, file=file) from None
    read_bytes(file)
    try:
        width = _bounded(file)
        book = load_workbook(file, read_only=True, data_only=True)
        try:
            found = [(name, list(_rows(book[name], width))) for name in book.sheetnames]
        finally:
            book.close()
    except RecordError:
        raise
    except OSError as problem:
        raise RecordError(f"cannot be read ({problem.strerror or 'damaged'})", file=file) from None
    except Exception as problem:  # the library raises whatever its parts raise
        what = f"is no workbook that can be read ({type(problem).__name__}): it is damaged; save it again, or as CSV"
        raise RecordError(what, file=file) from None
    return [(name, rows) for name, rows in found if rows]


def _bounded(file: Path) -> int:
    """The last column in use; raises RecordError where a workbook unpacks to too much."""
    last = 1
    with zipfile.ZipFile(file) as packed:
        if sum(part.file_size for part in packed.infolist()) > 4 * MAX_BYTES:
            raise RecordError(f"unpacks to more than {4 * MAX_BYTES >> 20} MiB, the most that is read", file=file)
        for part in packed.infolist():
            if _PARTS.fullmatch(part.filename) is None:
                continue
            if part.file_size > MAX_BYTES:
                raise RecordError(f"unpacks to more than {MAX_BYTES >> 20} MiB a sheet, the most read", file=file)
            content = packed.read(part)
            columns = {found[1] for found in _CELL.finditer(content)}
            width = max((_number(letters) for letters in columns), default=1)
            rows = max((int(found[1]) for found in _ROW.finditer(content)), default=0)
            rows = max(rows, sum(1 for _ in _ROWS.finditer(content)))
            strings = sum(1 for _ in _STRING.finditer(content))
            if max(rows, strings) > MAX_LINES or rows * width > MAX_CELLS:
                where = f"up to row {rows} of {width} columns" if rows else f"{strings} texts"
                what = f"holds a sheet with {where}, more than is read; delete the cells far away from the table"
                raise RecordError(what, file=file)
            last = max(last, width)
    return last


def _number(letters: bytes) -> int:
    """The number of a column from its letters, 1 for A."""
    number = 0
    for letter in letters:
        number = 26 * number + letter - 64
    return number


def _rows(sheet: object, width: int) -> Iterator[Fields]:
    cells_of_rows = sheet.iter_rows(values_only=True, max_row=MAX_LINES, max_col=width)  # type: ignore[attr-defined]
    for i, cells in enumerate(cells_of_rows):
        fields = [_shown(cell) for cell in cells]
        while fields and not fields[-1]:
            fields.pop()
        if fields:
            comment = fields[0].startswith("#") and not fields[0].startswith(("#REF!", "#N/A", "#VALUE!", "#DIV/0!"))
            yield i + 1, (fields[0].lstrip("# ") if comment else fields[0], *fields[1:]), comment


def _shown(cell: object) -> str:
    """One cell as text that says the same: shortest digits of a number, ISO form of a date."""
    if cell is None:
        return ""
    if isinstance(cell, (datetime, date, time)):
        return cell.isoformat()
    return str(cell).strip()
