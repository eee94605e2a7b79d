"""Drivers, generated: base quantities, closed under a few operators on the order of the work.

Base quantities are what a pointing itself says, the clock, and the recording's further columns. An operator takes the
value before, the change since, the sum of changes or of their sizes; what lags behind; another amount for each station
or each target that was measured before. Each operator costs a constant of prior odds
(`OPERATOR_ODDS`), and so does a product.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.physics.laws.columns import LOW, MODES
from ltsim.physics.laws.regressors import (
    CLOCKS,
    CONSTANT,
    LEVER,
    Regressor,
    across_the_room,
    amounts,
    base_of,
    latch,
    memory,
    near,
    passage,
    pieces,
    simple,
    smooth,
    switch,
)
from ltsim.physics.laws.states import FADES, INPUTS, latches_of, states_of
from ltsim.scene.regions import Region, is_distinctive, regions_of
from ltsim.scene.sightings import Sightings

POINTED = ("azimuth", "elevation", "distance")
BASE = (*POINTED, "time", "station-time", "height", "bearing", "x", "y")
_CIRCLES = ("circle", "vertical-circle")
_NEST = ("incidence", "nest-direction")
_SIGNS = ("face", "approach-azimuth", "approach-elevation", "parity", "seating-parity", "repeat")
WORK = ("work-azimuth", "work-elevation")
"""Ways that the axes have turned since the set-up began."""
OPERATORS = ("last", "move", "work")
"""The value before, the change since then, the sum of the changes' sizes."""
PRECEDING = ("wound-azimuth", "lapse", "count", *(f"{how}-{name}" for how in OPERATORS for name in POINTED))
FOLLOWED = tuple(dict.fromkeys((*BASE, "z", *_CIRCLES, *_NEST, *_SIGNS, *PRECEDING)))
"""Covariates of readings, in addition to columns of the recording."""
_HEAD = ("azimuth", "elevation", *_CIRCLES, *_SIGNS, *(n for n in PRECEDING if not n.endswith("distance")))
DRIVES: dict[str, tuple[str, ...]] = {
    "instrument": (*CLOCKS, *_HEAD, "distance", "height", "move-distance", "last-distance", "work-distance"),
    "circle": (*CLOCKS, "lapse", *_SIGNS[3:]),
    "stand": (
        *CLOCKS,
        "azimuth",
        "elevation",
        "distance",
        "wound-azimuth",
        "work-azimuth",
        "work-elevation",
        "lapse",
        "count",
        "last-target",
    ),
    "target": ("time", "station", "distance", "height", *_SIGNS[3:], *_NEST),
    "reflector": ("time", "lapse", "last-target", *_SIGNS[3:], *_NEST),
    "air": CLOCKS,
}
"""Covariates that each kind of carrier can depend on, in addition to columns of the recording: a wall does not depend
on the pointing of a tracker; its stand does, for a head is never quite in balance, and the floor gives under whoever
holds the reflector."""
LEAST_NEAR = 2.5
"""Smallest effective number of targets near a place."""
PLACES_NEAR = ("xyz", "xy")
"""Shapes of the regions near which a target may be."""
STANDING = ("xy", "x", "y")
"""Shapes of the regions in which something may stand for a time."""
STAYS, LEAST_TIMES = (2, 4), 12
"""Numbers of equal parts of the work, of which something may stand for one; smallest number of times of readings."""
DECAYS = np.array([0.03, 0.1, 0.3, 1.0])
"""Time constants of decays over a clock's span: what lies between two of them is within a factor of two of one."""
HALF_LOOPS = np.array([0.05, 0.15, 0.3])
"""Half-widths of hystereses over a covariate's span."""
SHORT_MOVES = (0.15, 0.3, 0.5)
"""Limits of dead bands, as quantiles of the moves' sizes."""
MEMORIES = (60.0, 300.0, 1000.0, 3000.0)
"""[s] Lags that are tried: of detectors, of parts of an instrument, of stands, of walls and floors."""
FEW_VISITS, MOST_VISITS, MOST_AMOUNTS = 3, 12, 60
"""Set-ups beyond and up to whose number each may have a value of its own (of few, one or two stand out); targets up to
whose number."""
MOST_CHANGES = 12
"""Times of a step that groups are tried with; the best is moved."""
WAVE_STEP = 0.6
"""Step of the rates tried for a wave, in cycles over the covariate's span: no rate lies far from one that is tried."""
MOST_CYCLES, LEAST_OF_A_CYCLE = 60, 8
"""Cycles over a covariate's span that a wave may have, and pointings that each must have."""
ROUNDING = 1e-12
"""[rad, m, s] Spread of what a pointing says that is none: elevations in a plan differ by 1e-31."""
OPERATOR_ODDS = 1.0 / 3.0
"""Prior odds that an operator, or a second factor, costs: odds of one in three that there is one."""
DEPTHS = {
    "constant": 0,
    "sign": 0,
    "curve": 0,
    "clock": 0,
    "step": 0,
    "decay": 0,
    "wave": 0,
    "memory": 1,
    "lag": 1,
    "amounts": 1,
    "shape": 1,
    "passage": 1,
    "lever": 1,
    "passage for a time": 2,
    "lever for a time": 2,
    "near": 1,
    "latch": 1,
    "state": 2,
    "room": 1,
    "product": 2,
}
"""Operators, and factors beyond one, of each kind of drivers."""


