"""Two epochs from lists of coordinates: each point by itself, frames, axes, files, the verb."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
from scipy.spatial.transform import Rotation

import ltsim as lt
from ltsim.cli.main import run
from ltsim.core.arrays import Floats
from ltsim.core.errors import LtsimError, ModelError, NetworkError, RecordError
from ltsim.core.randomness import random_stream
from ltsim.geometry.rigid import rigid_motion_jacobian
from ltsim.measurands.comparison import Comparison
from ltsim.measurands.epochs import compare_coordinates
from ltsim.recordings.coordinates import read_coordinates
from ltsim.recordings.epoch_coordinates import EpochCoordinates
from ltsim.recordings.result_file import read_result
from tests.networks import network as small_network

POINTS = ("901", "902", "903", "904", "905")


def crown(epoch: int) -> EpochCoordinates:
    """Five points on the crown of a wall, seen from fixed points in both epochs; they did not move."""
    rng = random_stream(9, "crown", epoch)
    root = 0.4 * rng.normal(size=(10, 10)) + np.diag(np.full(10, 1.0))
    covariance = 1e-6 * root @ root.T
    points = np.zeros((5, 3))
    points[:, :2] = random_stream(9, "wall").uniform(100.0, 300.0, (5, 2))
    points[:, :2] += np.linalg.cholesky(covariance).dot(rng.normal(size=10)).reshape(5, 2)
    return EpochCoordinates(f"epoch {epoch + 1}", POINTS, "xy", points, covariance)


def test_each_point_is_tested_with_its_covariance_blocks() -> None:
    first, second = crown(0), crown(1)
    comparison = compare_coordinates(first, second)
    shift = (second.points - first.points)[:, :2]
    blocks = [np.ix_([2 * i, 2 * i + 1], [2 * i, 2 * i + 1]) for i in range(5)]
    chi2 = [
        d @ np.linalg.solve((first.covariance + second.covariance)[b], d) for d, b in zip(shift, blocks, strict=True)
    ]
    np.testing.assert_allclose([d.point_chi2 for d in comparison.displacements], chi2, rtol=1e-9)
    assert not comparison.moved_points
    assert comparison.dof == 10


def written(epoch: EpochCoordinates, path: Path) -> Path:
    """The list as CSV with its covariance beside it."""
    header = ["target", *(f"{axis}_mm" for axis in epoch.axes)]
    rows = [
        [name, *(repr(1e3 * float(p[k])) for k in epoch.axis_indices)]
        for name, p in zip(epoch.names, epoch.points, strict=True)
    ]
    path.write_text("\n".join(",".join(row) for row in [header, *rows]) + "\n")
    coordinates = [f"{name}.{axis}" for name in epoch.names for axis in epoch.axes]
    matrix = [
        [name, *(repr(1e6 * float(x)) for x in row)] for name, row in zip(coordinates, epoch.covariance, strict=True)
    ]
    lines = [["covariance_mm2", *coordinates], *matrix]
    path.with_suffix(".covariance.csv").write_text("\n".join(",".join(row) for row in lines) + "\n")
    return path


def test_the_verb_compares_lists(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [str(written(crown(i), tmp_path / f"{i}.csv")) for i in (0, 1)]
    assert run(["compare", *paths, "--out", str(tmp_path / "out")]) == 0
    assert "No point moved" in capsys.readouterr().out
    content = read_result(tmp_path / "out", Comparison)
    chi2_values = [d.point_chi2 or np.nan for d in compare_coordinates(crown(0), crown(1)).displacements]
    np.testing.assert_allclose([d.point_chi2 or np.nan for d in content.displacements], chi2_values, rtol=1e-6)
    assert run(["report", str(tmp_path / "out"), "--quiet"]) == 0
    assert not lt.compare(*paths).moved_points
    assert run(["compare", *paths, "--robust"]) == 2
    assert "contain no readings" in capsys.readouterr().err
    (tmp_path / "1.covariance.csv").write_text("covariance_mm2,901.x\n901.x,1\n")
    assert run(["compare", *paths]) == 2
    assert "lacks the coordinate 901.y" in capsys.readouterr().err


def network(axes: str, seed: int, shift: Floats | None = None, *, turned: bool = False) -> EpochCoordinates:
    """Ten points of a free adjustment (inner constraints), somewhere else in each epoch where `turned`."""
    rng = random_stream(5, "places")
    along = np.array(["xyz".index(axis) for axis in axes])
    points = np.zeros((10, 3))
    points[:, along] = rng.uniform(0, 10, (10, 3))[:, along]
    raw = rng.normal(size=(10 * len(along),) * 2) * 1e-4
    free = rigid_motion_jacobian(points).reshape(10, 3, 6)[:, along].reshape(-1, 6)
    basis = scipy.linalg.orth(free[:, np.linalg.norm(free, axis=0) > 0])
    project = np.eye(len(raw)) - basis @ basis.T
    covariance = project @ (raw @ raw.T / len(raw) + 1e-9 * np.eye(len(raw))) @ project
    noise = (
        project
        @ np.linalg.cholesky(raw @ raw.T / len(raw) + 1e-9 * np.eye(len(raw)))
        @ random_stream(seed, "noise").normal(size=len(raw))
    )
    moved = points + (0.0 if shift is None else shift)
    moved[:, along] += noise.reshape(10, -1)
    if turned:
        turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
        moved = moved @ turn.T + (np.array([3.0, -2.0, 1.0]) * [axis in axes for axis in "xyz"])
        big = np.kron(np.eye(10), turn[np.ix_(along, along)])
        covariance = big @ covariance @ big.T
    return EpochCoordinates("free", tuple(f"P{i}" for i in range(10)), axes, moved, covariance)


@pytest.mark.parametrize("axes", ["xyz", "xy", "z"])
def test_free_networks_are_compared_whatever_their_frames(axes: str) -> None:
    """P-values of networks that did not move are uniform; a point that did is named, and no other."""
    turned = len(axes) > 1
    pairs = [(network(axes, 2 * i), network(axes, 2 * i + 1, turned=turned)) for i in range(40)]
    comparisons = [compare_coordinates(*pair, has_free_motions=True) for pair in pairs]
    assert comparisons[0].dof == {"xyz": 24, "xy": 17, "z": 9}[axes]
    assert 0.35 < np.mean([c.p_value for c in comparisons]) < 0.65
    assert sum(bool(c.moved_points) for c in comparisons) <= 6
    shift = np.zeros((10, 3))
    shift[4, "xyz".index(axes[0])] = 2e-6 * comparisons[0].displacements[4].detectable_um[1]
    moved = compare_coordinates(network(axes, 0), network(axes, 1, shift, turned=turned), has_free_motions=True)
    assert moved.moved_points == ("P4",)
    assert moved.displacements[0].point_chi2 is None


@pytest.mark.parametrize("axes", ["xyz", "xy", "z"])
def test_a_covariance_without_a_datum_is_recognised(axes: str) -> None:
    """A free network's covariance has a rank defect: the epochs are aligned as by `free`, and it is said."""
    shift = np.zeros((10, 3))
    shift[4, "xyz".index(axes[0])] = 0.01
    pair = network(axes, 0), network(axes, 1, shift, turned=len(axes) > 1)
    plain, free = compare_coordinates(*pair), compare_coordinates(*pair, has_free_motions=True)
    assert plain.dof == free.dof
    assert plain.moved_points == free.moved_points == ("P4",)
    np.testing.assert_allclose(plain.displacements[4].sigma_um, free.displacements[4].sigma_um, rtol=1e-6)
    assert len(plain.notes) == 1 and "motions of the whole network undetermined" in plain.notes[0]
    assert not free.notes
    assert not compare_coordinates(crown(0), crown(1)).notes


