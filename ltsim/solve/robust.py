"""Robust scales and weights."""

from __future__ import annotations

import numpy as np

from ltsim.arrays import Floats

NORMAL_MEDIAN = 0.6744897501960817
"""Median of |x| for a standard normal x."""


def median_deviation(values: Floats) -> float:
    """Standard deviation estimated from the median of absolute values; 0 for none."""
    return float(np.median(np.abs(values))) / NORMAL_MEDIAN if len(values) else 0.0


def absolute_weights(residuals: Floats, floor: float) -> Floats:
    """Weights (m,) that turn a sum of squares into a sum of absolute values at these residuals.

    `floor` bounds the weights where a residual vanishes.
    """
    return 1.0 / np.maximum(np.abs(residuals), floor)
