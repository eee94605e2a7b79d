"""Declared frame of a network (known points, levels, floor plan), and list of the measured points of each station.

The list has an entry per pair of a station and a target that it measured with range and both angles: 100,000 entries
for 2,000 set-ups with 50 targets each. An array of all stations and targets would have 100 million.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.adjustment.marks import StationMarks
from ltsim.core.arrays import Bools, Floats, Ints, batches
from ltsim.core.errors import NetworkError
from ltsim.core.units import DEGREE, MILLIMETRE
from ltsim.geometry.polar import from_polar
from ltsim.geometry.rigid import VERTICAL, align_rigidly, align_robustly, rotation_about_z, smallest_rotation
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Target

MAX_FLOOR_PLAN_ERROR = 0.5
"""Largest distance [m] of an adjusted station from its position on a usable floor plan; else the plan is ignored."""
UNDECLARED_COORDINATES = (np.nan, np.nan, np.nan)
"""Coordinates (NaN) of a point without declared coordinates."""


@dataclass(frozen=True)
class DeclaredFrame:
    """Declared coordinates and directions that define the frame of S stations and T targets; NaN if undeclared."""

    declared_points: Floats
    """Coordinates (T, 3) [m] of T targets that define the frame: known ones, or approximate ones of datum targets."""
    declared_station_positions: Floats
    """Positions (S, 3) [m] of S instruments, from declared coordinates of marks; NaN over a mark that is a target."""
    is_levelled: Bools
    """Flags (S,), True for those of the S stations that are levelled."""
    marks: StationMarks
    """Marks under the stations."""
    floor_plan_positions: Floats
    """Approximate positions (S, 3) [m] of S stations on the floor plan."""
    floor_plan_yaws: Floats
    """Declared yaws (azimuth zero, counter-clockwise from x) of S stations, (S,) [rad], approximate or known."""
    has_declared_yaw: Bools
    """Flags (S,), True for those of the S stations whose yaw is known with a standard deviation, not approximate."""
    approximate_points: Floats
    """Known or approximate coordinates (T, 3) [m] of T targets."""
    xy_reference_points: Floats
    """Known x and y of T targets with height 0, (T, 3) [m]; NaN for targets without known x and y."""

    @classmethod
    def from_recording(cls, recording: Recording) -> DeclaredFrame:
        """Coordinates and directions that the `setup.toml` of a recording declares."""
        marks = StationMarks.from_recording(recording)
        setups = [recording.station_setup(name) for name in recording.stations]
        alone, by_name = (
            [name if marks.target_indices[i] < 0 else "" for i, name in enumerate(marks.mark_names)],
            _mark_coordinates_by_name(recording),
        )
        return cls(
            _points_in_metres(
                [by_name.get(name) or _declared_coordinates(recording, name) for name in recording.targets]
            ),
            _points_in_metres([by_name.get(name) or _declared_coordinates(recording, name) for name in alone])
            + marks.instrument_offsets,
            np.array([s.levelled for s in setups], dtype=bool),
            marks,
            _points_in_metres([s.position_mm or UNDECLARED_COORDINATES for s in setups]),
            np.array([np.nan if s.yaw_deg is None else s.yaw_deg * DEGREE for s in setups]),
            np.array([s.yaw_sigma_arcsec is not None for s in setups], dtype=bool),
            _points_in_metres(
                [_declared_coordinates(recording, name, datum_targets_only=False) for name in recording.targets]
            ),
            _points_in_metres([_xy_reference_coordinates(recording.target_setup(name)) for name in recording.targets]),
        )

    @property
    def has_declared_positions(self) -> bool:
        """True if at least one target or station has declared coordinates that define the frame."""
        return any(
            bool(np.isfinite(places).any())
            for places in (self.declared_points, self.declared_station_positions, self.xy_reference_points)
        )

    def network_and_declared_points(self, position: Floats, points: Floats) -> tuple[Floats, Floats]:
        """Coordinates (k, 3) [m] of k stations and targets in a network, and their declared coordinates (k, 3).

        `position` (S, 3) [m] are the S stations and `points` (T, 3) [m] the T targets of the network. Stations and
        targets without declared coordinates are left out.
        """
        here, there = (
            np.concatenate([position, points]),
            np.concatenate([self.declared_station_positions, self.declared_points]),
        )
        is_common = np.isfinite(here).all(axis=1) & np.isfinite(there).all(axis=1)
        return here[is_common], there[is_common]

    def motion_into_frame(
        self, position: Floats, points: Floats, levelling_rotation: Floats, heading_rotation: Floats | None = None
    ) -> tuple[Floats, Floats] | None:
        """Rotation (3, 3) and translation (3,) [m] of a network into the declared frame; None if undetermined.

        `position` (S, 3) [m] and `points` (T, 3) [m] are the S stations and T targets of the network.
        `levelling_rotation` (3, 3) makes levelled stations upright; `heading_rotation` (3, 3) is a subsequent rotation
        about the vertical, to the known yaws of stations.
        """
        here, there = self.network_and_declared_points(position, points)
        if len(here) >= 3 and not are_collinear(there):
            return align_robustly(here, there)
        height = float(np.mean(there[:, 2] - (here @ levelling_rotation.T)[:, 2])) if len(here) else 0.0
        if len(here) < 2:
            both = np.isfinite(points).all(axis=1) & np.isfinite(self.xy_reference_points).all(axis=1)
            here, there = points[both], self.xy_reference_points[both]
        if heading_rotation is not None and len(here) == 1:
            shift = there[0] - heading_rotation @ levelling_rotation @ here[0]
            return heading_rotation @ levelling_rotation, np.array([*shift[:2], height])
        if not self.is_levelled.any() or len(here) < 2:
            return None
        try:
            rotation, translation = upright_alignment(here @ levelling_rotation.T, there)
        except NetworkError:
            return None
        return rotation @ levelling_rotation, np.array([*translation[:2], height])

    def motion_to_floor_plan(self, position: Floats, rotation: Floats) -> tuple[Floats, Floats] | None:
        """Rotation about z (3, 3) and translation (3,) [m] of a network without known points to the floor plan.

        `position` (S, 3) [m], `rotation` (S, 3, 3): S poses. The result is None without two stations, or one with its
        yaw, on the floor plan, and if a station misses its position by `MAX_FLOOR_PLAN_ERROR` or more.
        """
        planned_indices = np.flatnonzero(
            np.isfinite(self.floor_plan_positions).all(axis=1) & np.isfinite(position).all(axis=1)
        )
        here, there = position[planned_indices], self.floor_plan_positions[planned_indices]
        if len(planned_indices) > 1:
            try:
                motion = upright_alignment(here, there)
            except NetworkError:
                return None
            return motion if alignment_distances(here, there, motion).max() < MAX_FLOOR_PLAN_ERROR else None
        if not len(planned_indices) or not np.isfinite(self.floor_plan_yaws[planned_indices[0]]):
            return None
        headings = rotation[planned_indices[0], :, 0]
        turn = rotation_about_z(float(self.floor_plan_yaws[planned_indices[0]] - np.arctan2(headings[1], headings[0])))
        return turn, there[0] - turn @ here[0]

    def mirror_factors(self, network_points: Floats, declared_points: Floats) -> Floats | None:
        """Factors (3,) on the coordinates of a network of ranges alone: (1, 1, -1) mirrors it, (1, 1, 1) does not.

        Ranges alone do not distinguish the network from its mirror image. `declared_points` (k, 3) [m], NaN if not
        declared, of the k `network_points` (k, 3) [m] show if it is mirrored, unless they are coplanar; then the result
        is None.
        """
        has_place = np.isfinite(declared_points).all(axis=1)
        network_points, declared_points = network_points[has_place], declared_points[has_place]
        if len(network_points) < 4 or _rms_distance_from_plane(declared_points) < MAX_FLOOR_PLAN_ERROR:
            return None
        both = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, -1.0]])
        rests = [
            np.linalg.norm(
                alignment_distances(
                    network_points * factors, declared_points, align_rigidly(network_points * factors, declared_points)
                )
            )
            for factors in both
        ]
        return both[int(np.argmin(rests))]

    def resolves_mirror(self, position: Floats, points: Floats) -> bool:
        """True if declared coordinates distinguish a network of ranges alone from its mirror image.

        The network has S stations at `position` (S, 3) [m] and T targets at `points` (T, 3) [m].
        """
        return (
            self.mirror_factors(
                np.concatenate([position, points]), np.concatenate([self.floor_plan_positions, self.approximate_points])
            )
            is not None
        )

    def place_range_network(
        self, stations: Ints, position: Floats, targets: Ints, points: Floats
    ) -> tuple[Floats, bool]:
        """Targets (t, 3) [m] of a network of ranges alone, moved to approximate coordinates; True if these suffice.

        If the network is a mirror image, it is mirrored first. Approximate coordinates suffice to define the frame if
        they have three points that are not collinear. `stations` and `targets` are the indices of s stations and t
        targets, `position` (s, 3) and `points` (t, 3) [m] their coordinates.
        """
        here, there = (
            np.concatenate([position, points]),
            np.concatenate([self.floor_plan_positions[stations], self.approximate_points[targets]]),
        )
        factors = self.mirror_factors(here, there)
        if factors is not None:
            here, points = here * factors, points * factors
        has_place = np.isfinite(there).all(axis=1)
        if has_place.sum() < 3 or are_collinear(there[has_place]):
            return points, False
        rotation, shift = align_rigidly(here[has_place], there[has_place])
        return points @ rotation.T + shift, True

    def agrees_with_floor_plan(self, position: Floats, rotation: Floats) -> bool:
        """True if all stations of a network are nearer than `MAX_FLOOR_PLAN_ERROR` to their places on the floor plan.

        The places are those after the best motion of the network to the floor plan. `position` (S, 3) [m] and
        `rotation` (S, 3, 3) are the poses of the S stations.
        """
        motion = self.motion_to_floor_plan(position, rotation)
        return motion is not None and bool(alignment_distances(position, position, motion).max() < MAX_FLOOR_PLAN_ERROR)

    def rotation_to_declared_yaws(self, rotation: Floats, is_joined_station: Bools) -> Floats | None:
        """Rotation (3, 3) about z that turns a levelled network to the known yaws of its stations; None without yaws.

        `rotation` (S, 3, 3) are those of S stations, `is_joined_station` (S,) flags the stations in the network.
        """
        mask = self.has_declared_yaw & is_joined_station
        if not mask.any():
            return None
        headings = rotation[mask, :, 0]
        turns = self.floor_plan_yaws[mask] - np.arctan2(headings[:, 1], headings[:, 0])
        return rotation_about_z(float(np.angle(np.sum(np.exp(1j * turns)))))

    def levelling_rotation(self, rotation: Floats, is_joined_station: Bools) -> Floats:
        """Smallest rotation (3, 3) from the mean standing axis of levelled stations to their mean plumb line.

        `rotation` (S, 3, 3) are those of S stations, `is_joined_station` (S,) flags the stations in the network.
        """
        mask = self.is_levelled & is_joined_station
        if not mask.any():
            return np.eye(3)
        axis = (rotation[mask] @ VERTICAL).mean(axis=0)
        goal = self.marks.plumb_directions[mask].mean(axis=0)
        return smallest_rotation(axis / np.linalg.norm(axis), goal / np.linalg.norm(goal))


def _mark_coordinates_by_name(recording: Recording) -> dict[str, tuple[float, ...]]:
    """Coordinates [mm] by name: of known marks, and of marks that known differences connect to known marks."""
    targets = recording.setup.targets
    places: dict[str, tuple[float, ...]] = {
        name: target.known_mm
        for name, target in targets.items()
        if target.known_mm is not None and target.known_axes == "xyz"
    }
    differences = [difference for difference in recording.setup.differences if difference.known_axes == "xyz"]
    while ends := [
        (difference, difference.to in places)
        for difference in differences
        if (difference.from_ in places) != (difference.to in places)
    ]:
        for difference, back in ends:
            there, here, sign = (
                (difference.to, difference.from_, -1.0) if back else (difference.from_, difference.to, 1.0)
            )
            places[here] = tuple(a + sign * b for a, b in zip(places[there], difference.known_mm, strict=True))
    return places


def _declared_coordinates(recording: Recording, name: str, *, datum_targets_only: bool = True) -> tuple[float, ...]:
    """Known coordinates [mm] of the target `name`, otherwise its approximate coordinates, otherwise NaN.

    With `datum_targets_only`, approximate coordinates are used only for targets of the datum.
    """
    target = recording.target_setup(name) if name else None
    if target is None:
        return UNDECLARED_COORDINATES
    if target.known_mm is not None and target.known_axes == "xyz":
        return target.known_mm
    return (target.approximate_mm if target.datum or not datum_targets_only else None) or UNDECLARED_COORDINATES


def _xy_reference_coordinates(target: Target) -> tuple[float, ...]:
    """Known x and y of a target, with height 0 [mm]; NaN for a target without known x and y."""
    if target.known_mm is None or not target.known_axes.startswith("xy"):
        return UNDECLARED_COORDINATES
    return *target.known_mm[:2], 0.0


def _points_in_metres(coordinates_mm: list[tuple[float, ...]]) -> Floats:
    """Points (k, 3) [m] from the coordinates of k points in millimetres."""
    return np.array(coordinates_mm, dtype=np.float64).reshape(-1, 3) * MILLIMETRE


def _rms_distance_from_plane(points: Floats) -> float:
    """Root-mean-square distance [m] of k points (k, 3) from their best-fit plane."""
    return float(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[2] / np.sqrt(len(points)))


def are_collinear(points: Floats) -> bool:
    """True if k points (k, 3) are collinear: extent across the best-fit line is at most 0.1 % of that along it."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] <= 1e-3 * spread[0])


