"""Closed-form rigid alignment of two point sets."""

from functools import lru_cache
from itertools import combinations

import numpy as np

from ltsim.core.arrays import Bools, Floats, median
from ltsim.core.errors import NetworkError

MAX_ROBUST_PASSES = 8
"""Largest number of reweightings of a robust alignment."""
MAX_NOISE_DISTANCE_RATIO = 8.0
"""Ratio of the largest to the median distance between aligned points below which reweighting ends: all distances are
then noise."""
MAX_SOUND_MISFIT_M = 1e-4
"""Mean distance [m] between points and their goals after a least-squares alignment. Above it the alignment also starts
from triples of points, because an outlier may have distorted the least-squares alignment. Start values need no more
than 0.1 mm."""
MAX_POINTS_FOR_ALL_TRIPLES = 6
"""Number of points up to which every triple of points is a start of a robust alignment."""
MAX_TRIPLES = 30
"""Number of random triples that are tried if there are more points. Of 30 triples at least one has no outlier with 98 %
probability if half of the points are outliers, and with 99.999 % if a third are."""


def align_rigidly(points: Floats, goal_points: Floats, weights: Floats | None = None) -> tuple[Floats, Floats]:
    """Rotation (3, 3) and translation (3,) [m] that move `points` (n, 3) onto `goal_points` (n, 3) by least squares.

    The fit is ``goal_points ~ points @ rotation.T + translation``. Parameters and errors are those of
    `align_with_scale`.
    """
    return align_with_scale(points, goal_points, weights)[:2]


def align_with_scale(
    points: Floats, goal_points: Floats, weights: Floats | None = None, *, with_scale: bool = False
) -> tuple[Floats, Floats, Floats]:
    """Rotation (..., 3, 3), shift (..., 3) and scale (...) that move points onto their goals by least squares.

    The fit is ``goal_points ~ scale * points @ rotation.T + shift``. The leading dimensions `...` are independent
    point sets.

    Parameters
    ----------
    points : (..., n, 3) float, [m]
        Points to move, at least three that are not on one line.
    goal_points : (..., n, 3) float, [m]
        The corresponding points.
    weights : (n,) float, optional
        Non-negative weights.
    with_scale : bool
        Estimation of the scale; without it the scale is 1.

    Raises
    ------
    NetworkError
        When fewer than three points are given or they lie on one line.

    References
    ----------
    Kabsch, Acta Cryst. A32 (1976) 922; Umeyama, IEEE Trans. PAMI 13 (1991) 376. Proper rotation enforced by the sign of
    the determinant.
    """
    weight = np.ones(points.shape[-2]) if weights is None else weights
    if np.count_nonzero(weight) < 3:
        raise NetworkError("an alignment needs at least three common points")
    rotation, shift, scale, is_determined = _weighted_alignment(points, goal_points, weight, with_scale=with_scale)
    if not is_determined.all():
        raise NetworkError("an alignment needs three common points that are not on one line")
    return rotation, shift, scale


def _weighted_alignment(
    points: Floats, goal_points: Floats, weight: Floats, *, with_scale: bool = False
) -> tuple[Floats, Floats, Floats, Bools]:
    """Rotation, shift and scale of `align_with_scale`, and flags (...) that the points determine the rotation."""
    weight = weight / weight.sum()
    centre, goal_centre = weight @ points, weight @ goal_points
    centred_points = points - centre[..., None, :]
    moment = np.swapaxes(weight[:, None] * (goal_points - goal_centre[..., None, :]), -1, -2) @ centred_points
    u, spread, vt = np.linalg.svd(moment)
    reflection_signs = np.ones_like(spread)
    reflection_signs[..., 2] = np.sign(np.linalg.det(u @ vt))
    rotation = (u * reflection_signs[..., None, :]) @ vt
    scale = np.ones(moment.shape[:-2])
    if with_scale:
        scale = np.sum(spread * reflection_signs, axis=-1) / np.sum(weight[:, None] * centred_points**2, axis=(-2, -1))
    shift = goal_centre - scale[..., None] * np.einsum("...ij,...j->...i", rotation, centre)
    return rotation, shift, scale, np.asarray(spread[..., 1] > 1e-9 * spread[..., 0])


