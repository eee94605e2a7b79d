"""Approximate coordinates of stations and targets from a recording: stations are joined to the network one by one."""

from dataclasses import replace

import numpy as np

from ltsim.adjustment.fit_readings import FitReadings
from ltsim.adjustment.fitting import (
    HorizontalLengths,
    beam_intersection,
    fit_horizontal_network,
    fit_point,
    fit_pose,
    lines_of_undetermined_length,
    multilaterate,
)
from ltsim.adjustment.frame import DeclaredFrame, StationTargetPairs, points_with_slope_distances, upright_alignment
from ltsim.adjustment.opposite_sights import with_ranges_of_opposite_sights
from ltsim.adjustment.start_errors import require_connected_stations, require_located_target
from ltsim.core.arrays import Bools, Floats, Ints, group_rows
from ltsim.core.errors import NetworkError
from ltsim.core.notation import names_text
from ltsim.geometry.polar import from_polar
from ltsim.geometry.rigid import VERTICAL, align_robustly, rotation_about_z, smallest_rotation
from ltsim.recordings.recording import Recording

INITIALISATION_METHODS = ("frame", "cloud", "ranges", "positions", "bearings")
"""Methods for first coordinates: known points, one station's points, ranges, declared positions, directions."""


def initial_network(recording: Recording) -> tuple[tuple[Floats, Floats, Floats], Bools]:
    """Start positions (S, 3), rotations (S, 3, 3) of S stations; T targets (T, 3); flags (T,) of unconnected targets.

    Levels and known points define the frame; without levels and known points, the first station defines it. The station
    that measured most targets with coordinates is joined next. If too few targets were measured with range and both
    angles, beams are intersected and stations resected. A network of ranges alone starts with a closed-form solution.
    Unconnected targets get the mean position of the others, to be removed by the caller. Coordinates are in metres.

    Raises NetworkError if a station is not connected to the others, or if there are elevations alone.
    """
    if not recording.is_measured[:, :2].any():
        message = "the recording contains only elevations, which do not determine horizontal positions"
        raise NetworkError(f"{message}; measure azimuths or distances too")
    frame = DeclaredFrame.from_recording(recording)
    grown: list[NetworkInitialiser] = []
    for uses_opposite_sights in (False, True):
        if grown and grown[-1].is_complete:
            break
        source = with_ranges_of_opposite_sights(recording, frame.marks) if uses_opposite_sights else recording
        if uses_opposite_sights and source is recording:
            break
        pairs = StationTargetPairs.from_recording(source, points_with_slope_distances(source))
        for method in INITIALISATION_METHODS if frame.has_declared_positions else INITIALISATION_METHODS[1:]:
            grown.append(NetworkInitialiser(source, pairs, frame))
            grown[-1].run(method)
            if grown[-1].is_complete:
                break
    return max(grown, key=lambda growth: growth.n_located_points).result(grown[-1].undetermined_lines_text)


