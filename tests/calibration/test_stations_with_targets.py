"""Files with targets and stations and with their joint covariance, as source of `uncertainty` and `compare`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment.coordinate_uncertainty import joint_covariance, point_names
from ltsim.cli.main import run
from ltsim.recordings.air import NO_AIR_UNCERTAINTY
from ltsim.recordings.coordinates import read_coordinates


@pytest.fixture(scope="module")
def recording() -> lt.Recording:
    """Recording without errors of the instrument and of the air, with the noise of the scenario."""
    simulated = lt.simulate("two-trackers", seed=4).recording
    without_air = simulated.replace(setup=simulated.setup.model_copy(update={"air": NO_AIR_UNCERTAINTY}))
    return ideal(without_air, np.random.default_rng(1))


def ideal(recording: lt.Recording, rng: np.random.Generator) -> lt.Recording:
    """Recording whose readings are those of the adjusted network, with new noise as declared."""
    adjustment = lt.adjust(recording).adjustment
    readings = adjustment.problem.model.predict(adjustment.state)
    return recording.with_readings(readings + rng.normal(size=readings.shape) * adjustment.problem.reading_sigmas)


def length(source: Path, *targets: str) -> tuple[float, float]:
    """Distance and its standard uncertainty [mm] between two points of a list of coordinates."""
    task = {"name": "length", "kind": "distance", "targets": list(targets)}
    row = lt.uncertainty(source, {"task": [task], "monte_carlo": {"digits": 1}}).to_dataframe().iloc[0]
    return float(row["value"]), float(row["u"])


def test_distance_from_a_station_has_the_uncertainty_of_repeated_measurements(
    recording: lt.Recording, tmp_path: Path
) -> None:
    adjusted = lt.adjust(recording)
    lt.write(adjusted, tmp_path, with_stations=True)
    pairs = [("S1", "T05"), ("S3", "T12"), ("S2", "S4")]
    points = dict(zip(point_names(adjusted.adjustment, with_stations=True), range(99), strict=False))
    rng, state = np.random.default_rng(5), adjusted.adjustment.state
    exact = adjusted.adjustment.problem.model.predict(state)
    samples = []
    for _ in range(40):
        noisy = exact + rng.normal(size=exact.shape) * adjusted.adjustment.problem.reading_sigmas
        again = lt.adjust(recording.with_readings(noisy)).adjustment.state
        places = np.concatenate([again.target_points, again.station_positions])
        samples.append([1e3 * np.linalg.norm(places[points[a]] - places[points[b]]) for a, b in pairs])
    for (first, second), spread, mean in zip(pairs, np.std(samples, axis=0), np.mean(samples, axis=0), strict=True):
        value, uncertainty = length(tmp_path / "points.csv", first, second)
        assert value == pytest.approx(mean, abs=uncertainty)
        assert spread == pytest.approx(uncertainty, rel=0.35), (first, second)


def test_joint_covariance_agrees_with_targets_and_poses(recording: lt.Recording, tmp_path: Path) -> None:
    adjusted = lt.adjust(recording)
    lt.write(adjusted, tmp_path, with_stations=True)
    adjustment = adjusted.adjustment
    joint, n = joint_covariance(adjustment, with_stations=True), 3 * len(recording.targets)
    np.testing.assert_allclose(joint[:n, :n], joint_covariance(adjustment), atol=1e-20)
    for i, pose in enumerate(adjustment.pose_covariance):
        block = joint[n + 3 * i : n + 3 * i + 3, n + 3 * i : n + 3 * i + 3]
        np.testing.assert_allclose(block, pose[:3, :3], atol=1e-9 * np.diag(joint).max())
    written = read_coordinates(tmp_path / "points.csv", allows_fixed=True)
    targets = read_coordinates(tmp_path / "targets.csv").covariance
    np.testing.assert_allclose(written.covariance[: len(targets), : len(targets)], targets, atol=1e-18)
    assert written.names[-4:] == recording.stations


@pytest.mark.parametrize("command", ["adjust", "calibrate", "diagnose"])
def test_commands_write_stations_on_request(recording: lt.Recording, tmp_path: Path, command: str) -> None:
    lt.write(recording, tmp_path / "rec")
    extra = ["--no-held-out"] if command == "diagnose" else []
    run([command, str(tmp_path / "rec"), "--with-stations", "--out", str(tmp_path / "out"), "--quiet", *extra])
    points = read_coordinates(tmp_path / "out" / "points.csv", allows_fixed=True)
    targets = read_coordinates(tmp_path / "out" / "targets.csv")
    assert points.names == (*targets.names, *recording.stations)
    np.testing.assert_allclose(points.points[: len(targets.names)], targets.points)
    assert lt.compare(tmp_path / "out" / "points.csv", tmp_path / "out" / "points.csv").moved_points == ()


def test_station_with_the_name_of_a_target_gets_another_name(recording: lt.Recording, tmp_path: Path) -> None:
    names = {name: name for name in recording.targets} | {recording.targets[0]: "S1"}
    renamed = recording.replace(targets=tuple(names[name] for name in recording.targets))
    lt.write(lt.adjust(renamed), tmp_path, with_stations=True)
    assert "S1 (station)" in read_coordinates(tmp_path / "points.csv", allows_fixed=True).names
