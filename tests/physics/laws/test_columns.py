"""Columns of drivers that are more than a function of a covariate, against what they are by hand."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.physics.laws.columns import first_order_lag_columns, scaled_to_unit_rms
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


@pytest.mark.parametrize("size", [1e-200, 1.0, 1e200, 1.7e308])
def test_a_column_whose_squares_are_no_numbers_has_an_rms_of_1(size: float) -> None:
    column = size * np.array([[1.0], [-0.5], [0.0]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scaled = scaled_to_unit_rms(column)
    assert np.sqrt(np.mean(scaled**2)) == pytest.approx(1.0)
    assert scaled[1, 0] == -0.5 * scaled[0, 0]
    assert not scaled_to_unit_rms(np.zeros((3, 1))).any()
