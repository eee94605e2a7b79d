"""What the readings in use do not place: such targets are left out, such a station is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ltsim.adjustment.problem import NetworkProblem
from ltsim.arrays import Bools
from ltsim.geometry.rigid import holds_pose
from ltsim.model.measurement import State
from ltsim.solve.rank import POINT


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
        problem = replace(problem, gauge=gauge.without(idle))
        problem = problem.using(problem.use & ~loose[problem.model.recording.target][:, None])


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
    np.add.at(normal, control.target, np.swapaxes(control.root, 1, 2) @ control.root)
    normal[problem.structure.flat, 2, 2] += np.trace(normal[problem.structure.flat], axis1=1, axis2=2)
    spread = np.linalg.eigvalsh(normal)
    return doubtful & (spread[:, 0] <= POINT * spread[:, 2])


def poseless(problem: NetworkProblem, state: State) -> str:
    """A sentence: a station whose targets leave its pose open, as geometry alone decides; empty where there is none.

    Set-ups over marks and stations without readings are not asked.
    """
    recording, marks = problem.model.recording, problem.marks
    seen = np.zeros((len(recording.stations), len(recording.targets)), dtype=bool)
    used = problem.use.any(axis=1)
    seen[recording.station[used], recording.target[used]] = True
    vertical = np.full((len(seen), 3), np.nan)
    vertical[problem.levels.station] = problem.levels.vertical
    free = np.array([not name for name in marks.names]) & seen.any(axis=1)
    few = np.flatnonzero(free & ~holds_pose(state.points, seen, vertical))
    if not len(few):
        return ""
    levelled = few[0] in problem.levels.station
    what = "two targets that are not above one another" if levelled else "three targets off one line"
    return f"station {recording.stations[few[0]]} sees fewer than {what}; a pose needs them"
