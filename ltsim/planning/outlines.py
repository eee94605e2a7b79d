"""Outlines seen from above: where a tripod may stand, what is cut out of it, and what no outline may be."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ltsim.arrays import Bools, Floats

EDGE = 1e-9
"""[m] within which a place counts as on an edge."""


@dataclass(frozen=True)
class Area:
    """One area of the floor."""

    outline: Floats
    """(k, 2) [m]: corners, in order around it."""
    heights: tuple[float, float]
    """[m]: lowest and highest centre of the instrument here."""
    holes: tuple[Floats, ...] = ()
    """(k, 2) [m]: what is cut out of it."""

    def holds(self, position: Floats) -> Bools:
        """(N,): positions (N, 3) [m] of an instrument that may stand here."""
        low, high = self.heights
        good = inside(self.outline, position[:, :2])
        good &= (position[:, 2] > low - EDGE) & (position[:, 2] < high + EDGE)
        for hole in self.holes:
            good &= ~inside(hole, position[:, :2])
        return good


@dataclass(frozen=True)
class KeepOut:
    """A place that stays free: within `clear` [m] of an outline (k, 2), or of the way between two ends (2, 2)."""

    outline: Floats
    clear: float = 0.0

    def holds(self, places: Floats) -> Bools:
        """(N,): places (N, 2) that stay free."""
        near = distance(self.outline, places) < self.clear + EDGE
        return near | inside(self.outline, places) if len(self.outline) > 2 else near


def distance(outline: Floats, places: Floats) -> Floats:
    """(N,) [m]: from places (N, 2) to the nearest edge of an outline (k, 2)."""
    start, way = outline, np.roll(outline, -1, axis=0) - outline
    along = np.einsum("nki,ki->nk", places[:, None] - start, way) / np.maximum((way**2).sum(axis=1), 1e-30)
    foot = start + np.clip(along, 0, 1)[:, :, None] * way
    return np.linalg.norm(places[:, None] - foot, axis=2).min(axis=1)


def inside(outline: Floats, places: Floats) -> Bools:
    """(N,): places (N, 2) inside an outline (k, 2) or within a nanometre of its edge."""
    start, end = outline, np.roll(outline, -1, axis=0)
    x, y = places[:, 0, None], places[:, 1, None]
    spans = (start[:, 1] > y) != (end[:, 1] > y)
    rise = np.where(end[:, 1] == start[:, 1], 1.0, end[:, 1] - start[:, 1])
    left = x < start[:, 0] + (y - start[:, 1]) * (end[:, 0] - start[:, 0]) / rise
    crossings: Bools = (spans & left).sum(axis=1) % 2 == 1
    return crossings | (distance(outline, places) < EDGE)


def fault(outline: Floats) -> str:
    """What keeps corners (k, 2) from being an outline, in words; empty for one that is simple and has an area."""
    count = len(outline)
    for i in range(count):
        if np.linalg.norm(outline[i] - outline[i - 1]) < EDGE:
            return f"its corner {i + 1} stands where the one before it stands"
    for i, j in combinations(range(count), 2):
        beside = j == i + 1 or (i == 0 and j == count - 1)
        if not beside and _cross(outline[i], outline[(i + 1) % count], outline[j], outline[(j + 1) % count]):
            return (
                f"its side from corner {i + 1} crosses the one from corner {j + 1}; give the corners in order around it"
            )
    x, y = outline.T
    area = 0.5 * abs(float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)))
    return "" if area > EDGE else "its corners lie in a line"


def _cross(a: Floats, b: Floats, c: Floats, d: Floats) -> bool:
    """Whether two sides, a to b and c to d, have a point in common."""

    def side(p: Floats, q: Floats, r: Floats) -> float:
        return float((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]))

    def between(p: Floats, q: Floats, r: Floats) -> bool:
        return bool(np.all(np.minimum(p, q) <= r + EDGE) and np.all(r <= np.maximum(p, q) + EDGE))

    turns = side(a, b, c), side(a, b, d), side(c, d, a), side(c, d, b)
    if turns[0] * turns[1] < 0 and turns[2] * turns[3] < 0:
        return True
    ends = ((a, b, c), (a, b, d), (c, d, a), (c, d, b))
    return any(abs(turn) < EDGE and between(*three) for turn, three in zip(turns, ends, strict=True))
