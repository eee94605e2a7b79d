"""Pointings of a table before the conversion of units, as columns of names, faces, texts and exact numbers.

Numbers are stored as the digits in the cells, so that conversions are exact. A number takes 12 bytes (100 as a decimal
object), and a whole array is converted to floating point at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import MAX_PREC, Decimal, localcontext
from itertools import chain
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from ltsim.core.arrays import Floats, Ints
from ltsim.recordings.files import SourceLocation, safe_excerpt
from ltsim.recordings.spreadsheets.header import COORDINATE_ROLES, READING_ROLES, TableColumn

DigitTexts = NDArray[np.bytes_]
"""Array (n,) of n numbers as texts of decimal digits in ASCII; the text is empty for a missing number."""
ValueType = TypeVar("ValueType")
"""Type of the values in a list."""
MAX_EXACT_FLOAT_PRODUCT = 2**51
"""Limit of the magnitude of a floating-point product. Below it the product is rounded to the correct integer; larger
products are computed with integers of Python."""
MAX_ANGLE_SUM_DEG = 720.0
"""Largest magnitude [deg] of a sum of angles in a conversion; the integers of exact conversions need digits for it."""
ROWS_PER_BATCH = 8192
"""Number of rows that are converted at a time, to limit the memory."""


def to_digit_texts(texts: Sequence[str]) -> DigitTexts:
    """Array (n,) of n texts of decimal digits."""
    return np.array(texts, dtype=np.bytes_)


def to_floats(digits: DigitTexts) -> Floats:
    """Floating-point numbers (n,) nearest to the n numbers in `digits`; NaN for a missing number."""
    numbers = np.full(len(digits), np.nan)
    filled = digits != b""
    numbers[filled] = digits[filled].astype(np.float64)
    return numbers


def to_decimals(digits: DigitTexts) -> Iterator[Decimal | None]:
    """Exact decimal number of each entry of `digits`; None for a missing number."""
    for start in range(0, len(digits), ROWS_PER_BATCH):
        for text in digits[start : start + ROWS_PER_BATCH].astype(np.str_).tolist():
            yield Decimal(text) if text else None


def apply_exactly(
    digits: DigitTexts, factor: Decimal, function: Callable[[Any, int], Any] = lambda products, unit: products
) -> Floats:
    """Floating-point numbers (n,) nearest to exact results of `function(digits * factor)`; NaN for a missing number.

    `function` gets two arguments: the products (n,) as integers, in units of their last digit, and the integer that
    represents 1.0. By default it returns the products.
    """
    numbers = np.full(len(digits), np.nan)
    filled = digits != b""
    exponent = factor.as_tuple().exponent
    multiplier = int(factor.scaleb(-int(exponent))) * 10 ** max(int(exponent), 0)
    n_decimals = max(int(decimal_places(digits[filled]).max(initial=0)), 0)
    unit = 10 ** (n_decimals + max(-int(exponent), 0))
    numbers[filled] = function(_scaled_integers(digits[filled], n_decimals, multiplier, unit), unit) / unit
    return numbers


def _scaled_integers(digits: DigitTexts, n_decimals: int, multiplier: int, unit: int) -> NDArray[Any]:
    """Integers (n,): the n numbers in `digits`, multiplied by 10^`n_decimals` and by `multiplier`.

    They are int64 if floating-point arithmetic is exact, otherwise integers of Python. `unit` is the integer that
    represents 1.0 after the multiplication.
    """
    numbers = to_floats(digits)
    if unit * multiplier * int(np.abs(numbers).max(initial=MAX_ANGLE_SUM_DEG)) < MAX_EXACT_FLOAT_PRODUCT:
        return np.rint(numbers * 10**n_decimals).astype(np.int64) * multiplier
    with localcontext(prec=MAX_PREC):
        integers = [int(number.scaleb(n_decimals)) * multiplier for number in to_decimals(digits) if number is not None]
    return np.array([*integers, None])[:-1]  # of Python's integers, which an array of them alone would cut


def decimal_places(digits: DigitTexts) -> Ints:
    """Number (n,) of decimals of each of n numbers; negative for 12e3, whose last digit is before the decimal point."""
    if np.any(np.char.find(digits, b"e") >= 0) or np.any(np.char.find(digits, b"E") >= 0):
        return np.array([-int(number.as_tuple().exponent) for number in to_decimals(digits) if number is not None])
    point = np.char.find(digits, b".")
    return np.where(point < 0, 0, np.char.str_len(digits) - point - 1)


@dataclass
class UnconvertedPointings:
    """Pointings of a table before the conversion of units: lists of n entries, numbers in the table's units."""

    file: list[Path] = field(default_factory=list)
    line: list[int] = field(default_factory=list)
    station: list[str] = field(default_factory=list)
    target: list[str] = field(default_factory=list)
    face: list[int] = field(default_factory=list)
    """Face (1 or 2) of each pointing; 0 if not given."""
    date_and_time: list[str] = field(default_factory=list)
    """Date, time or both of each pointing, as text."""
    round_label: list[str] = field(default_factory=list)
    """Label of the round (set of directions from one station to several targets) of each pointing.

    It is the number of the round in the table, with the day if the table gives one.
    """
    thousands_separator: list[str] = field(default_factory=list)
    """Thousands separator in the sheet of each pointing; '' for none."""
    digit_texts_by_role: dict[str, DigitTexts] = field(default_factory=dict)
    """Numbers (n,) of each column of readings or heights, as texts of digits, by role (content) of the column."""
    additional_cells: dict[str, list[str]] = field(default_factory=dict)
    """Cells of the additional columns, by title; '' for a row without cell."""

    def __len__(self) -> int:
        return len(self.line)

    def source_location(self, index: int) -> SourceLocation:
        """File and line of the pointing with this index."""
        return SourceLocation(self.file[index], self.line[index])

    def name_indices(self, kind: Literal["station", "target"]) -> Ints:
        """Index (n,) of the station or target of each of n pointings, numbered in order of first occurrence.

        Raises RecordError for an invalid name, with its line.
        """
        names, indices = distinct_with_indices(self.station if kind == "station" else self.target)
        _, first = np.unique(indices, return_index=True)
        for name, row in zip(names, first.tolist(), strict=True):
            self.source_location(row).checked_name(name, kind, kind)
        return indices

    def digit_texts_of_roles(self, roles: Sequence[str]) -> DigitTexts:
        """Number (n,) of each of n rows, as digits, in its first filled column with one of these roles."""
        digits: DigitTexts = np.zeros(len(self), dtype="S1")
        for role in roles:
            if role in self.digit_texts_by_role:
                digits = np.where(digits == b"", self.digit_texts_by_role[role], digits)
        return digits

    @property
    def every_round_has_single_pointing(self) -> bool:
        """True if every round of measurements has one pointing, in a table with several targets."""
        rounds = {*zip(self.station, self.round_label, strict=True)}
        return len(rounds) == len(self) and len({*self.target}) > 1

    def additional_cell_texts(self, title: str) -> list[str]:
        """Cells, n texts, of the additional column with this title; all are '' if there is no such column."""
        return self.additional_cells.get(title) or [""] * len(self)

    @property
    def complete_columns(self) -> tuple[list[Any], ...]:
        """Lists with an entry for every row (file, line, station, ...), in the order of the fields of this class."""
        names = (self.station, self.target)
        return (self.file, self.line, *names, self.face, self.date_and_time, self.round_label, self.thousands_separator)

    @property
    def sources(self) -> list[str]:
        """File and line of each pointing, as n texts."""
        names = {key: file.name for key, file in dict(zip(map(id, self.file), self.file, strict=True)).items()}
        return [f"{names[key]}, line {line}" for key, line in zip(map(id, self.file), self.line, strict=True)]

    def reordered_pointings(self, order: Iterable[int]) -> UnconvertedPointings:
        """Pointings with the indices in `order`, in this order."""
        positions = list(order)
        list_columns: list[Any] = [[column[i] for i in positions] for column in self.complete_columns]
        digit_texts_by_role = {role: digits[positions] for role, digits in self.digit_texts_by_role.items()}
        additional_cells = {title: [column[i] for i in positions] for title, column in self.additional_cells.items()}
        return UnconvertedPointings(*[*list_columns, digit_texts_by_role, additional_cells])


