"""Errors of the head beyond the maker's model: bearings, sag, backlash, the tracking detector."""

import numpy as np

from ltsim.arrays import Floats


def half(raw: Floats) -> Floats:
    """The beam misses by half of what the returning spot is off."""
    return np.full(len(raw), 0.5)
