"""The flexible terms that a diagnosis tries: broad families over everything a reading may depend on.

Geometry, clock, face, the move since the last pointing, nest, place and every further column of the recording; alone
(smooth, periodic, local, stepped, decaying), two together, and confined to a station, a target or neighbouring targets.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, product

import numpy as np

from ltsim.diagnose.bank import Hypothesis
from ltsim.diagnose.flexible import (
    AXES,
    CIRCULAR,
    CYCLES,
    EDGES,
    LOCAL_WIDTHS,
    NORMAL,
    PLACE,
    Column,
    Factor,
    FlexibleTerm,
    further,
    smooth,
    wave,
)
from ltsim.recording.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings

MOST_CYCLES, STATION_CYCLES, MOVE_CYCLES = 60, 15, 10
MOST_STATIONS, MOST_TARGETS = 12, 60
"""Places up to whose number each has smooth terms of its own."""
MOVES = ("move-azimuth", "move-elevation", "move-distance")
LAST = ("last-azimuth", "last-elevation", "last-distance", "lapse")
APPROACHES = ("approach-azimuth", "approach-elevation")
NEIGHBOURS = (4, 6, 9)
"""Targets that stand together: a target with so many around it."""
MOVE_TIMES = 10
"""Moments tried at which neighbours move at once."""
SATURATION = (0.01, 0.03, 0.1, 0.3)
"""Moves after which half of an effect is reached, as a share of their span."""
DECAYS = 8
"""Time constants tried, from a twentieth of a station's time to three times all of it."""


def flexible_hypotheses(sightings: Sightings) -> list[Hypothesis]:
    """All flexible terms tried on a network."""
    return [
        *_smooth_terms(sightings),
        *_periodic_terms(sightings),
        *_local_terms(sightings),
        *_steps(sightings),
        *_decays(sightings),
        *_memory_terms(sightings),
        *_own_constants(sightings),
        *_moving_terms(sightings),
        *_product_terms(sightings),
        *_nest_terms(sightings),
        *_pair_terms(sightings),
        *_field_terms(sightings),
        *_neighbour_terms(sightings),
    ]


def _term(
    observable: str, *columns: Column, stations: tuple[str, ...] = (), targets: tuple[str, ...] = ()
) -> FlexibleTerm:
    return FlexibleTerm(stations, targets, observable, columns)


def _covariates(sightings: Sightings) -> list[str]:
    """What a reading may depend on here: geometry, clock, nest, and every further column that varies."""
    names = ["azimuth", "elevation", "distance", "time", "station-time", "height"]
    if _nested(sightings):
        names += ["incidence", "nest-direction"]
    return names + further(sightings)


def _nested(sightings: Sightings) -> bool:
    return bool(np.isfinite(sightings.incidence).any())


def _faced(sightings: Sightings) -> bool:
    return bool((sightings.face == 2).any())


def _smooth_terms(sightings: Sightings) -> Iterator[Hypothesis]:
    for observable, name in product(OBSERVABLES, _covariates(sightings)):
        for count in (2, 5, 8, 14):
            columns = smooth(name, count)
            yield Hypothesis(f"unknown:{observable}:{name}", _term(observable, *columns), False)
            if _faced(sightings):
                odd = tuple((("face", "power", 1.0), *c) for c in columns)
                yield Hypothesis(f"unknown:{observable}:{name}:face", _term(observable, *odd), False)
        if len(sightings.station_names) <= MOST_STATIONS:
            for station, count in product(sightings.station_names, (4, 10)):
                term = _term(observable, *smooth(name, count), stations=(station,))
                yield Hypothesis(f"unknown:{observable}:{name}:station", term, False)
        if len(sightings.target_names) <= MOST_TARGETS:
            for target in sightings.target_names:
                term = _term(observable, *smooth(name, 2), targets=(target,))
                yield Hypothesis(f"unknown:{observable}:{name}:target", term, False)


def _rates(sightings: Sightings, name: str, most: float) -> list[float]:
    """Rates of waves in a covariate with up to `most` cycles over its span; none where it does not vary."""
    span = float(np.ptp(sightings.quantities[name]))
    return (2 * np.pi * np.arange(1.0, most, CYCLES) / span).tolist() if span > 0 else []


