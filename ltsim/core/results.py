"""Results and their tables; each column of a table is declared once for all forms of output.

A `Column` has name, meaning, unit and number format. A `Table` gives the CSV file, the JSON rows, the data frame, the
text for a terminal, and the tables of notebooks and reports. A `Result` has a short summary, tables and a figure.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from pydantic import BaseModel

from ltsim.core.arrays import Floats
from ltsim.core.descriptions import field_descriptions
from ltsim.core.equality import ValueEquality
from ltsim.core.errors import (
    ModelError,
    RecordError,
    as_printable,
    missing_extra_error,
    require_columns,
    unknown_name_error,
)
from ltsim.core.limits import MAX_TEXT_LINES
from ltsim.core.notation import (
    MISSING_TEXT,
    align_columns,
    decimals_of_sigma,
    escape_cell_text,
    number_text,
    unescape_cell_text,
    unsigned_zero,
    with_sigma,
)
from ltsim.core.plotting import plotting_module
from ltsim.core.probability import p_value_text
from ltsim.core.units import UNIT_BY_KEY_ENDING, unit_of_key

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

MAX_RESULT_MAGNITUDE = 1e40
"""Largest absolute value of a number in a result file, so that a product of seven such numbers does not overflow."""
MAX_NOTEBOOK_ROWS = 12
"""Largest number of rows of a table that a notebook shows."""
ColumnKind = Literal["text", "number", "flag", "p_value"]
"""Kind of the values of a column: text, number, true or false, or p-value."""
ColumnValues = Mapping[str, Sequence[Any]]
"""Values of columns of equal length, by the names of the columns."""


@dataclass(frozen=True)
class Column:
    """Column of a table.

    Parameters
    ----------
    name : str
        Name in CSV, JSON and data frames, with the unit at its end (`x_mm`).
    meaning : str
        Definition of the column.
    kind : str
        `text`, `number`, `flag` (true or false) or `p_value`.
    csv_format : str
        Number format in CSV, in the syntax of Python's `format`; `r` for full precision.
    display_format : str
        Number format for display; by default `n_digits` significant digits.
    sigma_column : str
        Name of the column with the standard deviation of this column; both are displayed in one cell, `1.23 +- 0.10`.
    uncertainty_column : str
        Name of a column, such as U, whose second significant digit is the last displayed decimal of this column.
    unit : str
        Unit; by default the one in the name. An empty text is no unit.
    title : str
        Displayed title; by default the name without its unit.
    row_attribute : str
        Attribute of a row object, or key of a row mapping, that holds the value; by default the name of the column.
    n_digits : int
        Significant digits of a number that is displayed without `display_format`.
    """

    name: str
    meaning: str = ""
    kind: ColumnKind = "number"
    csv_format: str = ""
    display_format: str = ""
    sigma_column: str = ""
    uncertainty_column: str = ""
    unit: str | None = None
    title: str = ""
    row_attribute: str = ""
    n_digits: int = 4

    @property
    def heading(self) -> str:
        """Displayed title of the column with its unit: `x [mm]`."""
        unit = unit_of_key(self.name) if self.unit is None else self.unit
        ending = next((e for e, u in UNIT_BY_KEY_ENDING.items() if u == unit and self.name.endswith(e)), "")
        title = self.title or self.name.removesuffix(ending).replace("_", " ")
        return f"{title} [{unit}]" if unit else title

    def csv_cell(self, value: Any) -> Any:
        """Value for a cell of the CSV file; empty if it is missing."""
        if value is None or (isinstance(value, float) and not math.isfinite(value)):
            return ""
        if self.kind == "text":
            return escape_cell_text(str(value))
        if self.csv_format:
            return repr(float(value)) if self.csv_format == "r" else format(value, self.csv_format)
        return f"{value:.6g}" if isinstance(value, float) and abs(value) < 1e4 else value

    def displayed_text(self, value: Any, sigma_or_uncertainty: Any = None) -> str:
        """Displayed text of a value; `sigma_or_uncertainty` is the value in `sigma_column` or `uncertainty_column`."""
        if value is None or (isinstance(value, float) and not math.isfinite(value)):
            return MISSING_TEXT
        if isinstance(value, bool | np.bool_):
            return "yes" if value else ""
        if isinstance(value, str) or self.kind == "text":
            return str(value)
        if self.kind == "p_value":
            return p_value_text(value)
        if self.sigma_column:
            return with_sigma(float(value), sigma_or_uncertainty)
        if self.uncertainty_column and sigma_or_uncertainty and 0 < sigma_or_uncertainty < math.inf:
            return unsigned_zero(f"{value:.{decimals_of_sigma(sigma_or_uncertainty)}f}")
        if self.display_format:
            return unsigned_zero(format(value, self.display_format))
        return str(value) if isinstance(value, int | np.integer) else number_text(float(value), self.n_digits)


def text_columns(**columns: str) -> tuple[Column, ...]:
    """Columns that hold text; the arguments are names and definitions of the columns, `name="definition"`."""
    return tuple(Column(name, about, "text") for name, about in columns.items())


def number_columns(format_text: str = "", display_format: str = "", **columns: str) -> tuple[Column, ...]:
    """Columns that hold numbers, `name="definition"`, with their formats in CSV (`format_text`) and for display."""
    return tuple(
        Column(name, about, csv_format=format_text, display_format=display_format) for name, about in columns.items()
    )


def flag_columns(**columns: str) -> tuple[Column, ...]:
    """Columns with the values true and false; arguments `name="True if ..."` give name and meaning of true."""
    return tuple(Column(name, about, "flag") for name, about in columns.items())


def model_columns(model: type[BaseModel], names: str = "", **column_options: Mapping[str, Any]) -> tuple[Column, ...]:
    """Columns for the fields of a pydantic model, with the descriptions of the fields as meanings.

    `names` lists the fields, separated by blanks; default all. `column_options` holds further arguments of the `Column`
    of a field by the field's name: ``value={"sigma_column": "sigma"}``.
    """
    made, meanings = [], field_descriptions(model)
    for name in names.split() or model.model_fields:
        field = model.model_fields[name]
        kind = "flag" if field.annotation is bool else "text" if _is_text(field.annotation) else "number"
        options: dict[str, Any] = {"name": name, "kind": kind, "row_attribute": name, **column_options.get(name, {})}
        made.append(Column(meaning=meanings.get(name, "").rstrip("."), **options))
    return tuple(made)


def _is_text(annotation: Any) -> bool:
    return annotation is str or all(isinstance(choice, str) for choice in get_args(annotation) or (0,))


@dataclass(frozen=True)
class Table(ValueEquality):
    """Table with description, columns and rows.

    A spreadsheet interprets a cell that begins with ``=``, ``+``, ``-`` or ``@`` as a formula. Such texts, and texts
    that begin with an apostrophe, are written to CSV with an apostrophe before them; `parse_csv` removes it.
    """

    file: str
    """Name of the CSV file of the table; without its suffix, it is the name of the table."""
    description: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Any, ...], ...] = ()

    @classmethod
    def from_columns(cls, table_name: str, columns: ColumnValues, description: str = "") -> Table:
        """Table of values by column name, for columns without a declaration, such as extra columns of a recording."""
        table_columns = tuple(Column(head, kind=_column_kind(column)) for head, column in columns.items())
        return cls(f"{table_name}.csv", description, table_columns, tuple(zip(*columns.values(), strict=True)))

    def with_rows(self, rows: Iterable[Any]) -> Table:
        """Copy of the table with new rows: each a sequence in column order, an object with attributes, or a mapping."""
        return replace(self, rows=tuple(self._row_values(row) for row in rows))

    def _row_values(self, row: Any) -> tuple[Any, ...]:
        if isinstance(row, Mapping):
            return tuple(row[c.row_attribute or c.name] for c in self.columns)
        if isinstance(row, Sequence):
            if len(row) != len(self.columns):
                raise ModelError(f"a row of {self.file} has {len(row)} cells for {len(self.columns)} columns")
            return tuple(row)
        return tuple(getattr(row, c.row_attribute or c.name) for c in self.columns)

    @property
    def name(self) -> str:
        """Name of the table."""
        return Path(self.file).stem

    @property
    def header(self) -> list[str]:
        """Names of the columns."""
        return [column.name for column in self.columns]

    def select_columns(self, names: str) -> Table:
        """Copy of the table with only the columns `names` (separated by blanks) and their uncertainty columns."""
        column_by_name = {column.name: column for column in self.columns}
        columns_used = [column_by_name[name] for name in names.split() if name in column_by_name]
        names_used = dict.fromkeys(
            name for c in columns_used for name in (c.name, c.sigma_column or c.uncertainty_column) if name
        )
        indices = [self.header.index(name) for name in names_used]
        rows = tuple(tuple(row[i] for i in indices) for row in self.rows)
        return replace(self, columns=tuple(self.columns[i] for i in indices), rows=rows)

    def column(self, column_name: str) -> list[Any]:
        """All values of one column; raises ModelError for an unknown name."""
        if column_name not in self.header:
            raise unknown_name_error(f"column of {self.name}", column_name, self.header)
        column_index = self.header.index(column_name)
        return [row[column_index] for row in self.rows]

    def json_rows(self) -> list[dict[str, Any]]:
        """Rows of the table as mappings from column name to value."""
        return [dict(zip(self.header, row, strict=True)) for row in self.rows]

    def data_frame(self) -> pd.DataFrame:
        """Data frame of the table; raises InputError without pandas."""
        try:
            from pandas import DataFrame
        except ImportError:
            raise missing_extra_error("data frames", "pandas") from None
        return DataFrame({name: self.column(name) for name in self.header})

    def csv_text(self) -> str:
        """Content of the table's CSV file."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([escape_cell_text(name) for name in self.header])
        for row in self.rows:
            writer.writerow([column.csv_cell(value) for column, value in zip(self.columns, row, strict=True)])
        return stream.getvalue()

    def parse_csv(self, text: str, file: object = None) -> Table:
        """Copy of the table with the rows of a CSV text; an empty number is NaN, undeclared columns are ignored.

        Raises
        ------
        RecordError
            When a column is missing, or a cell of a number column holds no number. `file` is named in the message.
        """
        if text.count("\n") > MAX_TEXT_LINES:
            raise RecordError(f"the file has more than {MAX_TEXT_LINES} lines, the limit for reading", file=file)
        reader = csv.DictReader(io.StringIO(text, newline=None), restval="")
        try:
            names = list(reader.fieldnames or ())
            require_columns(names, self.header, file)
            return self.with_rows(
                [_parse_value(c, row[c.name], file, i) for c in self.columns] for i, row in enumerate(reader, 1)
            )
        except csv.Error as problem:
            raise RecordError(f"is not CSV ({problem})", file=file) from None

    def float_array(self, *names: str) -> Floats:
        """Values of the named columns as a float array (rows, columns)."""
        columns = [np.array(self.column(name), dtype=np.float64) for name in names]
        return np.stack(columns, axis=1) if columns else np.zeros((len(self.rows), 0))

    @property
    def _displayed_columns(self) -> list[Column]:
        """Displayed columns: all except empty ones and standard deviations that share a cell with their value."""
        merged_names = {column.sigma_column for column in self.columns}
        empty_names = {
            c.name for i, c in enumerate(self.columns) if self.rows and all(r[i] in (None, "") for r in self.rows)
        }
        return [column for column in self.columns if column.name not in merged_names | empty_names]

    @property
    def headings(self) -> list[str]:
        """Displayed titles of the columns with their units."""
        return [column.heading for column in self._displayed_columns]

    @property
    def meanings(self) -> dict[str, str]:
        """Meanings of the displayed columns by displayed title; columns without a meaning are omitted."""
        return {column.heading: column.meaning for column in self._displayed_columns if column.meaning}

    def displayed_cells(self) -> list[list[str]]:
        """Displayed text of each cell, row by row, in the column order of `headings`."""
        at = {name: i for i, name in enumerate(self.header)}
        pairs = [(c, c.sigma_column or c.uncertainty_column) for c in self._displayed_columns]
        return [[c.displayed_text(row[at[c.name]], row[at[p]] if p else None) for c, p in pairs] for row in self.rows]

    def text(self) -> str:
        """Text of the table for a terminal, with aligned columns: text flush left, numbers flush right."""
        is_text = [column.kind == "text" for column in self._displayed_columns]
        return align_columns(self.headings, self.displayed_cells(), [*is_text, False].index(False))

    def html_table(self) -> str:
        """HTML table of the first `MAX_NOTEBOOK_ROWS` rows for a notebook; texts are escaped."""
        if not self.columns:
            return ""
        head = "".join(
            f'<th title="{escape(self.meanings.get(name, ""))}">{escape(name)}</th>' for name in self.headings
        )
        row_html = "".join(
            "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>"
            for row in replace(self, rows=self.rows[:MAX_NOTEBOOK_ROWS]).displayed_cells()
        )
        n_more = len(self.rows) - MAX_NOTEBOOK_ROWS
        more_rows_html = f"<p>and {n_more} more rows: to_dataframe()</p>" if n_more > 0 else ""
        return f"<table><thead><tr>{head}</tr></thead><tbody>{row_html}</tbody></table>{more_rows_html}"


