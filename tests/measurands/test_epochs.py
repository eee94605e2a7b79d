"""Two epochs: false alarms, points that moved, the datum, what is shared, and the verb."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment import Adjustment, adjust
from ltsim.cli.main import run
from ltsim.core.errors import LtsimError
from ltsim.geometry.rigid import matrix_from_rotation_vector
from ltsim.measurands.comparison import Comparison
from ltsim.measurands.epochs import compare_adjustments
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings import write
from ltsim.recordings.coordinates import is_coordinate_file, read_coordinates
from ltsim.recordings.recording import Recording
from ltsim.recordings.result_file import read_result
from tests.networks import drawn, network

ERRORS = drawn(misalignment_construction(), 7)


def epoch(seed: int, shift: tuple[str, tuple[float, float, float]] | None = None) -> Adjustment:
    return adjust(recorded(seed, shift), misalignment_construction())


def recorded(seed: int, shift: tuple[str, tuple[float, float, float]] | None = None) -> Recording:
    """The test network by one tracker; a target moved by so much [m] before."""
    recording, truth = network(seed=seed, values=ERRORS)
    if shift is None:
        return recording
    clean, _ = network(values=ERRORS)
    adjustment = adjust(clean, misalignment_construction(), start_state=truth.state)
    points = truth.state.target_points.copy()
    points[recording.targets.index(shift[0])] += shift[1]
    moved = type(truth.state)(
        truth.state.station_positions, truth.state.station_rotations, points, truth.state.instrument_parameters
    )
    model = adjustment.problem.model
    return recording.with_readings(recording.readings + model.predict(moved) - model.predict(truth.state))


@pytest.mark.long
def test_no_motion_is_reported_without_a_motion() -> None:
    comparisons = [compare_adjustments(epoch(2 * i + 1), epoch(2 * i + 2), same_instrument=True) for i in range(12)]
    assert sum(bool(c.moved_points) for c in comparisons) <= 2
    assert 0.2 < np.mean([c.p_value for c in comparisons]) < 0.8  # uniform: 0.5 +- 0.08


def test_a_point_that_moved_is_named_and_no_other() -> None:
    first = epoch(1)
    plain = compare_adjustments(first, epoch(2), same_instrument=True)
    size = 1.5e-6 * plain.displacements[5].detectable_um[1]
    direction = np.array([1.0, -2.0, 1.0]) / np.sqrt(6.0)
    shift = (size * direction[0], size * direction[1], size * direction[2])
    comparison = compare_adjustments(first, epoch(2, ("T06", shift)), same_instrument=True)
    assert comparison.moved_points == ("T06",)
    displacement = comparison.displacements[5]
    gap = displacement.displacement_um - 1e6 * np.array(shift)
    assert gap @ np.linalg.solve(displacement.covariance_um2, gap) < 16.3  # 99.9 % of three directions
    assert comparison.p_value_without_moved_points > 0.001
    assert "T06" in comparison.sentence


def test_the_frame_may_be_defined_by_stable_points_or_by_all_points() -> None:
    """The frame of each epoch is the first station's; no point is special."""
    second = epoch(2, ("T06", (0.0, 0.0, 300e-6)))
    free = compare_adjustments(epoch(1), second, same_instrument=True)
    held = compare_adjustments(epoch(1), second, same_instrument=True, stable_names=("T01", "T08", "T12", "T20"))
    assert free.moved_points == held.moved_points == ("T06",)
    assert not any(d.moved for d in held.displacements if d.target in ("T01", "T08"))


def test_what_both_epochs_share_does_not_count() -> None:
    first, second = epoch(1), epoch(2)
    comparison, same = compare_adjustments(first, second), compare_adjustments(first, second, same_instrument=True)
    assert same.statistic > comparison.statistic
    assert all(
        s.detectable_um[1] <= a.detectable_um[1] * (1 + 1e-9)
        for s, a in zip(same.displacements, comparison.displacements, strict=True)
    )


