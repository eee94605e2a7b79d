"""Elevations from height differences, for tables of horizontal distances without vertical angles.

Data collectors often export horizontal distance (HD) and height difference (dH) in place of the slope distance and the
vertical angle. Height difference and horizontal distance then determine the elevation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.units import SI_PER_UNIT, UNIT_BY_SPELLING
from ltsim.recordings.files import safe_excerpt
from ltsim.recordings.pointings import NOT_MEASURED
from ltsim.recordings.spreadsheets import cells
from ltsim.recordings.spreadsheets.header import (
    HEIGHT_ROLES,
    VERTICAL_ROLES,
    TableColumn,
    normalised_title,
    title_words_and_unit,
)
from ltsim.recordings.tables.pointing_table import PointingTable

AXIS_TO_PRISM_TITLES = frozenset(
    ["vd", "verticaldistance", "verticaldist", "vertikaldistanz", "vdist", "distanceverticale"]
)
"""Titles, in the form of `normalised_title`, of height differences between tilting axis and reflector."""
MARK_TO_MARK_TITLES = (
    *("deltah", "dh", "dhgt", "hdiff", "heightdiff", "heightdifference"),
    *("hoehendifferenz", "hoehenunterschied", "hohendifferenz", "hohenunterschied"),
    *("denivelee", "desnivel", "dislivello"),
)
"""Titles, in the form of `normalised_title`, of height differences between the marks of station and target."""
MAX_HALF_CIRCLE_DIFFERENCE = 0.02
"""Limit of the difference [rad] from half a circle of two circle readings to one target. Below it, the readings were
made in both faces; the axis errors of an instrument are far below it."""
SHORTEST_DISTANCE = 1e-3
"""Horizontal distance [m] that replaces shorter distances in the uncertainty of an elevation."""


@dataclass(frozen=True)
class HeightDifferences:
    """Height differences of the reflectors from the tilting axis of the instrument."""

    axis_to_reflector: Floats
    """Height difference (n,) [m] from tilting axis to reflector of n pointings; NaN for an empty cell."""
    step: float
    """Value [m] of the last digit of the height differences."""
    note: str
    """Note to the user on the use of the column."""

    def elevations(self, horizontal_distances: Floats) -> Floats:
        """Elevations (n,) [rad] of n pointings with `horizontal_distances` (n,) [m]."""
        return np.arctan2(self.axis_to_reflector, horizontal_distances)

    def rounding_sigmas(self, horizontal_distances: Floats) -> Floats:
        """Standard deviations (n,) [rad] of the elevations due to the rounding of the height differences."""
        return self.step / np.sqrt(12.0) / np.maximum(horizontal_distances, SHORTEST_DISTANCE)


def height_differences(
    table: PointingTable, length_unit: str, assumed_unit: Callable[[str, Floats], str]
) -> HeightDifferences | None:
    """Height differences in a table of horizontal distances; None if the table has vertical angles or no such column.

    `length_unit` is the unit of height differences without declared unit, `assumed_unit(role, values)` that of heights
    of instrument or target with these values. Height differences between marks, in a table with
    heights of instrument and target, are converted to those from tilting axis to reflector.
    """
    if table.column_with_role(("flat",)) is None or table.column_with_role(VERTICAL_ROLES) is not None:
        return None
    titles = (*AXIS_TO_PRISM_TITLES, *MARK_TO_MARK_TITLES)
    column = next((c for c in table.columns if c.is_additional and _title_words(c) in titles), None)
    if column is None:
        return None
    numbers, last_digit, cell_unit = _numbers_and_unit(table, column.title)
    factor = SI_PER_UNIT[cell_unit or unit_in_title(column) or length_unit]
    differences = numbers * factor
    if not np.isfinite(differences).any():
        return None
    ends = "from tilting axis to reflector"
    if _title_words(column) in MARK_TO_MARK_TITLES:
        heights = [
            np.nan_to_num(values * SI_PER_UNIT[cell_unit or c.unit or assumed_unit(c.role, values)])
            for c in (table.column_with_role((role,)) for role in HEIGHT_ROLES)
            if c is not None
            for values, _, cell_unit in (_numbers_and_unit(table, c.title),)
        ]
        if len(heights) == len(HEIGHT_ROLES):
            differences = differences - heights[0] + heights[1]
            ends = "between the marks, because the table has heights of instrument and target"
    note = (
        f"the table has no vertical angles: elevations are computed from horizontal distances and height differences "
        f"('{safe_excerpt(column.title)}', {ends})"
    )
    del table.pointings.additional_cells[column.title]
    table.columns.remove(column)
    return HeightDifferences(differences, last_digit * factor, note)


def is_raw_second_face(azimuths: Floats, sight_indices: Ints, faces: Ints) -> Bools:
    """Mask (n,) of the pointings in face 2 whose circle readings (azimuths) the file did not reduce to face 1.

    Their azimuths (n,) [rad] differ by half a circle from that of the reference pointing of the same sight: its first
    pointing in face 1 or, without declared faces, its first pointing. `sight_indices` (n,) number the sights (pairs of
    station and target), `faces` (n,) are the declared faces, 0 if not declared.
    """
    order = np.lexsort((np.arange(len(faces)), faces == 2, sight_indices))
    _, first, sights = np.unique(sight_indices[order], return_index=True, return_inverse=True)
    reference = np.empty(len(faces), dtype=np.int64)
    reference[order] = order[first][sights]
    turn = np.abs(np.angle(np.exp(1j * (azimuths - azimuths[reference]))))
    return np.asarray((np.abs(turn - np.pi) < MAX_HALF_CIRCLE_DIFFERENCE) & (faces != 1))


def unit_in_title(column: TableColumn) -> str:
    """Unit in the title of a column, in brackets or after an underscore, also of a column without a role.

    The text is empty for a title without unit.
    """
    return column.unit or UNIT_BY_SPELLING.get(column.title.rpartition("_")[2].casefold(), "")


def _title_words(column: TableColumn) -> str:
    """Title of a column in the form of `normalised_title`, without a unit in brackets or after an underscore."""
    words, unit = title_words_and_unit(column.title)
    return words if unit or not unit_in_title(column) else normalised_title(column.title.rpartition("_")[0])


def _numbers_and_unit(table: PointingTable, title: str) -> tuple[Floats, float, str]:
    """Numbers (n,) in n cells of an additional column, value of their last digit, and unit of the cells.

    A cell without a number gives NaN.
    """
    texts, unit = cells.split_common_unit(table.pointings.additional_cell_texts(title))
    numbers = [*cells.exact_numbers(texts, table.pointings.thousands_separator)]
    last_digit = min((int(number.as_tuple().exponent) for number in numbers if number is not None), default=0)
    return np.array([NOT_MEASURED if x is None else float(x) for x in numbers]), 10.0**last_digit, unit
