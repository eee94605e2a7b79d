"""A network put together station by station from what is known already."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ltsim.adjustment.fitting import Sight, fit_point, fit_pose
from ltsim.adjustment.frame import VERTICAL, Frame, on_a_line, upright_alignment
from ltsim.adjustment.pairs import Pairs
from ltsim.adjustment.rows import GaugeRows
from ltsim.adjustment.seeds import LEAST_BEAMS, multilaterate, relative_orientation
from ltsim.arrays import Bools, Floats, Ints
from ltsim.errors import NetworkError
from ltsim.geometry.alignment import robust_align
from ltsim.geometry.polar import from_polar, to_face
from ltsim.geometry.rotations import about_z, smallest_turn
from ltsim.model.measurement import lift_of
from ltsim.recording.recording import Recording

BEGINNINGS = ("frame", "cloud", "beams", "ranges")
"""How a network can begin: with known points, with what one station measured whole, with two stations' beams alone,
with ranges alone."""
PARALLEL = 1e-5
"""Mean squared sine below which beams do not meet in a point."""


class Growth:
    """Stations and targets that have a place so far, in a frame of their own until the stated one is reached.

    Parameters
    ----------
    recording : Recording
    pairs : Pairs
        What each station measured whole, in its own frame.
    frame : Frame
    """

    def __init__(self, recording: Recording, pairs: Pairs, frame: Frame) -> None:
        self._recording, self._pairs, self._frame = recording, pairs, frame
        stations, targets = len(recording.stations), len(recording.targets)
        self._read = self._front = to_face(recording.readings, recording.face)
        self._flat = recording.is_horizontal
        lift = lift_of(recording)
        self._lift = np.zeros((len(recording), 3)) if lift is None else lift
        self._pair_lift = np.zeros((len(pairs), 3)) if lift is None else self._by_pair(lift)
        self._position = np.full((stations, 3), np.nan)
        self._rotation = np.tile(np.eye(3), (stations, 1, 1))
        self._joined = np.zeros(stations, dtype=bool)
        self._placed = np.full((len(pairs), 3), np.nan)
        self._covered = np.zeros(targets, dtype=bool)
        self._located = np.full((targets, 3), np.nan)
        self._upright = self._anchored = self._unscaled = self._planned = False
        self._tried: dict[int, int] = {}

    def _by_pair(self, lift: Floats) -> Floats:
        pairs, recording = self._pairs, self._recording
        own = np.zeros((len(pairs), 3))
        keys = pairs.station * len(recording.targets) + pairs.target
        rows = recording.station * len(recording.targets) + recording.target
        at = np.minimum(np.searchsorted(keys, rows), max(len(pairs) - 1, 0))
        paired = np.flatnonzero(np.isin(rows, keys))
        own[at[paired]] = lift[paired]
        return own

    def run(self, beginning: str) -> None:
        """Join everything that can be joined from one of `BEGINNINGS`, then go to the stated frame."""
        getattr(self, f"_begin_with_{beginning}")()
        while not self.is_complete:
            steps = self._join_by_cloud, self._locate, self._join_by_fit, self._anchor, self._rescale
            if not any(step() for step in steps):
                break
        self._settle()

    @property
    def is_complete(self) -> bool:
        """Whether every station and target has a place."""
        return bool(self._joined.all() and self._have.all())

    @property
    def reach(self) -> int:
        """How many stations and targets have a place."""
        return int(self._joined.sum() + self._have.sum())

    # --- what is known ---------------------------------------------------------------------------------------------

    def _known(self) -> Floats:
        """Targets (T, 3) so far: the median of where stations place them, or where they were located."""
        known = self._located.copy()
        whole = np.flatnonzero(self._covered)
        known[whole] = self._pairs.medians(self._placed, whole)
        return known

    @property
    def _have(self) -> Bools:
        return self._covered | np.isfinite(self._located[:, 0])

    def _shared(self) -> Ints:
        """How many of the known targets (S,) each station measured whole."""
        have = self._have[self._pairs.target] & (not self._unscaled)
        return np.bincount(self._pairs.station[have], minlength=len(self._joined))

    def _stand(self, station: int) -> Floats | None:
        """Where an unjoined station stands, if its mark has a place already."""
        marks = self._frame.marks
        if marks.target[station] >= 0:
            place = self._known()[marks.target[station]] + marks.offset[station]
        else:
            same = (marks.first == marks.first[station]) & np.isfinite(self._position[:, 0])
            if not same.any():
                return None
            one = int(np.argmax(same))
            place = self._position[one] - marks.offset[one] + marks.offset[station]
        return place if np.isfinite(place).all() else None

    # --- steps -----------------------------------------------------------------------------------------------------

    def _place(self, station: int, position: Floats, rotation: Floats) -> None:
        self._position[station], self._rotation[station] = position, rotation
        self._joined[station] = True
        if not self._unscaled:
            own = self._pairs.of_station(station)
            self._placed[own] = self._pairs.points[own] @ rotation.T + position - self._pair_lift[own]
            self._covered[self._pairs.target[own]] = True
        mark = self._frame.marks.target[station]
        if mark >= 0 and np.isnan(self._located[mark]).any():
            self._located[mark] = position - self._frame.marks.offset[station]

    def _join_by_cloud(self) -> bool:
        """Join the station that shares most targets with what is known; two will do for levelled stations."""
        have = self._have
        shared = np.where(self._joined, -1, self._shared())
        for station in np.argsort(-shared, kind="stable"):
            count = shared[station]
            if count < 2:
                return False
            own = np.arange(len(self._pairs))[self._pairs.of_station(int(station))]
            own = own[have[self._pairs.target[own]]]
            goal = self._targets(self._pairs.target[own]) + self._pair_lift[own]
            source = self._pairs.points[own]
            level = self._upright and bool(self._frame.level[station])
            try:
                if count >= 3:
                    rotation, position = robust_align(source, goal)
                elif level:
                    rotation, position = upright_alignment(source, goal)
                else:
                    continue
            except NetworkError:
                continue
            self._place(int(station), position, rotation)
            return True
        return False

    def _targets(self, which: Ints) -> Floats:
        """Known places (k, 3) of some targets."""
        placed = self._pairs.medians(self._placed, which)
        return np.where(np.isnan(placed), self._located[which], placed)

    def _locate(self) -> bool:
        """Place targets that joined stations only saw in part, and marks under joined stations."""
        recording = self._recording
        missing = ~self._have
        usable = self._joined[recording.station] & missing[recording.target]
        found = False
        for target, rows in _groups(recording.target, np.flatnonzero(usable)):
            key = -1 - target
            if self._tried.get(key) == len(rows):
                continue
            self._tried[key] = len(rows)
            point = self._located_by(rows)
            if point is not None:
                self._located[target] = point
                found = True
        return found

    def _located_by(self, rows: Ints) -> Floats | None:
        station = self._recording.station[rows]
        position, rotation = self._position[station], self._rotation[station]
        front = self._front[rows]
        if self._upright and self._frame.level[station].all() and np.isnan(front[:, [0, 2]]).all():
            front = np.where([False, False, True], 0.0, front)  # where directions alone meet in plan
        beams = np.isfinite(front[:, 1:]).all(axis=1)
        if beams.sum() >= 2:
            rays = from_polar(np.column_stack([np.ones(beams.sum()), front[beams, 1:]]))
            point = meeting_point(
                position[beams] - self._lift[rows][beams], np.einsum("nij,nj->ni", rotation[beams], rays)
            )
            if point is not None:
                return point
        return fit_point(self._sight(rows), position, rotation)

    def _sight(self, rows: Ints) -> Sight:
        return Sight(self._front[rows], self._flat[rows], self._lift[rows])

    def _join_by_fit(self) -> bool:
        """Join a station by a fit of whatever it read to known targets."""
        known = self._known()
        recording = self._recording
        usable = ~self._joined[recording.station] & np.isfinite(known[recording.target, 0])
        groups = _groups(recording.station, np.flatnonzero(usable))
        for station, rows in sorted(groups, key=lambda group: -np.isfinite(self._front[group[1]]).sum()):
            stand = self._stand(station)
            effort = 2 * len(rows) + (stand is not None)
            if self._tried.get(station) == effort:
                continue
            self._tried[station] = effort
            level = self._upright and bool(self._frame.level[station])
            pose = fit_pose(self._sight(rows), known[recording.target[rows]], level=level, position=stand)
            if pose is not None:
                self._place(station, *pose)
                return True
        return False

    # --- frame -----------------------------------------------------------------------------------------------------

    def _move(self, rotation: Floats, translation: Floats) -> None:
        self._position = self._position @ rotation.T + translation
        self._rotation = rotation @ self._rotation
        self._placed = self._placed @ rotation.T + translation
        self._located = self._located @ rotation.T + translation

    def _anchor(self) -> bool:
        """Go to the stated frame as soon as the network reaches enough of it."""
        if self._anchored or not self._frame.is_stated or self._unscaled:
            return False
        known = self._known()
        turn = self._frame.upright(self._rotation, self._joined)
        motion = self._frame.motion(self._position, known, turn)
        if motion is None:
            return False
        self._move(*motion)
        self._anchored = self._upright = True
        fresh = ~self._have & np.isfinite(self._frame.points[:, 0])
        self._located[fresh] = self._frame.points[fresh]
        return True

    def _settle(self) -> None:
        """Scale and frame of the finished network."""
        self._rescale()
        self._erect()
        if self._anchored or not self._joined.any() or self._anchor():
            return
        first = int(np.argmax(self._joined))
        self._move(self._rotation[first].T.copy(), -self._rotation[first].T @ self._position[first])
        turn = self._frame.upright(self._rotation, self._joined)
        if not np.array_equal(turn, np.eye(3)):
            self._move(turn, np.zeros(3))
        here, there = self._frame.common(self._position, self._known())
        if len(here):
            self._move(np.eye(3), (there - here).mean(axis=0))
            return
        motion = None if self._frame.is_stated else self._frame.plan_motion(self._position, self._rotation)
        if motion is not None:
            self._move(*motion)

    def _rescale(self) -> bool:
        """Bring a network of beams to scale by ranges, known lengths or known points; ranges count from then on."""
        if not self._unscaled:
            return False
        known, recording = self._known(), self._recording
        length = np.linalg.norm(known[recording.target] + self._lift - self._position[recording.station], axis=1)
        gauge = GaugeRows.of(recording)
        ratio = np.concatenate([self._read[:, 0] / length, gauge.length / gauge.predict(known)])
        here, there = self._frame.common(self._position, known)
        if len(here) > 1:
            spread = [np.sqrt(np.sum((x - x.mean(axis=0)) ** 2)) for x in (there, here)]
            ratio = np.append(ratio, spread[0] / spread[1])
        ratio = ratio[np.isfinite(ratio)]
        if not len(ratio):
            raise NetworkError("no range, no known length and no two known points give the network a scale")
        scale = float(np.median(ratio))
        self._position, self._placed, self._located = (scale * x for x in (self._position, self._placed, self._located))
        self._front, self._unscaled = self._read, False
        self._tried.clear()
        for station in np.flatnonzero(self._joined):
            self._place(int(station), self._position[station], self._rotation[station])
        return True

    def _erect(self) -> None:
        """Stations that read no angle stand upright: along the others' axes, or on the floor plan."""
        told = np.bincount(self._recording.station, np.isfinite(self._read[:, 1:]).any(axis=1), len(self._joined)) > 0
        if told.any():
            up = self._rotation[told & self._joined, :, 2].sum(axis=0)
        elif self._planned and not self._anchored:
            up = VERTICAL
        else:
            return
        if np.linalg.norm(up) > 0.0:
            yaw = np.nan_to_num(self._frame.yaw)
            for station in np.flatnonzero(~told & self._joined):
                self._rotation[station] = smallest_turn(VERTICAL, up / np.linalg.norm(up)) @ about_z(
                    float(yaw[station])
                )

    # --- beginnings ------------------------------------------------------------------------------------------------

    def _begin_with_frame(self) -> None:
        """Begin with the known points."""
        self._located = self._frame.points.copy()
        self._position = self._frame.stations.copy()
        self._anchored = self._upright = self._frame.is_stated

    def _begin_with_cloud(self) -> None:
        """Begin with a station that measured targets whole."""
        counts = np.diff(self._pairs.begin)
        if not counts.any():
            return
        first = 0 if counts[0] >= 3 else int(np.argmax(counts))
        rotation = np.eye(3)
        if self._frame.level[first]:
            rotation = smallest_turn(VERTICAL, self._frame.marks.vertical[first])
            self._upright = True
        self._place(first, np.zeros(3), rotation)

    def _begin_with_beams(self) -> None:
        """The two stations that read most directions in common, at distance 1."""
        size = len(self._joined), len(self._located)
        beams = np.full((*size, 3), np.nan)
        rows = np.flatnonzero(np.isfinite(self._front[:, 1:]).all(axis=1))
        ones = np.column_stack([np.ones(len(rows)), self._front[rows, 1:]])
        beams[self._recording.station[rows], self._recording.target[rows]] = from_polar(ones)
        has = np.isfinite(beams[:, :, 0])
        common = np.triu(has.astype(np.int64) @ has.T.astype(np.int64), 1)
        for pair in np.argsort(-common, axis=None)[:10]:
            a, b = np.unravel_index(pair, common.shape)
            if common[a, b] < LEAST_BEAMS:
                return
            both = has[a] & has[b]
            found = relative_orientation(beams[a, both], beams[b, both])
            if found is not None:
                self._unscaled = True  # No range and no point measured whole fits until there is a scale.
                self._front = np.column_stack([np.full(len(self._read), np.nan), self._read[:, 1:]])
                self._place(int(a), np.zeros(3), np.eye(3))
                self._place(int(b), *found)
                return

    def _begin_with_ranges(self) -> None:
        """All stations that read the ranges of the same targets."""
        ranges = np.full((len(self._joined), len(self._located)), np.nan)
        ranges[self._recording.station, self._recording.target] = self._front[:, 0]
        stations = np.flatnonzero(np.isfinite(ranges).sum(axis=1) >= 3)
        targets = np.flatnonzero(np.isfinite(ranges[stations]).all(axis=0))
        found = multilaterate(ranges[np.ix_(stations, targets)])
        if found is not None:
            self._located[targets], self._planned = self._frame.placed(stations, found[0], targets, found[1])

    # --- the end ---------------------------------------------------------------------------------------------------

    def require_stations(self) -> None:
        """NetworkError with the names of the stations that have no place, or of the targets where none has one."""
        recording = self._recording
        if not self._joined.all():
            lost = ", ".join(recording.stations[s] for s in np.flatnonzero(~self._joined))
            shared = self._shared()
            nearest = int(np.argmax(np.where(self._joined, -1, shared)))
            most, own = int(shared[nearest]), self._pairs.target[self._pairs.of_station(nearest)]
            known = own[self._have[own]]
            if most >= 3 and on_a_line(self._known()[known]):
                what = f"the {most} targets that it shares with the rest of the network lie on one line; three off it"
            else:
                what = f"shares only {most} targets with the rest of the network; at least three"
            raise NetworkError(
                f"station {lost}: {what} are needed "
                "(two between levelled stations, more where ranges or angles are missing)"
            )
        if not self._have.any():
            self.require_targets()

    def require_targets(self) -> None:
        """NetworkError with the names of the targets that have no place."""
        recording, missing = self._recording, ~self._have
        if missing.any():
            lost = ", ".join(recording.targets[t] for t in np.flatnonzero(missing)[:10])
            raise NetworkError(
                f"target {lost}: no station measured range and both angles, and what was read from different "
                "stations does not meet in one point"
            )

    def result(self) -> tuple[Floats, Floats, Floats]:
        """Positions, rotations and targets."""
        known = self._known()
        return self._frame.marks.on_marks(self._position, known), self._rotation, known


def _groups(keys: Ints, rows: Ints) -> Iterator[tuple[int, Ints]]:
    """Rows by key, in the order of the keys."""
    order = rows[np.argsort(keys[rows], kind="stable")]
    values, first = np.unique(keys[order], return_index=True)
    for key, group in zip(values, np.split(order, first[1:]), strict=False):
        yield int(key), group


def meeting_point(origin: Floats, beam: Floats) -> Floats | None:
    """The point (3,) nearest to k beams from `origin` (k, 3) along unit vectors; None where they are parallel."""
    across = np.eye(3) - beam[:, :, None] * beam[:, None, :]
    normal = across.sum(axis=0)
    if np.linalg.eigvalsh(normal)[0] < PARALLEL * len(beam):
        return None
    return np.linalg.solve(normal, np.einsum("kij,kj->i", across, origin))
