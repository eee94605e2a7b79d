"""Flexible terms: what is fitted where the catalogue fails.

A term acts on one observable (or moves the targets along one axis of the room) and is a sum of columns, each a
product of simple functions of covariates. Terms are effects like any other, so they are tested, refitted and simulated
in the same way; they are only never given a name of the catalogue.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from ltsim.arrays import Floats
from ltsim.diagnose.bank import Hypothesis
from ltsim.effects.effect import Effect, Parameter, Stage, by_displacement, on_readings
from ltsim.errors import unknown_name
from ltsim.geometry.polar import wrap
from ltsim.recording.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings
from ltsim.units import ARCSECOND, MICROMETRE

Factor = tuple[str, str, float]
"""Covariate, function, argument: ("azimuth", "cos", 2) is cos(2 azimuth)."""
Column = tuple[Factor, ...]

AXES = ("x", "y", "z")
CYCLES = 0.6
"""Step of the rates tried for a wave, in cycles over the covariate's span: no rate lies far from one that is tried."""
EDGES = 24
"""Values of a covariate at which a step is tried."""
MOST_CYCLES = 60
MOST_STATIONS, MOST_TARGETS = 12, 60
"""Places up to whose number each has smooth terms of its own."""
LOCAL_WIDTHS = {"narrow": 0.04, "wide": 0.1}
"""Widths of a local bump, as a share of the covariate's span."""
AIR_COLUMNS = ("air_temperature_c", "air_pressure_hpa", "relative_humidity_pct")


def covariate(sightings: Sightings, name: str) -> Floats:
    """Values (n,) of a covariate [SI, or the unit of the recording's own column]; unknown ones are zero."""
    place = sightings.points[sightings.target]
    geometry = {
        "azimuth": sightings.azimuth,
        "elevation": sightings.elevation,
        "distance": sightings.range_,
        "time": sightings.time,
        "station-time": sightings.station_time,
        "incidence": sightings.incidence,
        "height": sightings.local[:, 2],
        "x": place[:, 0],
        "y": place[:, 1],
        "z": place[:, 2],
        "face": sightings.face_sign,
    }
    return np.nan_to_num(geometry[name] if name in geometry else sightings.covariates[name])


def _centred(values: Floats) -> Floats:
    low, high = float(values.min()), float(values.max())
    half = 0.5 * (high - low)
    return (values - 0.5 * (low + high)) / half if half > 0 else np.zeros_like(values)


def evaluate(sightings: Sightings, factor: Factor) -> Floats:
    """Values (n,) of one factor."""
    name, function, k = factor
    x = covariate(sightings, name)
    match function:
        case "legendre":
            return np.asarray(np.polynomial.legendre.legval(_centred(x), [0.0] * int(k) + [1.0]), dtype=np.float64)
        case "power":
            return x**k
        case "cos":
            return np.cos(k * x)
        case "sin":
            return np.sin(k * x)
        case "tan":
            return np.tan(k * x)
        case "narrow" | "wide":
            gap = wrap(x - k) if name == "azimuth" else x - k
            return np.exp(-0.5 * (gap / (LOCAL_WIDTHS[function] * float(np.ptp(x)))) ** 2)
        case "step":
            return (x > k).astype(np.float64)
    raise unknown_name("function", function, ("legendre", "power", "cos", "sin", "tan", "step", *LOCAL_WIDTHS))


