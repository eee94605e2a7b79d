"""Flexible terms: what is fitted where the catalogue fails.

A term acts on one observable (or moves the targets along one axis of the room) and is a sum of columns, each a
product of simple functions of covariates. A term has a signature as effects have, so it is tested and refitted in the
same way; it has no card and no name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.signature import Parameter, Tunable, by_displacement, on_readings
from ltsim.errors import unknown_name
from ltsim.geometry.polar import wrap
from ltsim.recording.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings
from ltsim.units import ARCSECOND, MICROMETRE

Factor = tuple[str, str, float]
"""Covariate, function, argument: ("azimuth", "cos", 2) is cos(2 azimuth)."""
Column = tuple[Factor, ...]

AXES = ("x", "y", "z")
CIRCULAR = ("azimuth", "nest-direction")
"""Covariates that come round again."""
NORMAL = "normal"
PLACE = "place"
CYCLES = 0.6
"""Step of the rates tried for a wave, in cycles over the covariate's span: no rate lies far from one that is tried."""
EDGES = 24
"""Values of a covariate at which a step or a bend is tried."""
LOCAL_WIDTHS = {"narrow": 0.04, "wide": 0.1}
"""Widths of a local bump, as a share of the covariate's span."""
MEMORY = ("approach-", "move-", "last-", "lapse")
"""What names of covariates begin with that tell of the pointing before."""
WORDS = {
    "horizontal": "distance",
    "x": "place",
    "y": "place",
    "z": "place",
    "station-time": "time",
    "nest-direction": "incidence",
    "air_temperature_c": "temperature",
}
"""Names of the interface for covariates that have others here."""


def further(sightings: Sightings) -> list[str]:
    """Columns of the recording beyond the format's that vary."""
    return [name for name, values in sightings.covariates.items() if np.nanstd(values) > 0]


def _centred(values: Floats) -> Floats:
    low, high = float(values.min()), float(values.max())
    half = 0.5 * (high - low)
    return (values - 0.5 * (low + high)) / half if half > 0 else np.zeros_like(values)


def _legendre(x: Floats, order: float) -> Floats:
    """Legendre polynomial over the range of a covariate."""
    return np.asarray(np.polynomial.legendre.legval(_centred(x), [0.0] * int(order) + [1.0]), dtype=np.float64)


FUNCTIONS: dict[str, Callable[[Floats, float], Floats]] = {
    "legendre": _legendre,
    "power": lambda x, k: x**k,
    "abs": lambda x, k: np.abs(x),
    "cos": lambda x, k: np.cos(k * x),
    "sin": lambda x, k: np.sin(k * x),
    "tan": lambda x, k: np.tan(k * x),
    "step": lambda x, k: (x > k).astype(np.float64),
    "bend": lambda x, k: np.maximum(x - k, 0.0),
    "saturated": lambda x, k: x / (k + np.abs(x)),
    "decay": lambda x, k: np.exp(-x / k),
}
"""Functions of a covariate and an argument; besides them bumps (`LOCAL_WIDTHS`) and "target", which is one there."""


def evaluate(sightings: Sightings, factor: Factor) -> Floats:
    """Values (n,) of one factor."""
    name, function, k = factor
    if function == "target":
        return (sightings.target == sightings.target_names.index(name)).astype(np.float64)
    x = sightings.quantities[name]
    if function in LOCAL_WIDTHS:
        gap = wrap(x - k) if name in CIRCULAR else x - k
        return np.exp(-0.5 * (gap / (LOCAL_WIDTHS[function] * float(np.ptp(x)))) ** 2)
    if function not in FUNCTIONS:
        raise unknown_name("function", function, FUNCTIONS)
    return FUNCTIONS[function](x, k)


def direction(sightings: Sightings, axis: str) -> Floats:
    """Unit vectors (n, 3) of an axis of the room or of the targets' nests; zero where a nest is unknown."""
    if axis == NORMAL:
        return np.nan_to_num(sightings.nest_normal[sightings.target])
    return np.tile(np.eye(3)[AXES.index(axis)], (len(sightings), 1))


