"""Library of regressors: base quantities, and a few operators on the order of measurement that are applied to them.

Base quantities are those of a pointing, the clock, and the additional columns of the recording. The operators are:
previous value, change since then, sum of changes or of their magnitudes, first-order lag, separate amount per station
or per previous target. Each operator, and each product, multiplies the prior odds by `OPERATOR_ODDS`.
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
ACCUMULATED_ROTATIONS = ("work-azimuth", "work-elevation")
"""Accumulated rotations of the axes since the set-up began."""
OPERATORS = ("last", "move", "work")
"""Operators: previous value, change since then, accumulated magnitude of the changes."""
PRECEDING = ("wound-azimuth", "lapse", "count", *(f"{how}-{name}" for how in OPERATORS for name in POINTED))
READING_COVARIATES = tuple(dict.fromkeys((*BASE, "z", *_CIRCLES, *_NEST, *_SIGNS, *PRECEDING)))
"""Covariates of readings, in addition to columns of the recording."""
_HEAD = ("azimuth", "elevation", *_CIRCLES, *_SIGNS, *(n for n in PRECEDING if not n.endswith("distance")))
COVARIATES_BY_KIND: dict[str, tuple[str, ...]] = {
    "instrument": (*CLOCKS, *_HEAD, "distance", "height", "move-distance", "last-distance", "work-distance"),
    "circle": (*CLOCKS, "lapse", *_SIGNS[3:]),
    "stand": (
        *CLOCKS,
        "azimuth",
        "elevation",
        *_CIRCLES,
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
"""Covariates that each kind of response can depend on, in addition to columns of the recording. A wall does not depend
on the pointing of a tracker, but its stand does, because a head is not balanced exactly and the floor yields under the
operator.
"""
MIN_TARGETS_NEAR = 2.5
"""Smallest effective number of targets near a position."""
PLACES_NEAR = ("xyz", "xy")
"""Shapes of the regions for nearness of targets."""
TEMPORARY_SHAPES = ("xy", "x", "y", "z")
"""Shapes of the regions that may act for a part of the work."""
PARTS, MIN_TIMES = (2, 4), 12
"""Numbers of equal parts of the work, in one of which a region may act; smallest number of distinct times."""
DECAY_FRACTIONS = np.array([0.03, 0.1, 0.3, 1.0])
"""Time constants of decays, as fractions of a clock's span; every time constant in between is within a factor of two of
one.
"""
HALF_LOOPS = np.array([0.05, 0.15, 0.3])
"""Half-widths of hysteresis loops, as fractions of a covariate's span."""
SHORT_MOVES = (0.15, 0.3, 0.5)
"""Limits of dead bands, as quantiles of the sizes of the moves."""
LAG_TIMES = (60.0, 300.0, 1000.0, 3000.0)
"""Time constants [s] of lags that are tried: of detectors, instrument parts, stands, walls and floors."""
FEW_VISITS, MAX_VISITS, MAX_AMOUNTS = 3, 12, 60
"""Smallest and largest number of set-ups with separate values (for fewer, single set-ups are tried), and largest number
of targets.
"""
MAX_CHANGES = 12
"""Largest number of times at which a step of a group is tried; the best one is refined."""
WAVE_STEP = 0.6
"""Step between the rates tried for a wave, in cycles over the covariate's span, so that every rate
is near a tried one.
"""
MAX_CYCLES, MIN_POINTINGS_PER_CYCLE = 60, 8
"""Largest number of cycles of a wave over a covariate's span, and smallest number of pointings per cycle."""
ROUNDING = 1e-12
"""Spread [rad, m, s] of a quantity below which it counts as constant: elevations in a plane differ by 1e-31."""
OPERATOR_ODDS = 1.0 / 3.0
"""Factor on the prior odds for each operator or second factor: odds of one in three that it occurs."""
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
"""Number of operators, and of factors beyond one, of each kind of regressor."""


def additional_columns(sightings: Sightings) -> list[str]:
    """Additional columns of the recording that vary."""
    return [name for name, values in sightings.covariates.items() if np.nanstd(values) > 0]


