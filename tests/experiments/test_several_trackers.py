"""Several trackers on one network of 100 set-ups, one of them off: which one, which constant, and how much."""

from __future__ import annotations

import numpy as np
import pytest

import ltsim as lt
from tests.experiments.several_trackers import scenario_of


def test_the_trackers_take_turns_and_every_setup_shares_reflectors() -> None:
    recording, truth = lt.simulate(scenario_of(setups=20), seed=1)
    assert recording.instruments == ("A", "B", "C", "D")
    assert [t.stations[:2] for t in truth.instruments][:2] == [("S001", "S005"), ("S002", "S006")]
    assert truth.instrument_values["beam-tilt@C"] == pytest.approx(15e-6)
    assert np.bincount(recording.station).min() >= 6 and len(recording.notes) == 1


@pytest.mark.long
@pytest.mark.parametrize(
    ("off", "name", "size", "faces"),
    [
        ("C", "beam-tilt", 15.0, 1),
        ("A", "vertical-index", -20.0, 2),
        ("B", "range-offset", 30.0, 1),
        ("D", "transit-tilt", 12.0, 1),
    ],
)
def test_the_constant_that_is_off_stands_out_and_lies_in_its_interval(
    off: str, name: str, size: float, faces: int
) -> None:
    recording, truth = lt.simulate(scenario_of(off=off, errors={name: size}, faces=faces), seed=11)
    assert len(recording.stations) == 100
    calibration = lt.calibrate(recording)
    values, sigma = calibration.estimates.ravel(), calibration.sigma.ravel()
    outstanding = [
        flat for flat, z in zip(calibration.instrument_parameter_names, values / sigma, strict=True) if abs(z) > 5
    ]
    assert outstanding == [f"{name}@{off}"]
    at = calibration.instrument_parameter_names.index(f"{name}@{off}")
    assert abs(values[at] - truth.instrument_values[f"{name}@{off}"]) < 1.96 * sigma[at]


@pytest.mark.long
@pytest.mark.parametrize(
    ("off", "name", "size", "faces"),
    [("C", "beam-tilt", 30.0, 1), ("A", "vertical-index", -20.0, 2), ("B", "range-offset", 30.0, 1)],
)
def test_a_diagnosis_tells_which_tracker_is_off_in_what_and_how_much(
    off: str, name: str, size: float, faces: int
) -> None:
    """A constant within one standard deviation of its prior, such as a tilt of 15 urad, is not reported."""
    scenario = scenario_of(setups=100, trackers=3, off=off, errors={name: size}, faces=faces)
    recording, truth = lt.simulate(scenario, seed=23)
    first = lt.diagnose(recording, held_out=False).findings[0]
    value = next(p for p in first.parameters if name in p.name)
    assert first.effect == name and list(first.where.instruments) == [off]
    assert abs(value.value - 1e6 * truth.instrument_values[f"{name}@{off}"]) < 1.96 * value.sigma
