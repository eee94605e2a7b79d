"""State of a network, and the predicted readings at a state with their derivatives."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.geometry.rotations import from_rotation_vector


@dataclass(frozen=True)
class NetworkState:
    """State of a network: all poses, targets and parameters that an adjustment estimates; SI, network frame."""

    station_positions: Floats
    """Positions of the instruments, (S, 3)."""
    station_rotations: Floats
    """Instrument frame to network frame, (S, 3, 3)."""
    target_points: Floats
    """Coordinates of the targets, (T, 3)."""
    instrument_parameters: Floats
    """Construction parameters of each instrument, (I, p)."""
    extra_parameters: Floats = field(default_factory=lambda: np.zeros(0))
    """Parameters of the additional effects, (q,)."""

    def with_increments(
        self, pose_increments: Floats, point_increments: Floats, instrument_increments: Floats, extra_increments: Floats
    ) -> Self:
        """State after increments; `pose_increments` (S, 6) is translation and rotation vector in the network frame."""
        return type(self)(
            self.station_positions + pose_increments[:, :3],
            from_rotation_vector(pose_increments[:, 3:]) @ self.station_rotations,
            self.target_points + point_increments,
            self.instrument_parameters + instrument_increments,
            self.extra_parameters + extra_increments,
        )


@dataclass(frozen=True)
class Prediction:
    """Predicted raw readings (n, 3) and their derivatives.

    The derivatives are by_pose (n, 3, 6), by_target (n, 3, 3), by_instrument (n, 3, p) and by_extra (n, 3, q).
    """

    readings: Floats
    pose_derivatives: Floats
    target_derivatives: Floats
    instrument_derivatives: Floats
    extra_derivatives: Floats
