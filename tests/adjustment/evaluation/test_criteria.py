"""Criteria and verification against figures by hand and against the paper's definitions, term by term."""

from __future__ import annotations

import tracemalloc
from itertools import combinations

import numpy as np
import pytest

from ltsim.adjustment.evaluation import evaluate_criteria, read_nominal, verify_against_nominal
from ltsim.adjustment.evaluation.criteria import (
    coordinate_disagreement,
    distance_disagreement,
    distance_disagreement_with_first_station,
)
from ltsim.core.errors import NetworkError, RecordError
from ltsim.geometry.rigid import matrix_from_rotation_vector
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Setup
from tests.networks import share_removed

TARGETS = np.array([[4.0, 0, 1], [3, 2, -1], [1, 4, 2], [-2, 3, 0], [2, -3, 1.5], [5, 1, -2]])
POSES = [(np.zeros(3), np.zeros(3)), (np.array([1.0, 0.5, 0.2]), np.array([0.01, 0, 1.1]))]
POSES.append((np.array([-1.0, 0.3, 0.1]), np.array([0, 0.02, -0.7])))


def network(values: np.ndarray, noise: float = 0.0, *, faces: tuple[int, ...] = (1, 2)) -> Recording:
    """Three stations, six targets, each in the given faces, by a misaligned tracker."""
    rng = np.random.default_rng(3)
    rows = [(s, t, f) for s in range(3) for t in range(6) for f in faces]
    station, target, face = np.array(rows).T
    local = np.array([matrix_from_rotation_vector(POSES[s][1]).T @ (TARGETS[t] - POSES[s][0]) for s, t, _ in rows])
    readings = misalignment_construction().readings_from_points(local, face, values)
    readings += noise * rng.standard_normal(readings.shape)
    ones = np.ones(len(rows), dtype=np.int64)
    return Recording(
        setup=Setup(),
        stations=("S1", "S2", "S3"),
        targets=tuple(f"T{t}" for t in range(6)),
        station=station,
        target=target,
        face=face,
        repeat=ones,
        time=np.arange(len(rows), dtype=np.float64),
        readings=readings,
    )


def parameters(**values: float) -> np.ndarray:
    construction = misalignment_construction()
    vector = np.zeros(construction.n_parameters)
    for name, value in values.items():
        vector[construction.parameter_index(name.replace("_", "-"))] = value
    return vector


def test_distance_criterion_by_hand() -> None:
    base = np.array([[0.0, 0, 0], [1, 0, 0]])
    clouds = np.stack([base, base * 1.001, base * 1.002, base * np.nan])
    disagreement = distance_disagreement(clouds)
    # Lengths 1.000, 1.001, 1.002: deviations from their mean 1.001 are 1, 0, 1 mm.
    assert disagreement.mean == pytest.approx(2e-3 / 3)
    assert disagreement.maximum == pytest.approx(2e-3 / 3)
    assert distance_disagreement_with_first_station(clouds).mean == pytest.approx(1.5e-3)


def test_criteria_term_by_term() -> None:
    rng = np.random.default_rng(1)
    clouds = TARGETS + 1e-4 * rng.standard_normal((3, 6, 3))
    slow = []
    for i, j in combinations(range(6), 2):
        lengths = [np.linalg.norm(cloud[i] - cloud[j]) for cloud in clouds]
        slow.append(np.mean([abs(d - np.mean(lengths)) for d in lengths]))
    assert np.allclose(distance_disagreement(clouds).disagreements, slow)
    pairs = list(combinations(range(3), 2))
    gaps = [[np.linalg.norm(clouds[m, i] - clouds[n, i]) for m, n in pairs] for i in range(6)]
    assert np.allclose(coordinate_disagreement(clouds).disagreements, np.mean(gaps, axis=1))


def test_a_perfect_tracker_has_no_differences_and_poses_do_not_matter() -> None:
    criteria = evaluate_criteria(network(np.zeros(16)))
    assert criteria.distance.before.max_um < 1e-6
    assert criteria.coordinate.before.max_um < 1e-7
    assert criteria.distance.after is None
    assert criteria.distance.improvement_percent is None


def test_true_parameters_remove_everything_and_json_says_so() -> None:
    values = parameters(vertical_index=40e-6, transit_offset=60e-6, azimuth_second_order_cos=20e-6)
    criteria = evaluate_criteria(network(values, faces=(1,)), misalignment_construction(), values)
    assert criteria.distance.before.mean_um > 5
    assert criteria.coordinate.before.mean_um > 5
    assert criteria.distance.improvement_percent == pytest.approx(100.0, abs=1e-4)
    entry = criteria.model_dump(exclude_unset=True)
    assert set(entry) == {"distance", "coordinate", "distance_to_first"}
    assert entry["distance"]["before"]["mean_um"] == criteria.distance.before.mean_um


