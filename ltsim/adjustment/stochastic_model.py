"""Stochastic model of a network: robust weights of observations, and variance components of groups of readings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from ltsim.adjustment.problem import NetworkProblem
from ltsim.adjustment.significance import MIN_SIGMAS_BEYOND_NOISE
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.physics.model.measurement import NetworkState
from ltsim.recordings.recording import OBSERVABLES, Recording
from ltsim.solve.design import robust_sigma, weight_rows
from ltsim.solve.elimination import BlockSystem, FactorisedNormals, SingularSystemError
from ltsim.solve.gauss_newton import (
    MAX_CONVERGENCE_RATIO,
    MAX_DECISION_CHANGES,
    MAX_ITERATIONS,
    Solution,
    solve,
)

HUBER_LIMIT = 2.0
"""Largest residual, in robust standard deviations, with a weight of 1 by Huber's method. The statistical efficiency for
normal residuals is 97 %."""
CAUCHY_LIMIT = 2.385
"""Residual, in robust standard deviations, at which Cauchy's weight is one half. The statistical efficiency for normal
residuals is 95 %."""
MAX_FRACTION_BEYOND_NOISE = 0.02
"""Largest fraction of residuals above `MIN_SIGMAS_BEYOND_NOISE` declared standard deviations that single errors
explain. If the fraction is larger, Cauchy's weights are tried too.
"""
MAX_STEPS_OF_ROBUST_FIT = 25
"""Largest number of steps of a robust fit with all observations reweighted. With more steps many large errors of one
target distort the network: with 60 steps, a target that was displaced at random at every set-up was identified as three
motions."""
NOISE_KEYS_BY_OBSERVABLE = {
    "distance": ("distance_mm", "distance_ppm"),
    "azimuth": ("azimuth_arcsec",),
    "elevation": ("elevation_arcsec",),
}
"""Keys of the declared noise in `[instrument.noise]` of `setup.toml`, by observable."""
SQUARED_ROBUST_STEP_TOLERANCE = 1e-2
"""Squared length of a step, in units of the standard deviations of the unknowns, at which the iteration of robust
weights ends."""


def noise_declaration_texts(recording: Recording, observable: str, factor: float) -> list[str]:
    """Texts, such as "distance_mm to 0.02", with the keys and values that declare the noise of an observable.

    The values are the declared noise of the first instrument, multiplied by `factor`, for `[instrument.noise]`.
    """
    noise = recording.setup.instrument_named(recording.instruments[0]).noise
    return [
        f"{key} to {factor * getattr(noise, key):.3g}"
        for key in NOISE_KEYS_BY_OBSERVABLE[observable]
        if getattr(noise, key)
    ]


def n_observation_equations(problem: NetworkProblem) -> int:
    """Number of equations that are observations: readings and reference values, without constraints and priors."""
    return problem.level_row_slice.stop + len(problem.yaw_rows)


def fit_robust_state(problem: NetworkProblem, state: NetworkState) -> tuple[NetworkState, Floats]:
    """State of a fit with robust weights of readings and reference values, and whitened residuals (m,) of m equations.

    The method is that of `iterate_reweighted`; `state` is the start state.
    """
    return iterate_reweighted(
        problem, state, n_observation_equations(problem), min_scale=1.0, max_steps=MAX_STEPS_OF_ROBUST_FIT
    )


def iterate_reweighted(
    problem: NetworkProblem, state: NetworkState, n_observations: int, *, min_scale: float, max_steps: int
) -> tuple[NetworkState, Floats]:
    """State of a fit by iteratively reweighted least squares, and whitened residuals (m,) of all m equations.

    Huber's weights permit a poor start state. If many residuals are large with these weights, Cauchy's weights are
    tried too: with them a good start state changes little, although many readings of one station or target contradict
    it. The result with the smaller sum of Cauchy's robust loss is returned.

    Parameters
    ----------
    problem : NetworkProblem
    state : NetworkState
        Start state.
    n_observations : int
        Number of equations that are reweighted; these are the first equations of the problem.
    min_scale : float
        Lower bound of the robust standard deviation of the whitened residuals.
    max_steps : int
        Largest number of steps.
    """
    search, reading = (
        partial(_iterate_weights, problem, state, n_observations, min_scale, max_steps),
        int(problem.is_used_reading.sum()),
    )
    solutions = [search(huber_weights)]
    if has_many_residuals_beyond_noise(solutions[0][1][:reading]):
        solutions.append(search(cauchy_weights))
    return solutions[best_solution_index([residual[:reading] for _, residual in solutions])]


def has_many_residuals_beyond_noise(whitened_residuals: Floats) -> bool:
    """True if more than `MAX_FRACTION_BEYOND_NOISE` of the whitened residuals exceed `MIN_SIGMAS_BEYOND_NOISE`."""
    n_beyond = np.count_nonzero(np.abs(whitened_residuals) > MIN_SIGMAS_BEYOND_NOISE)
    return bool(n_beyond > MAX_FRACTION_BEYOND_NOISE * len(whitened_residuals))


def best_solution_index(residuals_of_solutions: Sequence[Floats]) -> int:
    """Index of the solution with the smallest sum of Cauchy's robust loss, from the residuals of each solution."""
    scale = max(min(robust_sigma(whitened) for whitened in residuals_of_solutions), 1.0)
    return int(
        np.argmin([np.sum(np.log1p((whitened / (CAUCHY_LIMIT * scale)) ** 2)) for whitened in residuals_of_solutions])
    )


