"""Set-ups on marks: instruments that share a position with each other or with a target, a height above it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Floats, Ints
from ltsim.model.measurement import verticals
from ltsim.recording.recording import Recording
from ltsim.units import MILLIMETRE


@dataclass(frozen=True)
class Marks:
    """Where the set-ups of a recording stand."""

    target: Ints
    """(S,): the target whose mark a set-up stands on, -1 for none."""
    first: Ints
    """(S,): the first set-up on the same mark that is no target; itself where it stands alone."""
    names: tuple[str, ...]
    """Name of the mark of each set-up, '' where it has none."""
    vertical: Floats
    """(S, 3): direction of plumb, unit."""
    offset: Floats
    """(S, 3) [m]: from the mark to the instrument."""

    @classmethod
    def of(cls, recording: Recording) -> Marks:
        """The marks of a recording."""
        places = {name: i for i, name in enumerate(recording.targets)}
        setups = [recording.station_setup(name) for name in recording.stations]
        names = tuple(s.over or "" for s in setups)
        target = np.array([places.get(name, -1) if name else -1 for name in names], dtype=np.int64)
        seen: dict[str, int] = {}
        first = [seen.setdefault(name, i) if name and target[i] < 0 else i for i, name in enumerate(names)]
        vertical = verticals(recording)
        height = np.array([s.instrument_height_mm if s.over else 0.0 for s in setups]) * MILLIMETRE
        return cls(target, np.array(first, dtype=np.int64), names, vertical, vertical * height[:, None])

    def on_marks(self, position: Floats, points: Floats) -> Floats:
        """Positions (S, 3) put onto their marks: targets at `points` (T, 3), else that of the first set-up."""
        settled = position[self.first] - self.offset[self.first] + self.offset
        over = np.flatnonzero(self.target >= 0)
        settled[over] = points[self.target[over]] + self.offset[over]
        return settled
