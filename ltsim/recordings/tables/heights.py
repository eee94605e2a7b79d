"""Completion of heights above survey marks in tables with empty cells."""

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.notation import names_text
from ltsim.recordings.recording import HEIGHT_COLUMNS
from ltsim.recordings.tables.pointing_table import PointingTable, distinct_with_indices


def covariates_with_instrument_heights(
    table: PointingTable, covariates: dict[str, Floats]
) -> tuple[dict[str, Floats], list[str]]:
    """Copy of `covariates` with the instrument height of the set-up in each row, and notes on empty cells of heights.

    `covariates` are the additional columns of numbers by name, each (n,). A table often gives the height of the
    instrument in the first row of a set-up only, because it is constant.
    """
    notes = []
    for column in HEIGHT_COLUMNS:
        heights = covariates.get(column)
        if heights is None or np.isfinite(heights).all() or not np.isfinite(heights).any():
            continue
        filled, kind = heights.copy(), "instrument" if column == HEIGHT_COLUMNS[0] else "target"
        if kind == "instrument":
            _, setup = distinct_with_indices(table.pointings.station)
            for index in np.unique(setup[np.isnan(heights)]).tolist():
                rows = setup == index
                values = np.unique(heights[rows & np.isfinite(heights)])
                if len(values) == 1:
                    filled[rows] = values[0]
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
