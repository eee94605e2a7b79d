"""Structure of a network: columns of the unknowns, undetermined unknowns, errors for singular networks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, wraps
from typing import Concatenate, ParamSpec, TypeVar

import numpy as np

from ltsim.adjustment.rows import VERTICAL, ControlRows, DifferenceRows, GaugeRows, LevelRows, Marks, YawRows
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import NetworkError
from ltsim.physics.model.measurement import MeasurementModel, NetworkState
from ltsim.recordings.recording import Recording


@dataclass(frozen=True)
class Unknowns:
    """Columns of the design: poses, reduced targets, instrument parameters, additional effects; then the other targets.

    Set-ups over one mark share the columns of their position, also with the target at that mark.
    """

    pose: Ints
    """Columns of translation and rotation of each station, (S, 6)."""
    target: Ints
    """Columns of each target, (T, 3): targets of reference lengths and differences and those under a set-up are reduced
    unknowns, all others are eliminated block by block.
    """
    instrument: Ints
    """Columns of the instrument parameters, (I, p)."""
    extra: Ints
    """Columns of the additional effects' parameters, (q,)."""
    n_reduced: int
    """Number K of reduced columns."""
    size: int
    """Number of all columns."""

    @property
    def places(self) -> Ints:
        """Columns of the places of targets and set-ups, (T + S + 1, 3).

        Those of the origin, the last, have no meaning.
        """
        return np.concatenate([self.target, self.pose[:, :3], self.pose[:1, :3]])

    @classmethod
    def of(cls, model: MeasurementModel, gauge: GaugeRows, marks: Marks, differences: DifferenceRows) -> Unknowns:
        """Columns of the unknowns of a model."""
        recording, over = model.recording, marks.target >= 0
        stations, targets = len(recording.stations), len(recording.targets)
        size = 0

        def fresh(rows: int, width: int) -> Ints:
            nonlocal size
            first, size = size, size + rows * width
            return np.arange(first, size).reshape(rows, width)

        has_columns = np.ones((stations, 6), dtype=bool)
        has_columns[:, :3] = (~over & (marks.first == np.arange(stations)))[:, None]
        keep = np.zeros(targets, dtype=bool)
        difference_ends = differences.ends[differences.ends < targets]
        keep[np.concatenate([gauge.first, gauge.second, marks.target[over], difference_ends])] = True
        pose, target = np.full((stations, 6), -1), np.empty((targets, 3), dtype=np.int64)
        pose[has_columns] = fresh(int(has_columns.sum()), 1)[:, 0]
        target[keep] = fresh(int(keep.sum()), 3)
        instrument, extra = (
            fresh(len(recording.instruments), model.construction.n_parameters),
            fresh(1, model.n_extra_parameters)[0],
        )
        n_reduced = size
        target[~keep] = fresh(int((~keep).sum()), 3)
        pose[over, :3] = target[marks.target[over]]
        pose[:, :3] = np.where(pose[:, :3] < 0, pose[marks.first, :3], pose[:, :3])
        return cls(pose, target, instrument, extra, n_reduced, size)


UPRIGHT = 1.0 - 1e-8
"""Cosine of the inclination up to which a plumb line counts as parallel to that of the network (0.14 mrad, 900 m on the
earth).
"""


@dataclass(frozen=True)
class NetworkRows:
    """Readings in use, reference values, and the unknowns of both."""

    model: MeasurementModel
    use: Bools
    """Flags of the readings in use, (n, 3)."""
    gauge: GaugeRows
    control: ControlRows
    levels: LevelRows
    yaws: YawRows
    marks: Marks
    mark_control: ControlRows
    differences: DifferenceRows
    unknowns: Unknowns

    @cached_property
    def structure(self) -> Structure:
        """Unknowns that these readings and the set-up leave undetermined."""
        return Structure.of(self)

    @property
    def knows_nothing(self) -> bool:
        """True if the network contains no reference length, point, difference, level or known azimuth zero."""
        references = self.gauge, self.control, self.mark_control, self.differences, self.levels, self.yaws
        return not any(len(rows) for rows in references)