def further(sightings: Sightings) -> list[str]:
    """Columns of the recording beyond the format's that vary."""
    return [name for name, values in sightings.covariates.items() if np.nanstd(values) > 0]


def _varying(sightings: Sightings, names: Iterable[str]) -> list[str]:
    """Names of the quantities that vary in these sightings."""
    has_nests, faces = np.isfinite(sightings.incidence).any(), np.ptp(sightings.face) > 0
    asked = [n for n in names if (has_nests or n not in _NEST) and (faces or n not in _CIRCLES)]
    floor = {n: ROUNDING * (base_of(n) not in sightings.covariates) for n in asked}
    return [n for n in asked if np.ptp(sightings.quantities[n]) > floor[n]]


def is_admissible(kind: str, driver: Regressor, sightings: Sightings) -> bool:
    """True if a driver can move a kind of carrier; a reading may err with anything."""
    names = [*driver.covariates, *(n for f in driver.factors if f.kind != "field" for n in f.covariates)]
    return kind == "reading" or all(n in DRIVES[kind] or base_of(n) in sightings.covariates for n in names)


def regressors_of(sightings: Sightings, modes: int = MODES) -> dict[str, list[Regressor]]:
    """Every driver that is tried, by kind; curves with so many `modes`."""
    s, columns = sightings, further(sightings)
    base = _varying(s, (*BASE, *columns, *_CIRCLES, *_NEST))
    before = _varying(s, (*PRECEDING, *(f"{how}-{name}" for how in OPERATORS for name in columns)))
    turning = [n for n in base if n not in CLOCKS]  # a clock never turns back
    signs = [n for n in _varying(s, _SIGNS) if n != "seating-parity" or _signs_differ(s)]
    return {
        "constant": [CONSTANT],
        "sign": [simple(name, "power") for name in signs],
        "curve": [smooth(name, modes) for name in base],
        "clock": local_drivers(s),
        "decay": [simple(n, "decay", float(t)) for n in CLOCKS if n in base for t in np.ptp(s.quantities[n]) * DECAYS],
        "memory": [
            *(smooth(name, modes) for name in before),
            *(simple(name, "abs") for name in before if name.startswith("move-")),
        ],
        "lag": lags(s, (*columns, "elevation", "distance", "move-azimuth", "move-elevation")),
        "amounts": [*_each_visit(s, FEW_VISITS + 1), *_each_before(s)],
        "wave": list(waves(s)),
        "room": [*across_the_room(_slow_waves(s), 1), *across_the_room(local_drivers(s), 2)],
        "shape": [
            *(simple(n, "hysteresis", float(k)) for n in turning for k in np.ptp(s.quantities[n]) * HALF_LOOPS),
            *dead_bands(s),
        ],
        "passage": [passage(region) for region in regions_of(s)],
        "lever": [passage(region, LEVER) for region in regions_of(s)],
        "passage for a time": list(for_a_time(s)),
        "lever for a time": list(for_a_time(s, LEVER)),
        "near": [near(region) for region in regions_of(s, PLACES_NEAR) if is_near_several(region, s)],
        "state": [memory(*made) for made in states_of(s, _varying(s, INPUTS))],
        "latch": [latch(*made) for made in latches_of(s, _varying(s, (*POINTED, *columns)))],
        "product": list(products(s)),
    }


def dead_bands(sightings: Sightings) -> list[Regressor]:
    """Drivers that act at short moves of an axis alone: what a drive or a contact does not follow."""
    return [
        simple(name, how, float(k))
        for name in _varying(sightings, ("move-azimuth", "move-elevation"))
        for k in np.unique(np.quantile(np.abs(sightings.quantities[name]), SHORT_MOVES))
        for how in ("within", "stuck")
        if k > ROUNDING
    ]


def is_near_several(region: Region, sightings: Sightings) -> bool:
    """True if several targets are in a region: one alone is an error of that target."""
    return region.targets_within(sightings) > LEAST_NEAR


def for_a_time(sightings: Sightings, function: str = "") -> Iterator[Regressor]:
    """Drivers of regions of the hall that something stands in for a time."""
    time, regions = np.unique(sightings.time), regions_of(sightings, STANDING)
    if len(time) < LEAST_TIMES or not regions:
        return
    passing = np.stack([region.path(sightings) > region.width for region in regions])
    for parts in STAYS:
        at = np.linspace(0, len(time) - 1, parts + 1).round().astype(int)
        ends = [*(0.5 * (time[at[1:-1]] + time[at[1:-1] - 1])).tolist(), np.inf]
        for begin, end in zip([-np.inf, *ends[:-1]], ends, strict=True):
            gate = switch([simple("time", "step", edge) for edge in (begin, end) if edge < np.inf])
            during = (sightings.time > begin) & (sightings.time <= end)
            for i in np.flatnonzero(is_distinctive(passing & during, sightings)):
                yield Regressor("product", factors=(passage(regions[i], function), gate))