class NetworkInitialiser:
    """Computation of approximate coordinates: stations are joined to the network one by one, first in a local frame.

    Parameters
    ----------
    recording : Recording
    station_target_pairs : StationTargetPairs
        Targets that each station measured with range and both angles, in the frame of the station.
    frame : DeclaredFrame
    """

    def __init__(self, recording: Recording, station_target_pairs: StationTargetPairs, frame: DeclaredFrame) -> None:
        self._recording, self._pairs, self._frame = recording, station_target_pairs, frame
        stations, targets = len(recording.stations), len(recording.targets)
        self._readings = FitReadings.from_recording(recording)
        self._front_readings = self._readings.readings
        self._pair_offsets = station_target_pairs.last_values_by_pair(recording, self._readings.sight_vector_offsets)
        self._positions = np.full((stations, 3), np.nan)
        self._rotations = np.tile(np.eye(3), (stations, 1, 1))
        self._is_joined = np.zeros(stations, dtype=bool)
        self._pair_points = np.full((len(station_target_pairs), 3), np.nan)
        self._is_covered = np.zeros(targets, dtype=bool)
        self._located_targets = np.full((targets, 3), np.nan)
        self._is_levelled = self._is_in_frame = self._is_from_plan = False
        self._failed_attempts: dict[int, int] = {}
        self._open_lines: list[tuple[int, int]] = []

    def run(self, method: str) -> None:
        """Computation of all coordinates, with first coordinates by one of `INITIALISATION_METHODS`."""
        getattr(self, f"_begin_with_{method}")()
        joins = self._join_by_cloud, self._join_by_yaw, self._locate_targets_and_marks, self._join_by_fit
        steps = (*joins, self._to_declared_frame, self._resect_horizontally)
        while not self.is_complete and any(step() for step in steps):
            pass
        self._to_final_frame()

    @property
    def is_complete(self) -> bool:
        """True if every station and target has coordinates."""
        return bool(self._is_joined.all() and self._has_coordinates.all())

    @property
    def n_located_points(self) -> int:
        """Number of stations and targets with coordinates."""
        return int(self._is_joined.sum() + self._has_coordinates.sum())

    def _target_points(self) -> Floats:
        """Present positions (T, 3) [m] of T targets: medians over joined stations, else fitted or declared; or NaN."""
        places = self._located_targets.copy()
        complete_rows = np.flatnonzero(self._is_covered)
        places[complete_rows] = self._pairs.medians_by_target(self._pair_points, complete_rows)
        return places

    @property
    def _has_coordinates(self) -> Bools:
        """Flags (T,), True for those of the T targets that have coordinates already."""
        return self._is_covered | np.isfinite(self._located_targets[:, 0])

    def _shared_target_counts(self) -> Ints:
        """Numbers (S,) of targets with coordinates that each of S stations measured with range and both angles."""
        stations = self._pairs.station_indices[self._has_coordinates[self._pairs.target_indices]]
        return np.bincount(stations, minlength=len(self._is_joined))

    def _position_from_mark(self, station: int) -> Floats | None:
        """Position (3,) [m] of a station over a mark with coordinates; otherwise None."""
        place = self._frame.marks.position_from_mark(station, self._positions, self._target_points())
        return place if np.isfinite(place).all() else None

    def _join_station(self, station: int, position: Floats, rotation: Floats) -> None:
        """Assignment of a pose to the station with the index `station`, and of coordinates to its targets and mark."""
        self._positions[station], self._rotations[station] = position, rotation
        self._is_joined[station] = True
        pairs = self._pairs.pair_slice_of_station(station)
        self._pair_points[pairs] = self._pairs.local_points[pairs] @ rotation.T + position - self._pair_offsets[pairs]
        self._is_covered[self._pairs.target_indices[pairs]] = True
        mark = self._frame.marks.target_indices[station]
        if mark >= 0 and np.isnan(self._located_targets[mark]).any():
            self._located_targets[mark] = position - self._frame.marks.instrument_offsets[station]

    def _join_by_cloud(self) -> bool:
        """True if a station was joined by aligning its points to three or more targets, or two if it is levelled."""
        have = self._has_coordinates
        shared = np.where(self._is_joined, -1, self._shared_target_counts())
        for station in np.argsort(-shared, kind="stable").tolist():
            level = self._is_levelled and bool(self._frame.is_levelled[station])
            if shared[station] < 2:
                return False
            if shared[station] < 3 and not level:
                continue
            pairs = np.arange(len(self._pairs))[self._pairs.pair_slice_of_station(station)]
            pairs = pairs[have[self._pairs.target_indices[pairs]]]
            goal = self._target_coordinates(self._pairs.target_indices[pairs]) + self._pair_offsets[pairs]
            fit = align_robustly if shared[station] >= 3 else upright_alignment
            try:
                rotation, position = fit(self._pairs.local_points[pairs], goal)
            except NetworkError:
                continue
            self._join_station(station, position, rotation)
            return True
        return False

    def _join_by_yaw(self) -> bool:
        """True if a station was joined by its known yaw and its known mark, which requires the declared frame."""
        oriented_indices = np.flatnonzero(self._frame.has_declared_yaw & ~self._is_joined).tolist()
        for station in oriented_indices if self._is_in_frame else ():
            stand = self._position_from_mark(station)
            if stand is not None:
                self._join_station(station, stand, rotation_about_z(float(self._frame.floor_plan_yaws[station])))
                return True
        return False

    def _target_coordinates(self, targets: Ints) -> Floats:
        """Approximate positions (k, 3) [m] of the k targets with the indices `targets` (k,)."""
        placed = self._pairs.medians_by_target(self._pair_points, targets)
        return np.where(np.isnan(placed), self._located_targets[targets], placed)

    def _locate_targets_and_marks(self) -> bool:
        """True if a target or mark got coordinates from readings of joined stations without range or an angle."""
        recording, has_new = self._recording, False
        usable = self._is_joined[recording.station] & ~self._has_coordinates[recording.target]
        for target, rows in group_rows(recording.target, np.flatnonzero(usable)):
            if self._is_fit_worth_trying(-1 - target, len(rows)):
                point = self._locate_point(rows)
                if point is not None:
                    self._located_targets[target], has_new = point, True
        return has_new

    def _is_fit_worth_trying(self, key: int, n_neighbours: int) -> bool:
        """True unless a fit with as many neighbours failed; `key` is a station index, or -1 minus a target index."""
        tried, self._failed_attempts[key] = self._failed_attempts.get(key), n_neighbours
        return tried != n_neighbours

    def _locate_point(self, pointing_indices: Ints) -> Floats | None:
        """Point (3,) [m] of a target from pointings of joined stations; None if they do not determine it."""
        station = self._recording.station[pointing_indices]
        position, rotation = self._positions[station], self._rotations[station]
        sight = self._readings.select_rows(pointing_indices)
        front = sight.readings
        no_heights = np.isnan(front[:, 2]) & (np.isnan(front[:, 0]) | sight.has_horizontal_distance)
        if self._is_levelled and self._frame.is_levelled[station].all() and no_heights.all():
            front = np.where([False, False, True], 0.0, front)  # directions and horizontal distances intersect in plan
        beams = np.isfinite(front[:, 1:]).all(axis=1)
        if beams.sum() >= 2:
            rays = from_polar(np.column_stack([np.ones(beams.sum()), front[beams, 1:]]))
            origin = position[beams] - sight.sight_vector_offsets[beams]
            point = beam_intersection(origin, np.einsum("nij,nj->ni", rotation[beams], rays))
            if point is not None:
                return point
        return fit_point(replace(sight, readings=front), position, rotation)

    def _join_by_fit(self) -> bool:
        """True if a station was joined by a fit of all its readings to targets with coordinates."""
        places, recording = self._target_points(), self._recording
        usable = ~self._is_joined[recording.station] & np.isfinite(places[recording.target, 0])
        groups = group_rows(recording.station, np.flatnonzero(usable))
        for station, rows in sorted(groups, key=lambda group: -np.isfinite(self._front_readings[group[1]]).sum()):
            stand = self._position_from_mark(station)
            if not self._is_fit_worth_trying(station, 2 * len(rows) + (stand is not None)):
                continue
            level = self._is_levelled and bool(self._frame.is_levelled[station])
            sight = self._readings.select_rows(rows)
            pose = fit_pose(sight, places[recording.target[rows]], is_levelled=level, position=stand)
            if pose is None and level and stand is not None:  # the azimuths alone determine the heading
                pose = fit_pose(sight.only_azimuths, places[recording.target[rows]], is_levelled=True, position=stand)
            if pose is not None:
                self._join_station(station, *pose)
                return True
        return False

    def _resect_horizontally(self) -> bool:
        """True if a levelled station was joined by horizontal directions (backsight and resection)."""
        recording, over = self._recording, self._frame.marks.target_indices
        places, ahead, turn = self._target_points(), self._rotations[:, :, 0], self._front_readings[:, 1]
        usable = self._is_joined[recording.station] & ~self._has_coordinates[recording.target]
        for row in np.flatnonzero(usable).tolist():
            back = recording.station[row]
            bearing = turn[row] + np.arctan2(ahead[back, 1], ahead[back, 0])
            is_over_target = (over == recording.target[row]) & self._frame.is_levelled & ~self._is_joined
            for station in np.flatnonzero(is_over_target).tolist():
                rows = (recording.station == station) & np.isfinite(turn + places[recording.target, 0])
                zero = turn[rows & (recording.target == over[back])][:1]
                if not self._is_levelled or not len(zero) or not np.isfinite(bearing):
                    continue
                yaw = float(bearing + np.pi - zero[0])
                angle = turn[rows] + yaw
                rays = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
                place = beam_intersection(places[recording.target[rows]], rays)
                if place is not None:
                    position = place + self._frame.marks.instrument_offsets[station]
                    self._join_station(station, position, rotation_about_z(yaw))
                    return True
        return False

    # --- frame -----------------------------------------------------------------------------------------------------

    def _transform(self, rotation: Floats, translation: Floats) -> None:
        """Rigid motion of all present coordinates by a rotation (3, 3) and a translation (3,) [m]."""
        self._rotations = rotation @ self._rotations
        points = (self._positions, self._pair_points, self._located_targets)
        moved_points = (places @ rotation.T + translation for places in points)
        self._positions, self._pair_points, self._located_targets = moved_points

    def _to_declared_frame(self) -> bool:
        """True if the network was moved to the declared frame, which requires enough declared points."""
        if self._is_in_frame or not self._frame.has_declared_positions:
            return False
        turn = self._frame.levelling_rotation(self._rotations, self._is_joined)
        heading = self._frame.rotation_to_declared_yaws(turn @ self._rotations, self._is_joined)
        motion = self._frame.motion_into_frame(self._positions, self._target_points(), turn, heading)
        if motion is None:
            return False
        self._transform(*motion)
        self._is_in_frame = self._is_levelled = True
        fresh = ~self._has_coordinates & np.isfinite(self._frame.declared_points[:, 0])
        self._located_targets[fresh] = self._frame.declared_points[fresh]
        return True

    def _to_final_frame(self) -> None:
        """Motion of the network to the declared frame, the floor plan, or the frame of the first station."""
        self._rotate_stations_without_angles()
        if self._is_in_frame or not self._is_joined.any() or self._to_declared_frame():
            return
        first = int(np.argmax(self._is_joined))
        self._transform(self._rotations[first].T.copy(), -self._rotations[first].T @ self._positions[first])
        turn = self._frame.levelling_rotation(self._rotations, self._is_joined)
        heading = self._frame.rotation_to_declared_yaws(turn @ self._rotations, self._is_joined)
        turn = turn if heading is None else heading @ turn
        if not np.array_equal(turn, np.eye(3)):
            self._transform(turn, np.zeros(3))
        here, there = self._frame.network_and_declared_points(self._positions, self._target_points())
        if len(here):
            self._transform(np.eye(3), (there - here).mean(axis=0))
            return
        has_places = self._frame.has_declared_positions
        motion = None if has_places else self._frame.motion_to_floor_plan(self._positions, self._rotations)
        if motion is not None:
            self._transform(*motion)

    def _rotate_stations_without_angles(self) -> None:
        """Assignment of rotations to stations without angles: upright as the other stations or the floor plan."""
        is_measured = np.isfinite(self._front_readings[:, 1:]).any(axis=1)
        reads_angles = np.bincount(self._recording.station, is_measured, len(self._is_joined)) > 0
        if reads_angles.any():
            up = self._rotations[reads_angles & self._is_joined, :, 2].sum(axis=0)
        elif self._is_from_plan and not self._is_in_frame:
            up = VERTICAL
        else:
            return
        if np.linalg.norm(up) > 0.0:
            turn = smallest_rotation(VERTICAL, up / np.linalg.norm(up))
            yaws = np.nan_to_num(self._frame.floor_plan_yaws)
            for station in np.flatnonzero(~reads_angles & self._is_joined):
                self._rotations[station] = turn @ rotation_about_z(float(yaws[station]))

    # --- initialisation methods ------------------------------------------------------------------------------------

    def _begin_with_frame(self) -> None:
        """Assignment of the first coordinates of a network: declared coordinates of targets and marks."""
        self._located_targets = self._frame.declared_points.copy()
        self._positions = self._frame.declared_station_positions.copy()
        self._is_in_frame = self._is_levelled = self._frame.has_declared_positions

    def _begin_with_cloud(self) -> None:
        """Assignment of the first coordinates of a network: one station and the targets that it measured completely."""
        counts = np.diff(self._pairs.first_pair_of_station)
        if not counts.any():
            return
        first_station = 0 if counts[0] >= 3 else int(np.argmax(counts))
        rotation = np.eye(3)
        if self._frame.is_levelled[first_station]:
            rotation = smallest_rotation(VERTICAL, self._frame.marks.plumb_directions[first_station])
            self._is_levelled = True
        self._join_station(first_station, np.zeros(3), rotation)

    def _begin_with_ranges(self) -> None:
        """Assignment of the first coordinates of a network of ranges between stations and common targets."""
        ranges = np.full((len(self._is_joined), len(self._located_targets)), np.nan)
        ranges[self._recording.station, self._recording.target] = self._front_readings[:, 0]
        stations = np.flatnonzero(np.isfinite(ranges).sum(axis=1) >= 3)
        targets = np.flatnonzero(np.isfinite(ranges[stations]).all(axis=0))
        network = multilaterate(ranges[np.ix_(stations, targets)])
        if network is not None:
            placed = self._frame.place_range_network(stations, network[0], targets, network[1])
            self._located_targets[targets], self._is_from_plan = placed

    def _begin_with_positions(self) -> None:
        """Assignment of first coordinates to a network: all declared positions, and rotations from mean azimuths."""
        self._begin_with_frame()
        self._located_targets, marks = self._frame.approximate_points.copy(), self._frame.marks
        on_marks = self._located_targets[marks.target_indices] + marks.instrument_offsets
        declared = np.where((marks.target_indices >= 0)[:, None], on_marks, self._frame.declared_station_positions)
        declared = np.where(np.isnan(declared), self._frame.floor_plan_positions, declared)
        for station in np.flatnonzero(np.isfinite(declared).all(axis=1)).tolist():
            rows = np.flatnonzero(self._recording.station == station)
            x, y, _ = (self._located_targets[self._recording.target[rows]] - declared[station]).T
            turns = np.exp(1j * (np.arctan2(y, x) - self._front_readings[rows, 1]))
            self._join_station(station, declared[station], rotation_about_z(float(np.angle(np.nansum(turns)))))

    def _begin_with_bearings(self) -> None:
        """Assignment of first horizontal coordinates, from directions of upright stations and horizontal lengths."""
        recording, frame, marks = self._recording, self._frame, self._frame.marks
        bearing_rows = np.flatnonzero(frame.is_levelled[recording.station] & np.isfinite(self._front_readings[:, 1]))
        if not len(bearing_rows) or np.isfinite(self._front_readings[:, 2]).any():
            return
        over, extra = marks.target_indices, len(self._located_targets) + marks.first_setup_on_mark
        stands = np.where(over >= 0, over, extra)
        control = np.concatenate([frame.xy_reference_points, frame.declared_station_positions])[:, :2]
        ranged_indices = np.flatnonzero(np.isfinite(self._front_readings[:, 0]))
        starts, ends = stands[recording.station[ranged_indices]], recording.target[ranged_indices]
        lines = HorizontalLengths(starts, ends, self._front_readings[ranged_indices, 0])
        station, end = recording.station[bearing_rows], recording.target[bearing_rows]
        azimuths = self._front_readings[bearing_rows, 1]
        plan = fit_horizontal_network(station, stands[station], end, azimuths, control, lines)
        if plan is None:
            self._open_lines = lines_of_undetermined_length(station, stands[station], end, azimuths, lines)
            return
        places, yaw, in_frame = np.pad(plan[0], ((0, 0), (0, 1))), plan[1], plan[2]
        if in_frame:
            self._begin_with_frame()
        for s in np.flatnonzero(np.isfinite(yaw)).tolist():
            self._join_station(s, places[stands[s]] + marks.instrument_offsets[s], rotation_about_z(float(yaw[s])))
        located = self._located_targets
        self._located_targets = np.where(np.isnan(located), places[: len(located)], located)
        self._is_in_frame, self._is_levelled = in_frame, True

    @property
    def undetermined_lines_text(self) -> str:
        """Text, for the end of a message, on lines whose horizontal length no reading determines; or empty."""
        ends = [*self._recording.targets, *self._recording.stations]
        lines = names_text([f"{ends[a]}-{ends[b]}" for a, b in self._open_lines])
        return f"; no reading determines the horizontal length of the lines {lines}" if lines else ""

    def result(self, undetermined_lines_text: str = "") -> tuple[tuple[Floats, Floats, Floats], Bools]:
        """Result of `initial_network`; the error for unconnected stations ends with `undetermined_lines_text`."""
        points = self._target_points()
        require_connected_stations(self._recording, self._frame.marks, self._is_joined, points, undetermined_lines_text)
        require_located_target(self._recording, self._has_coordinates)
        is_lost = np.asarray(np.isnan(points).any(axis=1))
        points = np.where(is_lost[:, None], points[~is_lost].mean(axis=0), points)
        return (self._frame.marks.positions_on_marks(self._positions, points), self._rotations, points), is_lost