FACTORS: tuple[Factor, ...] = (
    ("face", "power", 1.0),
    ("approach-azimuth", "power", 1.0),
    ("approach-elevation", "power", 1.0),
    ("lapse", "power", 1.0),
    ("elevation", "legendre", 1.0),
    ("elevation", "tan", 1.0),
    ("distance", "legendre", 1.0),
    ("distance", "power", -1.0),
    ("height", "legendre", 1.0),
    ("time", "legendre", 1.0),
    ("station-time", "legendre", 1.0),
    ("incidence", "legendre", 1.0),
    ("x", "legendre", 1.0),
    ("y", "legendre", 1.0),
)
"""What a term that stands out may be multiplied by."""
MOST_GROWN = 12
"""Columns up to which a term grows, and stations it may be confined to."""


@dataclass(frozen=True)
class FlexibleTerm(Tunable):
    """A sum of columns on one observable, or a displacement of the targets.

    Attributes
    ----------
    observable : str
        distance, azimuth, elevation, or place for a displacement.
    columns : tuple of Column
        Those of a displacement end with the factor (axis, "along", 1): an axis of the room, or the nest's normal.
    """

    stations: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    observable: str = "distance"
    columns: tuple[Column, ...] = ()

    name = "unknown"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """One coefficient a column."""
        angular = self.observable in ("azimuth", "elevation")
        unit, size = ("urad", 3 * ARCSECOND) if angular else ("um", 20 * MICROMETRE)
        return tuple(Parameter(describe(c), unit, "coefficient", size) for c in self.columns)

    @property
    def observables(self) -> tuple[str, ...]:
        """What the term acts on."""
        return OBSERVABLES if self.observable == PLACE else (self.observable,)

    @property
    def covariates(self) -> tuple[str, ...]:
        """What the term depends on, in the words of the interface."""
        factors = [factor for column in self.columns for factor in column if factor[1] != "along"]
        names = dict.fromkeys(PLACE if function == "target" else name for name, function, _ in factors)
        words = ["approach" if n.startswith(MEMORY) else WORDS.get(n, n) for n in names]
        return tuple(dict.fromkeys(words))

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, p) of the raw readings per unit of each coefficient."""
        values = np.repeat(self.mask(sightings)[:, None], len(self.columns), axis=1)
        displaced = self.observable == PLACE
        for k, column in enumerate(self.columns):
            for factor in column[:-1] if displaced else column:
                values[:, k] *= evaluate(sightings, factor)
        if not displaced:
            return on_readings(sightings, **{self.observable: values})
        axes = np.stack([direction(sightings, column[-1][0]) for column in self.columns], axis=2)
        return by_displacement(sightings, values[:, None] * axes)

    def finer(self, sightings: Sightings) -> list[FlexibleTerm]:
        """For waves: rates between the neighbours of the grid; for a step: the gaps around its edge."""
        name, function, k = self.columns[0][0] if self.columns and self.columns[0] else ("", "", 0.0)
        if function == "cos" and all(f[:1] == (name,) and f[2] == k for (f, *_) in self.columns):
            step = 2 * np.pi * CYCLES / float(np.ptp(sightings.quantities[name]))
            return [self._retuned(float(r)) for r in k + step * np.linspace(-0.9, 0.9, 13) if r > 0]
        if function in ("step", "bend"):
            values = np.unique(sightings.quantities[name])
            middles = 0.5 * (values[1:] + values[:-1])
            near = np.argsort(np.abs(middles - k))[: 2 * max(len(middles) // EDGES, 4)]
            return [self._retuned(float(edge)) for edge in middles[near]]
        return []

    def _retuned(self, k: float) -> FlexibleTerm:
        """The same with another argument of the first factor of every column."""
        return self.reshaped(columns=tuple(((name, function, k), *rest) for (name, function, _), *rest in self.columns))

    def grown(self, sightings: Sightings) -> list[FlexibleTerm]:
        """Terms one step richer: a further harmonic, times another factor or with it beside, at one station only."""
        columns, found = self.columns, list[tuple[Column, ...]]()
        waves = [c for c in columns if c and c[0][1] in ("cos", "sin")]
        if waves and len(columns) < MOST_GROWN:
            order = 1 + sum(c[0][1] == "cos" for c in waves)
            harmonic = tuple(((n, f, order * k), *rest) for (n, f, k), *rest in waves[:2])
            found.append((*columns, *harmonic))
        along = [c[-1:] if self.observable == PLACE else () for c in columns]
        bare = [c[: len(c) - len(a)] for c, a in zip(columns, along, strict=True)]
        for factor in FACTORS:
            times = tuple((*c, factor, *a) for c, a in zip(bare, along, strict=True))
            if not any(factor in c for c in columns) and any(evaluate(sightings, factor)):
                found += [times, *([(*columns, *times)] if 2 * len(columns) <= MOST_GROWN else [])]
        terms = [self.reshaped(columns=c) for c in found]
        if not self.stations and not self.targets:
            terms += [self.reshaped(stations=(station,)) for station in sightings.station_names[:MOST_GROWN]]
        return terms

    @property
    def formula(self) -> str:
        """The term as a formula with its coefficients left open."""
        return self.written([chr(ord("a") + i) for i in range(len(self.columns))])

    def written(self, coefficients: Sequence[str]) -> str:
        """The term as a formula with these coefficients."""
        pairs = zip(coefficients, self.columns, strict=True)
        terms = " + ".join(f"{coefficient} {describe(column)}".removesuffix(" 1") for coefficient, column in pairs)
        place = f" at {', '.join(self.stations + self.targets)}" if self.place else ""
        what = "displacement of the targets" if self.observable == PLACE else f"{self.observable} correction"
        return f"{what} = {terms}{place}"


def describe(column: Column) -> str:
    """A column in words: ``cos(2 azimuth) tan(elevation)``."""
    words = []
    for name, function, k in column:
        match function:
            case "legendre":
                words.append(f"P{int(k)}({name})")
            case "power":
                words.append({1.0: name, -1.0: f"1/{name}"}.get(k, f"{name}^{k:g}"))
            case "narrow" | "wide":
                words.append(f"bump({name} near {_value(name, k)})")
            case "step" | "bend":
                words.append(f"{function}({name} above {_value(name, k)})")
            case "saturated":
                words.append(f"saturation({name}, half at {_value(name, k)})")
            case "abs":
                words.append(f"|{name}|")
            case "decay":
                words.append(f"exp(-{name} / {_value(name, k)})")
            case "target":
                words.append(f"at {name}")
            case "along":
                words.append(f"along {'the nest' if name == NORMAL else name}")
            case "cos" | "sin" if name in UNITS:
                words.append(f"{function}(2 pi {name} / {_value(name, 2 * np.pi / k)})")
            case _:
                scale = "" if k == 1 else f"{k:.4g} "
                words.append(f"{function}({scale}{name})")
    return " ".join(words) or "1"


UNITS = dict.fromkeys(("time", "station-time", "lapse"), "s") | dict.fromkeys(
    ("distance", "horizontal", "height", "move-distance", "last-distance", *AXES), "m"
)
"""Units of the covariates that are no angles; a further column of the recording names its own."""


def _value(name: str, value: float) -> str:
    """A value of a covariate with its unit."""
    if name.endswith(("azimuth", "elevation", "incidence", "nest-direction")):
        return f"{np.degrees(value):.3g} deg"
    return f"{value:.4g} {UNITS.get(name, '')}".rstrip()


def smooth(name: str, count: int) -> tuple[Column, ...]:
    """Columns of a smooth function of one covariate: Fourier round a circle, Legendre elsewhere; no constant."""
    if name in CIRCULAR:
        waves = range(1, count // 2 + 1)
        return tuple(((name, f, float(k)),) for k in waves for f in ("cos", "sin"))
    return tuple(((name, "legendre", float(k)),) for k in range(1, count + 1))


def wave(name: str, rate: float) -> tuple[Column, ...]:
    """Cosine and sine of a covariate at one rate [1 / its unit]."""
    return ((name, "cos", rate),), ((name, "sin", rate),)
