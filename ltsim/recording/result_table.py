"""Tables of results in files: `Table` of `ltsim.results` with rows given or read at once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ltsim.arrays import Floats
from ltsim.recording.files import read_text
from ltsim.results import Column as Column, Table, numbers as numbers, texts as texts


@dataclass(frozen=True)
class ResultTable(Table):
    """A table as older code writes and reads it; new code fills a `Table`."""

    def text(self, rows: Iterable[Sequence[Any]] = ()) -> str:
        """The content of the file."""
        return self.filled(rows).csv()

    def read(self, file: Path) -> tuple[dict[str, list[str]], dict[str, Floats]]:
        """Columns of text and of numbers (NaN where a cell is empty), by name; raises RecordError."""
        found = self.parsed(read_text(file), file)
        words = {c.name: found.column(c.name) for c in self.columns if c.kind == "text"}
        return words, {c.name: found.numbers(c.name)[:, 0] for c in self.columns if c.kind == "number"}
