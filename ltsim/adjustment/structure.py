"""What set-up and readings in use fix, wherever things stand: the unknowns, and which of them no reading reaches."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ltsim.adjustment.marks import Marks
from ltsim.adjustment.rows import ControlRows, GaugeRows, LevelRows
from ltsim.adjustment.unknowns import Unknowns
from ltsim.arrays import Bools, Floats, Ints
from ltsim.model.measurement import MeasurementModel, State
from ltsim.recording.recording import Recording

VERTICAL = np.array([0.0, 0.0, 1.0])
UPRIGHT = 1.0 - 1e-8
"""Cosine of the lean up to which a plumb line counts as that of the network (0.14 mrad, 900 m on the earth)."""


@dataclass(frozen=True)
class Structure:
    """The unknowns of a network and what is held of them; two recordings of the same pointings share it."""

    unknowns: Unknowns
    """Places of the unknowns."""
    yaw: Ints
    tilt: Ints
    """Stations without azimuths, and those without any angle or level."""
    height: Ints
    """Levelled stations that only read azimuths."""
    place: Ints
    """Stations without any reading."""
    unseen: Bools
    """(T,): targets without a reading in use, known coordinates or a set-up on them."""
    flat: Bools
    """(T,): targets that levelled set-ups saw by horizontal directions alone: nothing tells their height."""

    @classmethod
    def of(
        cls,
        model: MeasurementModel,
        use: Bools,
        gauge: GaugeRows,
        control: ControlRows,
        levels: LevelRows,
        marks: Marks,
        known_marks: ControlRows,
        unknowns: Unknowns | None = None,
    ) -> Structure:
        """The structure of a network with `use` (n, 3) of its readings, by counting; `unknowns` where it is known."""
        recording, count = model.recording, len(model.recording.stations)
        range_, azimuth, elevation = (np.bincount(recording.station, use[:, i], count) > 0 for i in range(3))
        level, alone = np.zeros(count, dtype=bool), marks.first == np.arange(count)
        level[levels.station] = True
        alone &= marks.target < 0
        alone[known_marks.target] = False
        kept = set(gauge.first.tolist()) | set(gauge.second.tolist())
        return cls(
            unknowns=unknowns or Unknowns.of(model, kept, marks),
            yaw=np.flatnonzero(~azimuth),
            tilt=np.flatnonzero(~azimuth & ~elevation & ~level),
            height=np.flatnonzero(alone & azimuth & ~range_ & ~elevation & level),
            place=np.flatnonzero(alone & ~range_ & ~azimuth & ~elevation),
            unseen=_unseen(recording, use, control, marks),
            flat=_flat(recording, use, gauge, control, levels, marks),
        )

    @property
    def held_columns(self) -> Ints:
        """Columns (h, 3) of what no reading determines: each row is held where it is."""
        unknowns = self.unknowns
        single = [unknowns.target[self.unseen], unknowns.pose[self.place, :3]]
        single += [unknowns.pose[self.height, 2:3], unknowns.target[self.flat, 2:3]]
        rows = [unknowns.pose[self.yaw, 3:], np.repeat(unknowns.pose[self.tilt, 3:], 2, axis=0)]
        return np.concatenate([*rows, *(np.repeat(columns.reshape(-1, 1), 3, axis=1) for columns in single)])

    def held_directions(self, state: State) -> Floats:
        """Directions (h, 3) in these columns."""
        yaw = state.rotation[self.yaw] @ VERTICAL
        tilt = np.swapaxes(state.rotation[self.tilt], 1, 2)[:, :2].reshape(-1, 3)
        single = np.zeros((self.held - len(yaw) - len(tilt), 3))
        single[:, 0] = 1.0
        return np.concatenate([yaw, tilt, single])

    @property
    def held_poses(self) -> Bools:
        """(S, 6) True where something of a pose is held; turns of all three axes where the yaw is open."""
        held = np.zeros(self.unknowns.pose.shape, dtype=bool)
        held[self.yaw, 3:] = True
        held[self.tilt, 3:] = True
        held[self.height, 2] = True
        held[self.place, :3] = True
        return held

    @property
    def held(self) -> int:
        """Number h of held unknowns."""
        counted = len(self.yaw) + 2 * len(self.tilt) + len(self.height) + 3 * len(self.place) + int(self.flat.sum())
        return counted + 3 * int(self.unseen.sum())

    @property
    def anchors(self) -> Ints:
        """Stations that the datum rows hold: the first whose yaw is known; all where none is (distances alone)."""
        turned = self._turned
        return turned[:1] if len(turned) else np.arange(len(self.unknowns.pose))

    @property
    def anchors_turn(self) -> bool:
        """Whether the datum rows hold the turns of the anchors too."""
        return len(self._turned) > 0

    @cached_property
    def _turned(self) -> Ints:
        return np.setdiff1d(np.arange(len(self.unknowns.pose)), self.yaw)


def _unseen(recording: Recording, use: Bools, control: ControlRows, marks: Marks) -> Bools:
    seen = np.bincount(recording.target, use.any(axis=1), len(recording.targets))
    seen[control.target] += 1
    seen[marks.target[marks.target >= 0]] += 1
    return seen == 0


def _flat(
    recording: Recording, use: Bools, gauge: GaugeRows, control: ControlRows, levels: LevelRows, marks: Marks
) -> Bools:
    count, level = len(recording.targets), np.zeros(len(recording.stations), dtype=bool)
    level[levels.station] = np.abs(levels.vertical @ VERTICAL) > UPRIGHT
    flat = np.bincount(recording.target, use[:, 1], count) > 0
    tells = use[:, [0, 2]].any(axis=1) | (use[:, 1] & ~level[recording.station])
    flat[recording.target[tells]] = False
    for known in (gauge.first, gauge.second, control.target, marks.target[marks.target >= 0]):
        flat[known] = False
    return flat
