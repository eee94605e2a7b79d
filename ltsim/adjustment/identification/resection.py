"""Resection of set-ups whose readings mostly contradict the network, without one of their observables.

Ranges with a common offset or scale error displace a set-up, so that its angles have large residuals too; elevations
with a wrong index tilt it, so that all its readings have large residuals.
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
from ltsim.physics.model.measurement import NetworkState
from ltsim.recordings.recording import OBSERVABLES
from ltsim.solve.design import median_deviation


def resected(problem: NetworkProblem, state: NetworkState) -> NetworkState:
    """State in which set-ups with mostly far residuals are resected from two of their observables.

    The results must be near.
    """
    recording, far = problem.model.recording, _far(problem, state)
    if not far.any() or far[problem.use].mean() > MAJORITY:
        return state
    whole, now = Sight.of(recording), far
    for station, rows in grouped(recording.station, np.flatnonzero(problem.use.any(axis=1))):
        if problem.marks.target[station] >= 0 or far[rows][problem.use[rows]].mean() <= MAJORITY:
            continue
        sight = whole.at(rows)
        for observable in range(len(OBSERVABLES)):
            pose = fit_pose(sight.without(observable), state.target_points[recording.target[rows]])
            if pose is None:
                continue
            position, rotation = state.station_positions.copy(), state.station_rotations.copy()
            position[station], rotation[station] = pose
            moved = replace(state, station_positions=position, station_rotations=rotation)
            then = _far(problem, moved)
            if then[rows].sum() < now[rows].sum():
                state, now = moved, then
    return state


def _far(problem: NetworkProblem, state: NetworkState) -> Bools:
    """Flags (n, 3) of the used readings with far residuals."""
    whitened = whitened_readings(problem, state)
    scale = max(median_deviation(whitened[problem.use]), 1.0)
    return np.asarray(problem.use & (whitened > FAR * scale))
