"""Targets after a diagnosis: what an unknown law does to them is taken off as far as it is safe."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.diagnose.averaging import HARM, WORSE, safe_share
from ltsim.randomness import stream


@pytest.mark.parametrize("size", [0.01, 0.1, 1.0, 10.0])
@pytest.mark.parametrize("along", [0.02, 0.3])
def test_coordinates_become_much_worse_as_rarely_as_is_said(size, along):
    """The error is drawn of which nothing is known but its covariance; a share of it lies along the change."""
    count, spread = 60, size * along
    share = safe_share(size, spread, 1.0)
    rng = stream(8, "safe")
    error = rng.standard_normal((20_000, count)) * np.sqrt([along, *np.full(count - 1, (1.0 - along) / (count - 1))])
    shift = np.zeros(count)
    shift[0] = np.sqrt(size)
    before, after = (np.sum((error + part * shift) ** 2, axis=1) for part in (1.0, 1.0 - share))
    harmed = float(np.mean(after > (1.0 + WORSE) ** 2 * before))
    assert harmed < 2.5 * HARM  # e'e is taken to be its expectation
    if 0.05 < share < 1.0 and along < 0.1:
        assert harmed > 0.5 * HARM


def test_a_law_that_does_much_is_taken_off_whole():
    assert safe_share(100.0, 1.0, 1.0) == 1.0
    assert safe_share(0.0, 0.0, 1.0) == 1.0
    assert safe_share(1.0, 1.0, 1.0) < 0.5
