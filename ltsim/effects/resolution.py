"""Resolution: encoders and range give whole steps only.

Source: Sensors 2021, 21, 7479, section 2.1.1: 0.018 arcsec and 0.1 um; rounding comes last in the electronics.
"""

import numpy as np

from ltsim.arrays import Floats

PAPER_ANGLE_ARCSEC = 0.018
PAPER_DISTANCE_UM = 0.1


def quantised(readings: Floats, step: Floats) -> Floats:
    """Readings (n, 3) rounded to whole steps (3,) or (n, 3) [m, rad, rad]; a step of 0 leaves them."""
    step = np.broadcast_to(step, readings.shape)
    return np.where(step > 0.0, step * np.round(readings / np.where(step > 0.0, step, 1.0)), readings)
