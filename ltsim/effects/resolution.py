"""Resolution: encoders and range give whole steps only.

Source: Sensors 2021, 21, 7479, section 2.1.1: 0.018 arcsec and 0.1 um; rounding comes last in the electronics.
"""

from __future__ import annotations

import numpy as np

from ltsim.arrays import Floats

PAPER_ANGLE_ARCSEC = 0.018
PAPER_DISTANCE_UM = 0.1


def quantised(readings: Floats, *, distance: float, angle: float) -> Floats:
    """Readings (n, 3) rounded to whole steps of `distance` [m] and `angle` [rad]; a step of 0 leaves them."""
    rounded = readings.copy()
    for column, step in enumerate((distance, angle, angle)):
        if step > 0.0:
            rounded[:, column] = step * np.round(readings[:, column] / step)
    return rounded