def test_a_datum_of_several_points_leaves_the_same_motions_undetermined() -> None:
    """Constraints on three of ten points: the covariance has its rank defect elsewhere."""
    whole = network("xyz", 0)
    motions = rigid_motion_jacobian(whole.points)
    hold = np.zeros((30, 30))
    hold[:9, :9] = np.eye(9)
    project = np.eye(30) - motions @ np.linalg.solve(motions.T @ hold @ motions, motions.T @ hold)
    epochs = [replace(network("xyz", i), covariance=project @ network("xyz", i).covariance @ project.T) for i in (0, 1)]
    plain, free = compare_coordinates(*epochs), compare_coordinates(*epochs, has_free_motions=True)
    assert plain.p_value == pytest.approx(free.p_value, rel=1e-6)


@pytest.mark.parametrize("cycle", [(2, 7), (1, 5, 8)])
def test_exchanged_names_are_named_and_no_motion_is(tmp_path: Path, cycle: tuple[int, ...]) -> None:
    first, second = network("xyz", 0), network("xyz", 1)
    names = list(second.names)
    for place, other in zip(cycle, cycle[1:] + cycle[:1], strict=True):
        names[place] = second.names[other]
    mixed = compare_coordinates(first, replace(second, names=tuple(names)), has_free_motions=True)
    assert not mixed.moved_points
    assert f"the names {', '.join(f'P{i}' for i in cycle)} are exchanged" in mixed.notes[0]
    assert mixed.p_value == pytest.approx(compare_coordinates(first, second, has_free_motions=True).p_value, rel=1e-6)


