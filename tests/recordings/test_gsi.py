"""Leica GSI: words, units, stations, faces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ltsim.core.errors import RecordError
from ltsim.core.units import DEGREE, GON
from ltsim.recordings import Hints, read
from tests.recordings.samples import outcome, shared

GSI16 = (
    "*410001+0000000000000021 42....+000000000000BP04 43....+0000000000001538\n"
    "*110002+000000000000BP03 21.322+0000000016901313 22.322+0000000009955914 31..00+0000000000029462 "
    "51..1.+00000008+0000000 87..10+0000000000001565\n"
    "*110003+000000000000BP03 21.322+0000000036901579 22.322+0000000030043928 31..00+0000000000029462 "
    "51..1.+00000008+0000000 87..10+0000000000001565\n"
    "*410004+0000000000000021 42....+000000000000BP03 43....+0000000000001615\n"
    "*110005+000000000000BP04 21.322+0000000001000000 22.322+0000000010044086 31..00+0000000000029462 "
    "51..1.+00000008+0000000 87..10+0000000000001538\n"
)


def gsi(path: Path, text: str = GSI16) -> Path:
    path.write_text(text)
    return path


def test_gsi16(tmp_path: Path) -> None:
    recording = read(gsi(tmp_path / "n.gsi"))
    assert recording.stations == ("BP04", "BP03")
    assert list(recording.face) == [1, 2, 1]
    np.testing.assert_allclose(recording.readings[0], [29.462, (400 - 169.01313) * GON, (100 - 99.55914) * GON])
    np.testing.assert_allclose(recording.readings[1], [29.462, (400 - 369.01579) * GON, (500 - 300.43928) * GON])
    station = recording.station_setup("BP04")
    assert station.levelled
    assert station.over == "BP04"
    assert station.instrument_height_mm == 1538
    assert recording.target_setup("BP03").height_mm == 1565
    assert any("no noise" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("angle", "length", "azimuth", "distance"),
    [
        ("21.323+09000000", "31..06+00123456", 90 * DEGREE, 12.3456),
        ("21.324+09030300", "31..08+00123456", (90 + 30 / 60 + 30 / 3600) * DEGREE, 1.23456),
        ("21.325+16000000", "31..01+00001000", 90 * DEGREE, 0.3048),
        ("21.322+10000000", "31..00+00012345", 90 * DEGREE, 12.345),
    ],
)
def test_gsi8_units(tmp_path: Path, angle: str, length: str, azimuth: float, distance: float) -> None:
    text = (
        "110001+00000001 84..10+00001000 85..10+00002000 86..10+00003000 88..10+00001500\n"
        f"110002+00000A12 {angle} 22.322+10000000 {length} 87..10+00000100\n"
    )
    recording = read(gsi(tmp_path / "n.gsi", text))
    assert recording.stations == ("1",)
    assert recording.targets == ("A12",)
    np.testing.assert_allclose(recording.readings[0, :2], [distance, 2 * np.pi - azimuth])
    assert recording.station_setup("1").position_mm == (1000, 2000, 3000)


def test_missing_and_horizontal(tmp_path: Path) -> None:
    text = "110002+00000A12 21.322+01000000 22.322+-------- 32..00+00012345\n"
    recording = read(gsi(tmp_path / "n.gsi", text), hints=Hints(station="P"))
    assert np.isnan(recording.readings[0, 2])
    assert recording.is_horizontal_distance[0]
    assert recording.stations == ("P",)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            "*410001+0000000000000021 42....+000000000000BP04 43....+0000000000001538\n",
            "",
            "is before the first station",
        ),
        ("21.322+0000000016901313", "21.329+0000000016901313", "unit code '9' of an angle"),
        ("31..00+0000000000029462", "31..05+0000000000029462", "unit code '5' of a length"),
        ("31..00+0000000000029462", "31..00+000000000002946x", "expected digits"),
        ("31..00+0000000000029462", "31..00-0000000000029462", "a distance of -29.462"),
        ("21.322+0000000016901313", "21.322+00000000169", "not a word of GSI-16"),
        ("+000000000000BP03 21", "+000000000000<P03 21", "holds '<'"),
    ],
)
def test_wrong_files(tmp_path: Path, old: str, new: str, says: str) -> None:
    assert old in GSI16
    result = outcome(lambda: read(gsi(tmp_path / "n.gsi", GSI16.replace(old, new, 1)), format="gsi"))
    assert isinstance(result, str)
    assert says in result


def test_a_cut_file(tmp_path: Path) -> None:
    """GSI often ends without a line break: a last line is whole when it holds the words of the one before."""
    lines = GSI16.split("\n")
    again = "\n".join([*lines[:3], lines[2]])
    assert len(read(gsi(tmp_path / "n.gsi", again))) == 3
    for cut in range(len(GSI16) - 1):
        file = gsi(tmp_path / "n.gsi", GSI16[:cut])
        result = outcome(lambda: read(file, format="gsi"))  # noqa: B023
        assert isinstance(result, str) or GSI16[cut - 1] == "\n" or GSI16[cut] == "\n"


def test_a_real_file() -> None:
    file = shared("recordings", "geoeasy-total-station-22st", "network.GSI")
    if not file.exists():
        pytest.skip("the total-station network is not beside this checkout")
    recording = read(file)
    assert (len(recording), len(recording.stations), len(recording.targets)) == (1400, 22, 22)
    assert recording.repeat.max() == 7
    front, back = recording.readings[recording.face == 1], recording.readings[recording.face == 2]
    assert len(front) == len(back) == 700
    assert abs(np.mean(front[:, 2]) + np.mean(back[:, 2]) - np.pi) < 1e-4


def test_codes_of_points_are_no_setups(tmp_path: Path) -> None:
    code = "*410099+0000000000000012 42....+0000000000000007\n"
    recording = read(gsi(tmp_path / "n.gsi", GSI16.replace("*110003", code + "*110003")))
    assert recording.stations == ("BP04", "BP03")
    assert any("1 blocks are neither" in note for note in recording.notes)


def test_coordinates_name_the_setups_and_no_code_does(tmp_path: Path) -> None:
    text = (
        "110001+00000001 84..10+00001000 85..10+00002000 86..10+00003000 88..10+00001500\n"
        "410002+00000012 42....+00000007 43....+00000001\n"
        "110003+00000A12 21.322+10000000 22.322+10000000 31..00+00012345 87..10+00000100\n"
    )
    assert read(gsi(tmp_path / "n.gsi", text)).stations == ("1",)


def test_a_circle_that_was_set_anew_is_another_orientation(tmp_path: Path) -> None:
    lines = ["*410001+0000000000000021 42....+000000000000000S 43....+0000000000001538"]
    for turn in (0, 4_000_000, 12_345_600):
        lines += [
            f"*110002+000000000000000{name} 21.322+{(angle + turn) % 40_000_000:016d} 22.322+0000000010000000 "
            f"31..00+{distance:016d} 87..10+0000000000001538"
            for name, angle, distance in (("P", 0, 20_000), ("Q", 9_000_000, 30_000), ("R", 21_000_000, 25_000))
        ]
    recording = read(gsi(tmp_path / "n.gsi", "\n".join(lines) + "\n"))
    assert recording.stations == ("S", "S#2", "S#3")
    assert [recording.station_setup(name).over for name in recording.stations] == ["S"] * 3
    assert any("3 orientations at 1 occupations" in note for note in recording.notes)


def test_the_file_of_a_level_is_named(tmp_path: Path) -> None:
    text = "410001+?......1\n110002+000000A1 32...8+00012345 331.08+00123456\n"
    with pytest.raises(RecordError, match="the file comes from a level"):
        read(gsi(tmp_path / "n.gsi", text))
