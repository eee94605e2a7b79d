"""The only owner of names and places in the flat vector of unknowns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Floats, Ints
from ltsim.model.measurement import MeasurementModel, State


@dataclass(frozen=True)
class Layout:
    """Columns of the design: poses, kept targets, instrument parameters, further effects; then the other targets.

    Attributes
    ----------
    pose : (S, 6) int
        Translation, then rotation.
    target : (T, 3) int
        Gauge targets are kept, all others are eliminated block by block.
    instrument : (I, p) int
    extra : (q,) int
    kept : int
        Number of kept columns K.
    size : int
        Number of all columns.
    """

    pose: Ints
    target: Ints
    instrument: Ints
    extra: Ints
    kept: int
    size: int

    @classmethod
    def of(cls, model: MeasurementModel, kept_targets: set[int]) -> Layout:
        """Lay out the unknowns of a model; `kept_targets` are not eliminated."""
        recording = model.recording
        stations, targets = len(recording.stations), len(recording.targets)
        instruments, p = len(recording.instruments), model.construction.size
        pose = np.arange(6 * stations).reshape(stations, 6)
        at = 6 * stations
        keep = np.array([t in kept_targets for t in range(targets)])
        target = np.empty((targets, 3), dtype=np.int64)
        target[keep] = at + np.arange(3 * keep.sum()).reshape(-1, 3)
        at += 3 * int(keep.sum())
        instrument = at + np.arange(instruments * p).reshape(instruments, p)
        at += instruments * p
        extra = at + np.arange(model.extra_size)
        at += model.extra_size
        target[~keep] = at + np.arange(3 * (~keep).sum()).reshape(-1, 3)
        return cls(pose, target, instrument, extra, at, at + 3 * int((~keep).sum()))

    def retract(self, state: State, step: Floats) -> State:
        """The state after a step (size,)."""
        return state.moved(step[self.pose], step[self.target], step[self.instrument], step[self.extra])