def test_numbers_of_rows_are_no_names(tmp_path: Path) -> None:
    for i, numbers in enumerate(((1, 2, 3), (3, 1, 2))):
        rows = [f"{n},R{k},{1000 * k},{500 * k * k},{i * 0.01},0.02" for k, n in enumerate(numbers)]
        text = "\n".join(["ID,Feature,X [mm],Y [mm],Z [mm],sigma_mm", *rows])
        (tmp_path / f"{i}.csv").write_text(text + "\n")
    comparison = lt.compare(tmp_path / "0.csv", tmp_path / "1.csv")
    assert [d.target for d in comparison.displacements] == ["R0", "R1", "R2"] and not comparison.moved_points


def test_what_adjust_writes_is_what_compare_and_uncertainty_read(tmp_path: Path) -> None:
    recordings = [small_network(seed=seed)[0] for seed in (1, 2)]
    recordings = [r.replace(setup=r.setup.model_copy(update={"gauge": None})) for r in recordings]
    for i, recording in enumerate(recordings):
        lt.write(lt.adjust(recording), tmp_path / f"{i}")
    lists = [read_coordinates(tmp_path / f"{i}" / "targets.csv") for i in (0, 1)]
    assert not any("has no covariance" in note for entry in lists for note in entry.notes)
    read, comparison = lt.compare(*lists, free=True), lt.compare(*recordings, calibrate=False)
    assert read.p_value == pytest.approx(comparison.p_value, abs=1e-4)
    np.testing.assert_allclose(read.displacements[3].sigma_um, comparison.displacements[3].sigma_um, rtol=1e-3)
    names = list(recordings[0].targets[:2])
    task = {"task": [{"name": "length", "kind": "distance", "targets": names}], "calibrate": False}
    wanted = lt.uncertainty(recordings[0], task).results[0]
    listed = lt.uncertainty(tmp_path / "0" / "targets.csv", task).results[0]
    assert listed.value == pytest.approx(wanted.value, abs=1e-5)
    assert listed.standard_uncertainty == pytest.approx(wanted.standard_uncertainty, rel=1e-5)


GAMA = """<?xml version="1.0"?>
<gama-local-adjustment xmlns="http://www.gnu.org/software/gama/gama-local-adjustment">
<description> a levelled loop </description>
<coordinates>
<fixed> <point> <id>A</id> <z>100.0</z> </point> </fixed>
<adjusted>
 <point> <id>B</id> <Z>101.2345</Z> </point>
 <point> <id>C</id> <z>99.5</z> </point>
</adjusted>
<cov-mat>
<dim>3</dim> <band>1</band>
<flt>1.0</flt> <flt>0.25</flt> <flt>2.0</flt> <flt>0.5</flt> <flt>9.0</flt>
</cov-mat>
</coordinates>
</gama-local-adjustment>
"""


def test_results_of_gama_are_read(tmp_path: Path) -> None:
    path = tmp_path / "one.xml"
    path.write_text(GAMA)
    coordinates = read_coordinates(path)
    assert (coordinates.title, coordinates.names, coordinates.axes) == ("a levelled loop", ("B", "C"), "z")
    np.testing.assert_allclose(coordinates.points[:, 2], [101.2345, 99.5])
    np.testing.assert_allclose(coordinates.covariance, [[1e-6, 0.25e-6], [0.25e-6, 2e-6]])
    path.write_text(GAMA.replace("<band>1</band>", "<band>2</band>"))
    with pytest.raises(RecordError, match="do not match dim and band"):
        read_coordinates(path)
    path.write_text(GAMA.replace("<flt>0.25</flt>", "<flt>25</flt>"))
    with pytest.raises(RecordError, match="not positive definite"):
        read_coordinates(path)


def test_incomparable_epochs_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text("target,x_mm,y_mm\nA,1,2\nB,3,4\n")
    with pytest.raises(RecordError, match="the coordinates have no standard deviations"):
        read_coordinates(path)
    path.write_text("target,x_mm,y_mm,sigma_x_mm,sigma_y_mm\nA,1,2,0.1,0.1\nB,3,4,0,0.1\n")
    with pytest.raises(RecordError, match=r"the variance of B\.x is 0"):
        read_coordinates(path)
    path.write_text("target,x_mm,sigma_x_mm\nA,1,0.1\nB,3,0.2\n")
    assert "no covariance between points" in read_coordinates(path).notes[0]
    with pytest.raises(LtsimError, match="no point of the first list"):
        compare_coordinates(crown(0), read_coordinates(path))
    with pytest.raises(LtsimError, match="only with another list of coordinates"):
        lt.compare(path, lt.simulate("paper-workshop", seed=1)[0])
    two = network("xy", 1)
    few = EpochCoordinates("", two.names[:2], "xy", two.points[:2], two.covariance[:4, :4])
    with pytest.raises(LtsimError, match="share 2 points; at least 3"):
        compare_coordinates(few, few, has_free_motions=True)


