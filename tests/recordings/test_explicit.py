"""Tables as surveyors and offices keep them: heights, sigmas, coordinates a station, rounds, days, names, workbooks."""

from __future__ import annotations

import copy
import gc
import io
import pickle
import re
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment import adjust
from ltsim.core.errors import RecordError
from ltsim.geometry.polar import from_polar
from ltsim.recordings import Hints, read
from ltsim.recordings.conventions import mirror_image_warnings
from ltsim.recordings.coordinates import read_points
from ltsim.recordings.result_file import read_json
from ltsim.recordings.settings import read_setup
from ltsim.recordings.setup import Station
from tests.recordings import test_tables as tables
from tests.recordings.samples import POSITIONS, YAWS, outcome, workshop

SURVEY = """fromstn,fromhgt,tostn,tohgt,date,obsset,ha_value,ha_error,zd_value,zd_error,sd_value,sd_error
A,1.620,B,1.700,2015-03-15,1,10.0,0.0003,95.0,0.0003,327.6857,0.0001
A,1.620,C,0.100,2015-03-15,1,70.0,0.0003,92.0,0.0003,227.3644,0.0001
A,1.620,B,1.800,2015-03-16,2,30.0,0.0003,95.1,0.0003,327.6857,0.0001
A,1.620,C,0.200,2015-03-16,2,90.0,0.0003,92.1,0.0003,227.3644,0.0001
B,1.500,A,1.650,2015-03-16,1,20.0,0.0003,84.9,0.0003,327.6857,0.0002
"""


def file_of(folder: Path, text: str | bytes, name: str = "a.csv") -> Path:
    (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder / name


def test_heights_and_sigmas_of_every_row_are_read(tmp_path: Path) -> None:
    """They were further columns: one staff at four heights was one target, and all of a day at second 0."""
    recording = read(file_of(tmp_path, SURVEY), hints=Hints(angle="deg", vertical="zenith"))
    np.testing.assert_allclose(recording.covariates["instrument_height_mm"], [1620, 1620, 1620, 1620, 1500])
    np.testing.assert_allclose(recording.covariates["target_height_mm"], [1700, 100, 1800, 200, 1650])
    np.testing.assert_allclose(recording.covariates["sigma_distance_mm"], [0.1, 0.1, 0.1, 0.1, 0.2])
    np.testing.assert_allclose(recording.covariates["sigma_azimuth_arcsec"], 1.08)
    np.testing.assert_allclose(recording.covariates["sigma_elevation_arcsec"], 1.08)
    np.testing.assert_allclose(recording.readings[0, 0], 327.6857)
    assert not recording.regressor_covariates.keys() & {"tohgt", "target_height_mm", "ha_error"}
    assert not recording.has_clock
    assert recording.labels["date"][0] == "2015-03-15"
    notes = "\n".join(recording.notes)
    assert "distances are interpreted as m ('fromhgt'" in notes
    assert "'date' contains dates without a time" in notes
    assert "3 occupations of 2 marks, distinguished by day, are separate set-ups" in notes
    assert "declares no noise" not in notes
    assert recording.stations == ("A", "A#2", "B")
    assert [recording.station_setup(name).over for name in recording.stations] == ["A", "A", "B"]
    assert all(recording.station_setup(name).levelled for name in recording.stations)


def test_columns_names_heights_and_sigmas(tmp_path: Path) -> None:
    text = "A,B,C,D,E,F,G\nS1,T1,10,90,5000,1.5,3\nS1,T2,20,91,6000,1.6,3\n"
    wanted = (
        "station=A,target=B,horizontal=C[deg],zenith=D[deg],distance=E[mm],"
        "target_height_mm=F[m],sigma_azimuth_arcsec=G[cc]"
    )
    recording = read(file_of(tmp_path, text), hints=Hints(columns=wanted))
    np.testing.assert_allclose(recording.covariates["target_height_mm"], [1500, 1600])
    np.testing.assert_allclose(recording.covariates["sigma_azimuth_arcsec"], 0.972)
    assert any("declares no noise" in note for note in recording.notes)


def test_a_distance_that_may_be_metres_is_asked_for(tmp_path: Path) -> None:
    file = file_of(tmp_path, "Station,Point,Hz[deg],Z[deg],D\nS,A,10,90,327.5\nS,B,20,91,412.25\n")
    with pytest.raises(RecordError, match="may be metres or millimetres; give --hint length=m"):
        read(file)
    assert read(file, hints=Hints(length="m")).readings[0, 0] == 327.5


def places(path: Path, *, named: bool = True, single_frame: bool = False) -> Path:
    """The workshop as coordinates in each instrument's own axes."""
    r = workshop(faces=1)
    points = from_polar(r.readings) * 1e3
    rows = ["Setup;Name;X [mm];Y [mm];Z [mm];sX [mm];sY [mm];sZ [mm]"]
    for s, t, point in zip(r.station, r.target, points, strict=True):
        shown = points[r.target == t][0] if single_frame else point
        cells = [r.stations[s], r.targets[t], *(f"{v:.7f}".replace(".", ",") for v in shown), "0,02", "0,02", "0,02"]
        rows.append(";".join(cells[0 if named else 1 :]))
    path.write_text("\n".join(rows if named else [rows[0][6:], *rows[1:]]) + "\n")
    return path


def test_coordinates_of_each_station_become_readings(tmp_path: Path) -> None:
    recording = read(places(tmp_path / "a.csv"))
    want = workshop(faces=1).readings
    np.testing.assert_allclose(recording.readings[:, [0, 2]], want[:, [0, 2]], atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * recording.readings[:, 1]), np.exp(1j * want[:, 1]), atol=1e-9)
    np.testing.assert_allclose(recording.covariates["sigma_distance_mm"], 0.02)
    level = want[:, 0] * np.cos(want[:, 2])
    np.testing.assert_allclose(recording.covariates["sigma_azimuth_arcsec"], np.degrees(2e-5 / level) * 3600, rtol=1e-6)
    np.testing.assert_allclose(
        recording.covariates["sigma_elevation_arcsec"], np.degrees(2e-5 / want[:, 0]) * 3600, rtol=1e-6
    )
    assert any("converted to distance, azimuth and elevation" in note for note in recording.notes)
    with pytest.raises(RecordError, match="thus in one frame; export them in the axes of each instrument"):
        read(places(tmp_path / "b.csv", single_frame=True))
    rows = places(tmp_path / "c.csv", named=False).read_text().splitlines()[:7]
    list_ = file_of(tmp_path, "\n".join(rows) + "\n", "d.csv")
    with pytest.raises(RecordError, match=r"list of 6 points without instrument readings.*--hint station=NAME"):
        read(list_)
    alone = read(list_, format="table", hints=Hints(station="S9"))
    assert (alone.stations, len(alone)) == (("S9",), 6)


