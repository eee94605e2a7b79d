"""Robust adjustment: single readings that do not belong are left out, and taken back where they do belong after all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ltsim.adjustment.loose import without_loose
from ltsim.adjustment.problem import NetworkProblem
from ltsim.adjustment.reliability import FAMILY_LEVEL, UNCHECKED, critical_w, normalised, redundancy_of, scale_of
from ltsim.arrays import Bools
from ltsim.model.measurement import State
from ltsim.solve.blocks import Factor, SingularSystemError
from ltsim.solve.design import as_dense
from ltsim.solve.gauss_newton import Solution, solve
from ltsim.solve.robust import median_deviation

HUBER = 2.0
RELAXATIONS = 8
ROUNDS = 20


def snooped(
    problem: NetworkProblem, state: State, level: float = FAMILY_LEVEL
) -> tuple[NetworkProblem, Solution[State]]:
    """The problem without its outliers, and its solution.

    Reweighting (Huber) finds a network that many outliers together do not bend; readings that it rejects are left
    out; then the usual snooping goes on, and whatever was left out is tested again against the network without it.

    Parameters
    ----------
    problem : NetworkProblem
        With every reading in `use` that may be used.
    state : State
        Near the solution.
    level : float
        Chance that a clean recording loses any reading.
    """
    state = _relaxed(problem, state)
    try:
        factor = Factor(problem.linearise(state))
    except SingularSystemError:
        return problem, solve(problem, state)
    limit = critical_w(int(problem.use.sum()), level)
    rejected = _doubtful(problem, state, factor, limit)
    seen: set[bytes] = set()
    while True:
        kept = without_loose(problem.using(problem.use & ~rejected), state)
        solution = solve(kept, state)
        if solution.factor is None:  # Too much at once: what is left does not hold the network.
            rejected = _half(problem, state, rejected)
            continue
        state = solution.x
        seen.add(rejected.tobytes())
        new = _retested(problem, kept, solution, rejected, limit)
        if np.array_equal(new, rejected):
            return kept, solution
        if new.tobytes() in seen or len(seen) == ROUNDS:  # On the edge: what is out in either stays out.
            last = without_loose(problem.using(problem.use & ~(new | rejected)), state)
            ended = solve(last, state)
            return (kept, solution) if ended.factor is None else (last, ended)
        rejected = new


def _relaxed(problem: NetworkProblem, state: State) -> State:
    """The state after a few steps of reweighted least squares; as it was where that is singular."""
    for _ in range(RELAXATIONS):
        whitened = np.abs(problem.residuals(problem.model.predict(state)) / problem.sigma)
        scale = max(median_deviation(whitened[problem.use]), 1e-3)
        loose = np.sqrt(np.maximum(np.nan_to_num(whitened) / (HUBER * scale), 1.0))
        try:
            system = replace(problem, sigma=problem.sigma * loose).linearise(state)
            step = Factor(system).step()
        except SingularSystemError:
            return state
        state = problem.retract(state, step)
        if np.sum((system.design @ step) ** 2) < 1e-2:
            break
    return state


def _doubtful(problem: NetworkProblem, state: State, factor: Factor, limit: float) -> Bools:
    """Readings (n, 3) far off the relaxed network that others check."""
    redundancy = redundancy_of(problem, factor)
    w = normalised(problem, problem.residuals(problem.model.predict(state)), redundancy)
    return np.nan_to_num(np.abs(w)) > limit * scale_of(w, redundancy)


def _half(problem: NetworkProblem, state: State, rejected: Bools) -> Bools:
    """The half of the rejected readings (n, 3) with the larger residuals; at last none."""
    whitened = np.abs(problem.residuals(problem.model.predict(state)) / problem.sigma)
    size = np.where(rejected, np.nan_to_num(whitened), -1.0)
    half = np.zeros_like(rejected)
    half.flat[np.argsort(-size, axis=None)[: int(rejected.sum()) // 2]] = True
    return half


def _retested(
    problem: NetworkProblem, kept: NetworkProblem, solution: Solution[State], rejected: Bools, limit: float
) -> Bools:
    """Rejected readings (n, 3) anew: those left out that still do not fit, and kept ones that now do not."""
    assert solution.factor is not None
    redundancy = redundancy_of(kept, solution.factor)
    residuals = problem.residuals(problem.model.predict(solution.x))
    w = normalised(kept, residuals, redundancy)
    scale = scale_of(w, redundancy)
    new: Bools = (np.nan_to_num(np.abs(w)) > limit * scale) & (redundancy > UNCHECKED)
    if new.any():
        most = np.nan_to_num(np.abs(w)).max()
        new &= np.nan_to_num(np.abs(w)) > 0.5 * most
    out = np.flatnonzero(rejected[problem.use])
    if len(out):
        rows = as_dense(problem.linearise(solution.x).design[out])
        response = solution.factor.covariance_columns(np.ascontiguousarray(rows.T))
        spread = np.sqrt(1.0 + np.maximum(np.sum(rows * response.T, axis=1), 0.0))
        miss = np.abs((residuals / problem.sigma)[rejected & problem.use]) / spread
        still = np.zeros_like(rejected)
        still[rejected & problem.use] = miss > limit * scale
        # A target that is left out by now cannot speak for its readings.
        new |= still | (rejected & kept.unseen_targets[problem.model.recording.target][:, None])
    return new
