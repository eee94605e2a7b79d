from __future__ import annotations

import numpy as np
from hypothesis import given, strategies as st

from ltsim.core.units import ARCSECOND
from ltsim.simulation.physics import round_to_resolution, true_noise_sigmas
from ltsim.simulation.scenario import load_scenario
from ltsim.simulation.simulator import make_measurement_geometry, measure_trial


def test_sigma_is_that_of_a_recording() -> None:
    work = make_measurement_geometry(load_scenario("paper-workshop-two-face"), 3)
    recording, _ = measure_trial(work, 3)
    np.testing.assert_allclose(true_noise_sigmas(work.scenario, work.sightings), recording.reading_sigmas(), rtol=1e-3)


@given(st.floats(-10, 10), st.sampled_from([1e-7, 0.018 * ARCSECOND, 0.5]))
def test_rounding_gives_the_nearest_whole_step(value: float, step: float) -> None:
    rounded = round_to_resolution(np.full((1, 3), value), np.full(3, step))[0, 0]
    assert abs(rounded - value) <= 0.5 * step * (1 + 1e-6)
    assert abs(rounded / step - round(rounded / step)) < 1e-6


def test_without_a_step_readings_stay() -> None:
    readings = np.array([[1.23456789, 2.3456789, 0.987654321]])
    np.testing.assert_array_equal(round_to_resolution(readings, np.zeros(3)), readings)
    assert round_to_resolution(readings, np.array([1e-3, 0.0, 0.0]))[0].tolist() == [1.235, 2.3456789, 0.987654321]
