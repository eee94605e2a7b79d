"""Least absolute deviations, exactly: a vertex where as many rows as unknowns are met, and no neighbour is better.

Reweighted least squares comes near the optimum in a few passes, the descent along edges (Barrodale and Roberts 1973)
ends at it. What is found is the linear program's own solution, not one smoothed by a floor under the weights.
"""

import numpy as np
import scipy.linalg

from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import NetworkError

PASSES = 12
NEAR = 8
"""The first vertex is sought among this many times as many rows as unknowns, those with the smallest residuals."""
SPLIT = 1e-6
"""Share of the usual residual by which rows are set apart, so that no more of them meet in a vertex than unknowns."""
MOST_EDGES = 2000
ROUNDING = 1e-9


def least_absolute(design: Floats, goal: Floats, *, near: Floats | None = None) -> Floats:
    """Solution (k,) of ``min sum |goal - design @ x|``.

    NetworkError when the descent does not end, which rounding alone can bring about.

    Parameters
    ----------
    design : (m, k) float
        Of full rank.
    goal : (m,) float
    near : (k,) float, optional
        Where to begin; the solution does not depend on it.
    """
    x = np.asarray(np.linalg.lstsq(design, goal, rcond=None)[0], dtype=np.float64) if near is None else near
    usual = float(np.median(np.abs(goal - design @ x)))
    if not usual > 0.0 or not design.shape[1]:
        return x
    if near is None:
        for floor in usual * np.geomspace(1.0, 0.01, PASSES):
            weighted = design / np.maximum(np.abs(goal - design @ x), floor)[:, None]
            x = np.asarray(np.linalg.solve(weighted.T @ design, weighted.T @ goal), dtype=np.float64)
    # By the square of the row's number: multiples of the number itself add up, as differences of the same lengths do.
    split = (0.6180339887498949 * np.arange(len(goal), dtype=np.float64) ** 2) % 1.0 - 0.5
    met = _descended(design, goal + SPLIT * usual * split, x)
    return np.asarray(np.linalg.solve(design[met], goal[met]), dtype=np.float64)


def _descended(design: Floats, goal: Floats, near: Floats) -> Ints:
    """Rows (k,) that are met at the vertex that no edge improves; on the way the steepest edge."""
    met = _first_vertex(design, goal, near)
    for _ in range(MOST_EDGES):
        inverse = np.linalg.inv(design[met])
        residual = goal - design @ (inverse @ goal[met])
        residual[met] = 0.0
        pull = (np.sign(residual) @ design) @ inverse
        leaving = int(np.argmax(np.abs(pull)))
        slope = abs(float(pull[leaving])) - 1.0
        if slope <= ROUNDING:
            return met
        along = design @ (np.sign(pull[leaving]) * inverse[:, leaving])
        along[met] = 0.0
        met[leaving] = _where_it_turns(residual, along, slope)
    raise NetworkError(f"least absolute deviations: no best vertex after {MOST_EDGES} edges; check the readings")


def _first_vertex(design: Floats, goal: Floats, near: Floats) -> Ints:
    """Rows (k,) that are independent and almost met at a point near the optimum."""
    residual, count = np.abs(goal - design @ near), design.shape[1]
    order = np.argsort(residual)[: NEAR * count]
    scaled = design[order] / np.maximum(residual[order], residual[order].max() * 1e-6)[:, None]
    pivots = scipy.linalg.qr(scaled.T, mode="r", pivoting=True)[1]
    return order[pivots[:count]]


def _where_it_turns(residual: Floats, along: Floats, slope: float) -> int:
    """The row that is met where the sum stops falling along an edge: a weighted median."""
    ahead = np.flatnonzero(residual * along > 0.0)
    order = ahead[np.argsort(residual[ahead] / along[ahead])]
    risen = np.cumsum(2.0 * np.abs(along[order]))
    return int(order[min(int(np.searchsorted(risen, slope)), len(order) - 1)])
