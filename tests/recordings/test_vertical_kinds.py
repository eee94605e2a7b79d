"""Kinds of vertical angle and of circle that a reader must not mistake for another."""

from pathlib import Path

import numpy as np
import pytest

from ltsim.core.errors import RecordError
from ltsim.recordings import Hints, read

HORIZONTAL_DEG = (33.5125, 121.2075, 250.0325, 310.9975)
ZENITH_DEG = (88.0125, 91.5075, 79.2525, 95.0075)
DISTANCE_M = (12.1234, 31.4321, 22.2222, 18.8765)


def table(path: Path, header: str, verticals: dict[str, list[float]]) -> Path:
    """Table of one face with the vertical angles [deg] of each station."""
    rows = [header]
    for station, angles in verticals.items():
        for i, (horizontal, vertical, distance) in enumerate(zip(HORIZONTAL_DEG, angles, DISTANCE_M, strict=True)):
            rows.append(f"{station},P{i + 1},{horizontal},{vertical},{distance}")
    path.write_text("\n".join(rows) + "\n")
    return path


NADIR_DEG = [180.0 - zenith for zenith in ZENITH_DEG]
ELEVATION_DEG = [90.0 - zenith for zenith in ZENITH_DEG]


@pytest.mark.parametrize("columns", [None, "vertical=Nadir angle [deg]"])
def test_nadir_angles_are_never_read_upside_down(tmp_path: Path, columns: str | None) -> None:
    header = "Station,Target,Hz [deg],Nadir angle [deg],SD [m]"
    path = table(tmp_path / "nadir.csv", header, {"A": NADIR_DEG, "B": NADIR_DEG})
    with pytest.raises(RecordError, match=r"nadir angles.*write zenith angles"):
        read(path, hints=Hints(columns=columns))


def test_a_mixture_of_zenith_angles_and_elevations_is_named(tmp_path: Path) -> None:
    header = "Station,Target,Hz [deg],V [deg],SD [m]"
    path = table(tmp_path / "mixture.csv", header, {"A": list(ZENITH_DEG), "B": ELEVATION_DEG})
    with pytest.raises(RecordError, match=r"-5\.0075.*95\.0075.*mix zenith angles and elevations"):
        read(path)


def test_a_circle_with_an_unknown_title_is_reported(tmp_path: Path) -> None:
    path = table(tmp_path / "circle.csv", "Station,Target,Limbus [deg],Zenith [deg],SD [m]", {"A": list(ZENITH_DEG)})
    recording = read(path)
    assert not np.isfinite(recording.readings[:, 1]).any()
    assert any(
        "no column is recognised as azimuths" in note and "horizontal=Limbus" in note for note in recording.notes
    )


@pytest.mark.parametrize(("second", "is_position"), [((0, 0, 0), False), ((5000, 1000, 0), True)])
def test_equal_coordinates_of_all_stations_are_no_positions(
    tmp_path: Path, second: tuple[int, int, int], is_position: bool
) -> None:
    lines = []
    for station, coordinates in (("A", (0, 0, 0)), ("B", second)):
        words = " ".join(f"{key}..10+{value:08d}" for key, value in zip((84, 85, 86), coordinates, strict=True))
        lines.append(f"11{len(lines) + 1:04d}+{station:0>8} {words} 88..10+00001500 ")
        for i, (horizontal, zenith, distance) in enumerate(zip(HORIZONTAL_DEG, ZENITH_DEG, DISTANCE_M, strict=True)):
            angles = f"21.322+{round(horizontal / 0.9e-5):08d} 22.322+{round(zenith / 0.9e-5):08d}"
            lines.append(f"11{len(lines) + 1:04d}+{f'P{i + 1}':0>8} {angles} 31..00+{round(distance * 1e3):08d} ")
    path = tmp_path / "book.gsi"
    path.write_text("\r\n".join(lines) + "\r\n")
    recording = read(path)
    positions = [recording.setup.stations[name].position_mm for name in recording.stations]
    assert [position is not None for position in positions] == [is_position] * 2
    assert any("same coordinates (0, 0, 0) m" in note for note in recording.notes) == (not is_position)


@pytest.mark.parametrize(
    ("header", "rest"), [("Station,Target,Hz [gon]", ""), ("Station,Target,Hz [gon],V [gon]", ",")]
)
def test_directions_alone_are_read(tmp_path: Path, header: str, rest: str) -> None:
    rows = [f"{s},P{i + 1},{angle}{rest}" for s in ("A", "B") for i, angle in enumerate(HORIZONTAL_DEG)]
    path = tmp_path / "directions.csv"
    path.write_text("\n".join([header, *rows]) + "\n")
    recording = read(path)
    assert (recording.stations, recording.targets) == (("A", "B"), ("P1", "P2", "P3", "P4"))
    turned = np.exp(1j * (recording.readings[:4, 1] + np.array(HORIZONTAL_DEG) * np.pi / 200))
    np.testing.assert_allclose(np.angle(turned), 0.0, atol=1e-9)
    assert not np.isfinite(recording.readings[:, [0, 2]]).any()