def local_drivers(sightings: Sightings) -> list[Regressor]:
    """Drivers of changes of targets: functions of time, or of the recording's further columns."""
    names = _varying(sightings, ("time", *further(sightings)))
    straight = [simple(name, "power") for name in names]
    return [*straight, *(smooth(name, LOW) for name in names), *lags(sightings, further(sightings))]


def group_drivers(sightings: Sightings) -> dict[str, list[Regressor]]:
    """Drivers of changes of a group of targets: joint motion, sudden or gradual, another one at each set-up, a tilt."""
    local, each, steps = local_drivers(sightings), _each_visit(sightings, 2), _steps(sightings)
    return {
        "constant": [CONSTANT],
        "clock": local,
        "step": steps,
        "amounts": each,
        "wave": _slow_waves(sightings),
        "room": across_the_room([*local, *each, *steps], 1),
    }


def _steps(sightings: Sightings) -> list[Regressor]:
    """Steps in time, at pauses spread evenly over the work."""
    clock = np.unique(sightings.time)
    if len(clock) < MOST_CHANGES:
        return []
    at = np.linspace(0, len(clock) - 1, MOST_CHANGES + 2).round().astype(int)[1:-1]
    return [pieces([simple("time", "step", float(0.5 * (clock[i] + clock[i + 1])))]) for i in at]


def _signs_differ(sightings: Sightings) -> bool:
    """True if seatings and pointings alternate differently."""
    parity, seating = (sightings.quantities[name] for name in ("parity", "seating-parity"))
    return abs(float(parity @ seating)) < len(parity)


def _each_visit(sightings: Sightings, least: int) -> list[Regressor]:
    count = len(np.unique(sightings.station))
    return [amounts("station", count)] if least <= count <= MOST_VISITS else []


def _each_before(sightings: Sightings) -> list[Regressor]:
    count = len(sightings.target_names)
    return [amounts("last-target", count)] if 1 < count <= MOST_AMOUNTS else []


def lags(sightings: Sightings, names: Iterable[str]) -> list[Regressor]:
    """Drivers that follow quantities with a lag."""
    varying = _varying(sightings, names)
    return [
        Regressor("lagging", (name,), constant=t) for t in MEMORIES if np.ptp(sightings.time) > t for name in varying
    ]


def products(sightings: Sightings) -> Iterator[Regressor]:
    """Products of two drivers: a sign or a move with a curve, two curves, another curve for each instrument."""
    names = _varying(sightings, (*BASE[:7], *further(sightings), *_CIRCLES, *_NEST))
    trackers = len(np.unique(sightings.instrument))
    if 1 < trackers <= MOST_VISITS:
        by_instrument = amounts("instrument", trackers)
        yield from (Regressor("product", factors=(smooth(name, LOW), by_instrument)) for name in names)
    for sign in _varying(sightings, _SIGNS[:3]):
        yield from (Regressor("product", factors=(simple(sign, "power"), smooth(name, LOW))) for name in names)
    weights = [simple("distance", "power"), simple("elevation", "power")]
    for name in _varying(sightings, WORK):  # heat that the drives leave
        fading = [memory(name, how, k) for name, how, k in states_of(sightings, (name,)) if how == FADES]
        yield from (Regressor("product", factors=(heat, weight)) for heat in fading for weight in weights)
    weights += [smooth("lapse", LOW)] if np.ptp(sightings.quantities["lapse"]) > 0 else []  # a move is forgotten
    for move in _varying(sightings, [f"move-{name}" for name in POINTED]):
        lengths = (simple(move, how) for how in ("abs", "power"))
        yield from (Regressor("product", factors=(length, weight)) for length in lengths for weight in weights)
    for first, second in combinations(names, 2):
        if {first, second} not in ({"time", "station-time"}, {"azimuth", "bearing"}) and second not in _CIRCLES:
            yield Regressor("product", factors=(smooth(first, LOW), smooth(second, LOW)))


def rates(sightings: Sightings, name: str, most: float) -> Floats:
    """Rates of waves in a quantity with up to `most` cycles over its span."""
    span = float(np.ptp(sightings.quantities[name]))
    return 2 * np.pi * np.arange(1.0, most, WAVE_STEP) / span if span > ROUNDING else np.zeros(0)


def waves(
    sightings: Sightings,
    names: Sequence[str] = ("time", *POINTED, "x", "y", "z", "station-time", *WORK),
    among: int = 1,
) -> Iterator[Regressor]:
    """Waves in some quantities, of which each of so many parts has its share of pointings."""
    most = min(len(sightings) / LEAST_OF_A_CYCLE, MOST_CYCLES) / among
    for name in names:
        for rate in rates(sightings, name, most):
            yield Regressor("wave", (name,), constant=float(rate))


SLOW = 18
"""Rates of waves, the slowest ones, that targets are tried with."""


def _slow_waves(sightings: Sightings) -> list[Regressor]:
    return list(waves(sightings, ("time",)))[:SLOW]
