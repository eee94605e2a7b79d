"""What each station measured whole: one point for every station and target, kept as a list and not as a table.

A tunnel of 2,000 set-ups that see 50 targets each has 100,000 such pairs; the table would have 100 million places.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Floats, Ints
from ltsim.geometry.polar import from_polar
from ltsim.recording.recording import Recording

AT_ONCE = 4096
"""Targets whose medians are taken together."""


@dataclass(frozen=True)
class Pairs:
    """Pairs (m,) of a station and a target, in the order of the stations."""

    station: Ints
    target: Ints
    """(m,) each."""
    points: Floats
    """(m, 3) [m]: the target in the station's own frame."""
    begin: Ints
    """(S + 1,): where each station's pairs begin."""
    order: Ints
    """(m,): pairs in the order of their targets."""
    first: Ints
    """(T + 1,): where each target's pairs begin in that order."""

    @classmethod
    def of(cls, recording: Recording, points: Floats | None = None) -> Pairs:
        """The pairs of a recording; faces and repeats combined by the median, which a single blunder does not move.

        `points` (n, 3) are the measured points; by default those of an ideal tracker.
        """
        stations, targets = len(recording.stations), len(recording.targets)
        measured = from_polar(recording.readings) if points is None else points
        rows = np.flatnonzero(np.isfinite(measured).all(axis=1))
        key = recording.station[rows] * targets + recording.target[rows]
        by_key = np.argsort(key, kind="stable")
        where, first, count = np.unique(key[by_key], return_index=True, return_counts=True)
        middle = np.zeros((len(where), 3))
        for repeats in np.unique(count):
            group = np.flatnonzero(count == repeats)
            middle[group] = np.median(measured[rows[by_key[first[group][:, None] + np.arange(repeats)]]], axis=1)
        station, target = np.divmod(where, max(targets, 1))
        order = np.argsort(target, kind="stable")
        return cls(
            station=station,
            target=target,
            points=middle,
            begin=np.searchsorted(station, np.arange(stations + 1)),
            order=order,
            first=np.searchsorted(target[order], np.arange(targets + 1)),
        )

    def __len__(self) -> int:
        return len(self.station)

    def of_station(self, station: int) -> slice:
        """Its pairs."""
        return slice(int(self.begin[station]), int(self.begin[station + 1]))

    def medians(self, values: Floats, which: Ints) -> Floats:
        """Median (k, 3) over stations of values (m, 3) of some targets, leaving out NaN; NaN where all are."""
        found = np.full((len(which), 3), np.nan)
        for low in range(0, len(which), AT_ONCE):
            first, end = self.first[which[low : low + AT_ONCE]], self.first[which[low : low + AT_ONCE] + 1]
            place = first[:, None] + np.arange((end - first).max(initial=0))
            pair = self.order[np.minimum(place, len(self) - 1)]
            padded = np.where((place < end[:, None])[:, :, None], values[pair], np.nan)
            found[low : low + AT_ONCE] = _nan_median(padded)
        return found


def _nan_median(values: Floats) -> Floats:
    """Median over the second axis of (t, k, 3), leaving out entries that are NaN; NaN where all are."""
    if not values.shape[1]:
        return np.full((len(values), 3), np.nan)
    ordered = np.sort(values, axis=1)
    count = np.isfinite(values[:, :, 0]).sum(axis=1)
    at = np.arange(len(values))
    return 0.5 * (ordered[at, (count - 1) // 2] + ordered[at, count // 2])
