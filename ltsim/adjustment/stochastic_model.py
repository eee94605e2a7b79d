"""Stochastic model of a network: robust weights of all observations, variance components of groups of readings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from ltsim.adjustment.problem import NetworkProblem
from ltsim.adjustment.significance import FAR
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.physics.model.measurement import NetworkState
from ltsim.recordings.recording import OBSERVABLES
from ltsim.solve.design import median_deviation, weighted
from ltsim.solve.elimination import BlockFactor, BlockSystem, SingularSystemError
from ltsim.solve.gauss_newton import Solution, solve

HUBER = 2.0
CAUCHY = 2.385
"""Residuals, in robust standard deviations, above which Huber's weights decrease, and at which Cauchy's weights are one
half; the efficiencies for normal residuals are 97 and 95 %.
"""
MANY = 0.02
"""Fraction of readings with residuals above `FAR` declared standard deviations above which they are many."""
STEPS = 25
"""Reweightings at most, each with a linear step."""
STILL = 1e-2
"""Squared length of a step, in standard deviations, below which the iteration has converged."""


def observations(problem: NetworkProblem) -> int:
    """Number of rows that are observations (readings, then reference values); later rows are constraints and priors."""
    return problem.level_rows.stop + len(problem.yaws)


def robust_state(problem: NetworkProblem, state: NetworkState) -> tuple[NetworkState, Floats]:
    """State with robust weights of all observations, and the whitened residuals (m,) there; see `reweighted`."""
    return reweighted(problem, state, observations(problem), least=1.0, steps=STEPS)


def reweighted(
    problem: NetworkProblem, state: NetworkState, count: int, *, least: float, steps: int
) -> tuple[NetworkState, Floats]:
    """State by iteratively reweighted least squares, and the whitened residuals (m,) there.

    Huber's weights are used, which permit a poor start; if many residuals are then large, also Cauchy's, which retain a
    good start although many readings of one place contradict it.

    Parameters
    ----------
    problem : NetworkProblem
    state : State
    count : int
        Number of rows (the first ones) that are reweighted.
    least : float
        Lower bound of the robust standard deviation of the whitened residuals.
    steps : int
        Largest number of steps.
    """
    search, reading = partial(_searched, problem, state, count, least, steps), int(problem.use.sum())
    ends = [search(huber_weights)]
    if are_many_far(ends[0][1][:reading]):
        ends.append(search(cauchy_weights))
    return ends[better_end([residual[:reading] for _, residual in ends])]


def are_many_far(whitened: Floats) -> bool:
    """True if more whitened residuals (m,) are large than single errors of a recording can explain."""
    return bool(np.mean(np.abs(whitened) > FAR) > MANY)


def better_end(ends: Sequence[Floats]) -> int:
    """Index of the whitened residuals (m,) with the smallest Cauchy objective at a common scale."""
    scale = max(min(median_deviation(whitened) for whitened in ends), 1.0)
    return int(np.argmin([np.sum(np.log1p((whitened / (CAUCHY * scale)) ** 2)) for whitened in ends]))


def huber_weights(size: Floats) -> Floats:
    """Huber's weights (1964) of residuals in robust standard deviations."""
    return 1.0 / np.maximum(size / HUBER, 1.0)


def cauchy_weights(size: Floats) -> Floats:
    """Cauchy's weights (Holland and Welsch 1977) of residuals in robust standard deviations."""
    return 1.0 / (1.0 + (size / CAUCHY) ** 2)


def _searched(
    problem: NetworkProblem,
    state: NetworkState,
    count: int,
    least: float,
    steps: int,
    weights: Callable[[Floats], Floats],
) -> tuple[NetworkState, Floats]:
    """State with one kind of weights, and the whitened residuals (m,).

    The scale of the residuals never increases: otherwise a large error would gain weight by distorting the network
    (Huber 1981, Robust statistics, section 7.8: with a fixed scale each step lowers the objective).
    """
    reading, scale = int(problem.use.sum()), np.inf
    for _ in range(steps):
        system = problem.linearise(state)
        scale = min(scale, max(median_deviation(system.residual[:reading]), least))
        root = np.ones(len(system.residual))
        root[:count] = np.sqrt(weights(np.abs(system.residual[:count]) / scale))
        design = weighted(system.design, root)
        try:
            step = BlockFactor(BlockSystem(design, system.residual * root, system.n_reduced)).step()
        except SingularSystemError:
            break
        state, length = problem.retract(state, step), float(np.sum((design @ step) ** 2))
        del system, design  # before the next ones take as much memory
        if length < STILL:
            break
    return state, problem.residual(state)