def join_pointings(tables: Sequence[UnconvertedPointings]) -> UnconvertedPointings:
    """Pointings of all tables, one table after the other; a column that a table lacks is empty for its rows."""
    if len(tables) == 1:
        return tables[0]
    list_columns: list[Any] = [
        _concatenate(columns) for columns in zip(*(part.complete_columns for part in tables), strict=True)
    ]
    roles = dict.fromkeys(role for part in tables for role in part.digit_texts_by_role)
    titles = dict.fromkeys(title for part in tables for title in part.additional_cells)
    digit_texts_by_role = {
        role: np.concatenate([part.digit_texts_by_role.get(role, np.zeros(len(part), dtype="S1")) for part in tables])
        for role in roles
    }
    additional_cells = {title: _concatenate(part.additional_cell_texts(title) for part in tables) for title in titles}
    return UnconvertedPointings(*[*list_columns, digit_texts_by_role, additional_cells])


def _concatenate(columns: Iterable[list[ValueType]]) -> list[ValueType]:
    """Entries of all columns, one column after the other."""
    return list(chain.from_iterable(columns))


def distinct_with_indices(values: Iterable[ValueType]) -> tuple[list[ValueType], Ints]:
    """Distinct values in order of their first occurrence, and the index (n,) among them of each of n values."""
    index_by_value: dict[ValueType, int] = {}
    indices = [index_by_value.setdefault(value, len(index_by_value)) for value in values]
    return list(index_by_value), np.array(indices, dtype=np.int64)