def test_a_covariance_matrix_is_read_whatever_its_width(tmp_path: Path) -> None:
    """A file of more than 166 points in three axes, which adjust writes, was refused as a table of too many columns."""
    names = [f"P{i}.{axis}" for i in range(200) for axis in "xyz"]
    rows = [",".join([name, *("2" if i == j else "0" for j in range(600))]) for i, name in enumerate(names)]
    points = [f"P{i},{i},{2 * i},{3 * i}" for i in range(200)]
    (tmp_path / "a.csv").write_text("\n".join(("target,x_mm,y_mm,z_mm", *points)) + "\n")
    file = tmp_path / "a.covariance.csv"
    file.write_text("\n".join((",".join(["", *names]), "# of an adjustment", *rows)) + "\n")
    assert np.array_equal(read_coordinates(tmp_path / "a.csv").covariance, 2e-6 * np.eye(600))
    for changed, says in (
        (rows[:-1], "has other rows than columns, or another order"),
        ([*rows, rows[0]], "has other rows than columns, or another order"),
        ([rows[1], rows[0], *rows[2:]], "has other rows than columns, or another order"),
        ([rows[0] + ",1", *rows[1:]], "has rows whose length differs from the header"),
        ([rows[0].replace("2", "x"), *rows[1:]], "row 2: found 'x', expected a number"),
        ([rows[0].replace("2", "1e999"), *rows[1:]], "row 2: found 1e999"),
        ([rows[0].replace("2", "9" * 13), *rows[1:]], "row 2: found 9999999999999, expected a number of at most"),
        ([rows[0].replace("2,0", "2,1"), *rows[1:]], "is not symmetric"),
    ):
        file.write_text("\n".join((",".join(["", *names]), *changed)) + "\n")
        with pytest.raises(RecordError, match=says):
            read_coordinates(tmp_path / "a.csv")


NAMES = ("A", "B", "C", "D", "E", "F")
PLACES = 100.0 * np.array([[0, 0, 0], [50, 0, 1], [50, 40, 9], [0, 40, 3], [25, 9, 17], [7, 25, 26]])
"""Points [mm] of two lists."""


def point_list(
    path: Path, names: Sequence[str], places: Floats, header: str = "target,x_mm,y_mm,z_mm,sigma_mm"
) -> Path:
    """List of points with a standard deviation of 0.02."""
    rows = [",".join([name, *(f"{c:.6f}" for c in row), "0.02"]) for name, row in zip(names, places, strict=True)]
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


@pytest.mark.parametrize("unit_in_mm", [25.4, 1000.0, 304.8, 10.0])
def test_lists_in_different_units_are_refused(tmp_path: Path, unit_in_mm: float) -> None:
    first = point_list(tmp_path / "a.csv", NAMES, PLACES)
    turn = Rotation.from_euler("zyx", [0.4, 0.1, -0.2]).as_matrix()
    second = point_list(tmp_path / "b.csv", NAMES, PLACES @ turn.T / unit_in_mm)
    with pytest.raises(ModelError, match=r"times those of the first, which is the ratio of two units"):
        lt.compare(first, second)


def test_points_that_grew_are_in_the_same_unit(tmp_path: Path) -> None:
    first = point_list(tmp_path / "a.csv", NAMES, PLACES)
    assert lt.compare(first, point_list(tmp_path / "b.csv", NAMES, 1.05 * PLACES)).moved_points


def test_points_of_a_single_list_are_named(tmp_path: Path) -> None:
    first = point_list(tmp_path / "a.csv", NAMES, PLACES)
    second = point_list(tmp_path / "b.csv", [*NAMES[1:], "N"], PLACES[[1, 2, 3, 4, 5, 0]])
    notes = lt.compare(first, second).notes
    assert "points that only one list contains are not compared: A in the first, N in the second" in notes
    with pytest.raises(NetworkError, match=r"no point of the first list \(A, B, C, D, E, F\)"):
        lt.compare(first, point_list(tmp_path / "c.csv", [name.lower() * 2 for name in NAMES], PLACES))


