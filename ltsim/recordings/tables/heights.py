"""Heights above marks in tables whose cells are filled in part."""

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.notation import listing
from ltsim.recordings.recording import HEIGHT_COLUMNS
from ltsim.recordings.tables.printed import PointingTable, indices_by_value


def with_heights_of_setups(table: PointingTable, covariates: dict[str, Floats]) -> tuple[dict[str, Floats], list[str]]:
    """Covariates in which the single height of a set-up applies to all of its rows, and notes on empty heights.

    An instrument keeps its height within a set-up, so that tables often give it in the first row only.
    """
    notes = []
    for column in HEIGHT_COLUMNS:
        heights = covariates.get(column)
        if heights is None or np.isfinite(heights).all() or not np.isfinite(heights).any():
            continue
        filled, kind = heights.copy(), "instrument" if column == HEIGHT_COLUMNS[0] else "target"
        if kind == "instrument":
            _, setup = indices_by_value(table.pointings.station)
            for index in np.unique(setup[np.isnan(heights)]).tolist():
                rows = setup == index
                values = np.unique(heights[rows & np.isfinite(heights)])
                if len(values) == 1:
                    filled[rows] = values[0]
            n_filled = int(np.sum(np.isnan(heights) & np.isfinite(filled)))
            if n_filled:
                notes.append(f"{n_filled} empty heights of instruments are those of the same set-up in other rows")
        empty = np.flatnonzero(np.isnan(filled)).tolist()
        if empty:
            names = table.pointings.station if kind == "instrument" else table.pointings.target
            of = listing(list(dict.fromkeys(names[row] for row in empty)), 4)
            notes.append(f"heights of {kind}s are empty in {len(empty)} rows ({of}): 0 is assumed there")
        covariates = {**covariates, column: filled}
    return covariates, notes
