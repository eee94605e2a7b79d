"""Closed-form rigid alignment of two point sets."""

from __future__ import annotations

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import NetworkError


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