def test_common_axes_of_two_lists_are_compared(tmp_path: Path) -> None:
    first = point_list(tmp_path / "a.csv", NAMES, PLACES)
    moved = PLACES + np.outer(np.arange(6) == 3, [0.5, 0, 9])
    plan = point_list(tmp_path / "b.csv", NAMES, moved[:, :2], "target,x_mm,y_mm,sigma_mm")
    comparison = lt.compare(first, plan)
    assert comparison.moved_points == ("D",)
    assert "the first list has the axes xyz, the second xy: only xy are compared" in comparison.notes
    height = point_list(tmp_path / "c.csv", NAMES, moved[:, 2:], "target,z_mm,sigma_mm")
    with pytest.raises(ModelError, match="no axis is in both"):
        lt.compare(plan, height)


def test_points_that_define_the_frame_are_excluded(tmp_path: Path) -> None:
    rows = [",".join([n, *(f"{c:.4f}" for c in p), str(0.02 * (n != "A"))]) for n, p in zip(NAMES, PLACES, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(["target,x_mm,y_mm,z_mm,sigma_mm", *rows]) + "\n")
    first = read_coordinates(tmp_path / "a.csv")
    assert first.names == NAMES[1:]
    assert "points that define the frame, with the variance 0, are not used: A" in first.notes
    length = {"name": "length", "kind": "distance", "targets": ["A", "B"]}
    result = lt.uncertainty(tmp_path / "a.csv", {"task": [length], "monte_carlo": {"digits": 1}}).to_dataframe()
    assert result["u"][0] == pytest.approx(0.02, rel=1e-6)


@pytest.mark.parametrize("lacking", ["first", "second"])
def test_a_list_without_standard_deviations_counts_as_free_of_errors(tmp_path: Path, lacking: str) -> None:
    """Earlier, it was refused, also beside a list with standard deviations."""
    places = {"A": (0, 0, 0), "B": (9000, 100, 50), "C": (200, 7000, 80), "D": (8000, 6500, 2000), "E": (10, 20, 3000)}
    plain = ["target,x_mm,y_mm,z_mm", *(f"{n},{x},{y},{z}" for n, (x, y, z) in places.items())]
    files = {"first": tmp_path / "a.csv", "second": tmp_path / "b.csv"}
    for name, file in files.items():
        end = ("", "") if name == lacking else (",sigma_mm", ",0.1")
        file.write_text("\n".join([plain[0] + end[0], *(row + end[1] for row in plain[1:])]) + "\n")
    files["second"].write_text(files["second"].read_text().replace("D,8000,6500,2000", "D,8000,6500,2002"))
    result = lt.compare(*files.values())
    assert result.moved_points == ("D",)
    (moved,) = [d for d in result.displacements if d.moved]
    assert moved.displacement_um[2] == pytest.approx(2000.0)
    assert moved.sigma_um[2] == pytest.approx(100.0, rel=1e-6)
    assert any(note.startswith(f"the {lacking} list has no standard deviations") for note in result.notes)
    with pytest.raises(ModelError, match="both lists have no standard deviations"):
        lt.compare(files[lacking], files[lacking])


def test_names_of_points_are_no_row_numbers(tmp_path: Path) -> None:
    """The title of a point number is preferred to that of a row number, whatever the order of the rows."""
    rows = {"101": "1,2,3", "102": "4000,5,6", "103": "7,8000,9", "104": "5,6,7000"}
    for title in ("Punkt-Nr", "Pkt.-Nr.", "PunktID", "Pt No"):
        for file, names in (("a.csv", [*rows]), ("b.csv", [*reversed(rows)])):
            lines = [f"{i},{name},{rows[name]},0.1" for i, name in enumerate(names, start=1)]
            (tmp_path / file).write_text("\n".join([f"Nr.,{title},X [mm],Y [mm],Z [mm],sigma [mm]", *lines]) + "\n")
        result = lt.compare(tmp_path / "a.csv", tmp_path / "b.csv")
        assert not result.moved_points
        assert {d.target for d in result.displacements} == {*rows}


def test_missing_standard_deviations_are_named(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text("target,x_mm,y_mm,sigma_x_mm\nA,1,2,0.1\nB,3,4,0.1\n")
    with pytest.raises(RecordError, match=r"the coordinates along y have no .* or a column sigma_y_mm"):
        read_coordinates(path, requires_sigmas=False)
    path.write_text("target,x_mm,y_mm,sigma_mm\nA,1,2,0.1\nB,3,4,\n")
    with pytest.raises(RecordError, match="the coordinates of B have no standard deviations"):
        read_coordinates(path)