def _varying(sightings: Sightings, names: Iterable[str]) -> list[str]:
    """Names of the quantities that vary in these sightings."""
    has_nests, faces = np.isfinite(sightings.incidence).any(), np.ptp(sightings.face) > 0
    asked = [n for n in names if (has_nests or n not in _NEST) and (faces or n not in _CIRCLES)]
    floor = {n: ROUNDING * (base_of(n) not in sightings.covariates) for n in asked}
    return [n for n in asked if np.ptp(sightings.quantities[n]) > floor[n]]


def is_admissible(kind: str, driver: Regressor, sightings: Sightings) -> bool:
    """True if a regressor can cause changes of a kind of response; readings may depend on every regressor."""
    names = [*driver.covariates, *(n for f in driver.factors if f.kind != "field" for n in f.covariates)]
    return kind == "reading" or all(n in COVARIATES_BY_KIND[kind] or base_of(n) in sightings.covariates for n in names)


def regressors_of(sightings: Sightings, modes: int = MODES) -> dict[str, list[Regressor]]:
    """All regressors that are tried, by kind; smooth ones with `modes` eigenfunctions."""
    s, columns = sightings, additional_columns(sightings)
    base = _varying(s, (*BASE, *columns, *_CIRCLES, *_NEST))
    before = _varying(s, (*PRECEDING, *(f"{how}-{name}" for how in OPERATORS for name in columns)))
    turning = [n for n in base if n not in CLOCKS]  # a clock never turns back
    signs = [n for n in _varying(s, _SIGNS) if n != "seating-parity" or _signs_differ(s)]
    return {
        "constant": [CONSTANT],
        "sign": [simple(name, "power") for name in signs],
        "curve": [smooth(name, modes) for name in base],
        "clock": local_regressors(s),
        "decay": [
            simple(n, "decay", float(t)) for n in CLOCKS if n in base for t in np.ptp(s.quantities[n]) * DECAY_FRACTIONS
        ],
        "memory": [
            *(smooth(name, modes) for name in before),
            *(simple(name, "abs") for name in before if name.startswith("move-")),
        ],
        "lag": lags(s, (*columns, "elevation", "distance", "move-azimuth", "move-elevation")),
        "amounts": [*visits(s, FEW_VISITS + 1), *_each_before(s)],
        "wave": list(waves(s)),
        "room": [*across_the_room(_slow_waves(s), 1), *across_the_room(local_regressors(s), 2)],
        "shape": [
            *(simple(n, "hysteresis", float(k)) for n in turning for k in np.ptp(s.quantities[n]) * HALF_LOOPS),
            *dead_bands(s),
        ],
        "passage": [passage(region) for region in regions_of(s)],
        "lever": [passage(region, LEVER) for region in regions_of(s)],
        "passage for a time": list(temporary_regions(s)),
        "lever for a time": list(temporary_regions(s, LEVER)),
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
    """True if several targets are in a region: with one alone the error belongs to that target."""
    return region.targets_within(sightings) > MIN_TARGETS_NEAR


def temporary_regions(sightings: Sightings, function: str = "") -> Iterator[Regressor]:
    """Regressors of regions of the hall that act in one part of the work."""
    time, regions = np.unique(sightings.time), regions_of(sightings, TEMPORARY_SHAPES)
    if len(time) < MIN_TIMES or not regions:
        return
    passing = np.stack([region.path(sightings) > region.width for region in regions])
    for parts in PARTS:
        at = np.linspace(0, len(time) - 1, parts + 1).round().astype(int)
        ends = [*(0.5 * (time[at[1:-1]] + time[at[1:-1] - 1])).tolist(), np.inf]
        for begin, end in zip([-np.inf, *ends[:-1]], ends, strict=True):
            gate = switch([simple("time", "step", edge) for edge in (begin, end) if edge < np.inf])
            during = (sightings.time > begin) & (sightings.time <= end)
            for i in np.flatnonzero(is_distinctive(passing & during, sightings)):
                yield Regressor("product", factors=(passage(regions[i], function), gate))


def local_regressors(sightings: Sightings) -> list[Regressor]:
    """Regressors of single targets: functions of time, or of additional columns of the recording."""
    names = _varying(sightings, ("time", *additional_columns(sightings)))
    straight = [simple(name, "power") for name in names]
    return [*straight, *(smooth(name, LOW) for name in names), *lags(sightings, additional_columns(sightings))]


def group_regressors(sightings: Sightings) -> dict[str, list[Regressor]]:
    """Regressors of a group of targets: joint motion, sudden or gradual, different at each set-up, or a tilt."""
    local, each, steps = local_regressors(sightings), visits(sightings, 2), _steps(sightings)
    return {
        "constant": [CONSTANT],
        "sign": [simple(name, "power") for name in _varying(sightings, _SIGNS[3:])],
        "curve": [smooth(name, LOW) for name in _varying(sightings, _NEST[:1])],
        "clock": local,
        "step": steps,
        "amounts": each,
        "wave": _slow_waves(sightings),
        "room": across_the_room([*local, *each, *steps], 1),
    }


def _steps(sightings: Sightings) -> list[Regressor]:
    """Steps in time, at pauses spread evenly over the measurement."""
    clock = np.unique(sightings.time)
    if len(clock) < MAX_CHANGES:
        return []
    at = np.linspace(0, len(clock) - 1, MAX_CHANGES + 2).round().astype(int)[1:-1]
    return [pieces([simple("time", "step", float(0.5 * (clock[i] + clock[i + 1])))]) for i in at]


def _signs_differ(sightings: Sightings) -> bool:
    """True if seatings and pointings alternate differently."""
    parity, seating = (sightings.quantities[name] for name in ("parity", "seating-parity"))
    return abs(float(parity @ seating)) < len(parity)


def visits(sightings: Sightings, least: int) -> list[Regressor]:
    """Regressor with a separate amount for each set-up; none for fewer than `least`, and for many."""
    count = len(np.unique(sightings.station))
    return [amounts("station", count)] if least <= count <= MAX_VISITS else []


def _each_before(sightings: Sightings) -> list[Regressor]:
    count = len(sightings.target_names)
    return [amounts("last-target", count)] if 1 < count <= MAX_AMOUNTS else []


def lags(sightings: Sightings, names: Iterable[str]) -> list[Regressor]:
    """Regressors that depend on quantities through a first-order lag."""
    varying = _varying(sightings, names)
    return [
        Regressor("lagging", (name,), constant=t) for t in LAG_TIMES if np.ptp(sightings.time) > t for name in varying
    ]


def products(sightings: Sightings) -> Iterator[Regressor]:
    """Products of two regressors: a sign or change with a curve, two curves, separate curves per instrument."""
    names = _varying(sightings, (*BASE[:7], *additional_columns(sightings), *_CIRCLES, *_NEST))
    trackers = len(np.unique(sightings.instrument))
    if 1 < trackers <= MAX_VISITS:
        by_instrument = amounts("instrument", trackers)
        yield from (Regressor("product", factors=(smooth(name, LOW), by_instrument)) for name in names)
    for sign in _varying(sightings, _SIGNS[:3]):
        yield from (Regressor("product", factors=(simple(sign, "power"), smooth(name, LOW))) for name in names)
    weights = [simple("distance", "power"), simple("elevation", "power")]
    for name in _varying(sightings, ACCUMULATED_ROTATIONS):  # heat that the drives leave
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
    names: Sequence[str] = ("time", *POINTED, "x", "y", "z", "station-time", *ACCUMULATED_ROTATIONS),
    among: int = 1,
) -> Iterator[Regressor]:
    """Waves in some quantities; each of the parts `among` gets an equal fraction of the pointings."""
    most = min(len(sightings) / MIN_POINTINGS_PER_CYCLE, MAX_CYCLES) / among
    for name in names:
        for rate in rates(sightings, name, most):
            yield Regressor("wave", (name,), constant=float(rate))


SLOW_RATES = 18
"""Number of rates of waves, the slowest ones, that are tried with targets."""


def _slow_waves(sightings: Sightings) -> list[Regressor]:
    return list(waves(sightings, ("time",)))[:SLOW_RATES]