def align_robustly(points: Floats, goal_points: Floats) -> tuple[Floats, Floats]:
    """Rotation (3, 3) and translation (3,) [m] that move points (n, 3) onto their goals, insensitive to a few outliers.

    The alignment minimises the sum of the distances by iterative reweighting. If one distance is large, this sum has
    several local minima. Reweighting therefore starts at the least-squares alignment or at the alignment of three of
    the points: at the one with the smallest sum of the logarithms of all distances.

    Raises NetworkError under the conditions of `align_with_scale`.
    """
    best = align_rigidly(points, goal_points)
    if len(points) < 4:
        return best
    residual_distances = _residual_distances(points, goal_points, best)
    if residual_distances.mean() > MAX_SOUND_MISFIT_M:
        triples = _point_triples(len(points))
        rotation, shift, _, is_determined = _weighted_alignment(points[triples], goal_points[triples], np.ones(3))
        log_distance_sums = _sum_of_log_distances(_residual_distances(points, goal_points, (rotation, shift)))
        log_distance_sums[~is_determined] = np.inf
        k = int(np.argmin(log_distance_sums))
        best = (rotation[k], shift[k]) if log_distance_sums[k] < _sum_of_log_distances(residual_distances) else best
    for _ in range(MAX_ROBUST_PASSES):
        residual_distances = _residual_distances(points, goal_points, best)
        floor = max(1e-5, 0.5 * median(residual_distances))
        best = align_rigidly(points, goal_points, 1.0 / np.maximum(residual_distances, floor))
        if residual_distances.max() < MAX_NOISE_DISTANCE_RATIO * floor:
            break
    return best


def largest_residual(points: Floats, goal_points: Floats) -> float:
    """Largest distance [m] between points of two sets (n, 3) after their least-squares alignment.

    Raises NetworkError under the conditions of `align_with_scale`.
    """
    return float(_residual_distances(points, goal_points, align_rigidly(points, goal_points)).max())


def _residual_distances(points: Floats, goal_points: Floats, rigid_motion: tuple[Floats, Floats]) -> Floats:
    """Distances (..., n) [m] between points (..., n, 3) after a rigid motion and their goals (..., n, 3).

    `rigid_motion` is a pair: rotations (..., 3, 3) and shifts (..., 3) [m].
    """
    rotation, shift = rigid_motion
    moved = points @ np.swapaxes(rotation, -1, -2) + shift[..., None, :]
    return np.asarray(np.linalg.norm(moved - goal_points, axis=-1))


def _sum_of_log_distances(distances: Floats) -> Floats:
    """Sum (...) of the logarithms of distances (..., n) [m]; distances below `MAX_SOUND_MISFIT_M` count as this value.

    An alignment with a few large and many small distances has a smaller sum than one with all distances of medium size.
    """
    return np.asarray(np.log(np.maximum(distances, MAX_SOUND_MISFIT_M)).sum(axis=-1))


@lru_cache(maxsize=256)
def _point_triples(n_points: int) -> list[list[int]]:
    """Triples of point indices: all triples of at most `MAX_POINTS_FOR_ALL_TRIPLES` points, otherwise a random sample.

    The sample depends on the number of points only, so that results are reproducible.
    """
    every = list(combinations(range(n_points), 3)) if n_points <= MAX_POINTS_FOR_ALL_TRIPLES else []
    if every:
        return [list(triple) for triple in every]
    draw = np.random.default_rng(n_points)
    return [draw.choice(n_points, 3, replace=False).tolist() for _ in range(MAX_TRIPLES)]
