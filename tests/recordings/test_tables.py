"""Tables of every dialect give the same recording, and one sentence where they leave something open."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.core.errors import RecordError
from ltsim.core.units import DEGREE, MILLIMETRE
from ltsim.recordings import Hints, Recording, read, write
from ltsim.recordings.spreadsheets import cells
from ltsim.recordings.spreadsheets.header import title_role
from tests.families import family
from tests.recordings.samples import outcome, workshop

START = datetime(2026, 3, 4, 8, 15)
COLUMNS = "station=A,target=B,face=C,azimuth=D[deg],elevation=E[deg],distance=F[mm]"
Rows = list[tuple[str, str, int, float, float, float, float]]


def truth() -> Recording:
    """The workshop with readings of nine and six decimals, as every dialect below prints them."""
    recording = workshop()
    angles = np.round(np.degrees(recording.readings[:, 1:]), 9)
    angles[:, 0] %= 360
    printed = np.column_stack([np.round(recording.readings[:, 0] * 1e3, 6), angles])
    return recording.with_readings(printed * [MILLIMETRE, DEGREE, DEGREE])


def rows() -> Rows:
    """Station, target, face, azimuth and elevation [deg], distance [mm], time [s]."""
    r = truth()
    names = [(r.stations[s], r.targets[t], int(f)) for s, t, f in zip(r.station, r.target, r.face, strict=True)]
    values = np.round(np.degrees(r.readings), 9)
    return [
        (*name, a, e, float(np.round(d * 1e3, 6)), float(t))
        for name, (_, a, e), d, t in zip(names, values, r.readings[:, 0], r.time, strict=True)
    ]


def lines(header: Sequence[str], body: Sequence[Sequence[str]], separator: str = ",", end: str = "\n") -> str:
    return end.join(separator.join(row) for row in [header, *body]) + end


def english(path: Path) -> Path:
    header = ["Station", "Point", "Face", "Azimuth [deg]", "Elevation [deg]", "Distance [mm]", "Time [s]"]
    body = [[s, t, str(f), f"{a:.9f}", f"{e:.9f}", f"{d:.6f}", f"{x}"] for s, t, f, a, e, d, x in rows()]
    path.write_text(lines(header, body))
    return path


def german(path: Path) -> Path:
    """Semicolons, decimal commas, gon, clockwise circle, zenith angles, date and clock apart."""
    body = []
    for s, t, f, a, e, d, x in rows():
        numbers = [f"{(-a % 360) / 0.9:.10f}", f"{(90 - e) % 360 / 0.9:.10f}", f"{d / 1e3:.9f}"]
        stamp = START + timedelta(seconds=x)
        row = [s, t, str(f), *numbers, f"{stamp:%d.%m.%Y}", f"{stamp:%H:%M:%S}.{stamp.microsecond // 100000}"]
        body.append([cell.replace(".", ",") if i not in (6,) else cell for i, cell in enumerate(row)])
    path.write_text(lines(["Standpunkt", "Punkt", "Lage", "Hz[gon]", "V[gon]", "SD[m]", "Datum", "Uhrzeit"], body, ";"))
    return path


def a_file_a_station(path: Path) -> Path:
    path.mkdir()
    for station in ("S1", "S2"):
        body = [
            [t, str(f), f"{-a % 360:.9f}", f"{(90 - e) % 360:.9f}", f"{d / 1e3:.9f}"]
            + [(START + timedelta(seconds=x)).isoformat()]
            for s, t, f, a, e, d, x in rows()
            if s == station
        ]
        (path / f"{station}.csv").write_text(lines(["Name", "Face", "Hz[deg]", "Zenith[deg]", "D[m]", "Time"], body))
    return path


def blanks(path: Path) -> Path:
    body = [
        f"{s}   {t:6s} {f} {np.radians(a):.12f} {np.radians(e):.12f} {d / 1e3:.9f}" for s, t, f, a, e, d, _ in rows()
    ]
    path.write_text("# station target face azimuth_rad elevation_rad range_m\n" + "\n".join(body) + "\n")
    return path


def sexagesimal(path: Path) -> Path:
    def dms(angle: float) -> str:
        minutes, seconds = divmod(angle * 3600, 60)
        return f"{int(minutes) // 60}°{int(minutes) % 60:02d}'{seconds:09.6f}\""

    body = [[s, t, str(f), dms(-a % 360), dms((90 - e) % 360), f"{d:.6f}"] for s, t, f, a, e, d, _ in rows()]
    path.write_text(lines(["Stn", "Pt", "Face", "HA (dms)", "ZA (dms)", "SlopeDist (mm)"], body, "\t"))
    return path


def inches(path: Path) -> Path:
    body = [[s, t, str(f), f"{a:.9f}", f"{e:.9f}", f"{d / 25.4:.10f}"] for s, t, f, a, e, d, _ in rows()]
    path.write_text(lines(["setup", "name", "F", "Az(deg)", "El(deg)", "Dist(in)"], body))
    return path


def two_faces_a_row(path: Path) -> Path:
    printed = [[f"{-a % 360:.9f}", f"{(90 - e) % 360:.9f}", f"{d:.6f}"] for *_, a, e, d, _ in rows()]
    body = [[*rows()[i][:2], *printed[i], *printed[i + 1]] for i in range(0, len(printed), 2)]
    header = ["Station", "Target", "Hz1[deg]", "V1[deg]", "D1[mm]", "Hz2[deg]", "V2[deg]", "D2[mm]"]
    path.write_text(lines(header, body))  # type: ignore[arg-type]
    return path


def degree_signs(path: Path) -> Path:
    text = english(path).read_text().replace("[deg]", "(°)").replace("[mm]", "(mm)")
    path.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    return path


def utf16(path: Path) -> Path:
    path.write_bytes(english(path).read_text().replace(",", "\t").encode("utf-16"))
    return path


def blocks(path: Path) -> Path:
    text = "Job: hall 7\n\n"
    for station in ("S1", "S2"):
        text += f"Station: {station}\nPoint;Face;Hz [deg];V [deg];D [mm];T [C];Operator\n"
        text += "".join(
            f"{t};{f};{-a % 360:.9f};{(90 - e) % 360:.9f};{d:.6f};{21 + x / 1e3:.2f};night shift\n"
            for s, t, f, a, e, d, x in rows()
            if s == station
        )
    path.write_text(text + "\nTotal: 24 measurements\n")
    return path


def unnamed(path: Path) -> Path:
    body = [[s, t, str(f), f"{a:.9f}", f"{e:.9f}", f"{d:.6f}"] for s, t, f, a, e, d, _ in rows()]
    path.write_text(lines(list("ABCDEF"), body))
    return path


def workbook(path: Path) -> Path:
    openpyxl = pytest.importorskip("openpyxl", reason="the extra xlsx is not installed")
    book = openpyxl.Workbook()
    book.active.append(["Station", "Point", "Face", "Azimuth [deg]", "Elevation [deg]", "Distance [mm]", "Time"])
    for s, t, f, a, e, d, x in rows():
        book.active.append([s, t, f, a, e, d, START + timedelta(seconds=x)])
    book.save(path)
    return path


DIALECTS: dict[str, tuple[Callable[[Path], Path], str, bool, float]] = {
    "english": (english, "a.csv", True, 0.0),
    "german": (german, "a.csv", True, 1e-11),
    "a-file-a-station": (a_file_a_station, "a", True, 0.0),
    "blanks": (blanks, "a.txt", False, 1e-11),
    "sexagesimal": (sexagesimal, "a.csv", False, 1e-11),
    "inches": (inches, "a.csv", False, 1e-11),
    "two-faces-a-row": (two_faces_a_row, "a.csv", False, 0.0),
    "degree-signs": (degree_signs, "a.csv", True, 0.0),
    "utf-16": (utf16, "a.txt", True, 0.0),
    "blocks": (blocks, "a.csv", False, 0.0),
    "unnamed": (unnamed, "a.csv", False, 0.0),
    "workbook": (workbook, "a.xlsx", True, 0.0),
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_every_dialect_gives_the_same_recording(tmp_path: Path, dialect: str) -> None:
    """To the last bit where the dialect prints every digit: numbers are carried as decimals."""
    make, name, clock, rounding = DIALECTS[dialect]
    recording = read(make(tmp_path / name), hints=Hints(columns=COLUMNS if dialect == "unnamed" else None))
    whole = truth()
    assert [recording.stations[i] for i in recording.station] == [whole.stations[i] for i in whole.station]
    assert [recording.targets[i] for i in recording.target] == [whole.targets[i] for i in whole.target]
    assert np.array_equal(recording.face, whole.face)
    np.testing.assert_allclose(recording.readings, whole.readings, rtol=1e-15, atol=max(rounding, 1e-16))
    assert recording.has_clock == clock
    if clock:
        np.testing.assert_array_equal(recording.time, whole.time)


def test_used_and_excluded_columns_are_reported(tmp_path: Path) -> None:
    recording = read(blocks(tmp_path / "a.csv"))
    np.testing.assert_allclose(recording.covariates["T [C]"][:2], [21.0, 21.01])
    assert set(recording.labels["Operator"]) == {"night shift"}
    notes = "\n".join(recording.notes)
    assert "covariates and labels: 'T [C]', 'Operator'" in notes
    assert "free text is not used: line 1 of a.csv ('Job: hall 7'); line 32" in notes
    assert "'V [deg]' is interpreted as zenith angles" in notes
    assert "'Hz [deg]' is interpreted as a horizontal circle, clockwise" in notes


def test_rows_know_the_line_they_came_from(tmp_path: Path) -> None:
    recording = read(a_file_a_station(tmp_path / "a"))
    assert recording.row_text(1) == "row 1 (S1.csv, line 2)"
    second = recording.select(recording.station == 1)
    assert second.row_text(3) == "row 3 (S2.csv, line 4)"
    write(recording, tmp_path / "native")
    assert read(tmp_path / "native").row_text(3) == "row 3"


def test_the_sentence_shows_what_to_type(tmp_path: Path) -> None:
    with pytest.raises(RecordError) as refused:
        read(unnamed(tmp_path / "a.csv"))
    assert f'for instance --columns "{COLUMNS}"' in str(refused.value)
    (tmp_path / "b.csv").write_text("Point,Az[deg],Zenith[deg],D[m]\nT1,10.5,95.2,3.125\nT2,20.5,85.2,3.5\n")
    with pytest.raises(RecordError, match="--hint azimuth=clockwise or --hint azimuth=counter-clockwise"):
        read(tmp_path / "b.csv")
    recording = read(tmp_path / "b.csv", hints=Hints(azimuth="clockwise", station="P7"))
    np.testing.assert_allclose(np.degrees(recording.readings[0, 1:]), [349.5, -5.2])
    assert recording.stations == ("P7",)
    (tmp_path / "c.csv").write_text("Point,Hz,V,D\nT1,10.5,85.2,3.125\nT2,20.5,86.2,3.5\n")
    with pytest.raises(RecordError, match="give --hint angle=deg --hint vertical=zenith"):
        read(tmp_path / "c.csv")


def test_rough_places_decide_the_sense_against_the_words(tmp_path: Path) -> None:
    """A column called Hz that runs counter-clockwise: the floor plan in setup.toml knows better."""
    file = english(tmp_path / "a.csv")
    file.write_text(file.read_text().replace("Azimuth", "Hz"))
    (tmp_path / "setup.toml").write_text(
        'format = "ltsim-recording/1"\n'
        f"[stations.S1]\nposition_mm = [2250.0, 1950.0, 1500.0]\nyaw_deg = {np.degrees(0.3) + 1}\n"
        f"[stations.S2]\nposition_mm = [3550.0, 4150.0, 1700.0]\nyaw_deg = {np.degrees(-2.1) - 1}\n"
    )
    recording = read(file)
    np.testing.assert_allclose(recording.readings, truth().readings, rtol=1e-15)
    assert any("at their approximate positions then agree" in note for note in recording.notes)


def test_readings_reduced_to_face_1_are_turned_back(tmp_path: Path) -> None:
    body = [
        [s, t, str(f), f"{(a + 180 * (f - 1)) % 360:.9f}", f"{180 - e if f == 2 else e:.9f}", f"{d:.6f}"]
        for s, t, f, a, e, d, _ in rows()
    ]
    file = tmp_path / "a.csv"
    file.write_text(lines(["Station", "Point", "Face", "Az[deg]", "El[deg]", "D[mm]"], body))
    recording = read(file)
    np.testing.assert_allclose(recording.readings, truth().readings, atol=1e-11)
    assert any("reduced to face 1" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("Point,Face,Az[deg],El[deg],D[mm]\nT1,3,1,2,3000\n", "row 2, column face: found '3', expected 1 or 2"),
        ("Point,Az[deg],El[deg],D[mm]\nT1,1,x,3000\nT2,1,1,3000\n", "row 2, column El[deg]: found 'x', expected a n"),
        ("Point,Az[deg],El[deg],D[mm]\nT1,1,2,3000,7\n", "row 2: 5 fields, expected 4 as in the header"),
        ("Point,Az[deg],El[deg],D[mm]\nT1,1,2,3000.123\nT2,1,2,30", "row 3: the file ends inside this row"),
        ("Point,Az[deg],El[deg],D[mm]\n<b>,1,2,3000\n", "holds '<'"),
        ("Point,Az[deg],El[deg],D[mm]\n", "contains no"),
        ("Point,Az[deg],El[deg],D[mm],Date\nT1,1,2,3000,03/04/2026\nT2,1,2,3000,04/04/2026\n", "--hint date=dmy"),
    ],
)
def test_wrong_tables_are_refused_in_a_sentence(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    result = outcome(lambda: read(tmp_path / "a.csv", format="table"))
    assert isinstance(result, str) and says in result, result


@pytest.mark.parametrize(
    ("wanted", "says"),
    [
        ("azimuth=D[furlong]", "expected one of the units deg, gon, rad, dms, mil for azimuth"),
        ("colour=D", "expected ROLE=HEADER[UNIT] with a role among station, target"),
        ("azimuth=Z[deg],elevation=E[deg]", "does not say what its columns contain"),
    ],
)
def test_wrong_mappings_are_refused_in_a_sentence(tmp_path: Path, wanted: str, says: str) -> None:
    result = outcome(lambda: read(unnamed(tmp_path / "a.csv"), hints=Hints(columns=wanted)))
    assert isinstance(result, str) and says in result, result


@pytest.mark.parametrize(
    ("role", "title"),
    [
        *(
            ("station", title)
            for title in (
                "Instrument station",
                "Instr. pos.",
                "Station ID",
                "Tracker position",
                "Occupied station",
                "Gerätestandpunkt",
                "Instrumentenstandort Nr.",
                "Stationierung",
                "Station de l'instrument",
                "Mise en station",
                "Estación del instrumento",
                "Posizione dello strumento",
            )
        ),
        *(
            ("round", title)
            for title in ("Round", "Round no.", "Series ID", "Set", "Epoch", "Messepoche", "Durchgang Nr.", "Époque")
        ),
        *(("round", title) for title in ("Vuelta", "Giro")),
        *(("", title) for title in ("Numéro de série", "Serial No.", "Reflector type", "Position")),
    ],
)
def test_titles_of_stations_and_rounds(role: str, title: str) -> None:
    """In several languages, with words for the instrument and for a number."""
    assert title_role(title) == role


def test_a_column_with_the_time_of_an_epoch_changes_nothing(tmp_path: Path) -> None:
    """Each row has another number: no rounds, and the recording is that without the column."""
    readings = [(s, t, 10.0 * s + 40.0 * t, 85.0 + t, 5.0 + t) for s in (1, 2) for t in range(6)]
    rows = [f"A{s},P{t},{hz},{v},{d}" for s, t, hz, v, d in readings]
    title = "Instrument station,Point,Hz [deg],Zenith [deg],Slope distance [m]"
    (tmp_path / "plain.csv").write_text("\n".join([title, *rows]))
    with_epoch = [f"{title},Epoch", *(f"{row},{1.7e9 + 12 * i:.0f}" for i, row in enumerate(rows))]
    (tmp_path / "epoch.csv").write_text("\n".join(with_epoch))
    plain, epoch = read(tmp_path / "plain.csv"), read(tmp_path / "epoch.csv")
    assert epoch.stations == plain.stations == ("A1", "A2")
    np.testing.assert_array_equal(epoch.readings, plain.readings)


def test_columns_by_number_of_a_table_without_a_header(tmp_path: Path) -> None:
    file = unnamed(tmp_path / "a.csv")
    file.write_text("".join(file.read_text().splitlines(keepends=True)[1:]))
    wanted = "station=1,target=2,face=3,azimuth=4[deg],elevation=5[deg],distance=6[mm]"
    np.testing.assert_allclose(read(file, hints=Hints(columns=wanted)).readings, truth().readings, rtol=1e-15)


@pytest.mark.parametrize(
    ("text", "value"),
    [("1.234,5", "1234.5"), ("1,234.5", "1234.5"), ("-7,25", "-7.25"), ("12.5°", "12.5"), ("-0°30'00\"", "-0.5")],
)
def test_numbers_of_every_locale(text: str, value: str) -> None:
    assert str(cells.parse_number_or_angle(text)).rstrip("0") == value.rstrip("0")


@pytest.mark.parametrize(
    ("texts", "seconds"),
    [
        (["23:59:58.5", "00:00:01.5"], [0.0, 3.0]),
        (["11:59 AM", "12:01 PM"], [0.0, 120.0]),
        (["2026-03-04T08:15:00Z", "2026-03-04T08:15:00.25Z"], [0.0, 0.25]),
        (["04.03.26 08:15", "05.03.26 08:15"], [0.0, 86400.0]),
        (["03/14/2026 08:00:00", "03/15/2026 08:00:00"], [0.0, 86400.0]),
        (["03/04/2026 08:00:00", "03/04/2026 08:00:02"], [0.0, 2.0]),
    ],
)
def test_moments(texts: list[str], seconds: list[float]) -> None:
    assert cells.parse_times(texts)[0] == seconds


def test_a_workbook_without_the_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = workbook(tmp_path / "a.xlsx")
    monkeypatch.setitem(__import__("sys").modules, "openpyxl", None)
    with pytest.raises(RecordError, match=r'pip install "ltsim\[xlsx\]"'):
        read(file)


def test_twelve_dialects_of_the_same_network(shared: Path) -> None:
    """Somebody else's tables: the adjustment of each is that of the reference."""
    folder = shared / "recordings" / "tables"
    if not folder.is_dir():
        pytest.skip("the tables are not beside this checkout")
    whole = lt.adjust(read(folder / "reference"))
    for path in sorted(folder.iterdir()):
        if path.name[:2].isdigit():
            columns = COLUMNS if path.name.startswith("11") else None
            adjustment = lt.adjust(read(path, hints=Hints(columns=columns, setup=folder / "reference")))
            rounded = path.name[:2] in ("02", "04", "05", "06")
            np.testing.assert_allclose(
                adjustment.fit.chi2, whole.fit.chi2, rtol=1e-5 if rounded else 1e-9, err_msg=path.name
            )
            for station, other in zip(adjustment.stations, whole.stations, strict=True):
                np.testing.assert_allclose(station.position, other.position, atol=1e-9, err_msg=path.name)
    with pytest.raises(RecordError, match="for instance --columns"):
        read(folder / "11-unnamed.csv")


