"""From the frame of the set-up to that of the network: an adjustment without control stands in its first station.

Directions that a person states (where the open face of a nest looks) belong to the floor plan. Rough positions and yaws
of the stations are enough to turn them: a degree of error changes an incidence by a degree.
"""

from __future__ import annotations

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import NetworkError
from ltsim.geometry.alignment import align
from ltsim.geometry.rotations import about_z, smallest_turn
from ltsim.recording.recording import Recording
from ltsim.units import DEGREE, MILLIMETRE

UPRIGHT = 5 * DEGREE
"""How far the axes of instruments on tripods part, as seen in the length of their mean."""
ROUGH = 3 * DEGREE
"""How well a floor plan knows directions: frames that agree so well are one frame."""


def plan_rotation(recording: Recording, position: Floats, rotation: Floats) -> Floats:
    """Rotation (3, 3) from the set-up's frame to the network's.

    The stations' rough positions (three or more, off one line) say it; otherwise their yaws. With control points both
    frames are one, and nothing better is known where the set-up is silent: then it is the identity.

    Parameters
    ----------
    recording : Recording
    position : (S, 3) float, [m]
    rotation : (S, 3, 3) float
        Instrument frame to network frame.
    """
    if any(recording.target_setup(name).known_mm is not None for name in recording.targets):
        return np.eye(3)
    setups = [recording.station_setup(name) for name in recording.stations]
    turn = _by_positions([s.position_mm for s in setups], position, rotation)
    if turn is None:
        turn = _by_yaws([s.yaw_deg for s in setups], rotation)
    if turn is None or np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0)) < ROUGH:
        return np.eye(3)
    return turn


def _by_positions(stated: list[tuple[float, float, float] | None], position: Floats, rotation: Floats) -> Floats | None:
    """By the rough places of three or more stations; upright instruments know the vertical far better than these."""
    known = [i for i, p in enumerate(stated) if p is not None]
    if len(known) < 3:
        return None
    plan = np.array([stated[i] for i in known], dtype=np.float64) * MILLIMETRE
    axis = rotation[known, :, 2].mean(axis=0)
    level, here = np.eye(3), position[known]
    if np.linalg.norm(axis) > np.cos(UPRIGHT):
        level = smallest_turn(axis / np.linalg.norm(axis), np.array([0.0, 0.0, 1.0]))
        here, plan = here @ level.T * [1.0, 1.0, 0.0], plan * [1.0, 1.0, 0.0]
    try:
        turn, _ = align(plan, here)
    except NetworkError:
        return None
    return level.T @ turn


def _by_yaws(stated: list[float | None], rotation: Floats) -> Floats | None:
    """Mean of the rotations that upright stations with these yaws ask for."""
    asked = [r @ about_z(yaw * DEGREE).T for yaw, r in zip(stated, rotation, strict=True) if yaw is not None]
    if not asked:
        return None
    left, _, right = np.linalg.svd(np.sum(asked, axis=0))
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
