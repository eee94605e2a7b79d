from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from ltsim.core.errors import NetworkError
from ltsim.core.randomness import random_stream
from ltsim.geometry.rigid import align_rigidly, align_robustly, align_sets_robustly, matrix_from_rotation_vector

seeds = st.integers(0, 10_000)


@given(seeds, st.integers(3, 12))
def test_a_rigid_motion_is_recovered(seed: int, count: int) -> None:
    rng = random_stream(seed, "alignment")
    source = rng.uniform(-5, 5, (count, 3))
    turn, shift = matrix_from_rotation_vector(rng.uniform(-3, 3, 3)), rng.uniform(-9, 9, 3)
    rotation, translation = align_rigidly(source, source @ turn.T + shift)
    np.testing.assert_allclose(rotation, turn, atol=1e-11)
    np.testing.assert_allclose(translation, shift, atol=1e-10)


@given(seeds)
def test_no_other_move_fits_better(seed: int) -> None:
    rng = random_stream(seed, "optimum")
    source, goal = rng.uniform(-5, 5, (2, 6, 3))
    weights = rng.uniform(0.1, 2, 6)
    rotation, translation = align_rigidly(source, goal, weights)

    def misfit(turn: np.ndarray, shift: np.ndarray) -> float:
        return float(weights @ np.sum((goal - source @ turn.T - shift) ** 2, axis=1))

    best = misfit(rotation, translation)
    for _ in range(5):
        nudged = matrix_from_rotation_vector(rng.normal(0, 1e-3, 3)) @ rotation
        assert misfit(nudged, translation + rng.normal(0, 1e-3, 3)) >= best


@given(seeds)
def test_a_mirror_image_is_never_answered_with_a_reflection(seed: int) -> None:
    source = random_stream(seed, "mirror").uniform(-5, 5, (6, 3))
    rotation, _ = align_rigidly(source, source * [1, 1, -1])
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0, atol=1e-12)


def test_a_point_without_weight_has_no_say() -> None:
    source = random_stream(0, "weights").uniform(-5, 5, (5, 3))
    goal = source + [1.0, 2.0, 3.0]
    goal[0] += 50
    rotation, translation = align_rigidly(source, goal, np.array([0.0, 1, 1, 1, 1]))
    np.testing.assert_allclose(rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(translation, [1, 2, 3], atol=1e-12)


def test_two_points_are_too_few() -> None:
    with pytest.raises(NetworkError, match="at least three"):
        align_rigidly(np.eye(3)[:2], np.eye(3)[:2])


def test_points_on_a_line_leave_a_rotation_undetermined() -> None:
    line = np.outer([1.0, 2.0, 3.0, 5.0], [1.0, 1.0, 0.5])
    with pytest.raises(NetworkError, match="not on one line"):
        align_rigidly(line, line)


def test_sets_aligned_together_equal_sets_aligned_singly_with_an_outlier_and_a_line() -> None:
    """Sets of points aligned at once: motions of single alignments, and a flag for the set on one line."""
    draw = np.random.default_rng(5)
    points = draw.normal(0.0, 3.0, (3, 7, 3))
    goal_points = points + [1.0, 2.0, 3.0] + draw.normal(0.0, 2e-5, points.shape)
    goal_points[1, 2] += 0.4
    points[2] = goal_points[2] = np.arange(7.0)[:, None] * [1.0, 2.0, 0.5]
    rotation, shift, is_determined = align_sets_robustly(points, goal_points)
    assert is_determined.tolist() == [True, True, False]
    for k in range(2):
        alone = align_robustly(points[k], goal_points[k])
        np.testing.assert_allclose(rotation[k], alone[0], atol=1e-13)
        np.testing.assert_allclose(shift[k], alone[1], atol=1e-12)
    np.testing.assert_allclose(shift[:2], [[1.0, 2.0, 3.0]] * 2, atol=2e-4)
