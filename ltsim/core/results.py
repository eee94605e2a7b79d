"""One result model: a table's columns are declared once, and every form of the result is made from that declaration.

A `Column` says name, meaning, unit and form; a `Table` of columns, filled with rows, is the CSV file (written and read
back), the rows of JSON, the data frame, the text of a terminal, the table of a notebook and that of a page. A `Result`
is what a verb gives: a few lines, tables, a picture; equal where its values are, copied and pickled.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from pydantic import BaseModel

from ltsim.core.arrays import Floats
from ltsim.core.chances import p_text
from ltsim.core.drawing import pictures
from ltsim.core.errors import ModelError, RecordError, missing_extra, printable, unknown_name
from ltsim.core.limits import LINES
from ltsim.core.notation import NONE, aligned, decimals, number, with_sigma
from ltsim.core.units import BY_ENDING, unit_of_key
from ltsim.core.values import Valued

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

FORMULA = ("=", "+", "-", "@", "'")
LARGEST = 1e100
"""Size of a number in a file of results: squares of what is larger overflow, and no result comes near."""
MOST_SHOWN = 12
"""Rows of a table that a notebook shows."""
Kind = Literal["text", "number", "flag", "chance"]
Columns = Mapping[str, Sequence[Any]]
"""Columns of one length by their headers."""


@dataclass(frozen=True)
class Column:
    """One column of a table.

    Parameters
    ----------
    name : str
        In CSV, JSON and data frames; carries its unit at the end (`x_mm`).
    meaning : str
        What a cell holds, for definitions beside the table.
    kind : str
        `text`, `number`, `flag` (true or false) or `chance` (of a test).
    form : str
        How CSV writes a number, as of `format`; `r` in full.
    shown : str
        How a person reads it; by default four digits.
    sigma : str
        Name of the column with its standard deviation: a person reads both in one cell, `1.23 +- 0.10`.
    like : str
        Name of the column whose two digits say to which place a person reads it: value and U alike.
    unit : str
        By default the one in the name.
    title : str
        What a person reads as its head; by default the name without its unit.
    field : str
        What an object of a row calls it, where that is not the name.
    """

    name: str
    meaning: str = ""
    kind: Kind = "number"
    form: str = ""
    shown: str = ""
    sigma: str = ""
    like: str = ""
    unit: str = ""
    title: str = ""
    field: str = ""

    @property
    def heading(self) -> str:
        """`x [mm]`: the head of the column where a person reads it."""
        unit = self.unit or unit_of_key(self.name)
        ending = next((e for e, u in BY_ENDING.items() if u == unit and self.name.endswith(e)), "")
        title = self.title or self.name.removesuffix(ending).replace("_", " ")
        return f"{title} [{unit}]" if unit else title

    def cell(self, value: Any) -> Any:
        """A value as CSV has it: nothing for what does not exist."""
        if value is None or (isinstance(value, float) and not math.isfinite(value)):
            return ""
        if self.kind == "text":
            return guarded(str(value))
        if self.form:
            return repr(float(value)) if self.form == "r" else format(value, self.form)
        return f"{value:.6g}" if isinstance(value, float) and abs(value) < 1e4 else value

    def words(self, value: Any, beside: Any = None) -> str:
        """A value as a person reads it, `beside` the cell of its `sigma` or `like`; a dash for none."""
        if value is None or (isinstance(value, float) and not math.isfinite(value)):
            return NONE
        if isinstance(value, bool | np.bool_):
            return "yes" if value else ""
        if isinstance(value, str) or self.kind == "text":
            return str(value)
        if self.kind == "chance":
            return p_text(value)
        if self.sigma:
            return with_sigma(float(value), beside)
        if self.like and beside:
            return f"{value:.{decimals(beside)}f}"
        if self.shown:
            return format(value, self.shown)
        return str(value) if isinstance(value, int | np.integer) else number(float(value), 4)


def texts(**columns: str) -> tuple[Column, ...]:
    """Columns of text: name and what it means."""
    return tuple(Column(name, about, "text") for name, about in columns.items())


def numbers(form: str = "", shown: str = "", **columns: str) -> tuple[Column, ...]:
    """Columns of numbers, all written in one form: name and what it means."""
    return tuple(Column(name, about, form=form, shown=shown) for name, about in columns.items())


def flags(**columns: str) -> tuple[Column, ...]:
    """Columns of true and false: name and what true means."""
    return tuple(Column(name, about, "flag") for name, about in columns.items())


def columns_of(model: type[BaseModel], names: str = "", **more: Mapping[str, str]) -> tuple[Column, ...]:
    """The columns of a model whose fields are numbers, texts and flags, with what the model says of them.

    `names` are the fields in their order, with blanks between; default all. What else the `Column` of a field is to
    know is said by its name: ``value={"sigma": "sigma"}``.
    """
    made = []
    for name in names.split() or model.model_fields:
        field = model.model_fields[name]
        kind = "flag" if field.annotation is bool else "text" if _is_text(field.annotation) else "number"
        how: dict[str, Any] = {"name": name, "kind": kind, "field": name, **more.get(name, {})}
        made.append(Column(meaning=(field.description or "").rstrip("."), **how))
    return tuple(made)


def _is_text(annotation: Any) -> bool:
    return annotation is str or all(isinstance(choice, str) for choice in get_args(annotation) or (0,))


@dataclass(frozen=True)
class Table(Valued):
    """A table: what it is about and its columns, declared once; `filled` gives it rows.

    A spreadsheet takes a cell that begins with ``=``, ``+``, ``-`` or ``@`` for a formula. A text that begins so is
    written to CSV with an apostrophe before it, as is one that begins with an apostrophe; the reader takes it away.
    """

    file: str
    """Name of the CSV file; without its ending the table's name."""
    about: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Any, ...], ...] = ()

    @classmethod
    def of_columns(cls, name: str, columns: Columns, about: str = "") -> Table:
        """A table whose columns only the data know, such as the further columns of a recording."""
        made = tuple(Column(head, kind=_kind_of(column)) for head, column in columns.items())
        return cls(f"{name}.csv", about, made, tuple(zip(*columns.values(), strict=True)))

    def filled(self, rows: Iterable[Any]) -> Table:
        """The table with rows: sequences in the order of the columns, or objects or mappings that have their names."""
        return replace(self, rows=tuple(self._row(row) for row in rows))

    def _row(self, row: Any) -> tuple[Any, ...]:
        if isinstance(row, Mapping):
            return tuple(row[c.field or c.name] for c in self.columns)
        if isinstance(row, Sequence):
            if len(row) != len(self.columns):
                raise ModelError(f"a row of {self.file} has {len(row)} cells for {len(self.columns)} columns")
            return tuple(row)
        return tuple(getattr(row, c.field or c.name) for c in self.columns)

    @property
    def name(self) -> str:
        """Name of the table."""
        return Path(self.file).stem

    @property
    def header(self) -> list[str]:
        """Names of the columns."""
        return [column.name for column in self.columns]

    def only(self, names: str) -> Table:
        """The table with some of its columns, named with blanks between, and the standard deviations of these."""
        wanted = set(names.split())
        wanted |= {column.sigma or column.like for column in self.columns if column.name in wanted}
        at = [i for i, column in enumerate(self.columns) if column.name in wanted]
        rows = tuple(tuple(row[i] for i in at) for row in self.rows)
        return replace(self, columns=tuple(self.columns[i] for i in at), rows=rows)

    def column(self, name: str) -> list[Any]:
        """All cells of one column; raises ModelError."""
        if name not in self.header:
            raise unknown_name(f"column of {self.name}", name, self.header)
        at = self.header.index(name)
        return [row[at] for row in self.rows]

    def json(self) -> list[dict[str, Any]]:
        """A mapping a row, values as they are."""
        return [dict(zip(self.header, row, strict=True)) for row in self.rows]

    def frame(self) -> pd.DataFrame:
        """The table as a data frame; raises SetupError without pandas."""
        try:
            from pandas import DataFrame
        except ImportError:
            raise missing_extra("data frames", "pandas") from None
        return DataFrame({name: self.column(name) for name in self.header})

    def csv(self) -> str:
        """The content of its file."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([guarded(name) for name in self.header])
        for row in self.rows:
            writer.writerow([column.cell(value) for column, value in zip(self.columns, row, strict=True)])
        return stream.getvalue()

    def parsed(self, text: str, file: object = None) -> Table:
        """The table with the rows of a CSV text; an empty cell of numbers is NaN, further columns are left out.

        Raises
        ------
        RecordError
            When a column is missing or a cell holds no number where one should be.
        """
        if text.count("\n") > LINES:
            raise RecordError(f"has more than {LINES} lines, the most that is read", file=file)
        reader = csv.DictReader(io.StringIO(text, newline=None), restval="")
        try:
            names = list(reader.fieldnames or ())
            missing = [name for name in self.header if names.count(name) != 1]
            if missing:
                what = "is there twice" if missing[0] in names else "is missing"
                raise RecordError(f"the column {missing[0]} {what}; expected {','.join(self.header)}", file=file)
            rows = list(reader)
        except csv.Error as problem:
            raise RecordError(f"is not CSV ({problem})", file=file) from None
        return self.filled([_value(c, row[c.name], file, i) for c in self.columns] for i, row in enumerate(rows, 1))

    def numbers(self, *names: str) -> Floats:
        """Some columns of numbers as (rows, columns) float."""
        columns = [np.array(self.column(name), dtype=np.float64) for name in names]
        return np.stack(columns, axis=1) if columns else np.zeros((len(self.rows), 0))

    @property
    def _read(self) -> list[Column]:
        """The columns that a person reads: a standard deviation stands beside its value, what no row has is gone."""
        beside = {column.sigma for column in self.columns}
        empty = {c.name for i, c in enumerate(self.columns) if self.rows and all(r[i] in (None, "") for r in self.rows)}
        return [column for column in self.columns if column.name not in beside | empty]

    @property
    def headings(self) -> list[str]:
        """Heads of the columns for a person, with units."""
        return [column.heading for column in self._read]

    @property
    def meanings(self) -> dict[str, str]:
        """Meanings of the columns that a person reads, by heading; columns without a meaning are left out."""
        return {column.heading: column.meaning for column in self._read if column.meaning}

    def cells(self) -> list[list[str]]:
        """The rows as a person reads them, in the columns of `headings`."""
        at = {name: i for i, name in enumerate(self.header)}
        beside = [c.sigma or c.like for c in self._read]
        return [
            [c.words(row[at[c.name]], row[at[b]] if b else None) for c, b in zip(self._read, beside, strict=True)]
            for row in self.rows
        ]

    def text(self) -> str:
        """Aligned text for a terminal: text to the left, numbers to the right."""
        kinds = [column.kind == "text" for column in self._read]
        return aligned(self.headings, self.cells(), kinds.index(False) if False in kinds else len(kinds))

    def html(self) -> str:
        """The first rows for a notebook; texts are escaped."""
        if not self.columns:
            return ""
        head = "".join(
            f'<th title="{escape(self.meanings.get(name, ""))}">{escape(name)}</th>' for name in self.headings
        )
        rows = "".join(
            "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>"
            for row in replace(self, rows=self.rows[:MOST_SHOWN]).cells()
        )
        more = len(self.rows) - MOST_SHOWN
        rest = f"<p>and {more} more rows: to_dataframe()</p>" if more > 0 else ""
        return f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>{rest}"


class Result(Valued):
    """Base class of the results of verbs: `_lines` and `_tables` are defined by each kind of result; all else is here.

    It is equal to another of its kind where all values are, arrays among them; it can be copied and pickled.
    """

    def _lines(self) -> list[str]:
        """The result in a few lines."""
        raise NotImplementedError

    def _tables(self) -> Mapping[str, Callable[[], Table | Columns]]:
        """Its tables by name, the most wanted first; each is made when it is asked for."""
        return {}

    def __repr__(self) -> str:
        return "\n".join(self._lines())

    def _repr_html_(self) -> str:
        """The lines, and below them the beginning of the first table."""
        head = "<br>".join(escape(line) for line in self._lines())
        return f"<p>{head}</p>" + (self.table().html() if self._tables() else "")

    def table(self, name: str | None = None) -> Table:
        """One of the result's tables.

        Parameters
        ----------
        name : str, optional
            Which; default the first. A name that does not exist is answered with those that do.

        Raises
        ------
        ModelError
            When the result has no such table.
        """
        tables = self._tables()
        chosen = next(iter(tables), "") if name is None else name
        if chosen not in tables:
            kind = type(self).__name__
            raise unknown_name(f"table of a {kind}", chosen, tables) if tables else ModelError(f"{kind} has no table")
        made = tables[chosen]()
        return made if isinstance(made, Table) else Table.of_columns(chosen, made)

    def to_dataframe(self, table: str | None = None) -> pd.DataFrame:
        """One of the result's tables as a data frame; raises ModelError as `table`, SetupError without pandas."""
        return self.table(table).frame()

    def plot(self) -> Figure:
        """The picture of the result, a matplotlib figure; raises ModelError for what has none."""
        figure: Figure = pictures("plots").figure_of(self)
        return figure


