"""One face in another unit or convention: found in the frame of its station, for any unit, observable and face."""

from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment.blunders import correct_units
from ltsim.adjustment.fieldcheck import check
from ltsim.core.errors import NetworkError
from ltsim.recordings import Recording, read
from ltsim.recordings.face_units import face_unit_errors
from ltsim.recordings.transcription_errors import UNIT_AND_CONVENTION_ERRORS, WrongColumnConversion
from tests.networks import network

ERRORS = {error.name: error for error in UNIT_AND_CONVENTION_ERRORS}
FULL_TURN = 2 * np.pi


def with_wrong_face(recording: Recording, error: WrongColumnConversion, face: int, stations: list[int]) -> Recording:
    """The recording with one face of some stations in another unit, with azimuths that stay within one turn."""
    readings = recording.readings.copy()
    rows = (recording.face == face) & np.isin(recording.station, stations)
    readings[rows] = error.with_error(readings[rows])
    readings[:, 1] %= FULL_TURN
    return recording.with_readings(readings)


@pytest.mark.parametrize("face", [1, 2])
@pytest.mark.parametrize("error", UNIT_AND_CONVENTION_ERRORS, ids=lambda error: error.name)
def test_the_unit_of_a_face_is_detected_at_a_single_station(error: WrongColumnConversion, face: int) -> None:
    recording, _ = network(faces=2, seed=4)
    corrected, findings = correct_units(with_wrong_face(recording, error, face, [2]))
    np.testing.assert_allclose(corrected.readings[:, 0], recording.readings[:, 0], rtol=1e-12)
    turned = np.exp(1j * (corrected.readings - recording.readings)[:, 1:])
    np.testing.assert_allclose(np.angle(turned), 0.0, atol=1e-9)
    assert {finding.effect_name for finding in findings} == {"wrong-unit"}
    assert {finding.stations for finding in findings} == {(recording.stations[2],)}


@pytest.mark.parametrize("name", ["metre", "gon", "gon-azimuth", "degree-azimuth", "zenith", "radian"])
def test_the_unit_of_a_face_is_detected_at_all_stations(name: str) -> None:
    recording, _ = network(faces=2, seed=4)
    everywhere = list(range(len(recording.stations)))
    (error,) = face_unit_errors(with_wrong_face(recording, ERRORS[name], 2, everywhere))
    assert (error.transcription_error.name, error.face, error.stations) == (name, 2, recording.stations)


def test_faces_that_agree_have_no_unit_error() -> None:
    recording, _ = network(faces=2, seed=4)
    assert face_unit_errors(recording) == []
    assert face_unit_errors(network(seed=4)[0]) == []
    readings = recording.readings.copy()
    readings[recording.face == 2, 1] += 0.01  # a collimation error of half a degree is no unit
    assert face_unit_errors(recording.with_readings(readings)) == []


def test_directions_alone_show_the_unit_of_a_face() -> None:
    recording, _ = network(faces=2, seed=4)
    wrong = with_wrong_face(recording, ERRORS["gon-azimuth"], 1, [0])
    directions = wrong.with_readings(np.where([False, True, False], wrong.readings, np.nan))
    (error,) = face_unit_errors(directions)
    assert (error.transcription_error.changed_columns, error.face) == ((1,), 1)


def table(path: Path, factor: float) -> Path:
    """Table with a column per face, of which the azimuths of the first are multiplied by a factor."""
    recording, _ = network(faces=2, seed=4)
    rows = ["Station,Target,Hz1[deg],V1[deg],D1[mm],Hz2[deg],V2[deg],D2[mm]"]
    for station in range(len(recording.stations)):
        for target in range(len(recording.targets)):
            at = (recording.station == station) & (recording.target == target)
            cells = [recording.stations[station], recording.targets[target]]
            for face in (1, 2):
                distance, azimuth, elevation = recording.readings[at & (recording.face == face)][0]
                circle = np.degrees(-azimuth % FULL_TURN) * (factor if face == 1 else 1.0)
                cells += [f"{circle:.9f}", f"{np.degrees(np.pi / 2 - elevation) % 360:.9f}", f"{distance * 1e3:.6f}"]
            rows.append(",".join(cells))
    path.write_text("\n".join(rows) + "\n")
    return path


def test_every_command_names_the_face_in_a_wrong_unit(tmp_path: Path) -> None:
    recording = read(table(tmp_path / "faces.csv", 0.9))
    stations = ", ".join(recording.stations)
    sentence = f"azimuths of face 1 at stations {stations} were recorded with degrees for gon of the azimuth"
    assert any(sentence in note and "multiply by 1.11111" in note for note in recording.notes)
    for refuses in (lt.adjust, lt.calibrate):
        with pytest.raises(NetworkError, match="degrees for gon of the azimuth: read the recording again"):
            refuses(recording)
    result = check(recording)
    assert not result.passed
    assert sentence in result.sentence
    assert {item.kind for item in result.items if not item.passed} == {"mistake", "network"}
    assert sentence in str(lt.diagnose(recording, held_out=False))
    right = read(table(tmp_path / "right.csv", 1.0))
    assert not any("of face" in note for note in right.notes)
