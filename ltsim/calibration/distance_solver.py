"""Estimator of the paper: parameters that make distances agree between stations and with the gauge (eq. 9).

Least squares and least absolute deviations both use Gauss-Newton steps; a step of the latter is the solution of a
linear program. The objective as printed estimates up to 78 parameters even if the data do not determine them.
`solve_distances` estimates only combinations whose estimate is more precise than the prior (gain above one half); the
others remain zero with their prior uncertainty. That is no minimum of eq. 9. `solve_equation_9` computes the minimum,
optionally within a box: it excludes only combinations that do not change the objective, and therefore fits noise if the
readings determine little. It serves for comparison and reproduction.

The objective ignores that distances share points, so its own covariance would be too small. The covariance computed
here propagates the declared noise of every reading (and of the gauge) through the estimator.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.sparse as sp
from scipy.optimize import linprog, lsq_linear

from ltsim.adjustment.remedies.undetermined import DETERMINED, Direction
from ltsim.calibration.objective import DistanceProblem, Distances, centring, set_pairs
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import ModelError, NetworkError
from ltsim.solve.absolute import least_absolute

CAP = 30
CLOSED = 1e-7
"""Largest number of steps, and largest change of an unknown, in prior sigmas, at which the iteration has converged."""
LEAST_CAP = 60
LEAST_CLOSED = 1e-9
"""Largest number of steps, and relative change at which the iteration has converged, for the minimum of eq. 9; the
change is that of an unknown (in prior sigmas) or of the objective.
"""
NOTHING = 1e-9
"""Singular value, relative to the largest, below which a combination changes no compared distance (rounding)."""

Norm = Literal["squares", "absolute"]


@dataclass(frozen=True)
class Separations:
    """Compared distances: comparison matrix (R, D), residuals (R,), derivatives (R, q) and noise (R, 3 n + g)."""

    compare: sp.csr_array
    residual: Floats
    by_unknown: Floats
    by_noise: sp.csr_array


@dataclass(frozen=True)
class Estimates:
    """Estimates in units of their prior sigmas, and their dependence on the noise."""

    unknowns: Floats
    """Estimated unknowns, (q,)."""
    covariance: Floats
    """Covariance of the error, including combinations fixed at zero, (q, q)."""
    noise: Floats
    """Covariance of the error and the whitened readings and gauge lengths, (q, 3 n + g)."""
    undetermined: tuple[Direction, ...]
    objective: float
    """Objective at the minimum: [m^2] for least squares, [m] for absolute deviations."""
    iterations: int
    converged: bool


def mean_rows(problem: DistanceProblem, distances: Distances) -> Separations:
    """Rows whose sum of squares is eq. 9 squared: weighted deviations from the mean over sets."""
    centre, count = centring(distances)
    scaled = sp.diags_array(np.sqrt(count)) @ centre
    return _with_gauge(problem, distances, sp.csr_array(scaled))


def pair_rows(problem: DistanceProblem, distances: Distances) -> Separations:
    """Single terms of eq. 9: differences between pairs of sets, then gauge terms."""
    first, second = set_pairs(distances)
    problem._check_size(len(first))
    count = len(distances.length)
    return _with_gauge(problem, distances, sp.csr_array(_selected(first, count) - _selected(second, count)))


def _selected(at: Ints, count: int) -> sp.csr_array:
    """Matrix (k, count) that selects the rows `at` (k,)."""
    return sp.csr_array((np.ones(len(at)), (np.arange(len(at)), at)), shape=(len(at), count))


def _with_gauge(problem: DistanceProblem, distances: Distances, compare: sp.csr_array) -> Separations:
    at, which = problem.gauge_matches(distances)
    n_lengths = len(problem.gauge)
    pick = _selected(at, len(distances.length))
    # The error of a gauge length shifts all rows that compare with it.
    spread = sp.csr_array(-problem.gauge.spread[which])
    matrix = sp.vstack([compare, pick], format="csr")
    residual = matrix @ distances.length
    residual[compare.shape[0] :] -= problem.gauge.length[which]
    length_noise = sp.vstack([sp.csr_array((compare.shape[0], n_lengths)), spread], format="csr")
    noise = sp.hstack([matrix @ distances.by_reading, length_noise], format="csr")
    return Separations(sp.csr_array(matrix), residual, matrix @ distances.by_parameter, sp.csr_array(noise))


def solve_distances(
    problem: DistanceProblem, norm: Norm, *, start: Floats | None = None, held: Bools | None = None
) -> Estimates:
    """Minimum of eq. 9 over the combinations that the readings determine.

    The iteration starts at zero or at `start` (q,); unknowns that are `held` (q,) keep their start value.

    Raises
    ------
    NetworkError
        If no pair of targets was measured from two stations (or faces), and there is no gauge.
    """
    unknowns, free = _begun(problem, start, held)
    rows = mean_rows(problem, problem.at(unknowns))
    _require_compared(rows, np.ones_like(free))
    estimated, undetermined = determined(rows, free)
    moved, iterations = np.inf, 0
    while iterations < CAP and not moved < CLOSED:
        iterations += 1
        rows = compared_rows(problem, unknowns, norm)
        step = estimated @ _least(rows.by_unknown @ estimated, rows.residual, norm)
        unknowns = unknowns + step
        moved = float(np.max(np.abs(step), initial=0.0))
    return _estimate(rows, norm, (unknowns, estimated, undetermined), iterations, moved < CLOSED)


def solve_equation_9(
    problem: DistanceProblem,
    norm: Norm,
    *,
    box: float | None = None,
    start: Floats | None = None,
    held: Bools | None = None,
) -> Estimates:
    """Minimum of eq. 9 with every unknown within `box` prior sigmas; arguments and errors as `solve_distances`.

    Raises
    ------
    ModelError
        When the box is not positive.
    """
    if box is not None and not box > 0:
        raise ModelError(f"the box is {box}, expected a positive number of prior sigmas")
    unknowns, free = _begun(problem, start, held)
    rows, iterations, moved = compared_rows(problem, unknowns, norm), 0, np.inf
    _require_compared(rows, free)
    while iterations < LEAST_CAP and not moved < LEAST_CLOSED:
        iterations += 1
        step = np.zeros(len(unknowns))
        step[free] = _step(rows, unknowns[free], free, norm, box)
        unknowns, rows, fallen = _searched(problem, unknowns, step, rows, norm)
        moved = min(float(np.max(np.abs(step))), fallen)
    visible, invisible = _split_visible(rows, free)
    undetermined = tuple(Direction(vector, 0.0) for vector in invisible.T)
    return _estimate(rows, norm, (unknowns, visible, undetermined), iterations, moved < LEAST_CLOSED)


def _begun(problem: DistanceProblem, start: Floats | None, held: Bools | None) -> tuple[Floats, Bools]:
    """Start values (q,) of the unknowns, and flags of the free ones."""
    size = problem.prior_sigma.size
    unknowns: Floats = np.zeros(size) if start is None else start.copy()
    return unknowns, np.ones(size, dtype=bool) if held is None else ~held


def _require_compared(rows: Separations, free: Bools) -> None:
    if not np.any(rows.by_unknown[:, free]):
        raise NetworkError("no distance can be compared: stations share no pair of targets, and there is no gauge")


def _estimate(
    rows: Separations,
    norm: Norm,
    solution: tuple[Floats, Floats, tuple[Direction, ...]],
    iterations: int,
    converged: bool,
) -> Estimates:
    """Estimates from the unknowns, with the estimated combinations (q, k) and the excluded ones."""
    unknowns, estimated, undetermined = solution
    covariance, noise = uncertainty(rows, estimated, norm)
    prior = np.array([d.vector for d in undetermined]).reshape(len(undetermined), len(unknowns))
    return Estimates(
        unknowns, covariance + prior.T @ prior, noise, undetermined, objective(rows, norm), iterations, converged
    )


def compared_rows(problem: DistanceProblem, unknowns: Floats, norm: Norm) -> Separations:
    """Rows whose sum of squares, or of absolute values, is eq. 9."""
    distances = problem.at(unknowns)
    return mean_rows(problem, distances) if norm == "squares" else pair_rows(problem, distances)


def objective(rows: Separations, norm: Norm) -> float:
    """Value of eq. 9 [m^2], or of its sum of absolute values [m]."""
    return float(np.sum(rows.residual**2) if norm == "squares" else np.sum(np.abs(rows.residual)))


def determined(rows: Separations, free: Bools) -> tuple[Floats, tuple[Direction, ...]]:
    """Combinations (q, k) of the `free` (q,) unknowns to be estimated, and those fixed at zero with their gains."""
    strength, eigenvectors = np.linalg.eigh(rows.by_unknown[:, free].T @ rows.by_unknown[:, free])
    vectors = np.zeros((len(free), len(eigenvectors)))
    vectors[free] = eigenvectors
    nonzero = strength > 1e-12 * strength[-1]
    carried = np.asarray((rows.by_noise.T @ (rows.by_unknown @ vectors)).T)
    variance = np.full(len(strength), np.inf)
    variance[nonzero] = np.sum(carried[nonzero] ** 2, axis=1) / strength[nonzero] ** 2
    gain = 1.0 / (1.0 + variance)
    keep = gain >= DETERMINED
    undetermined = [Direction(vectors[:, i], float(gain[i])) for i in np.flatnonzero(~keep)]
    return vectors[:, keep], tuple(sorted(undetermined, key=lambda d: d.gain))


def _split_visible(rows: Separations, free: Bools) -> tuple[Floats, Floats]:
    """Combinations (q, k) of the free unknowns that change a compared distance, and those that do not."""
    _, strength, right_vectors = np.linalg.svd(rows.by_unknown[:, free], full_matrices=False)
    vectors = np.zeros((len(free), len(right_vectors)))
    vectors[free] = right_vectors.T
    nonzero = strength > NOTHING * strength[0]
    return vectors[:, nonzero], vectors[:, ~nonzero]


def _least(design: Floats, residual: Floats, norm: Norm) -> Floats:
    """Step that minimises |residual + design @ step| in the norm."""
    if norm == "squares":
        return -np.asarray(np.linalg.lstsq(design, residual, rcond=None)[0], dtype=np.float64)
    return -least_absolute(design, residual)


def _step(rows: Separations, at: Floats, free: Bools, norm: Norm, box: float | None) -> Floats:
    """Step (f,) of the free unknowns to the minimum of the linearised objective."""
    design = rows.by_unknown[:, free]
    if box is None:
        visible = _split_visible(rows, free)[0][free]
        return visible @ _least(design @ visible, rows.residual, norm)
    within = _squares_in_box if norm == "squares" else _absolute_in_box
    return within(design, rows.residual, (-box - at, box - at))


def _squares_in_box(design: Floats, residual: Floats, bounds: tuple[Floats, Floats]) -> Floats:
    scale = float(np.linalg.norm(residual))
    solution = lsq_linear(design / scale, -residual / scale, bounds, method="bvls", tol=1e-14)
    return np.asarray(solution.x, dtype=np.float64)


def _absolute_in_box(design: Floats, residual: Floats, bounds: tuple[Floats, Floats]) -> Floats:
    """Solution of a linear program: residual + design @ step = above - below, both nonnegative, smallest sum."""
    count, size = design.shape
    scale = float(np.mean(np.abs(residual)))
    weights = np.concatenate([np.zeros(size), np.ones(2 * count)])
    identity = sp.eye_array(count)
    matrix = sp.hstack([sp.csr_array(design / scale), -identity, identity], format="csr")
    limits = [*zip(*bounds, strict=True), *[(0.0, None)] * (2 * count)]
    solution = linprog(weights, A_eq=matrix, b_eq=-residual / scale, bounds=limits, method="highs")
    if solution.x is None:
        raise NetworkError(f"eq. 9 in the box: the linear program has no solution ({solution.message})")
    return np.asarray(solution.x[:size], dtype=np.float64)


def _searched(
    problem: DistanceProblem, unknowns: Floats, step: Floats, rows: Separations, norm: Norm
) -> tuple[Floats, Separations, float]:
    """Backtracking line search along a step: unknowns, rows at them, and relative decrease of the objective."""
    before, share = objective(rows, norm), 1.0
    while share > 1e-3:
        there = unknowns + share * step
        rows_there = compared_rows(problem, there, norm)
        fallen = 1.0 - objective(rows_there, norm) / before
        if fallen > 0.0:
            return there, rows_there, fallen
        share *= 0.5
    return unknowns, rows, 0.0


def uncertainty(rows: Separations, estimated: Floats, norm: Norm) -> tuple[Floats, Floats]:
    """Covariance (q, q) of the estimate and its covariance (q, 3 n + g) with the whitened noise.

    For absolute deviations by the asymptotic law of the median for correlated normal rows: the score is the sign,
    E[sign sign] = 2/pi asin(correlation), taken to first order off the diagonal.
    """
    design = rows.by_unknown @ estimated
    if norm == "squares":
        inverse = np.linalg.inv(design.T @ design)
        influence = -inverse @ np.asarray((rows.by_noise.T @ design).T)
        noise = estimated @ influence
        return noise @ noise.T, noise
    spread = np.sqrt(np.asarray(rows.by_noise.multiply(rows.by_noise).sum(axis=1)).ravel())
    spread = np.maximum(spread, 1e-12)
    scaled = design / spread[:, None]
    curvature = np.sqrt(2 / np.pi) * (design.T @ scaled)
    carried = np.asarray((rows.by_noise.T @ scaled).T) * np.sqrt(2 / np.pi)
    score = carried @ carried.T + (1 - 2 / np.pi) * (design.T @ design)
    inverse = np.linalg.inv(curvature)
    covariance = estimated @ inverse @ score @ inverse.T @ estimated.T
    return covariance, estimated @ (-inverse @ carried)


def with_minimum(problem: DistanceProblem, norm: Norm, estimate: Estimates, held: Bools) -> tuple[str, ...]:
    """Sentence on the objective at an estimate without all combinations, and the minimum of eq. 9."""
    least = solve_equation_9(problem, norm, start=estimate.unknowns, held=held).objective
    power, unit = (1e6, "mm^2") if norm == "squares" else (1e3, "mm")
    method = "equation-9" if norm == "squares" else "equation-9-l1"
    return (
        f"eq. 9 is {power * estimate.objective:.4g} {unit} here, with {len(estimate.undetermined)} combinations left "
        f"at zero that the readings hardly determine; its own minimum is {power * least:.4g} {unit} (method {method}, "
        "which fits these to the noise)",
    )
