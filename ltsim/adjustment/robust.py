"""A robust state of a network: all observations reweighted, reference values as well as readings."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from ltsim.adjustment.problem import NetworkProblem
from ltsim.core.arrays import Floats
from ltsim.physics.model.measurement import State
from ltsim.solve.blocks import BlockFactor, BlockSystem, SingularSystemError
from ltsim.solve.design import Design, median_deviation

HUBER = 2.0
"""Residual, in robust standard deviations, up to which an observation has its full weight (Huber 1964)."""
STEPS = 25
STILL = 1e-2
"""Squared length of a step, in standard deviations, after which the state moves no more."""


def observations(problem: NetworkProblem) -> int:
    """Number of rows that are observations: readings, then reference values; what follows holds or regularises."""
    return problem.level_rows.stop + len(problem.yaws)


def robust_state(problem: NetworkProblem, state: State) -> tuple[State, Floats]:
    """State by iteratively reweighted least squares with Huber's weights, and the whitened residuals (m,) there."""
    count = observations(problem)
    reading = int(problem.use.sum())
    residual = problem.residual(state)
    for _ in range(STEPS):
        scale = max(median_deviation(residual[:reading]), 1.0)
        weight = np.ones(len(residual))
        weight[:count] = np.sqrt(1.0 / np.maximum(np.abs(residual[:count]) / (HUBER * scale), 1.0))
        system = problem.linearise(state)
        weighted = _weighted(system.design, weight)
        try:
            step = BlockFactor(BlockSystem(weighted, system.residual * weight, system.n_reduced)).step()
        except SingularSystemError:
            break
        state = problem.retract(state, step)
        residual = problem.residual(state)
        if float(np.sum((weighted @ step) ** 2)) < STILL:
            break
    return state, residual


def _weighted(design: Design, weight: Floats) -> Design:
    """A design with its rows times weights (m,)."""
    if isinstance(design, np.ndarray):
        return np.asarray(design * weight[:, None])
    return sp.csr_array(design.multiply(weight[:, None]))
