"""Closed-form rigid alignment of two point sets."""

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import NetworkError

ROBUST_PASSES = 8
OUTLYING = 8.0
"""Misses up to four times the median are noise: nothing to reweight."""


def align(source: Floats, goal: Floats, weights: Floats | None = None) -> tuple[Floats, Floats]:
    """Rotation (3, 3) and translation (3,) with ``goal ~ source @ rotation.T + translation``; see `best_fit`."""
    return best_fit(source, goal, weights)[:2]


def best_fit(
    source: Floats, goal: Floats, weights: Floats | None = None, *, scaled: bool = False
) -> tuple[Floats, Floats, Floats]:
    """Rotation (..., 3, 3), shift (..., 3) and scale (...) with ``goal ~ scale * source @ rotation.T + shift``.

    Parameters
    ----------
    source : (n, 3) float, [m]
        n >= 3, not on one line.
    goal : (..., n, 3) float, [m]
        The corresponding points.
    weights : (n,) float, optional
        Non-negative weights.
    scaled : bool
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
    weight = np.ones(len(source)) if weights is None else weights
    if np.count_nonzero(weight) < 3:
        raise NetworkError("an alignment needs at least three common points")
    weight = weight / weight.sum()
    centre, middle = weight @ source, weight @ goal
    arms = source - centre
    moment = np.swapaxes(weight[:, None] * (goal - middle[..., None, :]), -1, -2) @ arms
    left, spread, right = np.linalg.svd(moment)
    if np.any(spread[..., 1] <= 1e-9 * spread[..., 0]):
        raise NetworkError("an alignment needs three common points that are not on one line")
    flip = np.ones_like(spread)
    flip[..., 2] = np.sign(np.linalg.det(left @ right))
    rotation = (left * flip[..., None, :]) @ right
    scale = np.ones(moment.shape[:-2])
    if scaled:
        scale = np.sum(spread * flip, axis=-1) / np.sum(weight[:, None] * arms**2)
    return rotation, middle - scale[..., None] * (rotation @ centre), scale


def robust_align(source: Floats, goal: Floats) -> tuple[Floats, Floats]:
    """Rigid alignment by least absolute deviations (reweighted), so that a swapped target does not tilt it."""
    rotation, translation = align(source, goal)
    if len(source) < 4:
        return rotation, translation
    for _ in range(ROBUST_PASSES):
        miss = np.linalg.norm(source @ rotation.T + translation - goal, axis=1)
        floor = max(1e-5, 0.5 * float(np.median(miss)))
        if miss.max() < OUTLYING * floor:
            break
        rotation, translation = align(source, goal, 1.0 / np.maximum(miss, floor))
    return rotation, translation