def _periodic_terms(sightings: Sightings) -> Iterator[Hypothesis]:
    most = dict.fromkeys(("time", "distance", "azimuth", "elevation", "x", "y", "z"), MOST_CYCLES)
    most |= dict.fromkeys(("move-azimuth", "move-elevation", "lapse"), MOVE_CYCLES)
    for observable, name in product(OBSERVABLES, most):
        for rate in _rates(sightings, name, min(len(sightings) / 8, most[name])):
            yield Hypothesis(f"unknown:{observable}:{name}:periodic", _term(observable, *wave(name, rate)), False)
    stations = sightings.station_names
    if not 1 < len(stations) <= MOST_STATIONS:
        return
    for observable, name in product(OBSERVABLES, ("station-time", "distance", "azimuth", "elevation")):
        rates = _rates(sightings, name, min(len(sightings) / (3 * len(stations)), STATION_CYCLES))
        for rate, station in product(rates, stations):
            term = _term(observable, *wave(name, rate), stations=(station,))
            yield Hypothesis(f"unknown:{observable}:{name}:periodic:station", term, False)


def _local_terms(sightings: Sightings) -> Iterator[Hypothesis]:
    """A bump in one direction, at one distance, for a while."""
    for observable, name in product(OBSERVABLES, ("azimuth", "elevation", "distance", "time")):
        values = sightings.quantities[name]
        for function, width in LOCAL_WIDTHS.items():
            for centre in np.linspace(values.min(), values.max(), round(1.5 / width)):
                column = ((name, function, float(centre)),)
                yield Hypothesis(f"unknown:{observable}:{name}:local", _term(observable, column), False)


def _steps(sightings: Sightings) -> Iterator[Hypothesis]:
    """A reading that jumps where a covariate passes a value, or bends there: a stop, a threshold, a saturation."""
    for observable, name in product(OBSERVABLES, [*_covariates(sightings), *MOVES, "lapse"]):
        values = sightings.quantities[name]
        for edge in np.unique(np.quantile(values, np.linspace(0.0, 1.0, EDGES + 2)[1:-1])):
            for function in ("step", "bend"):
                column = ((name, function, float(edge)),)
                yield Hypothesis(f"unknown:{observable}:{name}:{function}", _term(observable, column), False)


def _decays(sightings: Sightings) -> Iterator[Hypothesis]:
    """What dies away after a station has begun, alone or along the beam, up and round the instrument."""
    longest = float(sightings.station_time.max())
    if longest <= 0:
        return
    along: tuple[Column, ...] = ((), (("distance", "power", 1.0),), (("elevation", "tan", 1.0),))
    for constant in np.geomspace(0.05 * longest, 3.0 * longest, DECAYS):
        decay: Factor = ("station-time", "decay", float(constant))
        for observable in OBSERVABLES:
            for rest in along:
                term = _term(observable, (decay, *rest))
                yield Hypothesis(f"unknown:{observable}:station-time:decay", term, False)
            turning = _term(observable, *((decay, *column) for column in AZIMUTH[:2]))
            yield Hypothesis(f"unknown:{observable}:station-time:decay", turning, False)


def _memory_terms(sightings: Sightings) -> Iterator[Hypothesis]:
    """What the last move left behind: by its direction, its length, or both."""
    approaches = [a for a in APPROACHES if np.any(sightings.quantities[a])]
    for observable, name in product(OBSERVABLES, approaches):
        sign: Factor = (name, "power", 1.0)
        for e, d in product(ELEVATION, DISTANCE):
            yield Hypothesis(f"unknown:{observable}:approach", _term(observable, (sign, *e, *d)), False)
            for k in range(0, 8, 2):
                pair = ((sign, *AZIMUTH[k], *e, *d), (sign, *AZIMUTH[k + 1], *e, *d))
                yield Hypothesis(f"unknown:{observable}:approach", _term(observable, *pair), False)
        for clock in ("time", "station-time", "lapse"):
            columns = ((sign,), *((sign, *c) for c in smooth(clock, 2)))
            yield Hypothesis(f"unknown:{observable}:approach", _term(observable, *columns), False)
    moves = [m for m in MOVES if np.ptp(sightings.quantities[m]) > 0]
    for observable, name in product(OBSERVABLES, [*moves, *LAST] if moves else []):
        for count in (1, 2, 5):
            yield Hypothesis(f"unknown:{observable}:move", _term(observable, *smooth(name, count)), False)
        for half in SATURATION:
            function: Factor = (name, "saturated", half * float(np.ptp(sightings.quantities[name])))
            yield Hypothesis(f"unknown:{observable}:move", _term(observable, (function,)), False)
        for e, d in product(ELEVATION, DISTANCE):
            length = ((name, "abs", 1.0), *e, *d)
            yield Hypothesis(f"unknown:{observable}:move", _term(observable, length), False)
            if e + d:
                signed = ((name, "power", 1.0), *e, *d)
                yield Hypothesis(f"unknown:{observable}:move", _term(observable, signed), False)


