"""SpatialAnalyzer's instrument report: units, zenith angles, poses, groups, switched-off lines, cuts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ltsim.core.errors import RecordError
from ltsim.geometry.polar import swap_front_and_raw, to_polar
from ltsim.recordings import Hints, read
from ltsim.recordings.formats import spatialanalyzer
from tests.recordings.samples import POINTS, outcome, shared

TILTS = np.array([[0.02, -0.01, 0.4], [-0.015, 0.005, -2.2]])
POSITIONS = np.array([[2.2, 2.0, 1.5], [3.6, 4.1, 1.7]])
HEADING = (
    "Collection;Group;Target;Azimuth (gon);Elevation (gon);Distance (mm);"
    "Offset1 (mm);Offset2 (mm);Date & Time;;User;Active"
)


def comma(value: float, digits: int = 9) -> str:
    return f"{value:.{digits}f}".replace(".", ",")


def report(path: Path, *, poses: bool = True, clockwise: bool = True, stations: int = 2) -> Path:
    """An invented report in the layout that SpatialAnalyzer exports."""
    lines = [";;;;;;;;;;;"] * 4 + ['"Instruments - CompositeReport', '";;;;;;;;;;;', ";;;;;;;;;;;"]
    for s in range(stations):
        rotation = Rotation.from_euler("xyz", TILTS[s]).as_matrix()
        polar = to_polar((POINTS - POSITIONS[s]) @ rotation)
        name = f"Hall A::{s} - Leica AT960/930"
        lines += ['"Transform', f'{name}";;;;;;;;;;;', f"# Meas.;{2 * len(POINTS) + 1};;;;;;;;;;"]
        if poses:
            lines += ["Scale Factor;1;;;;;;;;;;", "Position;X;Y;Z;;;;;;;;"]
            lines += ["(mm);" + ";".join(comma(v * 1e3, 4) for v in POSITIONS[s]) + ";;;;;;;;"]
            lines += ["Rotation;Rx;Ry;Rz;;;;;;;;"]
            lines += ["(gon);" + ";".join(comma(v * 200 / np.pi % 400, 7) for v in TILTS[s]) + ";;;;;;;;"]
        lines += ['"Observations', f'{name}";;;;;;;;;;;', HEADING]
        for t in range(len(POINTS)):
            for face in (1, 2):
                raw = swap_front_and_raw(polar[t : t + 1], np.array([face]))[0]
                hz = (-raw[1] if clockwise else raw[1]) % (2 * np.pi) * 200 / np.pi
                v = (np.pi / 2 - raw[2]) % (2 * np.pi) * 200 / np.pi
                numbers = ";".join(comma(x) for x in (hz, v, raw[0] * 1e3))
                lines.append(f"Hall A;G{s};T{t + 1};{numbers};19,05;19,05;20.09.2021 08:{10 * s + t:02d};;;Yes")
        last = lines[-1].replace(";Yes", ";No").replace("T6", "T7")
        lines.append(last)
    path.write_text("\ufeff" + "\n".join(lines) + "\n", encoding="utf-8")
    return path


def truth(s: int) -> np.ndarray:
    rotation = Rotation.from_euler("xyz", TILTS[s]).as_matrix()
    return to_polar((POINTS - POSITIONS[s]) @ rotation)


@pytest.mark.parametrize("clockwise", [True, False])
def test_a_report_is_understood(tmp_path: Path, clockwise: bool) -> None:
    recording = read(report(tmp_path / "r.csv", clockwise=clockwise))
    assert recording.stations == ("Instrument_0", "Instrument_1")
    assert recording.targets == ("T1", "T2", "T3", "T4", "T5", "T6")
    for s in (0, 1):
        front = (recording.station == s) & (recording.face == 1)
        got, want = recording.readings[front], truth(s)
        np.testing.assert_allclose(got[:, [0, 2]], want[:, [0, 2]], atol=1e-9)
        np.testing.assert_allclose(np.mod(got[:, 1] - want[:, 1] + 1, 2 * np.pi), 1, atol=1e-9)
    sense = "clockwise" if clockwise else "counter-clockwise"
    notes = " ".join(recording.notes)
    assert (
        f"azimuths are interpreted as {sense}, because all stations at their approximate positions then agree" in notes
    )
    assert "is interpreted as zenith angles" in notes
    assert "2 observations are not active" in notes
    assert recording.has_clock
    assert recording.time.max() == 15 * 60
    assert set(recording.covariates["offset1_mm"]) == {19.05}
    assert set(recording.labels["group"]) == {"G0", "G1"}
    station = recording.station_setup("Instrument_0")
    np.testing.assert_allclose(station.position_mm, POSITIONS[0] * 1e3)
    assert station.yaw_deg == pytest.approx(np.degrees(TILTS[0, 2]), abs=0.05)
    assert station.instrument == "Leica AT960-930"


def test_without_poses_the_usual_sense_is_assumed_and_reported(tmp_path: Path) -> None:
    recording = read(report(tmp_path / "r.csv", poses=False))
    assert any("the file does not show the sense" in note for note in recording.notes)
    given = read(report(tmp_path / "r.csv", poses=False), hints=Hints(azimuth="counter-clockwise"))
    np.testing.assert_allclose(np.mod(given.readings[:, 1] + recording.readings[:, 1] + 1, 2 * np.pi), 1, atol=1e-9)


def test_a_name_in_two_places(tmp_path: Path) -> None:
    """A name that stands for other points in another group gets the group in front, except where most saw it."""
    file = report(tmp_path / "r.csv")
    lines = file.read_text(encoding="utf-8").split("\n")
    extra = "Hall A;Line;T1;10,5;99,5;2500,25;19,05;19,05;20.09.2021 09:00;;;Yes"
    place = max(i for i, line in enumerate(lines) if line.startswith("Hall A;G1"))
    lines[place] = extra
    file.write_text("\n".join(lines), encoding="utf-8")
    recording = read(file)
    assert set(recording.targets) == {"T1", "T2", "T3", "T4", "T5", "T6", "Line:T1"}
    assert any("1 names stand for points at different positions" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("Azimuth (gon)", "Azimuth (parsec)", "unit 'parsec' in this heading"),
        ("Distance (mm)", "Distance", "unit '' in this heading"),
        ("Azimuth (gon)", "Distance (gon)", "2 columns called Distance|0 columns called Azimuth"),
        ("Collection;Group", "Group", "no heading"),
        ("# Meas.;13", "# Meas.;14", "declares 14 observations, but contains 13"),
        (";T3;", ";T<3;", "holds '<'"),
        (";T3;", ";T3;x", "expected a number"),
        ("(mm);2200", "(mm);abc", "expected a number"),
        ("(mm);2200", "(miles);2200", "the unit 'miles' of the pose"),
        ('"Observations', '"Observ"ations', "the table cannot be read"),
    ],
)
def test_wrong_reports(tmp_path: Path, old: str, new: str, says: str) -> None:
    file = report(tmp_path / "r.csv")
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new), encoding="utf-8")
    result = outcome(lambda: read(file, format="spatialanalyzer"))
    assert isinstance(result, str)
    assert any(part in result for part in says.split("|")), result


def test_a_report_of_too_many_observations_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """370,000 took 38 s and 910 MB."""
    monkeypatch.setattr(spatialanalyzer, "MAX_REPORT_OBSERVATIONS", 20)
    with pytest.raises(RecordError, match="more observations than a report may hold, expected at most 20; export the"):
        read(report(tmp_path / "r.csv"))


def test_a_cut_report(tmp_path: Path) -> None:
    """Whatever is missing, the announced number of observations tells, or what is left is whole."""
    file = report(tmp_path / "r.csv")
    content = file.read_bytes()
    for cut in range(0, len(content), 7):
        file.write_bytes(content[:cut])
        result = outcome(lambda: read(file, format="spatialanalyzer"))
        assert isinstance(result, str) or len(result) in (12, 24)


def test_the_real_reports() -> None:
    file = shared("recordings", "desy-girder-at960", "SA_CompositeReport_20Sep21.csv")
    if not file.exists():
        pytest.skip("the recordings of the girder are not beside this checkout")
    recording = read(file)
    assert len(recording) == 500
    assert any("azimuths are interpreted as clockwise, because all stations" in note for note in recording.notes)
    polar = read(file.with_name("Polar_measurements_20Sep21.txt"), hints=Hints(azimuth="clockwise"))
    rows = {tuple(np.round(r, 9)) for r in recording.readings}
    assert all(tuple(np.round(r, 9)) in rows for r in polar.readings)
    with pytest.raises(RecordError, match="no such file"):
        read(file.with_name("missing.csv"))
    single = read(shared("recordings", "format-samples", "sa_instrument_report_single_station.csv"))
    assert len(single) == 101
