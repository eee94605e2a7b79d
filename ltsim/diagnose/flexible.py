"""Flexible terms: what is fitted where the catalogue fails.

A term acts on one observable (or moves the targets along one axis of the room) and is a sum of columns, each a
product of simple functions of covariates. Terms are effects like any other, so they are tested, refitted and simulated
in the same way; they are only never given a name of the catalogue.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Floats
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
"""Values of a covariate at which a step or a bend is tried."""
LOCAL_WIDTHS = {"narrow": 0.04, "wide": 0.1}
"""Widths of a local bump, as a share of the covariate's span."""


FUNCTIONS = ("legendre", "power", "cos", "sin", "tan", "step", "bend", "abs", "decay", *LOCAL_WIDTHS)
WORDS = {"x": "place", "y": "place", "z": "place", "station-time": "time", "air_temperature_c": "temperature"}
"""Names of the interface for covariates that have others here."""


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
        "approach-azimuth": sightings.approach[:, 0],
        "approach-elevation": sightings.approach[:, 1],
        "move-distance": sightings.move[:, 0],
        "move-azimuth": sightings.move[:, 1],
        "move-elevation": sightings.move[:, 2],
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
        case "bend":
            return np.maximum(x - k, 0.0)
        case "abs":
            return np.abs(x)
        case "decay":
            return np.exp(-x / k)
    raise unknown_name("function", function, FUNCTIONS)


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
        words = ["approach" if n.startswith(("approach-", "move-")) else WORDS.get(n, n) for n in names]
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
        if function in ("step", "bend"):
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
        elif function in ("step", "bend"):
            words.append(f"{function}({name} above {k:.3g})")
        elif function == "abs":
            words.append(f"|{name}|")
        elif function == "decay":
            words.append(f"exp(-{name} / {k:.3g})")
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


def wave(name: str, rate: float) -> tuple[Column, ...]:
    """Cosine and sine of a covariate at one rate [1 / its unit]."""
    return ((name, "cos", rate),), ((name, "sin", rate),)