@dataclass(frozen=True)
class FlexibleTerm(Effect):
    """A sum of columns on one observable, or a displacement of the targets along one axis.

    Attributes
    ----------
    observable : str
        distance, azimuth (across the beam, as a length over distance), elevation, or x, y, z for a displacement.
    columns : tuple of Column
    across : bool
        The azimuth's error is one across the beam: divided by cos(elevation).
    """

    observable: str = "distance"
    columns: tuple[Column, ...] = ()

    name = "unknown"
    number = 0
    stage = Stage.ELECTRONICS

    @property
    def parameters(self) -> tuple[Parameter, ...]:  # type: ignore[override]
        """One coefficient a column."""
        angular = self.observable in ("azimuth", "elevation")
        unit, size = ("urad", 3 * ARCSECOND) if angular else ("um", 20 * MICROMETRE)
        return tuple(Parameter(describe(c), unit, "coefficient", size) for c in self.columns)

    @property
    def observables(self) -> tuple[str, ...]:  # type: ignore[override]
        """What the term acts on."""
        return OBSERVABLES if self.observable in AXES else (self.observable,)

    @property
    def covariates(self) -> tuple[str, ...]:  # type: ignore[override]
        """What the term depends on, in the words of the interface."""
        names = dict.fromkeys(f[0] for column in self.columns for f in column)
        words = ["place" if n in AXES else ("time" if n == "station-time" else n) for n in names]
        return tuple(dict.fromkeys(words))

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, p) of the raw readings per unit of each coefficient."""
        acts = self.mask(sightings)
        made = []
        for column in self.columns:
            values = acts.copy()
            for factor in column:
                values = values * evaluate(sightings, factor)
            if self.observable in AXES:
                moved = np.zeros((len(sightings), 3, 1))
                moved[:, AXES.index(self.observable), 0] = values
                made.append(by_displacement(sightings, moved)[:, :, 0])
            else:
                made.append(on_readings(sightings, **{self.observable: values}))
        return np.stack(made, axis=2)

    def finer(self, sightings: Sightings) -> list[FlexibleTerm]:
        """For waves: rates between the neighbours of the grid; for a step: the gaps around its edge."""
        name, function, k = self.columns[0][0] if self.columns and self.columns[0] else ("", "", 0.0)
        if function == "cos" and all(f[:1] == (name,) and f[2] == k for (f, *_) in self.columns):
            step = 2 * np.pi * CYCLES / float(np.ptp(covariate(sightings, name)))
            return [self._retuned(float(r)) for r in k + step * np.linspace(-0.9, 0.9, 13) if r > 0]
        if function == "step":
            values = np.unique(covariate(sightings, name))
            middles = 0.5 * (values[1:] + values[:-1])
            near = np.argsort(np.abs(middles - k))[: 2 * max(len(middles) // EDGES, 4)]
            return [self._retuned(float(edge)) for edge in middles[near]]
        return []

    def _retuned(self, k: float) -> FlexibleTerm:
        """The same with another argument of the first factor of every column."""
        return self.reshaped(columns=tuple(((name, function, k), *rest) for (name, function, _), *rest in self.columns))

    @property
    def formula(self) -> str:
        """The term as a formula with its coefficients left open."""
        return self.written([chr(ord("a") + i) for i in range(len(self.columns))])

    def written(self, coefficients: Sequence[str]) -> str:
        """The term as a formula with these coefficients."""
        pairs = zip(coefficients, self.columns, strict=True)
        terms = " + ".join(f"{coefficient} {describe(column)}".removesuffix(" 1") for coefficient, column in pairs)
        place = f" at {', '.join(self.stations + self.targets)}" if self.stations + self.targets else ""
        return f"{self.observable} correction = {terms}{place}"


def describe(column: Column) -> str:
    """A column in words: ``cos(2 azimuth) tan(elevation)``."""
    words = []
    for name, function, k in column:
        if function == "legendre":
            words.append(f"P{int(k)}({name})")
        elif function == "power":
            words.append({1.0: name, -1.0: f"1/{name}"}.get(k, f"{name}^{k:g}"))
        elif function in LOCAL_WIDTHS:
            words.append(f"bump({name} near {k:.3g})")
        elif function == "step":
            words.append(f"step({name} above {k:.3g})")
        else:
            scale = "" if k == 1 else f"{k:.4g} "
            words.append(f"{function}({scale}{name})")
    return " ".join(words) or "1"


def smooth(name: str, count: int) -> tuple[Column, ...]:
    """Columns of a smooth function of one covariate: Fourier in the azimuth, Legendre elsewhere; no constant."""
    if name == "azimuth":
        waves = range(1, count // 2 + 1)
        return tuple(((name, f, float(k)),) for k in waves for f in ("cos", "sin"))
    return tuple(((name, "legendre", float(k)),) for k in range(1, count + 1))


def _further(sightings: Sightings) -> list[str]:
    """Covariates of the network at hand: geometry, clock, and every further column that varies."""
    names = ["azimuth", "elevation", "distance", "time", "station-time", "height"]
    if np.isfinite(sightings.incidence).any():
        names.append("incidence")
    names += [c for c, v in sightings.covariates.items() if np.nanstd(v) > 0]
    return names


def _smooth_terms(sightings: Sightings) -> Iterator[Hypothesis]:
    for observable, name in product(OBSERVABLES, _further(sightings)):
        for count in (2, 5, 8):
            columns = smooth(name, count)
            yield Hypothesis(f"unknown:{observable}:{name}", FlexibleTerm((), (), observable, columns), False)
            if (sightings.face == 2).any():
                odd = tuple((("face", "power", 1.0), *c) for c in columns)
                yield Hypothesis(f"unknown:{observable}:{name}:face", FlexibleTerm((), (), observable, odd), False)
        if len(sightings.station_names) <= MOST_STATIONS:
            for station in sightings.station_names:
                term = FlexibleTerm((station,), (), observable, smooth(name, 4))
                yield Hypothesis(f"unknown:{observable}:{name}:station", term, False)
        if len(sightings.target_names) <= MOST_TARGETS:
            for target in sightings.target_names:
                term = FlexibleTerm((), (target,), observable, smooth(name, 2))
                yield Hypothesis(f"unknown:{observable}:{name}:target", term, False)


def wave(name: str, rate: float) -> tuple[Column, ...]:
    """Cosine and sine of a covariate at one rate [1 / its unit]."""
    return ((name, "cos", rate),), ((name, "sin", rate),)


def _periodic_terms(sightings: Sightings) -> Iterator[Hypothesis]:
    for observable, name in product(OBSERVABLES, ("time", "distance", "azimuth", "elevation", "x", "y", "z")):
        span = float(np.ptp(covariate(sightings, name)))
        if span <= 0:
            continue
        for cycles in np.arange(1.0, min(len(sightings) / 8, MOST_CYCLES), CYCLES):
            term = FlexibleTerm((), (), observable, wave(name, float(2 * np.pi * cycles / span)))
            yield Hypothesis(f"unknown:{observable}:{name}:periodic", term, False)


def _local_terms(sightings: Sightings) -> Iterator[Hypothesis]:
    """A bump in one direction, at one distance, for a while."""
    for observable, name in product(OBSERVABLES, ("azimuth", "elevation", "distance", "time")):
        values = covariate(sightings, name)
        for function, width in LOCAL_WIDTHS.items():
            for centre in np.linspace(values.min(), values.max(), round(1.5 / width)):
                column = ((name, function, float(centre)),)
                term = FlexibleTerm((), (), observable, (column,))
                yield Hypothesis(f"unknown:{observable}:{name}:local", term, False)


def _steps(sightings: Sightings) -> Iterator[Hypothesis]:
    """A reading that jumps where a covariate passes a value; of the circle, an arc between two."""
    for observable in OBSERVABLES:
        for name in ("elevation", "distance", "time", "height"):
            values = covariate(sightings, name)
            for edge in np.unique(np.quantile(values, np.linspace(0.0, 1.0, EDGES + 2)[1:-1])):
                term = FlexibleTerm((), (), observable, (((name, "step", float(edge)),),))
                yield Hypothesis(f"unknown:{observable}:{name}:step", term, False)


def _own_constants(sightings: Sightings) -> Iterator[Hypothesis]:
    """Constants of the instrument that are others at one station: index and tilt of the transit axis."""
    if len(sightings.station_names) < 2:
        return
    sign: tuple[Factor, ...] = (("face", "power", 1.0),) if (sightings.face == 2).any() else ()
    for station in sightings.station_names:
        for observable, column in (("elevation", ()), ("azimuth", (("elevation", "tan", 1.0),))):
            term = FlexibleTerm((station,), (), observable, ((*column, *sign),))
            yield Hypothesis(f"unknown:{observable}:own constant", term, False)


def _moving_terms(sightings: Sightings) -> Iterator[Hypothesis]:
    """Targets that move in time along an axis of the room, together or more the farther along the room they lie."""
    where: tuple[Column, ...] = ((), *((((axis, "legendre", 1.0),)) for axis in AXES))
    span = float(np.ptp(sightings.time))
    if span <= 0:
        return
    for axis in AXES:
        for count in (1, 3):
            columns = tuple((("time", "legendre", float(k)), *w) for k in range(1, count + 1) for w in where)
            yield Hypothesis("unknown:place:time", FlexibleTerm((), (), axis, columns), False)
        for cycles in np.arange(1.0, min(len(sightings) / 8, MOST_CYCLES), CYCLES):
            waves = wave("time", float(2 * np.pi * cycles / span))
            columns = tuple((*factor, *w) for factor in waves for w in where)
            yield Hypothesis("unknown:place:time:periodic", FlexibleTerm((), (), axis, columns), False)


AZIMUTH: tuple[Column, ...] = (*(((("azimuth", f, float(k)),)) for k in (1, 2, 3, 4) for f in ("cos", "sin")),)
ELEVATION: tuple[Column, ...] = (
    (),
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
CLOCK: tuple[Column, ...] = (
    (),
    (("time", "power", 1.0),),
    (("station-time", "power", 1.0),),
)


def _product_terms(sightings: Sightings) -> Iterator[Hypothesis]:
    """Products of simple functions: a cosine and a sine of the azimuth always go together."""
    both = (sightings.face == 2).any()
    for observable, e, d, t in product(OBSERVABLES, ELEVATION, DISTANCE, CLOCK):
        rest = e + d + t
        for sign in ((), (("face", "power", 1.0),)) if both else ((),):
            if rest + sign:
                term = FlexibleTerm((), (), observable, (rest + sign,))
                yield Hypothesis(f"unknown:{observable}:product", term, False)
            for k in range(0, 8, 2):
                pair = (AZIMUTH[k] + rest + sign, AZIMUTH[k + 1] + rest + sign)
                yield Hypothesis(f"unknown:{observable}:product", FlexibleTerm((), (), observable, pair), False)


def _field_terms(sightings: Sightings) -> Iterator[Hypothesis]:
    """Fields over the room and over the directions of the instrument."""
    powers = [p for p in product(range(4), repeat=3) if 0 < sum(p) <= 3]
    for degree in (2, 3):
        place = tuple(
            tuple((axis, "legendre", float(k)) for axis, k in zip(AXES, p, strict=True) if k)
            for p in powers
            if sum(p) <= degree
        )
        for observable in OBSERVABLES:
            yield Hypothesis(f"unknown:{observable}:place", FlexibleTerm((), (), observable, place), False)
    directions = tuple(
        a + e for a in AZIMUTH[:6] for e in ((), (("elevation", "legendre", 1.0),), (("elevation", "legendre", 2.0),))
    )
    for observable in OBSERVABLES:
        yield Hypothesis(f"unknown:{observable}:direction", FlexibleTerm((), (), observable, directions), False)


def flexible_hypotheses(sightings: Sightings) -> list[Hypothesis]:
    """All flexible terms tried on a network."""
    return [
        *_smooth_terms(sightings),
        *_periodic_terms(sightings),
        *_local_terms(sightings),
        *_steps(sightings),
        *_own_constants(sightings),
        *_moving_terms(sightings),
        *_product_terms(sightings),
        *_field_terms(sightings),
    ]
