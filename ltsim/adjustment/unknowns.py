"""The only owner of names and places in the flat vector of unknowns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.adjustment.marks import Marks
from ltsim.arrays import Floats, Ints
from ltsim.model.measurement import MeasurementModel, State


@dataclass(frozen=True)
class Unknowns:
    """Columns of the design: poses, kept targets, instrument parameters, further effects; then the other targets.

    Set-ups over one mark share the columns of their position, with the target where that mark is one.
    """

    pose: Ints
    """(S, 6): translation, then rotation."""
    target: Ints
    """(T, 3): gauge targets and those under a set-up are kept, all others are eliminated block by block."""
    instrument: Ints
    """(I, p)."""
    extra: Ints
    """(q,)."""
    kept: int
    """Number of kept columns K."""
    size: int
    """Number of all columns."""

    @classmethod
    def of(cls, model: MeasurementModel, kept_targets: set[int], marks: Marks) -> Unknowns:
        """The unknowns of a model; `kept_targets` are not eliminated."""
        recording = model.recording
        stations, targets = len(recording.stations), len(recording.targets)
        instruments, p = len(recording.instruments), model.construction.size
        alone = (marks.target < 0) & (marks.first == np.arange(stations))
        own = np.repeat(alone[:, None], 6, axis=1)
        own[:, 3:] = True
        pose = np.full((stations, 6), -1)
        pose[own] = np.arange(own.sum())
        at = int(own.sum())
        keep = np.zeros(targets, dtype=bool)
        keep[[*kept_targets, *marks.target[marks.target >= 0]]] = True
        target = np.empty((targets, 3), dtype=np.int64)
        target[keep] = at + np.arange(3 * keep.sum()).reshape(-1, 3)
        at += 3 * int(keep.sum())
        instrument = at + np.arange(instruments * p).reshape(instruments, p)
        at += instruments * p
        extra = at + np.arange(model.extra_size)
        at += model.extra_size
        target[~keep] = at + np.arange(3 * (~keep).sum()).reshape(-1, 3)
        shared = marks.target >= 0
        pose[shared, :3] = target[marks.target[shared]]
        pose[:, :3] = np.where(pose[:, :3] < 0, pose[marks.first, :3], pose[:, :3])
        return cls(pose, target, instrument, extra, at, at + 3 * int((~keep).sum()))

    def retract(self, state: State, step: Floats) -> State:
        """The state after a step (size,)."""
        return state.moved(step[self.pose], step[self.target], step[self.instrument], step[self.extra])