Grouping = Literal["observable", "instrument"]
CLOSE = 2e-3
"""Relative change of variance factors that ends their estimation: a tenth of the standard deviation of one from 1,250
readings."""
PASSES = 30
"""Estimates of the variance factors at most, for given outliers."""
ROUNDS = 6
"""Estimates of outliers at most, for given variance factors: they alternate on the edge."""
LEAST = 3.0
"""Redundancy below which a group keeps its declared noise."""


@dataclass(frozen=True)
class Component:
    """Variance component: noise of one group of readings."""

    observable: str
    """Name of the observable, or ``level``."""
    instrument: str
    """Name of the instrument; '' if all instruments are one group."""
    factor: float
    """Factor on the declared standard deviations."""
    sigma: float
    """Standard deviation of `factor`; infinite if it could not be estimated."""
    redundancy: float
    """Sum of the redundancy numbers of the group's readings."""


def estimated_components(
    problem: NetworkProblem,
    solution: Solution[NetworkState],
    grouping: Grouping,
    find: Callable[[NetworkProblem, NetworkState], tuple[NetworkProblem, Solution[NetworkState]]],
    use: Bools | None = None,
) -> tuple[NetworkProblem, Solution[NetworkState], tuple[Component, ...]]:
    """Problem with standard deviations scaled by group until each agrees with its residuals; its solution.

    `find` solves a problem and may reject readings; it gets all readings of `use` (n, 3) again with the new noise,
    until the rejected ones do not change.

    References
    ----------
    Foerstner, Ein Verfahren zur Schaetzung von Varianz- und Kovarianzkomponenten, AVN 86 (1979) 446: the variance of
    a group is its weighted sum of squares over its redundancy, iterated to one. Where it converges it is the
    maximum likelihood of the residuals (Helmert's estimate).
    """
    recording, several = problem.model.recording, grouping == "instrument"
    group = np.arange(3) + 3 * several * recording.instrument[:, None]
    names = recording.instruments if several else ("",)
    factor, redundancy = np.ones(3 * len(names) + 1), np.zeros(3 * len(names) + 1)
    declared, available = problem, problem.use if use is None else use
    for _ in range(ROUNDS):
        for _ in range(PASSES):
            if solution.factor is None:
                return problem, solution, ()
            square, redundancy = _sums(problem, solution, group, len(factor))
            enough = redundancy > LEAST
            change = np.where(enough, np.sqrt(square / np.where(enough, redundancy, 1.0)), 1.0)
            factor = factor * np.maximum(change, 0.1)
            problem = _scaled(declared, factor, group, problem.use)
            solution = solve(problem, solution.x)
            if np.max(np.abs(change - 1.0)) < CLOSE:
                break
        before = problem.use
        problem, solution = find(_scaled(declared, factor, group, available), solution.x)
        if np.array_equal(problem.use, before):
            break
    sigma = np.where(redundancy > LEAST, factor / np.sqrt(2 * np.maximum(redundancy, LEAST)), np.inf)
    kinds = [(observable, name) for name in names for observable in OBSERVABLES]
    kinds += [("level", "")] if len(problem.levels) else []
    rows = zip(kinds, factor.tolist(), sigma.tolist(), redundancy.tolist(), strict=False)
    return problem, solution, tuple(Component(*kind, *numbers) for kind, *numbers in rows)


def _scaled(declared: NetworkProblem, factor: Floats, group: Ints, use: Bools) -> NetworkProblem:
    """Problem with other standard deviations: a factor for each group, the last for the levels."""
    levels = replace(declared.levels, sigma=declared.levels.sigma * factor[-1])
    return replace(declared, sigma=declared.sigma * factor[group], levels=levels, use=use)


def _sums(problem: NetworkProblem, solution: Solution[NetworkState], group: Ints, count: int) -> tuple[Floats, Floats]:
    """Weighted sum of squares (count,) and redundancy (count,) of each group; the levels are last."""
    assert solution.factor is not None
    share = 1.0 - solution.factor.leverage()
    residual = problem.residual(solution.x)
    readings, rows = slice(0, int(problem.use.sum())), problem.level_rows
    square, redundancy = (np.bincount(group[problem.use], values[readings], count) for values in (residual**2, share))
    square[-1], redundancy[-1] = float(np.sum(residual[rows] ** 2)), float(np.sum(share[rows]))
    return square.astype(np.float64), redundancy.astype(np.float64)
