"""Times and angles of tables are read by what their cells hold, and advice by what the cells allow."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from ltsim.core.errors import RecordError
from ltsim.recordings import Hints, Recording, read
from ltsim.recordings.spreadsheets import cells
from ltsim.recordings.spreadsheets.angle_cells import joined_angle_text, parse_packed_degrees

POLAR = "Station;Point;Face;Hz [gon];V [gon];D [m]"
ROWS = [
    "A;P1;1;36.891195;99.552368;12.0064232",
    "A;P2;1;298.024567;90.721389;10.6753296",
    "A;P3;1;14.024965;89.961369;16.0960773",
    "A;P1;2;236.891172;300.447147;12.0064249",
    "A;P2;2;98.024163;309.278235;10.6753222",
    "A;P3;2;214.025065;310.038075;16.0960837",
]


def table(path: Path, header: str, cells_: list[str], rows: list[str] = ROWS) -> Path:
    path.write_text("\n".join([f"{POLAR};{header}", *(f"{r};{c}" for r, c in zip(rows, cells_, strict=True))]) + "\n")
    return path


@pytest.mark.parametrize("header", ["Uhrzeit", "Zeit [hh:mm:ss]", "Registered", "time_s"])
@pytest.mark.parametrize(
    "form", ["08:{:02d}:20", "08:{:02d}:20.000", "'11.10.2022 08:{:02d}:20", "2022-10-11T08:{:02d}:20Z"]
)
def test_a_clock_is_a_time_of_day_under_any_header(tmp_path: Path, header: str, form: str) -> None:
    recording = read(table(tmp_path / "a.csv", header, [form.format(i) for i in range(6)]))
    assert recording.has_clock
    np.testing.assert_allclose(recording.time, 60.0 * np.arange(6))
    assert recording.setup.started.endswith("08:00:20")
    assert not recording.covariates and not recording.labels


@pytest.mark.parametrize(
    "form",
    [
        "8h{:02d}m20s",
        "20260301T08{:02d}20",
        "2026-03-01T08:{:02d}:20+01:00",
        "1-Mar-2026 08:{:02d}:20",
        "Mar 1, 2026 8:{:02d}:20 AM",
        "1. März 2026 08:{:02d}:20",
        "03/01/2026 8:{:02d}:20 AM",
    ],
)
def test_further_spellings_of_a_clock(tmp_path: Path, form: str) -> None:
    recording = read(table(tmp_path / "a.csv", "measured", [form.format(i) for i in range(6)]))
    np.testing.assert_allclose(recording.time, 60.0 * np.arange(6))
    assert recording.setup.started == ("08:00:20" if "h" in form else "2026-03-01T08:00:20")
    asked = any("interpreted as month and day (otherwise give --hint date=dmy)" in note for note in recording.notes)
    assert asked == ("/" in form)


def test_numbered_days_are_no_seconds(tmp_path: Path) -> None:
    recording = read(table(tmp_path / "a.csv", "Tag", ["1", "1", "1", "2", "2", "2"]))
    assert not recording.has_clock and recording.stations == ("A", "A#2")
    assert any("contains numbers of days without a time" in note for note in recording.notes)


def test_a_clock_next_to_the_time_stays_as_text(tmp_path: Path) -> None:
    moments = [f"{20.0 * i};08:{i:02d}:20" for i in range(6)]
    recording = read(table(tmp_path / "a.csv", "time_s;set up at", moments))
    np.testing.assert_allclose(recording.time, 20.0 * np.arange(6))
    assert recording.labels["set up at"][1] == "08:01:20" and not recording.covariates


def test_a_pace_that_no_instrument_has_is_questioned(tmp_path: Path) -> None:
    rows = [*ROWS, *ROWS]
    quick = read(table(tmp_path / "a.csv", "Time", [f"{0.0055 * i}" for i in range(12)], rows))
    assert any("take 0.0605 s, 0.0055 s from one target to the next: check the unit" in note for note in quick.notes)
    slow = read(table(tmp_path / "b.csv", "Time", [f"{20.0 * i}" for i in range(12)], rows))
    assert not any("check the unit" in note for note in slow.notes)


@pytest.mark.parametrize(
    ("text", "degrees"),
    [
        ("33°12'07.2\"", 33.202),
        ("33º12´07.2´´", 33.202),
        ("33d12m07.2s", 33.202),
        ("33° 12′ 07,2″", 33.202),
        ("33-12-07.2", 33.202),
        ("-33°12'07.2''", -33.202),
        ("33°12.12'", 33.202),
        ("33D12'07.2\"", 33.202),
        ("33_12_07.2", 33.202),
        ("33.12.07,2", 33.202),
    ],
)
def test_degrees_with_any_usual_marks(text: str, degrees: float) -> None:
    value = cells.parse_number_or_angle(text)
    assert value is not None and float(value) == pytest.approx(degrees, abs=1e-12)
    assert cells.is_sexagesimal(text)


@pytest.mark.parametrize(
    ("parts", "degrees"),
    [
        (("-4", "9", "36"), -4.16),
        (("-4", "-9", "-36"), -4.16),
        (("0", "-9", "36"), -0.16),
        (("-0", "9", "36"), -0.16),
        (("\u22120", "9,6"), -0.16),
        (("4", "", ""), None),
        (("4", "-9", "36"), None),
        (("4", "9", "-36"), None),
    ],
)
def test_sign_of_an_angle_in_separate_cells(parts: tuple[str, ...], degrees: float | None) -> None:
    angle = cells.parse_number_or_angle(joined_angle_text(parts))
    assert angle == 4 or degrees is not None or angle is None
    assert degrees is None or float(angle or 0) == pytest.approx(degrees, abs=1e-12)


@pytest.mark.parametrize(("text", "degrees"), [("33.12072", 33.202), ("33.5", 33 + 50 / 60), ("7", 7.0)])
def test_minutes_and_seconds_as_decimals(text: str, degrees: float) -> None:
    value = parse_packed_degrees(text)
    assert value is not None and float(value) == pytest.approx(degrees, abs=1e-12)


@pytest.mark.parametrize("text", ["33°72'07\"", "33°12'61\"", "33.7512"])
def test_no_angle_has_sixty_minutes(text: str) -> None:
    assert parse_packed_degrees(text) is None


@pytest.mark.parametrize(
    ("text", "number", "unit"),
    [
        ("43.7121g", 43.7121, "gon"),
        ("43,7121 gon", 43.7121, "gon"),
        ("43g71c21.5cc", 43.71215, "gon"),
        ("43.5°", 43.5, "deg"),
        ("12.345 m", 12.345, "m"),
    ],
)
def test_a_unit_next_to_each_number_is_the_unit_of_its_column(text: str, number: float, unit: str) -> None:
    bare, texts = cells.split_common_unit([text, "", text])
    assert texts == unit and bare[1] == ""
    value = cells.parse_number_or_angle(bare[0])
    assert value is not None and float(value) == pytest.approx(number, abs=1e-12)
    assert cells.split_common_unit([text, "7.5"]) == ([text, "7.5"], "")


def test_units_in_cells_decide_between_degrees_and_gon(tmp_path: Path) -> None:
    rows = [f"A;P{i};{10.5 + i}{{0}};{95.25 - i}{{0}};{3.5 + i} m" for i in range(4)]
    for mark, factor in (("g", 0.9), (" gon", 0.9), ("°", 1.0)):
        (tmp_path / "a.csv").write_text(
            "\n".join(["Station;Point;Hz;V;D", *rows]).format(mark) + "\n", encoding="utf-8"
        )
        recording = read(tmp_path / "a.csv", hints=Hints(vertical="zenith"))
        assert np.degrees(recording.readings[0, 2]) == pytest.approx(90 - factor * 95.25)
        assert recording.readings[0, 0] == pytest.approx(3.5)
    (tmp_path / "a.csv").write_text(
        "\n".join(["Station;Point;Hz;V;D", rows[0].format("g"), rows[1].format("°")]) + "\n"
    )
    with pytest.raises(RecordError, match="expected one unit in all cells"):
        read(tmp_path / "a.csv")


def packed(degrees: float) -> str:
    seconds = round(3600 * degrees)
    return f"{seconds // 3600}.{seconds % 3600 // 60:02d}{seconds % 60:02d}"


def test_minutes_and_seconds_in_decimals_are_recognised_by_their_digits(tmp_path: Path) -> None:
    angles = np.random.default_rng(3).uniform([0, 70], [360, 110], (12, 2))
    for name, form in (("packed", packed), ("plain", "{:.4f}".format)):
        lines = [f"S;P{i};{form(hz)};{form(v)};{4 + i}.125" for i, (hz, v) in enumerate(angles.tolist())]
        (tmp_path / f"{name}.csv").write_text("\n".join(["Station;Point;Hz;V;SD [m]", *lines]) + "\n")
        recording = read(tmp_path / f"{name}.csv", hints=None if name == "packed" else Hints(angle="deg"))
        np.testing.assert_allclose(np.degrees(recording.readings[:, 2]), 90 - angles[:, 1], atol=2e-4)
        assert any("interpreted as ddd.mmss" in note for note in recording.notes) == (name == "packed")


@pytest.mark.parametrize("titles", ["Hz;M;S;V;M;S", "Hz;m;s;V;m;s"])
def test_letters_after_an_angle_are_its_minutes_and_seconds(tmp_path: Path, titles: str) -> None:
    rows = [f"A;P{i};{10 * i};12;7.5;{90 + i};30;0.5;3.{i}" for i in range(4)]
    (tmp_path / "a.csv").write_text("\n".join([f"Station;Point;{titles};SD [m]", *rows]) + "\n")
    recording = read(tmp_path / "a.csv")
    assert np.degrees(recording.readings[1, 2]) == pytest.approx(-1 - 30 / 60 - 0.5 / 3600)
    assert not recording.covariates


GON = [(36.5, 99.75), (298.25, 90.5), (14.125, 89.625)]
"""Horizontal circle and zenith angle; whole numbers of degrees and seconds below."""


def sexagesimal(gon: float) -> tuple[int, int, float]:
    seconds = round(gon * 0.9 * 3600, 6)
    return int(seconds // 3600), int(seconds % 3600 // 60), seconds % 60


def test_degrees_minutes_seconds_in_columns_in_marks_and_in_decimals_are_the_same_angle(tmp_path: Path) -> None:
    angles = [tuple(map(sexagesimal, pair)) for pair in GON]
    columns = ["A,B,HzD,HzM,HzS,ZA [°],ZA ['],ZA [\"],SD [m]"]
    marked, decimals, unnamed = ["A,B,Hz,ZA,SD [m]"], ["A,B,Hz [ddd.mmss],ZA [ddd.mmss],SD [m]"], ["a,b,c,d,e,f,g,h,i"]
    columns[0] = columns[0].replace("A,B", "Station,Point")
    marked[0], decimals[0] = (line[0].replace("A,B", "Station,Point") for line in (marked, decimals))
    for i, (hz, v) in enumerate(angles):
        names, length = f"S,P{i + 1}", f"{3.1 + i}"
        columns.append(",".join([names, *map(str, hz), *map(str, v), length]))
        unnamed.append(columns[-1])
        marked.append(",".join([names, *("{}°{:02d}'{:04.1f}\"".format(*a) for a in (hz, v)), length]))
        decimals.append(",".join([names, *("{}.{:02d}{:02.0f}".format(*a) for a in (hz, v)), length]))
    expected = np.array([[-0.9 * h % 360, 90 - 0.9 * v] for h, v in GON])
    for name, text in {"columns": columns, "marked": marked, "decimals": decimals}.items():
        (tmp_path / f"{name}.csv").write_text("\n".join(text) + "\n")
        recording = read(tmp_path / f"{name}.csv")
        rounding = 1e-9 if name != "decimals" else 1.5e-4
        np.testing.assert_allclose(np.degrees(recording.readings[:, 1:]), expected, atol=rounding)
        assert not recording.covariates
    (tmp_path / "unnamed.csv").write_text("\n".join(unnamed) + "\n")
    with pytest.raises(RecordError, match=r"azimuth=c\+d\+e\[deg\],vertical=f\+g\+h\[deg\],distance=i\[m\]"):
        read(tmp_path / "unnamed.csv")
    mapped = Hints(columns="station=a,target=b,horizontal=c+d+e,zenith=f+g+h,distance=i[m]", angle="deg")
    np.testing.assert_allclose(
        np.degrees(read(tmp_path / "unnamed.csv", hints=mapped).readings[:, 1:]), expected, atol=1e-9
    )


@pytest.mark.parametrize(
    ("text", "says"),
    [
        # directions in three columns and a distance: no column of minutes is an angle
        ("C1,C2,76,46,56,141.9394\nC1,C3,0,0,5,323.6861\n", '"station=a,target=b,horizontal=c+d+e[deg],flat=f[m]"'),
        # directions in three columns, zenith angles in one with marks, lengths with the unit in their title
        (
            "Loc;Reper;Hz deg;Hz min;Hz sec;Unghi zenital;Longueur (mm)\n"
            "A;P;79;32;20,8;83°29'57,8\";11,9071\nA;Q;189;8;16,9;94°01'53,5\";4,5160\n",
            '"station=Loc,target=Reper,horizontal=Hz deg+Hz min+Hz sec[deg],zenith=Unghi zenital[deg],'
            'distance=Longueur (mm)[mm]"',
        ),
        # a column of marked angles is no distance
        (
            "Loc;Reper;a deg;a min;a sec;Unghi zenital\nA;P;79;32;20,8;83°29'57,8\"\nA;Q;189;8;16,9;94°01'53,5\"\n",
            "no three columns look like two angles and a distance",
        ),
        # point numbers are names, one station's number no face
        ("1,101,23.12345,99.23456,3.1234\n1,102,223.12345,98.23456,3.2\n", '"station=a,target=b,azimuth=c[deg],vert'),
        # two temperatures are no reading
        ("x,20.5,30.5\ny,20.6,30.4\n", "no three columns look like two angles and a distance, or like coordinates"),
        ("x,700.5,-3190.1,300.5\ny,740.1,-3165.1,291.5\n", '"target=a,x=b[mm],y=c[mm],z=d[mm]"'),
        # titles that are not unique are given by their numbers
        (
            "S,D,D,D,D\nA,P,23.12345,99.23456,3.1234\nA,Q,223.12345,98.23456,3.2\n",
            '"station=S,target=2,azimuth=3[deg],vertical=4[deg],distance=5[m]"',
        ),
    ],
)
def test_advice_suggests_only_what_the_values_allow(tmp_path: Path, text: str, says: str) -> None:
    header = "" if text.startswith("S,D") else ",".join("abcdef"[: text.splitlines()[0].count(",") + 1]) + "\n"
    (tmp_path / "a.csv").write_text(f"{header}{text}")
    with pytest.raises(RecordError) as refused:
        read(tmp_path / "a.csv", format="table")
    assert says in str(refused.value)


ROBOT = "X [mm],Y [mm],Z [mm],Target,Time Stamp\n" + "".join(
    f"{700 + 40 * (i % 4)}.0{i % 3},{-3190 + 25 * (i % 4)}.000,{300 - 9 * (i % 4)}.000,RRR,'11.10.2022 15:{i:02d}:10\n"
    for i in range(8)
)


def test_positions_of_a_moving_target_are_no_list_of_points(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(ROBOT)
    with pytest.raises(RecordError, match=r"8 positions under one name \('RRR'\), as a moving target gives"):
        read(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("header", "first", "says"),
    [
        ("Time;X;Y;Z;Rx;Ry;Rz", "08:0{i}:00;{x};-3190.5;300.5;1.5;2.5;3.5", "8 positions without point names"),
        ("Time;X [mm];Y [mm];Z [mm]", "08:0{i}:00;{x};-3190.5;300.5", "8 positions without point names"),
        ("q1;q2;X;Y;Z", "{i}.25;-{i}.75;{x};-3190.5;300.5", "8 positions without point names"),
        (
            "Station;X;Y;Z",
            "S{n};{x};-3190.5;300.5",
            "names no points, so common targets of its set-ups are unknown",
        ),
        ("Name;X;Y;Z", "P{n};{n}00.50{i};-3190.5;300.5", "list of 2 points in 8 rows"),
    ],
)
def test_the_interpretation_of_a_table_of_positions_is_reported(
    tmp_path: Path, header: str, first: str, says: str
) -> None:
    rows = [first.format(i=i, x=f"{700 + 40 * i}.5", n=i % 2 + 1) for i in range(8)]
    (tmp_path / "a.csv").write_text("\n".join([header, *rows]) + "\n")
    with pytest.raises(RecordError, match=says):
        read(tmp_path / "a.csv")


@pytest.mark.parametrize("named", [True, False])
def test_positions_of_a_single_set_up_are_targets_by_place(tmp_path: Path, named: bool) -> None:
    text = ROBOT if named else ROBOT.replace("Target", "ball")
    (tmp_path / "a.csv").write_text(text)
    hints = Hints(station="L", columns=None if named else "x=1[mm],y=2[mm],z=3[mm]")
    recording = read(tmp_path / "a.csv", format="table", hints=hints)
    assert recording.stations == ("L",) and recording.targets == ("pose-1", "pose-2", "pose-3", "pose-4")
    assert recording.repeat.max() == 2 and recording.has_clock
    assert any("its 8 rows are 4 positions of a target that moves" in note for note in recording.notes)


@pytest.mark.parametrize("first", ["Time Stamp", "q1 [deg]", "Pose"])
def test_positions_without_names_are_read_with_the_name_of_their_set_up(tmp_path: Path, first: str) -> None:
    """As the message says that refuses them without that name."""
    rows = [f"{i}.5,{700 + 40 * (i % 4)}.0{i % 3},{-3190 + 25 * (i % 4)},{300 - 9 * (i % 4)}" for i in range(8)]
    (tmp_path / "a.csv").write_text("\n".join([f"{first},X [mm],Y [mm],Z [mm]", *rows]) + "\n")
    with pytest.raises(RecordError, match="--format table --hint station=NAME"):
        read(tmp_path / "a.csv")
    recording = read(tmp_path / "a.csv", format="table", hints=Hints(station="L"))
    assert recording.targets == ("pose-1", "pose-2", "pose-3", "pose-4") and recording.repeat.max() == 2


@pytest.mark.parametrize("faces", [1, 2])
def test_unnamed_polar_readings_of_the_same_position_are_a_single_target(tmp_path: Path, faces: int) -> None:
    """Also across the zero of the circle, with elevations of a few degrees, and on both faces."""
    rows = []
    for azimuth, zenith in ((359.99995, 87.5), (12.5, 89.25), (77.25, 91.0)):
        for shot in range(3):
            turned = (azimuth + shot * 5e-5) % 360, zenith + shot * 1e-3
            rows.append((*turned, 2600.0 + 0.01 * shot))
            rows += [((turned[0] + 180) % 360, 360 - turned[1], 2600.0)] * (faces - 1)
    text = "".join(f"{hz:.6f};{v:.6f};{d:.4f}\n" for hz, v, d in rows)
    (tmp_path / "a.csv").write_text(f"Hz [deg];Zenith [deg];D [mm]\n{text}")
    recording = read(tmp_path / "a.csv")
    assert recording.targets == ("pose-1", "pose-2", "pose-3")
    assert len(recording) == 9 * faces and recording.face.max() == faces


def test_numbered_shots_of_a_point_are_reported(tmp_path: Path) -> None:
    def table(gap_mm: float) -> str:
        rows = [
            f"S1;P{i}-{shot};{2500 + 300 * i + gap_mm * shot:.3f};{800 - 90 * i};{40 * i}\n"
            for i in range(4)
            for shot in range(3)
        ]
        return "Station;Point;X [mm];Y [mm];Z [mm]\n" + "".join(rows)

    (tmp_path / "a.csv").write_text(table(0.01))
    notes = [note for note in read(tmp_path / "a.csv").notes if "have the same position" in note]
    assert len(notes) == 1 and "4 times, such as 'P0-0', 'P0-1', 'P0-2': if these are shots of one point" in notes[0]
    (tmp_path / "a.csv").write_text(table(20.0))
    assert not any("have the same position" in note for note in read(tmp_path / "a.csv").notes)


@pytest.mark.parametrize("n_names", [1, 2])
def test_names_of_reflectors_in_place_of_points_are_reported(tmp_path: Path, n_names: int) -> None:
    places = [(3.1, 10.5, 95.5), (4.2, 77.5, 99.0), (5.3, 130.0, 104.5), (6.4, 220.5, 88.0)]

    def note(names: list[str]) -> list[str]:
        rows = [
            f"{station};{name};{hz};{zenith};{distance + shift}"
            for station, shift in (("A", 0.0), ("B", 1.7))
            for name, (distance, hz, zenith) in zip(names, places, strict=True)
        ]
        (tmp_path / "a.csv").write_text("\n".join(["Station;Point;Hz [gon];Zenith [gon];D [m]", *rows]) + "\n")
        return [text for text in read(tmp_path / "a.csv").notes if "several positions" in text]

    (text,) = note([f"SMR{i % n_names}" for i in range(4)])
    assert f"' differ by {(3.3, 2.2)[n_names - 1]} m; if it names a reflector that moved, name each point" in text
    assert not note([f"P{i}" for i in range(4)])


def test_set_ups_without_point_names_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(
        "Station,Hz [gon],ZA [gon],D [m]\n" + "A,1.5,99.5,3.1\nA,7.5,99.0,3.2\nB,9,98.5,3.3\n"
    )
    with pytest.raises(RecordError, match="names no points, so common targets of its set-ups are unknown"):
        read(tmp_path / "a.csv")


def test_headers_of_office_programs(tmp_path: Path) -> None:
    """As Leica Infinity exports the observations of a total station."""
    header = (
        "Station ID;Point ID;Date/Time;Hz [gon];V [gon];Slope Dist. [m];Instrument Height [m];Target Height [m];Face"
    )
    rows = [
        f"1000;{name};26.11.2026 08:{i:02d}:15;{hz};{v};{12.0105 + i:.4f};1.5520;{1.3 + 0.1 * (i % 2):.4f};{face}"
        for i, (name, hz, v, face) in enumerate(
            [
                ("101", 10.5, 98.5, "I"),
                ("101", 210.5001, 301.5, "II"),
                ("102", 80.25, 101.25, "I"),
                ("102", 280.25, 298.75, "II"),
            ]
        )
    ]
    (tmp_path / "a.csv").write_text("\n".join([header, *rows]) + "\n")
    recording = read(tmp_path / "a.csv")
    assert recording.stations == ("1000",) and recording.targets == ("101", "102")
    assert list(recording.face) == [1, 2, 1, 2]
    np.testing.assert_allclose(recording.time, [0, 60, 120, 180])
    np.testing.assert_allclose(recording.heights_above_marks()[0], 1.552)
    np.testing.assert_allclose(recording.covariates["target_height_mm"], [1300, 1400, 1300, 1400])


SINGLE_ROWS = {
    "station,target,Hz[deg],zenith[deg],distance[mm]\nS1,T1,10,BAD,3000\n": "zenith[deg]",
    "station,target,azimuth[deg],elevation[deg],distance[mm]\nS1,T1,10,BAD,3000": "elevation[deg]",
    "Punkt;Hz[gon];V[gon];SD[m]\nP1;10,5;80,25;BAD\n": "SD[m]",
    "station\ttarget\tx[mm]\ty[mm]\tz[mm]\nS1\tT1\t5\tBAD\t7\n": "y[mm]",
    "Station Punkt Hz V Strecke\nS1 P1 10.5 BAD 3000\n": "V",
    "station,target,face,Hz[deg],zenith[deg],distance[mm]\nS1,T1,BAD,10,80,3000\n": "face",
    "station,target,Hz1[deg],V1[deg],D1[mm],Hz2[deg],V2[deg],D2[mm]\nS1,T1,1,80,3000,181,BAD,3000\n": "V2[deg]",
}
"""Tables of one row, and the column whose cell is wrong."""


@pytest.mark.parametrize(("text", "column"), SINGLE_ROWS.items())
def test_a_bad_cell_of_the_only_row_is_named(text: str, column: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text.replace("BAD", "abc"))
    with pytest.raises(RecordError, match=rf"a\.csv, row 2, column {re.escape(column)}: found 'abc', expected "):
        read(tmp_path / "a.csv")


@pytest.mark.parametrize("text", [text for text in SINGLE_ROWS if "," in text or ";" in text or "\t" in text])
def test_a_table_without_readings_says_so(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text.split("\n")[0] + "\n")
    with pytest.raises(RecordError, match=r"a\.csv: the file contains no pointings below its header"):
        read(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text("station,target,Hz[deg],zenith[deg],distance[mm]\nS1,T1,a,b,c\n")
    with pytest.raises(RecordError, match=r"b\.csv: .* no pointings: line 2 of b\.csv \('S1 T1 a b c'\) has no"):
        read(tmp_path / "b.csv")


def sexagesimal_rows(form: str) -> list[list[str]]:
    """Twelve rows of station, target, horizontal circle, zenith angle and distance; the angles are in this form."""
    rows = []
    for i in range(12):
        hz, v = (23 + 27 * i) % 360 + i / 60 + (7.5 + i) / 3600, 85 + i + 59 / 60 + (58.5 - i) / 3600
        angles = []
        for angle in (hz, v):
            tenths = round(angle * 36000)
            degrees, minutes, seconds = tenths // 36000, tenths // 600 % 60, tenths % 600 / 10
            angles.append(form.format(d=degrees, m=minutes, s=seconds))
        rows.append([f"S{1 + i // 6}", str(101 + i % 6), *angles, f"{12.3456 + i:.4f}"])
    return rows


def written(path: Path, header: str, rows: list[list[str]], separator: str = ";") -> Path:
    """Table with this header and rows."""
    path.write_text("\n".join([header, *(separator.join(row) for row in rows)]) + "\n", encoding="utf-8")
    return path


def first_angles(recording: Recording) -> list[float]:
    """Horizontal circle and zenith angle of the first and last pointing [deg]."""
    hz, v = -np.degrees(recording.readings[:, 1]) % 360, 90 - np.degrees(recording.readings[:, 2])
    return [hz[0], v[0], hz[-1], v[-1]]


EXPECTED = [23 + 7.5 / 3600, 85 + 59 / 60 + 58.5 / 3600, 320 + 11 / 60 + 18.5 / 3600, 96 + 59 / 60 + 47.5 / 3600]
"""First and last angles of `sexagesimal_rows` [deg]."""


@pytest.mark.parametrize("separator", [";", ","])
@pytest.mark.parametrize(
    "form",
    [
        "{d} {m:02d} {s:04.1f}",
        "{d} deg {m:02d} min {s:04.1f} sec",
        "{d}D{m:02d}'{s:04.1f}\"",
        "{d}.{m:02d}.{s:04.1f}",
        "{d:03d}{m:02d}{s:04.1f}",
    ],
)
def test_sexagesimal_angles_with_any_separator_of_fields(tmp_path: Path, form: str, separator: str) -> None:
    rows = sexagesimal_rows(form)
    recording = read(written(tmp_path / "a.csv", separator.join(("Stn", "Pt", "HA", "VA", "SD")), rows, separator))
    assert first_angles(recording) == pytest.approx(EXPECTED, abs=1e-9)


@pytest.mark.parametrize(
    "header",
    [
        "Station;Point;Hz;;;V;;;SD",
        "Station;Point;Hz;Hz;Hz;V;V;V;SD",
        "Station;Point;Hz;;;V;;;SD\n;;°;';\";°;';\";m",
        "Estacion;Punto;Ang. Hor.;;;Ang. Vert.;;;Dist. Incl.",
    ],
)
def test_minutes_and_seconds_below_merged_titles(tmp_path: Path, header: str) -> None:
    rows = [
        [station, target, *hz.split(), *v.split(), d]
        for station, target, hz, v, d in sexagesimal_rows("{d} {m} {s:.1f}")
    ]
    recording = read(written(tmp_path / "a.csv", header, rows))
    assert first_angles(recording) == pytest.approx(EXPECTED, abs=1e-9)


def test_untitled_columns_that_hold_no_minutes_are_not_joined(tmp_path: Path) -> None:
    rows = [[*row[:2], "23", "71", *row[3:]] for row in sexagesimal_rows("{d}")]
    recording = read(written(tmp_path / "a.csv", "Station;Point;Hz [deg];;V [deg];SD", rows))
    assert first_angles(recording)[0] == pytest.approx(23.0)


def test_few_packed_angles_are_questioned(tmp_path: Path) -> None:
    rows = sexagesimal_rows("{d}.{m:02d}{s:02.0f}")[:3]
    file = written(tmp_path / "a.csv", "Station;Point;Hz;Zenith;SD", rows)
    advice = "horizontal=Hz[dms],zenith=Zenith[dms]"
    with pytest.raises(RecordError, match=f"may be decimal numbers or ddd.mmss.*{re.escape(advice)}"):
        read(file)
    recording = read(file, hints=Hints(columns=advice))
    assert first_angles(recording)[0] == pytest.approx(EXPECTED[0], abs=1 / 3600)
    read(file, hints=Hints(angle="deg"))


@pytest.mark.parametrize(
    ("form", "unit"),
    [("{d}°{m:02d}'{s:04.1f}\"", "deg"), ("{d}.{m:02d}{s:02.0f}", "dms"), ("{d}-{m:02d}-{s:04.1f}", "deg")],
)
def test_advice_names_station_target_and_packed_angles(tmp_path: Path, form: str, unit: str) -> None:
    file = written(tmp_path / "a.csv", "a;b;c;d;e", sexagesimal_rows(form))
    advice = f"station=a,target=b,azimuth=c[{unit}],vertical=d[{unit}],distance=e[m]"
    with pytest.raises(RecordError, match=re.escape(advice)):
        read(file)


def position(i: int) -> list[str]:
    """Coordinates [mm] of the i-th position of a moving target."""
    return [f"{c + 11.5 * i}" for c in (2500.1, 40.2, -300.3)]


@pytest.mark.parametrize(
    "header",
    [
        "time;q1;q2;q3;Tracker X;Tracker Y;Tracker Z",
        "time;Rx;Ry;Rz;laser_x [mm];laser_y [mm];laser_z [mm]",
        "time;rot_x;rot_y;rot_z;X_T-Mac;Y_T-Mac;Z_T-Mac",
        "time;nominal_x;nominal_y;nominal_z;measured_x;measured_y;measured_z",
        "A1;A2;A3;A4;X [mm];Y [mm];Z [mm]",
    ],
)
def test_coordinates_with_a_common_word_are_positions(tmp_path: Path, header: str) -> None:
    rows = [[f"{i}", f"{0.1 * i:.3f}", "0.500", "-1.250", *position(i)] for i in range(8)]
    file = written(tmp_path / "a.csv", header, rows)
    with pytest.raises(RecordError, match="8 positions without point names, as a moving target gives"):
        read(file)
    recording = read(file, format="table", hints=Hints(station="T1"))
    assert len(recording.targets) == 8
    assert recording.readings[0, 0] == pytest.approx(np.linalg.norm([2.5001, 0.0402, -0.3003]), abs=1e-9)


def test_advice_on_joint_angles_and_positions_without_titles(tmp_path: Path) -> None:
    rows = [[f"{17.25 * (-1) ** i * j - i}" for j in range(1, 7)] + position(-37 * (i % 3)) for i in range(8)]
    with pytest.raises(RecordError, match=r"x=7\[mm\],y=8\[mm\],z=9\[mm\]"):
        read(written(tmp_path / "a.txt", "# robot", rows, " "))


def test_numbered_poses_with_joint_angles_are_no_list_of_points(tmp_path: Path) -> None:
    rows = [[f"{i + 1}", f"{3.5 * i}", f"{1.5 * i}", "0.5", *position(i)] for i in range(8)]
    with pytest.raises(RecordError, match="8 positions without point names"):
        read(written(tmp_path / "a.csv", "pose;J1;J2;J3;x;y;z", rows))


@pytest.mark.parametrize(
    ("form", "says"),
    [
        ("355g40'{:02d}\"", "write 355°40'10\" if the parts are degrees, minutes and seconds, or 355.4010"),
        ("355,40,{:02d},7", "it looks like an angle in degrees, minutes and seconds; write 355°40'10.7\""),
        ("355°75'{:02d}\"", "minutes or seconds of 60 or more, which are no parts of a degree; write an angle in gon"),
        ("-3/40/{:02d}", "write -3°40'10\""),
    ],
)
def test_an_angle_with_unknown_marks_is_described(tmp_path: Path, form: str, says: str) -> None:
    """Earlier, such a cell was no number, and commas in the cells made the table one without header."""
    rows = [["S1", f"P{i}", form.format(i), "90,25", "12,5"] for i in range(10, 16)]
    with pytest.raises(RecordError, match=re.escape(says)) as problem:
        read(written(tmp_path / "a.csv", "Station;Point;Hz;V;SD", rows))
    assert "row 2, column Hz" in str(problem.value)
    if "g" in form:
        with pytest.raises(RecordError, match=re.escape(says)):
            read(written(tmp_path / "b.csv", "A;B;C;D;E", rows))


def test_other_cells_than_angles_are_not_described_as_angles(tmp_path: Path) -> None:
    rows = [["S1", f"P{i}", "1.5", "90.25", "1g40g10"] for i in range(6)]
    file = written(tmp_path / "a.csv", "Station;Point;Hz;V;SD", rows)
    with pytest.raises(RecordError, match=r"found '1g40g10', expected a number$"):
        read(file)


@pytest.mark.parametrize("titles", ["J1;J2;J3", "Axis 1 [deg];Axis 2 [deg];Axis 3 [deg]", "Rx;Ry;Rz", "roll;pitch;yaw"])
@pytest.mark.parametrize("name", ["Pose1", "P 01"])
def test_named_poses_with_joint_angles_are_no_list_of_points(tmp_path: Path, titles: str, name: str) -> None:
    rows = [[f"{name}{i}", f"{3.5 * i}", f"{1.5 * i}", "0.5", *position(i)] for i in range(8)]
    file = written(tmp_path / "a.csv", f"point;{titles};x;y;z", rows)
    says = f"8 poses ('{name}0') with the angles of joints or rotations {titles.split(';')[0]}"
    with pytest.raises(RecordError, match=re.escape(says)):
        read(file)
    assert len(read(file, format="table", hints=Hints(station="T1")).targets) == 8


def test_points_with_deviations_are_a_list_of_points(tmp_path: Path) -> None:
    rows = [[f"P{i}", "0.1", "0.2", "0.3", *position(i)] for i in range(8)]
    with pytest.raises(RecordError, match="a list of 8 points"):
        read(written(tmp_path / "a.csv", "point;dx;dy;dz;x;y;z", rows))
