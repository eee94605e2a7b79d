"""What an invented law is, and what several of them are made of."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ltsim.arrays import Floats
from ltsim.scene.sightings import Sightings

Law = Callable[[Sightings, Floats], Floats]
"""Correction (n,) per unit of size at constants (5,), each uniform between 0 and 1; or displacement (n, 3)."""


class Words(NamedTuple):
    """What a law turns or moves, what that follows, and where; empty: everywhere, or as the law's observable says."""

    carrier: str
    driver: str
    place: str = ""
    observables: tuple[str, ...] = ()


def turn(u: float) -> float:
    """[rad] A direction of the whole circle."""
    return 2 * np.pi * u


def level(u: float) -> Floats:
    """A level unit vector (3,)."""
    return np.array([np.cos(turn(u)), np.sin(turn(u)), 0.0])


def hours(s: Sightings) -> Floats:
    """Time (n,) [h] since the first pointing."""
    return (s.time - s.time.min()) / 3600.0


def share(s: Sightings) -> Floats:
    """Time (n,) from the first pointing, 0, to the last, 1."""
    since = s.time - s.time.min()
    return np.asarray(since / max(float(since.max()), 1.0))
