"""Cells of a workbook (xlsx) as text; its archive, the markup of its parts and the number of its cells are bounded."""

import io
import warnings
import zipfile
from datetime import date, datetime, time
from pathlib import Path
from typing import Any

from ltsim.core.errors import RecordError
from ltsim.core.limits import CELLS, FILE_BYTES, LINE_CHARACTERS, LINES, MIB, SHEETS, WORKBOOK_BYTES, WORKBOOK_PARTS
from ltsim.recordings.files import read_bytes, shown
from ltsim.recordings.xml import check_part

_MOMENTS = (datetime, date, time)
Line = tuple[int, list[str]]
"""Number of a row, from 1, and its cells up to the last that is filled."""


def workbook_cells(file: Path) -> list[tuple[str, list[Line]]]:
    """Names of the sheets of a workbook, each with the rows that hold something.

    Raises RecordError for what is no workbook, is damaged, exceeds a limit, or lacks the library that reads workbooks.
    """
    try:
        from openpyxl import load_workbook
    except ImportError:
        message = 'is a workbook, which needs the library openpyxl: pip install "ltsim[xlsx]", or save it as CSV'
        raise RecordError(message, file=file) from None
    packed = io.BytesIO(read_bytes(file))  # of a damaged file the library would leave its own handle open
    try:
        _check_parts(file, packed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # on styles and extensions, which hold no cell
            book = load_workbook(packed, read_only=True, data_only=True, keep_links=False)
            try:
                return _sheets(book, file)
            finally:
                book.close()
    except RecordError:
        raise
    except OSError as problem:
        raise RecordError(f"cannot be read ({problem.strerror or 'damaged'})", file=file) from None
    except Exception as problem:  # the library raises whatever its parts raise
        what = f"is no workbook that can be read ({type(problem).__name__}): it is damaged; save it again, or as CSV"
        raise RecordError(what, file=file) from None


def _check_parts(file: Path, packed: io.BytesIO) -> None:
    """Raise RecordError where a workbook unpacks to more than a recording ever holds, or its markup is too deep."""
    with zipfile.ZipFile(packed) as archive:
        parts = archive.infolist()
        if len(parts) > WORKBOOK_PARTS:
            raise RecordError(f"holds more than {WORKBOOK_PARTS} parts, the most that is read", file=file)
        if sum(part.file_size for part in parts) > WORKBOOK_BYTES:
            most = f"{WORKBOOK_BYTES // MIB} MiB"
            raise RecordError(f"unpacks to more than {most}, the most that is read; save the table as CSV", file=file)
        for part in parts:
            content = archive.read(part)
            if part.filename.lower().endswith(".xml") or b"<" in content.lstrip()[:4]:  # after any byte-order mark
                check_part(content, file)


def _sheets(book: Any, file: Path) -> list[tuple[str, list[Line]]]:
    """Rows of all sheets of an open workbook, counted together: several sheets may name the same part."""
    sheets = [sheet for sheet in book.worksheets if hasattr(sheet, "reset_dimensions")]
    if len(sheets) > SHEETS:
        raise RecordError(f"holds more than {SHEETS} sheets, the most that is read", file=file)
    rows = cells = characters = 0
    contents = []
    for sheet in sheets:
        sheet.reset_dimensions()  # the size that the file declares need not be true
        lines: list[Line] = []
        for number, values in enumerate(sheet.iter_rows(values_only=True), start=1):
            where = f"up to row {number} of sheet {shown(sheet.title)}"
            rows, cells = rows + 1, cells + len(values)
            if rows > LINES or cells > CELLS:
                what = f"holds more than {LINES} rows or {CELLS} cells {where}, the most that is read"
                raise RecordError(f"{what}; delete the cells far away from the table", file=file)
            texts = _texts(values)
            size = sum(map(len, texts))
            characters += size
            if size > LINE_CHARACTERS or characters > FILE_BYTES:
                most = f"{LINE_CHARACTERS} characters in a row or {FILE_BYTES // MIB} million in all"
                raise RecordError(f"holds more than {most} {where}, the most that is read", file=file)
            lines += [(number, texts)] if texts else []
        contents.append((sheet.title, lines))
    return contents


def _text(cell: object) -> str:
    """Text of a cell; a day without a clock as a date alone."""
    if isinstance(cell, datetime) and cell.time() == time():
        cell = cell.date()
    return "" if cell is None else cell.isoformat() if isinstance(cell, _MOMENTS) else str(cell).strip()


def _texts(values: tuple[Any, ...]) -> list[str]:
    """Cells of a row as text: dates in ISO form, numbers with their shortest digits, nothing behind the last."""
    texts = list(map(_text, values))
    while texts and not texts[-1]:
        texts.pop()
    return texts
