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
"""Mean distance [m] after a least-squares alignment up to which no point is an outlier that matters
for start values.
"""
MAX_POINTS_FOR_ALL_TRIPLES = 6
"""Number of points up to which every triple of them is evaluated."""
MAX_TRIPLES = 30
"""Number of triples for more points. Of 30 triples at least one has no outlier with 98 % probability if half of the
points are outliers, and with 99.999 % if a third are."""


def align_rigidly(points: Floats, goal_points: Floats, weights: Floats | None = None) -> tuple[Floats, Floats]:
    """Rotation (3, 3) and translation (3,) of the least-squares alignment ``goal ~ source @ rotation.T + translation``.

    See `align_with_scale`.
    """
    return align_with_scale(points, goal_points, weights)[:2]


def align_with_scale(
    points: Floats, goal_points: Floats, weights: Floats | None = None, *, with_scale: bool = False
) -> tuple[Floats, Floats, Floats]:
    """Rotation (..., 3, 3), shift (..., 3) and scale (...) of the least-squares alignment of points.

    The fit is ``goal ~ scale * source @ rotation.T + shift``.

    Parameters
    ----------
    points : (..., n, 3) float, [m]
        n >= 3, not on one line.
    goal_points : (..., n, 3) float, [m]
        The corresponding points.
    weights : (n,) float, optional
        Non-negative weights.
    with_scale : bool
        Estimate the scale too; 1 otherwise.

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
    rotation, shift, scale, is_held = _weighted_alignment(points, goal_points, weight, with_scale=with_scale)
    if not is_held.all():
        raise NetworkError("an alignment needs three common points that are not on one line")
    return rotation, shift, scale


def _weighted_alignment(
    points: Floats, goal_points: Floats, weight: Floats, *, with_scale: bool = False
) -> tuple[Floats, Floats, Floats, Bools]:
    """Rotation, shift and scale as of `align_with_scale`, and flags (...) of determined rotations."""
    weight = weight / weight.sum()
    centre, middle = weight @ points, weight @ goal_points
    arms = points - centre[..., None, :]
    moment = np.swapaxes(weight[:, None] * (goal_points - middle[..., None, :]), -1, -2) @ arms
    u, spread, vt = np.linalg.svd(moment)
    flip = np.ones_like(spread)
    flip[..., 2] = np.sign(np.linalg.det(u @ vt))
    rotation = (u * flip[..., None, :]) @ vt
    scale = np.ones(moment.shape[:-2])
    if with_scale:
        scale = np.sum(spread * flip, axis=-1) / np.sum(weight[:, None] * arms**2, axis=(-2, -1))
    shift = middle - scale[..., None] * np.einsum("...ij,...j->...i", rotation, centre)
    return rotation, shift, scale, np.asarray(spread[..., 1] > 1e-9 * spread[..., 0])


def align_robustly(points: Floats, goal_points: Floats) -> tuple[Floats, Floats]:
    """Rigid alignment (3, 3), (3,) by least absolute deviations, so that a few outlying points do not affect it.

    The sum of the distances has several minima where one of them is large, and for four points its least value may
    belong to an alignment that fits none. Reweighting therefore begins at the least-squares alignment or at the
    alignment of three points, whichever has the smallest sum of logarithms.

    Raises NetworkError under the conditions of `align_with_scale`.
    """
    best = align_rigidly(points, goal_points)
    if len(points) < 4:
        return best
    miss = _residual_distances(points, goal_points, best)
    if miss.mean() > MAX_SOUND_MISFIT_M:
        triples = _point_triples(len(points))
        rotation, shift, _, is_held = _weighted_alignment(points[triples], goal_points[triples], np.ones(3))
        sizes = _sum_of_log_distances(_residual_distances(points, goal_points, (rotation, shift)))
        sizes[~is_held] = np.inf
        k = int(np.argmin(sizes))
        best = (rotation[k], shift[k]) if sizes[k] < _sum_of_log_distances(miss) else best
    for _ in range(MAX_ROBUST_PASSES):
        miss = _residual_distances(points, goal_points, best)
        floor = max(1e-5, 0.5 * median(miss))
        best = align_rigidly(points, goal_points, 1.0 / np.maximum(miss, floor))
        if miss.max() < MAX_NOISE_DISTANCE_RATIO * floor:
            break
    return best


def largest_residual(points: Floats, goal_points: Floats) -> float:
    """Largest distance [m] between points of two sets (n, 3) after their least-squares alignment.

    Raises NetworkError as `align_with_scale`.
    """
    return float(_residual_distances(points, goal_points, align_rigidly(points, goal_points)).max())


def _residual_distances(points: Floats, goal_points: Floats, rigid_motion: tuple[Floats, Floats]) -> Floats:
    """Distances (..., n) [m] of moved points from their goals.

    The motions are rotations (..., 3, 3) and shifts (..., 3).
    """
    rotation, shift = rigid_motion
    moved = points @ np.swapaxes(rotation, -1, -2) + shift[..., None, :]
    return np.asarray(np.linalg.norm(moved - goal_points, axis=-1))


def _sum_of_log_distances(distances: Floats) -> Floats:
    """Sum (...) of the logarithms of distances (..., n) [m], each at least `MAX_SOUND_MISFIT_M`.

    It prefers a few large distances to many small ones.
    """
    return np.asarray(np.log(np.maximum(distances, MAX_SOUND_MISFIT_M)).sum(axis=-1))


@lru_cache(maxsize=256)
def _point_triples(n_points: int) -> list[list[int]]:
    """Triples of point numbers: all of them for a few points, a fixed selection for many."""
    every = list(combinations(range(n_points), 3)) if n_points <= MAX_POINTS_FOR_ALL_TRIPLES else []
    if every:
        return [list(triple) for triple in every]
    draw = np.random.default_rng(n_points)
    return [draw.choice(n_points, 3, replace=False).tolist() for _ in range(MAX_TRIPLES)]