def _own_constants(sightings: Sightings) -> Iterator[Hypothesis]:
    """Constants of the instrument that are others at one station: index and tilt of the transit axis."""
    if len(sightings.station_names) < 2:
        return
    sign: tuple[Factor, ...] = (("face", "power", 1.0),) if _faced(sightings) else ()
    for station in sightings.station_names:
        for observable, column in (("elevation", ()), ("azimuth", (("elevation", "tan", 1.0),))):
            term = _term(observable, (*column, *sign), stations=(station,))
            yield Hypothesis(f"unknown:{observable}:own constant", term, False)


def _moved(columns: Sequence[Column], axes: Sequence[str]) -> tuple[Column, ...]:
    """Columns of a displacement along some axes."""
    return tuple((*column, (axis, "along", 1.0)) for axis in axes for column in columns)


def _moving_terms(sightings: Sightings) -> Iterator[Hypothesis]:
    """Targets that move: in time, with a further column of the recording, in their nests, or for one station.

    Together, or more the farther along the room they lie; along one axis or in any direction.
    """
    where: tuple[Column, ...] = ((), *((((axis, "legendre", 1.0),)) for axis in AXES))
    ways: tuple[tuple[str, ...], ...] = tuple((axis,) for axis in AXES)
    for name, way in product(further(sightings), ways):
        columns = tuple(((name, "legendre", 1.0), *w) for w in where)
        yield Hypothesis(f"unknown:place:{name}", _term(PLACE, *_moved(columns, way)), False)
    if _nested(sightings):
        for name, count in product(("incidence", "azimuth", "elevation", "time"), (2, 4)):
            for way in (*ways, (NORMAL,)):
                term = _term(PLACE, *_moved(smooth(name, count), way))
                yield Hypothesis("unknown:place:nest", term, False)
    if 1 < len(sightings.station_names) <= MOST_STATIONS:
        for station, way, degree in product(sightings.station_names, (*ways, AXES), (1, 2)):
            term = _term(PLACE, *_moved(_field(degree), way), stations=(station,))
            yield Hypothesis("unknown:place:station", term, False)
    for way in ways if np.ptp(sightings.time) > 0 else ():
        for count in (1, 3):
            columns = tuple((("time", "legendre", float(k)), *w) for k in range(1, count + 1) for w in where)
            yield Hypothesis("unknown:place:time", _term(PLACE, *_moved(columns, way)), False)
        for rate in _rates(sightings, "time", min(len(sightings) / 8, MOST_CYCLES)):
            columns = tuple((*factor, *w) for factor in wave("time", rate) for w in where)
            yield Hypothesis("unknown:place:time:periodic", _term(PLACE, *_moved(columns, way)), False)


def _field(degree: int) -> tuple[Column, ...]:
    """A polynomial field over the room without its constant."""
    powers = (p for p in product(range(degree + 1), repeat=3) if 0 < sum(p) <= degree)
    return tuple(tuple((axis, "legendre", float(k)) for axis, k in zip(AXES, p, strict=True) if k) for p in powers)


AZIMUTH: tuple[Column, ...] = (*(((("azimuth", f, float(k)),)) for k in (1, 2, 3, 4) for f in ("cos", "sin")),)
ELEVATION: tuple[Column, ...] = (
    (),
    (("elevation", "power", 1.0),),
    (("elevation", "sin", 1.0),),
    (("elevation", "cos", 1.0),),
    (("elevation", "tan", 1.0),),
    (("elevation", "sin", 2.0),),
    (("elevation", "power", 2.0),),
)
DISTANCE: tuple[Column, ...] = (
    (),
    (("distance", "power", 1.0),),
    (("distance", "power", 2.0),),
    (("distance", "power", -1.0),),
)
NEARER: tuple[Column, ...] = ((), (("distance", "power", -1.0),), (("horizontal", "power", -1.0),))
"""An angle of something across the beam, by its length over the distance."""
CLOCK: tuple[Column, ...] = (
    (),
    (("time", "power", 1.0),),
    (("station-time", "power", 1.0),),
)


def _product_terms(sightings: Sightings) -> Iterator[Hypothesis]:
    """Products of simple functions: a cosine and a sine of the azimuth always go together.

    Of the azimuth as it was turned, too: a cable winds up from the zero of the circle.
    """
    for observable, e, d, function in product(OBSERVABLES, ELEVATION, DISTANCE, ("power", "abs")):
        wound = (("azimuth", function, 1.0), *e, *d)
        yield Hypothesis(f"unknown:{observable}:winding", _term(observable, wound), False)
    for observable, e, d, t in product(OBSERVABLES, ELEVATION, DISTANCE, CLOCK):
        rest = e + d + t
        for sign in ((), (("face", "power", 1.0),)) if _faced(sightings) else ((),):
            if rest + sign:
                yield Hypothesis(f"unknown:{observable}:product", _term(observable, rest + sign), False)
            for k in range(0, 8, 2):
                pair = (AZIMUTH[k] + rest + sign, AZIMUTH[k + 1] + rest + sign)
                yield Hypothesis(f"unknown:{observable}:product", _term(observable, *pair), False)


