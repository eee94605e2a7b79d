"""Lines between the pointings of a table: stations, instruments and heights of a block; titles in several languages."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from ltsim.core.errors import RecordError
from ltsim.recordings import Hints, Recording, read
from ltsim.recordings.spreadsheets.title_words import FOREIGN_TITLES_BY_LANGUAGE, TITLES_BY_ROLE

HEADER = "Point;Hz [gon];V [gon];SD [m];TH"
ROWS = ["P1;10.1234;98.5;12.3456;1.5", "P2;120.1234;99.5;13.3456;1.6", "P3;220.1234;101.5;10.3456;1.7"]


def read_text(path: Path, text: str, hints: Hints | None = None) -> Recording:
    path.write_text(text, encoding="utf-8")
    return read(path, hints=hints)


def block(lines: list[str], *, first: bool = False) -> str:
    """Two blocks, each with its header below its lines, or one header before all (`first`)."""
    parts = [[HEADER]] if first else []
    for station, height in (("A", "1.683"), ("B", "1.548")):
        parts += [[line.format(station=station, height=height) for line in lines], [] if first else [HEADER], ROWS]
    return "\n".join(line for part in parts for line in part) + "\n"


@pytest.mark.parametrize("first", [False, True])
@pytest.mark.parametrize(
    "lines",
    [
        ["Station: {station}", "Instrument height: {height}"],
        ["Station: {station}, ih = {height} m"],
        ["# Station {station} HI {height}"],
        ["Station name: {station}", "Instrument: TS60 885123", "Instrument height (m): {height}", "Weather: dry"],
        ["Instrument: TS60 885123", "Standpunkt: {station}", "Instrumentenhöhe: {height}"],
        ["from 08:00 to 12:00", "Stazione: {station}", "Altezza strumento: {height}"],
    ],
)
def test_blocks_name_stations_and_heights(tmp_path: Path, lines: list[str], first: bool) -> None:
    recording = read_text(tmp_path / "a.csv", block(lines, first=first))
    assert recording.stations == ("A", "B")
    np.testing.assert_allclose(recording.covariates["instrument_height_mm"], [1683.0] * 3 + [1548.0] * 3)
    np.testing.assert_allclose(recording.covariates["target_height_mm"], [1500, 1600, 1700] * 2)


def test_an_instrument_names_the_block_where_no_station_does(tmp_path: Path) -> None:
    assert read_text(tmp_path / "a.csv", block(["Tracker: {station}"])).stations == ("A", "B")


def test_a_new_station_has_no_height_of_the_previous_station(tmp_path: Path) -> None:
    lines = ["Station: A", "Instrument height: 1.5", HEADER, *ROWS, "Station: B", *ROWS]
    recording = read_text(tmp_path / "a.csv", "\n".join(lines) + "\n")
    assert np.isnan(recording.covariates["instrument_height_mm"][3:]).all()


@pytest.mark.parametrize(
    "header",
    [
        "Station;Point visé;Angle horizontal (gon);Angle vertical (gon);Distance inclinée (m);Hauteur instrument;"
        "Hauteur prisme",
        "Estación;Punto;Ángulo horizontal [gon];Ángulo vertical [gon];Distancia geométrica [m];Altura instrumento;"
        "Altura prisma",
        "Stazione;Punto;Angolo orizzontale [gon];Angolo zenitale [gon];Distanza inclinata [m];Altezza strumento;"
        "Altezza prisma",
        "Stanovisko;Cíl;Směr [gon];Zenitový úhel [gon];Šikmá délka [m];Výška přístroje;Výška cíle",
        "Stanowisko;Punkt;Kierunek [gon];Kąt zenitalny [gon];Odległość skośna [m];Wysokość instrumentu;Wysokość celu",
        "Álláspont;Pont;Vízszintes irány [gon];Zenitszög [gon];Ferde távolság [m];Műszermagasság;Jelmagasság",
        "Uppställning;Punkt;Horisontalvinkel [gon];Vertikalvinkel [gon];Lutande längd [m];Instrumenthöjd;Prismahöjd",
        "Standplaats;Punkt;Horizontale hoek [gon];Zenithoek [gon];Schuine afstand [m];Instrumenthoogte;Prismahoogte",
        "器械点;視準点;水平角 [gon];天頂角 [gon];斜距離 [m];器械高;プリズム高",
        "测站;目标点;水平角（gon）;天顶距（gon）;斜距（m）;仪器高;棱镜高",
        "測站;目標點;水平角（gon）;豎直角（gon）;斜距（m）;儀器高;稜鏡高",
        "기계점;시준점;수평각 [gon];연직각 [gon];사거리 [m];기계고;프리즘고",
    ],
)
def test_titles_in_several_languages(tmp_path: Path, header: str) -> None:
    rows = ["A;P1;10,1234;98,5;12,3456;1,683;1,5", "A;P2;120,1234;101,5;13,3456;1,683;1,6"]
    recording = read_text(tmp_path / "a.csv", "\n".join([header, *rows]) + "\n")
    assert (recording.stations, recording.targets) == (("A",), ("P1", "P2"))
    np.testing.assert_allclose(
        recording.readings,
        np.array([[12.3456, 389.8766, 1.5], [13.3456, 279.8766, -1.5]]) * [1, np.pi / 200, np.pi / 200],
    )
    np.testing.assert_allclose(recording.covariates["instrument_height_mm"], 1683.0)
    np.testing.assert_allclose(recording.covariates["target_height_mm"], [1500.0, 1600.0])


@pytest.mark.parametrize(
    "header",
    [
        "Station;Point visé;Gisement (gon);Site (gon);Distance inclinée (m)",
        "Station;Nom;Gisement (gon);Angle de site (gon);Distance selon la pente (m)",
        "Standpunkt;Ziel;Richtung (gon);Elevationswinkel (gon);Schrägentfernung (m)",
        "Estación;Nombre;Lectura horizontal [gon];Ángulo de elevación [gon];Distancia inclinada [m]",
        "Estação;Ponto visado;Leitura horizontal [gon];Ângulo de elevação [gon];Distância inclinada [m]",
        "Stazione;Nome punto;Angolo Hz [gon];Angolo di elevazione [gon];Distanza obliqua [m]",
    ],
)
def test_titles_of_elevations_in_several_languages(tmp_path: Path, header: str) -> None:
    rows = ["A;P1;10,1234;1,5;12,3456", "A;P2;120,1234;-1,5;13,3456"]
    recording = read_text(tmp_path / "a.csv", "\n".join([header, *rows]) + "\n")
    assert (recording.stations, recording.targets) == (("A",), ("P1", "P2"))
    np.testing.assert_allclose(
        recording.readings,
        np.array([[12.3456, 389.8766, 1.5], [13.3456, 279.8766, -1.5]]) * [1, np.pi / 200, np.pi / 200],
    )


def test_an_english_site_is_no_elevation(tmp_path: Path) -> None:
    header = "Site;Station;Point;Hz [gon];Zenith [gon];Slope distance [m]"
    rows = ["hall;A;P1;10,1234;98,5;12,3456", "hall;A;P2;120,1234;101,5;13,3456"]
    recording = read_text(tmp_path / "a.csv", "\n".join([header, *rows]) + "\n")
    assert recording.labels["Site"] == ("hall", "hall")
    np.testing.assert_allclose(recording.readings[:, 2], np.array([1.5, -1.5]) * np.pi / 200)
    points = read_text(tmp_path / "b.csv", "Site;Station;Name;X [mm];Y [mm];Z [mm]\n" + "hall;A;P1;1;2;3\n" * 1)
    assert points.labels["Site"] == ("hall",)


def test_each_word_has_a_single_role() -> None:
    roles: dict[str, set[str]] = {}
    for words in (TITLES_BY_ROLE, *FOREIGN_TITLES_BY_LANGUAGE.values()):
        for role, text in words.items():
            for word in text.split():
                roles.setdefault(word, set()).add(role)
    assert not [word for word, both in roles.items() if len(both) > 1]
    twice = Counter(word for text in TITLES_BY_ROLE.values() for word in text.split())
    assert max(twice.values()) == 1


@pytest.mark.parametrize("separator", [";", ",", "\t"])
def test_a_sign_of_seconds_as_title_is_no_quote(tmp_path: Path, separator: str) -> None:
    lines = [
        ["Station", "Point", "Hz °", "'", '"', "V °", "'", '"', "SD [m]"],
        ["A", "P1", "10", "20", "30.5", "90", "10", "20.5", "12.3456"],
        ["A", "P2", "110", "20", "30.5", "91", "10", "20.5", "13.3456"],
    ]
    recording = read_text(tmp_path / "a.csv", "\n".join(separator.join(line) for line in lines) + "\n")
    expected = np.array([360 - 10 - 20 / 60 - 30.5 / 3600, 90 - 90 - 10 / 60 - 20.5 / 3600])
    np.testing.assert_allclose(np.degrees(recording.readings[0, 1:]), expected)


def test_coordinates_of_several_set_ups_under_an_unknown_title(tmp_path: Path) -> None:
    rows = [
        f"{s};P{k};{1000 * k + 300 * j}.5;{200 * k * k + 77 * j}.5;{50 * k}.5"
        for j, s in enumerate("QRST")
        for k in range(1, 5)
    ]
    with pytest.raises(
        RecordError, match=r"column 'Appareil' may name 4 stations: give --columns \"station=Appareil\""
    ):
        read_text(tmp_path / "a.csv", "\n".join(["Appareil;Name;X [mm];Y [mm];Z [mm]", *rows]) + "\n")


def test_advice_without_a_header_offers_angles_and_coordinates(tmp_path: Path) -> None:
    text = "// job of the hall\nP1, 3000.1, 10.5, 91.2\nP2, 4000.2, 100.5, 92.2\nP3, 5000.4, 250.5, 88.2\n"
    with pytest.raises(
        RecordError, match=r'azimuth=3\[deg\],vertical=4\[deg\],distance=2\[mm\]", or --columns "target=1,x=2'
    ):
        read_text(tmp_path / "a.txt", text, Hints(station="A"))


def test_angles_without_distances_and_stations_are_read(tmp_path: Path) -> None:
    recording = read_text(tmp_path / "a.csv", "Point;Hz [gon];V [gon]\nP1;10.5;98.5\nP2;120.5;101.5\n")
    assert recording.stations == ("S1",)


@pytest.mark.parametrize(
    ("instrument", "target"),
    [("Instrument Ht", "Target Ht"), ("Inst. Hgt", "Refl. Hgt"), ("Alt. instr.", "Alt. prisma"), ("H. Inst", "Rod Ht")],
)
def test_titles_of_heights_may_be_abbreviated(tmp_path: Path, instrument: str, target: str) -> None:
    header = f"Station;Point;Hz [gon];Zenith [gon];SD [m];{instrument};{target}"
    recording = read_text(tmp_path / "a.csv", f"{header}\nA;P;10.5;98.5;12.3456;1.683;1.3\n")
    assert recording.covariates["instrument_height_mm"].tolist() == [1683.0]
    assert recording.covariates["target_height_mm"].tolist() == [1300.0]


def test_a_line_of_heights_between_rows_with_blanks_is_no_pointing(tmp_path: Path) -> None:
    header = "Point Hz[gon] Zenith[gon] SD[m] TH[m]"
    rows = ["Station: A", "Instrument height: 1.55", header, "P 10.5 98.5 12.3456 1.3"]
    rows += ["Station: 102", "Instrument height: 1.65", header, "P 11.5 98.5 12.3456 1.3"]
    recording = read_text(tmp_path / "a.txt", "\n".join(rows) + "\n")
    assert recording.stations == ("A", "102")
    assert recording.covariates["instrument_height_mm"].tolist() == [1550.0, 1650.0]
    with pytest.raises(RecordError, match="row 9: 4 fields, expected 5 as in the header"):
        read_text(tmp_path / "a.txt", "\n".join([*rows, "P 10.5 98.5 12.3456"]) + "\n")


def test_distances_may_have_the_title_s(tmp_path: Path) -> None:
    recording = read_text(tmp_path / "a.csv", "Station;Point;Hz [gon];Zenith [gon];S\nA;P;10.5;98.5;12.3456\n")
    np.testing.assert_allclose(recording.readings[:, 0], 12.3456)
    named = read_text(tmp_path / "b.csv", "Station;Point;Hz [gon];Zenith [gon];S;SD [m]\nA;P;10.5;98.5;1;12.3456\n")
    np.testing.assert_allclose(named.readings[:, 0], 12.3456)


def test_mils_and_survey_feet_are_units(tmp_path: Path) -> None:
    header = "Station;Point;Hz [mil];Zenith [mil];SD (usft)"
    recording = read_text(tmp_path / "a.csv", f"{header}\nA;P;1600.0;1500.0;3937.00\n")
    expected = np.array([[1200.0, 1.5 * np.pi, np.pi / 32]])
    np.testing.assert_allclose(recording.readings % [2000, 2 * np.pi, 2 * np.pi], expected)


def test_row_numbers_are_no_targets(tmp_path: Path) -> None:
    rows = [f"{4 * s + k};P{k};{'AB'[s]};{10 * k + s};98.{k};1{k}.3456" for s in range(2) for k in range(1, 5)]
    text = "\n".join(["Nr.;Bezeichnung;Standpunkt;Hz [gon];Zenith [gon];D [m]", *rows]) + "\n"
    with pytest.raises(RecordError, match=r'numbers the rows.*give --columns "target=Bezeichnung"'):
        read_text(tmp_path / "a.csv", text)
    recording = read_text(tmp_path / "a.csv", text, Hints(columns="target=Bezeichnung"))
    assert recording.targets == ("P1", "P2", "P3", "P4")


def test_words_in_titles_may_be_abbreviated(tmp_path: Path) -> None:
    header = "Station;Point;Horiz. Angle [gon];Ang. Zenital [gon];Dist. suivant pente;i [m];t [m]"
    recording = read_text(tmp_path / "a.csv", f"{header}\nA;P;10.5;98.5;12.3456;1.683;1.3\n")
    np.testing.assert_allclose(recording.readings, [[12.3456, 389.5 * np.pi / 200, 1.5 * np.pi / 200]])
    assert recording.covariates["instrument_height_mm"].tolist() == [1683.0]
    assert recording.covariates["target_height_mm"].tolist() == [1300.0]


def test_the_proposed_unit_of_small_angles_is_radian(tmp_path: Path) -> None:
    rows = [f"{s};P{k};{0.9 * k + s};1.5{k};1{k}.3456" for s in range(2) for k in range(1, 5)]
    with pytest.raises(RecordError, match="therefore give --hint angle=rad"):
        read_text(tmp_path / "a.csv", "\n".join(["Station;Target;H;V;D", *rows]) + "\n")
