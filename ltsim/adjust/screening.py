"""Gross errors seen before any adjustment: pointings that land elsewhere by more than any tracker error."""

from __future__ import annotations

import numpy as np

from ltsim.arrays import Bools, Floats
from ltsim.geometry.polar import from_polar
from ltsim.recording.recording import Recording
from ltsim.solve.robust import median_deviation

LARGEST_ERROR = 1e-3
"""[m] what no tracker error of a plausible size reaches at workshop range (physics.md section 2.2)."""
FACTOR = 30.0


def gross_pointings(recording: Recording, position: Floats, rotation: Floats, points: Floats) -> Bools:
    """(n,) True where a pointing misses its target by far more than the rest of the recording does.

    A swapped or misnamed reflector, a wrong unit in one row. These rows stay out of the adjustment and are reported.
    """
    measured = from_polar(recording.readings)
    placed = np.einsum("nij,nj->ni", rotation[recording.station], measured) + position[recording.station]
    miss = np.linalg.norm(placed - points[recording.target], axis=1)
    usual = median_deviation(miss[np.isfinite(miss)])
    limit = max(LARGEST_ERROR, FACTOR * usual)
    return np.nan_to_num(miss) > limit