@dataclass(frozen=True)
class Structure:
    """Unknowns that no used reading determines for any geometry; they are fixed at their present values."""

    unknowns: Unknowns
    yaw: Ints
    tilt: Ints
    """Stations without azimuths, and stations without any angle or level."""
    height: Ints
    """Levelled stations with azimuths and horizontal distances only."""
    unread_stations: Ints
    """Stations without any reading."""
    unseen: Bools
    """Flags of the targets without a used reading, known coordinates or a set-up on them, (T,)."""
    height_free_targets: Bools
    """Flags of the targets connected to levelled set-ups by horizontal directions and distances only, (T,): their
    height is undetermined.
    """
    oriented_stations: Ints
    """Stations whose yaw is determined by readings."""
    constraints_on_unseen: int
    """Number of known coordinates of unmeasured targets, which check nothing."""
    scale: Ints
    """Target (one or none) whose distance from the first station the datum fixes, if directions leave the scale
    undetermined and approximate coordinates define it.
    """
    in_plan: bool
    """True if the datum fixes all heights, so that a vertical translation is no datum defect."""

    @classmethod
    def of(cls, network: NetworkRows) -> Structure:
        """Structure of a network, from the kinds of its readings."""
        recording, use, marks, levels = network.model.recording, network.use, network.marks, network.levels
        count = len(recording.stations)
        range_, azimuth, elevation = (np.bincount(recording.station, use[:, i], count) > 0 for i in range(3))
        high = use[:, 2] | (use[:, 0] & ~recording.is_horizontal)
        feels = np.bincount(recording.station, high, count) > 0
        level, alone = np.zeros(count, dtype=bool), (marks.first == np.arange(count)) & (marks.target < 0)
        level[levels.station] = True
        alone[network.mark_control.target] = False
        height = alone & azimuth & ~feels & level
        is_read = np.bincount(recording.target, use.any(axis=1), len(recording.targets)) > 0
        is_read[network.control.target[network.control.axes.all(axis=1)]] = True
        is_read[marks.target[marks.target >= 0]] = True
        upright = np.zeros(count, dtype=bool)
        upright[levels.station] = np.abs(levels.vertical @ VERTICAL) > UPRIGHT
        on = marks.target >= 0
        flat = np.bincount(recording.target, use.any(axis=1), len(recording.targets)) > 0
        flat[marks.target[on & azimuth]] = True
        flat[recording.target[high | (use.any(axis=1) & ~upright[recording.station])]] = False
        flat[marks.target[on & (feels | ~upright)]] = False
        flat[network.control.target[network.control.axes[:, 2]]] = False
        flat[np.concatenate([network.gauge.first, network.gauge.second])] = False
        height_free = network.differences.height_free(np.concatenate([flat, height, [False]]))
        has_height = np.concatenate([network.control.axes[:, 2], network.mark_control.axes[:, 2]])
        stands = np.where(marks.target >= 0, height_free[marks.target], height_free[len(flat) : -1])
        return cls(
            constraints_on_unseen=int(network.control.axes[~is_read[network.control.target]].sum()),
            unknowns=network.unknowns,
            yaw=np.flatnonzero(~azimuth),
            tilt=np.flatnonzero(~azimuth & ~elevation & ~level),
            height=np.flatnonzero(height_free[len(flat) : -1]),
            unread_stations=np.flatnonzero(alone & ~range_ & ~azimuth & ~elevation),
            unseen=~is_read,
            height_free_targets=height_free[: len(flat)],
            oriented_stations=np.flatnonzero(azimuth),
            scale=_scale_target(network) if _takes_scale(network) else np.zeros(0, dtype=np.int64),
            in_plan=bool(stands.all() and (height_free[: len(flat)] | ~is_read).all() and not has_height.any()),
        )

    @property
    def held_columns(self) -> Ints:
        """Columns (h, 3) of each row that fixes an unknown."""
        unknowns = self.unknowns
        single = [unknowns.target[self.unseen], unknowns.pose[self.unread_stations, :3]]
        single += [unknowns.pose[self.height, 2:3], unknowns.target[self.height_free_targets, 2:3]]
        rows = [unknowns.pose[self.yaw, 3:], np.repeat(unknowns.pose[self.tilt, 3:], 2, axis=0)]
        rows.append(unknowns.target[self.scale])
        return np.concatenate([*rows, *(np.repeat(columns.reshape(-1, 1), 3, axis=1) for columns in single)])

    def held_directions(self, state: NetworkState) -> Floats:
        """Directions (h, 3) in these columns."""
        yaw = state.station_rotations[self.yaw] @ VERTICAL
        tilt = np.swapaxes(state.station_rotations[self.tilt], 1, 2)[:, :2].reshape(-1, 3)
        arm = state.target_points[self.scale] - state.station_positions[self.oriented_stations[: len(self.scale)]]
        away = arm / np.linalg.norm(arm, axis=1, keepdims=True)
        single = np.zeros((self.held - len(yaw) - len(tilt) - len(away), 3))
        single[:, 0] = 1.0
        return np.concatenate([yaw, tilt, away, single])

    @property
    def held_poses(self) -> Bools:
        """Flags (S, 6) of the fixed components of poses; all three rotations if the yaw is undetermined."""
        held = np.zeros(self.unknowns.pose.shape, dtype=bool)
        held[self.yaw, 3:] = True
        held[self.tilt, 3:] = True
        held[self.height, 2] = True
        held[self.unread_stations, :3] = True
        return held

    @property
    def held(self) -> int:
        """Number h of fixed unknowns."""
        counted = (
            len(self.yaw) + 2 * len(self.tilt) + len(self.scale) + len(self.height) + 3 * len(self.unread_stations)
        )
        return counted + int(self.height_free_targets.sum()) + 3 * int(self.unseen.sum())

    @property
    def anchors(self) -> Ints:
        """Stations of the datum rows: the first one with determined yaw, or all if there is none (distances alone)."""
        return self.oriented_stations[:1] if self.anchors_turn else np.arange(len(self.unknowns.pose))

    @property
    def anchors_turn(self) -> bool:
        """True if the datum rows also fix the rotations of the anchors."""
        return len(self.oriented_stations) > 0


