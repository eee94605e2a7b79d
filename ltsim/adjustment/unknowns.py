"""Columns of the unknowns of a network in its design matrix."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.adjustment.rows import DifferenceRows, GaugeRows, Marks
from ltsim.core.arrays import Ints
from ltsim.physics.model.measurement import MeasurementModel


@dataclass(frozen=True)
class Unknowns:
    """Columns of the design: poses, kept targets, instrument parameters, further effects; then the other targets.

    Set-ups over one mark share the columns of their position, with the target where that mark is one.
    """

    pose: Ints
    """(S, 6): translation, then rotation."""
    target: Ints
    """(T, 3): targets of known lengths and differences and those under a set-up are kept, all others are eliminated
    block by block."""
    instrument: Ints
    """(I, p)."""
    extra: Ints
    """(q,)."""
    n_reduced: int
    """Number of kept columns K."""
    size: int
    """Number of all columns."""

    @property
    def places(self) -> Ints:
        """(T + S + 1, 3): columns of the places of targets and set-ups; any for the origin, which is no unknown."""
        return np.concatenate([self.target, self.pose[:, :3], self.pose[:1, :3]])

    @classmethod
    def of(cls, model: MeasurementModel, gauge: GaugeRows, marks: Marks, differences: DifferenceRows) -> Unknowns:
        """The unknowns of a model."""
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
        instrument, extra = fresh(len(recording.instruments), model.construction.size), fresh(1, model.extra_size)[0]
        n_reduced = size
        target[~keep] = fresh(int((~keep).sum()), 3)
        pose[over, :3] = target[marks.target[over]]
        pose[:, :3] = np.where(pose[:, :3] < 0, pose[marks.first, :3], pose[:, :3])
        return cls(pose, target, instrument, extra, n_reduced, size)
