"""Plain polar text and the decisions about what its numbers mean."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings, strategies as st

from ltsim.adjustment import adjust
from ltsim.core.errors import RecordError
from ltsim.geometry.rigid import align_rigidly, matrix_from_rotation_vector
from ltsim.recordings import Hints, Recording, read, write
from ltsim.recordings.coordinates import read_points
from tests.recordings.samples import POINTS, outcome, shared, workshop

CLOCKWISE = Hints(azimuth="clockwise")
ALL_HINTS = Hints(angle="gon", vertical="zenith", azimuth="clockwise", length="mm")
SCALE = {"gon": 200 / np.pi, "deg": 180 / np.pi, "rad": 1.0}


def printed(
    path: Path,
    recording: Recording,
    *,
    unit: str = "gon",
    zenith: bool = True,
    clockwise: bool = True,
    metres: bool = False,
    comma: bool = False,
    digits: int = 9,
) -> Path:
    """Write a recording as somebody's instrument would print it."""
    distance, azimuth, elevation = recording.readings.T
    horizontal = np.mod(-azimuth if clockwise else azimuth, 2 * np.pi) * SCALE[unit]
    vertical = (np.mod(np.pi / 2 - elevation, 2 * np.pi) if zenith else elevation) * SCALE[unit]
    lines = []
    for i in range(len(recording)):
        s, t = recording.stations[recording.station[i]], recording.targets[recording.target[i]]
        d = distance[i] * (1 if metres else 1000)
        lines.append(f"{s}\t{t}\t{horizontal[i]:.{digits}f}\t{vertical[i]:.{digits}f}\t{d:.{digits}f}")
    text = "\r\n".join(lines) + "\r\n"
    path.write_text(text.replace(".", ",") if comma else text, newline="")
    return path


@pytest.mark.parametrize("unit", ["gon", "deg", "rad"])
@pytest.mark.parametrize("zenith", [True, False])
@pytest.mark.parametrize("faces", [1, 2])
def test_unit_and_vertical_angle_are_detected(tmp_path: Path, unit: str, zenith: bool, faces: int) -> None:
    """From two faces, or with one face from lengths that two stations share."""
    truth = workshop(faces=faces)
    file = printed(tmp_path / "a.txt", truth, unit=unit, zenith=zenith, comma=unit == "gon", digits=12)
    recording = read(file, hints=CLOCKWISE)
    np.testing.assert_allclose(recording.readings[:, 0], truth.readings[:, 0], atol=1e-9)
    turn = recording.readings[:, 1:] - truth.readings[:, 1:]
    np.testing.assert_allclose(np.mod(turn + 1, 2 * np.pi), 1, atol=1e-9)
    assert np.array_equal(recording.face, truth.face)
    assert any(f"angles are interpreted as {unit}" in note for note in recording.notes)
    assert any("zenith" in note if zenith else "elevation" in note for note in recording.notes)


def test_metres_are_detected(tmp_path: Path) -> None:
    recording = read(printed(tmp_path / "a.txt", workshop(), metres=True), hints=CLOCKWISE)
    np.testing.assert_allclose(recording.readings[:, 0], workshop().readings[:, 0])


def test_the_sense_of_the_azimuth_is_asked_for(tmp_path: Path) -> None:
    """A mirrored network fits itself as well: two set-ups cannot tell, coordinates can."""
    file = printed(tmp_path / "a.txt", workshop())
    with pytest.raises(RecordError, match=r"azimuths is unknown, .*--hint azimuth=clockwise"):
        read(file)


@pytest.mark.parametrize("clockwise", [True, False])
def test_coordinates_decide_the_sense(tmp_path: Path, clockwise: bool) -> None:
    truth = workshop()
    file = printed(tmp_path / "a.txt", truth, clockwise=clockwise)
    turned = POINTS @ matrix_from_rotation_vector(np.array([0.3, -0.8, 2.0])).T + [10.0, 20.0, -3.0]
    points = tmp_path / "points.txt"
    points.write_text(
        "".join(f"T{i + 1} {x * 1e3:.4f} {y * 1e3:.4f} {z * 1e3:.4f}\n" for i, (x, y, z) in enumerate(turned))
    )
    recording = read(file, hints=Hints(points=points))
    turn = recording.readings[:, 1] - truth.readings[:, 1]
    np.testing.assert_allclose(np.mod(turn + 1, 2 * np.pi), 1, atol=1e-9)
    sense = "clockwise" if clockwise else "counter-clockwise"
    assert any(f"azimuths are interpreted as {sense} " in note for note in recording.notes)


