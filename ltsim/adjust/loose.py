"""Targets that the readings in use do not place: they are left out, and the rest of the network is adjusted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ltsim.adjust.problem import NetworkProblem
from ltsim.arrays import Bools
from ltsim.model.measurement import State
from ltsim.solve.rank import FORMED


def without_loose(problem: NetworkProblem, state: State) -> NetworkProblem:
    """The problem without the readings and known lengths of targets that they do not determine.

    A length to such a target keeps its row, without weight.
    """
    while True:
        loose = loose_targets(problem, state)
        gauge = problem.gauge
        reached = problem.unseen_targets | loose
        idle = (reached[gauge.first] | reached[gauge.second]) & np.isfinite(gauge.sigma)
        if not loose.any() and not idle.any():
            return problem
        problem = replace(
            problem,
            use=problem.use & ~loose[problem.model.recording.target][:, None],
            gauge=replace(gauge, sigma=np.where(idle, np.inf, gauge.sigma)),
        )


def loose_targets(problem: NetworkProblem, state: State) -> Bools:
    """(T,) True for targets with readings in use that leave a direction of them open, stations taken as known."""
    recording, count = problem.model.recording, len(problem.model.recording.targets)
    whole = np.bincount(recording.target, problem.use.all(axis=1), count) > 0
    doubtful = ~whole & ~problem.unseen_targets
    doubtful[problem.marks.target[problem.marks.target >= 0]] = False
    if not doubtful.any():
        return doubtful
    weighted = np.where(problem.use, 1.0 / problem.sigma, 0.0)[:, :, None]
    rows = np.where(problem.use[:, :, None], problem.model.linearised(state).by_target * weighted, 0.0)
    normal = np.zeros((count, 3, 3))
    np.add.at(normal, recording.target, np.swapaxes(rows, 1, 2) @ rows)
    gauge, control = problem.gauge, problem.control
    along = gauge.directions(state.points) / gauge.sigma[:, None]
    for end in (gauge.first, gauge.second):
        np.add.at(normal, end, along[:, :, None] * along[:, None, :])
    at, axis = np.nonzero(control.axes)
    np.add.at(normal, (control.target[at], axis, axis), control.weights()[:, 0] ** 2)
    spread = np.linalg.eigvalsh(normal)
    loose: Bools = doubtful & (spread[:, 0] <= FORMED * spread[:, 2])
    return loose
