"""Twelve causes that a catalogue has, by formulas of their own; parameters in the units and signs of its cards.

A parameter is a correction (truth less reading), so a reading changes by its negative, unless it is a motion of a
target or a station, or an added variance.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import reduce
from operator import add

import numpy as np

from .hall import Draw, Hall
from .tracker import Array, Change, within_a_turn

MICRO = 1e-6
HOUR = 3600.0
STILL = 1e-4
"""[rad] A circle that turned less stood still."""


@dataclass(frozen=True)
class Known:
    """A catalogued cause: one change a parameter at one of its unit, and values of plausible proportions."""

    parts: tuple[Change, ...]
    names: tuple[str, ...]
    unit: str
    values: Array
    observables: tuple[str, ...] = ()
    stations: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    shape: dict[str, float] = field(default_factory=dict)
    """Constants that enter nonlinearly, in the unit a person reads."""

    def change(self) -> Change:
        """All parts together."""
        return reduce(add, (part.scaled(value) for value, part in zip(self.values, self.parts, strict=True)))


def _correction(h: Hall, column: int, amount: Array) -> Change:
    """A correction of a raw reading by amounts (n,) [um, urad, or what is said in the amount]."""
    change = np.zeros((len(h.pointings), 3))
    change[:, column] = -MICRO * amount
    return Change(reading=change)


def _station(h: Hall, rng: Draw) -> tuple[str, Array]:
    s = int(rng.integers(len(h.stations)))
    return h.stations[s], h.pointings.station == s


def _gap(times: Array, rng: Draw, least: int) -> float:
    """[s] The middle between two pointings with some on either side."""
    times = np.unique(times)
    k = int(rng.integers(least, len(times) - least))
    return float((times[k - 1] + times[k]) / 2)


def range_step(h: Hall, rng: Draw) -> Known:
    """The beam was lost and found again at one station."""
    name, here = _station(h, rng)
    time = _gap(h.pointings.time[here], rng, 3)
    part = _correction(h, 0, here * (h.pointings.time >= time))
    values, shape = rng.choice([-30.0, 30.0], 1), {"time": time}
    return Known((part,), ("range-step",), "um", values, ("distance",), (name,), shape=shape)


def range_drift(h: Hall, rng: Draw) -> Known:
    """The electronics warm up."""
    minutes = float(np.exp(rng.uniform(np.log(15.0), np.log(120.0))))
    part = _correction(h, 0, np.exp(-(h.pointings.time - h.pointings.time[0]) / (60.0 * minutes)))
    shape = {"time_constant": minutes}
    return Known((part,), ("range-drift-amplitude",), "um", rng.choice([-30.0, 30.0], 1), ("distance",), shape=shape)


def index_drift(h: Hall, rng: Draw) -> Known:
    """The zero of the elevation circle runs off through the day."""
    part = _correction(h, 2, (h.pointings.time - h.pointings.time[0]) / HOUR)
    return Known((part,), ("index-drift",), "urad/h", rng.choice([-10.0, 10.0], 1), ("elevation",))


def azimuth_drift(h: Hall, rng: Draw) -> Known:
    """The base of one station turns."""
    name, here = _station(h, rng)
    since = h.pointings.time - h.pointings.time[here].min()
    part = _correction(h, 1, here * since / HOUR)
    return Known((part,), ("azimuth-drift",), "urad/h", rng.choice([-20.0, 20.0], 1), ("azimuth",), (name,))


def station_bump(h: Hall, rng: Draw) -> Known:
    """Somebody touched the tripod."""
    name, here = _station(h, rng)
    time = _gap(h.pointings.time[here], rng, 5)
    after = (here & (h.pointings.time >= time))[:, None] * MICRO
    moves = [Change(station=after * axis) for axis in np.eye(3)] + [Change(turn=after * axis) for axis in np.eye(3)]
    names = tuple(f"{what}-{axis}" for what in ("shift", "turn") for axis in "xyz")
    values = rng.standard_normal(6) * [20.0, 20.0, 20.0, 10.0, 10.0, 10.0]
    return Known(tuple(moves), names, "um um um urad urad urad", values, (), (name,), (), {"time": time})


def target_moved(h: Hall, rng: Draw) -> Known:
    """A nest was knocked between two set-ups."""
    t = int(rng.integers(len(h.targets)))
    mine = h.pointings.target == t
    before = np.flatnonzero(np.diff(h.pointings.station[mine]))
    times = h.pointings.time[mine]
    k = int(rng.choice(before))
    time = float((times[k] + times[k + 1]) / 2)
    after = (mine & (h.pointings.time >= time))[:, None] * MICRO
    parts = tuple(Change(target=after * axis) for axis in np.eye(3))
    names = ("moved-x", "moved-y", "moved-z")
    return Known(parts, names, "um", 40.0 * rng.standard_normal(3), (), (), (h.targets[t],), {"time": time})


def nest_lift(h: Hall, rng: Draw) -> Known:
    """Dirt lay under the ball during one visit, not the last one."""
    t, s = int(rng.integers(len(h.targets))), int(rng.integers(1, len(h.stations) - 1))
    here = ((h.pointings.target == t) & (h.pointings.station == s))[:, None] * MICRO
    part = Change(target=here * h.normals[t])
    return Known((part,), ("lift",), "um", np.array([50.0]), (), (h.stations[s],), (h.targets[t],))


def range_cyclic(h: Hall, rng: Draw) -> Known:
    """Crosstalk of the modulation."""
    metres = 1.0 / rng.uniform(1.0 / 2.0, 1.0 / 0.05)
    phase = 2 * np.pi * h.pointings.seen[:, 0] / metres
    parts = tuple(_correction(h, 0, wave) for wave in (np.cos(phase), np.sin(phase)))
    shape = {"wavelength": 1e3 * metres}
    return Known(parts, ("cyclic-cos", "cyclic-sin"), "um", 8.0 * rng.standard_normal(2), ("distance",), shape=shape)


def station_weather(h: Hall, rng: Draw) -> Known:
    """The thermometer of one station stood in the sun."""
    name, here = _station(h, rng)
    part = _correction(h, 0, here * h.pointings.seen[:, 0])
    return Known((part,), ("station-weather",), "ppm", rng.choice([-5.0, 5.0], 1), ("distance",), (name,))


def azimuth_harmonic(h: Hall, rng: Draw) -> Known:
    """Lines of the scale are off, some times a turn."""
    order = int(rng.integers(3, 7))
    raw = order * h.pointings.readings()[:, 1]
    parts = tuple(_correction(h, 1, wave) for wave in (np.cos(raw), np.sin(raw)))
    names = ("azimuth-harmonic-cos", "azimuth-harmonic-sin")
    return Known(parts, names, "urad", 2.0 * rng.standard_normal(2), ("azimuth",))


def backlash(h: Hall, rng: Draw) -> Known:
    """What a circle reads depends on the side it came from; on one face, for half a turn has no shorter way round."""
    if (h.pointings.face == 2).any():
        raise LookupError("two faces")
    parts = tuple(_correction(h, axis, -0.5 * _side(h, h.pointings.seen[:, axis])) for axis in (1, 2))
    names = ("backlash-azimuth", "backlash-elevation")
    return Known(parts, names, "urad", 6.0 * rng.standard_normal(2), ("azimuth", "elevation"))


def _side(h: Hall, angle: Array) -> Array:
    """(n,) Sign of the last turn of a circle in this set-up; 0 before the first."""
    side, last = np.zeros(len(angle)), 0.0
    for row in range(1, len(angle)):
        move = float(within_a_turn(angle[row : row + 1] - angle[row - 1])[0])
        last = 0.0 if h.starts[row] == row else last if abs(move) < STILL else float(np.sign(move))
        side[row] = last
    return side


def station_noise(h: Hall, rng: Draw) -> Known:
    """An unsteady stand: all readings of one station scatter more."""
    name, here = _station(h, rng)
    parts = tuple(Change(variance=here[:, None] * axis) for axis in np.eye(3))
    names = ("noise-distance", "noise-azimuth", "noise-elevation")
    return Known(parts, names, "", rng.uniform(0.5, 2.0, 3), (), (name,))


_ALL = (range_step, range_drift, index_drift, azimuth_drift, station_bump, target_moved, nest_lift, range_cyclic,
        station_weather, azimuth_harmonic, backlash, station_noise)  # fmt: skip
KNOWN: dict[str, Callable[[Hall, Draw], Known]] = {cause.__name__.replace("_", "-"): cause for cause in _ALL}