@dataclass
class PointingTable:
    """Pointings and columns of a file or folder, with ignored lines, units of cells and notes for the user."""

    columns: list[TableColumn]
    pointings: UnconvertedPointings = field(default_factory=UnconvertedPointings)
    unread_lines: list[str] = field(default_factory=list)
    """Texts, for a note to the user, that identify ignored lines without pointing."""
    lacks_station_names: bool = False
    """True if the station of a pointing has no name."""
    is_positional: bool = False
    """True if there is no header, so that the positions of columns determine their roles."""
    has_unnamed_targets: bool = False
    """True if no row names its target."""
    mark_by_setup: dict[str, str] = field(default_factory=dict)
    """Name of the survey mark under a set-up, by name of the set-up, if both names differ."""
    notes: list[str] = field(default_factory=list)
    cell_units: dict[str, str] = field(default_factory=dict)
    """Unit that symbols after the numbers in the cells of a column denote, by title of the column."""

    def column_with_role(self, kind: Sequence[str]) -> TableColumn | None:
        """First column whose role (content, such as `azimuth`) is in `kind`; None if there is no such column."""
        return next((c for c in self.columns if c.role in kind), None)

    @property
    def has_coordinates(self) -> bool:
        """True if the table has coordinates in place of readings."""
        return {*COORDINATE_ROLES} <= {c.role for c in self.columns}

    @property
    def mark_names(self) -> list[str]:
        """Name of the survey mark under the station of each of n pointings."""
        return [self.mark_by_setup.get(station, station) for station in self.pointings.station]

    def add_header(self, columns: Sequence[TableColumn], file: object, row: int | None = None) -> None:
        """Addition of the columns of a further header, which may have other additional columns.

        Raises RecordError, which names `file` and `row`, if roles or units of readings differ from earlier headers.
        """
        earlier_columns, new_columns = (
            [(c.role, c.unit, c.face) for c in table_columns if c.role in READING_ROLES]
            for table_columns in (self.columns, columns)
        )
        if earlier_columns and earlier_columns != new_columns:
            message = "the columns differ from those of earlier headers, expected the same contents and units"
            raise SourceLocation(file, row).error(message)
        titles = {c.title for c in self.columns}
        self.columns += [c for c in columns if c.title not in titles]

    def add_cell_units(self, units: Mapping[str, str], file: object) -> None:
        """Addition of units of symbols in cells, by title of the column; raises RecordError for two in one column."""
        for title, unit in units.items():
            earlier_unit = self.cell_units.setdefault(title, unit)
            if earlier_unit != unit:
                message = f"has cells in {earlier_unit} and in {unit}, expected one unit"
                raise SourceLocation(file, None).error(message, safe_excerpt(title))

    def add_sheet(self, sheet: PointingTable, file: object) -> None:
        """Addition of the columns and notes of a further sheet, without its pointings; raises RecordError."""
        self.add_header(sheet.columns, file)
        self.unread_lines += sheet.unread_lines
        self.notes += [note for note in sheet.notes if note not in self.notes]
        self.lacks_station_names |= sheet.lacks_station_names
        self.add_cell_units(sheet.cell_units, file)
        self.is_positional |= sheet.is_positional
