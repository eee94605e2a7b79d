"""Tables as surveyors' software writes them: nothing in them is misread without a word."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ltsim.core.errors import RecordError
from ltsim.core.units import ARCSECOND, DEGREE, GON
from ltsim.recordings import Hints, Recording, read

TARGETS = ("P1", "P2", "P3", "P4")
HORIZONTAL_DEG = (33.5125, 121.2075, 250.0325, 310.9975)
ZENITH_DEG = (88.0125, 91.5075, 79.2525, 95.0075)
DISTANCE_M = (12.1234, 31.4321, 22.2222, 18.8765)
STATIONS = ("A", "B")


def write(path: Path, header: str, form: str, tail: str = "") -> Path:
    """Table with the rows of both stations; `form` is filled with station, name, angles, their parts, and distance."""
    rows = []
    for station in STATIONS:
        for name, h, z, d in zip(TARGETS, HORIZONTAL_DEG, ZENITH_DEG, DISTANCE_M, strict=True):
            values = {"s": station, "t": name, "d": d, "h": h, "z": z, "hg": h / 0.9, "zg": z / 0.9, "n": len(rows)}
            for key, angle in (("h", h), ("z", z)):
                seconds = round(angle * 3600)
                values |= {f"{key}d": seconds // 3600, f"{key}m": seconds // 60 % 60, f"{key}s": seconds % 60}
            rows.append(form.format(**values))
    path.write_text("\n".join([header, *rows]) + "\n" + tail)
    return path


def assert_right(recording: Recording) -> None:
    assert (recording.stations, recording.targets) == (STATIONS, TARGETS)
    np.testing.assert_allclose(recording.readings[:, 0], [*DISTANCE_M, *DISTANCE_M])
    azimuths = np.exp(1j * (recording.readings[:, 1] + np.array([*HORIZONTAL_DEG, *HORIZONTAL_DEG]) * DEGREE))
    np.testing.assert_allclose(np.angle(azimuths), 0.0, atol=0.01 * ARCSECOND)
    elevations = np.pi / 2 - np.array([*ZENITH_DEG, *ZENITH_DEG]) * DEGREE
    np.testing.assert_allclose(recording.readings[:, 2], elevations, atol=0.01 * ARCSECOND)


@pytest.mark.parametrize(
    ("header", "form"),
    [
        ("From;To;Hz_deg;Hz_min;Hz_sec;Z_deg;Z_min;Z_sec;SD [m]", "{s};{t};{hd};{hm};{hs};{zd};{zm};{zs};{d}"),
        ("From;To;Hz deg;V deg;Hz min;V min;Hz sec;V sec;SD [m]", "{s};{t};{hd};{zd};{hm};{zm};{hs};{zs};{d}"),
        ("Station;Point;Hz(gon);Vz(gon);Dist(m)", "{s};{t};{hg:.6f};{zg:.6f};{d}"),
        ("Occupied;Observed;Hz[deg];Zd[deg];Dist[m]", "{s};{t};{h};{z};{d}"),
        ("Stn Pt Hz [deg] V [deg] D [m]", "{s} {t} {h} {z} {d}"),
    ],
)
def test_titles_and_parts_of_angles_are_recognised(tmp_path: Path, header: str, form: str) -> None:
    assert_right(read(write(tmp_path / "a.txt", header, form), hints=Hints(vertical="zenith")))


@pytest.mark.parametrize(
    "tail", ["Total;8;;;169.31\n", "Summe;;;;169.31\nMittel;;178.9;88.4;21.16\n", "Mean :;;178.9;88.4;21.16\n"]
)
def test_sums_and_means_below_a_table_are_no_pointings(tmp_path: Path, tail: str) -> None:
    path = write(tmp_path / "a.csv", "Station;Point;Hz[deg];Zd[deg];D[m]", "{s};{t};{h};{z};{d}", tail)
    recording = read(path)
    assert_right(recording)
    assert any("free text is not used" in note and tail[:4] in note for note in recording.notes)


def test_a_point_named_like_a_sum_is_a_point(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "Point;Station;Hz[deg];Zd[deg];D[m]", "{t};{s};{h};{z};{d}", "Max;B;10;90;5.5\n")
    assert "Max" in read(path).targets


@pytest.mark.parametrize(("title", "factor"), [("epoch_ms", 1e-3), ("Epoch [s]", 1.0)])
def test_an_epoch_with_a_unit_of_time_is_the_time(tmp_path: Path, title: str, factor: float) -> None:
    header = f"Station;Point;Hz[deg];Zd[deg];D[m];{title}"
    recording = read(write(tmp_path / "a.csv", header, "{s};{t};{h};{z};{d};177243840{n}"))
    assert_right(recording)
    np.testing.assert_allclose(recording.time - recording.time[0], factor * np.arange(8), atol=1e-6)


def test_rounds_of_a_single_pointing_are_no_rounds(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "Station;Point;Hz[deg];Zd[deg];D[m];Epoch", "{s};{t};{h};{z};{d};{n}")
    recording = read(path)
    assert_right(recording)
    assert any('--columns "time=Epoch[s]"' in note for note in recording.notes)


def test_a_sigma_of_distances_next_to_distances(tmp_path: Path) -> None:
    header = "Station;Point;Hz[deg];Zd[deg];sHz(mgon);sV(mgon);sD(mm);D[m]"
    recording = read(write(tmp_path / "a.csv", header, "{s};{t};{h};{z};0.3;0.4;0.6;{d}"))
    assert_right(recording)
    sigmas = [recording.covariates[f"sigma_{name}"] for name in ("distance_mm", "azimuth_arcsec", "elevation_arcsec")]
    expected = np.array([0.6, 0.3e-3 * GON / ARCSECOND, 0.4e-3 * GON / ARCSECOND])
    np.testing.assert_allclose(np.array(sigmas).T, np.tile(expected, (8, 1)))


def test_an_unrecognised_column_of_angles_is_asked_for(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "Station;Point;Hz[deg];Tilt_deg;D[m]", "{s};{t};{h};{z};{d}")
    note = next(note for note in read(path).notes if "vertical angles" in note)
    assert note.startswith("no column is recognised as vertical angles, so the recording contains none")
    assert_right(read(path, hints=Hints(columns=note.split('"')[1], vertical="zenith", angle="deg")))


def test_unrecognised_names_are_asked_for(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "Where;What;Hz[deg];Zd[deg];D[m]", "{s};{t};{h};{z};{d}")
    with pytest.raises(RecordError, match=r"names no points, and 'Where', 'What' may contain names; give --columns"):
        read(path)
    assert_right(read(path, hints=Hints(columns="station=Where,target=What")))


def test_a_short_row_between_blanks_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.txt", "Stn Pt Hz[deg] Zd[deg] Slope dist[m]", "{s} {t} {h} {z} {d}")
    with pytest.raises(RecordError, match="row 2: 5 fields, expected 6 as in the header; titles and cells with blanks"):
        read(path)


def test_an_empty_name_is_reported_with_its_line(tmp_path: Path) -> None:
    path = write(
        tmp_path / "a.csv", "# a\n# b\nStation;Point;Hz[deg];Zd[deg];D[m]", "{s};{t};{h};{z};{d}", "B;;1;90;5\n"
    )
    with pytest.raises(RecordError, match="row 12, column target: the name of a target is empty"):
        read(path)
