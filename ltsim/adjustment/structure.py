"""Structure of a network adjustment: columns of the unknowns in the design matrix, and undetermined unknowns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, wraps
from typing import Concatenate, ParamSpec, TypeVar

import numpy as np

from ltsim.adjustment.marks import StationMarks
from ltsim.adjustment.rows import ControlRows, GaugeRows, LevelRows, MarkDifferenceRows, YawRows
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import NetworkError
from ltsim.geometry.rigid import VERTICAL
from ltsim.physics.model.measurement import MeasurementModel, NetworkState
from ltsim.recordings.recording import Recording


@dataclass(frozen=True)
class UnknownColumns:
    """Columns of the unknowns of a network in the design matrix.

    The order is: poses, targets that are not eliminated from the normal equations, instrument parameters, parameters of
    additional effects, eliminated targets. Set-ups over one mark, and a target at this mark, share position columns.
    """

    pose_columns: Ints
    """Columns in the design matrix of translation and rotation of each of S stations, (S, 6)."""
    target_columns: Ints
    """Columns in the design matrix of the coordinates of each of T targets, (T, 3). All targets are eliminated from the
    normal equations one by one, except targets of reference lengths and differences, and targets under a set-up.
    """
    instrument_columns: Ints
    """Columns in the design matrix of the p parameters of each of I instruments, (I, p)."""
    effect_columns: Ints
    """Columns in the design matrix of the q parameters of additional effects, (q,)."""
    n_retained: int
    """Number K of columns of the unknowns that are not eliminated from the normal equations."""
    n_columns: int
    """Number of columns of all unknowns."""

    @property
    def position_columns(self) -> Ints:
        """Columns (T + S + 1, 3) in the design matrix of the positions of T targets, S set-ups and the origin.

        The origin, which stands for known marks, is fixed; its columns are arbitrary.
        """
        return np.concatenate([self.target_columns, self.pose_columns[:, :3], self.pose_columns[:1, :3]])

    @classmethod
    def from_model(
        cls, model: MeasurementModel, gauge: GaugeRows, marks: StationMarks, differences: MarkDifferenceRows
    ) -> UnknownColumns:
        """Columns of the unknowns of a measurement model with its reference lengths, marks and known differences."""
        recording, over = model.recording, marks.target_indices >= 0
        stations, targets = len(recording.stations), len(recording.targets)
        size = 0

        def next_columns(n_rows: int, n_columns: int) -> Ints:
            nonlocal size
            first, size = size, size + n_rows * n_columns
            return np.arange(first, size).reshape(n_rows, n_columns)

        has_columns = np.ones((stations, 6), dtype=bool)
        has_columns[:, :3] = (~over & (marks.first_setup_on_mark == np.arange(stations)))[:, None]
        keep = np.zeros(targets, dtype=bool)
        difference_ends = differences.start_and_end_indices[differences.start_and_end_indices < targets]
        keep[
            np.concatenate([gauge.first_targets, gauge.second_targets, marks.target_indices[over], difference_ends])
        ] = True
        pose, target = np.full((stations, 6), -1), np.empty((targets, 3), dtype=np.int64)
        pose[has_columns] = next_columns(int(has_columns.sum()), 1)[:, 0]
        target[keep] = next_columns(int(keep.sum()), 3)
        instrument, extra = (
            next_columns(len(recording.instruments), model.construction.n_parameters),
            next_columns(1, model.n_extra_parameters)[0],
        )
        n_retained = size
        target[~keep] = next_columns(int((~keep).sum()), 3)
        pose[over, :3] = target[marks.target_indices[over]]
        pose[:, :3] = np.where(pose[:, :3] < 0, pose[marks.first_setup_on_mark, :3], pose[:, :3])
        return cls(pose, target, instrument, extra, n_retained, size)


MIN_COS_PLUMB_INCLINATION = 1.0 - 1e-8
"""Limit of the cosine of the angle between a plumb line and the z axis of the network. If the cosine is larger, the
plumb line counts as parallel to the z axis (0.14 mrad, 900 m on the earth)."""


@dataclass(frozen=True)
class NetworkRows:
    """Observation equations of a network (readings in use, reference values) and the columns of its unknowns."""

    model: MeasurementModel
    """Measurement model that predicts the readings."""
    is_used_reading: Bools
    """Flags (n, 3), True for those readings of n pointings that are in use."""
    gauge_rows: GaugeRows
    """Equations of the reference lengths."""
    control_rows: ControlRows
    """Equations of the targets with known coordinates."""
    level_rows: LevelRows
    """Equations of the levelled stations."""
    yaw_rows: YawRows
    """Equations of the stations with known yaw (direction of azimuth zero)."""
    marks: StationMarks
    """Marks under the set-ups."""
    control_rows_of_marks: ControlRows
    """Equations of the known marks under stations."""
    difference_rows: MarkDifferenceRows
    """Equations of the known differences."""
    unknowns: UnknownColumns
    """Columns of the unknowns in the design matrix."""

    @cached_property
    def undetermined_unknowns(self) -> UndeterminedUnknowns:
        """Unknowns that are undetermined because of the kinds of observations, such as heights without elevations."""
        return UndeterminedUnknowns.from_rows(self)

    @property
    def has_no_references(self) -> bool:
        """True if the network contains no reference length, known point, known difference, level or known yaw."""
        references = (
            self.gauge_rows,
            self.control_rows,
            self.control_rows_of_marks,
            self.difference_rows,
            self.level_rows,
            self.yaw_rows,
        )
        return not any(len(rows) for rows in references)


@dataclass(frozen=True)
class UndeterminedUnknowns:
    """Unknowns that are undetermined because of the kinds of observations in use, whatever the geometry of the network.

    For example, heights are undetermined without elevations. Such unknowns are fixed at their present values. Stations
    and targets are given by their indices.
    """

    unknowns: UnknownColumns
    """Columns of all unknowns in the design matrix."""
    yaw_undetermined_stations: Ints
    """Indices of stations without azimuths, whose rotation about the standing axis is undetermined."""
    tilt_undetermined_stations: Ints
    """Indices of stations without angles and level, whose tilts are undetermined."""
    height_undetermined_stations: Ints
    """Indices of stations with undetermined height: levelled stations with only azimuths and horizontal distances."""
    stations_without_readings: Ints
    """Indices of stations without any reading."""
    is_unmeasured_target: Bools
    """Flags (T,), True for those of T targets that have no reading in use, no known coordinates, and no set-up over
    them."""
    is_height_undetermined_target: Bools
    """Flags (T,), True for those of T targets with undetermined height: levelled set-ups measured only azimuths and
    horizontal distances to them.
    """
    yaw_determined_stations: Ints
    """Indices of stations with azimuths, whose yaw (direction of azimuth zero) is determined."""
    n_coordinates_of_unmeasured_targets: int
    """Number of known coordinates of unmeasured targets; they do not count as observations."""
    scale_defining_target: Ints
    """Index (1,) of a target whose distance from the first station with azimuths is fixed, because only approximate
    coordinates define the scale of a network of directions alone; empty otherwise."""
    fixes_heights: bool
    """True if all heights are undetermined and therefore fixed, so that the datum fixes no vertical translation."""

    @classmethod
    def from_rows(cls, network: NetworkRows) -> UndeterminedUnknowns:
        """Undetermined unknowns of a network, from the kinds of its observations (ranges, azimuths, levels...)."""
        recording, use, marks, levels = (
            network.model.recording,
            network.is_used_reading,
            network.marks,
            network.level_rows,
        )
        n_stations = len(recording.stations)
        range_, azimuth, elevation = (np.bincount(recording.station, use[:, i], n_stations) > 0 for i in range(3))
        high = use[:, 2] | (use[:, 0] & ~recording.is_horizontal_distance)
        feels = np.bincount(recording.station, high, n_stations) > 0
        level, alone = (
            np.zeros(n_stations, dtype=bool),
            (marks.first_setup_on_mark == np.arange(n_stations)) & (marks.target_indices < 0),
        )
        level[levels.station_indices] = True
        alone[network.control_rows_of_marks.point_indices] = False
        height = alone & azimuth & ~feels & level
        is_read = np.bincount(recording.target, use.any(axis=1), len(recording.targets)) > 0
        is_read[network.control_rows.point_indices[network.control_rows.is_declared_coordinate.all(axis=1)]] = True
        is_read[marks.target_indices[marks.target_indices >= 0]] = True
        upright = np.zeros(n_stations, dtype=bool)
        upright[levels.station_indices] = np.abs(levels.plumb_directions @ VERTICAL) > MIN_COS_PLUMB_INCLINATION
        on = marks.target_indices >= 0
        n_rows = np.bincount(recording.target, use.any(axis=1), len(recording.targets)) > 0
        n_rows[marks.target_indices[on & azimuth]] = True
        n_rows[recording.target[high | (use.any(axis=1) & ~upright[recording.station])]] = False
        n_rows[marks.target_indices[on & (feels | ~upright)]] = False
        n_rows[network.control_rows.point_indices[network.control_rows.is_declared_coordinate[:, 2]]] = False
        n_rows[np.concatenate([network.gauge_rows.first_targets, network.gauge_rows.second_targets])] = False
        height_free = network.difference_rows.is_height_undetermined(np.concatenate([n_rows, height, [False]]))
        has_height = np.concatenate(
            [
                network.control_rows.is_declared_coordinate[:, 2],
                network.control_rows_of_marks.is_declared_coordinate[:, 2],
            ]
        )
        stands = np.where(marks.target_indices >= 0, height_free[marks.target_indices], height_free[len(n_rows) : -1])
        return cls(
            n_coordinates_of_unmeasured_targets=int(
                network.control_rows.is_declared_coordinate[~is_read[network.control_rows.point_indices]].sum()
            ),
            unknowns=network.unknowns,
            yaw_undetermined_stations=np.flatnonzero(~azimuth),
            tilt_undetermined_stations=np.flatnonzero(~azimuth & ~elevation & ~level),
            height_undetermined_stations=np.flatnonzero(height_free[len(n_rows) : -1]),
            stations_without_readings=np.flatnonzero(alone & ~range_ & ~azimuth & ~elevation),
            is_unmeasured_target=~is_read,
            is_height_undetermined_target=height_free[: len(n_rows)],
            yaw_determined_stations=np.flatnonzero(azimuth),
            scale_defining_target=_scale_defining_target(network)
            if _has_approximate_scale(network)
            else np.zeros(0, dtype=np.int64),
            fixes_heights=bool(stands.all() and (height_free[: len(n_rows)] | ~is_read).all() and not has_height.any()),
        )

    @property
    def fixed_columns(self) -> Ints:
        """Columns (h, 3) of the unknowns in the h equations that fix undetermined unknowns at their present values."""
        unknowns = self.unknowns
        single = [
            unknowns.target_columns[self.is_unmeasured_target],
            unknowns.pose_columns[self.stations_without_readings, :3],
        ]
        single += [
            unknowns.pose_columns[self.height_undetermined_stations, 2:3],
            unknowns.target_columns[self.is_height_undetermined_target, 2:3],
        ]
        column_groups = [
            unknowns.pose_columns[self.yaw_undetermined_stations, 3:],
            np.repeat(unknowns.pose_columns[self.tilt_undetermined_stations, 3:], 2, axis=0),
        ]
        column_groups.append(unknowns.target_columns[self.scale_defining_target])
        return np.concatenate([*column_groups, *(np.repeat(columns.reshape(-1, 1), 3, axis=1) for columns in single)])

    def fixing_coefficients(self, state: NetworkState) -> Floats:
        """Coefficients (h, 3) of the unknowns `fixed_columns` in the h equations that fix undetermined unknowns."""
        yaw = state.station_rotations[self.yaw_undetermined_stations] @ VERTICAL
        tilt = np.swapaxes(state.station_rotations[self.tilt_undetermined_stations], 1, 2)[:, :2].reshape(-1, 3)
        arm = (
            state.target_points[self.scale_defining_target]
            - state.station_positions[self.yaw_determined_stations[: len(self.scale_defining_target)]]
        )
        directions = arm / np.linalg.norm(arm, axis=1, keepdims=True)
        unit_vectors = np.zeros((self.n_fixing_equations - len(yaw) - len(tilt) - len(directions), 3))
        unit_vectors[:, 0] = 1.0
        return np.concatenate([yaw, tilt, directions, unit_vectors])

    @property
    def fixed_pose_components(self) -> Bools:
        """Flags (S, 6), True for components of the poses of S stations that are fixed because they are undetermined.

        The components are translation, then rotation. All three rotations of a station are flagged if its rotation
        about the standing axis is undetermined.
        """
        is_fixed = np.zeros(self.unknowns.pose_columns.shape, dtype=bool)
        is_fixed[self.yaw_undetermined_stations, 3:] = True
        is_fixed[self.tilt_undetermined_stations, 3:] = True
        is_fixed[self.height_undetermined_stations, 2] = True
        is_fixed[self.stations_without_readings, :3] = True
        return is_fixed

    @property
    def n_fixing_equations(self) -> int:
        """Number h of equations that fix undetermined unknowns."""
        n_tilts = (
            len(self.yaw_undetermined_stations)
            + 2 * len(self.tilt_undetermined_stations)
            + len(self.scale_defining_target)
            + len(self.height_undetermined_stations)
            + 3 * len(self.stations_without_readings)
        )
        return n_tilts + int(self.is_height_undetermined_target.sum()) + 3 * int(self.is_unmeasured_target.sum())

    @property
    def datum_stations(self) -> Ints:
        """Indices of the stations that define the datum: the first station with azimuths, or all if none has any."""
        return (
            self.yaw_determined_stations[:1]
            if self.fixes_datum_rotations
            else np.arange(len(self.unknowns.pose_columns))
        )

    @property
    def fixes_datum_rotations(self) -> bool:
        """True if the datum fixes the rotation of a station, which requires azimuths; otherwise only translations."""
        return len(self.yaw_determined_stations) > 0


def _has_approximate_scale(network: NetworkRows) -> bool:
    """True if only approximate coordinates define the scale of a network: no distance, length or two known points."""
    use, recording, control_axes = (
        network.is_used_reading,
        network.model.recording,
        network.control_rows.is_declared_coordinate,
    )
    has_height = use[:, 2].any()
    has_scale = (
        use[:, 0].any() or len(network.gauge_rows) or len(network.difference_rows) or len(network.control_rows_of_marks)
    )
    if (
        has_scale
        or control_axes[:, : 3 if has_height else 2].any()
        or (has_height and any(height.any() for height in recording.heights_above_marks()))
    ):
        return False
    targets = map(recording.target_setup, recording.targets)
    return sum(target.datum and target.approximate_mm is not None for target in targets) > 1


def _scale_defining_target(network: NetworkRows) -> Ints:
    """Index (1,) of the first target in the azimuths of the first station with azimuths; empty without azimuths."""
    recording, rows = network.model.recording, np.flatnonzero(network.is_used_reading[:, 1])
    first_row = rows[np.argsort(recording.station[rows], kind="stable")][:1]
    return recording.target[first_row]


DecoratedParameters = ParamSpec("DecoratedParameters")
"""Parameters of a decorated function after its first parameter, which is a recording."""
DecoratedReturn = TypeVar("DecoratedReturn")
"""Type of the result of a decorated function whose first parameter is a recording."""


def raise_for_singular_network(
    function: Callable[Concatenate[Recording, DecoratedParameters], DecoratedReturn],
) -> Callable[Concatenate[Recording, DecoratedParameters], DecoratedReturn]:
    """Decorator for a function of a recording: numpy's error for a singular matrix becomes a NetworkError."""

    @wraps(function)
    def wrapper(
        recording: Recording, /, *args: DecoratedParameters.args, **kwargs: DecoratedParameters.kwargs
    ) -> DecoratedReturn:
        try:
            return function(recording, *args, **kwargs)
        except np.linalg.LinAlgError:
            raise NetworkError(_sparsest_measurement_sentence(recording)) from None

    return wrapper


def _sparsest_measurement_sentence(recording: Recording) -> str:
    """Sentence on a singular network, with the station and the target that have the fewest readings."""
    n_measured = recording.is_measured.sum(axis=1)
    stations = np.bincount(recording.station, n_measured, len(recording.stations))
    targets = np.bincount(recording.target, n_measured, len(recording.targets))
    clause = (
        f"station {recording.stations[int(stations.argmin())]} has {stations.min():.0f} readings, "
        f"target {recording.targets[int(targets.argmin())]} has {targets.min():.0f}"
    )
    return (
        f"the equations of the network are singular, because its readings leave some unknowns undetermined ({clause}); "
        "measure range and both angles to three or more common targets from each station"
    )
