"""OpenIndy projects: kinds of readings, points and surfaces, hostile files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ltsim.recordings import read
from tests.recordings.samples import outcome, shared


def observation(number: int, kind: str, target: int, values: dict[str, float], *, valid: int = 1, face: int = 1) -> str:
    measured = "".join(f'<measurement sigma="0.00002" value="{v!r}" type="{n}"/>' for n, v in values.items())
    return (
        f'<observation id="{number}" isValid="{valid}"><station ref="5"/>'
        f'<reading id="{number + 500}" time="2024-05-01T10:00:{number:02d}" face="{face}" type="{kind}">'
        f'<measurements>{measured}</measurements></reading><measuredTargetGeometry ref="{target}"/></observation>'
    )


POLAR = {"azimuth": 1.25, "zenith": 1.0, "distance": 3.5}
SAMPLE = (
    '<oiProjectData name="hall.xml"><stations><station id="5" name="ST1"/></stations>'
    '<geometries><geometry id="8" name="P1" type="point"/><geometry id="9" name="floor" type="plane"/></geometries>'
    "<observations>"
    + observation(10, "polar", 8, POLAR)
    + observation(11, "polar", 8, POLAR | {"zenith": 2 * np.pi - 1.0, "azimuth": 1.25 + np.pi}, face=2)
    + observation(12, "polar", 9, POLAR)
    + observation(13, "cartesian", 9, {"x": 1.0, "y": 2.0, "z": 2.0})
    + observation(14, "direction", 8, {"azimuth": 0.5, "zenith": 1.5})
    + observation(15, "distance", 8, {"distance": 2.5})
    + observation(16, "polar", 8, POLAR, valid=0)
    + observation(17, "temperature", 8, {"temperature": 20.0})
    + "</observations></oiProjectData>\n"
)


def project(path: Path, old: str = "", new: str = "") -> Path:
    assert old in SAMPLE
    path.write_text(SAMPLE.replace(old, new, 1) if old else SAMPLE)
    return path


def test_readings(tmp_path: Path) -> None:
    recording = read(project(tmp_path / "p.xml"))
    assert recording.stations == ("ST1",)
    assert recording.targets == ("P1", "floor.12", "floor.13")
    assert list(recording.face) == [1, 2, 1, 1, 1, 1]
    np.testing.assert_allclose(recording.readings[0], [3.5, 1.25, np.pi / 2 - 1])
    np.testing.assert_allclose(recording.readings[1], [3.5, 1.25 + np.pi, np.pi / 2 + 1])
    np.testing.assert_allclose(recording.readings[3, 0], 3.0)
    assert list(recording.is_measured[4]) == [False, True, True]
    assert list(recording.is_measured[5]) == [True, False, False]
    assert list(recording.time) == [0, 1, 2, 3, 4, 5]
    np.testing.assert_allclose(recording.reading_sigmas()[0], [2e-5] * 3)
    notes = " ".join(recording.notes)
    assert "1 readings are declared invalid and are not used" in notes
    assert "1 readings of the type temperature are not used" in notes
    assert "declares no noise" in notes  # not all of them do
    polar = SAMPLE.partition(observation(12, "polar", 9, POLAR))[0] + "</observations></oiProjectData>"
    (tmp_path / "q.xml").write_text(polar)
    assert "declares no noise" not in " ".join(read(tmp_path / "q.xml").notes)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('<station ref="5"/>', '<station ref="99"/>', "refers to the station 99"),
        ('value="3.5"', 'value="nan"', "expected a finite number"),
        ('value="3.5"', 'value="-3.5"', "distance of -3.5"),
        ('value="3.5"', 'value="9e99"', "at most"),
        ('type="zenith"', 'type="zen"', "the polar reading has no zenith"),
        ('name="ST1"', 'name="../ST1"', "holds '/'"),
        ('name="P1"', 'name="&lt;i&gt;"', "holds '<'"),
        ("</oiProjectData>", "", "not well-formed"),
        ("<oiProjectData", '<!DOCTYPE x [<!ENTITY a "b">]><oiProjectData', "entities"),
    ],
)
def test_wrong_projects(tmp_path: Path, old: str, new: str, says: str) -> None:
    result = outcome(lambda: read(project(tmp_path / "p.xml", old, new)))
    assert isinstance(result, str)
    assert says in result


def test_a_cut_project(tmp_path: Path) -> None:
    content = project(tmp_path / "p.xml").read_bytes()
    for cut in range(0, len(content) - 1, 11):
        (tmp_path / "p.xml").write_bytes(content[:cut])
        assert isinstance(outcome(lambda: read(tmp_path / "p.xml", format="openindy")), str)


def test_a_real_project() -> None:
    file = shared("recordings", "format-samples", "openindy_example_1.xml")
    if not file.exists():
        pytest.skip("the format samples are not beside this checkout")
    recording = read(file)
    assert len(recording) == 32
    assert recording.targets[0] == "point_1"