def huber_weights(normalised_residuals: Floats) -> Floats:
    """Huber's weights (1964) of absolute residuals divided by their robust standard deviation."""
    return 1.0 / np.maximum(normalised_residuals / HUBER_LIMIT, 1.0)


def cauchy_weights(normalised_residuals: Floats) -> Floats:
    """Cauchy's weights (Holland and Welsch 1977) of residuals divided by their robust standard deviation."""
    return 1.0 / (1.0 + (normalised_residuals / CAUCHY_LIMIT) ** 2)


def _iterate_weights(
    problem: NetworkProblem,
    state: NetworkState,
    n_observations: int,
    min_scale: float,
    max_steps: int,
    weight_function: Callable[[Floats], Floats],
) -> tuple[NetworkState, Floats]:
    """State of a fit by reweighted least squares with one weight function, and whitened residuals (m,) of m equations.

    The other arguments are those of `iterate_reweighted`.

    The robust scale of the residuals never increases. Otherwise a large error that distorts the network would increase
    the scale and thus its weight (Huber 1981, Robust statistics, section 7.8: with a fixed scale each step decreases
    the objective).
    """
    reading, scale = int(problem.is_used_reading.sum()), np.inf
    for _ in range(max_steps):
        system = problem.linearise(state)
        scale = min(scale, max(robust_sigma(system.whitened_residuals[:reading]), min_scale))
        root = np.ones(len(system.whitened_residuals))
        root[:n_observations] = np.sqrt(weight_function(np.abs(system.whitened_residuals[:n_observations]) / scale))
        design = weight_rows(system.design, root)
        try:
            step = FactorisedNormals(BlockSystem(design, system.whitened_residuals * root, system.n_retained)).step()
        except SingularSystemError:
            break
        state, length = problem.retract(state, step), float(np.sum((design @ step) ** 2))
        del system, design  # free the memory before the next step
        if length < SQUARED_ROBUST_STEP_TOLERANCE:
            break
    return state, problem.whitened_residuals(state)


NoiseGrouping = Literal["observable", "instrument"]
"""Grouping of readings for the estimation of noise: one group per observable, or per observable and instrument."""
GROUP_NOISE_FACTOR_TOLERANCE = 2e-3
"""Relative change of the noise factors of groups of readings at which their iteration ends: a tenth of the standard
deviation of a factor that is estimated from 1,250 readings."""
MIN_GROUP_REDUNDANCY = 3.0
"""Smallest sum of redundancy numbers of a group of readings whose noise is estimated; other groups keep their declared
noise."""


@dataclass(frozen=True)
class VarianceComponent:
    """Estimated noise of one group of readings."""

    observable: str
    """Name of the observable of the group; ``level`` for the group of all levels."""
    instrument: str
    """Name of the instrument of the group; '' if all instruments are one group."""
    noise_factor: float
    """Estimated factor on the declared standard deviations of the group."""
    noise_factor_sigma: float
    """Standard deviation of `noise_factor`; infinite if it could not be estimated."""
    redundancy: float
    """Sum of the redundancy numbers of the group's readings."""