def test_a_scale_is_estimated_where_it_is_asked_for() -> None:
    recording, _ = network(seed=2, values=ERRORS)
    readings = recording.readings.copy()
    readings[:, 0] *= 1 + 20e-6
    gauge = recording.gauge.model_copy(
        update={
            "distance": tuple(
                g.model_copy(update={"length_mm": g.length_mm * (1 + 20e-6)}) for g in recording.gauge.distance
            )
        }
    )
    grown = recording.replace(readings=readings, setup=recording.setup.model_copy(update={"gauge": gauge}))
    comparison = compare_adjustments(epoch(1), adjust(grown, misalignment_construction()), with_scale=True)
    assert comparison.scale_ppm == pytest.approx(20, abs=6)
    assert not comparison.moved_points


def test_too_few_common_points_are_reported() -> None:
    first = epoch(1)
    with pytest.raises(LtsimError, match="common point"):
        compare_adjustments(first, epoch(2), stable_names=("T01", "T02", "T99"))
    with pytest.raises(LtsimError, match="at least 3"):
        compare_adjustments(first, epoch(2), stable_names=("T01", "T02"))


def test_the_verb(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(recorded(1), tmp_path / "one")
    write(recorded(2, ("T06", (0.0, 0.0, 400e-6))), tmp_path / "two")
    arguments = [str(tmp_path / "one"), str(tmp_path / "two"), "--same-instrument"]
    assert run(["compare", *arguments, "--out", str(tmp_path / "out")]) == 1
    assert "T06 by 4" in capsys.readouterr().out
    content = read_result(tmp_path / "out", Comparison)
    assert [d.target for d in content.displacements if d.moved] == ["T06"]
    assert run(["report", str(tmp_path / "out"), "--quiet"]) == 0


def listed(path: Path, points: np.ndarray, names: list[str] | None = None) -> Path:
    names = names or [f"R{i}" for i in range(len(points))]
    rows = [f"{name},{x:.4f},{y:.4f},{z:.4f},0.02" for name, (x, y, z) in zip(names, points.tolist(), strict=True)]
    path.write_text("\n".join(["target,x_mm,y_mm,z_mm,sigma_mm", *rows]) + "\n")
    return path


POINTS = np.random.default_rng(4).uniform(-4000.0, 4000.0, (7, 3))


def test_lists_in_different_frames_are_recognised(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    turn = matrix_from_rotation_vector(np.array([0.001, -0.002, 0.008]))
    moved = POINTS.copy()
    moved[3, 0] += 0.4
    first = listed(tmp_path / "first.csv", POINTS)
    second = listed(tmp_path / "second.csv", moved @ turn.T + [100.0, 50.0, -20.0])
    comparison = lt.compare(first, second)
    assert comparison.has_common_rigid_motion and len(comparison.moved_points) == 7
    assert "after alignment of the lists by free=True, 1 of 7 points moved: R3" in comparison.notes[-1]
    run(["compare", str(first), str(second)])
    printed = capsys.readouterr().out
    assert "compare them with --free" in printed and "re-measure" not in printed
    assert not lt.compare(first, second, free=True).has_common_rigid_motion
    scattered = POINTS + np.random.default_rng(5).normal(0.0, 1.0, POINTS.shape)
    assert not lt.compare(first, listed(tmp_path / "third.csv", scattered)).has_common_rigid_motion


def test_names_may_differ_in_case_blanks_and_zeros(tmp_path: Path) -> None:
    first = listed(tmp_path / "first.csv", POINTS)
    second = listed(tmp_path / "second.csv", POINTS, ["r0", "R 1", "R02", "R3", "r4", "R_5", "other"])
    comparison = lt.compare(first, second)
    assert [d.target for d in comparison.displacements] == ["R0", "R1", "R2", "R3", "R4", "R5"]
    assert any("the same point: 'r0' and 'R0'" in note for note in comparison.notes)


def test_folders_of_results_are_lists_with_their_covariance(tmp_path: Path) -> None:
    recording = recorded(1)
    lt.write(lt.adjust(recording), tmp_path / "adjusted")
    lt.write(lt.calibrate(recording), tmp_path / "calibrated")
    read = read_coordinates(tmp_path / "adjusted")
    assert read.title == "adjusted" and len(read.covariance) == 3 * len(recording.targets)
    assert not is_coordinate_file(tmp_path)
    assert lt.compare(tmp_path / "adjusted", tmp_path / "adjusted").moved_points == ()
    assert len(lt.compare(tmp_path / "adjusted", tmp_path / "calibrated").displacements) == len(recording.targets)
