"""From a file to rows of text: encoding, separator, quotes, comments, sheets of a workbook."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ltsim.errors import RecordError
from ltsim.recording.files import is_number, read_lines, shown
from ltsim.recording.tables.cells import grouping_of, is_value

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

    `open_end` says that the last line had no line break, `grouping` which mark groups the thousands of its numbers.
    """

    file: Path
    name: str
    rows: tuple[Row, ...]
    open_end: bool = False
    grouping: str = ""


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
        if file.suffix.lower() == ".xlsx":
            from ltsim.recording.tables.workbook import rows_of_sheets  # needs a library that few need

            found += [_sheet(file, name, [Row(*row) for row in rows]) for name, rows in rows_of_sheets(file)]
        else:
            found.append(text_sheet(file))
    return found


def _sheet(file: Path, name: str, rows: Sequence[Row], *, open_end: bool = False) -> Sheet:
    return Sheet(file, name, tuple(rows), open_end, grouping_of((r.fields for r in rows), file))


def text_sheet(file: Path) -> Sheet:
    """A text file as a sheet; raises RecordError."""
    lines = read_lines(file, liberal=True)
    return _sheet(file, file.stem, list(_rows(lines, file)), open_end=bool(lines[-1]))


def _rows(lines: Sequence[str], file: Path) -> Iterator[Row]:
    separator = separator_of(lines)
    for i, line in enumerate(lines):
        comment = line.lstrip().startswith("#")
        text = line.lstrip().lstrip("#") if comment else line
        if text.strip() and not _says_separator(line):
            fields = split(text, separator)
            if len(fields) > MAX_FIELDS:
                raise RecordError(f"{len(fields)} fields, expected at most {MAX_FIELDS}", file=file, row=i + 1)
            yield Row(i + 1, fields, comment)


def _says_separator(line: str) -> bool:
    """The first line of some spreadsheets' exports: ``sep=;``."""
    return line.lower().startswith("sep=") and len(line) == 5


def separator_of(lines: Sequence[str]) -> str:
    """The separator that makes most values of most lines of one width; of equals the first of `SEPARATORS`.

    Lines of three columns count before those of two, and those before the mere number of columns.
    """
    sample = [line for line in lines[:SAMPLE] if line.strip() and not line.lstrip().startswith("#")]
    if sample and all(line.count("\t") == sample[0].count("\t") > 2 for line in sample):
        return "\t"
    width = {s: max((len(split(line, s)) for line in sample[:1]), default=0) for s in SEPARATORS[:3]}
    return max(SEPARATORS, key=lambda s: (_values(sample, s, 3), _values(sample, s, 2), width.get(s, 0)))


def _values(lines: Sequence[str], separator: str, least: int) -> int:
    """Cells that hold values in the lines of one width, of `least` columns at least, that hold most."""
    rows = [fields for fields in (split(line, separator) for line in lines) if len(fields) >= least]
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


def words_of_row(row: Row, length: int = 30) -> str:
    """A row as it can stand in a note."""
    return shown(" ".join(field for field in row.fields if field), length)


def check_whole(sheet: Sheet, width: int, *, strict: bool = False) -> None:
    """Raise RecordError where the last line has no line break and does not end as the one before it does.

    `strict` is for what programs write, who end every line.
    """
    if not sheet.open_end:
        return
    row = sheet.rows[-1]
    before = next((p for p in reversed(sheet.rows[:-1]) if len(p.fields) == width), None)
    ends = [len(r.fields[-1].replace(",", ".").partition(".")[2]) for r in (row, before) if r is not None]
    if strict or len(row.fields) != width or (len(ends) == 2 and ends[0] < ends[1]):
        raise RecordError("the file ends inside this row: it was cut", file=sheet.file, row=row.line)


def table_rows(path: Path) -> tuple[list[str], list[tuple[int, dict[str, str]]]]:
    """The header of a small table that a person wrote, and its rows by column, each with its line.

    Raises
    ------
    RecordError
        When a row has more or fewer cells than the header.
    """
    header, *rows = [row for row in text_sheet(path).rows if not row.comment]
    for row in rows:
        check_width(row, len(header.fields), path)
    return list(header.fields), [(r.line, dict(zip(header.fields, r.fields, strict=True))) for r in rows]


def check_width(row: Row, width: int, file: object) -> None:
    """Raise RecordError where a row has another number of cells than the header."""
    if len(row.fields) != width:
        raise RecordError(f"{len(row.fields)} fields, expected {width} as in the header", file=file, row=row.line)
