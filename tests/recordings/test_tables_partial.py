"""Tables whose cells are filled in part: merged cells, missing readings, several distances, sheets of coordinates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import openpyxl
import pytest

from ltsim.core.errors import RecordError
from ltsim.recordings import Recording, read

HEADER = "Station;Point;Face;Hz [gon];V [gon];SD [m];IH;TH"
ROWS = [
    ["A", "P1", "1", "10.1234", "98.5", "12.3456", "1.683", "1.5"],
    ["A", "P2", "1", "120.1234", "101.5", "13.3456", "1.683", "1.6"],
    ["B", "P1", "1", "220.1234", "101.5", "10.3456", "1.548", "1.5"],
    ["B", "P2", "1", "300.1234", "97.5", "11.3456", "1.548", "1.6"],
]


def read_rows(path: Path, rows: list[list[str]], header: str = HEADER) -> Recording:
    path.write_text("\n".join([header, *(";".join(row) for row in rows)]) + "\n", encoding="utf-8")
    return read(path)


def notes_text(recording: Recording) -> str:
    return "\n".join(recording.notes)


def test_merged_cells_hold_for_the_rows_below(tmp_path: Path) -> None:
    rows = [list(row) for row in ROWS]
    for row in (rows[1], rows[3]):
        row[0] = row[6] = ""
    recording = read_rows(tmp_path / "a.csv", rows)
    assert recording.stations == ("A", "B")
    np.testing.assert_allclose(recording.covariates["instrument_height_mm"], [1683, 1683, 1548, 1548])
    assert "2 rows without a station are assigned to the station of the row above" in notes_text(recording)
    assert "2 empty heights of instruments are taken from other rows of the same set-up" in notes_text(recording)


def test_empty_heights_that_no_row_gives_are_reported(tmp_path: Path) -> None:
    rows = [list(row) for row in ROWS]
    rows[2][6] = rows[3][6] = rows[1][7] = ""
    recording = read_rows(tmp_path / "a.csv", rows)
    assert "heights of instruments are missing in 2 rows (B) and are taken as 0" in notes_text(recording)
    assert "heights of targets are missing in 1 rows (P2) and are taken as 0" in notes_text(recording)


@pytest.mark.parametrize("mark", ["", "-", "---", "N/A", "\u2013"])
def test_marks_of_missing_readings(tmp_path: Path, mark: str) -> None:
    recording = read_rows(tmp_path / "a.csv", [*ROWS, ["B", "P2", "2", "100.1234", "302.5", mark, "1.548", "1.6"]])
    assert np.isnan(recording.readings[4, 0]) and np.isfinite(recording.readings[:4]).all()


def test_a_slope_distance_has_priority_over_a_horizontal_distance(tmp_path: Path) -> None:
    rows = [[*row[:5], f"{float(row[5]) - 0.1:.4f}", *row[5:]] for row in ROWS]
    rows[3][6] = ""
    recording = read_rows(tmp_path / "a.csv", rows, HEADER.replace("SD [m]", "HD [m];SD [m]"))
    np.testing.assert_allclose(recording.readings[:, 0], [12.3456, 13.3456, 10.3456, 11.2456])
    assert recording.is_horizontal_distance.tolist() == [False, False, False, True]


def test_words_for_faces(tmp_path: Path) -> None:
    rows = [[*row[:2], face, *row[3:]] for row, face in zip(ROWS, ("Lage I", "Lage I", "1st", "face I"), strict=True)]
    assert read_rows(tmp_path / "a.csv", rows).face.tolist() == [1] * 4


def test_an_unknown_unit_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match=r"'Hz \[turn\]' has the unknown unit 'turn'; convert it to one of deg"):
        read_rows(tmp_path / "a.csv", ROWS, HEADER.replace("gon", "turn"))


def test_a_sheet_of_coordinates_next_to_readings(tmp_path: Path) -> None:
    book = openpyxl.Workbook()
    sheet = book.active
    assert sheet is not None
    sheet.append(HEADER.split(";"))
    for row in ROWS:
        sheet.append([*row[:3], *map(float, row[3:])])
    points = book.create_sheet("Stations")
    for line in (["Name", "X", "Y", "Z"], ["A", 1.0, 2.0, 3.0], ["B", 21.0, 2.0, 3.5]):
        points.append(line)
    book.save(tmp_path / "a.xlsx")
    recording = read(tmp_path / "a.xlsx")
    assert recording.stations == ("A", "B")
    assert "the coordinates in 'Stations' are not used" in notes_text(recording)


@pytest.mark.parametrize("title", ["Z [gon]", "Z"])
def test_z_next_to_a_direction_and_a_distance_is_an_angle(tmp_path: Path, title: str) -> None:
    recording = read_rows(tmp_path / "a.csv", ROWS, HEADER.replace("V [gon]", title))
    np.testing.assert_allclose(np.degrees(recording.readings[:, 2]) / 0.9, [1.5, -1.5, -1.5, 2.5])


def test_heights_with_units_in_their_cells(tmp_path: Path) -> None:
    rows = [[*row[:6], f"{row[6]} m", f"{1e3 * float(row[7]):.0f} mm"] for row in ROWS]
    recording = read_rows(tmp_path / "a.csv", rows)
    np.testing.assert_allclose(recording.covariates["instrument_height_mm"], [1683, 1683, 1548, 1548])
    np.testing.assert_allclose(recording.covariates["target_height_mm"], [1500, 1600, 1500, 1600])
    rows[2][6] = "1.548 ft"
    with pytest.raises(RecordError, match=r"column IH: found '1.683 m', expected a height, with the same unit"):
        read_rows(tmp_path / "a.csv", rows)
