"""Mistakes of the work: named from what they leave, and mended where they are understood."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.blunders import correct_faces, correct_units
from ltsim.adjustment.identification import cause_tests, identify_causes
from ltsim.adjustment.quality import adjustment_warnings
from ltsim.recordings.recording import Recording
from ltsim.recordings.transcription_errors import UNIT_AND_CONVENTION_ERRORS, WrongColumnConversion
from tests.networks import network

SLIPS = {slip.name: slip for slip in UNIT_AND_CONVENTION_ERRORS}


def written(recording: Recording, rows: np.ndarray, slip: WrongColumnConversion) -> Recording:
    """The recording with some rows written down in another unit."""
    readings = recording.readings.copy()
    readings[rows] = slip.with_error(readings[rows])
    return recording.with_readings(readings)


def row_of(recording: Recording, station: str, target: str) -> int:
    at = (recording.station == recording.stations.index(station)) & (
        recording.target == recording.targets.index(target)
    )
    return int(np.flatnonzero(at)[0])


@pytest.mark.parametrize("slip", ["metre", "gon", "clockwise", "zenith"])
def test_a_station_in_another_unit_is_corrected_to_the_last_micrometre(slip: str) -> None:
    recording, _ = network(seed=4)
    rows = np.flatnonzero(recording.station == 2)
    corrected, (finding,) = correct_units(written(recording, rows, SLIPS[slip]))
    np.testing.assert_allclose(corrected.readings, recording.readings, rtol=0, atol=1e-12)
    assert (finding.effect_name, finding.stations) == ("wrong-unit", (recording.stations[2],))
    assert finding.pointing_indices.tolist() == rows.tolist()
    assert finding.sentence == f"Station {recording.stations[2]} was recorded with {SLIPS[slip].description}."


def test_stations_of_equal_shape_are_not_changed() -> None:
    recording, _ = network(seed=4)
    same, findings = correct_units(recording)
    assert same is recording
    assert findings == []
    two, _ = network(seed=4, stations=2)  # of two that differ nobody can tell which is wrong
    assert correct_units(written(two, np.flatnonzero(two.station == 1), SLIPS["gon"]))[1] == []


def test_faces_follow_the_raw_elevation() -> None:
    recording, _ = network(faces=2, seed=4)
    stored = recording.face.copy()
    rows = np.flatnonzero((recording.station == 1) & (recording.face == 2))[:3]
    stored[rows] = 1
    corrected, (finding,) = correct_faces(recording.replace(face=stored))
    assert corrected.face.tolist() == recording.face.tolist()
    assert (finding.effect_name, finding.pointing_indices.tolist()) == ("face-confusion", rows.tolist())
    assert correct_faces(recording) == (recording, [])


@pytest.mark.long
def test_every_mistake_of_a_recording_is_explained_and_corrected() -> None:
    recording, _ = network(seed=5)
    s = recording.stations
    first, second = row_of(recording, s[0], "T03"), row_of(recording, s[0], "T14")
    target, readings = recording.target.copy(), recording.readings.copy()
    target[[first, second]] = target[[second, first]]
    unit, off = row_of(recording, s[1], "T07"), row_of(recording, s[3], "T20")
    readings[unit] = SLIPS["gon"].with_error(readings[[unit]])[0]
    readings[off, 0] += 12e-3
    adjustment = adjust(recording.replace(target=target, readings=readings))
    (doubt,) = adjustment_warnings(adjustment)
    assert "the reflectors T03 and T14" in doubt
    assert "gon for degrees" in doubt
    assert "T20" not in doubt  # an outlier alone is no mistake that anybody can name
    selection = identify_causes(recording.replace(target=target, readings=readings))
    assert selection is not None
    tests = {test.kind: test for test in cause_tests(selection)}
    assert sorted(tests) == ["names", "outlier", "unit"]
    assert sorted(tests["names"].rows) == sorted([first + 1, second + 1])
    assert tests["names"].where.targets == ("T03", "T14")
    assert selection.fit.recording.target.tolist() == recording.target.tolist()
    assert tests["unit"].rows == (unit + 1,)
    np.testing.assert_allclose(selection.fit.recording.readings[unit], recording.readings[unit], rtol=0, atol=1e-12)
    assert (tests["outlier"].rows, tests["outlier"].acts_on) == ((off + 1,), "distance")
    assert tests["outlier"].estimate == pytest.approx(12.0, abs=0.2)
    assert np.argwhere(selection.fit.is_outlier).tolist() == [[off, 0]]


def test_a_recording_without_gross_errors_stays_as_it_is() -> None:
    recording = network(seed=5)[0]
    selection = identify_causes(recording)
    assert selection is not None
    assert selection.selected_hypotheses == ()
    np.testing.assert_array_equal(selection.fit.recording.readings, recording.readings)
    assert not selection.fit.is_outlier.any()
