"""Choices among equal values do not follow rounding errors."""

from __future__ import annotations

import numpy as np

from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE, index_of_largest


def test_the_first_of_values_that_differ_by_rounding_is_the_largest() -> None:
    """A field check named row 149 or row 150, by the processor: the two readings of a target in two faces."""
    values = np.array([1.0, 28.0, 28.0, 2.0])
    rng = np.random.default_rng(1)
    for _ in range(20):
        assert index_of_largest(values * (1.0 + 0.1 * NORMAL_EQUATIONS_TOLERANCE * rng.standard_normal(4))) == 1
    assert index_of_largest([0.0, -1.0]) == 0
    assert index_of_largest([-np.inf, -5.0, -3.0]) == 2
