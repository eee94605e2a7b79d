"""Errors on the header of a table that lacks a required column, or has it twice."""

import difflib
from collections.abc import Sequence

from ltsim.core.errors import RecordError, shortened_name

MAX_QUOTED_COLUMNS = 12
"""Largest number of titles of columns that a message on a missing column lists: two lines of a terminal."""


def require_columns(header: Sequence[str], required_names: Sequence[str], file: object | None = None) -> None:
    """Check that the header of a table has each required column once; raises RecordError with the name of the file."""
    for name in required_names:
        if name not in header:
            raise RecordError(missing_column_text(name, header), file=file, row=0)
        if header.count(name) > 1:
            raise RecordError(f"the column {name} is there twice; remove one of the two", file=file, row=0)


def missing_column_text(name: str, header: Sequence[str]) -> str:
    """Message on a required column that a table lacks: its name, the columns in the `header`, and the next action."""
    similar_names = difflib.get_close_matches(name, header, n=1, cutoff=0.6)
    columns = ", ".join(shortened_name(title) for title in header[:MAX_QUOTED_COLUMNS])
    more = f" and {len(header) - MAX_QUOTED_COLUMNS} more" if len(header) > MAX_QUOTED_COLUMNS else ""
    change = f"rename '{shortened_name(similar_names[0])}', if it" if similar_names else "rename the column that"
    return (
        f"the required column {name} is missing; the header has the columns {columns or '(none)'}{more}; "
        f"{change} contains these values, or add the column"
    )