def _nest_terms(sightings: Sightings) -> Iterator[Hypothesis]:
    """A reflector that errs with the direction it is seen from: off the normal of its nest, and round it."""
    if not _nested(sightings):
        return
    tilts: tuple[Column, ...] = tuple((("incidence", f, k),) for f, k in (("sin", 1.0), ("cos", 1.0), ("power", 2.0)))
    for observable, tilt, distance in product(OBSERVABLES, ((), *tilts), NEARER):
        yield Hypothesis(f"unknown:{observable}:nest", _term(observable, tilt + distance), False)
        for order in (1.0, 2.0):
            round_ = tuple((*tilt, ("nest-direction", f, order), *distance) for f in ("cos", "sin"))
            yield Hypothesis(f"unknown:{observable}:nest", _term(observable, *round_), False)


def _pair_terms(sightings: Sightings) -> Iterator[Hypothesis]:
    """What depends on two covariates together, smoothly: products of low orders in each; everywhere or at a station."""
    names, stations = _covariates(sightings), sightings.station_names
    places: list[tuple[str, ...]] = [(), *((s,) for s in stations if 1 < len(stations) <= MOST_STATIONS)]
    for observable, (one, other), place in product(OBSERVABLES, combinations(names, 2), places):
        if {one, other} == {"time", "station-time"}:
            continue
        for count in (1, 2):
            first, second = ((), *_low(one, count)), ((), *_low(other, count))
            columns = tuple(a + b for a, b in product(first, second) if a + b)
            family = f"unknown:{observable}:pair" + (":station" if place else "")
            yield Hypothesis(family, _term(observable, *columns, stations=place), False)


def _low(name: str, count: int) -> tuple[Column, ...]:
    return smooth(name, 2 * count if name in CIRCULAR else count)


def _field_terms(sightings: Sightings) -> Iterator[Hypothesis]:
    """Fields over the room and over the directions of the instrument."""
    for degree, observable in product((2, 3), OBSERVABLES):
        yield Hypothesis(f"unknown:{observable}:place", _term(observable, *_field(degree)), False)
    if len(sightings.target_names) <= MOST_TARGETS:
        each: tuple[Column, ...] = tuple(((name, "target", 1.0),) for name in sightings.target_names)
        for observable in OBSERVABLES:
            yield Hypothesis(f"unknown:{observable}:targets", _term(observable, *each), False)
    directions = tuple(
        a + e for a in AZIMUTH[:6] for e in ((), (("elevation", "legendre", 1.0),), (("elevation", "legendre", 2.0),))
    )
    for observable in OBSERVABLES:
        yield Hypothesis(f"unknown:{observable}:direction", _term(observable, *directions), False)


def _neighbours(sightings: Sightings) -> list[tuple[str, ...]]:
    """Groups of targets that stand together."""
    points, names = sightings.points, sightings.target_names
    groups = set()
    for point in points:
        near = np.argsort(np.linalg.norm(points - point, axis=1), kind="stable")
        for count in NEIGHBOURS:
            if 2 * count < len(names):
                groups.add(tuple(sorted(near[: count + 1].tolist())))
    return [tuple(names[t] for t in group) for group in sorted(groups)]


def _neighbour_terms(sightings: Sightings) -> Iterator[Hypothesis]:
    """What befalls targets that stand together: readings that are off there, or a floor that moves."""
    if len(sightings.target_names) > MOST_TARGETS:
        return
    simple: tuple[tuple[Column, ...], ...] = ((()),), smooth("distance", 1), smooth("elevation", 1), smooth("time", 1)
    moves = [name for name in ("time", *further(sightings)) if np.ptp(sightings.quantities[name]) > 0]
    steps = np.quantile(sightings.time, np.linspace(0.0, 1.0, MOVE_TIMES + 2)[1:-1])
    sudden = [((("time", "step", float(edge)),),) for edge in np.unique(steps)] if "time" in moves else []
    for group in _neighbours(sightings):
        for observable, columns in product(OBSERVABLES, simple):
            yield Hypothesis(f"unknown:{observable}:neighbours", _term(observable, *columns, targets=group), False)
        for axis, name in product(AXES, moves):
            term = _term(PLACE, *_moved(smooth(name, 2), (axis,)), targets=group)
            yield Hypothesis("unknown:place:neighbours", term, False)
        for change in (*(smooth(name, 1) for name in moves), *sudden):
            term = _term(PLACE, *_moved(change, AXES), targets=group)
            yield Hypothesis("unknown:place:neighbours", term, False)
