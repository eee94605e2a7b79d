"""Rules that a layout keeps besides the places of its stations: spacing, sights, targets.

Each function tells which parts of layouts break its rule, for many layouts at once (the search) and for one (its
sentences): `SearchSpace` is made of them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ltsim.core.arrays import Bools, Floats

FEWEST = 3
"""Targets in sight that a station needs."""
TOUCH = 1e-3
"""[m] Distance within which a station and a point coincide."""
SLACK = 1e-9
"""[m] Tolerance of the minimum spacing of two stations, for rounding."""


class BrokenRule(NamedTuple):
    """A rule of the plan that a layout breaks."""

    words: str
    """A sentence without its full stop, with the numbers and the key of the plan file."""
    stations: tuple[str, ...] = ()
    """Stations whose places break it; none where it is about sights."""


def words_of(rules: Sequence[BrokenRule]) -> str:
    """Broken rules in one line; empty for none."""
    return "; ".join(rule.words for rule in rules)


def too_near(position: Floats, spacing: float) -> Bools:
    """(B, S, S): pairs of stations of layouts (B, S, 3) [m] nearer than the spacing [m] seen from above, once each."""
    gap = np.linalg.norm(position[:, :, None, :2] - position[:, None, :, :2], axis=3)
    return np.asarray(np.triu(gap <= spacing - SLACK, 1))


def short_of_sights(visible: Bools, least: int) -> Bools:
    """(B, T): targets that fewer than `least` stations see; `visible` is (B, S, T)."""
    return np.asarray(visible.sum(axis=1) < least)


def short_of_targets(visible: Bools) -> Bools:
    """(B, S): stations that see fewer than `FEWEST` targets; `visible` is (B, S, T)."""
    return np.asarray(visible.sum(axis=2) < FEWEST)
