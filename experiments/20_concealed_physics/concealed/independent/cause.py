"""What a law that is in no catalogue says of itself, and what laws are made of: readings, constants, stations, groups.

A law draws its constants and gives what it does to every pointing at size one (a micrometre, a microradian, or the
stated variance once more). A hall without the column or the second tracker that it needs raises LookupError.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .hall import WARMTH, Hall
from .tracker import CONSTANTS, Array, Change, within_a_turn

MICRO = 1e-6
UP, OUT = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
"""Upwards, and away from the wall."""
CLOCK = ("time", "order")
TURN = ("move", "approach", "before")
WARM = (WARMTH, "temperature", "time")
"""Words for what follows the clock, the last turn of the head, and the warmth of the hall."""
Draw = np.random.Generator
CARRIERS = {
    "distance": ("distance", "range"),
    "azimuth": ("azimuth",),
    "elevation": ("elevation", "vertical index"),
    "vertical-index": ("elevation", "vertical index"),
    "beam-tilt": ("beam tilt",),
    "transit-tilt": ("transit tilt",),
    "vertical-offset": ("beam offset", "vertical offset"),
    "eccentricity": ("eccentricity", "azimuth"),
    "station": ("stand", "station"),
    "yaw": ("stand", "station", "azimuth"),
    "targets": ("target",),
    "noise": ("noise",),
}
"""What is turned or moved: the words of which a finding's carrier has one, if it is right."""


@dataclass(frozen=True)
class Cause:
    """What was drawn: its doing, where it acts, and what it is in words."""

    change: Change
    carrier: str
    """A key of `CARRIERS`."""
    drivers: tuple[str, ...]
    """What it follows, in any word of which a finding may say it: the clock that a column went with among them."""
    observables: tuple[str, ...] = ()
    """Readings it acts on; empty: all three."""
    stations: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    place: str = "everywhere"


Law = Callable[[Hall, Draw], Cause]


def reading(h: Hall, column: int, amount: Array) -> Change:
    """A change of one raw reading by amounts (n,) [um, urad]; the raw elevation of the back face runs backwards."""
    change = np.zeros((len(h.pointings), 3))
    change[:, column] = MICRO * amount
    if column == 2:
        change[h.pointings.face == 2, 2] *= -1
    return Change(reading=change)


def vary(h: Hall, constant: str, amount: Array) -> Change:
    """A constant of the tracker that varies by amounts (n,) [um, urad]."""
    change = np.zeros((len(h.pointings), len(CONSTANTS)))
    change[:, CONSTANTS.index(constant)] = MICRO * amount
    return Change(constants=change)


def one_station(h: Hall, rng: Draw) -> tuple[str, Array]:
    """A station and where it is the one that measures (n,)."""
    s = int(rng.integers(len(h.stations)))
    return h.stations[s], (h.pointings.station == s).astype(np.float64)


def one_tracker(h: Hall, rng: Draw) -> tuple[str, Array]:
    """One of two trackers, as a place, and where it is the one that measures (n,)."""
    if len(h.trackers) < 2:
        raise LookupError("one tracker only")
    k = int(rng.integers(len(h.trackers)))
    return f"instrument {h.trackers[k]}", (h.pointings.tracker == k).astype(np.float64)


def latched(h: Hall, values: Array, low: float, high: float) -> Array:
    """(n,) 1 once values rose above the high mark, until they fall below the low one; 0 when a set-up begins."""
    known = (values < low) | (values > high) | (h.turn_of_work == 0)
    last = np.maximum.accumulate(np.where(known, np.arange(len(values)), 0))
    return np.asarray(values[last] > high, dtype=np.float64)


def group(h: Hall, name: str) -> tuple[tuple[str, ...], Array]:
    """Names of a group's targets, and the pointings (n,) to them."""
    inside = np.isin(h.pointings.target, h.groups[name])
    return tuple(h.targets[t] for t in sorted(h.groups[name])), inside.astype(np.float64)


def windows(h: Hall, rng: Draw) -> Array:
    """(n,) 1 while a machine runs that works for a part of every cycle."""
    cycle, share = rng.uniform(900.0, 2400.0), rng.uniform(0.3, 0.6)
    return (np.mod(h.pointings.time + rng.uniform(0.0, cycle), cycle) < share * cycle).astype(np.float64)


def level(rng: Draw) -> Array:
    """(3,) A level direction."""
    angle = rng.uniform(-np.pi, np.pi)
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def walk(h: Hall, rng: Draw) -> Array:
    """(n,) a random walk from pointing to pointing with a variance of one at the end of the work."""
    n = len(h.pointings)
    return np.cumsum(rng.standard_normal(n)) / np.sqrt(n)


def aims(h: Hall) -> Array:
    """(n, 3) [m] Nests that the pointings go to, in the room."""
    return np.asarray(h.pointings.points[h.pointings.target])


def backwards(h: Hall) -> Array:
    """(n,) [rad] By which the head stands turned round for the back face."""
    return np.pi * (h.pointings.face == 2)


def circle(h: Hall) -> Array:
    """(n,) [rad] Where the azimuth circle is read."""
    return within_a_turn(h.pointings.seen[:, 1] + backwards(h))


def swing(h: Hall) -> Array:
    """(n,) [rad] Turn of the head since the pointing before, the short way round; nothing when a set-up begins."""
    return within_a_turn(h.since_before(circle(h)))


def gap(h: Hall) -> Array:
    """(n,) [s] Since the pointing before, breaks included."""
    return np.diff(h.pointings.time, prepend=h.pointings.time[0])


def decaying(h: Hall, given: Array, memory: float) -> Array:
    """(n,) What is left of all that was given (n,) up to each pointing, where it dies away with a memory [s]."""
    kept = np.exp(-gap(h) / memory)
    left, found = 0.0, np.empty(len(given))
    for i, (share, more) in enumerate(zip(kept.tolist(), given.tolist(), strict=True)):
        left = share * left + more
        found[i] = left
    return found


def lagging(h: Hall, values: Array, delay: float) -> Array:
    """(n,) Values as a thing has them that follows with a delay [s], and had the first of them when the work began."""
    given = (1.0 - np.exp(-gap(h) / delay)) * values
    given[0] = values[0]
    return decaying(h, given, delay)


def named(*laws: Law) -> dict[str, Law]:
    """Laws by their names in words."""
    return {law.__name__.replace("_", " "): law for law in laws}