def test_a_table_becomes_a_native_recording(tmp_path: Path) -> None:
    recording = read(blocks(tmp_path / "a.csv"))
    write(recording, tmp_path / "out")
    back = read(tmp_path / "out")
    np.testing.assert_array_equal(back.readings, recording.readings)
    assert back.covariates.keys() == recording.covariates.keys()


def traverse(axis_to_axis: bool) -> str:
    """Six pillars, each set up once over its mark; lines of sight between axes, heights of 1.5 to 1.7 m stated."""
    rng = np.random.default_rng(4)
    marks = np.column_stack([rng.uniform(0.0, 60.0, (6, 2)), rng.uniform(0.0, 4.0, 6)])
    height = rng.uniform(1.5, 1.7, (6, 6))
    body = []
    for s in range(6):
        for t in (t for t in range(6) if t != s):
            arm = marks[t] - marks[s]
            if not axis_to_axis:
                arm[2] += height[s, t] - height[s, s]
            length = float(np.linalg.norm(arm))
            turn = np.degrees(np.arctan2(arm[0], arm[1])) % 360
            zenith = np.degrees(np.arccos(arm[2] / length))
            body.append([f"P{s}", f"P{t}", f"{turn:.5f}", f"{zenith:.5f}", f"{1e3 * length:.2f}"])
            body[-1] += [f"{1e3 * height[s, s]:.1f}", f"{1e3 * height[s, t]:.1f}"]
    names = "station,target,hz [deg],zenith [deg],distance [mm],instrument_height_mm,target_height_mm"
    return lines(names.split(","), body)