def test_points_in_a_plane_do_not_decide(tmp_path: Path) -> None:
    file = printed(tmp_path / "a.txt", workshop())
    points = tmp_path / "points.txt"
    points.write_text("T1 0 0 100\nT2 5800 400 300\nT3 5500 5900 2400\n")
    with pytest.raises(RecordError, match="coordinates of 3 targets do not decide"):
        read(file, hints=Hints(points=points))


def test_a_single_face_of_a_station_is_questioned(tmp_path: Path) -> None:
    recording = workshop(faces=1)
    above = recording.select((recording.station == 0) & (recording.readings[:, 2] > 0))
    file = printed(tmp_path / "a.txt", above, unit="deg")
    with pytest.raises(RecordError, match=r"zenith angles in deg or .*give --hint angle=deg --hint vertical=zenith"):
        read(file, hints=CLOCKWISE)
    read(file, hints=Hints(angle="deg", vertical="zenith", azimuth="clockwise"))


def test_comments_say_what_is_meant(tmp_path: Path) -> None:
    file = tmp_path / "a.txt"
    file.write_text(
        "# Format: spherical\n# Units: gon mm\n# Azimuth: clockwise\n# Vertical: zenith\nP1 12,5\t100\t1500,5\n"
    )
    recording = read(file)
    np.testing.assert_allclose(recording.readings, [[1.5005, 2 * np.pi - 12.5 * np.pi / 200, 0.0]], atol=1e-12)
    assert recording.stations == ("S1",)
    file.write_text("# Format: polar\n# Units: furlong\nP1 12,5\t100\t1500,5\n")
    with pytest.raises(RecordError, match="expected one of deg, gon, rad"):
        read(file)


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("S1 T1 10 95", "4 fields, expected station"),
        ("S1 T1 10 nan 2000", "column horizontal|column vertical: found 'nan'"),
        ("S1 T1 10 95 -2000", "row 3, column distance: found -2000"),
        ("S1 T1 10 95 1e99", "row 3, column distance"),
        ("S1 <T1> 10 95 2000", "holds '<'"),
        ("S1 T1 1000 95 2000", "have none of the units"),
        ("S1 T1 10 95 " + "9" * 30_000, "longer than"),
        ("S1 T1 10 95 2000.", ""),
    ],
)
def test_a_wrong_line(tmp_path: Path, line: str, says: str) -> None:
    file = tmp_path / "a.txt"
    file.write_text(f"S1 T1 10 95 2000\nS1 T1 210 305 2000\n{line}\n")
    result = outcome(lambda: read(file, format="polar-text", hints=CLOCKWISE))
    if says:
        assert isinstance(result, str)
        assert any(part in result for part in says.split("|")) or pytest.fail(result)


def test_a_cut_file(tmp_path: Path) -> None:
    file = printed(tmp_path / "a.txt", workshop())
    content = file.read_bytes()
    for cut in (*range(200), *range(200, len(content), 7)):
        file.write_bytes(content[:cut])
        result = outcome(
            lambda: read(file, hints=Hints(angle="gon", vertical="zenith", azimuth="clockwise", length="mm"))
        )
        assert isinstance(result, str) or content[:cut].endswith((b"\n", b"\r"))


POLAR = st.tuples(st.floats(0.3, 300), st.floats(0, 6.28), st.floats(-1.5, 1.5), st.integers(1, 2))


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    numbers=st.lists(
        st.tuples(st.floats(0.3, 300), st.floats(0, 6.28), st.floats(-1.5, 1.5), st.integers(1, 2)),
        min_size=1,
        max_size=9,
    ),
    names=st.lists(st.sampled_from(["K3", "a b", "P-1.REF.", "\u0160\u00e9"]), min_size=9, max_size=9),
)
def test_written_and_read_back(
    tmp_path: Path, numbers: list[tuple[float, float, float, int]], names: list[str]
) -> None:
    table = np.array([(d, a, np.pi - e if f == 2 else e) for d, a, e, f in numbers])
    targets = tuple(dict.fromkeys(names[: len(table)]))
    assume(len(targets) > 1)  # one name for all rows may be a target that moves
    face = np.array([n[3] for n in numbers])
    truth = workshop().replace(
        stations=("S 1",),
        targets=targets,
        station=np.zeros(len(table), dtype=np.int64),
        target=np.array([targets.index(n) for n in names[: len(table)]]),
        face=face,
        readings=table,
    )
    write(truth, tmp_path / "out.txt", "polar-text")
    back = read(tmp_path / "out.txt")
    np.testing.assert_allclose(back.readings, table, rtol=1e-12, atol=1e-12)
    assert np.array_equal(back.face, face)
    assert [back.targets[i] for i in back.target] == names[: len(table)]
    assert back.stations == ("S 1",)


