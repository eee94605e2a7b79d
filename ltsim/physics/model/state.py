"""Unknowns of a network, and the readings that are predicted for them, with derivatives."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.geometry.rigid import matrix_from_rotation_vector


@dataclass(frozen=True)
class NetworkState:
    """Values of all unknowns of a network [SI]: poses, coordinates and parameters, in the network frame.

    The arrays have S stations, T targets, I instruments with p parameters each, and q additional parameters.
    """

    station_positions: Floats
    """Positions of the instrument at each of S stations, (S, 3) [m]."""
    station_rotations: Floats
    """Rotation matrices from instrument frame to network frame at each of S stations, (S, 3, 3)."""
    target_points: Floats
    """Coordinates of T targets, (T, 3) [m]."""
    instrument_parameters: Floats
    """The p parameters of the geometric error model for each of I instruments, (I, p) [SI]."""
    extra_parameters: Floats = field(default_factory=lambda: np.zeros(0))
    """The q parameters of effects and of nuisance errors, (q,) [SI]."""

    def with_increments(
        self, pose_increments: Floats, point_increments: Floats, instrument_increments: Floats, extra_increments: Floats
    ) -> Self:
        """Values of the unknowns after the given increments.

        `pose_increments` (S, 6) are translations [m] and rotation vectors [rad] of the S stations in the network frame.
        `point_increments` (T, 3) [m], `instrument_increments` (I, p) and `extra_increments` (q,) are added to the
        coordinates of T targets, to the p parameters of I instruments, and to the q parameters of effects and nuisance
        errors.
        """
        return type(self)(
            self.station_positions + pose_increments[:, :3],
            matrix_from_rotation_vector(pose_increments[:, 3:]) @ self.station_rotations,
            self.target_points + point_increments,
            self.instrument_parameters + instrument_increments,
            self.extra_parameters + extra_increments,
        )


@dataclass(frozen=True)
class Prediction:
    """Predicted raw readings of n pointings, with their derivatives with respect to all unknowns."""

    readings: Floats
    """Raw readings of n pointings: range [m], azimuth and elevation [rad], (n, 3)."""
    pose_derivatives: Floats
    """Derivatives of the readings of n pointings with respect to translation and rotation of the station, (n, 3, 6)."""
    target_derivatives: Floats
    """Derivatives of the readings of n pointings with respect to the coordinates of the target, (n, 3, 3)."""
    instrument_derivatives: Floats
    """Derivatives of the readings of n pointings with respect to the p instrument parameters, (n, 3, p)."""
    extra_derivatives: Floats
    """Derivatives of the readings of n pointings with respect to the q parameters of effects and nuisance errors, (n,
    3, q)."""
