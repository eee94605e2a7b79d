"""Tables of results as CSV, each with the definition of its columns: one writer, one reader.

A spreadsheet takes a cell that begins with ``=``, ``+``, ``-`` or ``@`` for a formula. A text that begins so is
written with an apostrophe before it, as is one that begins with an apostrophe; the reader takes it away.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import RecordError
from ltsim.recording.files import read_text, shown

FORMULA = ("=", "+", "-", "@", "'")


@dataclass(frozen=True)
class Column:
    """One column: its name in the header, what a cell holds and means, and how a number is written (`r`: in full)."""

    name: str
    about: str
    kind: Literal["text", "number"] = "number"
    form: str = ""

    def cell(self, value: Any) -> Any:
        """A value as it stands in the file: nothing for what does not exist."""
        if value is None or (isinstance(value, float) and not math.isfinite(value)):
            return ""
        if self.kind == "text":
            return guarded(str(value))
        if self.form:
            return repr(float(value)) if self.form == "r" else format(value, self.form)
        return f"{value:.6g}" if isinstance(value, float) and abs(value) < 1e4 else value


def texts(**columns: str) -> tuple[Column, ...]:
    """Columns of text: name and what it means."""
    return tuple(Column(name, about, "text") for name, about in columns.items())


def numbers(form: str = "", **columns: str) -> tuple[Column, ...]:
    """Columns of numbers, all written in one form: name and what it means."""
    return tuple(Column(name, about, "number", form) for name, about in columns.items())


@dataclass(frozen=True)
class ResultTable:
    """A table of a result: its file, what it is about, its columns."""

    file: str
    about: str
    columns: tuple[Column, ...]

    @property
    def header(self) -> list[str]:
        """Names of the columns."""
        return [column.name for column in self.columns]

    def text(self, rows: Iterable[Sequence[Any]]) -> str:
        """The content of the file."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([guarded(name) for name in self.header])
        for row in rows:
            writer.writerow([column.cell(value) for column, value in zip(self.columns, row, strict=True)])
        return stream.getvalue()

    def read(self, file: Path) -> tuple[dict[str, list[str]], dict[str, Floats]]:
        """Columns of text and of numbers (NaN where a cell is empty), by name.

        Raises
        ------
        RecordError
            When a column is missing or a cell holds no number where one should be.
        """
        reader = csv.DictReader(io.StringIO(read_text(file)), restval="")
        missing = [name for name in self.header if name not in (reader.fieldnames or ())]
        if missing:
            raise RecordError(f"there is no column {missing[0]}; expected {','.join(self.header)}", file=file)
        try:
            rows = list(reader)
        except csv.Error as problem:
            raise RecordError(f"is not CSV ({problem})", file=file) from None
        words = {c.name: [plain(row[c.name]) for row in rows] for c in self.columns if c.kind == "text"}
        return words, {c.name: _numbers(rows, c.name, file) for c in self.columns if c.kind == "number"}


def guarded(text: str) -> str:
    """A text that no spreadsheet takes for a formula."""
    return f"'{text}" if text.startswith(FORMULA) else text


def plain(text: str) -> str:
    """The text that was guarded."""
    return text[1:] if text.startswith("'") and text[1:].startswith(FORMULA) else text


def _numbers(rows: Sequence[dict[str, str]], name: str, file: Path) -> Floats:
    values = np.full(len(rows), np.nan)
    for i, row in enumerate(rows):
        try:
            values[i] = float(row[name] or "nan")
        except ValueError:
            raise RecordError(f"'{shown(row[name])}' is no number", file=file, row=i + 1, column=name) from None
    return values
