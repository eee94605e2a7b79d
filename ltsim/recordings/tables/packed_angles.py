"""Packed angles, whose decimals contain minutes and seconds (33.120747 is 33° 12' 07.47"), found by their digits."""

from dataclasses import replace

import numpy as np

from ltsim.recordings.conventions import Hints
from ltsim.recordings.files import safe_excerpt
from ltsim.recordings.spreadsheets import cells
from ltsim.recordings.spreadsheets.header import HORIZONTAL_ROLES, VERTICAL_ROLES, TableColumn
from ltsim.recordings.tables.pointing_table import DigitTexts, PointingTable, to_digit_texts

MIN_PACKED_CELLS = 10
"""Smallest number of different angles in a column that can show packed angles: the decimals of all must be minutes and
seconds below 60. By chance this is so for a decimal angle with a probability of 36 %, for ten with 4e-5."""
MIN_PACKED_DIGITS = 4
"""Smallest number of decimals of a packed angle, for minutes and seconds."""

N_CELLS_TESTED_FOR_PACKED_ANGLES = 1000
"""Number of cells of each column that are tested first, to save time; the rest is tested only if these can be packed
angles.
"""


def with_unpacked_angles(table: PointingTable, hints: Hints) -> PointingTable:
    """Table whose packed angles (33.120747 for 33° 12' 07.47") are converted to decimal degrees, in place.

    A column has packed angles if it declares no unit, and the decimals of all cells can be minutes and seconds.
    """
    columns = [c for c in table.columns if c.role in (*HORIZONTAL_ROLES, *VERTICAL_ROLES)]
    if hints.angle is not None or not columns or any(c.unit for c in columns):
        return table
    digit_texts_by_role = {
        c.role: table.pointings.digit_texts_by_role[c.role]
        for c in columns
        if c.role in table.pointings.digit_texts_by_role
    }
    if not _are_packed(
        np.concatenate([digits[:N_CELLS_TESTED_FOR_PACKED_ANGLES] for digits in digit_texts_by_role.values()])
    ):
        return table
    all_values = np.concatenate(list(digit_texts_by_role.values()))
    if not _are_packed(all_values):
        return table
    table.pointings.digit_texts_by_role |= {
        role: _decimal_degrees(digits) for role, digits in digit_texts_by_role.items()
    }
    table.columns = [replace(c, unit="deg") if c in columns else c for c in table.columns]
    table.notes.append(
        f"the angles in {_titles_text(columns)} are interpreted as ddd.mmss: all {len(all_values)} have minutes and "
        "seconds below 60 (otherwise give --hint angle=deg or --hint angle=gon)"
    )
    return table


def _are_packed(digits: DigitTexts) -> bool:
    """True if at least `MIN_PACKED_CELLS` different angles have decimals with minutes and seconds below 60."""
    distinct = [text for text in np.unique(digits).astype(str).tolist() if _n_decimals(text) >= MIN_PACKED_DIGITS]
    return len(distinct) >= MIN_PACKED_CELLS and all(cells.parse_packed_degrees(text) is not None for text in distinct)


def _decimal_degrees(digits: DigitTexts) -> DigitTexts:
    """Decimal degrees (n,) as digits, from n packed angles; an empty text for a missing angle."""
    return to_digit_texts(
        [str(cells.parse_packed_degrees(text)) if text else "" for text in digits.astype(str).tolist()]
    )


def _n_decimals(text: str) -> int:
    """Number of decimals of a number in a text."""
    return len(text.partition(".")[2])


def _titles_text(columns: list[TableColumn]) -> str:
    """Titles of columns as text for a note."""
    return " and ".join(dict.fromkeys(f"'{safe_excerpt(c.title)}'" for c in columns))
