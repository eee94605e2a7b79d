"""Heights above survey marks in tables: completion of empty cells, and lines measured in both directions as a test."""

from collections.abc import Mapping, Sequence

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.core.notation import names_text
from ltsim.core.units import EARTH_RADIUS
from ltsim.recordings.files import safe_excerpt
from ltsim.recordings.recording import HEIGHT_COLUMNS
from ltsim.recordings.spreadsheets.header import HEIGHT_ROLES
from ltsim.recordings.tables.pointing_table import PointingTable, distinct_with_indices

MIN_RECIPROCAL_LINES = 4
"""Smallest number of lines measured in both directions whose misclosures decide whether heights above survey marks are
applied."""
MAX_MISCLOSURE_RATIO_WITHOUT_TO_WITH_HEIGHTS = 0.5
"""Limit of the misclosure of lines measured in both directions without heights above survey marks, divided by that with
them. If the ratio is smaller, the heights are not applied, because correct heights would reduce the misclosure."""
MAX_MISCLOSURE_WITHOUT_HEIGHTS_M = 0.2
"""Limit of the median height misclosure [m] of lines measured in both directions, without heights above survey marks.
If it is exceeded, the heights are applied. The curvature of the earth causes 0.2 m over 1.3 km."""
MAX_FORCED_CENTRING_MISCLOSURE_M = 0.02
"""Limit of the median misclosure [m] of lines measured in both directions. Below it, tracker heads and reflectors were
exchanged on a common forced centring. If they were set up separately over a survey mark, their heights differ by
decimetres."""


def covariates_with_instrument_heights(
    table: PointingTable, covariates: dict[str, Floats], first_setup_of_occupation: Mapping[str, str]
) -> tuple[dict[str, Floats], list[str]]:
    """Copy of `covariates` with the instrument height of the set-up in each row, and notes on empty cells of heights.

    `covariates` are the additional columns of numbers by name, each (n,). A table often gives the height of the
    instrument in the first row of a set-up only, because it is constant, also if the circle is rotated:
    `first_setup_of_occupation` names the first set-up of the same occupation, by name of other set-ups.
    """
    notes = []
    for column in HEIGHT_COLUMNS:
        heights = covariates.get(column)
        if heights is None or np.isfinite(heights).all() or not np.isfinite(heights).any():
            continue
        filled, kind = heights.copy(), "instrument" if column == HEIGHT_COLUMNS[0] else "target"
        if kind == "instrument":
            setups = table.pointings.station
            for names in (setups, [first_setup_of_occupation.get(setup, setup) for setup in setups]):
                _, number = distinct_with_indices(names)
                for index in np.unique(number[np.isnan(filled)]).tolist():
                    rows = number == index
                    values = np.unique(heights[rows & np.isfinite(heights)])
                    if len(values) == 1:
                        filled[rows & np.isnan(filled)] = values[0]
            n_filled = int(np.sum(np.isnan(heights) & np.isfinite(filled)))
            if n_filled:
                notes.append(f"{n_filled} empty heights of instruments are taken from other rows of the same set-up")
        empty_rows = np.flatnonzero(np.isnan(filled)).tolist()
        if empty_rows:
            names = table.pointings.station if kind == "instrument" else table.pointings.target
            empty_row_names = names_text(list(dict.fromkeys(names[row] for row in empty_rows)), 4)
            notes.append(
                f"heights of {kind}s are missing in {len(empty_rows)} rows ({empty_row_names}) and are taken as 0"
            )
        covariates = {**covariates, column: filled}
    return covariates, notes


def reciprocal_lines_agree(table: PointingTable, readings: Floats) -> bool:
    """True if lines measured in both directions agree in length and, if elevations were measured, in height.

    The median misclosure decides. It takes account of the curvature of the earth, but not of heights above survey
    marks. `readings` (n, 3) [m, rad, rad] are those of n pointings.
    """
    lengths = readings[:, 0] * np.cos(np.nan_to_num(readings[:, 2]))
    rises = readings[:, 0] * np.sin(readings[:, 2]) + lengths**2 / (2.0 * EARTH_RADIUS)
    length, rise = _reciprocal_misclosures(table, np.stack([lengths, rises], axis=1), (-1.0, 1.0)).T
    if not len(length):
        return False
    in_height = rise[np.isfinite(rise)]
    medians = [float(np.median(closure)) for closure in (length, in_height) if len(closure)]
    return max(medians) < MAX_FORCED_CENTRING_MISCLOSURE_M


def unapplied_heights_notes(table: PointingTable, readings: Floats, height: Floats) -> list[str]:
    """Note, in a list, that heights in a table are not applied because the readings refer to heads; otherwise empty.

    Heights are those above survey marks. Lines measured in both directions decide: their height differences agree
    either with the heights `height` (n, 2) [m] of instrument and target in n pointings, or without them. `readings` (n,
    3) are in m, rad, rad.
    """
    heights = np.nan_to_num(height)
    if not heights.any():
        return []
    rise = readings[:, 0] * np.sin(readings[:, 2])
    rows = np.flatnonzero(~np.isnan(rise))
    rises = np.stack([rise, rise + heights[:, 0] - heights[:, 1]], axis=1)
    closures = _reciprocal_misclosures(table, rises, (1.0, 1.0), rows)
    if len(closures) < MIN_RECIPROCAL_LINES:
        return []
    if np.median(closures[:, 0]) > MAX_MISCLOSURE_WITHOUT_HEIGHTS_M:
        return []
    for statistic in (np.median, np.max):
        closure_without, closure_with = statistic(closures, axis=0)
        if not closure_without < MAX_MISCLOSURE_RATIO_WITHOUT_TO_WITH_HEIGHTS * closure_with:
            return []
    names = " and ".join(f"'{safe_excerpt(c.title)}'" for c in table.columns if c.role in HEIGHT_ROLES)
    return [
        f"heights in {names} are not applied: {len(closures)} lines measured in both directions close within "
        f"{1e3 * closures[:, 0].max():.3g} mm without them, {1e3 * closures[:, 1].max():.4g} mm with them. "
        "The coordinates are those of heads and reflectors, not of the marks below them. The height of each head is an "
        "observation with the standard deviation height_above_mark_sigma_mm. Plumb lines follow the curved earth (key "
        "curved)"
    ]


def _reciprocal_misclosures(
    table: PointingTable, quantities: Floats, signs: Sequence[float], rows: Ints | None = None
) -> Floats:
    """Magnitudes (k, q) of the misclosures of k lines that were measured in both directions, in q quantities.

    `quantities` (n, q) are those of n pointings, of which the mean is taken for each direction. The sign in `signs` is
    -1 for a quantity that is equal in both directions, and 1 for one that changes its sign. `rows` are the indices of
    the pointings that are used, by default all.
    """
    rows_by_line: dict[tuple[str, str], list[int]] = {}
    lines = list(zip(table.mark_names, table.pointings.target, strict=True))
    for row in range(len(lines)) if rows is None else rows.tolist():
        rows_by_line.setdefault(lines[row], []).append(row)
    mean = {line: np.mean(quantities[of_line], axis=0) for line, of_line in rows_by_line.items()}
    closures = [mean[a, b] + np.multiply(signs, mean[b, a]) for a, b in mean if a < b and (b, a) in mean]
    return np.asarray(np.abs(np.array(closures)).reshape(-1, len(signs)))
