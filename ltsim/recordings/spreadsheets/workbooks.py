"""Rows of workbooks (xlsx): safety checks of the archive and its XML parts, and texts of the cells."""

from __future__ import annotations

import io
import warnings
import zipfile
from datetime import date, datetime, time
from pathlib import Path
from typing import Any

from defusedxml.ElementTree import DefusedXMLParser

from ltsim.core.errors import RecordError
from ltsim.core.limits import (
    BYTES_PER_MIB,
    MAX_FILE_BYTES,
    MAX_LINE_CHARACTERS,
    MAX_TEXT_LINES,
    MAX_WORKBOOK_BYTES,
    MAX_WORKBOOK_CELLS,
    MAX_WORKBOOK_ELEMENTS,
    MAX_WORKBOOK_PARTS,
    MAX_WORKBOOK_ROW_CELLS,
    MAX_WORKBOOK_SHEETS,
)
from ltsim.recordings.files import read_bytes, safe_excerpt
from ltsim.recordings.xml import DepthCheck, check_tag_attributes

_DATE_TYPES = (datetime, date, time)
"""Types of cell values that are dates or times."""
WorkbookRow = tuple[int, list[str]]
"""Number of a row (from 1), and its cells up to the last one that is not empty."""


def workbook_rows_by_sheet(file: Path) -> list[tuple[str, list[WorkbookRow]]]:
    """Name of each sheet of a workbook, with the rows that are not empty.

    Raises RecordError for a file that is not a workbook, is damaged or exceeds a limit, and if the library that reads
    workbooks is not installed.
    """
    try:
        from openpyxl import load_workbook
    except ImportError:
        message = 'is a workbook, which needs the library openpyxl: pip install "ltsim[xlsx]", or save it as CSV'
        raise RecordError(message, file=file) from None
    packed = io.BytesIO(read_bytes(file))  # of a damaged file the library would leave its own handle open
    try:
        checked = _checked_archive(file, packed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # on styles and extensions, which hold no cell
            book = load_workbook(checked, read_only=True, data_only=True, keep_links=False)
            try:
                return _read_workbook_sheets(book, file)
            finally:
                book.close()
    except RecordError:
        raise
    except OSError as problem:
        raise RecordError(f"the file cannot be read ({problem.strerror or 'damaged'})", file=file) from None
    except Exception as problem:  # the library raises whatever its parts raise
        what = f"is not a readable workbook ({type(problem).__name__}): it is damaged; save it again, or as CSV"
        raise RecordError(what, file=file) from None


def _read_workbook_sheets(book: Any, file: Path) -> list[tuple[str, list[WorkbookRow]]]:
    """Name and rows of each sheet of an open workbook; raises RecordError.

    The limits on rows, cells and characters apply to all sheets together.
    """
    sheets = [sheet for sheet in book.worksheets if hasattr(sheet, "reset_dimensions")]
    if len(sheets) > MAX_WORKBOOK_SHEETS:
        raise RecordError(f"the file holds more than {MAX_WORKBOOK_SHEETS} sheets, the limit for reading", file=file)
    if len({getattr(sheet, "_worksheet_path", sheet.title) for sheet in sheets}) < len(sheets):  # read once per sheet
        raise RecordError(
            "the file holds two sheets with the same content part: it is damaged; save it again", file=file
        )
    rows = cells = characters = 0
    contents = []
    for sheet in sheets:
        sheet.reset_dimensions()  # the size that the file declares need not be true
        lines: list[WorkbookRow] = []
        for number, values in enumerate(sheet.iter_rows(values_only=True), start=1):
            where = f"up to row {number} of sheet {safe_excerpt(sheet.title)}, the limit for reading"
            rows, cells = rows + 1, cells + len(values)
            if rows > MAX_TEXT_LINES or cells > MAX_WORKBOOK_CELLS:
                what = f"the file holds more than {MAX_TEXT_LINES} rows or {MAX_WORKBOOK_CELLS} cells {where}"
                raise RecordError(f"{what}; delete the cells far away from the table", file=file)
            texts = _cell_texts(values)
            size = sum(map(len, texts))
            characters += size
            if size > MAX_LINE_CHARACTERS or characters > MAX_FILE_BYTES:
                most = f"{MAX_LINE_CHARACTERS} characters in a row or {MAX_FILE_BYTES // BYTES_PER_MIB} million in all"
                raise RecordError(f"the file holds more than {most} {where}", file=file)
            lines += [(number, texts)] if texts else []
        contents.append((sheet.title, lines))
    return contents


def _cell_text(cell: object) -> str:
    """Text of a cell's value; a date with the time 0:00 becomes a date without time."""
    if isinstance(cell, datetime) and cell.time() == time():
        cell = cell.date()
    return "" if cell is None else cell.isoformat() if isinstance(cell, _DATE_TYPES) else str(cell).strip()


def _cell_texts(cell_values: tuple[Any, ...]) -> list[str]:
    """Texts of the cells of a row: ISO dates, numbers with as few digits as possible, no empty cells at the end."""
    texts = list(map(_cell_text, cell_values))
    while texts and not texts[-1]:
        texts.pop()
    return texts


def _checked_archive(file: Path, workbook_archive: io.BytesIO) -> io.BytesIO:
    """New archive with the parts of a workbook, after checks of their number, unpacked size and XML; or RecordError.

    The parts are packed again, because the library would unpack them without regard to the declared size.
    """
    checked = io.BytesIO()
    with zipfile.ZipFile(workbook_archive) as archive, zipfile.ZipFile(checked, "w") as copy:
        parts = archive.infolist()
        if len(parts) > MAX_WORKBOOK_PARTS:
            raise RecordError(f"the file holds more than {MAX_WORKBOOK_PARTS} parts, the limit for reading", file=file)
        if sum(part.file_size for part in parts) > MAX_WORKBOOK_BYTES:
            most = f"{MAX_WORKBOOK_BYTES // BYTES_PER_MIB} MiB"
            raise RecordError(
                f"the file unpacks to more than {most}, the limit for reading; save the table as CSV", file=file
            )
        for part in {part.filename: part for part in parts}.values():
            if part.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise RecordError("the file is packed in a way that spreadsheets do not use; save it again", file=file)
            with archive.open(part) as stream:
                content = stream.read(part.file_size + 1)
            if part.filename.lower().endswith(".xml") or b"<" in content.lstrip()[:4]:  # after any byte-order mark
                _check_xml(content, file)
            copy.writestr(part.filename, content)
    checked.seek(0)
    return checked


class _WorkbookCheck(DepthCheck):
    """Parser target that limits the numbers of elements, and of cells in a row, of a workbook; raises RecordError.

    The library that reads workbooks would hold all of them in memory.
    """

    def __init__(self, file: Path) -> None:
        super().__init__(file)
        self.n_elements = self._n_cells = 0

    def start(self, tag: Any, attributes: Any) -> None:
        super().start(tag, attributes)
        name = str(tag).rpartition("}")[2]
        self.n_elements += 1
        self._n_cells = 0 if name == "row" else self._n_cells + (name == "c")
        if self.n_elements > MAX_WORKBOOK_ELEMENTS or self._n_cells > MAX_WORKBOOK_ROW_CELLS:
            most = f"{MAX_WORKBOOK_ELEMENTS} XML elements, or {MAX_WORKBOOK_ROW_CELLS} cells in a row"
            raise RecordError(
                f"the file holds more than {most}, the limit for reading; save the table as CSV", file=self._file
            )


def _check_xml(content: bytes, file: Path) -> None:
    """Check of an XML part of a workbook (entities, encoding, numbers of elements, depth) before a library parses it.

    Raises RecordError, or ParseError if the text is not well formed.
    """
    if b"\x00" in content:
        raise RecordError("the file contains a part that is not UTF-8", file=file)
    check_tag_attributes(content, file)
    parser = DefusedXMLParser(target=_WorkbookCheck(file))
    parser.feed(content)
    parser.close()