def _takes_scale(network: NetworkRows) -> bool:
    """True if the scale follows from approximate coordinates, and not from measurements or reference values."""
    use, recording, control_axes = network.use, network.model.recording, network.control.axes
    high = use[:, 2].any()
    has_scale = use[:, 0].any() or len(network.gauge) or len(network.differences) or len(network.mark_control)
    if (
        has_scale
        or control_axes[:, : 3 if high else 2].any()
        or (high and any(height.any() for height in recording.heights()))
    ):
        return False
    targets = map(recording.target_setup, recording.targets)
    return sum(target.datum and target.approximate_mm is not None for target in targets) > 1


def _scale_target(network: NetworkRows) -> Ints:
    """Target (1,) with an azimuth from the first station that has azimuths."""
    recording, rows = network.model.recording, np.flatnonzero(network.use[:, 1])
    first = rows[np.argsort(recording.station[rows], kind="stable")][:1]
    return recording.target[first]


P = ParamSpec("P")
R = TypeVar("R")


def refusing_singular(function: Callable[Concatenate[Recording, P], R]) -> Callable[Concatenate[Recording, P], R]:
    """Decorator for functions of a recording that raises NetworkError for matrices that are unexpectedly singular."""

    @wraps(function)
    def refusing(recording: Recording, /, *args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return function(recording, *args, **kwargs)
        except np.linalg.LinAlgError:
            raise NetworkError(_sentence(recording)) from None

    return refusing


def _sentence(recording: Recording) -> str:
    """Sentence on the station and target of a network with the fewest readings."""
    count = recording.measured.sum(axis=1)
    stations = np.bincount(recording.station, count, len(recording.stations))
    targets = np.bincount(recording.target, count, len(recording.targets))
    weakest = (
        f"station {recording.stations[int(stations.argmin())]} has {stations.min():.0f} readings, "
        f"target {recording.targets[int(targets.argmin())]} has {targets.min():.0f}"
    )
    return (
        f"the equations of the network are singular: its readings leave some unknowns undetermined ({weakest}); "
        "measure range and both angles to three or more common targets from each station"
    )