def alignment_distances(points: Floats, goal_points: Floats, motion: tuple[Floats, Floats]) -> Floats:
    """Distances (k,) [m] of points (k, 3) from their goals after `motion`: rotation (3, 3), translation (3,)."""
    return np.asarray(np.linalg.norm(points @ motion[0].T + motion[1] - goal_points, axis=1))


def upright_alignment(source: Floats, goal_points: Floats) -> tuple[Floats, Floats]:
    """Rotation about z (3, 3) and translation (3,) [m] that align k points `source` (k, 3) to `goal_points` (k, 3).

    Raises NetworkError if all points lie on one vertical line.
    """
    a, b = (source - source.mean(axis=0))[:, :2], (goal_points - goal_points.mean(axis=0))[:, :2]
    if not np.sum(a * a) > 1e-9 * np.sum((source - source.mean(axis=0)) ** 2):
        raise NetworkError("an alignment about the vertical needs points with different horizontal positions")
    yaw = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    rotation = rotation_about_z(float(yaw))
    return rotation, np.asarray(goal_points.mean(axis=0) - rotation @ source.mean(axis=0))


@dataclass(frozen=True)
class StationTargetPairs:
    """List of the m pairs of a station and a target that it measured with range and both angles, station by station."""

    station_indices: Ints
    """Index of the station of each of m pairs, (m,)."""
    target_indices: Ints
    """Index of the target of each of m pairs, (m,)."""
    local_points: Floats
    """Coordinates of the target of each of m pairs in the frame of its station, (m, 3) [m]."""
    first_pair_of_station: Ints
    """Index of the first pair of each of S stations, followed by the number of pairs, (S + 1,)."""
    pair_order_by_target: Ints
    """Indices of the m pairs in the order of their targets, (m,)."""
    first_pair_of_target: Ints
    """Index in `pair_order_by_target` of the first pair of each of T targets, then the number of pairs, (T + 1,)."""

    @classmethod
    def from_recording(cls, recording: Recording, points: Floats | None = None) -> StationTargetPairs:
        """Station-target pairs of a recording, each with its median point over faces and repeats (robust to a blunder).

        `points` (n, 3) [m] are the measured points of n pointings in the instrument frame, by default computed from the
        readings without correction.
        """
        stations, targets = len(recording.stations), len(recording.targets)
        measured = from_polar(recording.readings) if points is None else points
        complete_rows = np.flatnonzero(np.isfinite(measured).all(axis=1))
        key = recording.station[complete_rows] * targets + recording.target[complete_rows]
        by_key = np.argsort(key, kind="stable")
        where, first, count = np.unique(key[by_key], return_index=True, return_counts=True)
        centres = np.zeros((len(where), 3))
        for repeats in np.unique(count):
            group = np.flatnonzero(count == repeats)
            centres[group] = np.median(
                measured[complete_rows[by_key[first[group][:, None] + np.arange(repeats)]]], axis=1
            )
        station, target = np.divmod(where, max(targets, 1))
        order = np.argsort(target, kind="stable")
        starts = np.searchsorted(station, np.arange(stations + 1))
        return cls(station, target, centres, starts, order, np.searchsorted(target[order], np.arange(targets + 1)))

    def __len__(self) -> int:
        return len(self.station_indices)

    def pair_slice_of_station(self, station: int) -> slice:
        """Slice that selects the station-target pairs of one station, given by its index `station`."""
        return slice(int(self.first_pair_of_station[station]), int(self.first_pair_of_station[station + 1]))

    def last_values_by_pair(self, recording: Recording, pointing_values: Floats) -> Floats:
        """Values (m, 3) of m pairs, each that of the last pointing of the pair, from `pointing_values` (n, 3)."""
        by_pair = np.zeros((len(self), 3))
        keys = self.station_indices * len(recording.targets) + self.target_indices
        pair_keys = recording.station * len(recording.targets) + recording.target
        pair_rows = np.flatnonzero(np.isin(pair_keys, keys))
        by_pair[np.searchsorted(keys, pair_keys[pair_rows])] = pointing_values[pair_rows]
        return by_pair

    def medians_by_target(self, pair_values: Floats, targets: Ints) -> Floats:
        """Medians (k, 3) of `pair_values` (m, 3) over the stations of each of k `targets`; NaN if all are NaN."""
        medians = np.full((len(targets), 3), np.nan)
        for part in batches(len(targets), 3 * int(np.diff(self.first_pair_of_target).max(initial=1))):
            first, end = self.first_pair_of_target[targets[part]], self.first_pair_of_target[targets[part] + 1]
            place = first[:, None] + np.arange((end - first).max(initial=0))
            pair = self.pair_order_by_target[np.minimum(place, len(self) - 1)]
            medians[part] = _nan_median(np.where((place < end[:, None])[:, :, None], pair_values[pair], np.nan))
        return medians


def _nan_median(values: Floats) -> Floats:
    """Medians (t, 3) over axis 1 of `values` (t, k, 3), ignoring NaN; NaN if all values are NaN."""
    if not values.shape[1]:
        return np.full((len(values), 3), np.nan)
    sorted_values = np.sort(values, axis=1)
    n_finite = np.isfinite(values[:, :, 0]).sum(axis=1)
    group_indices = np.arange(len(values))
    return 0.5 * (sorted_values[group_indices, (n_finite - 1) // 2] + sorted_values[group_indices, n_finite // 2])


def points_with_slope_distances(recording: Recording) -> Floats | None:
    """Points (n, 3) [m] of n pointings if horizontal distances are read as slope distances; None without such ones."""
    is_horizontal_distance = recording.is_horizontal_distance
    if not is_horizontal_distance.any():
        return None
    readings = recording.readings.copy()
    if not np.isfinite(readings[:, 2]).any():
        readings[is_horizontal_distance, 2] = 0.0  # a network in plan has no elevations
    readings[is_horizontal_distance, 0] /= np.abs(np.cos(readings[is_horizontal_distance, 2]))
    return from_polar(readings)
