"""Approximate coordinates from the recording alone: stations are joined one by one, in closed form if possible."""

from dataclasses import replace

import numpy as np

from ltsim.adjustment.fitting import (
    Lines,
    fit_point,
    fit_pose,
    loose_lines,
    meeting_point,
    multilaterate,
    plan_of,
)
from ltsim.adjustment.frame import VERTICAL, Frame, Pairs, flat_points, on_a_line, upright_alignment
from ltsim.adjustment.sight import Sight
from ltsim.core.arrays import Bools, Floats, Ints, grouped
from ltsim.core.errors import NetworkError
from ltsim.core.notation import listing
from ltsim.geometry.alignment import robust_align
from ltsim.geometry.polar import from_polar
from ltsim.geometry.rotations import about_z, smallest_turn
from ltsim.recordings.recording import Recording

SEEDS = ("frame", "cloud", "ranges", "places", "bearings")
"""Starts of a network: known points, points of one station, ranges alone, approximate positions, plan of directions."""


def initial_network(recording: Recording) -> tuple[tuple[Floats, Floats, Floats], Bools]:
    """Positions (S, 3), rotations (S, 3, 3) and targets (T, 3) [m], and flags (T,) of unconnected targets.

    Levels and known points define the frame if there are any, otherwise the first station. The station with most known
    targets is joined next; if too few were measured with range and both angles, beams are intersected and stations
    resected, and a network of ranges alone starts with a closed-form solution. Unconnected targets get a position among
    the others and must be removed.

    Raises NetworkError if a station is not connected to the others, or if there are elevations alone.
    """
    if not recording.measured[:, :2].any():
        message = "the recording contains only elevations: horizontal positions and ranges are undetermined; "
        raise NetworkError(message + "measure azimuths or distances too")
    pairs, frame = Pairs.of(recording, flat_points(recording)), Frame.of(recording)
    grown = []
    for beginning in SEEDS if frame.has_places else SEEDS[1:]:
        grown.append(NetworkInitialiser(recording, pairs, frame))
        grown[-1].run(beginning)
        if grown[-1].is_complete:
            break
    return max(grown, key=lambda growth: growth.reach).result(grown[-1].loose)


