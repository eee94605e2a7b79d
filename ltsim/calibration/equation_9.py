"""Eq. 9 of the paper solved as it is printed: the least value that the objective has, in a box or anywhere.

`distance_solver` leaves combinations at zero that the readings hardly determine, so what it gives is no minimum of
eq. 9. This one leaves nothing out but what does not change the objective at all, and so fits noise where the readings
say little: it is here to compare with, and to reproduce.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import scipy.sparse as sp
from scipy.optimize import linprog, lsq_linear

from ltsim.arrays import Bools, Floats
from ltsim.calibration.distance_solver import (
    Estimate,
    Rows,
    compared_rows,
    objective,
    uncertainty,
)
from ltsim.calibration.objective import DistanceProblem
from ltsim.errors import ModelError, NetworkError
from ltsim.remedies.undetermined import Direction
from ltsim.solve.absolute import least_absolute

CAP = 60
CLOSED = 1e-9
"""Converged when no unknown moves by more than this share of its prior sigma, or the objective by this share."""
NOTHING = 1e-9
"""Relative singular value of a combination that does not change any compared distance."""

Norm = Literal["squares", "absolute"]


def solve_equation_9(
    problem: DistanceProblem,
    norm: Norm,
    *,
    box: float | None = None,
    start: Floats | None = None,
    held: Bools | None = None,
) -> Estimate:
    """The minimum of eq. 9, by Gauss-Newton.

    Parameters
    ----------
    problem : DistanceProblem
    norm : str
        `squares` or `absolute`.
    box : float, optional
        Bound on every unknown, in prior sigmas.
    start : (q,) float, optional
        In prior sigmas; default zero.
    held : (q,) bool, optional
        Unknowns that stay at the start.

    Raises
    ------
    NetworkError
        When no pair of targets was seen from two stations (or faces), and no gauge.
    ModelError
        When the box is not positive.
    """
    if box is not None and not box > 0:
        raise ModelError(f"the box is {box}, expected a positive number of prior sigmas")
    unknowns: Floats = np.zeros(problem.prior_sigma.size) if start is None else start.copy()
    free = np.ones(len(unknowns), dtype=bool) if held is None else ~held
    rows, iterations, moved = compared_rows(problem, unknowns, norm), 0, np.inf
    if not np.any(rows.by_unknown[:, free]):
        raise NetworkError("no distance can be compared: stations share no pair of targets, and there is no gauge")
    while iterations < CAP and not moved < CLOSED:
        iterations += 1
        step = np.zeros(len(unknowns))
        step[free] = _step(rows, unknowns[free], free, norm, box)
        unknowns, rows, fallen = _searched(problem, unknowns, step, rows, norm)
        moved = min(float(np.max(np.abs(step))), fallen)
    seen, unseen = _seen(rows, free)
    spread, noise = uncertainty(rows, seen, norm)
    left = tuple(Direction(unseen[:, k], 0.0) for k in range(unseen.shape[1]))
    covariance = spread + unseen @ unseen.T
    total = objective(rows, norm)
    return Estimate(unknowns, covariance, noise, left, total, iterations, moved < CLOSED)


def _seen(rows: Rows, free: Bools) -> tuple[Floats, Floats]:
    """Combinations (q, k) of the free unknowns that change a compared distance, and those that do not."""
    _, strength, own = np.linalg.svd(rows.by_unknown[:, free], full_matrices=False)
    vectors = np.zeros((len(free), len(own)))
    vectors[free] = own.T
    known = strength > NOTHING * strength[0]
    return vectors[:, known], vectors[:, ~known]


def _step(rows: Rows, at: Floats, free: Bools, norm: Norm, box: float | None) -> Floats:
    """Step (f,) of the free unknowns to the minimum of the linearised objective."""
    design = rows.by_unknown[:, free]
    if box is not None:
        bounds = -box - at, box - at
        return (
            _squares_in_box(design, rows.residual, bounds)
            if norm == "squares"
            else _absolute_in_box(design, rows.residual, bounds)
        )
    seen = _seen(rows, free)[0][free]
    reduced = design @ seen
    if norm == "squares":
        return -seen @ np.linalg.lstsq(reduced, rows.residual, rcond=None)[0]
    return -seen @ least_absolute(reduced, rows.residual)


def _squares_in_box(design: Floats, residual: Floats, bounds: tuple[Floats, Floats]) -> Floats:
    scale = float(np.linalg.norm(residual))
    found = lsq_linear(design / scale, -residual / scale, bounds, method="bvls", tol=1e-14)
    return np.asarray(found.x, dtype=np.float64)


def _absolute_in_box(design: Floats, residual: Floats, bounds: tuple[Floats, Floats]) -> Floats:
    """The linear program: residual + design @ step = above - below, both positive, their sum least."""
    count, size = design.shape
    scale = float(np.mean(np.abs(residual)))
    weights = np.concatenate([np.zeros(size), np.ones(2 * count)])
    one = sp.eye_array(count)
    matrix = sp.hstack([sp.csr_array(design / scale), -one, one], format="csr")
    limits = [*zip(*bounds, strict=True), *[(0.0, None)] * (2 * count)]
    found = linprog(weights, A_eq=matrix, b_eq=-residual / scale, bounds=limits, method="highs")
    if found.x is None:
        raise NetworkError(f"eq. 9 in the box: the linear program has no solution ({found.message})")
    return np.asarray(found.x[:size], dtype=np.float64)


def _searched(
    problem: DistanceProblem, unknowns: Floats, step: Floats, rows: Rows, norm: Norm
) -> tuple[Floats, Rows, float]:
    """Go along a step as far as the objective falls; unknowns, rows there, and by what share it fell."""
    before, share = objective(rows, norm), 1.0
    while share > 1e-3:
        there = unknowns + share * step
        found = compared_rows(problem, there, norm)
        fallen = 1.0 - objective(found, norm) / before
        if fallen > 0.0:
            return there, found, fallen
        share *= 0.5
    return unknowns, rows, 0.0


def with_minimum(problem: DistanceProblem, norm: Norm, estimate: Estimate, held: Bools) -> tuple[str, ...]:
    """A sentence: the objective at an estimate that leaves combinations out, and the least that eq. 9 reaches."""
    least = solve_equation_9(problem, norm, start=estimate.unknowns, held=held).objective
    power, unit = (1e6, "mm^2") if norm == "squares" else (1e3, "mm")
    method = "equation-9" if norm == "squares" else "equation-9-l1"
    return (
        f"eq. 9 is {power * estimate.objective:.4g} {unit} here, with {len(estimate.left_out)} combinations left at "
        f"zero that the readings hardly determine; its own minimum is {power * least:.4g} {unit} (method {method}, "
        "which fits these to the noise)",
    )
