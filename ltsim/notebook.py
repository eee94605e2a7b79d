"""How a result shows itself: a few lines at the prompt, a table in a notebook, data frames on request."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from html import escape
from itertools import islice
from typing import TYPE_CHECKING, Any

from ltsim.errors import missing_extra, unknown_name

if TYPE_CHECKING:
    import pandas as pd

Columns = Mapping[str, Sequence[Any]]
"""A table: columns of one length, by their headers; units stand in the header."""
MOST_SHOWN = 12


class Shown:
    """A result that a person looks at; `_lines` and `_tables` are what each kind of result says.

    A dataclass of this kind is declared with ``repr=False``: its fields are arrays of thousands of numbers.
    """

    def _lines(self) -> list[str]:
        """The result in a few lines."""
        raise NotImplementedError

    def _tables(self) -> Mapping[str, Callable[[], Columns]]:
        """Its tables by name, the most wanted first; each is made when it is asked for."""
        return {}

    def __repr__(self) -> str:
        return "\n".join(self._lines())

    def _repr_html_(self) -> str:
        """The lines, and below them the beginning of the first table."""
        head = "<br>".join(escape(line) for line in self._lines())
        tables = list(self._tables().items())
        return f"<p>{head}</p>" + (_html_table(tables[0][1]()) if tables else "")

    def to_pandas(self, table: str | None = None) -> pd.DataFrame:
        """One of the result's tables as a data frame.

        Parameters
        ----------
        table : str, optional
            Which; default the first. A name that does not exist is answered with those that do.

        Raises
        ------
        ModelError
            When the result has no such table.
        SetupError
            When pandas is not installed.
        """
        tables = self._tables()
        name = next(iter(tables), "") if table is None else table
        if name not in tables:
            raise unknown_name(f"table of a {type(self).__name__}", name, tables)
        try:
            from pandas import DataFrame
        except ImportError:
            raise missing_extra("data frames", "pandas") from None
        return DataFrame({header: list(column) for header, column in tables[name]().items()})


def _html_table(columns: Columns) -> str:
    """The first rows of a table as HTML; texts are escaped."""
    if not columns:
        return ""
    count = len(next(iter(columns.values())))
    head = "".join(f"<th>{escape(name)}</th>" for name in columns)
    rows = "".join(
        "<tr>" + "".join(f"<td>{escape(_cell(value))}</td>" for value in row) + "</tr>"
        for row in islice(zip(*columns.values(), strict=True), MOST_SHOWN)
    )
    more = f"<p>and {count - MOST_SHOWN} more rows: to_pandas()</p>" if count > MOST_SHOWN else ""
    return f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>{more}"


def _cell(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def by_row(rows: Sequence[Mapping[str, Any]]) -> Columns:
    """Columns of rows that all have the same keys."""
    return {key: [row[key] for row in rows] for key in (rows[0] if rows else ())}


def by_entry(kind: type, entries: Sequence[object]) -> Columns:
    """Columns of the fields of a dataclass, a row an entry."""
    return {field.name: [getattr(entry, field.name) for entry in entries] for field in fields(kind)}