@pytest.mark.parametrize("axis_to_axis", family([True, False]))
def test_heights_next_to_readings_between_the_heads_are_not_applied_and_it_is_reported(
    tmp_path: Path, axis_to_axis: bool
) -> None:
    (tmp_path / "pillars.csv").write_text(traverse(axis_to_axis))
    recording = read(tmp_path / "pillars.csv")
    notes = [note for note in recording.notes if "are not applied" in note]
    assert bool(notes) == axis_to_axis
    if notes:
        assert "15 lines measured in both directions close within" in notes[0]
    assert bool(np.any(recording.heights_above_marks()[1])) != axis_to_axis
    assert lt.adjust(recording).fit.sigma0 < 20.0


def test_occupations_are_names_of_a_column_or_combinations_of_mark_day_and_role(tmp_path: Path) -> None:
    plain, numbered = tmp_path / "plain.csv", tmp_path / "numbered.csv"
    rows = traverse(True).splitlines()
    plain.write_text("\n".join(rows))
    more = [f"{row},{i % 3 + 1},7" for i, row in enumerate(rows[1:])]
    numbered.write_text("\n".join([f"{rows[0]},isetupid,tsetupid", *more]))
    recording, with_column = read(plain), read(numbered)
    assert recording.setup.height_above_mark_sigma_mm == with_column.setup.height_above_mark_sigma_mm == 1.0
    assert set(recording.labels["instrument_setup"]) == set(recording.stations)
    assert set(recording.labels["target_setup"]) == {f"to {name}" for name in recording.targets}
    assert set(with_column.labels["instrument_setup"]) == {"1", "2", "3"}
    write(with_column, tmp_path / "native")
    assert read(tmp_path / "native").labels["target_setup"] == with_column.labels["target_setup"]
