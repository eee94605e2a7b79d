"""Places for stations from which every target is seen often enough: one after the other, or by integer programming."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.optimize import Bounds, LinearConstraint, milp

from ltsim.arrays import Bools, Floats, Ints

DRAWS = 24
"""Places that are looked at for a station of a random placement."""
NODES = 3000
"""Of the branch-and-bound tree; a few are enough in the halls that were tried."""
TIE = 1e-4
"""Random costs of places beside a missing sight: another answer for each draw."""


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
    counted: Ints
    """(T,): how many of those see each target."""

    def stations(self, count: int, wanted: int, rng: np.random.Generator | None = None) -> list[int]:
        """Places of `count` stations from which each target is seen `wanted` times, or with the fewest sights missing.

        With `rng` each station is put at the best of a few random places: another answer for each draw.
        """
        chosen: list[int] = []
        while len(chosen) < count and (one := self._best(chosen, wanted, rng)) >= 0:
            chosen.append(one)
        if len(chosen) == count and not self.missing(chosen, wanted):
            return chosen
        return self._exact(count, wanted, rng) or chosen

    def missing(self, chosen: list[int], wanted: int) -> int:
        """How many sights are missing until each target is seen `wanted` times."""
        return int(np.maximum(wanted - self.counted - self.seen[chosen].sum(axis=0), 0).sum())

    def _best(self, others: list[int], wanted: int, rng: np.random.Generator | None) -> int:
        """The place that brings most beside others, further sights a little; -1 where none may stand."""
        count = len(self.position)
        rows = np.arange(count) if rng is None else rng.integers(count, size=min(DRAWS, count))
        had = self.counted + self.seen[others].sum(axis=0)
        worth = (np.minimum(had + self.seen[rows], wanted) - np.minimum(had, wanted)).sum(axis=1).astype(np.float64)
        worth += 1e-3 * (self.seen[rows] / (1.0 + had) ** 2).sum(axis=1)
        for place in (*self.standing, *self.position[others]):
            worth[np.linalg.norm(self.position[rows, :2] - place[:2], axis=1) < self.spacing] = -1.0
        return int(rows[np.argmax(worth)]) if worth.max(initial=-1.0) >= 0.0 else -1

    def _exact(self, count: int, wanted: int, rng: np.random.Generator | None) -> list[int]:
        """The places with the fewest missing sights of all combinations; empty where none keep their distance."""
        places, targets = self.seen.shape
        gap = np.linalg.norm(self.position[:, None, :2] - self.standing[None, :, :2], axis=2)
        free = (gap >= self.spacing).all(axis=1)
        near = np.linalg.norm(self.position[:, None, :2] - self.position[None, :, :2], axis=2) < self.spacing
        first, second = np.nonzero(np.triu(near, 1))
        rows = np.arange(len(first))
        pairs = sp.csr_array((np.ones(2 * len(first)), (np.r_[rows, rows], np.r_[first, second])), (len(first), places))
        sights = sp.hstack([sp.csr_array(self.seen.T.astype(np.float64)), sp.eye_array(targets)])
        need = np.maximum(wanted - self.counted, 0)
        limits = [
            LinearConstraint(sights, need, np.inf),
            LinearConstraint(np.r_[np.ones(places), np.zeros(targets)][None], count, count),
        ]
        if len(first):
            limits.append(LinearConstraint(sp.hstack([pairs, sp.csr_array((len(first), targets))]), -np.inf, 1.0))
        cost = np.zeros(places) if rng is None else TIE * rng.random(places)
        found = milp(
            np.r_[cost, np.ones(targets)],
            constraints=limits,
            integrality=np.r_[np.ones(places), np.zeros(targets)],
            bounds=Bounds(0.0, np.r_[free.astype(np.float64), np.full(targets, float(wanted))]),
            options={"node_limit": NODES},
        )
        return [] if found.x is None else np.flatnonzero(found.x[:places] > 0.5).tolist()