def guarded(text: str) -> str:
    """A text that no spreadsheet takes for a formula."""
    return f"'{text}" if text.startswith(FORMULA) else text


def plain(text: str) -> str:
    """The text that was guarded."""
    return text[1:] if text.startswith("'") and text[1:].startswith(FORMULA) else text


def _kind_of(column: Sequence[Any]) -> Kind:
    first = next((value for value in column if value is not None), None)
    return "flag" if isinstance(first, bool | np.bool_) else "text" if isinstance(first, str) else "number"


def _value(column: Column, cell: str, file: object, row: int) -> Any:
    if column.kind == "text":
        return plain(cell)
    if column.kind == "flag":
        return cell == "True"
    try:
        value = float(cell or "nan")
    except ValueError:
        value = math.inf
    if abs(value) > LARGEST:
        raise RecordError(f"'{printable(cell[:40])}' is no number", file=file, row=row, column=column.name)
    return value


def by_row(rows: Sequence[Mapping[str, Any]]) -> Columns:
    """Columns of rows that all have the same keys."""
    return {key: [row[key] for row in rows] for key in (rows[0] if rows else ())}


def by_entry(kind: type, entries: Sequence[object]) -> Columns:
    """Columns of the fields of a dataclass, a row an entry."""
    return {field.name: [getattr(entry, field.name) for entry in entries] for field in fields(kind)}
