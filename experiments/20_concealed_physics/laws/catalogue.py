"""Twelve causes that a catalogue has, by formulas of their own; parameters in the units and signs of its cards.

A parameter is a correction (truth less reading), so a reading changes by its negative, unless it is a motion of a
target or a station, or an added variance.
"""

from collections.abc import Callable

import numpy as np

from ..hall import Draw, Hall
from ..law import OBSERVABLES, Cause, carriers
from ..tracker import Array, Change, within_a_turn

MICRO = 1e-6
HOUR = 3600.0
STILL = 1e-4
"""[rad] A circle that turned less stood still."""


def _cause(
    parts: tuple[Change, ...], names: str, unit: str, values: Array, station: str = "", target: str = "", **shape: float
) -> Cause:
    """A change a parameter at one of its unit, and values of plausible proportions; `shape`: nonlinear constants."""
    units = tuple(unit.split()) if " " in unit else (unit,) * len(parts)
    reads = [name for name in OBSERVABLES if any(name in carriers(part) for part in parts)]
    places = {"stations": [station] if station else [], "targets": [target] if target else []}
    return Cause(parts, values, {**places, "observables": reads, "shape": shape}, tuple(names.split()), units)


def _correction(h: Hall, column: int, amount: Array) -> Change:
    """A correction of a raw reading by amounts (n,) [um, urad, or what is said in the amount]."""
    change = np.zeros((h.n, 3))
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


def range_step(h: Hall, rng: Draw) -> Cause:
    """The beam was lost and found again at one station."""
    name, here = _station(h, rng)
    time = _gap(h.time[here], rng, 3)
    part = _correction(h, 0, here * (h.time >= time))
    return _cause((part,), "range-step", "um", rng.choice([-30.0, 30.0], 1), name, time=time)


def range_drift(h: Hall, rng: Draw) -> Cause:
    """The electronics warm up."""
    minutes = float(np.exp(rng.uniform(np.log(15.0), np.log(120.0))))
    part = _correction(h, 0, np.exp(-(h.time - h.time[0]) / (60.0 * minutes)))
    return _cause((part,), "range-drift-amplitude", "um", rng.choice([-30.0, 30.0], 1), time_constant=minutes)


def index_drift(h: Hall, rng: Draw) -> Cause:
    """The zero of the elevation circle runs off through the day."""
    part = _correction(h, 2, (h.time - h.time[0]) / HOUR)
    return _cause((part,), "index-drift", "urad/h", rng.choice([-10.0, 10.0], 1))


def azimuth_drift(h: Hall, rng: Draw) -> Cause:
    """The base of one station turns."""
    name, here = _station(h, rng)
    part = _correction(h, 1, here * (h.time - h.time[here].min()) / HOUR)
    return _cause((part,), "azimuth-drift", "urad/h", rng.choice([-20.0, 20.0], 1), name)


def station_bump(h: Hall, rng: Draw) -> Cause:
    """Somebody touched the tripod."""
    name, here = _station(h, rng)
    time = _gap(h.time[here], rng, 5)
    after = (here & (h.time >= time))[:, None] * MICRO
    parts = [Change(station=after * axis) for axis in np.eye(3)] + [Change(turn=after * axis) for axis in np.eye(3)]
    values = rng.standard_normal(6) * [20.0, 20.0, 20.0, 10.0, 10.0, 10.0]
    names = "shift-x shift-y shift-z turn-x turn-y turn-z"
    return _cause(tuple(parts), names, "um um um urad urad urad", values, name, time=time)


def target_moved(h: Hall, rng: Draw) -> Cause:
    """A nest was knocked between two set-ups."""
    t = int(rng.integers(len(h.targets)))
    mine = h.pointings.target == t
    times = h.time[mine]
    k = int(rng.choice(np.flatnonzero(np.diff(h.pointings.station[mine]))))
    time = float((times[k] + times[k + 1]) / 2)
    after = (mine & (h.time >= time))[:, None] * MICRO
    parts = tuple(Change(target=after * axis) for axis in np.eye(3))
    values = 40.0 * rng.standard_normal(3)
    return _cause(parts, "moved-x moved-y moved-z", "um", values, target=h.targets[t], time=time)


def nest_lift(h: Hall, rng: Draw) -> Cause:
    """Dirt lay under the ball during one visit, not the last one."""
    t, s = int(rng.integers(len(h.targets))), int(rng.integers(1, len(h.stations) - 1))
    here = ((h.pointings.target == t) & (h.pointings.station == s))[:, None] * MICRO
    return _cause((Change(target=here * h.normals[t]),), "lift", "um", np.array([50.0]), h.stations[s], h.targets[t])


def range_cyclic(h: Hall, rng: Draw) -> Cause:
    """Crosstalk of the modulation."""
    metres = 1.0 / rng.uniform(1.0 / 2.0, 1.0 / 0.05)
    phase = 2 * np.pi * h.distance / metres
    parts = tuple(_correction(h, 0, wave) for wave in (np.cos(phase), np.sin(phase)))
    return _cause(parts, "cyclic-cos cyclic-sin", "um", 8.0 * rng.standard_normal(2), wavelength=1e3 * metres)


def station_weather(h: Hall, rng: Draw) -> Cause:
    """The thermometer of one station stood in the sun."""
    name, here = _station(h, rng)
    part = _correction(h, 0, here * h.distance)
    return _cause((part,), "station-weather", "ppm", rng.choice([-5.0, 5.0], 1), name)


def azimuth_harmonic(h: Hall, rng: Draw) -> Cause:
    """Lines of the scale are off, some times a turn."""
    raw = int(rng.integers(3, 7)) * h.pointings.readings()[:, 1]
    parts = tuple(_correction(h, 1, wave) for wave in (np.cos(raw), np.sin(raw)))
    return _cause(parts, "azimuth-harmonic-cos azimuth-harmonic-sin", "urad", 2.0 * rng.standard_normal(2))


def backlash(h: Hall, rng: Draw) -> Cause:
    """What a circle reads depends on the side it came from; on one face, for half a turn has no shorter way round."""
    if h.back.any():
        raise LookupError("two faces")
    parts = tuple(_correction(h, axis, -0.5 * _side(h, h.local_points[:, axis])) for axis in (1, 2))
    return _cause(parts, "backlash-azimuth backlash-elevation", "urad", 6.0 * rng.standard_normal(2))


def _side(h: Hall, angle: Array) -> Array:
    """(n,) Sign of the last turn of a circle in this set-up; 0 before the first."""
    side, last = np.zeros(len(angle)), 0.0
    for row in range(1, len(angle)):
        move = float(within_a_turn(angle[row : row + 1] - angle[row - 1])[0])
        last = 0.0 if h.starts[row] == row else last if abs(move) < STILL else float(np.sign(move))
        side[row] = last
    return side


def station_noise(h: Hall, rng: Draw) -> Cause:
    """An unsteady stand: all readings of one station scatter more."""
    name, here = _station(h, rng)
    parts = tuple(Change(variance=here[:, None] * axis) for axis in np.eye(3))
    return _cause(parts, "noise-distance noise-azimuth noise-elevation", "", rng.uniform(0.5, 2.0, 3), name)


_ALL = (range_step, range_drift, index_drift, azimuth_drift, station_bump, target_moved, nest_lift, range_cyclic,
        station_weather, azimuth_harmonic, backlash, station_noise)  # fmt: skip
KNOWN: dict[str, Callable[[Hall, Draw], Cause]] = {cause.__name__.replace("_", "-"): cause for cause in _ALL}