def test_a_network_of_coordinates_is_that_of_its_readings_and_a_single_sigma_serves_all_axes(tmp_path: Path) -> None:
    rows = places(tmp_path / "a.csv").read_text().splitlines()
    once = [row.rsplit(";", 2)[0] for row in rows]
    once[0] = once[0].replace("sX", "sigma")
    adjustment = lt.adjust(read(file_of(tmp_path, "\n".join(once) + "\n", "b.csv")))
    whole = lt.adjust(read(tmp_path / "a.csv"))
    assert adjustment.fit.chi2 == pytest.approx(whole.fit.chi2, rel=1e-9)
    r = workshop(faces=1)
    range_, elevation = r.readings[:, 0], r.readings[:, 2]
    sigma = 2e-5 * np.stack([np.ones(len(r)), 1 / (range_ * np.cos(elevation)), 1 / range_], axis=1)
    polar = adjust(r, sigma=sigma)
    np.testing.assert_allclose(adjustment.adjustment.state.target_points, polar.state.target_points, atol=1e-8)
    folder = tmp_path / "folder"
    folder.mkdir()
    for name in r.stations:
        lines = [row.split(";")[1:5] for row in rows if row.startswith(f"{name};")]
        (folder / f"{name}.txt").write_text("".join(" ".join(cells).replace(",", ".") + "\n" for cells in lines))
    with pytest.raises(RecordError) as refused:
        read(folder)
    asked = str(refused.value).partition('--columns "')[2].rstrip('"')
    assert asked == "target=1,x=2[mm],y=3[mm],z=4[mm]"
    again = read(folder, hints=Hints(columns=asked))
    np.testing.assert_allclose(adjust(again, sigma=sigma).state.target_points, polar.state.target_points, atol=1e-8)


def test_names_that_differ_by_set_up(tmp_path: Path) -> None:
    rows = [f"{s},{n},{10 * i},{5 + i},3000" for s in ("S1", "S2") for i, n in enumerate(("a", "b", "c"))]
    head = "Station,Point,Az[deg],El[deg],D[mm]\n"
    text = "\n".join(f"{row[:3]}{row[:2]}_{row[3:]}" for row in rows)
    recording = read(file_of(tmp_path, head + text + "\n"))
    assert recording.targets == ("a", "b", "c")
    assert any("removed from the names of its targets: 'S1_a' is 'a'" in note for note in recording.notes)
    other = "S1,P 01,1,5,3000\nS1,P2,2,5,3000\nS2,p1,1,6,3000\nS2,P02,2,5,3000\n"
    recording = read(file_of(tmp_path, head + other))
    assert recording.targets == ("P 01", "P2")
    assert any("are the same target: 'p1' and 'P 01'" in note for note in recording.notes)
    both = "S1,P1,1,5,3000\nS1,P01,2,5,3000\nS2,P1,1,6,3000\n"
    assert read(file_of(tmp_path, head + both)).targets == ("P1", "P01")