def estimate_variance_components(
    problem: NetworkProblem,
    solution: Solution[NetworkState],
    grouping: NoiseGrouping,
    reject_outliers: Callable[[NetworkProblem, NetworkState], tuple[NetworkProblem, Solution[NetworkState]]],
    reading_mask: Bools | None = None,
) -> tuple[NetworkProblem, Solution[NetworkState], tuple[VarianceComponent, ...]]:
    """Problem with standard deviations scaled by group to agree with the residuals, its solution, and the estimates.

    `reject_outliers` is a function that solves a problem and may reject readings. It is called with the new noise and
    all readings that `reading_mask` (n, 3) selects, until the set of rejected readings does not change.

    References
    ----------
    Foerstner, Ein Verfahren zur Schaetzung von Varianz- und Kovarianzkomponenten, AVN 86 (1979) 446: the variance
    factor of a group is its weighted sum of squares divided by its redundancy, iterated until it is one. The limit is
    the restricted maximum likelihood estimate (Helmert's estimate).
    """
    recording, several = problem.model.recording, grouping == "instrument"
    group = np.arange(3) + 3 * several * recording.instrument[:, None]
    names = recording.instruments if several else ("",)
    factor, redundancy = np.ones(3 * len(names) + 1), np.zeros(3 * len(names) + 1)
    declared, available = problem, problem.is_used_reading if reading_mask is None else reading_mask
    for _ in range(MAX_DECISION_CHANGES):
        last_change, last_step = np.zeros(len(factor)), np.zeros(len(factor))
        for _ in range(MAX_ITERATIONS):
            if solution.factor is None:
                return problem, solution, ()
            square, redundancy = _sums_by_group(problem, solution, group, len(factor))
            enough = redundancy > MIN_GROUP_REDUNDANCY
            change = np.where(enough, np.sqrt(square / np.where(enough, redundancy, 1.0)), 1.0)
            log_change = np.log(np.maximum(change, 0.1))
            last_change, last_step = log_change, _secant_step(log_change, last_change, last_step)
            factor = factor * np.exp(last_step)
            problem = _scale_sigmas(declared, factor, group, problem.is_used_reading)
            solution = solve(problem, solution.x)
            if np.max(np.abs(change - 1.0)) < GROUP_NOISE_FACTOR_TOLERANCE:
                break
        before = problem.is_used_reading
        problem, solution = reject_outliers(_scale_sigmas(declared, factor, group, available), solution.x)
        if np.array_equal(problem.is_used_reading, before):
            break
    sigma = np.where(
        redundancy > MIN_GROUP_REDUNDANCY, factor / np.sqrt(2 * np.maximum(redundancy, MIN_GROUP_REDUNDANCY)), np.inf
    )
    kinds = [(observable, name) for name in names for observable in OBSERVABLES]
    kinds += [("level", "")] if len(problem.level_rows) else []
    component_rows = zip(kinds, factor.tolist(), sigma.tolist(), redundancy.tolist(), strict=False)
    return problem, solution, tuple(VarianceComponent(*kind, *numbers) for kind, *numbers in component_rows)


def converged_variance_components(problem: NetworkProblem, state: NetworkState) -> tuple[VarianceComponent, ...]:
    """Noise of each observable, estimated with weights that agree with this noise; empty without redundancy.

    If the user declares the noise with these factors, the next adjustment confirms it. One step from the declared noise
    is not sufficient, because wrong weights distribute the misfit among the observables in a wrong way. The readings in
    use do not change.
    """

    def solve_with_same_readings(
        scaled_problem: NetworkProblem, start_state: NetworkState
    ) -> tuple[NetworkProblem, Solution[NetworkState]]:
        """Unchanged problem with scaled standard deviations, and its solution, without a search for outliers."""
        return scaled_problem, solve(scaled_problem, start_state)

    return estimate_variance_components(problem, solve(problem, state), "observable", solve_with_same_readings)[2]


def _secant_step(change: Floats, last_change: Floats, last_step: Floats) -> Floats:
    """Steps (g,) of g fixed-point iterations towards their limits, by the secant method.

    `change` (g,) are the changes of the values by one fixed-point iteration at the present values, `last_change` (g,)
    those at the previous values, and `last_step` (g,) the steps from previous to present values. If `last_step` is 0,
    the step is `change`.
    """
    slope = np.divide(change - last_change, last_step, out=np.full_like(change, -1.0), where=last_step != 0.0)
    return change / (1.0 - np.clip(1.0 + slope, 0.0, MAX_CONVERGENCE_RATIO))


def _scale_sigmas(problem: NetworkProblem, factor: Floats, group_indices: Ints, reading_mask: Bools) -> NetworkProblem:
    """Problem with the readings that `reading_mask` (n, 3) selects, whose noise is multiplied by group factors.

    `group_indices` (n, 3) is the group of each reading of n pointings, `factor` (g,) the factor on the standard
    deviations of each of g groups. The last group is that of the levels.
    """
    levels = replace(problem.level_rows, tilt_sigmas=problem.level_rows.tilt_sigmas * factor[-1])
    return replace(
        problem,
        reading_sigmas=problem.reading_sigmas * factor[group_indices],
        level_rows=levels,
        is_used_reading=reading_mask,
    )


def _sums_by_group(
    problem: NetworkProblem, solution: Solution[NetworkState], group_indices: Ints, n_groups: int
) -> tuple[Floats, Floats]:
    """Weighted sums of squared residuals (g,), and of redundancy numbers (g,), of g groups; the last is the levels."""
    assert solution.factor is not None
    share = 1.0 - solution.factor.leverage()
    residual = problem.whitened_residuals(solution.x)
    readings, rows = slice(0, int(problem.is_used_reading.sum())), problem.level_row_slice
    square, redundancy = (
        np.bincount(group_indices[problem.is_used_reading], values[readings], n_groups)
        for values in (residual**2, share)
    )
    square[-1], redundancy[-1] = float(np.sum(residual[rows] ** 2)), float(np.sum(share[rows]))
    return square.astype(np.float64), redundancy.astype(np.float64)
