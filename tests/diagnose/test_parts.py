"""Parts of the diagnosis by themselves, each on a network whose answer is known."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from ltsim.adjust import Adjustment, adjust
from ltsim.diagnose.detect import Detection
from ltsim.diagnose.gross import explain_gross
from ltsim.diagnose.refit import refit
from ltsim.diagnose.separate import separating_measurement
from ltsim.diagnose.stations import mend_faces, mend_stations
from ltsim.effects.effect import Effect
from ltsim.effects.range_cyclic import RangeCyclic
from ltsim.effects.station_settling import StationSettling
from ltsim.model.construction import misalignment
from ltsim.model.measurement import MeasurementModel
from ltsim.randomness import stream
from ltsim.recording.recording import Recording
from ltsim.recording.slips import UNIT_SLIPS, Slip
from ltsim.remedies.deciding import DECISIVE
from tests.networks import network

SLIPS = {slip.name: slip for slip in UNIT_SLIPS}


def written(recording: Recording, rows: np.ndarray, slip: Slip) -> Recording:
    """The recording with some rows written down in another unit."""
    readings = recording.readings.copy()
    readings[rows] = slip.written(readings[rows])
    return recording.with_readings(readings)


def row_of(recording: Recording, station: str, target: str) -> int:
    at = (recording.station == recording.stations.index(station)) & (
        recording.target == recording.targets.index(target)
    )
    return int(np.flatnonzero(at)[0])


# --- stations ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("slip", ["metre", "gon", "clockwise", "zenith"])
def test_a_station_in_another_unit_is_mended_to_the_last_micrometre(slip: str) -> None:
    recording, _ = network(seed=4)
    rows = np.flatnonzero(recording.station == 2)
    mended, (finding,) = mend_stations(written(recording, rows, SLIPS[slip]))
    np.testing.assert_allclose(mended.readings, recording.readings, rtol=0, atol=1e-12)
    assert (finding.effect, finding.stations) == ("wrong-unit", (recording.stations[2],))
    assert finding.rows.tolist() == rows.tolist()
    assert finding.sentence == f"Station {recording.stations[2]} was recorded with {SLIPS[slip].cause}."


def test_stations_of_one_shape_are_left_as_they_are() -> None:
    recording, _ = network(seed=4)
    same, findings = mend_stations(recording)
    assert same is recording
    assert findings == []
    two, _ = network(seed=4, stations=2)  # of two that differ nobody can tell which is wrong
    assert mend_stations(written(two, np.flatnonzero(two.station == 1), SLIPS["gon"]))[1] == []


def test_faces_follow_the_raw_elevation() -> None:
    recording, _ = network(faces=2, seed=4)
    stored = recording.face.copy()
    rows = np.flatnonzero((recording.station == 1) & (recording.face == 2))[:3]
    stored[rows] = 1
    mended, (finding,) = mend_faces(recording.replace(face=stored))
    assert mended.face.tolist() == recording.face.tolist()
    assert (finding.effect, finding.rows.tolist()) == ("face-confusion", rows.tolist())
    assert mend_faces(recording) == (recording, [])


# --- gross ------------------------------------------------------------------------------------------------------------


def test_every_mistake_of_one_recording_is_explained_and_mended() -> None:
    recording, _ = network(seed=5)
    s = recording.stations
    first, second = row_of(recording, s[0], "T03"), row_of(recording, s[0], "T14")
    target, readings = recording.target.copy(), recording.readings.copy()
    target[[first, second]] = target[[second, first]]
    unit, off = row_of(recording, s[1], "T07"), row_of(recording, s[3], "T20")
    readings[unit] = SLIPS["gon"].written(readings[[unit]])[0]
    readings[off, 0] += 12e-3
    found = adjust(recording.replace(target=target, readings=readings))
    mended, use, findings = explain_gross(found)
    told = {finding.effect: finding for finding in findings}
    assert sorted(told) == ["outlier", "target-swap", "wrong-unit"]
    assert sorted(told["target-swap"].rows.tolist()) == sorted([first, second])
    assert told["target-swap"].targets == ("T03", "T14")
    assert mended.target.tolist() == recording.target.tolist()
    assert told["wrong-unit"].rows.tolist() == [unit]
    np.testing.assert_allclose(mended.readings[unit], recording.readings[unit], rtol=0, atol=1e-12)
    assert (told["outlier"].rows.tolist(), told["outlier"].observables) == ([off], ("distance",))
    assert told["outlier"].size == pytest.approx(12e-3, abs=0.2e-3)
    assert np.argwhere(~use).tolist() == [[off, 0]]


def test_a_recording_without_gross_errors_is_given_back() -> None:
    found = adjust(network(seed=5)[0])
    same, use, findings = explain_gross(found)
    assert same is found.recording
    assert use.all()
    assert findings == []


# --- refit ------------------------------------------------------------------------------------------------------------


def with_effect(effect: Effect, values: list[float], *, noise: float) -> Recording:
    """A recording, its noise times `noise`, of a tracker without errors and with an effect of known size [SI]."""
    recording, truth = network(faces=2)
    model = MeasurementModel(recording, misalignment(), (effect,))
    exact = model.predict(replace(truth.state, extra=np.array(values)))
    drawn = stream(11, "noise").standard_normal(exact.shape)
    return recording.with_readings(exact + noise * recording.sigma() * drawn)


def refitted(effect: Effect, guess: Effect, values: list[float], *, noise: float = 1.0) -> tuple[Adjustment, dict]:
    recording = with_effect(effect, values, noise=noise)
    plain = adjust(recording, misalignment())
    found = refit(
        recording,
        misalignment(),
        [guess],
        start=plain.state,
        sigma=recording.sigma(),
        use=np.ones((len(recording), 3), dtype=bool),
    )
    return found.adjustment, {estimate.name: estimate for estimate in found.estimates[0]}


def test_a_refit_gives_back_sizes_and_constants_within_their_sigmas() -> None:
    true = StationSettling(("S3",), time_constant=480.0)
    _, told = refitted(true, true.reshaped(time_constant=700.0), [30e-6, -20e-6, 40e-6])
    expected = {"tilt-x": 30.0, "tilt-y": -20.0, "rise": 40.0, "time_constant": 8.0}  # urad, um, min
    assert set(told) == set(expected)
    for name, value in expected.items():
        assert told[name].sigma > 0
        assert abs(told[name].value - value) < 4 * told[name].sigma, name


def test_a_refit_without_noise_ends_at_the_truth() -> None:
    true = RangeCyclic(wavelength=0.75)
    found, told = refitted(true, true.reshaped(wavelength=0.76), [10e-6, 0.0], noise=0.0)
    assert found.chi2 < 1.0
    assert told["wavelength"].value == pytest.approx(750.0, rel=1e-3)  # mm


# --- separate ---------------------------------------------------------------------------------------------------------


def test_what_is_no_question_gets_no_measurement() -> None:
    found = adjust(network(faces=2, seed=6)[0], misalignment())
    assert separating_measurement(found, "range-step", [], ()) == ""
    assert separating_measurement(found, "range-step", ["unknown"], ()) == ""
    assert separating_measurement(found, "range-step", ["station-noise"], ()) == ""
    assert separating_measurement(found, "station-noise", ["range-step"], ()) == ""


def test_a_bump_and_a_settling_are_told_apart_by_another_order_of_the_work() -> None:
    settled = StationSettling(("S3",), time_constant=480.0)
    found = adjust(with_effect(settled, [8e-6, -5e-6, 5e-6], noise=1.0), misalignment())
    advice = separating_measurement(found, "station-settling", ["station-bump"], ())
    assert advice.startswith("measure every station's targets again in the reverse order: expected chi-square")
    before, after = map(float, re.findall(r"from (\d+) to (\d+)", advice)[0])
    assert before < DECISIVE < after


# --- detect -----------------------------------------------------------------------------------------------------------


def test_chances_are_those_of_the_simulated_recordings_and_fall_exponentially_beyond_them() -> None:
    null = stream(3, "null").permutation(np.arange(1000.0))
    found = Detection(0.0, 1.0, 1.0, null)
    assert found.threshold(0.05) == pytest.approx(949.05)
    assert found.chance(-1.0) == 1.0
    assert found.chance(500.0) == pytest.approx(501 / 1001)
    last = found.chance(np.sort(null)[-15])
    assert last == pytest.approx(16 / 1001)
    assert found.chance(np.sort(null)[-15] + np.log(10.0)) == pytest.approx(last / 10)
    assert found.chance(1e4) < 1e-300
