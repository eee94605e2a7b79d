"""Columns of drivers that are more than a function of a covariate, against what they are by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.physics.laws.columns import first_order_lag_columns
from ltsim.scene.sightings import Sightings
from tests.networks import network


@pytest.fixture(scope="module")
def sightings() -> Sightings:
    return adjust(network(faces=1, seed=1)[0]).sightings


def test_what_lags_comes_to_a_step_by_an_exponential_of_the_time(sightings):
    n = len(sightings)
    time = np.cumsum(np.linspace(5.0, 40.0, n))
    warm = (np.arange(n) >= n // 3).astype(np.float64)
    moved = replace(sightings, time=time, covariates={"hall": 20.0 + warm})
    slow, behind = first_order_lag_columns(moved, "hall", 600.0).T
    since = time - time[n // 3 - 1]
    expected = np.where(warm > 0, 1.0 - np.exp(-since / 600.0), 0.0)
    swing = np.ptp(slow) / np.ptp(expected)
    np.testing.assert_allclose(slow - slow[0], swing * expected, atol=1e-9)
    swing = np.ptp(behind) / np.ptp(warm - expected)
    np.testing.assert_allclose(behind - behind[0], swing * (warm - expected), atol=1e-9)
