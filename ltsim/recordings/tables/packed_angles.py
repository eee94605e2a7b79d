"""Angles that pack minutes and seconds into decimals (``33.120747`` is 33° 12' 07.47"), recognised by their digits."""

from dataclasses import replace

import numpy as np

from ltsim.recordings.conventions import Hints
from ltsim.recordings.files import quoted_text
from ltsim.recordings.tables import cells
from ltsim.recordings.tables.header import HORIZONTAL_ROLES, VERTICAL_ROLES, TableColumn
from ltsim.recordings.tables.printed import Digits, PointingTable, to_digits

MIN_PACKED_CELLS = 10
"""Number of distinct angles that must all have minutes and seconds below 60. Of decimal degrees or gon 36 % have, so
that ten do by chance in 4 of 100,000 tables.
"""
MIN_PACKED_DIGITS = 4
"""Number of decimals from which a cell shows minutes and seconds."""

N_SAMPLE_CELLS = 1000
"""Number of cells of each column that are tested first."""


def with_unpacked_angles(table: PointingTable, hints: Hints) -> PointingTable:
    """Table whose angles are in degrees if their columns state no unit and all cells pack minutes and seconds."""
    columns = [c for c in table.columns if c.role in (*HORIZONTAL_ROLES, *VERTICAL_ROLES)]
    if hints.angle is not None or not columns or any(c.unit for c in columns):
        return table
    numbers = {c.role: table.pointings.numbers[c.role] for c in columns if c.role in table.pointings.numbers}
    if not _are_packed(np.concatenate([digits[:N_SAMPLE_CELLS] for digits in numbers.values()])):
        return table
    all_values = np.concatenate(list(numbers.values()))
    if not _are_packed(all_values):
        return table
    table.pointings.numbers |= {role: _decimal_degrees(digits) for role, digits in numbers.items()}
    table.columns = [replace(c, unit="deg") if c in columns else c for c in table.columns]
    table.notes.append(
        f"the angles in {_titles(columns)} are interpreted as ddd.mmss: all {len(all_values)} have minutes and seconds "
        "below 60 (otherwise give --hint angle=deg or --hint angle=gon)"
    )
    return table


def _are_packed(digits: Digits) -> bool:
    """True if there are enough distinct angles with minutes and seconds, and all of them are below 60."""
    distinct = [text for text in np.unique(digits).astype(str).tolist() if _n_decimals(text) >= MIN_PACKED_DIGITS]
    return len(distinct) >= MIN_PACKED_CELLS and all(cells.parse_packed_degrees(text) is not None for text in distinct)


def _decimal_degrees(digits: Digits) -> Digits:
    """Degrees with decimals of packed angles; empty cells stay empty."""
    return to_digits([str(cells.parse_packed_degrees(text)) if text else "" for text in digits.astype(str).tolist()])


def _n_decimals(text: str) -> int:
    return len(text.partition(".")[2])


def _titles(columns: list[TableColumn]) -> str:
    return " and ".join(dict.fromkeys(f"'{quoted_text(c.title)}'" for c in columns))