class NetworkInitialiser:
    """Stations and targets with approximate coordinates so far, in a local frame until the declared one is reached.

    Parameters
    ----------
    recording : Recording
    pairs : Pairs
        Completely measured targets of each station, in its own frame.
    frame : Frame
    """

    def __init__(self, recording: Recording, pairs: Pairs, frame: Frame) -> None:
        self._recording, self._pairs, self._frame = recording, pairs, frame
        stations, targets = len(recording.stations), len(recording.targets)
        self._sight = Sight.of(recording)
        self._front = self._sight.readings
        self._pair_lift = pairs.of_rows(recording, self._sight.lift)
        self._position = np.full((stations, 3), np.nan)
        self._rotation = np.tile(np.eye(3), (stations, 1, 1))
        self._joined = np.zeros(stations, dtype=bool)
        self._placed = np.full((len(pairs), 3), np.nan)
        self._covered = np.zeros(targets, dtype=bool)
        self._located = np.full((targets, 3), np.nan)
        self._upright = self._anchored = self._planned = False
        self._tried: dict[int, int] = {}
        self._loose: list[tuple[int, int]] = []

    def run(self, beginning: str) -> None:
        """Initialisation from one of `SEEDS`, and transformation to the declared frame."""
        getattr(self, f"_begin_with_{beginning}")()
        steps = (self._join_by_cloud, self._join_by_yaw, self._locate, self._join_by_fit, self._anchor, self._resect)
        while not self.is_complete and any(step() for step in steps):
            pass
        self._to_final_frame()

    @property
    def is_complete(self) -> bool:
        """True if every station and target has coordinates."""
        return bool(self._joined.all() and self._have.all())

    @property
    def reach(self) -> int:
        """Number of stations and targets with coordinates."""
        return int(self._joined.sum() + self._have.sum())

    # --- what is known ---------------------------------------------------------------------------------------------

    def _target_places(self) -> Floats:
        """Targets (T, 3) so far: median of their positions from stations, or located positions."""
        places = self._located.copy()
        whole = np.flatnonzero(self._covered)
        places[whole] = self._pairs.medians(self._placed, whole)
        return places

    @property
    def _have(self) -> Bools:
        return self._covered | np.isfinite(self._located[:, 0])

    def _shared(self) -> Ints:
        """Number (S,) of targets with coordinates that each station measured completely."""
        return np.bincount(self._pairs.station[self._have[self._pairs.target]], minlength=len(self._joined))

    def _stand(self, station: int) -> Floats | None:
        """Position (3,) [m] of an unjoined station whose mark has coordinates; else None."""
        place = self._frame.marks.place(station, self._position, self._target_places())
        return place if np.isfinite(place).all() else None

    # --- steps -----------------------------------------------------------------------------------------------------

    def _place(self, station: int, position: Floats, rotation: Floats) -> None:
        self._position[station], self._rotation[station] = position, rotation
        self._joined[station] = True
        pairs = self._pairs.of_station(station)
        self._placed[pairs] = self._pairs.points[pairs] @ rotation.T + position - self._pair_lift[pairs]
        self._covered[self._pairs.target[pairs]] = True
        mark = self._frame.marks.target[station]
        if mark >= 0 and np.isnan(self._located[mark]).any():
            self._located[mark] = position - self._frame.marks.offset[station]

    def _join_by_cloud(self) -> bool:
        """Addition of the station with most known targets; levelled stations need two."""
        have = self._have
        shared = np.where(self._joined, -1, self._shared())
        for station in np.argsort(-shared, kind="stable").tolist():
            level = self._upright and bool(self._frame.level[station])
            if shared[station] < 2:
                return False
            if shared[station] < 3 and not level:
                continue
            pairs = np.arange(len(self._pairs))[self._pairs.of_station(station)]
            pairs = pairs[have[self._pairs.target[pairs]]]
            goal = self._targets(self._pairs.target[pairs]) + self._pair_lift[pairs]
            fit = robust_align if shared[station] >= 3 else upright_alignment
            try:
                rotation, position = fit(self._pairs.points[pairs], goal)
            except NetworkError:
                continue
            self._place(station, position, rotation)
            return True
        return False

    def _join_by_yaw(self) -> bool:
        """Addition of an oriented station over a known mark, once the network is in its frame."""
        for station in np.flatnonzero(self._frame.oriented & ~self._joined).tolist() if self._anchored else ():
            stand = self._stand(station)
            if stand is not None:
                self._place(station, stand, about_z(float(self._frame.yaw[station])))
                return True
        return False

    def _targets(self, which: Ints) -> Floats:
        """Known positions (k, 3) of some targets."""
        placed = self._pairs.medians(self._placed, which)
        return np.where(np.isnan(placed), self._located[which], placed)

    def _locate(self) -> bool:
        """Location of targets that joined stations measured incompletely, and of marks under joined stations."""
        recording, has_new = self._recording, False
        usable = self._joined[recording.station] & ~self._have[recording.target]
        for target, rows in grouped(recording.target, np.flatnonzero(usable)):
            if self._is_new(-1 - target, len(rows)):
                point = self._located_by(rows)
                if point is not None:
                    self._located[target], has_new = point, True
        return has_new

    def _is_new(self, key: int, effort: int) -> bool:
        """True if a station (or a target, -1 minus its index) has not failed before with as many neighbours."""
        tried, self._tried[key] = self._tried.get(key), effort
        return tried != effort

    def _located_by(self, rows: Ints) -> Floats | None:
        station = self._recording.station[rows]
        position, rotation, sight = self._position[station], self._rotation[station], self._sight.at(rows)
        front = sight.readings
        no_heights = np.isnan(front[:, 2]) & (np.isnan(front[:, 0]) | sight.horizontal)
        if self._upright and self._frame.level[station].all() and no_heights.all():
            front = np.where([False, False, True], 0.0, front)  # where directions and horizontal distances meet in plan
        beams = np.isfinite(front[:, 1:]).all(axis=1)
        if beams.sum() >= 2:
            rays = from_polar(np.column_stack([np.ones(beams.sum()), front[beams, 1:]]))
            origin = position[beams] - sight.lift[beams]
            point = meeting_point(origin, np.einsum("nij,nj->ni", rotation[beams], rays))
            if point is not None:
                return point
        return fit_point(replace(sight, readings=front), position, rotation)

    def _join_by_fit(self) -> bool:
        """Addition of a station by a fit of all its readings to known targets."""
        places, recording = self._target_places(), self._recording
        usable = ~self._joined[recording.station] & np.isfinite(places[recording.target, 0])
        groups = grouped(recording.station, np.flatnonzero(usable))
        for station, rows in sorted(groups, key=lambda group: -np.isfinite(self._front[group[1]]).sum()):
            stand = self._stand(station)
            if not self._is_new(station, 2 * len(rows) + (stand is not None)):
                continue
            level = self._upright and bool(self._frame.level[station])
            sight = self._sight.at(rows)
            pose = fit_pose(sight, places[recording.target[rows]], level=level, position=stand)
            if pose is None and level and stand is not None:  # a wrong range or elevation leaves the heading
                pose = fit_pose(sight.azimuths, places[recording.target[rows]], level=True, position=stand)
            if pose is not None:
                self._place(station, *pose)
                return True
        return False

    def _resect(self) -> bool:
        """Addition of a levelled station by resection: beams to and from other stations intersect in plan."""
        recording, over = self._recording, self._frame.marks.target
        places, ahead, turn = self._target_places(), self._rotation[:, :, 0], self._front[:, 1]
        for row in np.flatnonzero(self._joined[recording.station] & ~self._have[recording.target]).tolist():
            back = recording.station[row]
            bearing = turn[row] + np.arctan2(ahead[back, 1], ahead[back, 0])
            for station in np.flatnonzero((over == recording.target[row]) & self._frame.level & ~self._joined).tolist():
                rows = (recording.station == station) & np.isfinite(turn + places[recording.target, 0])
                zero = turn[rows & (recording.target == over[back])][:1]
                if not self._upright or not len(zero) or not np.isfinite(bearing):
                    continue
                yaw = float(bearing + np.pi - zero[0])
                angle = turn[rows] + yaw
                rays = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
                place = meeting_point(places[recording.target[rows]], rays)
                if place is not None:
                    self._place(station, place + self._frame.marks.offset[station], about_z(yaw))
                    return True
        return False

    # --- frame -----------------------------------------------------------------------------------------------------

    def _move(self, rotation: Floats, translation: Floats) -> None:
        self._rotation = rotation @ self._rotation
        moved = (places @ rotation.T + translation for places in (self._position, self._placed, self._located))
        self._position, self._placed, self._located = moved

    def _anchor(self) -> bool:
        """Transformation to the declared frame as soon as the network has enough of its points."""
        if self._anchored or not self._frame.has_places:
            return False
        turn = self._frame.upright(self._rotation, self._joined)
        heading = self._frame.heading(turn @ self._rotation, self._joined)
        motion = self._frame.motion(self._position, self._target_places(), turn, heading)
        if motion is None:
            return False
        self._move(*motion)
        self._anchored = self._upright = True
        fresh = ~self._have & np.isfinite(self._frame.points[:, 0])
        self._located[fresh] = self._frame.points[fresh]
        return True

    def _to_final_frame(self) -> None:
        """Transformation of the network to its frame: the declared one, the floor plan, or the first station's."""
        self._level_stations()
        if self._anchored or not self._joined.any() or self._anchor():
            return
        first = int(np.argmax(self._joined))
        self._move(self._rotation[first].T.copy(), -self._rotation[first].T @ self._position[first])
        turn = self._frame.upright(self._rotation, self._joined)
        heading = self._frame.heading(turn @ self._rotation, self._joined)
        turn = turn if heading is None else heading @ turn
        if not np.array_equal(turn, np.eye(3)):
            self._move(turn, np.zeros(3))
        here, there = self._frame.common(self._position, self._target_places())
        if len(here):
            self._move(np.eye(3), (there - here).mean(axis=0))
            return
        motion = None if self._frame.has_places else self._frame.plan_motion(self._position, self._rotation)
        if motion is not None:
            self._move(*motion)

    def _level_stations(self) -> None:
        """Rotations of stations without angles: upright, along the axes of the others or of the floor plan."""
        measured = np.isfinite(self._front[:, 1:]).any(axis=1)
        reads_angles = np.bincount(self._recording.station, measured, len(self._joined)) > 0
        if reads_angles.any():
            up = self._rotation[reads_angles & self._joined, :, 2].sum(axis=0)
        elif self._planned and not self._anchored:
            up = VERTICAL
        else:
            return
        if np.linalg.norm(up) > 0.0:
            turn = smallest_turn(VERTICAL, up / np.linalg.norm(up))
            for station in np.flatnonzero(~reads_angles & self._joined):
                self._rotation[station] = turn @ about_z(float(np.nan_to_num(self._frame.yaw[station])))

    # --- beginnings ------------------------------------------------------------------------------------------------

    def _begin_with_frame(self) -> None:
        """Start with the known points."""
        self._located = self._frame.points.copy()
        self._position = self._frame.stations.copy()
        self._anchored = self._upright = self._frame.has_places

    def _begin_with_cloud(self) -> None:
        """Start with a station that measured targets completely."""
        counts = np.diff(self._pairs.begin)
        if not counts.any():
            return
        first = 0 if counts[0] >= 3 else int(np.argmax(counts))
        rotation = np.eye(3)
        if self._frame.level[first]:
            rotation = smallest_turn(VERTICAL, self._frame.marks.vertical[first])
            self._upright = True
        self._place(first, np.zeros(3), rotation)

    def _begin_with_ranges(self) -> None:
        """Start with all stations that measured ranges to the same targets."""
        ranges = np.full((len(self._joined), len(self._located)), np.nan)
        ranges[self._recording.station, self._recording.target] = self._front[:, 0]
        stations = np.flatnonzero(np.isfinite(ranges).sum(axis=1) >= 3)
        targets = np.flatnonzero(np.isfinite(ranges[stations]).all(axis=0))
        network = multilaterate(ranges[np.ix_(stations, targets)])
        if network is not None:
            self._located[targets], self._planned = self._frame.placed(stations, network[0], targets, network[1])

    def _begin_with_places(self) -> None:
        """Start with all declared positions, known or approximate, and rotations averaged from azimuths."""
        self._begin_with_frame()
        self._located, marks = self._frame.near.copy(), self._frame.marks
        on_marks = self._located[marks.target] + marks.offset
        declared = np.where((marks.target >= 0)[:, None], on_marks, self._frame.stations)
        declared = np.where(np.isnan(declared), self._frame.plan, declared)
        for station in np.flatnonzero(np.isfinite(declared).all(axis=1)).tolist():
            rows = np.flatnonzero(self._recording.station == station)
            x, y, _ = (self._located[self._recording.target[rows]] - declared[station]).T
            turns = np.exp(1j * (np.arctan2(y, x) - self._front[rows, 1]))
            self._place(station, declared[station], about_z(float(np.angle(np.nansum(turns)))))

    def _begin_with_bearings(self) -> None:
        """Start with the plan from directions of upright stations and from horizontal lengths."""
        recording, frame, marks = self._recording, self._frame, self._frame.marks
        rows = np.flatnonzero(frame.level[recording.station] & np.isfinite(self._front[:, 1]))
        if not len(rows) or np.isfinite(self._front[:, 2]).any():
            return
        stands = np.where(marks.target >= 0, marks.target, len(self._located) + marks.first)
        control = np.concatenate([frame.in_plan, frame.stations])[:, :2]
        ranged = np.flatnonzero(np.isfinite(self._front[:, 0]))
        lines = Lines(stands[recording.station[ranged]], recording.target[ranged], self._front[ranged, 0])
        station, end = recording.station[rows], recording.target[rows]
        plan = plan_of(station, stands[station], end, self._front[rows, 1], control, lines)
        if plan is None:
            self._loose = loose_lines(station, stands[station], end, self._front[rows, 1], lines)
            return
        places, yaw, in_frame = np.pad(plan[0], ((0, 0), (0, 1))), plan[1], plan[2]
        if in_frame:
            self._begin_with_frame()
        for s in np.flatnonzero(np.isfinite(yaw)).tolist():
            self._place(s, places[stands[s]] + marks.offset[s], about_z(float(yaw[s])))
        self._located = np.where(np.isnan(self._located), places[: len(self._located)], self._located)
        self._anchored, self._upright = in_frame, True

    @property
    def loose(self) -> str:
        """Text of the lines of the plan without a determined length."""
        names = [*self._recording.targets, *self._recording.stations]
        lines = listing([f"{names[a]}-{names[b]}" for a, b in self._loose])
        return f"; no reading determines the horizontal length of the lines {lines}" if lines else ""

    def result(self, loose: str = "") -> tuple[tuple[Floats, Floats, Floats], Bools]:
        """Result of `initial_network`: positions, rotations and targets, flags of unconnected targets."""
        self._require_stations(loose)
        points = self._target_places()
        lost = np.asarray(np.isnan(points).any(axis=1))
        points = np.where(lost[:, None], points[~lost].mean(axis=0), points)
        return (self._frame.marks.on_marks(self._position, points), self._rotation, points), lost

    def _require_stations(self, loose: str) -> None:
        """Check that all stations have coordinates; raises NetworkError with the names of those without."""
        recording = self._recording
        if not self._joined.all():
            lost = listing([recording.stations[s] for s in np.flatnonzero(~self._joined)])
            shared = self._shared()
            nearest = int(np.argmax(np.where(self._joined, -1, shared)))
            most, pair_targets = int(shared[nearest]), self._pairs.target[self._pairs.of_station(nearest)]
            placed = pair_targets[self._have[pair_targets]]
            if most >= 3 and on_a_line(self._target_places()[placed]):
                what = f"the {most} targets that it shares with the network lie on one line; three that do not"
            else:
                what = f"shares only {most} target{'s' * (most != 1)} with the network; at least three"
            raise NetworkError(
                f"station {lost}: {what} are needed (two between levelled stations, more where ranges or angles are "
                f'missing), or approximate coordinates of all; for a station over a target, set over = "TARGET"{loose}'
            )
        if not self._have.any():
            raise NetworkError(
                f"target {', '.join(recording.targets[:10])}: no station measured range and both angles, and "
                "the lines of sight from different stations do not meet in one point"
            )
