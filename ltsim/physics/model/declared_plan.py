"""Floor plan that a set-up declares (approximate station poses), and its rotation to the network frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.errors import NetworkError
from ltsim.core.units import DEGREE, MILLIMETRE
from ltsim.geometry.rigid import VERTICAL, align_rigidly, rotation_about_z, smallest_rotation
from ltsim.recordings.recording import Recording

MAX_STANDING_AXIS_SPREAD = 5 * DEGREE
"""Largest angle [rad] between a standing axis and the mean of all standing axes of upright instruments."""
MIN_PLAN_POSITIONS = 3
"""Smallest number of approximate station positions that determine the rotation from the floor plan to the network."""
PLAN_DIRECTION_SIGMA = 3 * DEGREE
"""Standard deviation [rad] of directions on a floor plan. A smaller rotation between floor plan and network frame is
neglected."""


@dataclass(frozen=True, eq=False)
class DeclaredPlan:
    """Floor plan that a set-up declares: approximate positions of k of its S stations, and approximate yaws."""

    has_control_points: bool
    """True if a target has known coordinates. The frame of the floor plan is then the network frame."""
    placed_station_indices: list[int]
    """Indices (k,) of the stations whose approximate position is declared."""
    placed_station_positions: Floats
    """Approximate positions (k, 3) [m] of the stations in `placed_station_indices`."""
    station_yaws: tuple[float | None, ...]
    """Approximate yaw [deg] of each of the S stations: rotation about the vertical from the x axis of the floor plan,
    counter-clockwise seen from above. None for a station without a declared yaw."""

    @classmethod
    def from_recording(cls, recording: Recording) -> DeclaredPlan:
        """Floor plan that the set-up of a recording declares."""
        setups = [recording.station_setup(name) for name in recording.stations]
        places = [setup.position_mm for setup in setups]
        return cls(
            has_control_points=any(recording.target_setup(name).known_mm is not None for name in recording.targets),
            placed_station_indices=[i for i, place in enumerate(places) if place is not None],
            placed_station_positions=np.array([place for place in places if place is not None]).reshape(-1, 3)
            * MILLIMETRE,
            station_yaws=tuple(setup.yaw_deg for setup in setups),
        )

    @property
    def determines_rotation(self) -> bool:
        """True if the floor plan determines its rotation to the network frame."""
        is_placed = len(self.placed_station_indices) >= MIN_PLAN_POSITIONS
        return self.has_control_points or is_placed or any(yaw is not None for yaw in self.station_yaws)

    def rotation_to_network(self, station_positions: Floats, station_rotations: Floats) -> Floats:
        """Rotation matrix (3, 3) from the frame of the floor plan to the network frame.

        The rotation follows from the approximate positions of three or more stations that are not collinear, otherwise
        from the yaws. The result is the identity for a set-up with control points, and for one without positions and
        yaws. `station_positions` (S, 3) [m] and `station_rotations` (S, 3, 3) are the poses in the network frame.
        """
        if self.has_control_points:
            return np.eye(3)
        turn = self._rotation_from_positions(station_positions, station_rotations)
        if turn is None:
            turn = self._rotation_from_yaws(station_rotations)
        if turn is None or np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0)) < PLAN_DIRECTION_SIGMA:
            return np.eye(3)
        return turn

    def _rotation_from_positions(self, station_positions: Floats, station_rotations: Floats) -> Floats | None:
        """Rotation matrix (3, 3) from the approximate positions of the stations; None if they do not determine one.

        For upright instruments, the vertical comes from the standing axes, which are far more accurate than the
        positions.
        """
        if len(self.placed_station_indices) < MIN_PLAN_POSITIONS:
            return None
        axis = station_rotations[self.placed_station_indices, :, 2].mean(axis=0)
        level, here, plan = np.eye(3), station_positions[self.placed_station_indices], self.placed_station_positions
        length = np.linalg.norm(axis)
        if length > np.cos(MAX_STANDING_AXIS_SPREAD):
            level = smallest_rotation(axis / length, VERTICAL)
            here, plan = here @ level.T * [1.0, 1.0, 0.0], plan * [1.0, 1.0, 0.0]
        try:
            turn, _ = align_rigidly(plan, here)
        except NetworkError:
            return None
        return level.T @ turn

    def _rotation_from_yaws(self, station_rotations: Floats) -> Floats | None:
        """Mean (3, 3) of the rotation matrices that follow from the yaws of upright stations; None without yaws."""
        station_rotations_to_plan = [
            r @ rotation_about_z(yaw * DEGREE).T
            for yaw, r in zip(self.station_yaws, station_rotations, strict=True)
            if yaw is not None
        ]
        if not station_rotations_to_plan:
            return None
        u, _, vt = np.linalg.svd(np.sum(station_rotations_to_plan, axis=0))
        return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
