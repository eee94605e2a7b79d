"""Geometry of all pointings of a network (ranges, angles, incidence, order in time), computed once for all effects."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.geometry.kinematics import MISALIGNMENT_CHAIN, points_and_error_derivatives
from ltsim.geometry.polar import beam_frame_axes, polar_jacobian, swap_front_and_raw, to_polar, wrap_angle
from ltsim.geometry.rigid import pose_jacobian

MIN_AXIS_ROTATION = 1e-4
"""Smallest rotation [rad] of an axis between two pointings that counts as a motion of the axis."""


@dataclass(frozen=True)
class Sightings:
    """Geometry of n pointings from S stations to T targets, from which effects compute the change of readings.

    Arrays are in SI units and in the network frame, unless a name says otherwise.
    """

    station: Ints
    """Index of the station of each of n pointings, from 0, (n,)."""
    target: Ints
    """Index of the target of each of n pointings, from 0, (n,)."""
    instrument: Ints
    """Index of the instrument of each of n pointings, from 0, (n,)."""
    face: Ints
    """Face (1 or 2) of each of n pointings, (n,)."""
    repeat: Ints
    """Number of the round of measurements of each of n pointings, (n,); a station may repeat its round."""
    time: Floats
    """Time of each of n pointings since the start of the recording, (n,) [s]."""
    station_positions: Floats
    """Origins of the instruments at S stations, (S, 3) [m]."""
    station_rotations: Floats
    """Rotations from the instrument frames at S stations to the network frame, (S, 3, 3)."""
    target_points: Floats
    """Coordinates of T targets, (T, 3) [m]."""
    nest_normals: Floats
    """Unit normals of the nests of T targets, out of the open side, (T, 3); NaN if unknown."""
    is_reaimed: Bools
    """Flags (T,) of the targets whose reflector is turned towards the station before each pointing."""
    station_names: tuple[str, ...]
    """Names of the S stations."""
    target_names: tuple[str, ...]
    """Names of the T targets."""
    covariates: Mapping[str, Floats] = field(default_factory=dict)
    """Additional columns of the recording by name, such as a temperature, each (n,) for n pointings."""
    sight_vector_offsets: Floats | None = None
    """Vectors (n, 3) [m] from instrument to reflector minus those from station to target, for n pointings. Such a
    vector is the offset of the reflector from its target minus the offset of the instrument from its station. None if
    all are zero."""
    encoder_readings: Floats | None = None
    """Raw readings (n, 3) [m, rad] of n pointings with the instrument's errors, on which encoder errors with a short
    period depend. If None, ideal (error-free) readings are used.
    """

    def __len__(self) -> int:
        return len(self.station)

    def with_geometry(self, position: Floats, rotation: Floats, points: Floats) -> Self:
        """Copy with other station positions (S, 3) [m], station rotations (S, 3, 3) and targets (T, 3) [m]."""
        return replace(
            self, station_positions=position, station_rotations=rotation, target_points=points, encoder_readings=None
        )

    @cached_property
    def derived_cache(self) -> dict[Hashable, Any]:
        """Cache of quantities derived from these sightings, by keys that the calling functions choose."""
        return {}

    @cached_property
    def station_indices_by_name(self) -> dict[str, list[int]]:
        """Indices of the stations by name.

        A name has several indices if alternative positions of a station are evaluated together.
        """
        return _index_by_name(self.station_names)

    @cached_property
    def target_indices_by_name(self) -> dict[str, list[int]]:
        """Indices of the targets by name."""
        return _index_by_name(self.target_names)

    @cached_property
    def sight_vectors(self) -> Floats:
        """Vectors (n, 3) [m] from the instrument to the reflector in n pointings, in the network frame."""
        arm: Floats = self.target_points[self.target] - self.station_positions[self.station]
        return arm if self.sight_vector_offsets is None else arm + self.sight_vector_offsets

    @cached_property
    def local_points(self) -> Floats:
        """Coordinates (n, 3) [m] of the reflector in n pointings, in the frame of the instrument."""
        return np.einsum("nji,nj->ni", self.station_rotations[self.station], self.sight_vectors)

    @cached_property
    def ideal_front_face_readings(self) -> Floats:
        """Ideal (error-free) ranges, azimuths and elevations of n pointings in face 1, (n, 3) [m, rad]."""
        return to_polar(self.local_points)

    @cached_property
    def ideal_raw_readings(self) -> Floats:
        """Ideal (error-free) ranges, azimuths and elevations of n pointings in their face, (n, 3) [m, rad]."""
        return swap_front_and_raw(self.ideal_front_face_readings, self.face)

    @property
    def instrument_readings(self) -> Floats:
        """Raw readings (n, 3) [m, rad] of n pointings: `encoder_readings` if given, otherwise ideal readings."""
        return self.ideal_raw_readings if self.encoder_readings is None else self.encoder_readings

    @property
    def range_(self) -> Floats:
        """Ideal (error-free) range of each of n pointings, (n,) [m]."""
        return self.ideal_front_face_readings[:, 0]

    @property
    def azimuth(self) -> Floats:
        """Ideal (error-free) azimuth in face 1 of each of n pointings, (n,) [rad]."""
        return self.ideal_front_face_readings[:, 1]

    @property
    def elevation(self) -> Floats:
        """Ideal (error-free) elevation in face 1 of each of n pointings, (n,) [rad]."""
        return self.ideal_front_face_readings[:, 2]

    @property
    def displacement_per_reading(self) -> Floats:
        """Displacements (n, 3) of the points of n pointings by unit errors of ranges [m/m] and of angles [m/rad]."""
        return np.stack([np.ones_like(self.range_), self.range_ * np.cos(self.elevation), self.range_], axis=1)

    @cached_property
    def face_sign(self) -> Floats:
        """Sign (n,) of the face of each of n pointings: +1 for face 1, -1 for face 2."""
        return np.where(self.face == 2, -1.0, 1.0)

    @cached_property
    def local_derivatives(self) -> Floats:
        """Derivatives (n, 3, 3) of the raw range, azimuth and elevation of n pointings by x, y, z of the reflector.

        Rows are readings, columns coordinates in the instrument frame; units are 1 for the range and rad/m for angles.
        """
        return polar_jacobian(self.ideal_front_face_readings, self.face)

    @cached_property
    def target_derivatives(self) -> Floats:
        """Derivatives (n, 3, 3) of the raw range, azimuth and elevation of n pointings by x, y, z of the target.

        Rows are readings, columns coordinates in the network frame; units are 1 for the range and rad/m for angles.
        """
        return self.local_derivatives @ np.swapaxes(self.station_rotations[self.station], 1, 2)

    @cached_property
    def pose_derivatives(self) -> Floats:
        """Derivatives (n, 3, 6) of the readings of n pointings by translation and rotation of the station."""
        return pose_jacobian(self.target_derivatives, self.sight_vectors)

    @cached_property
    def beam_vectors(self) -> tuple[Floats, Floats, Floats]:
        """Unit vectors along the beam, to its left, and upwards perpendicular to it, each (n, 3) for n pointings.

        The vectors are in the network frame.
        """
        turn = self.station_rotations[self.station]
        beam, across, upward_part = (
            np.einsum("nij,nj->ni", turn, v) for v in beam_frame_axes(self.azimuth, self.elevation)
        )
        return beam, across, upward_part

    @cached_property
    def reading_change_by_error_key(self) -> dict[str, Floats]:
        """Change (n, 3) [m, rad] of the readings of n pointings per unit of each instrument error, by key of the error.

        The keys are those of `MISALIGNMENT_CHAIN`. An instrument error is a correction, which is added to a reading:
        for a fixed point, a larger correction means a smaller reading.
        """
        error_keys = {motion.error_key for motion in MISALIGNMENT_CHAIN}
        _, derivatives_by_key = points_and_error_derivatives(
            MISALIGNMENT_CHAIN, self.ideal_raw_readings, {}, error_keys
        )
        return {
            key: -np.einsum("nij,nj->ni", self.local_derivatives, moved) for key, moved in derivatives_by_key.items()
        }

    @cached_property
    def time_since_station_start(self) -> Floats:
        """Time (n,) [s] of each of n pointings since the first pointing of its station."""
        first_times = np.full(len(self.station_names), np.inf)
        np.minimum.at(first_times, self.station, self.time)
        return self.time - first_times[self.station]

    @cached_property
    def elapsed_occupation_fraction(self) -> Floats:
        """Elapsed fraction (n,) of the station's occupation at n pointings: 0 at its first, 1 at its last."""
        duration = np.full(len(self.station_names), 1e-9)
        np.maximum.at(duration, self.station, self.time_since_station_start)
        return self.time_since_station_start / duration[self.station]

    @cached_property
    def measurement_order(self) -> Ints:
        """Indices (n,) of the n pointings in the order of time; at equal times in the order of the recording."""
        return np.argsort(self.time, kind="stable")

    @cached_property
    def pointing_order_by_station(self) -> Ints:
        """Indices (n,) of the n pointings in the order of stations, and for each station in the order of time."""
        return self.measurement_order[np.argsort(self.station[self.measurement_order], kind="stable")]

    @cached_property
    def previous_pointing_indices(self) -> Ints:
        """Index (n,) of the previous pointing of the station for each of n pointings; -1 for the first of a station."""
        row_order = self.pointing_order_by_station
        before = np.full(len(self), -1)
        same = np.diff(self.station[row_order]) == 0
        before[row_order[1:][same]] = row_order[:-1][same]
        return before

    def _cumulative_sum(self, row_increments: Floats | Bools) -> Floats:
        """Cumulative sum (n,) of the increments (n,) over the pointings of each station, except its first pointing."""
        row_order = self.pointing_order_by_station
        first_indices = np.maximum.accumulate(
            np.where(self.previous_pointing_indices[row_order] < 0, np.arange(len(row_order)), 0)
        )
        cumulative_sums = np.cumsum(row_increments[row_order], dtype=np.float64)
        sums_by_row = np.empty_like(cumulative_sums)
        sums_by_row[row_order] = cumulative_sums - cumulative_sums[first_indices]
        return sums_by_row

    @cached_property
    def reading_changes_since_previous_pointing(self) -> Floats:
        """Change (n, 3) [m, rad] of the readings of n pointings since the previous pointing of the station.

        It is 0 for the first pointing of a station. The change of azimuth is the smaller of the two possible rotations.
        """
        move: Floats = np.where(
            self.previous_pointing_indices[:, None] >= 0,
            self.ideal_raw_readings - self.ideal_raw_readings[self.previous_pointing_indices],
            0.0,
        )
        move[:, 1] = wrap_angle(move[:, 1])
        return move

    @cached_property
    def cumulative_head_rotation(self) -> Floats:
        """Rotation (n,) [rad] of the azimuth axis, counter-clockwise, since the station's first pointing.

        Full turns count, so that the angle may exceed 2 pi.
        """
        return self._cumulative_sum(self.reading_changes_since_previous_pointing[:, 1])

    @cached_property
    def approach_signs(self) -> Floats:
        """Signs (n, 2) of the last rotation of the azimuth axis and of the elevation axis before each of n pointings.

        The sign is +1 if the reading increased, -1 if it decreased. An axis that does not move keeps its sign. The sign
        is 0 until the first rotation at a station.
        """
        sign = np.where(
            np.abs(self.reading_changes_since_previous_pointing[:, 1:]) < MIN_AXIS_ROTATION,
            0.0,
            np.sign(self.reading_changes_since_previous_pointing[:, 1:]),
        )
        for row in self.measurement_order:
            before = self.previous_pointing_indices[row]
            if before >= 0:
                sign[row] = np.where(sign[row] == 0.0, sign[before], sign[row])
        return sign

    @cached_property
    def seating_numbers(self) -> Ints:
        """Number (n,) of target changes at a station before each pointing; each is a new seating of the SMR."""
        return self._cumulative_sum(self.target != self.target[self.previous_pointing_indices]).astype(np.int64)

    @cached_property
    def covariate_values(self) -> dict[str, Floats]:
        """Covariates of n pointings by name, each (n,), in SI units or in the unit of the recording's column.

        Unknown values are 0. Changes since the previous pointing are 0 at the first pointing of a station.
        """
        place = self.target_points[self.target]
        has_previous = self.previous_pointing_indices >= 0
        previous_polar = np.where(
            has_previous[:, None], self.ideal_front_face_readings[self.previous_pointing_indices], 0.0
        )
        covariate_values = {
            "azimuth": self.azimuth,
            "elevation": self.elevation,
            "circle": wrap_angle(self.ideal_raw_readings[:, 1]),
            "vertical-circle": wrap_angle(self.ideal_raw_readings[:, 2]),
            "distance": self.range_,
            "horizontal": self.range_ * np.cos(self.elevation),
            "height": self.local_points[:, 2],
            "x": place[:, 0],
            "y": place[:, 1],
            "z": place[:, 2],
            "time": self.time,
            "station-time": self.time_since_station_start,
            "incidence": self.incidence_angle,
            "nest-direction": self.incidence_direction,
            "face": self.face_sign,
            "bearing": np.arctan2(self.beam_vectors[0][:, 1], self.beam_vectors[0][:, 0]),
            "parity": 1.0 - 2.0 * (np.argsort(self.measurement_order) % 2),
            "seating-parity": 1.0 - 2.0 * (self.seating_numbers % 2),
            "repeat": self.repeat.astype(np.float64),
            "approach-azimuth": self.approach_signs[:, 0],
            "approach-elevation": self.approach_signs[:, 1],
            "wound-azimuth": self.cumulative_head_rotation,
            "count": self._cumulative_sum(has_previous),
            "lapse": np.where(has_previous, self.time - self.time[self.previous_pointing_indices], 0.0),
        }
        changing = dict(
            zip(
                ("distance", "azimuth", "elevation"),
                zip(previous_polar.T, self.reading_changes_since_previous_pointing.T, strict=True),
                strict=True,
            )
        )
        for name, column in self.covariates.items():
            x = np.nan_to_num(column)
            changing[name] = (
                np.where(has_previous, x[self.previous_pointing_indices], x),
                np.where(has_previous, x - x[self.previous_pointing_indices], 0.0),
            )
        for name, (before, move) in changing.items():
            covariate_values |= {
                f"last-{name}": before,
                f"move-{name}": move,
                f"work-{name}": self._cumulative_sum(np.abs(move)),
            }
        return {name: np.nan_to_num(values) for name, values in (dict(self.covariates) | covariate_values).items()}

    @cached_property
    def _incidence_angle_and_direction(self) -> tuple[Floats, Floats]:
        """Values (n,) [rad] of `incidence_angle` and of `incidence_direction` for n pointings."""
        x, y, z = self.nest_normals.T
        level = np.hypot(x, y)
        across_x = np.divide(-y, level, out=np.ones_like(y), where=~(level < 1e-6))
        across_y = np.divide(x, level, out=np.zeros_like(x), where=~(level < 1e-6))
        lateral = across_x, across_y, 0.0 * z  # level, across the normal
        above = -z * across_y, z * across_x, x * across_y - y * across_x
        axes = np.stack([(x, y, z), lateral, above])[:, :, self.target]
        along, horizontal_part, upward_part = -np.einsum("ijn,nj->in", axes, self.sight_vectors)
        sight_lengths = np.sqrt(np.einsum("nj,nj->n", self.sight_vectors, self.sight_vectors))
        return np.arccos(np.clip(along / sight_lengths, -1.0, 1.0)), np.arctan2(upward_part, horizontal_part)

    @property
    def incidence_angle(self) -> Floats:
        """Angle (n,) [rad] between the beam and the normal of the nest in n pointings; NaN if the normal is unknown."""
        return self._incidence_angle_and_direction[0]

    @property
    def incidence_direction(self) -> Floats:
        """Direction (n,) [rad] to the station in n pointings, as an angle around the normal of the nest.

        Seen from the front of the nest, 0 is horizontal to the right, and pi / 2 is upwards. NaN if the normal is
        unknown.
        """
        return self._incidence_angle_and_direction[1]


def _index_by_name(names: Sequence[str]) -> dict[str, list[int]]:
    """Indices of all occurrences of each name in `names`."""
    indices: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        indices.setdefault(name, []).append(i)
    return indices
