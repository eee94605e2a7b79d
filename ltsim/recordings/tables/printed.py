"""Pointings as they are in a table, column by column: names, faces, texts, and numbers with all digits.

Numbers are stored as the digits of the cells (12 bytes; a decimal object takes 100), so that computations with them are
exact, and an array of them is converted to floating point at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import MAX_PREC, Decimal, localcontext
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ltsim.core.arrays import Floats, Ints
from ltsim.recordings.files import SourceLocation, quoted_text
from ltsim.recordings.tables.header import COORDINATE_ROLES, READING_ROLES, TableColumn

Digits = NDArray[np.bytes_]
"""Numbers (n,) as decimal digits in ASCII; empty for a missing number."""
ValueType = TypeVar("ValueType")
MAX_EXACT_PRODUCT = 2**51
"""Magnitude up to which a product of floating-point numbers is rounded to the correct integer."""
MAX_ANGLE_SUM = 720.0
"""Largest magnitude [deg] of sums of angles."""
ROWS_PER_BATCH = 8192
"""Number of rows that are converted together, which bounds the memory of intermediate results."""


def to_digits(texts: Sequence[str]) -> Digits:
    """Numbers (n,) kept as their decimal text, so that no digit is lost."""
    return np.array(texts, dtype=np.bytes_)


def to_floats(digits: Digits) -> Floats:
    """Nearest floating-point numbers (n,); NaN for missing ones."""
    values = np.full(len(digits), np.nan)
    filled = digits != b""
    values[filled] = digits[filled].astype(np.float64)
    return values


def to_decimals(digits: Digits) -> Iterator[Decimal | None]:
    """Exact numbers; None for missing ones."""
    for start in range(0, len(digits), ROWS_PER_BATCH):
        for text in digits[start : start + ROWS_PER_BATCH].astype(np.str_).tolist():
            yield Decimal(text) if text else None


def apply_exactly(
    digits: Digits, factor: Decimal, function: Callable[[Any, int], Any] = lambda products, unit: products
) -> Floats:
    """Nearest floating-point numbers (n,) to a function of products with a factor; NaN for missing ones.

    The arguments of the function are the products as integers (n,) in units of their last digit, and the integer that
    represents 1.0.
    """
    values = np.full(len(digits), np.nan)
    filled = digits != b""
    exponent = factor.as_tuple().exponent
    multiplier = int(factor.scaleb(-int(exponent))) * 10 ** max(int(exponent), 0)
    places = max(int(decimal_places(digits[filled]).max(initial=0)), 0)
    unit = 10 ** (places + max(-int(exponent), 0))
    values[filled] = function(_scaled_integers(digits[filled], places, multiplier, unit), unit) / unit
    return values


def _scaled_integers(digits: Digits, places: int, multiplier: int, unit: int) -> NDArray[Any]:
    """Numbers (n,) without decimal point, times a multiplier: int64 if floats are exact, otherwise Python integers."""
    values = to_floats(digits)
    if unit * multiplier * int(np.abs(values).max(initial=MAX_ANGLE_SUM)) < MAX_EXACT_PRODUCT:
        return np.rint(values * 10**places).astype(np.int64) * multiplier
    with localcontext(prec=MAX_PREC):
        whole = [int(number.scaleb(places)) * multiplier for number in to_decimals(digits) if number is not None]
    return np.array([*whole, None])[:-1]  # of Python's integers, which an array of them alone would cut


def decimal_places(digits: Digits) -> Ints:
    """Number of decimals (n,); negative if the last digit is before the decimal point."""
    if np.any(np.char.find(digits, b"e") >= 0) or np.any(np.char.find(digits, b"E") >= 0):
        return np.array([-int(number.as_tuple().exponent) for number in to_decimals(digits) if number is not None])
    point = np.char.find(digits, b".")
    return np.where(point < 0, 0, np.char.str_len(digits) - point - 1)


@dataclass
class PrintedPointings:
    """Pointings as they are in a table: columns of n entries, numbers by role in the units of their columns."""

    file: list[Path] = field(default_factory=list)
    line: list[int] = field(default_factory=list)
    station: list[str] = field(default_factory=list)
    target: list[str] = field(default_factory=list)
    face: list[int] = field(default_factory=list)
    """Face of each pointing; 0 if not given."""
    moment: list[str] = field(default_factory=list)
    round: list[str] = field(default_factory=list)
    """Round of the station to which each pointing belongs: a number, possibly with a day."""
    grouping: list[str] = field(default_factory=list)
    """Thousands separator in the sheet of each pointing, '' for none."""
    numbers: dict[str, Digits] = field(default_factory=dict)
    additional_cells: dict[str, list[str]] = field(default_factory=dict)
    """Cells of additional columns by title; '' for a row without one."""

    def __len__(self) -> int:
        return len(self.line)

    def source_location(self, index: int) -> SourceLocation:
        """File and row of a pointing."""
        return SourceLocation(self.file[index], self.line[index])

    def digits_of_roles(self, roles: Sequence[str]) -> Digits:
        """Digits of each row in the first of the roles that it has."""
        digits: Digits = np.zeros(len(self), dtype="S1")
        for role in roles:
            if role in self.numbers:
                digits = np.where(digits == b"", self.numbers[role], digits)
        return digits

    def texts(self, title: str) -> list[str]:
        """Cells of an additional column; '' in a table without this title."""
        return self.additional_cells.get(title) or [""] * len(self)

    @property
    def complete_columns(self) -> tuple[list[Any], ...]:
        """Columns that every row has, in the order of the fields."""
        names = (self.station, self.target)
        return (self.file, self.line, *names, self.face, self.moment, self.round, self.grouping)

    @property
    def source(self) -> list[str]:
        """File and line of each pointing."""
        names = {key: file.name for key, file in dict(zip(map(id, self.file), self.file, strict=True)).items()}
        return [f"{names[key]}, line {line}" for key, line in zip(map(id, self.file), self.line, strict=True)]

    def take(self, order: Iterable[int]) -> PrintedPointings:
        """Pointings at some positions, in that order."""
        places = list(order)
        lists: list[Any] = [[column[i] for i in places] for column in self.complete_columns]
        numbers = {role: digits[places] for role, digits in self.numbers.items()}
        further = {title: [column[i] for i in places] for title, column in self.additional_cells.items()}
        return PrintedPointings(*[*lists, numbers, further])


def join_pointings(tables: Sequence[PrintedPointings]) -> PrintedPointings:
    """Pointings of several parts in sequence; a column that a part lacks is empty there."""
    if len(tables) == 1:
        return tables[0]
    lists: list[Any] = [
        _concatenate(columns) for columns in zip(*(part.complete_columns for part in tables), strict=True)
    ]
    roles = dict.fromkeys(role for part in tables for role in part.numbers)
    titles = dict.fromkeys(title for part in tables for title in part.additional_cells)
    numbers = {
        role: np.concatenate([part.numbers.get(role, np.zeros(len(part), dtype="S1")) for part in tables])
        for role in roles
    }
    further = {title: _concatenate(part.texts(title) for part in tables) for title in titles}
    return PrintedPointings(*[*lists, numbers, further])


def _concatenate(columns: Iterable[list[ValueType]]) -> list[ValueType]:
    return list(chain.from_iterable(columns))


def indices_by_value(values: Iterable[ValueType]) -> tuple[list[ValueType], Ints]:
    """Distinct values in order of appearance, and the index of each value among them."""
    places: dict[ValueType, int] = {}
    indices = [places.setdefault(value, len(places)) for value in values]
    return list(places), np.array(indices, dtype=np.int64)


@dataclass
class PointingTable:
    """All pointings of a file or folder, their columns, and the lines that were not read."""

    columns: list[TableColumn]
    pointings: PrintedPointings = field(default_factory=PrintedPointings)
    unread: list[str] = field(default_factory=list)
    nameless: bool = False
    positional: bool = False
    has_unnamed_targets: bool = False
    """True if no row names its target."""
    marks: dict[str, str] = field(default_factory=dict)
    """Name of the mark under each set-up, if it differs from that of the set-up."""
    notes: list[str] = field(default_factory=list)
    cell_units: dict[str, str] = field(default_factory=dict)
    """Units that marks in the cells give, by title."""

    def column(self, kind: Sequence[str]) -> TableColumn | None:
        """First column with one of the roles; None if there is none."""
        return next((c for c in self.columns if c.role in kind), None)

    @property
    def has_coordinates(self) -> bool:
        """True for a table with coordinates in place of readings."""
        return {*COORDINATE_ROLES} <= {c.role for c in self.columns}

    @property
    def mark(self) -> list[str]:
        """Name of the mark under the set-up of each pointing."""
        return [self.marks.get(station, station) for station in self.pointings.station]

    def add_header(self, columns: Sequence[TableColumn], file: object, row: int | None = None) -> None:
        """Addition of another header: with equal roles and units, and possibly additional columns, which are retained.

        Raises RecordError if its readings or units differ.
        """
        before, here = (
            [(c.role, c.unit, c.face) for c in all_ if c.role in READING_ROLES] for all_ in (self.columns, columns)
        )
        if before and before != here:
            message = "its columns differ from those of the headers before, expected the same roles and units"
            raise SourceLocation(file, row).error(message)
        titles = {c.title for c in self.columns}
        self.columns += [c for c in columns if c.title not in titles]

    def add_cell_units(self, units: Mapping[str, str], file: object) -> None:
        """Addition of units that marks in further cells give; raises RecordError if they differ from those before."""
        for title, unit in units.items():
            before = self.cell_units.setdefault(title, unit)
            if before != unit:
                message = f"has cells in {before} and in {unit}, expected one unit"
                raise SourceLocation(file, None).error(message, quoted_text(title))

    def add_sheet(self, sheet: PointingTable, file: object) -> None:
        """Addition of the columns and notes of another sheet; raises RecordError."""
        self.add_header(sheet.columns, file)
        self.unread += sheet.unread
        self.notes += [note for note in sheet.notes if note not in self.notes]
        self.nameless |= sheet.nameless
        self.add_cell_units(sheet.cell_units, file)
        self.positional |= sheet.positional