def mean_of(recording: Recording) -> float:
    mean = evaluate_criteria(recording).coordinate.before.mean_um
    assert mean is not None
    return mean


def test_faces_are_averaged() -> None:
    values = parameters(vertical_index=40e-6, beam_tilt=30e-6)  # both flip with the face
    both, front_face = network(values), network(values, faces=(1,))
    assert mean_of(both) < 1e-3 * mean_of(front_face)


def test_a_single_station_is_refused_in_a_sentence() -> None:
    recording = network(np.zeros(16))
    with pytest.raises(NetworkError, match="has only one"):
        evaluate_criteria(recording.select(recording.station == 0))


def test_verification_against_nominal_points_in_another_frame() -> None:
    values = parameters(range_scale=50e-6, vertical_index=40e-6)
    turned = TARGETS @ matrix_from_rotation_vector(np.array([0.3, -0.2, 2.0])).T + [10.0, 20, 30]
    nominal = {f"T{t}": turned[t] for t in range(6)} | {"unused": np.zeros(3)}
    criteria = verify_against_nominal(network(values, faces=(1,)), nominal, misalignment_construction(), values)
    # A scale of 50 ppm is an error of every distance, which only nominal lengths can show.
    assert criteria.distance.before.max_um > 100
    assert criteria.distance.after is not None
    assert criteria.coordinate.after is not None
    assert criteria.distance.after.max_um < 1e-6
    assert criteria.coordinate.after.max_um < 1e-6
    with pytest.raises(NetworkError, match="at least three"):
        verify_against_nominal(network(values), {"T1": np.zeros(3)})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("target,x_mm,y_mm\nT1,1,2\n", "row 2: a coordinate is missing"),
        ("target,x_mm,y_mm,z_mm\nT1,1,2,abc\n", "row 2, column z_mm: found 'abc', expected a number"),
        ("target,x_mm,y_mm,z_mm\nT1,1,2,\n", "row 2: a coordinate is missing"),
        ("target,x_mm,y_mm,z_mm\nT1,1,2,3\nT1,1,2,4\n", "row 3: the point T1"),
        ("target,x_mm,y_mm,z_mm\n", "contains no points"),
        (None, "there is no such file"),
    ],
)
def test_nominal_files_that_are_wrong(tmp_path, text: str | None, message: str) -> None:
    path = tmp_path / "nominal.csv"
    if text is not None:
        path.write_text(text)
    with pytest.raises(RecordError, match=message):
        read_nominal(path)


def test_share_of_the_correctable_error() -> None:
    values = parameters(transit_offset=60e-6, vertical_index=40e-6)
    recording, construction = network(values, noise=1e-6, faces=(1,)), misalignment_construction()
    none = share_removed(recording, TARGETS, construction, calibrated=0 * values, true_parameters=values)
    full = share_removed(recording, TARGETS, construction, calibrated=values, true_parameters=values)
    assert none.removed_error_fraction == pytest.approx(0.0, abs=1e-6)
    assert full.removed_error_fraction == pytest.approx(1.0)
    half = share_removed(recording, TARGETS, construction, calibrated=values / 2, true_parameters=values)
    assert (
        0.7 < half.removed_error_fraction < 0.8
    )  # three quarters of the mean square; a8a5717 said a half, of its root
    assert half.raw_rms > half.calibrated_rms > half.true_parameters_rms > 0


def test_memory_is_proportional_to_pointings_and_not_to_all_pairs() -> None:
    """A tunnel of 100 set-ups: all pairs from all of them would be 2.5 GB."""
    count, rng = 100, np.random.default_rng(3)
    base = rng.normal(0, 4, (25 * (count + 1), 3))
    clouds = np.full((count, len(base), 3), np.nan)
    for s in range(count):
        clouds[s, 25 * s : 25 * s + 50] = base[25 * s : 25 * s + 50] + rng.normal(0, 1e-5, (50, 3))
    tracemalloc.start()
    pairs, places = distance_disagreement(clouds), coordinate_disagreement(clouds)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(pairs.disagreements) == 99 * 25 * 24 / 2
    assert len(places.disagreements) == 99 * 25
    assert most < 60e6
