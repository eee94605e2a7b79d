"""Estimator of Sensors 2021, 21, 7479, eq. 9: parameters for which distances agree between stations and with the gauge.

The gauge is a set of reflectors at known distances. Least squares and least absolute deviations both use Gauss-Newton
steps. For absolute deviations, each step is the solution of a linear program.

`solve_determined_combinations` estimates only combinations of parameters that the distances determine better than the
prior (gain above one half). The other combinations stay at zero with their prior uncertainty, so that the result is not
the minimum of eq. 9.

`solve_all_combinations` computes this minimum, for comparison with the article. The parameters can be restricted to a
box around zero. Only combinations that change no distance are excluded. The minimum therefore fits the noise if the
readings determine little: eq. 9 as printed has up to 78 parameters.

The objective ignores that distances share points, so that a covariance derived from it would be too small. The
covariance computed here propagates the declared noise of each reading and of the gauge through the estimator.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.sparse as sp
from scipy.optimize import linprog, lsq_linear

from ltsim.adjustment.remedies.undetermined import MIN_DETERMINED_GAIN, ParameterCombination
from ltsim.calibration.objective import DistanceProblem, PairDistances, compared_distance_indices, mean_removal_matrix
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import ModelError, NetworkError
from ltsim.core.rounding import SQRT_MACHINE_EPSILON
from ltsim.solve.gauss_newton import MAX_ITERATIONS
from ltsim.solve.least_absolute import solve_least_absolute

ObjectiveNorm = Literal["squares", "absolute"]
"""Norm of the distance objective: `squares` (sum of squares) or `absolute` (sum of absolute values)."""


@dataclass(frozen=True)
class DistanceComparisons:
    """Comparisons of distances between sets of pointings (one station and face each), with their derivatives.

    The unknowns are the instrument parameters. A comparison is zero if the compared distances agree.
    """

    comparison_matrix: sp.csr_array
    """Coefficient of each distance in each comparison, shape (comparisons, distances)."""
    residuals: Floats
    """Value of each comparison, shape (comparisons,) [m]; zero if the compared distances agree."""
    derivatives_by_unknowns: Floats
    """Derivative of each comparison with respect to each unknown in prior standard deviations, shape (comparisons,
    unknowns) [m]."""
    derivatives_by_noise: sp.csr_array
    """Derivative of each comparison with respect to each whitened reading and reference length, shape (comparisons, 3
    pointings + reference lengths) [m]."""


@dataclass(frozen=True)
class DistanceEstimate:
    """Parameters estimated from distances, with their covariance, in units of their prior standard deviations."""

    unknowns: Floats
    """Estimated parameters of all instruments, shape (unknowns,)."""
    covariance: Floats
    """Covariance of the estimates, shape (unknowns, unknowns). Combinations fixed at zero contribute their prior
    variance."""
    covariance_with_observations: Floats
    """Covariance of the estimates with the whitened readings and reference lengths, shape (unknowns, 3 pointings +
    reference lengths)."""
    undetermined_combinations: tuple[ParameterCombination, ...]
    """Combinations of parameters that the distances do not determine and that are fixed at zero."""
    objective_value: float
    """Distance objective at the estimate: [m^2] for least squares, [m] for absolute deviations."""
    n_iterations: int
    """Number of Gauss-Newton steps."""
    has_converged: bool
    """True if the last step was smaller than the tolerance."""


def mean_deviation_comparisons(problem: DistanceProblem, distances: PairDistances) -> DistanceComparisons:
    """Weighted deviations of distances from their means over stations and faces; the objective sums their squares."""
    centre, count = mean_removal_matrix(distances)
    scaled_centring = sp.diags_array(np.sqrt(count)) @ centre
    return _append_gauge_rows(problem, distances, sp.csr_array(scaled_centring))


def pair_difference_comparisons(problem: DistanceProblem, distances: PairDistances) -> DistanceComparisons:
    """Terms of the distance objective: differences of distances between stations or faces, or from known lengths."""
    first, second = compared_distance_indices(distances)
    problem._check_matrix_size(len(first))
    n_distances = len(distances.lengths)
    return _append_gauge_rows(
        problem, distances, sp.csr_array(_selection_matrix(first, n_distances) - _selection_matrix(second, n_distances))
    )


def _selection_matrix(row_indices: Ints, n_columns: int) -> sp.csr_array:
    """Sparse matrix that selects the rows `row_indices` of a matrix with `n_columns` rows."""
    return sp.csr_array(
        (np.ones(len(row_indices)), (np.arange(len(row_indices)), row_indices)), shape=(len(row_indices), n_columns)
    )


def _append_gauge_rows(
    problem: DistanceProblem, distances: PairDistances, set_comparison_matrix: sp.csr_array
) -> DistanceComparisons:
    """Comparisons between sets of pointings, then the deviations of distances from their reference lengths."""
    at, which = problem.gauge_match_indices(distances)
    n_lengths = len(problem.reference_lengths)
    selection = _selection_matrix(at, len(distances.lengths))
    # The error of a gauge length shifts all rows that compare with it.
    spread = sp.csr_array(-problem.reference_lengths.covariance_cholesky_factor[which])
    matrix = sp.vstack([set_comparison_matrix, selection], format="csr")
    residual = matrix @ distances.lengths
    residual[set_comparison_matrix.shape[0] :] -= problem.reference_lengths.lengths[which]
    length_noise = sp.vstack([sp.csr_array((set_comparison_matrix.shape[0], n_lengths)), spread], format="csr")
    noise = sp.hstack([matrix @ distances.reading_derivatives, length_noise], format="csr")
    return DistanceComparisons(
        sp.csr_array(matrix), residual, matrix @ distances.parameter_derivatives, sp.csr_array(noise)
    )


def solve_determined_combinations(
    problem: DistanceProblem,
    norm: ObjectiveNorm,
    *,
    start_values: Floats | None = None,
    fixed_mask: Bools | None = None,
) -> DistanceEstimate:
    """Minimum of the distance objective over the combinations of unknowns that the readings determine.

    The iteration starts at `start_values` (default zero). Unknowns in the mask `fixed_mask` keep their start value.
    Both have the shape (unknowns,).

    Raises
    ------
    NetworkError
        If no pair of targets was measured from two stations (or faces), and no reference length is declared.

    """
    unknowns, free = _start_values(problem, start_values, fixed_mask)
    deviation_rows = mean_deviation_comparisons(problem, problem.distances_at(unknowns))
    _require_distance_comparisons(deviation_rows, np.ones_like(free))
    estimated, undetermined = determined_and_undetermined_combinations(deviation_rows, free)
    moved, iterations = np.inf, 0
    while iterations < MAX_ITERATIONS and not moved < SQRT_MACHINE_EPSILON:
        iterations += 1
        deviation_rows = distance_comparisons_at(problem, unknowns, norm)
        step = estimated @ _unbounded_step(
            deviation_rows.derivatives_by_unknowns @ estimated, deviation_rows.residuals, norm
        )
        unknowns = unknowns + step
        moved = float(np.max(np.abs(step), initial=0.0))
    return _solution_estimate(
        deviation_rows, norm, (unknowns, estimated, undetermined), iterations, moved < SQRT_MACHINE_EPSILON
    )


def solve_all_combinations(
    problem: DistanceProblem,
    norm: ObjectiveNorm,
    *,
    bound_in_prior_sigmas: float | None = None,
    start_values: Floats | None = None,
    fixed_mask: Bools | None = None,
) -> DistanceEstimate:
    """Minimum of the distance objective (Sensors 2021, 21, 7479, eq. 9) over all combinations of unknowns.

    Each unknown stays within `bound_in_prior_sigmas` prior standard deviations of zero; None for no bound. The other
    arguments and the errors are as in `solve_determined_combinations`.

    Raises
    ------
    ModelError
        If `bound_in_prior_sigmas` is not positive.
    """
    if bound_in_prior_sigmas is not None and not bound_in_prior_sigmas > 0:
        raise ModelError(
            f"the bound on the parameters (box) is {bound_in_prior_sigmas}; expected a positive number of prior sigmas"
        )
    unknowns, free = _start_values(problem, start_values, fixed_mask)
    rows, iterations, moved = distance_comparisons_at(problem, unknowns, norm), 0, np.inf
    _require_distance_comparisons(rows, free)
    while iterations < MAX_ITERATIONS and not moved < SQRT_MACHINE_EPSILON:
        iterations += 1
        step = np.zeros(len(unknowns))
        step[free] = _bounded_step(rows, unknowns[free], free, norm, bound_in_prior_sigmas)
        unknowns, rows, fallen = _line_search(problem, unknowns, step, rows, norm)
        moved = min(float(np.max(np.abs(step))), fallen)
    visible, invisible = _split_observable_combinations(rows, free)
    combinations = tuple(ParameterCombination(vector, 0.0) for vector in invisible.T)
    return _solution_estimate(rows, norm, (unknowns, visible, combinations), iterations, moved < SQRT_MACHINE_EPSILON)


def _start_values(
    problem: DistanceProblem, start_values: Floats | None, fixed_mask: Bools | None
) -> tuple[Floats, Bools]:
    """Start values of the unknowns, and mask of the unknowns to estimate (not in `fixed_mask`), shape (unknowns,)."""
    n_parameters = problem.prior_sigma.size
    unknowns: Floats = np.zeros(n_parameters) if start_values is None else start_values.copy()
    return unknowns, np.ones(n_parameters, dtype=bool) if fixed_mask is None else ~fixed_mask


def _require_distance_comparisons(comparisons: DistanceComparisons, is_free_unknown: Bools) -> None:
    """Check that a comparison of distances depends on the free unknowns; raises NetworkError otherwise."""
    if not np.any(comparisons.derivatives_by_unknowns[:, is_free_unknown]):
        raise NetworkError(
            "no distance can be compared: stations have no pair of common targets, and no gauge is declared"
        )


def _solution_estimate(
    comparisons: DistanceComparisons,
    norm: ObjectiveNorm,
    solution: tuple[Floats, Floats, tuple[ParameterCombination, ...]],
    n_iterations: int,
    is_converged: bool,
) -> DistanceEstimate:
    """Instrument parameters estimated from distances, with their covariance, after the last step of the iteration.

    `solution` contains the unknowns, the estimated linear combinations of instrument parameters (unknowns,
    combinations), and the combinations that distances hardly determine and that are fixed at zero.
    """
    unknowns, estimated, undetermined = solution
    covariance, noise = estimate_covariance(comparisons, estimated, norm)
    prior = np.array([d.coefficient_vector for d in undetermined]).reshape(len(undetermined), len(unknowns))
    return DistanceEstimate(
        unknowns,
        covariance + prior.T @ prior,
        noise,
        undetermined,
        distance_objective(comparisons, norm),
        n_iterations,
        is_converged,
    )


def distance_comparisons_at(problem: DistanceProblem, unknowns: Floats, norm: ObjectiveNorm) -> DistanceComparisons:
    """Comparisons of distances at `unknowns`; their squares or absolute values add to the distance objective."""
    distances = problem.distances_at(unknowns)
    comparisons_of = mean_deviation_comparisons if norm == "squares" else pair_difference_comparisons
    return comparisons_of(problem, distances)


def distance_objective(comparisons: DistanceComparisons, norm: ObjectiveNorm) -> float:
    """Distance objective (Sensors 2021, 21, 7479, eq. 9): sum of squares [m^2] or absolute values [m] of residuals."""
    return float(np.sum(comparisons.residuals**2) if norm == "squares" else np.sum(np.abs(comparisons.residuals)))


def determined_and_undetermined_combinations(
    comparisons: DistanceComparisons, is_free_unknown: Bools
) -> tuple[Floats, tuple[ParameterCombination, ...]]:
    """Combinations of unknowns to estimate, and combinations to fix at zero.

    The estimated ones are an array (unknowns, combinations). For those fixed at zero, the readings reduce the prior
    variance by a fraction below `MIN_DETERMINED_GAIN`; they are in ascending order of this fraction. Unknowns outside
    the mask `is_free_unknown` are not used.
    """
    strength, eigenvectors = np.linalg.eigh(
        comparisons.derivatives_by_unknowns[:, is_free_unknown].T
        @ comparisons.derivatives_by_unknowns[:, is_free_unknown]
    )
    vectors = np.zeros((len(is_free_unknown), len(eigenvectors)))
    vectors[is_free_unknown] = eigenvectors
    nonzero = strength > 1e-12 * strength[-1]
    noise_response = np.asarray(
        (comparisons.derivatives_by_noise.T @ (comparisons.derivatives_by_unknowns @ vectors)).T
    )
    variance = np.full(len(strength), np.inf)
    variance[nonzero] = np.sum(noise_response[nonzero] ** 2, axis=1) / strength[nonzero] ** 2
    gain = 1.0 / (1.0 + variance)
    keep = gain >= MIN_DETERMINED_GAIN
    combinations = [ParameterCombination(vectors[:, i], float(gain[i])) for i in np.flatnonzero(~keep)]
    return vectors[:, keep], tuple(sorted(combinations, key=lambda d: d.gain))


def _split_observable_combinations(comparisons: DistanceComparisons, is_free_unknown: Bools) -> tuple[Floats, Floats]:
    """Combinations of unknowns that change a compared distance, and combinations that change none.

    Both have the shape (unknowns, combinations). Unknowns outside the mask `is_free_unknown` are not used.
    """
    _, strength, right_vectors = np.linalg.svd(
        comparisons.derivatives_by_unknowns[:, is_free_unknown], full_matrices=False
    )
    vectors = np.zeros((len(is_free_unknown), len(right_vectors)))
    vectors[is_free_unknown] = right_vectors.T
    nonzero = strength > SQRT_MACHINE_EPSILON * strength[0]
    return vectors[:, nonzero], vectors[:, ~nonzero]


def _unbounded_step(design: Floats, residual: Floats, norm: ObjectiveNorm) -> Floats:
    """Step of the unknowns that minimises the norm of residual + design @ step."""
    if norm == "squares":
        return -np.asarray(np.linalg.lstsq(design, residual, rcond=None)[0], dtype=np.float64)
    return -solve_least_absolute(design, residual)


def _bounded_step(
    comparisons: DistanceComparisons,
    unknowns: Floats,
    is_free_unknown: Bools,
    norm: ObjectiveNorm,
    bound_in_prior_sigmas: float | None,
) -> Floats:
    """Step that minimises the linearised objective; each unknown stays within `bound_in_prior_sigmas` of zero."""
    design = comparisons.derivatives_by_unknowns[:, is_free_unknown]
    if bound_in_prior_sigmas is None:
        visible = _split_observable_combinations(comparisons, is_free_unknown)[0][is_free_unknown]
        return visible @ _unbounded_step(design @ visible, comparisons.residuals, norm)
    bounded_solver = _least_squares_in_bounds if norm == "squares" else _least_absolute_in_bounds
    return bounded_solver(
        design, comparisons.residuals, (-bound_in_prior_sigmas - unknowns, bound_in_prior_sigmas - unknowns)
    )


def _least_squares_in_bounds(design: Floats, residual: Floats, bounds: tuple[Floats, Floats]) -> Floats:
    """Step within bounds that minimises the sum of squares of residual + design @ step."""
    scale = float(np.linalg.norm(residual))
    solution = lsq_linear(design / scale, -residual / scale, bounds, method="bvls", tol=1e-14)
    return np.asarray(solution.x, dtype=np.float64)


def _least_absolute_in_bounds(design: Floats, residual: Floats, bounds: tuple[Floats, Floats]) -> Floats:
    """Step within bounds that minimises the sum of absolute values of residual + design @ step, by a linear program.

    The residual is written as the difference of two nonnegative vectors, whose sum is minimised.
    """
    count, size = design.shape
    weights, scale = np.concatenate([np.zeros(size), np.ones(2 * count)]), float(np.mean(np.abs(residual)))
    identity = sp.eye_array(count)
    matrix = sp.hstack([sp.csr_array(design / scale), -identity, identity], format="csr")
    limits = [*zip(*bounds, strict=True), *[(0.0, None)] * (2 * count)]
    solution = linprog(weights, A_eq=matrix, b_eq=-residual / scale, bounds=limits, method="highs")
    if solution.x is None:
        raise NetworkError(
            "the sum of absolute distance differences (Sensors 2021, 21, 7479, eq. 9) has no minimum in the bounds of "
            f"the unknowns: the linear program has no solution ({solution.message})"
        )
    return np.asarray(solution.x[:size], dtype=np.float64)


def _line_search(
    problem: DistanceProblem, unknowns: Floats, step: Floats, comparisons: DistanceComparisons, norm: ObjectiveNorm
) -> tuple[Floats, DistanceComparisons, float]:
    """Result of a backtracking line search along a step of the unknowns.

    It consists of the new unknowns, the comparisons at these, and the relative decrease of the objective.
    """
    before, share = distance_objective(comparisons, norm), 1.0
    while share > 1e-3:
        there = unknowns + share * step
        rows_there = distance_comparisons_at(problem, there, norm)
        fallen = 1.0 - distance_objective(rows_there, norm) / before
        if fallen > 0.0:
            return there, rows_there, fallen
        share *= 0.5
    return unknowns, comparisons, 0.0


def estimate_covariance(
    comparisons: DistanceComparisons, estimated_combinations: Floats, norm: ObjectiveNorm
) -> tuple[Floats, Floats]:
    """Covariance of the estimates (unknowns, unknowns), and their covariance with the whitened observations.

    Only the `estimated_combinations` (unknowns, combinations) vary. The observations are the readings and reference
    lengths. For absolute deviations, the asymptotic distribution of the median for correlated normal observations is
    used: the score of an observation is its sign, with E[sign sign] = 2/pi asin(correlation), to first order off the
    diagonal.
    """
    design = comparisons.derivatives_by_unknowns @ estimated_combinations
    if norm == "squares":
        inverse = np.linalg.inv(design.T @ design)
        influence = -inverse @ np.asarray((comparisons.derivatives_by_noise.T @ design).T)
        noise = estimated_combinations @ influence
        return noise @ noise.T, noise
    spread = np.sqrt(
        np.asarray(comparisons.derivatives_by_noise.multiply(comparisons.derivatives_by_noise).sum(axis=1)).ravel()
    )
    spread = np.maximum(spread, 1e-12)
    scaled_design = design / spread[:, None]
    curvature = np.sqrt(2 / np.pi) * (design.T @ scaled_design)
    noise_response = np.asarray((comparisons.derivatives_by_noise.T @ scaled_design).T) * np.sqrt(2 / np.pi)
    score = noise_response @ noise_response.T + (1 - 2 / np.pi) * (design.T @ design)
    inverse = np.linalg.inv(curvature)
    covariance = estimated_combinations @ inverse @ score @ inverse.T @ estimated_combinations.T
    return covariance, estimated_combinations @ (-inverse @ noise_response)


def minimum_comparison_sentences(
    problem: DistanceProblem, norm: ObjectiveNorm, estimate: DistanceEstimate, fixed_mask: Bools
) -> tuple[str, ...]:
    """Sentence that compares the distance objective at an estimate with its minimum over all combinations."""
    minimum = solve_all_combinations(problem, norm, start_values=estimate.unknowns, fixed_mask=fixed_mask)
    power, unit, method = (1e6, "mm^2", "equation-9") if norm == "squares" else (1e3, "mm", "equation-9-l1")
    n_undetermined = len(estimate.undetermined_combinations)
    return (
        f"the distance objective (Sensors 2021, 21, 7479, eq. 9) is {power * estimate.objective_value:.4g} {unit}, "
        f"with {n_undetermined} hardly determined combinations set to zero. Its minimum is "
        f"{power * minimum.objective_value:.4g} {unit} (method {method}), where these combinations are fitted to the "
        "noise",
    )
