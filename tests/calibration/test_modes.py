"""Two distance meters with zeros of their own in one recording."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.distance import calibrate_distance
from ltsim.calibration.files import write_calibration
from ltsim.calibration.network import calibrate_network
from ltsim.diagnosis.diagnose import diagnose
from ltsim.recordings.native import read_recording, write_recording
from ltsim.recordings.recording import Recording
from tests.networks import network

STEP = 30e-6


def with_modes(seed: int) -> Recording:
    """Each target in the mode of its number, the interferometer's ranges too short by 30 um."""
    recording, _ = network(faces=2, seed=seed)
    modes = tuple("ifm" if t % 2 else "adm" for t in recording.target)
    readings = recording.readings.copy()
    readings[[m == "ifm" for m in modes], 0] -= STEP
    return recording.with_readings(readings).replace(labels={"distance_mode": modes})


@pytest.mark.long
def test_a_range_zero_for_each_mode_is_estimated_and_reported(tmp_path: Path) -> None:
    write_recording(with_modes(8), tmp_path)
    calibration = calibrate_network(read_recording(tmp_path))
    assert calibration.adjustment is not None
    sigma = float(np.sqrt(calibration.adjustment.effect_covariance[0, 0]))
    assert calibration.adjustment.state.extra_parameters[0] == pytest.approx(STEP, abs=4 * sigma)
    assert calibration.fit.p_value is not None and calibration.fit.p_value > 1e-3
    assert "range-mode" in calibration.notes[0]
    assert write_calibration(calibration, tmp_path / "out") is not None


@pytest.mark.long
def test_the_diagnosis_names_the_mode() -> None:
    first = diagnose(with_modes(8)).findings[0]
    assert (first.effect, first.where.covariates) == ("range-mode", ("distance_mode",))


def test_a_single_mode_has_a_single_zero() -> None:
    recording, _ = network(seed=2)
    interferometer = recording.replace(labels={"distance_mode": ("ifm",) * len(recording)})
    assert "distance_mode" not in interferometer.regressor_covariates


@pytest.mark.long
@pytest.mark.parametrize("calibrate", [lt.adjust, partial(calibrate_distance, advise=False)])
def test_functions_that_assume_a_common_zero_report_it(calibrate: Callable[[Recording], Calibration]) -> None:
    assert "one range zero assumed for both" in calibrate(with_modes(8)).notes[0]
