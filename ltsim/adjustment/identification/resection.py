"""Resection: set-ups of which most readings contradict the network, placed anew without one of their observables.

Ranges that are wrong by the same amount, or in the same ratio, displace a set-up, and all its angles then look as wrong
as its ranges; elevations with a wrong index tilt it, and all its readings look wrong.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ltsim.adjustment.fitting import fit_pose
from ltsim.adjustment.problem import NetworkProblem
from ltsim.adjustment.sight import Sight
from ltsim.adjustment.significance import FAR, MAJORITY
from ltsim.adjustment.snooping import whitened_readings
from ltsim.core.arrays import Bools, grouped
from ltsim.physics.model.measurement import State
from ltsim.recordings.recording import OBSERVABLES
from ltsim.solve.design import median_deviation


def resected(problem: NetworkProblem, state: State) -> State:
    """State in which set-ups with mostly far residuals stand where two of their observables say, if these are near."""
    recording, far = problem.model.recording, _far(problem, state)
    if not far.any() or far[problem.use].mean() > MAJORITY:
        return state
    whole, now = Sight.of(recording), far
    for station, rows in grouped(recording.station, np.flatnonzero(problem.use.any(axis=1))):
        if problem.marks.target[station] >= 0 or far[rows][problem.use[rows]].mean() <= MAJORITY:
            continue
        sight = whole.at(rows)
        for observable in range(len(OBSERVABLES)):
            pose = fit_pose(sight.without(observable), state.points[recording.target[rows]])
            if pose is None:
                continue
            position, rotation = state.position.copy(), state.rotation.copy()
            position[station], rotation[station] = pose
            moved = replace(state, position=position, rotation=rotation)
            then = _far(problem, moved)
            if then[rows].sum() < now[rows].sum():
                state, now = moved, then
    return state


def _far(problem: NetworkProblem, state: State) -> Bools:
    """Readings (n, 3) in use with far residuals."""
    whitened = whitened_readings(problem, state)
    scale = max(median_deviation(whitened[problem.use]), 1.0)
    return np.asarray(problem.use & (whitened > FAR * scale))
