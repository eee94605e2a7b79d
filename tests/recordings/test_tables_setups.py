"""Occupations, rounds and kinds of instrument that tables of surveyors show."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.core.errors import RecordError
from ltsim.recordings import Hints, Recording, read
from ltsim.recordings.specification import ASSUMED_TOTAL_STATION_NOISE
from tests.recordings.samples import workshop

MARKS = {"A": (0.0, 0.0, 1.0), "B": (30.0, 2.0, 1.4)}
RNG_SEED = 5


def survey(
    path: Path, visits: list[tuple[str, str, str, int, float]], *, heights: bool, sigmas: bool = False, digits: int = 4
) -> Path:
    """A total station's table: visits of (mark, day, set-up, round, zero of the circle [deg]) to six of twelve targets.

    Noise of 1 arcsec and 0.1 mm; heads and prisms stand 1.6 m over their marks.
    """
    rng = np.random.default_rng(RNG_SEED)
    targets = {f"P{i:02d}": rng.uniform([5, -15, 0], [25, 15, 8]) for i in range(12)}
    header = ["fromstn", "tostn", "date", "obsset", "isetupid", "ha_value [deg]", "zd_value [deg]", "sd_value [m]"]
    header += ["fromhgt [m]", "tohgt [m]"] * heights + ["ha_error [arcsec]"] * sigmas
    rows = [",".join(header)]
    for k, (mark, day, setup, turn, zero) in enumerate(visits):
        other = "B" if mark == "A" else "A"
        chosen = [other, *list(targets)[6 * (k % 2) : 6 * (k % 2) + 6]]
        for name in chosen:
            there = np.array(MARKS[name]) if name in MARKS else targets[name]
            arm = there - MARKS[mark] + np.array([0, 0, 0 if name in MARKS else -1.6]) * heights
            length = float(np.linalg.norm(arm)) + rng.normal(0, 1e-4)
            hz = np.degrees(np.arctan2(arm[0], arm[1])) + zero + rng.normal(0, 1) / 3600
            zd = np.degrees(np.arccos(arm[2] / np.linalg.norm(arm))) + rng.normal(0, 1) / 3600
            row = [mark, name, day, str(turn), setup, f"{hz % 360:.5f}", f"{zd:.5f}", f"{length:.{digits}f}"]
            row += ["1.600", "1.600" if name in MARKS else "0.000"] * heights + ["1.0"] * sigmas
            rows.append(",".join(row))
    path.write_text("\n".join(rows) + "\n")
    return path


def notes_text(recording: Recording) -> str:
    return "\n".join(recording.notes)


DAYS = [
    ("A", "2015-03-17", "S1", 1),
    ("B", "2015-03-17", "S2", 1),
    ("A", "2015-03-18", "S3", 1),
    ("B", "2015-03-18", "S4", 1),
]


@pytest.mark.parametrize("by", ["set-up", "day"])
def test_occupations_of_a_mark_are_separate_set_ups(tmp_path: Path, by: str) -> None:
    visits = [
        (mark, day, setup if by == "set-up" else "", turn, 10.0 * i)
        for i, (mark, day, setup, turn) in enumerate(DAYS * 2)
    ]
    file = survey(tmp_path / "a.csv", visits, heights=True)
    if by == "day":
        file.write_text(file.read_text().replace("isetupid", "remark"))
    recording = read(file)
    assert recording.stations == ("A", "B", "A#2", "B#2")
    assert f"4 occupations of 2 marks, distinguished by {by}, are separate set-ups" in notes_text(recording)
    assert {recording.station_setup(name).over for name in recording.stations} == {"A", "B"}


def test_newly_zeroed_rounds_are_separate_orientations(tmp_path: Path) -> None:
    """By 20 arcsec where the table states 1: the heads stay where they are."""
    zeros = np.random.default_rng(1).normal(0.0, 20.0, 8) / 3600
    visits = [("A" if i % 4 < 2 else "B", "", "", i // 4 * 2 + i % 2, zero) for i, zero in enumerate(zeros.tolist())]
    recording = read(survey(tmp_path / "a.csv", visits, heights=False, sigmas=True))
    assert len(recording.stations) == 8
    assert "the circle was rotated between rounds: 8 rounds are separate set-ups" in notes_text(recording)
    adjusted = lt.adjust(recording)
    assert 0.6 < adjusted.fit.sigma0 < 1.5
    still = read(survey(tmp_path / "b.csv", [(*visit[:4], 0.0) for visit in visits], heights=False, sigmas=True))
    assert still.stations == ("A", "B")


@pytest.mark.parametrize("title", ["Setup", "Occupation", "Aufstellung"])
def test_a_set_up_next_to_the_station_is_an_occupation(tmp_path: Path, title: str) -> None:
    visits = [(mark, "", setup, turn, 10.0 * i) for i, (mark, _, setup, turn) in enumerate(DAYS)]
    file = survey(tmp_path / "a.csv", visits, heights=True)
    file.write_text(file.read_text().replace("isetupid", title))
    recording = read(file)
    assert recording.stations == ("A", "B", "A#2", "B#2")
    alone = file.read_text().splitlines()
    alone[0] = alone[0].replace("fromstn", "remark")
    file.write_text("\n".join(alone) + "\n")
    assert read(file).stations == ("S1", "S2", "S3", "S4")


def repeated(path: Path, zeros: list[float], digits: int = 4, wrong: int = -1) -> Path:
    """Rounds of two stations to the same targets without a column of rounds; `zeros` [deg] of the circle by round."""
    survey(path, [(mark, "", "", 1, zero) for zero in zeros for mark in "AB" for _ in (0,)], heights=True)
    rows = [line.split(",") for line in path.read_text().splitlines()]
    columns = [[*row[:2], *row[5:7], f"{float(row[7]):.{digits}f}" if i else row[7]] for i, row in enumerate(rows)]
    if wrong >= 0:
        columns[wrong][2] = f"{(float(columns[wrong][2]) + 50.0) % 360:.5f}"
    path.write_text("\n".join(map(",".join, columns)) + "\n")
    return path


def test_a_circle_set_anew_is_recognised_without_a_column_of_rounds(tmp_path: Path) -> None:
    zeros = [0.0, 0.0, 120.0, 120.0, 240.0, 240.0]
    recording = read(repeated(tmp_path / "a.csv", zeros))
    assert recording.stations == ("A", "B", "A#2", "B#2", "A#3", "B#3")
    assert "6 orientations at 2 occupations" in notes_text(recording)
    assert lt.adjust(recording).fit.sigma0 < 1.5
    assert read(repeated(tmp_path / "b.csv", [0.0] * 6)).stations == ("A", "B")
    assert read(repeated(tmp_path / "c.csv", [0.0] * 6, wrong=20)).stations == ("A", "B")
    assert read(repeated(tmp_path / "d.csv", zeros, digits=7)).stations == recording.stations  # whatever the digits


def test_a_single_wrong_direction_rotates_no_circle(tmp_path: Path) -> None:
    visits = [("A", "", "", i, 0.0) for i in range(4)] + [("B", "", "", i, 0.0) for i in range(4)]
    file = survey(tmp_path / "a.csv", visits, heights=True)
    lines = file.read_text().splitlines()
    cells = lines[18].split(",")
    cells[5] = f"{float(cells[5]) + 1.0:.5f}"
    file.write_text("\n".join([*lines[:18], ",".join(cells), *lines[19:]]) + "\n")
    assert read(file).stations == ("A", "B")


@pytest.mark.parametrize(("digits", "heights"), [(4, False), (4, True), (5, True)])
def test_ranges_that_no_tracker_prints_get_the_noise_of_a_total_station_and_a_note(
    tmp_path: Path, digits: int, heights: bool
) -> None:
    visits = [("A", "", "", 1, 0.0), ("B", "", "", 1, 0.0)]
    recording = read(survey(tmp_path / "a.csv", visits, heights=heights, digits=digits))
    assert recording.setup.instrument.noise == ASSUMED_TOTAL_STATION_NOISE
    assert (
        "the default noise of a total station is used (1 mm + 1.5 ppm, 1 arcsec), because the ranges are written to"
        in recording.notes[0]
    )
    assert all(recording.station_setup(name).levelled for name in recording.stations)


def test_a_trackers_table_keeps_a_trackers_noise(tmp_path: Path) -> None:
    recording = read(
        survey(tmp_path / "a.csv", [("A", "", "", 1, 0.0), ("B", "", "", 1, 0.0)], heights=False, digits=7)
    )
    assert recording.setup.instrument.noise.distance_mm == pytest.approx(0.003)
    assert "the default noise of a laser tracker is used" in recording.notes[0]
    assert not recording.setup.stations


@pytest.mark.parametrize("title", ["inst", "Halteplatz"])
def test_a_column_that_separates_the_set_ups_is_suggested_as_the_station(tmp_path: Path, title: str) -> None:
    recording = workshop()
    header = f"{title},label,T [degC],target,face,azimuth [deg],elevation [deg],distance [mm]"
    rows = [
        f"{10 + s},{i % 2},{20 + s},T{t},{f},{np.degrees(a):.8f},{np.degrees(e):.8f},{1e3 * d:.6f}"
        for i, (s, t, f, (d, a, e)) in enumerate(
            zip(recording.station, recording.target, recording.face, recording.readings, strict=True)
        )
    ]
    file = tmp_path / "a.csv"
    file.write_text("\n".join([header, *rows]) + "\n")
    with pytest.raises(RecordError, match=f'"station={title}"') as refused:
        read(file)
    assert "distances to the same target differ by" in str(refused.value)
    suggested = read(file, hints=Hints(columns=f"station={title}"))
    assert len(suggested.stations) == len(recording.stations)
    file.write_text("\n".join([header, *(f",,,{row.split(',', 3)[3]}" for row in rows)]) + "\n")
    with pytest.raises(RecordError, match="add a column station"):
        read(file)
    assert read(file, hints=Hints(station="S1")).stations == ("S1",)


def test_another_height_of_the_instrument_is_another_occupation(tmp_path: Path) -> None:
    def table(heights: list[str]) -> Recording:
        rows = [
            f"{mark},P{k},{40 * k + 7 * (mark == 'B')}.5,{99 + k}.25,1{k}.1234,{height},0.1"
            for mark, height in zip("ABA", heights, strict=True)
            for k in range(4)
        ]
        file = tmp_path / "a.csv"
        file.write_text("\n".join(["Station,Point,Hz [gon],V [gon],SD [m],IH [m],TH [m]", *rows]) + "\n")
        return read(file)

    recording = table(["1.5", "1.6", "1.55"])
    assert recording.stations == ("A", "B", "A#2")
    assert "3 occupations of 2 marks, distinguished by height of the instrument, are separate set-ups" in notes_text(
        recording
    )
    assert table(["1.5", "1.6", "1.5"]).stations == ("A", "B")


@pytest.mark.parametrize(
    ("distance", "height", "unit"), [("12.3456", "1683", "mm"), ("12345.6", "1.683", "m"), ("12.3456", "1.683", "m")]
)
def test_heights_without_a_unit_are_plausible_ones(tmp_path: Path, distance: str, height: str, unit: str) -> None:
    file = tmp_path / "a.csv"
    rows = [f"A;P{k};{10 * k}.5;10{k}.25;{distance};{height};0" for k in range(1, 4)]
    title = f"SD [{'m' if len(distance) == 7 and distance[2] == '.' else 'mm'}]"
    file.write_text("\n".join([f"Station;Point;Hz [gon];V [gon];{title};IH;TH", *rows]) + "\n")
    recording = read(file)
    np.testing.assert_allclose(recording.covariates["instrument_height_mm"], 1683.0)
    assert f"'IH' is interpreted as instrument_height_mm, in {unit}" in notes_text(recording)


def test_a_reading_with_an_unknown_unit_is_not_excluded(tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    file.write_text("Station;Point;Hz [gon];V [%];SD [m]\nA;P;1.5;2.5;12.3\n")
    with pytest.raises(RecordError, match=r"column 'V \[%\]' has the unknown unit '%'; convert it to one of deg"):
        read(file)


@pytest.mark.parametrize(("station", "target"), [("00", ""), ("", "00")])
def test_a_set_up_and_a_target_of_another_spelling_are_the_same_mark(tmp_path: Path, station: str, target: str) -> None:
    """As a workbook drops leading zeros in one of two columns."""
    lines = survey(tmp_path / "a.csv", [(*visit, 30.0) for visit in DAYS], heights=True).read_text().splitlines()
    numbers = {"A": "1", "B": "2"}
    rows = [lines[0]]
    for line in lines[1:]:
        mark, name, *rest = line.split(",")
        rows.append(",".join([station + numbers[mark], target + numbers[name] if name in numbers else name, *rest]))
    (tmp_path / "a.csv").write_text("\n".join(rows) + "\n")
    recording = read(tmp_path / "a.csv")
    assert {recording.station_setup(name).over for name in recording.stations} == {f"{target}1", f"{target}2"}
    assert f"are one mark: '{station}1' and '{target}1'" in notes_text(recording)
    rows = [line.replace(f",{target}2,", f",{target}1,") for line in rows]  # the set-up sees this target
    (tmp_path / "a.csv").write_text("\n".join(rows) + "\n")
    assert "are one mark" not in notes_text(read(tmp_path / "a.csv"))


@pytest.mark.parametrize("has_rounds", [True, False])
def test_a_height_in_the_first_row_is_that_of_all_orientations(tmp_path: Path, has_rounds: bool) -> None:
    visits = [("A" if i % 2 else "B", "", "", i // 2, 70.0 * (i // 2)) for i in (0, 2, 4, 1, 3, 5)]
    file = survey(tmp_path / "a.csv", [visit for visit in visits for _ in "ab"], heights=True, sigmas=True)
    rows = [line.split(",") for line in file.read_text().splitlines()]
    for i, row in enumerate(rows):
        row[8] = row[8] if i == 0 or row[0] != rows[i - 1][0] else ""
        del row[4], row[2 : 4 - has_rounds]
    file.write_text("\n".join(map(",".join, rows)) + "\n")
    recording = read(file)
    assert recording.stations == ("B", "B#2", "B#3", "A", "A#2", "A#3")
    assert set(recording.covariates["instrument_height_mm"]) == {1600.0}
    assert "are taken as 0" not in notes_text(recording)
