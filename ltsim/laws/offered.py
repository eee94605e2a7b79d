"""Which drivers a carrier may follow in a recording, and which of them are tried."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import combinations, product

import numpy as np

from ltsim.arrays import Floats
from ltsim.laws.columns import LOW, MODES, PARTS
from ltsim.laws.drivers import BELLS, CLOCKS, CONSTANT, PLANES, SEVERAL, Driver, simple, smooth
from ltsim.scene.sightings import Sightings

_AXES = ("azimuth", "elevation")
_OWN = ("azimuth", "elevation", "distance", "time", "station-time", "height", "bearing")
_CIRCLES = ("circle", "vertical-circle")
_BALL = ("incidence", "nest-direction")
_BEFORE = ("wound-azimuth", "lapse", *(f"{when}-{n}" for when in ("move", "last") for n in (*_AXES, "distance")))


def further(sightings: Sightings) -> list[str]:
    """Columns of the recording beyond the format's that vary."""
    return [name for name, values in sightings.covariates.items() if np.nanstd(values) > 0]


def _varying(sightings: Sightings, names: Iterable[str]) -> list[str]:
    """What of some covariates, and which further columns, vary here."""
    seen = np.isfinite(sightings.incidence).any()
    asked = [n for n in (*names, *further(sightings)) if seen or n not in _BALL]
    asked += _CIRCLES if np.ptp(sightings.face) else ()
    return [n for n in asked if np.ptp(sightings.quantities[n]) > 0]


def covariates_of(sightings: Sightings) -> list[str]:
    """What a smooth driver may follow here."""
    return _varying(sightings, (*_OWN, "x", "y", *_BALL, *_BEFORE))


def general_drivers(sightings: Sightings, modes: int = MODES) -> list[Driver]:
    """Drivers of every carrier: constants, signs, clocks that decay, smooth in every covariate."""
    tried = ["face", "approach-azimuth", "approach-elevation", "parity", "repeat"]
    one, other = (sightings.quantities[name] for name in ("parity", "seating-parity"))
    tried += ["seating-parity"] if abs(one @ other) < len(one) else []
    signs = [s for s in tried if np.ptp(sightings.quantities[s]) > 0]
    found = [CONSTANT, *(simple(name, "power") for name in signs)]
    found += visits(sightings, FEW_VISITS + 1)
    for name in CLOCKS:
        span = float(np.ptp(sightings.quantities[name]))
        found += [simple(name, "decay", float(t)) for t in span * DECAYS if span > 0]
    for name in ("move-azimuth", "move-elevation", "move-distance"):
        if np.ptp(sightings.quantities[name]) > 0:
            found.append(simple(name, "abs"))
    found += lags(sightings, (*further(sightings), "elevation", "distance", "move-azimuth", "move-elevation"))
    return [*found, *(smooth(name, modes) for name in covariates_of(sightings))]


def visits(sightings: Sightings, least: int = 2) -> list[Driver]:
    """Another amount at each set-up, where there are at least so many."""
    count = len(np.unique(sightings.station))
    return [Driver("visits", constant=count)] if least <= count <= MOST_VISITS else []


DECAYS = np.array([0.03, 0.1, 0.3, 1.0])
"""Time constants of decays over a clock's span: what lies between two of them is within a factor of two of one."""
MEMORIES = (60.0, 300.0, 1000.0, 3000.0)
"""[s] Lags that are tried: of detectors, of parts of an instrument, of stands, of walls and floors."""


def lags(sightings: Sightings, names: Iterable[str]) -> list[Driver]:
    """Drivers that follow covariates with a lag."""
    varying = [name for name in names if np.ptp(sightings.quantities[name]) > 0]
    return [Driver("lagging", (name,), constant=t) for t in MEMORIES if np.ptp(sightings.time) > t for name in varying]


FEW_VISITS, MOST_VISITS = 3, 12
"""Set-ups beyond and up to whose number each may have a value of its own; of few, one or two stand out."""
_MOVES = tuple(f"{when}-{axis}" for when in ("approach", "move", "last") for axis in _AXES)
_HEAD = (*_AXES, *_CIRCLES, "face", "wound-azimuth", *_MOVES)
_TURNS = ("parity", "seating-parity", "repeat")
DRIVES: dict[str, tuple[str, ...]] = {
    "instrument": (*CLOCKS, "lapse", *_HEAD, *_TURNS, "distance", "height", "move-distance", "last-distance"),
    "circle": (*CLOCKS, "lapse", *_TURNS),
    "stand": (*CLOCKS, "lapse", *_AXES, "wound-azimuth", "distance"),
    "target": ("time", *_TURNS),
    "reflector": ("time", "lapse", *_TURNS, *_BALL),
    "air": CLOCKS,
}
"""What each kind of carrier can follow beside columns of the recording: a wall does not know where a tracker looks; its
stand does, for a head is never quite in balance, and the floor gives under whoever holds the reflector."""
FOLLOWED = tuple(dict.fromkeys((*_OWN, "x", "y", "z", *_BALL, *_BEFORE, *_HEAD, *_TURNS)))
"""Everything that a reading can follow beside columns of the recording."""