def test_blocks_with_broken_cells_keep_what_they_hold(tmp_path: Path) -> None:
    """A KeyError where a later block had further columns."""
    head = "Point;Face;Hz [deg];Z [deg];D [mm];T [C]"
    text = f"Station: S1\n{head}\nP1;1;10;80;3000;#REF!\nStation: S2\n{head};Op\nP1;1;15;81;3000;#REF!;x\n"
    recording = read(file_of(tmp_path, text))
    assert recording.labels == {"T [C]": ("#REF!", "#REF!"), "Op": ("", "x")}
    with pytest.raises(RecordError, match="row 5: the columns differ from those of earlier headers"):
        read(file_of(tmp_path, text.replace(f"{head};Op", f"{head};Op".replace("[deg]", "[gon]"))))


@pytest.mark.parametrize(
    ("content", "name", "places", "sigma"),
    [
        ("Name;X [mm];Y [mm];Z [mm]\nA;7.000,000;1.500,5;2\nB;8.000;2;3\n", "A", [7, 1.5005, 0.002], None),
        (
            "Punkt;Rechtswert;Hochwert;Höhe\nA1;35000,123;5400000,456;120,5\n".encode("cp1252"),
            "A1",
            [35000.123, 5400000.456, 120.5],
            None,
        ),
        ("x_m\ty_m\tz_m\tname\n1\t2\t3\tA\n", "A", [1, 2, 3], None),
        (
            "Nr,Easting,Northing,Elevation,sE,sN\n1,100.5,200.5,3.2,0.001,0.002\n",
            "1",
            [100.5, 200.5, 3.2],
            [0.001, 0.002, np.nan],
        ),
        ("target,x_mm,y_mm,z_mm,sigma\nA,1000,2000,,0.02\n".encode("utf-16"), "A", [1, 2, np.nan], [2e-5, 2e-5, 2e-5]),
        ("A 1,5 2,5 3,5\nB 4,5 5,5 6,5\n", "A", [1.5, 2.5, 3.5], None),
    ],
)
def test_lists_of_coordinates(
    tmp_path: Path, content: str | bytes, name: str, places: list, sigma: list | None
) -> None:
    points = read_points(file_of(tmp_path, content))
    assert points.names[0] == name
    np.testing.assert_allclose(points.points[0], places)
    np.testing.assert_allclose(points.coordinate_sigmas[0], sigma or [np.nan] * 3)


def test_a_point_in_another_row_is_grouped_as_its_list_groups(tmp_path: Path) -> None:
    points = read_points(file_of(tmp_path, "Name;X [mm];Y [mm];Z [mm]\nA;7.000,5;1;2\nB;8.000;2;3\n"))
    assert points.coordinates_by_name["B"][0] == 8.0
    with pytest.raises(RecordError, match="contains numbers written as"):
        read_points(file_of(tmp_path, "Name;X [mm];Y [mm];Z [mm]\nA;7.000,5;1;2\nB;8,000.5;2;3\n"))


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("wrong,thing\n1,2\n", "is not a list of coordinates, expected a header that names the point"),
        ("name,x_mm,y_mm,z_mm\nA,1,x,3\n", "row 2, column y_mm: found 'x', expected a number"),
        ("name,x_mm,y_mm,z_mm\n", "contains no points"),
        ("name,x_mm,y_mm,z_mm\nA,1,2,3\nA,1,2,4\n", "row 3: the point A occurs again with different coordinates"),
        ("name,x_mm,y_mm,z_mm\nA,1,2,3,4\n", "5 fields, expected 4 as in the header"),
    ],
)
def test_wrong_lists_are_refused_in_a_sentence(tmp_path: Path, content: str, says: str) -> None:
    result = outcome(lambda: read_points(file_of(tmp_path, content)))  # type: ignore[arg-type]
    assert isinstance(result, str) and says in result, result


def packed(base: Path, path: Path, part: str, change: Callable[[bytes], bytes]) -> Path:
    """A workbook with one part changed."""
    with zipfile.ZipFile(base) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            content = old.read(name)
            new.writestr(name, change(content) if name.endswith(part) else content)
        if "Strings" in part:
            new.writestr(f"xl/{part}", change(b"<sst></sst>"))
    return path


