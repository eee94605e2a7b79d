"""The summary of a recording that convert ends with."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ltsim.cli.main import run
from ltsim.recordings import read
from ltsim.recordings.setup import Noise, Station, Target
from ltsim.recordings.summary import noise_text, recording_summary
from tests.recordings.samples import workshop


def test_a_surveyor_sees_what_was_read() -> None:
    recording = workshop()
    setup = recording.setup.model_copy(
        update={
            "started": "2026-03-04T08:00:00",
            "stations": {
                recording.stations[0]: Station(levelled=True, over=recording.targets[0], instrument_height_mm=1600)
            },
            "targets": {recording.targets[1]: Target(known_mm=(0.0, 0.0, 0.0), height_mm=100)},
        }
    )
    topics = recording_summary(
        recording.replace(setup=setup, time=np.linspace(0.0, 3725.0, len(recording)), has_clock=True)
    )
    count = len(recording.stations)
    assert topics["set-ups"] == f"{count}, 1 of them over 1 marks ({', '.join(recording.stations)}); 1 levelled"
    assert topics["pointings"].startswith(f"{len(recording)} to {len(recording.targets)} targets")
    assert topics["time"] == "from 2026-03-04T08:00:00 on, 1 h 02 min 05 s"
    assert topics["heights"] == "instruments 0 to 1.6 m, targets 0 to 0.1 m over their marks"
    assert "1 control points" in topics["known"]


def test_faces_noise_and_what_is_missing_are_counted() -> None:
    recording = workshop()
    first = recording.select(recording.face == 1)
    readings = first.readings.copy()
    readings[:, 0] = np.nan
    topics = recording_summary(first.with_readings(readings).replace(has_clock=False))
    assert topics["faces"] == "face 1 only"
    assert topics["readings"].startswith("no distances, ")
    assert topics["time"] == "no clock: the order of the rows replaces the time"
    assert topics["heights"] == "none"
    assert noise_text(Noise(distance_mm=1.0, distance_ppm=1.5, azimuth_arcsec=1.0, elevation_arcsec=2.0)) == (
        "1 mm + 1.5 ppm, 1 arcsec across, 2 arcsec in elevation"
    )


def test_convert_ends_with_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.csv").write_text(
        "Station,Point,Hz [gon],ZA [gon],SD [m]\n"
        + "".join(f"A,P{i},{40.5 * i},98.5,{2.5 + i:.7f}\n" for i in range(8))
    )
    assert run(["convert", str(tmp_path / "a.csv"), str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    for topic, words in recording_summary(read(tmp_path / "a.csv")).items():
        assert f"  {topic:9}  {words}" in printed
    assert "see the 2 notes above" in printed
    assert run(["convert", str(tmp_path / "a.csv"), str(tmp_path / "out"), "--force", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["summary"]["faces"] == "face 1 only"


def test_slope_and_horizontal_distances_are_counted(tmp_path: Path) -> None:
    lengths = [f",{20 + i:.4f}" if i < 3 else f"{20 + i:.4f}," for i in range(8)]
    rows = [f"A,P{i},{40.5 * i},{98.5 - i},{length}" for i, length in enumerate(lengths)]
    (tmp_path / "a.csv").write_text("\n".join(["Station,Point,Hz [gon],ZA [gon],SD [m],HD [m]", *rows]) + "\n")
    assert recording_summary(read(tmp_path / "a.csv"))["readings"].startswith("8 distances (3 of them horizontal) of ")
    flat = [f"A,P{i},{40.5 * i},{20 + i:.4f}" for i in range(8)]
    (tmp_path / "b.csv").write_text("\n".join(["Station,Point,Hz [gon],HD [m]", *flat]) + "\n")
    assert recording_summary(read(tmp_path / "b.csv"))["readings"].startswith("8 distances (horizontal) of ")
