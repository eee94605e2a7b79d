"""Displacements of points by one decomposition: the same as by a least-squares fit for each point."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import scipy.linalg

from ltsim.core.arrays import Floats
from ltsim.core.randomness import random_stream
from ltsim.measurands.displacement_fit import WhitenedDifferences

LIMIT = 16.0


def differences(
    seed: int, n_points: int, n_axes: int, n_motions: int, moved: Sequence[int] = ()
) -> WhitenedDifferences:
    rng = random_stream(seed, "differences")
    size = n_points * n_axes
    root = rng.normal(size=(size, size)) + 3 * np.eye(size)
    values = np.linalg.solve(root, rng.normal(size=size))
    values.reshape(n_points, n_axes)[list(moved)] += 20.0
    return WhitenedDifferences(root, values, rng.normal(size=(size, n_motions)), n_axes)


def fitted(data: WhitenedDifferences, points: Sequence[int]) -> tuple[Floats, Floats, float]:
    """Estimates of smallest norm in units of their standard deviations, covariance, and sum of squares."""
    displacement_columns = np.eye(len(data.differences))[:, data.point_coordinate_indices(points)]
    design = data.whitening_root @ np.hstack([data.free_motions, displacement_columns])
    norms = np.linalg.norm(design, axis=0)
    inverse = np.linalg.pinv(design / norms) / norms[:, None]
    observed = data.whitening_root @ data.differences
    basis = scipy.linalg.orth(design / norms)
    return inverse @ observed, inverse @ inverse.T, float(observed @ observed - np.sum((basis.T @ observed) ** 2))


@pytest.mark.parametrize(("n_axes", "n_motions"), [(3, 0), (3, 6), (2, 3), (1, 1)])
@pytest.mark.parametrize("moved", [(), (2,), (7, 0, 4), (1, 2, 3, 4, 5, 6, 7)])
def test_displacement_of_each_point(moved: tuple[int, ...], n_axes: int, n_motions: int) -> None:
    """With seven of nine points moved and six motions, the displacement of the others is undetermined."""
    data = differences(5, 9, n_axes, n_motions, moved)
    fit = data.fit(moved)
    assert fit.sum_of_squares == pytest.approx(fitted(data, moved)[2], rel=1e-9, abs=1e-9)
    for point in range(9):
        others = [p for p in moved if p != point]
        values, covariance, squares = fitted(data, [*others, point])
        displacement = fit.displacement(point)
        assert displacement[0] == pytest.approx(values[-n_axes:], rel=1e-7)
        assert displacement[1] == pytest.approx(covariance[-n_axes:, -n_axes:], rel=1e-7)
        if len(values) <= len(data.differences):
            assert displacement[2] == pytest.approx(fitted(data, others)[2] - squares, rel=1e-7, abs=1e-9)


@pytest.mark.parametrize("n_motions", [0, 6])
@pytest.mark.parametrize("moved", [(), (3,), (8, 1, 5), tuple(range(9))])
def test_points_are_added_and_removed_as_by_a_fit_for_each(moved: tuple[int, ...], n_motions: int) -> None:
    data = differences(11, 12, 3, n_motions, moved)
    added: list[int] = []
    while len(added) < 9:
        drops = {p: fitted(data, added)[2] - fitted(data, [*added, p])[2] for p in range(12) if p not in added}
        best = max(drops, key=lambda p: drops[p])
        if drops[best] < LIMIT:
            break
        added.append(best)
    for point in list(added):
        others = [p for p in added if p != point]
        if fitted(data, others)[2] - fitted(data, added)[2] < LIMIT:
            added = others
    assert data.find_moved_points(range(12), LIMIT, 9) == added