def test_incomplete_pointings_cannot_be_written(tmp_path: Path) -> None:
    readings = workshop().readings.copy()
    readings[4, 0] = np.nan
    with pytest.raises(RecordError, match="row 5: a reading is missing"):
        write(workshop().with_readings(readings), tmp_path / "out.txt", "polar-text")
    assert not list(tmp_path.iterdir())


def test_point_lists(tmp_path: Path) -> None:
    file = tmp_path / "points.txt"
    file.write_text(
        "A,  -2192.6, -253.7, -368.0,  0.01, 0.02, 0.03, 0.04,  1e-4, 0, 0,  0, 4e-4, 1e-5,  0, 1e-5, 9e-4\n"
    )
    points = read_points(file)
    np.testing.assert_allclose(points.points, [[-2.1926, -0.2537, -0.368]])
    np.testing.assert_allclose(np.diag(points.covariance[0]), [1e-10, 4e-10, 9e-10])
    with pytest.raises(RecordError, match="list of 1 points without instrument readings"):
        read(file)
    file.write_text("A 1 2 3\nA 1 2 4\n")
    with pytest.raises(RecordError, match="row 2: the point A occurs again"):
        read_points(file)
    assert len(read_points(file, refuses_contradictions=False).notes) == 2
    file.write_text("A 1 2\n")
    with pytest.raises(RecordError, match="or lines of a name, x, y and z"):
        read_points(file)


def test_the_girder_epochs() -> None:
    files = sorted(shared("recordings", "desy-girder-at960").glob("Polar_measurements_*.txt"))
    if not files:
        pytest.skip("the recordings of the girder are not beside this checkout")
    for file in files:
        with pytest.raises(RecordError, match="clockwise"):
            read(file)
        points = file.with_name(file.name.replace("Polar_measurements", "Point_List"))
        recording = read(file, hints=Hints(points=points))
        assert len(recording.stations) == 2
        assert any("azimuths are interpreted as clockwise" in note for note in recording.notes)
        assert any("gon, vertical angles as zenith" in note for note in recording.notes)
        assert 0.45 < np.mean(recording.face == 2) < 0.55


@pytest.mark.parametrize(("epoch", "date"), [(3, "21Feb22"), (12, "21Apr22")])
def test_the_girder_comes_out_where_its_authors_have_it(epoch: int, date: str) -> None:
    """Units, zero directions and signs: a mirrored or rescaled network would miss by far more than 5 um."""
    folder = shared("recordings", "desy-girder-at960")
    if not folder.is_dir():
        pytest.skip("the recordings of the girder are not beside this checkout")
    recording = read(folder / f"Polar_measurements_{date}.txt", hints=CLOCKWISE)
    points = adjust(recording, robust=True).state.target_points
    lines = (
        line.replace(",", " ").split() for line in (folder / f"Results_Epoch_{epoch}.txt").read_text().splitlines()
    )
    published = {w[0]: [float(x) for x in w[1:4]] for w in lines if len(w) > 3 and w[0] in recording.targets}
    ours = points[[recording.targets.index(name) for name in published]]
    goal = np.array(list(published.values()))
    rotation, shift = align_rigidly(ours, goal)
    miss = np.linalg.norm(ours @ rotation.T + shift - goal, axis=1)
    assert len(miss) == 88
    assert np.median(miss) < 6e-6
    assert miss.max() < 40e-6


def test_a_station_whose_line_would_be_a_comment_is_refused(tmp_path: Path) -> None:
    recording = workshop()
    for k in range(2):
        names = tuple(f"#{name}" if i == k else name for i, name in enumerate(recording.stations))
        with pytest.raises(RecordError, match=f"station '#{recording.stations[k]}' begins with #"):
            write(recording.replace(stations=names), tmp_path / "a.txt", "polar-text")
    assert not (tmp_path / "a.txt").exists()
