"""Mistakes of the work: named from what they leave, and mended where they are understood."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.doubt import doubts
from ltsim.adjustment.gross import explain_gross, mend_faces, mend_stations
from ltsim.recordings.recording import Recording
from ltsim.recordings.transcription_errors import UNIT_ERRORS, TranscriptionError
from tests.networks import network

SLIPS = {slip.name: slip for slip in UNIT_ERRORS}


def written(recording: Recording, rows: np.ndarray, slip: TranscriptionError) -> Recording:
    """The recording with some rows written down in another unit."""
    readings = recording.readings.copy()
    readings[rows] = slip.written(readings[rows])
    return recording.with_readings(readings)


def row_of(recording: Recording, station: str, target: str) -> int:
    at = (recording.station == recording.stations.index(station)) & (
        recording.target == recording.targets.index(target)
    )
    return int(np.flatnonzero(at)[0])


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
    (doubt,) = doubts(found)
    assert "the reflectors T03 and T14" in doubt
    assert "gon for degrees" in doubt
    assert "T20" not in doubt  # an outlier alone is no mistake that anybody can name
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
