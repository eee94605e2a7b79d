"""Stations placed one after the other where they bring most, then exchanged one by one: the one greedy placement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Bools, Floats

SWEEPS = 6
"""Rounds of exchanges at most."""
DRAWS = 24
"""Places that are looked at for a station of a random placement."""


@dataclass(frozen=True)
class Placement:
    """Places for stations, beside those that stand already."""

    position: Floats
    """(N, 3) [m]: where a station may stand."""
    seen: Bools
    """(N, T): targets in sight from there."""
    spacing: float
    """[m]: least distance between two stations, seen from above."""
    standing: Floats
    """(F, 3) [m]: stations that stay."""
    counted: np.ndarray
    """(T,): how many of those see each target."""

    def stations(self, count: int, wanted: int, rng: np.random.Generator | None = None) -> list[int]:
        """Places of `count` stations from which each target is seen `wanted` times, as nearly as was found.

        With `rng` each station is first put at the best of a few random places: another answer for each draw.
        """
        chosen: list[int] = []
        for _ in range(count):
            some = None if rng is None else rng.integers(len(self.position), size=DRAWS)
            if (one := self._best(chosen, wanted, some)) < 0:
                break
            chosen.append(one)
        for _ in range(SWEEPS):
            before = self.missing(chosen, wanted)
            for k in range(len(chosen)):
                others = chosen[:k] + chosen[k + 1 :]
                tried = [*chosen[:k], self._best(others, wanted), *chosen[k + 1 :]]
                if min(tried) >= 0 and self.missing(tried, wanted) < self.missing(chosen, wanted):
                    chosen = tried
            if self.missing(chosen, wanted) in (0, before):
                break
        return chosen

    def missing(self, chosen: list[int], wanted: int) -> int:
        """How many sights are missing until each target is seen `wanted` times."""
        return int(np.maximum(wanted - self.counted - self.seen[chosen].sum(axis=0), 0).sum())

    def _best(self, others: list[int], wanted: int, some: np.ndarray | None = None) -> int:
        """The place that brings most beside others, further sights a little; -1 where none may stand."""
        rows = np.arange(len(self.position)) if some is None else some
        had = self.counted + self.seen[others].sum(axis=0)
        worth = (np.minimum(had + self.seen[rows], wanted) - np.minimum(had, wanted)).sum(axis=1).astype(np.float64)
        worth += 1e-3 * (self.seen[rows] / (1.0 + had) ** 2).sum(axis=1)
        for place in (*self.standing, *self.position[others]):
            gap = np.linalg.norm(self.position[rows, :2] - place[:2], axis=1)
            worth[gap < self.spacing] = -1.0
        return int(rows[np.argmax(worth)]) if worth.max(initial=-1.0) >= 0.0 else -1