def moves(kind: str, driver: Driver, sightings: Sightings) -> bool:
    """Whether a driver can move a kind of carrier; a reading may err with anything."""
    names = [*driver.covariates, *(n for f in driver.factors if f.kind != "field" for n in f.covariates)]
    return kind == "reading" or all(n in DRIVES[kind] or n in sightings.covariates for n in names)


def products(sightings: Sightings) -> Iterator[Driver]:
    """Products of two drivers: a sign and a smooth one, and two smooth ones in different covariates."""
    names = _varying(sightings, (*_OWN, *_BALL))
    for sign in ("face", "approach-azimuth", "approach-elevation"):
        if np.ptp(sightings.quantities[sign]) > 0:
            for name in names:
                yield Driver("product", factors=(simple(sign, "power"), smooth(name, LOW)))
    weights = [simple("distance", "power"), simple("elevation", "power")]
    weights += [smooth("lapse", LOW)] if np.ptp(sightings.quantities["lapse"]) > 0 else []  # a move is forgotten
    moved = [f"move-{axis}" for axis in (*_AXES, "distance")]
    for length, function, weight in product(moved, ("abs", "power"), weights):
        if np.ptp(sightings.quantities[length]) > 0:
            yield Driver("product", factors=(simple(length, function), weight))
    for one, other in combinations(names, 2):
        if {one, other} not in ({"time", "station-time"}, {"azimuth", "bearing"}) and other not in _CIRCLES:
            yield Driver("product", factors=(smooth(one, LOW), smooth(other, LOW)))


ANGLES = (0.12, 0.3)
"""[rad] Angles within which sights pass a target that are tried first."""


def sights(sightings: Sightings) -> Iterator[Driver]:
    """What errs on the way: near a line of sight, beyond a plane, in a curtain; a list that is one row late."""
    count = len(sightings.target_names)
    for name, angle, kind in product(sightings.target_names if count <= MOST_LINES else (), ANGLES, BELLS):
        yield Driver(kind, SEVERAL[kind], constant=angle, around=(name,))
    for axis, name in enumerate("xyz"):
        low, high = (float(end(sightings.points[:, axis])) for end in (np.min, np.max))
        for plane in np.linspace(low, high, PARTS + 1)[1:-1] if high > low else ():
            yield from (Driver(kind, ("distance", name), constant=float(plane)) for kind in PLANES)
    if 1 < count <= MOST_LINES:
        yield Driver("late", SEVERAL["late"], constant=count)


MOST_LINES = 60
"""Targets up to whose number each is tried as one that sights pass, or that a list is late by."""
WAVE_STEP = 0.6
"""Step of the rates tried for a wave, in cycles over the covariate's span: no rate lies far from one that is tried."""
MOST_CYCLES, LEAST_OF_A_CYCLE = 60, 8
"""Cycles over a covariate's span that a wave may have, and pointings that each must have."""


def rates(sightings: Sightings, name: str, most: float) -> Floats:
    """Rates of waves in a covariate with up to `most` cycles over its span."""
    span = float(np.ptp(sightings.quantities[name]))
    return 2 * np.pi * np.arange(1.0, most, WAVE_STEP) / span if span > 0 else np.zeros(0)


def waves(sightings: Sightings, *, of_a_visit: bool = False) -> Iterator[Driver]:
    """Waves in clock, range, angles and place; of one visit, in its clock."""
    most = min(len(sightings) / LEAST_OF_A_CYCLE, MOST_CYCLES)
    if of_a_visit:
        for rate in rates(sightings, "station-time", most / len(sightings.station_names)):
            yield Driver("wave", ("station-time",), constant=float(rate))
        return
    for name in ("time", "distance", "azimuth", "elevation", "x", "y", "z", "station-time"):
        for rate in rates(sightings, name, most):
            yield Driver("wave", (name,), constant=float(rate))
