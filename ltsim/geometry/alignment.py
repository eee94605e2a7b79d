"""Closed-form rigid alignment of two point sets."""

from __future__ import annotations

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import NetworkError

ROBUST_PASSES = 8
OUTLYING = 8.0
"""Misses up to four times the median are noise: nothing to reweight."""


def align(source: Floats, goal: Floats, weights: Floats | None = None) -> tuple[Floats, Floats]:
    """Rotation (3, 3) and translation (3,) with ``goal ~ source @ rotation.T + translation``.

    Parameters
    ----------
    source, goal : (n, 3) float, [m]
        Corresponding points, n >= 3, not on one line.
    weights : (n,) float, optional
        Non-negative weights.

    Raises
    ------
    NetworkError
        When fewer than three points are given or they lie on one line.

    References
    ----------
    Kabsch, Acta Cryst. A32 (1976) 922; proper rotation enforced by the sign of the determinant.
    """
    weight = np.ones(len(source)) if weights is None else weights
    if np.count_nonzero(weight) < 3:
        raise NetworkError("an alignment needs at least three common points")
    weight = weight / weight.sum()
    centre_s, centre_g = weight @ source, weight @ goal
    covariance = (weight[:, None] * (goal - centre_g)).T @ (source - centre_s)
    left, spread, right = np.linalg.svd(covariance)
    if spread[1] <= 1e-9 * spread[0]:
        raise NetworkError("an alignment needs three common points that are not on one line")
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = left @ flip @ right
    return rotation, centre_g - rotation @ centre_s


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
