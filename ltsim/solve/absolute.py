"""Exact solver for least absolute deviations: it moves between vertices until no neighbouring vertex is better.

At a vertex as many residuals are zero as there are unknowns. Reweighted least squares approaches the optimum in a few
passes; the descent along edges (Barrodale and Roberts 1973) ends at it. The result is the exact solution of the linear
program, without a lower bound on residuals in the weights.
"""

import numpy as np
import scipy.linalg

from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import NetworkError

MAX_VERTEX_SEARCHES = 12
"""Largest number of searches of an optimal vertex with new perturbations."""
CANDIDATE_ROWS_RATIO = 8
"""Number of rows with the smallest residuals among which the first vertex is searched, in multiples of the number of
unknowns."""
DATA_PERTURBATION = 1e-6
"""Size of the perturbation of rows, relative to the usual residual, that prevents more rows than unknowns from having
zero residuals at one vertex.
"""
MAX_DESCENT_EDGES = 2000
"""Largest number of edges along which one search descends."""
ROUNDING_TOLERANCE = 1e-9
"""Relative size below which a slope counts as zero (rounding)."""


def solve_least_absolute(design: Floats, observations: Floats, *, start_solution: Floats | None = None) -> Floats:
    """Solution (k,) of ``min sum |goal - design @ x|``.

    Raises NetworkError if the descent does not end, which only rounding can cause.

    Parameters
    ----------
    design : (m, k) float
        Design matrix of full rank.
    observations : (m,) float
    start_solution : (k,) float, optional
        Start point; the solution does not depend on it.
    """
    x = (
        np.asarray(np.linalg.lstsq(design, observations, rcond=None)[0], dtype=np.float64)
        if start_solution is None
        else start_solution
    )
    usual = float(np.median(np.abs(observations - design @ x)))
    if not usual > 0.0 or not design.shape[1]:
        return x
    if start_solution is None:
        for floor in usual * np.geomspace(1.0, 0.01, MAX_VERTEX_SEARCHES):
            weighted = design / np.maximum(np.abs(observations - design @ x), floor)[:, None]
            x = np.asarray(np.linalg.solve(weighted.T @ design, weighted.T @ observations), dtype=np.float64)
    # By the square of the row's number: multiples of the number itself add up, as differences of the same lengths do.
    split = (0.6180339887498949 * np.arange(len(observations), dtype=np.float64) ** 2) % 1.0 - 0.5
    met = _optimal_vertex(design, observations + DATA_PERTURBATION * usual * split, x)
    return np.asarray(np.linalg.solve(design[met], observations[met]), dtype=np.float64)


def _optimal_vertex(design: Floats, observations: Floats, start_solution: Floats) -> Ints:
    """Rows (k,) with zero residual at the optimal vertex, found by steepest-edge descent."""
    met = _first_vertex(design, observations, start_solution)
    for _ in range(MAX_DESCENT_EDGES):
        inverse = np.linalg.inv(design[met])
        residual = observations - design @ (inverse @ observations[met])
        residual[met] = 0.0
        pull = (np.sign(residual) @ design) @ inverse
        leaving = int(np.argmax(np.abs(pull)))
        slope = abs(float(pull[leaving])) - 1.0
        if slope <= ROUNDING_TOLERANCE:
            return met
        along = design @ (np.sign(pull[leaving]) * inverse[:, leaving])
        along[met] = 0.0
        met[leaving] = _entering_row(residual, along, slope)
    raise NetworkError(f"least absolute deviations: no solution after {MAX_DESCENT_EDGES} steps; check the readings")


def _first_vertex(design: Floats, observations: Floats, start_solution: Floats) -> Ints:
    """Independent rows (k,) with nearly zero residuals at a point near the optimum."""
    residual, count = np.abs(observations - design @ start_solution), design.shape[1]
    order = np.argsort(residual)[: CANDIDATE_ROWS_RATIO * count]
    scaled_design = design[order] / np.maximum(residual[order], residual[order].max() * 1e-6)[:, None]
    pivots = scipy.linalg.qr(scaled_design.T, mode="r", pivoting=True)[1]
    return order[pivots[:count]]


def _entering_row(residual: Floats, edge_residual_rate: Floats, edge_derivative: float) -> int:
    """Row at which the sum of absolute residuals stops decreasing along an edge: a weighted median."""
    ahead = np.flatnonzero(residual * edge_residual_rate > 0.0)
    order = ahead[np.argsort(residual[ahead] / edge_residual_rate[ahead])]
    risen = np.cumsum(2.0 * np.abs(edge_residual_rate[order]))
    return int(order[min(int(np.searchsorted(risen, edge_derivative)), len(order) - 1)])
