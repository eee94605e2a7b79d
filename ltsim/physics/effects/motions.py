"""Changes of readings by motions of targets or stations, exact and to first order, and base classes of such effects."""

from dataclasses import dataclass, replace

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.geometry.polar import swap_front_and_raw, to_polar, wrap_angle
from ltsim.geometry.rigid import matrix_from_rotation_vector
from ltsim.physics.effects.effect import Effect, design_from_displacements
from ltsim.physics.effects.linear_effect import LinearEffect, Linearisation
from ltsim.scene.sightings import Sightings


def reading_change_by_displacement(sightings: Sightings, displacement: Floats) -> Floats:
    """Exact change (n, 3) of the raw readings of n pointings by a displacement of their targets.

    `displacement` (n, 3) [m] is the displacement of the target of each pointing in the network frame.
    """
    return reading_change_by_target_positions(
        sightings, _sightings_with_displaced_targets(sightings, displacement).local_points
    )


def reading_change_by_station_motion(sightings: Sightings, motion: Floats) -> Floats:
    """Exact change (n, 3) of the raw readings of n pointings by a motion of their stations.

    `motion` (n, 6) is a translation [m] and a rotation vector [rad] about the station's origin, for each pointing, in
    the network frame.
    """
    return reading_change_by_target_positions(sightings, _sightings_from_moved_stations(sightings, motion).local_points)


def _sightings_with_displaced_targets(sightings: Sightings, displacement: Floats) -> Sightings:
    """Sightings with the reflector of each of n pointings displaced by `displacement` (n, 3) [m], network frame."""
    return replace(
        sightings,
        sight_vector_offsets=displacement
        if sightings.sight_vector_offsets is None
        else sightings.sight_vector_offsets + displacement,
    )


def _sightings_from_moved_stations(sightings: Sightings, motion: Floats) -> Sightings:
    """Sightings with the reflectors where they appear, relative to the unmoved stations, from stations that moved.

    `motion` (n, 6) is the motion of the station of each of n pointings: a translation [m] and a rotation vector [rad]
    in the network frame.
    """
    inverse_rotations = np.swapaxes(matrix_from_rotation_vector(motion[:, 3:]), 1, 2)
    apparent = np.einsum("nij,nj->ni", inverse_rotations, sightings.sight_vectors - motion[:, :3])
    return _sightings_with_displaced_targets(sightings, apparent - sightings.sight_vectors)


def _linearised_change(
    sightings: Sightings, apparent_sightings: Sightings, displacement_derivatives: Floats
) -> Linearisation:
    """Change of the readings by displaced apparent positions of the reflectors, with its derivatives.

    `apparent_sightings` have the displaced positions. `displacement_derivatives` (n, 3, p) are the derivatives of the
    displacement in n pointings with respect to the p parameters.
    """
    by_target = apparent_sightings.target_derivatives - sightings.target_derivatives
    by_pose = apparent_sightings.pose_derivatives - sightings.pose_derivatives
    return Linearisation(
        reading_change_by_target_positions(sightings, apparent_sightings.local_points),
        displacement_derivatives,
        (by_target, by_pose),
    )


def reading_change_by_target_positions(sightings: Sightings, local_points: Floats) -> Floats:
    """Change (n, 3) of the readings of n pointings if their targets are at the positions `local_points` (n, 3) [m].

    The positions are in the frame of the instrument.
    """
    change: Floats = swap_front_and_raw(to_polar(local_points), sightings.face) - sightings.ideal_raw_readings
    change[:, 1] = wrap_angle(change[:, 1])
    return change


class TargetDisplacement(LinearEffect):
    """Base class of linear effects that displace targets or their apparent positions.

    The change of the readings is exact, not only linear in the displacement.
    """

    def displacement(self, sightings: Sightings) -> Floats:
        """Derivatives (n, 3, p) of the target's position in n pointings by the p parameters, network frame."""
        raise NotImplementedError

    def design(self, sightings: Sightings) -> Floats:
        return design_from_displacements(sightings, self.displacement(sightings))

    def reading_change(self, sightings: Sightings, parameter_values: Floats) -> Floats:
        return reading_change_by_displacement(sightings, self.displacement(sightings) @ parameter_values)

    def linearise(self, sightings: Sightings, parameter_values: Floats) -> Linearisation:
        displacement = self.displacement(sightings)
        apparent = _sightings_with_displaced_targets(sightings, displacement @ parameter_values)
        return _linearised_change(sightings, apparent, design_from_displacements(apparent, displacement))


@dataclass(frozen=True)
class TargetDisplacementEffect(TargetDisplacement, Effect):
    """Base class of catalogue effects that displace targets or their apparent positions."""


@dataclass(frozen=True)
class StationMotionEffect(Effect):
    """Base class of catalogue effects that move stations."""

    def motion(self, sightings: Sightings) -> Floats:
        """Derivatives (n, 6, p) of the station's motion in n pointings with respect to the p parameters.

        A motion is a translation [m] and a rotation vector [rad] about the station's origin, in the network frame.
        """
        raise NotImplementedError

    def design(self, sightings: Sightings) -> Floats:
        return sightings.pose_derivatives @ self.motion(sightings)

    def reading_change(self, sightings: Sightings, parameter_values: Floats) -> Floats:
        return reading_change_by_station_motion(sightings, self.motion(sightings) @ parameter_values)

    def linearise(self, sightings: Sightings, parameter_values: Floats) -> Linearisation:
        motion = self.motion(sightings)
        apparent = _sightings_from_moved_stations(sightings, motion @ parameter_values)
        return _linearised_change(sightings, apparent, apparent.pose_derivatives @ motion)