class Result(ValueEquality):
    """Base class of the results of public functions; a subclass defines `_summary_lines` and `_table_makers`.

    Results are compared by value, including their arrays; they can be copied and pickled.
    """

    def _summary_lines(self) -> list[str]:
        """Lines of the summary of the result."""
        raise NotImplementedError

    def _table_makers(self) -> Mapping[str, Callable[[], Table | ColumnValues]]:
        """Functions that make the tables of the result, by name of the table; the first table is the default."""
        return {}

    def __repr__(self) -> str:
        return "\n".join(self._summary_lines())

    def _repr_html_(self) -> str:
        """HTML of the summary and of the first rows of the default table."""
        head = "<br>".join(escape(line) for line in self._summary_lines())
        return f"<p>{head}</p>" + (self.table().html_table() if self._table_makers() else "")

    def table(self, table_name: str | None = None) -> Table:
        """Table of the result with the given name.

        Parameters
        ----------
        table_name : str, optional
            Name of the table; default the first table. The error for an unknown name lists the valid names.

        Raises
        ------
        ModelError
            When the result has no such table.
        """
        tables = self._table_makers()
        name = next(iter(tables), "") if table_name is None else table_name
        if name not in tables:
            kind = type(self).__name__
            raise (
                unknown_name_error(f"table of a {kind}", name, tables) if tables else ModelError(f"{kind} has no table")
            )
        content = tables[name]()
        return content if isinstance(content, Table) else Table.from_columns(name, content)

    def to_dataframe(self, table: str | None = None) -> pd.DataFrame:
        """Data frame of a table of the result; raises ModelError for an unknown table and InputError without pandas."""
        return self.table(table).data_frame()

    def plot(self) -> Figure:
        """Figure of the result (matplotlib); raises ModelError for a result without a figure."""
        figure: Figure = plotting_module("plots").figure_of(self)
        return figure


def _column_kind(column: Sequence[Any]) -> ColumnKind:
    first_value = next((value for value in column if value is not None), None)
    return "flag" if isinstance(first_value, bool | np.bool_) else "text" if isinstance(first_value, str) else "number"


def _parse_value(column: Column, cell: str, file: object, row: int) -> Any:
    if column.kind == "text":
        return unescape_cell_text(cell)
    if column.kind == "flag":
        return cell == "True"
    try:
        value = float(cell or "nan")
    except ValueError:
        value = math.inf
    if abs(value) > MAX_RESULT_MAGNITUDE:
        raise RecordError(f"'{as_printable(cell[:40])}' is not a number", file=file, row=row, column=column.name)
    return value
