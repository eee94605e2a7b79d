"""Exact solver for least absolute deviations: a linear program, solved by a descent from vertex to vertex.

At a vertex of the linear program as many residuals are zero as there are unknowns. Reweighted least squares gives an
approximate optimum. From there the solver moves along edges to neighbouring vertices until no neighbour has a smaller
sum of absolute residuals (Barrodale and Roberts 1973). Reweighted least squares alone is not exact, because its weights
need a lower bound on the residuals.
"""

import numpy as np
import scipy.linalg

from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import NetworkError

N_REWEIGHTING_PASSES = 12
"""Number of passes of reweighted least squares that compute the start values of a least-absolute-deviations solution.
The lower bound on residuals decreases from pass to pass, from the median absolute residual to a hundredth of it."""
CANDIDATE_ROWS_PER_UNKNOWN = 8
"""Number of rows of the design matrix, per unknown, that are candidates for a zero residual in the first vertex
(solution with as many zero residuals as unknowns). The candidates are the rows with the smallest residuals."""
RELATIVE_DATA_PERTURBATION = 1e-6
"""Size of a perturbation of the observations, divided by the median absolute residual. Without the perturbation a
solution may have more zero residuals than there are unknowns, and the descent could then repeat the same solutions
without end."""
MAX_DESCENT_EDGES = 2000
"""Largest number of edges of one descent from vertex to vertex (solutions with as many zero residuals as unknowns). An
edge exchanges one zero residual. If the number is exceeded, the solver raises NetworkError."""
ZERO_SLOPE_TOLERANCE = 1e-9
"""Limit of the relative slope of the sum of absolute residuals along an edge (exchange of one zero residual). Slopes
below it are rounding errors; if no edge has a larger slope, the solution is optimal."""


def solve_least_absolute(design: Floats, observations: Floats, *, start_solution: Floats | None = None) -> Floats:
    """Least-absolute-deviations solution (k,): the k unknowns x that minimise ``sum |observations - design @ x|``.

    Raises NetworkError if the descent does not end, which only rounding errors can cause.

    Parameters
    ----------
    design : (m, k) float
        Design matrix of full rank.
    observations : (m,) float
        The m observed values.
    start_solution : (k,) float, optional
        Start values of the unknowns. The solution does not depend on them.
    """
    x = (
        np.asarray(np.linalg.lstsq(design, observations, rcond=None)[0], dtype=np.float64)
        if start_solution is None
        else start_solution
    )
    median_residual = float(np.median(np.abs(observations - design @ x)))
    if not median_residual > 0.0 or not design.shape[1]:
        return x
    if start_solution is None:
        for floor in median_residual * np.geomspace(1.0, 0.01, N_REWEIGHTING_PASSES):
            weighted = design / np.maximum(np.abs(observations - design @ x), floor)[:, None]
            x = np.asarray(np.linalg.solve(weighted.T @ design, weighted.T @ observations), dtype=np.float64)
    # The perturbation grows with the square of the row index. A linear one would cancel in differences of observations.
    perturbation = (0.6180339887498949 * np.arange(len(observations), dtype=np.float64) ** 2) % 1.0 - 0.5
    vertex_rows = _optimal_vertex(design, observations + RELATIVE_DATA_PERTURBATION * median_residual * perturbation, x)
    return np.asarray(np.linalg.solve(design[vertex_rows], observations[vertex_rows]), dtype=np.float64)


def _optimal_vertex(design: Floats, observations: Floats, start_solution: Floats) -> Ints:
    """Indices (k,) of the k rows with zero residual in the optimal solution, by exchange of one row at a time.

    `start_solution` (k,) contains the values of the unknowns near which the first solution with k zero residuals is
    selected.
    """
    vertex_rows = _initial_vertex(design, observations, start_solution)
    for _ in range(MAX_DESCENT_EDGES):
        inverse = np.linalg.inv(design[vertex_rows])
        residual = observations - design @ (inverse @ observations[vertex_rows])
        residual[vertex_rows] = 0.0
        multipliers = (np.sign(residual) @ design) @ inverse
        leaving_index = int(np.argmax(np.abs(multipliers)))
        slope = abs(float(multipliers[leaving_index])) - 1.0
        if slope <= ZERO_SLOPE_TOLERANCE:
            return vertex_rows
        edge_rates = design @ (np.sign(multipliers[leaving_index]) * inverse[:, leaving_index])
        edge_rates[vertex_rows] = 0.0
        vertex_rows[leaving_index] = _entering_row(residual, edge_rates, slope)
    raise NetworkError(
        f"the minimisation of absolute deviations did not converge in {MAX_DESCENT_EDGES} steps; check the readings"
    )


def _initial_vertex(design: Floats, observations: Floats, start_solution: Floats) -> Ints:
    """Indices (k,) of k linearly independent rows with small residuals at the values `start_solution` (k,).

    The first solution of a descent has zero residuals in these rows.
    """
    residual, count = np.abs(observations - design @ start_solution), design.shape[1]
    order = np.argsort(residual)[: CANDIDATE_ROWS_PER_UNKNOWN * count]
    scaled_design = design[order] / np.maximum(residual[order], residual[order].max() * 1e-6)[:, None]
    pivots = scipy.linalg.qr(scaled_design.T, mode="r", pivoting=True)[1]
    return order[pivots[:count]]


def _entering_row(residual: Floats, residual_rates_along_edge: Floats, objective_slope: float) -> int:
    """Index of the row whose residual becomes zero where the sum of absolute residuals along an edge is smallest.

    This place is a weighted median. `residual_rates_along_edge` (m,) is the decrease of each of the m entries of
    `residual` per unit of length along the edge, `objective_slope` the initial decrease of the sum of absolute
    residuals per unit of length.
    """
    ahead = np.flatnonzero(residual * residual_rates_along_edge > 0.0)
    order = ahead[np.argsort(residual[ahead] / residual_rates_along_edge[ahead])]
    slope_increase = np.cumsum(2.0 * np.abs(residual_rates_along_edge[order]))
    return int(order[min(int(np.searchsorted(slope_increase, objective_slope)), len(order) - 1)])
