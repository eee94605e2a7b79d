"""Covariance in another datum: inner constraints over chosen targets (an S-transformation).

An adjustment ties the free rigid motions of its network to the first station, whose uncertainty then spreads over
everything else. The inner-constraint datum ties them to the mean of chosen targets instead: of all datums it gives
those targets the smallest trace of covariance, and it is the one to compare with a cloud fitted to the truth.
"""

from __future__ import annotations

import numpy as np

from ltsim.adjust.adjustment import Adjustment
from ltsim.arrays import Floats, Ints
from ltsim.errors import ModelError
from ltsim.geometry.rigid import rigid_motion


def inner_covariance(adjustment: Adjustment, points: Ints | None = None) -> Floats:
    """Covariance (3 T, 3 T) [m^2] of all targets, with the free motions tied to the targets `points`.

    Parameters
    ----------
    adjustment : Adjustment
    points : (k,) int, optional
        Indices of at least three targets off one line; default all.

    Raises
    ------
    ModelError
        When the chosen targets do not hold the free motions.

    References
    ----------
    Baarda, S-transformations and criterion matrices (1973); Koch, Parameter Estimation and Hypothesis Testing
    in Linear Models (1999), 3.3: S = I - G (B^T G)^-1 B^T.
    """
    problem, state = adjustment.problem, adjustment.state
    count = len(state.points)
    chosen = np.arange(count) if points is None else np.asarray(points, dtype=np.int64)
    centre = state.points[chosen].mean(axis=0)
    free = problem.free.copy()
    free[:3] += np.cross(free[3:].T, centre).T
    motion = rigid_motion(state.points - centre) @ free
    if not free.shape[1]:
        return _target_covariance(adjustment)
    tied = np.zeros((count, 3), dtype=bool)
    tied[chosen] = True
    hold = motion * tied.reshape(-1, 1)
    square = hold.T @ motion
    if np.linalg.cond(square) > 1e12:
        raise ModelError("these targets do not define a datum: choose at least three off one line")
    transform = np.eye(3 * count) - motion @ np.linalg.solve(square, hold.T)
    inner: Floats = transform @ _target_covariance(adjustment) @ transform.T
    return inner


def _target_covariance(adjustment: Adjustment) -> Floats:
    """Joint covariance (3 T, 3 T) of all targets in the datum of the adjustment."""
    at = adjustment.problem.layout.target.ravel()
    pick = np.zeros((adjustment.problem.layout.size, len(at)))
    pick[at, np.arange(len(at))] = 1.0
    covariance: Floats = adjustment.factor.covariance_columns(pick)[at]
    return covariance
