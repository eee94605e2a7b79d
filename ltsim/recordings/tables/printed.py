"""Pointings as a table prints them, column by column: names, faces, texts, and numbers to their last digit.

Numbers are held as the digits that the cells print (12 bytes where a decimal object takes 100), so that what is
computed from them is exact, and an array of them becomes floating-point numbers at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from decimal import MAX_PREC, Decimal, localcontext
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ltsim.core.arrays import Floats, Ints
from ltsim.recordings.files import SourceLocation
from ltsim.recordings.tables.header import PLACE, READINGS, TableColumn

Digits = NDArray[np.bytes_]
"""Numbers (n,) as decimal digits in ASCII; empty where nothing is printed."""
T = TypeVar("T")
EXACT = 2**51
"""Size up to which a product of floating-point numbers rounds to the integer that is meant."""
LARGEST_TURN = 720.0
"""[deg] Size of sums of angles."""
BLOCK = 8192
"""Rows that are converted together: what lies between text and columns takes memory for so many rows alone."""


def as_digits(texts: Sequence[str]) -> Digits:
    """Numbers (n,) by their text, which `Decimal` reads."""
    return np.array(texts, dtype=np.bytes_)


def as_floats(digits: Digits) -> Floats:
    """The nearest floating-point numbers (n,); NaN where nothing is printed."""
    values = np.full(len(digits), np.nan)
    filled = digits != b""
    values[filled] = digits[filled].astype(np.float64)
    return values


def as_decimals(digits: Digits) -> Iterator[Decimal | None]:
    """Exact numbers, None where nothing is printed."""
    for start in range(0, len(digits), BLOCK):
        for text in digits[start : start + BLOCK].astype(np.str_).tolist():
            yield Decimal(text) if text else None


def exactly(
    digits: Digits, factor: Decimal, function: Callable[[Any, int], Any] = lambda products, unit: products
) -> Floats:
    """The nearest floating-point numbers (n,) to a function of products with a factor; NaN where nothing is printed.

    The function takes the products as integers (n,), whose unit is their last digit, and the integer that is 1.0.
    """
    values = np.full(len(digits), np.nan)
    filled = digits != b""
    exponent = factor.as_tuple().exponent
    multiplier = int(factor.scaleb(-int(exponent))) * 10 ** max(int(exponent), 0)
    places = max(int(decimal_places(digits[filled]).max(initial=0)), 0)
    unit = 10 ** (places + max(-int(exponent), 0))
    values[filled] = function(_integers(digits[filled], places, multiplier, unit), unit) / unit
    return values


def _integers(digits: Digits, places: int, multiplier: int, unit: int) -> NDArray[Any]:
    """Numbers (n,) without decimal point times a multiplier: int64 where floats hold all, else Python integers."""
    values = as_floats(digits)
    if unit * multiplier * int(np.abs(values).max(initial=LARGEST_TURN)) < EXACT:
        return np.rint(values * 10**places).astype(np.int64) * multiplier
    with localcontext(prec=MAX_PREC):
        whole = [int(number.scaleb(places)) * multiplier for number in as_decimals(digits) if number is not None]
    return np.array([*whole, None])[:-1]  # of Python's integers, which an array of them alone would cut


def decimal_places(digits: Digits) -> Ints:
    """Place of the last digit (n,) behind the decimal point; negative where it stands before it."""
    if np.any(np.char.find(digits, b"e") >= 0) or np.any(np.char.find(digits, b"E") >= 0):
        return np.array([-int(number.as_tuple().exponent) for number in as_decimals(digits) if number is not None])
    point = np.char.find(digits, b".")
    return np.where(point < 0, 0, np.char.str_len(digits) - point - 1)


@dataclass
class PrintedPointings:
    """Pointings as their rows print them: columns of n entries, numbers by role in the units of their columns."""

    file: list[Path] = field(default_factory=list)
    line: list[int] = field(default_factory=list)
    station: list[str] = field(default_factory=list)
    target: list[str] = field(default_factory=list)
    face: list[int] = field(default_factory=list)
    """0 where none is given."""
    moment: list[str] = field(default_factory=list)
    round: list[str] = field(default_factory=list)
    """Round of its station that each belongs to: a number, perhaps with a day."""
    grouping: list[str] = field(default_factory=list)
    """Mark that groups thousands in the sheet of each, '' for none."""
    numbers: dict[str, Digits] = field(default_factory=dict)
    further: dict[str, list[str]] = field(default_factory=dict)
    """Cells of further columns by their title, '' where the row has none."""

    def __len__(self) -> int:
        return len(self.line)

    def place(self, index: int) -> SourceLocation:
        """File and row of a pointing."""
        return SourceLocation(self.file[index], self.line[index])

    def of(self, roles: Sequence[str]) -> Digits:
        """Printed text of each row in the first of the roles that it holds."""
        digits: Digits = np.zeros(len(self), dtype="S1")
        for role in roles:
            if role in self.numbers:
                digits = np.where(digits == b"", self.numbers[role], digits)
        return digits

    def texts(self, title: str) -> list[str]:
        """Cells of a further column; '' where the table has none of this title."""
        return self.further.get(title) or [""] * len(self)

    @property
    def lists(self) -> tuple[list[Any], ...]:
        """Columns that every row has, in the order of the fields."""
        names = (self.station, self.target)
        return (self.file, self.line, *names, self.face, self.moment, self.round, self.grouping)

    @property
    def source(self) -> list[str]:
        """File and line of each pointing."""
        names = {key: file.name for key, file in dict(zip(map(id, self.file), self.file, strict=True)).items()}
        return [f"{names[key]}, line {line}" for key, line in zip(map(id, self.file), self.line, strict=True)]

    def take(self, order: Iterable[int]) -> PrintedPointings:
        """The pointings at some places, in that order."""
        places = list(order)
        lists: list[Any] = [[column[i] for i in places] for column in self.lists]
        numbers = {role: digits[places] for role, digits in self.numbers.items()}
        further = {title: [column[i] for i in places] for title, column in self.further.items()}
        return PrintedPointings(*[*lists, numbers, further])


def joined(parts: Sequence[PrintedPointings]) -> PrintedPointings:
    """Pointings one after another; a column that some parts lack is empty there."""
    if len(parts) == 1:
        return parts[0]
    lists: list[Any] = [_chained(columns) for columns in zip(*(part.lists for part in parts), strict=True)]
    roles = dict.fromkeys(role for part in parts for role in part.numbers)
    titles = dict.fromkeys(title for part in parts for title in part.further)
    numbers = {
        role: np.concatenate([part.numbers.get(role, np.zeros(len(part), dtype="S1")) for part in parts])
        for role in roles
    }
    further = {title: _chained(part.texts(title) for part in parts) for title in titles}
    return PrintedPointings(*[*lists, numbers, further])


def _chained(columns: Iterable[list[T]]) -> list[T]:
    return list(chain.from_iterable(columns))


def codes(values: Iterable[T]) -> tuple[list[T], Ints]:
    """Distinct values in the order in which they appear, and the place of each value among them."""
    places: dict[T, int] = {}
    indices = [places.setdefault(value, len(places)) for value in values]
    return list(places), np.array(indices, dtype=np.int64)


@dataclass
class PointingTable:
    """All pointings of a file or folder, the columns they came from, and the lines that were not read."""

    columns: list[TableColumn]
    pointings: PrintedPointings = field(default_factory=PrintedPointings)
    unread: list[str] = field(default_factory=list)
    nameless: bool = False
    positional: bool = False
    marks: dict[str, str] = field(default_factory=dict)
    """Name of the mark under each set-up whose name differs from it."""
    notes: list[str] = field(default_factory=list)
    marked: set[str] = field(default_factory=set)
    """Headers without a unit over angles with marks of degrees and minutes."""

    def column(self, kind: Sequence[str]) -> TableColumn | None:
        """The first column of one of the roles."""
        return next((c for c in self.columns if c.role in kind), None)

    @property
    def holds_places(self) -> bool:
        """True where it holds coordinates in place of readings."""
        return {*PLACE} <= {c.role for c in self.columns}

    @property
    def mark(self) -> list[str]:
        """Name of the mark under the set-up of each pointing."""
        return [self.marks.get(station, station) for station in self.pointings.station]

    def take(self, columns: Sequence[TableColumn], file: object, row: int | None = None) -> None:
        """A further header: of the same roles and units, perhaps with more columns, which are retained.

        Raises RecordError where it holds other readings, or in other units.
        """
        before, here = (
            [(c.role, c.unit, c.face) for c in all_ if c.role in READINGS] for all_ in (self.columns, columns)
        )
        if before and before != here:
            message = "its columns differ from those of the headers before, expected the same roles and units"
            raise SourceLocation(file, row).error(message)
        titles = {c.title for c in self.columns}
        self.columns += [c for c in columns if c.title not in titles]

    def add(self, other: PointingTable, file: object) -> None:
        """Add the columns of a further sheet and its notes; raises RecordError."""
        self.take(other.columns, file)
        self.unread += other.unread
        self.notes += [note for note in other.notes if note not in self.notes]
        self.nameless |= other.nameless
        self.marked |= other.marked
        self.positional |= other.positional
