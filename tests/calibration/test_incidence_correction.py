"""Estimated incidence errors of reflectors: in the result, in its file, and taken out of readings."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.files import read_calibration, write_calibration
from ltsim.core.errors import RecordError
from ltsim.physics.effects.smr_incidence import SmrIncidence
from ltsim.recordings import Recording
from ltsim.simulation.truth import Truth

QUIET = {"instrument.noise_factor": 0.05}


@cache
def calibrated() -> tuple[Recording, Truth, Calibration]:
    recording, truth = lt.simulate("paper-workshop", seed=5, changes=QUIET)
    return recording, truth, lt.calibrate(recording)


def coordinate_after(calibration: Calibration) -> float:
    return float(lt.evaluate(calibrated()[0], calibration).coordinate.after.mean_um)


def test_the_estimate_is_that_of_the_simulated_reflector() -> None:
    """Over the angles of the recording, at most a third of the true error is left."""
    _, truth, calibration = calibrated()
    applied = next(entry for entry in truth.applied_effects if isinstance(entry.effect, SmrIncidence))
    sightings = calibration.adjustment.sightings
    true = applied.effect.reading_change(sightings, np.array(applied.parameter_values))[:, 0]
    estimated = (SmrIncidence().design(sightings) @ calibration.applied_reflectors[""])[:, 0]
    rest = estimated - true - np.mean(estimated - true)
    assert np.std(rest) < 0.33 * np.std(true)


def test_it_is_taken_out_with_the_parameters() -> None:
    recording, _, calibration = calibrated()
    without = calibration.with_changes(reflectors=())
    assert coordinate_after(calibration) < 0.7 * coordinate_after(without)
    change = lt.correct(recording, calibration).readings - lt.correct(recording, without).readings
    assert 1e-6 < np.abs(change[:, 0]).max() < 20e-6
    assert np.abs(change[:, 1:]).max() < 1e-9


def test_criteria_of_the_calibration_are_those_of_evaluate() -> None:
    _, _, calibration = calibrated()
    assert coordinate_after(calibration) == pytest.approx(calibration.criteria.coordinate.after.mean_um, rel=1e-3)


def test_no_correction_takes_nothing_out() -> None:
    recording, _, calibration = calibrated()
    nothing = calibration.with_changes(applied_values=np.zeros_like(calibration.estimates))
    assert nothing.applied_reflectors == {}
    np.testing.assert_allclose(lt.correct(recording, nothing).readings, recording.readings, atol=1e-15)


def test_the_file_gives_it_back(tmp_path: Path) -> None:
    recording, _, calibration = calibrated()
    write_calibration(calibration, tmp_path)
    again = read_calibration(tmp_path)
    assert again.reflectors == calibration.reflectors
    np.testing.assert_allclose(
        lt.correct(recording, again).readings, lt.correct(recording, calibration).readings, atol=1e-15
    )


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [("name", "even-fifth", "even-fifth"), ("unit", "mm", "expected a number in um"), ("value", "much", "expected")],
)
def test_a_wrong_entry_of_the_file_is_refused(tmp_path: Path, key: str, value: str, says: str) -> None:
    write_calibration(calibrated()[2], tmp_path)
    file = tmp_path / "calibration.json"
    content = json.loads(file.read_text())
    content["reflectors"][0]["parameters"][0][key] = value
    file.write_text(json.dumps(content))
    with pytest.raises(RecordError, match=says):
        read_calibration(tmp_path)


def test_a_recording_without_the_directions_of_nests_keeps_its_readings() -> None:
    recording, _, calibration = calibrated()
    targets = {n: t.model_copy(update={"nest_normal": None}) for n, t in recording.setup.targets.items()}
    bare = recording.replace(setup=recording.setup.model_copy(update={"targets": targets}))
    corrected, without = (lt.correct(bare, c) for c in (calibration, calibration.with_changes(reflectors=())))
    np.testing.assert_array_equal(corrected.readings, without.readings)
