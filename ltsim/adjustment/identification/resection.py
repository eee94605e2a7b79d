"""Resection of set-ups from two of three observables, if most of their readings contradict the network.

Ranges with a common offset or scale error displace a set-up, so that its angles have large residuals too. Elevations
with a wrong vertical index tilt a set-up, so that all its readings have large residuals. A pose from the other two
observables does not have these errors.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ltsim.adjustment.fit_readings import FitReadings
from ltsim.adjustment.fitting import fit_pose
from ltsim.adjustment.problem import NetworkProblem
from ltsim.adjustment.significance import MIN_FAULTY_FRACTION_OF_GROUP, MIN_SIGMAS_BEYOND_NOISE
from ltsim.adjustment.snooping import absolute_whitened_residuals
from ltsim.core.arrays import Bools, group_rows
from ltsim.physics.model.measurement import NetworkState
from ltsim.recordings.recording import OBSERVABLES
from ltsim.solve.design import robust_sigma


def resect_contradicted_setups(problem: NetworkProblem, state: NetworkState) -> NetworkState:
    """State in which set-ups with mostly large residuals get a new pose, resected from two of their three observables.

    A pose is replaced only if the set-up then has fewer readings with large residuals, above `MIN_SIGMAS_BEYOND_NOISE`
    robust standard deviations.
    """
    recording, far = problem.model.recording, _large_residual_mask(problem, state)
    if not far.any() or far[problem.is_used_reading].mean() > MIN_FAULTY_FRACTION_OF_GROUP:
        return state
    whole, now = FitReadings.from_recording(recording), far
    for station, rows in group_rows(recording.station, np.flatnonzero(problem.is_used_reading.any(axis=1))):
        if (
            problem.marks.target_indices[station] >= 0
            or far[rows][problem.is_used_reading[rows]].mean() <= MIN_FAULTY_FRACTION_OF_GROUP
        ):
            continue
        sight = whole.select_rows(rows)
        for observable in range(len(OBSERVABLES)):
            pose = fit_pose(sight.without_observable(observable), state.target_points[recording.target[rows]])
            if pose is None:
                continue
            position, rotation = state.station_positions.copy(), state.station_rotations.copy()
            position[station], rotation[station] = pose
            moved = replace(state, station_positions=position, station_rotations=rotation)
            then = _large_residual_mask(problem, moved)
            if then[rows].sum() < now[rows].sum():
                state, now = moved, then
    return state


def _large_residual_mask(problem: NetworkProblem, state: NetworkState) -> Bools:
    """Flags (n, 3) of n pointings, True for used readings with large residuals.

    Large residuals exceed `MIN_SIGMAS_BEYOND_NOISE` robust standard deviations.
    """
    whitened_residual = absolute_whitened_residuals(problem, state)
    scale = max(robust_sigma(whitened_residual[problem.is_used_reading]), 1.0)
    return np.asarray(problem.is_used_reading & (whitened_residual > MIN_SIGMAS_BEYOND_NOISE * scale))