@pytest.mark.long
@pytest.mark.parametrize(
    ("part", "change", "says"),
    [
        ("sheet1.xml", lambda c: c[:900] + b"<<&" + c[903:], "it is damaged; save it again"),
        ("sheet1.xml", lambda c: c.replace(b"</v>", b"gon53</v>"), "it is damaged; save it again"),
        (
            "sheet1.xml",
            lambda c: c.replace(b"</sheetData>", b"<row/>" * 600_000 + b"</sheetData>"),
            "more than 500000 rows",
        ),
        (
            "sheet1.xml",
            lambda c: c.replace(b"</sheetData>", b'<row r="900000"><c r="A900000"><v>1</v></c></row></sheetData>'),
            "delete the cells far away from the table",
        ),
        ("sheet1.xml", lambda c: c + b" " * 17_000_000, "unpacks to more than 16 MiB"),
        ("xl/workbook.xml", lambda c: c[:99], "it is damaged; save it again"),
        ("workbook.xml", lambda c: c.replace(b"<sheets>", b"<a>" * 70 + b"<sheets>"), "deeper than 64"),
        (
            "sheet1.xml",  # 4,000,000 cells in a row took 1.3 GB
            lambda c: c.replace(b"</sheetData>", b"<row>" + b"<c/>" * 17_000 + b"</row></sheetData>"),
            "16384 cells in a row",
        ),
        ("Strings.xml", lambda c: b"<sst>" + b"<si/>" * 1_200_001 + b"</sst>", "more than 1200000 XML elements"),
        (
            "xl/workbook.xml",  # a part that 199 sheets read took minutes
            lambda c: re.sub(rb'(<sheet [^>]*?)name="[^"]*"([^>]*>)', rb'\g<0>\1name="again"\2', c),
            "two sheets with the same content part",
        ),
    ],
)
def test_workbooks_are_bounded_and_reported(
    tmp_path: Path, part: str, change: Callable[[bytes], bytes], says: str
) -> None:
    """Tracebacks, 3.3 GB and 24 s for one cell far away, files that stay open."""
    file = packed(tables.workbook(tmp_path / "a.xlsx"), tmp_path / "b.xlsx", part, change)
    gc.disable()
    try:
        result = outcome(lambda: read(file))
        buffers = [item for item in gc.get_objects() if isinstance(item, io.BufferedReader) and item.name == str(file)]
    finally:
        gc.enable()
    assert isinstance(result, str) and says in result, result
    assert all(item.closed for item in buffers)


def test_numbers_of_thousands_of_digits_and_keys_with_brackets(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match=r"contains the number 1111.*, expected a finite number of at most 1e"):
        read_json(file_of(tmp_path, '{"a": ' + "1" * 5000 + "}", "c.json"), "calibration.json")
    file = file_of(tmp_path, 'format = "ltsim-recording/1"\n"a[0]" = 1\n', "setup.toml")
    with pytest.raises(RecordError, match=r"unknown key a\[0\]; did you mean"):
        read_setup(file)


def test_recordings_are_copied_pickled_and_compared() -> None:
    hall = workshop()
    holed = hall.with_readings(np.where(np.arange(72).reshape(24, 3) % 7 == 3, np.nan, hall.readings))
    for recording in (hall, holed):
        for other in (pickle.loads(pickle.dumps(recording)), copy.deepcopy(recording), recording.replace()):
            assert other == recording
            assert hash(other) == hash(recording)
    assert hall != holed
    assert hall != hall.replace(covariates={"load": np.zeros(24)})
    assert hall != "a recording"


def test_a_mirrored_hall_and_a_mirrored_station_are_reported() -> None:
    """Both passed without a word: lengths and faces agree in the mirror image."""
    hall = workshop()
    stations = {
        name: Station(position_mm=tuple((POSITIONS[i] * 1e3).round(-2)), yaw_deg=round(np.degrees(YAWS[i])))
        for i, name in enumerate(hall.stations)
    }
    hall = hall.replace(setup=hall.setup.model_copy(update={"stations": stations}))
    assert not mirror_image_warnings(hall)
    mirrored = mirror_image_warnings(hall.with_readings(hall.readings * [1.0, -1.0, 1.0]))
    assert len(mirrored) == 1 and "only the mirror image of the readings: if the azimuths run clockwise" in mirrored[0]
    second = np.where((hall.station == 1)[:, None], [1.0, -1.0, 1.0], 1.0)
    notes = mirror_image_warnings(workshop().with_readings(hall.readings * second))
    assert notes == (
        "the targets of S1 and S2 fit each other only as mirror images: the azimuths of one of these stations "
        "run clockwise",
    )


def test_a_native_recording_is_mirrored_on_request(tmp_path: Path) -> None:
    from ltsim.recordings import write

    write(workshop(), tmp_path / "rec")
    turned = read(tmp_path / "rec", hints=Hints(azimuth="clockwise"))
    np.testing.assert_allclose(turned.readings[:, 1], -workshop().readings[:, 1])
