"""Fitted features against published values, exact geometry and conditions that every minimum meets."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError
from ltsim.core.randomness import random_stream
from ltsim.measurands.features import MIN_POINTS_BY_FEATURE, fit_feature

KINDS = tuple(MIN_POINTS_BY_FEATURE)


def surface(kind: str, count: int, *key: int) -> tuple[Floats, Floats]:
    """Points (count, 3) on an element of radius 0.7 m in general position, and its direction."""
    rng = random_stream(11, kind, *key)
    angle, height = rng.uniform(0, 2 * np.pi, count), rng.uniform(-0.5, 0.5, count)
    ball = rng.standard_normal((count, 3))
    ball /= np.linalg.norm(ball, axis=1)[:, None]
    ring = np.stack([0.7 * np.cos(angle), 0.7 * np.sin(angle)], axis=1)
    points = {
        "line": np.stack([0 * height, 0 * height, height], axis=1),
        "plane": np.stack([height, rng.uniform(-0.3, 0.3, count), 0 * height], axis=1),
        "circle": np.column_stack([ring, 0 * height]),
        "sphere": 0.7 * ball,
        "cylinder": np.column_stack([ring, height]),
    }[kind]
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    return points @ turn.T + [3.0, -2.0, 1.0], turn[:, 2]


def test_published_circle() -> None:
    """Gander, Golub and Strebel, BIT 34 (1994) 558: the geometric fit of their six points."""
    plane = np.array([[1, 7], [2, 6], [5, 8], [7, 7], [9, 5], [3, 7]], dtype=np.float64)
    feature_fit = fit_feature("circle", np.column_stack([plane, np.zeros(6)]))
    assert np.round(feature_fit.reference_point, 4).tolist() == [4.7398, 2.9835, 0.0]
    assert round(float(feature_fit.radius), 4) == 4.7142


@pytest.mark.parametrize("kind", KINDS)
def test_exact_points_are_fitted_exactly(kind: str) -> None:
    points, direction = surface(kind, 12)
    feature_fit = fit_feature(kind, points)
    assert np.abs(feature_fit.deviations).max() < 1e-11
    if kind != "sphere":
        assert abs(abs(feature_fit.direction @ direction) - 1.0) < 1e-12
    if kind in ("circle", "sphere", "cylinder"):
        assert feature_fit.radius == pytest.approx(0.7, abs=1e-11)


@pytest.mark.parametrize("kind", KINDS)
def test_no_neighbouring_element_fits_better(kind: str) -> None:
    points = surface(kind, 15)[0] + 1e-4 * random_stream(5, kind).standard_normal((15, 3))
    feature_fit = fit_feature(kind, points)
    best = distances(kind, points, feature_fit.reference_point, feature_fit.direction, feature_fit.radius)
    rng = random_stream(6, kind)
    for _ in range(60):
        size = 10.0 ** rng.uniform(-6, -3)
        centre, normal = (
            feature_fit.reference_point + size * rng.standard_normal(3),
            feature_fit.direction + size * rng.standard_normal(3),
        )
        radius = feature_fit.radius + size * rng.standard_normal()
        assert distances(kind, points, centre, normal / np.linalg.norm(normal), radius) >= best


def distances(kind: str, points: Floats, centre: Floats, normal: Floats, radius: Floats) -> float:
    """Sum of squared orthogonal distances, straight from the definition."""
    arm = points - centre
    if kind == "sphere":
        return float(np.sum((np.linalg.norm(arm, axis=1) - radius) ** 2))
    along = arm @ normal
    across = np.linalg.norm(arm - np.outer(along, normal), axis=1)
    if kind == "plane":
        return float(np.sum(along**2))
    if kind == "line":
        return float(np.sum(across**2))
    return float(np.sum((across - radius) ** 2 + (along**2 if kind == "circle" else 0.0)))


@pytest.mark.parametrize("kind", KINDS)
def test_many_sets_at_once_are_the_single_fits(kind: str) -> None:
    points, _ = surface(kind, 9)
    many = points + 1e-5 * random_stream(7, kind).standard_normal((5, *points.shape))
    together = fit_feature(kind, many, start_feature=fit_feature(kind, points))
    for i in range(5):
        alone = fit_feature(kind, many[i])
        assert np.allclose(np.abs(together.deviations[i]), np.abs(alone.deviations), atol=1e-11)
        assert np.allclose(together.reference_point[i], alone.reference_point, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_points_that_determine_nothing_are_refused(kind: str) -> None:
    with pytest.raises(ModelError, match="needs at least"):
        fit_feature(
            kind, np.zeros((MIN_POINTS_BY_FEATURE[kind] - 1, 3)) + np.arange(MIN_POINTS_BY_FEATURE[kind] - 1)[:, None]
        )
    with pytest.raises(ModelError, match="coincide"):
        fit_feature(kind, np.ones((6, 3)))
    if kind != "line":
        on_a_line = np.outer(np.linspace(-1, 1, 8), [1.0, 2.0, 3.0])
        with pytest.raises(ModelError):
            fit_feature(kind, on_a_line)
