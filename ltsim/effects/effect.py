"""The contract of an effect.

An effect is one physical cause of a difference between the ideal reading and the instrument's. Simulator,
calibrator, planner and diagnoser all use the same object:

* `parameters`: name, unit, meaning, prior. Effects are linear in their parameters.
* `design(sightings)` (n, 3, p): change of the raw reading (range [m], azimuth, elevation [rad]) per unit of
  each parameter. Calibrator, planner and diagnoser need nothing else.
* `shift(sightings, values)` (n, 3): what the simulator adds. By default design times values; an effect whose
  exact physics is not linear (a ray through a temperature field) says so here.
* `shape`: constants that enter nonlinearly (a time constant, a wavelength), with bounds; they are fields of
  the instance, and the diagnoser profiles over them.
* `stations`, `targets`: where the effect acts, empty for everywhere; `candidates` lists the places to try.

Sign: a parameter is a correction, truth - reading, as in physics.md; the change of a reading is therefore its
negative.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import product
from typing import Any, ClassVar, Literal, Self

import numpy as np

from ltsim.arrays import Bools, Floats, Ints
from ltsim.recording.setup import Prior
from ltsim.scene.sightings import Sightings
from ltsim.units import ARCSECOND, FACTOR, MILLIMETRE, PPM

PriorKind = Literal["angle", "offset", "range_scale", "range_offset"]
Scope = Literal["all", "station", "target", "pointing", "reading"]


class Stage(IntEnum):
    """Where on the way of the light an effect acts; the simulator applies them in this order."""

    TARGET = 0
    STATION = 1
    AIR = 2
    OPTICS = 3
    AXES = 4
    ENCODERS = 5
    RANGE = 6
    ELECTRONICS = 7
    NOISE = 8


@dataclass(frozen=True)
class Parameter:
    """One number of an effect.

    Attributes
    ----------
    name : str
    unit : str
        The unit a person reads it in, a key of `units.FACTOR`; values are SI.
    meaning : str
    prior_kind : str or None
        Which guarantee of the maker bounds it; None: only `prior_sigma`.
    prior_sigma : float
        One standard deviation [SI] where the set-up gives none; also the scale of a plausible size.
    positive : bool
        Never negative: a thickness.
    """

    name: str
    unit: str
    meaning: str
    prior_sigma: float
    prior_kind: PriorKind | None = None
    positive: bool = False

    def sigma_from(self, prior: Prior) -> float:
        """Prior standard deviation [SI] under a maker's guarantee."""
        if self.prior_kind is None:
            return self.prior_sigma
        return {
            "angle": prior.angle_arcsec * ARCSECOND,
            "offset": prior.offset_mm * MILLIMETRE,
            "range_scale": prior.range_scale_ppm * PPM,
            "range_offset": prior.range_offset_mm * MILLIMETRE,
        }[self.prior_kind]

    @property
    def factor(self) -> float:
        """The unit in SI."""
        return FACTOR[self.unit]


@dataclass(frozen=True)
class ShapeParameter:
    """A constant that enters nonlinearly: a field of the effect, searched between bounds."""

    name: str
    unit: str
    meaning: str
    low: float
    high: float
    logarithmic: bool = False
    steps: int = 9
    reciprocal: bool = False

    def grid(self) -> Floats:
        """Values (steps,) [SI] between the bounds, at which a search tries the effect.

        Evenly spaced in the value, its logarithm, or (`reciprocal`, a wavelength) its inverse.
        """
        if self.reciprocal:
            return 1.0 / np.linspace(1.0 / self.high, 1.0 / self.low, self.steps)
        if self.logarithmic:
            return np.geomspace(self.low, self.high, self.steps)
        return np.linspace(self.low, self.high, self.steps)

    def bracket(self, value: float) -> tuple[float, float]:
        """The stretch [SI] from one step of the grid below a value to one above, within the bounds."""
        grid = np.sort(self.grid())
        if len(grid) < 2:
            return value, value
        i = int(np.clip(np.searchsorted(grid, value), 1, len(grid) - 1))
        below, above = float(grid[i - 1]), float(grid[i])
        low = value * below / above if self.logarithmic else value - (above - below)
        high = value * above / below if self.logarithmic else value + (above - below)
        return max(low, self.low), min(high, self.high)


@dataclass(frozen=True)
class Effect:
    """Base of all effects; see the module for the contract."""

    stations: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()

    name: ClassVar[str]
    number: ClassVar[int]
    stage: ClassVar[Stage]
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    shape: ClassVar[tuple[ShapeParameter, ...]] = ()
    observables: ClassVar[tuple[str, ...]] = ("distance", "azimuth", "elevation")
    covariates: ClassVar[tuple[str, ...]] = ()
    scope: ClassVar[Scope] = "all"
    plural: ClassVar[bool] = False
    """Several of them in one recording are nothing unusual: bad readings, nests and targets."""
    ways: ClassVar[int] = 1
    """Independent directions in which `finer` moves."""

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Instances a diagnosis tries on a network: all places of the effect's scope, all shapes of its grid.

        An effect whose places follow from the recording (a change point between two pointings) says so here.
        """
        places: list[dict[str, Any]] = [{}]
        if cls.scope == "station":
            places = [{"stations": (name,)} for name in sightings.station_names]
        elif cls.scope == "target":
            places = [{"targets": (name,)} for name in sightings.target_names]
        grids = [[(s.name, float(v)) for v in s.grid()] for s in cls.shape]
        shapes: list[dict[str, Any]] = [dict(shape) for shape in product(*grids)]
        return [cls(**place, **shape) for place in places for shape in shapes]

    def finer(self, sightings: Sightings) -> list[Self]:
        """Instances near this one that `candidates` leaves out; tried once this one stands out."""
        return []

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, p) of the raw readings per unit of each parameter."""
        raise NotImplementedError

    def shift(self, sightings: Sightings, values: Floats) -> Floats:
        """Change (n, 3) of the raw readings for parameter values (p,) [SI]."""
        change: Floats = self.design(sightings) @ values
        return change

    def gauge_design(self, first: Ints, second: Ints, points: Floats) -> Floats:
        """Change (g, p) of the known lengths between targets `first` and `second` (g,) per unit.

        One column a parameter; only effects on the gauge itself have one.
        """
        return np.zeros((len(first), len(self.parameters)))

    def reshaped(self, **constants: Any) -> Self:
        """The same effect with other shape constants."""
        return replace(self, **constants)

    def mask(self, sightings: Sightings) -> Floats:
        """(n,) 1 where the effect acts, 0 elsewhere."""
        acts = np.ones(len(sightings), dtype=bool)
        if self.stations:
            ids = [i for i, name in enumerate(sightings.station_names) if name in self.stations]
            acts &= _among(sightings.station, ids)
        if self.targets:
            ids = [i for i, name in enumerate(sightings.target_names) if name in self.targets]
            acts &= _among(sightings.target, ids)
        return acts.astype(np.float64)


def _among(values: Ints, ids: list[int]) -> Bools:
    """(n,): whether each value is one of a few; one is the common case, and much faster alone."""
    among: Bools = values == ids[0] if len(ids) == 1 else np.isin(values, ids)
    return among


@dataclass(frozen=True)
class NoiseEffect(Effect):
    """A change of the noise: parameters are added variances or factors on them, not mean shifts."""

    least: ClassVar[float] = 0.0
    """Smallest value of a parameter in units of its prior sigma: most causes add noise and take none away."""

    def variance(self, sightings: Sightings, sigma: Floats, values: Floats) -> Floats:
        """Variance (n, 3) of the readings when the stated standard deviations are `sigma` (n, 3).

        Must give sigma^2 at zero values.
        """
        raise NotImplementedError

    def size_grid(self) -> list[tuple[float, ...]]:
        """Parameter values [SI] that a diagnosis tries: each parameter alone and all together, in several sizes."""
        count = len(self.parameters)
        subsets = [*np.eye(count), *([np.ones(count)] if count > 1 else [])]
        prior = np.array([p.prior_sigma for p in self.parameters])
        return [tuple(size * subset * prior) for subset in subsets for size in (0.05, 0.15, 0.4, 1.0, 3.0, 10.0)]

    def design(self, sightings: Sightings) -> Floats:
        """No mean shift: zeros (n, 3, p)."""
        return np.zeros((len(sightings), 3, len(self.parameters)))


@dataclass(frozen=True)
class Mistake(Effect):
    """A blunder at the work: something else was measured, or a finished reading was written down wrongly.

    The simulator makes it by doing the wrong thing (`done`, `written`), so that the instrument's errors and the noise
    are those of what was really done; `design` says what it does to an ideal reading.
    """

    def done(self, sightings: Sightings) -> Sightings:
        """What was really measured."""
        return sightings

    def written(self, sightings: Sightings, readings: Floats) -> Floats:
        """What was written down (n, 3) of finished readings (n, 3)."""
        return readings


def card_line(kind: type[Effect]) -> tuple[str, str]:
    """Title of an effect and what happens, both from the first line of its card."""
    line = (sys.modules[kind.__module__].__doc__ or kind.name).strip().splitlines()[0].rstrip(".")
    title, _, cause = line.partition(": ")
    return title.split(" (")[0], cause


Basis = Callable[[Floats], Floats]


def one(raw: Floats) -> Floats:
    """The constant basis."""
    return np.ones(len(raw))


@dataclass(frozen=True)
class Term:
    """A parameter's part in a kinematic chain: ``error[slot] += value * basis(raw)``."""

    slot: str
    basis: Basis = one


@dataclass(frozen=True)
class SlotEffect(Effect):
    """An error of the instrument's geometry: each parameter feeds a slot of the kinematic chain.

    The construction evaluates it exactly; `design` is its first-order form.
    """

    terms: ClassVar[tuple[Term, ...]]

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, p) of the raw readings per unit of each parameter, first order."""
        acts = self.mask(sightings)
        columns = [sightings.slot_responses[t.slot] * (acts * t.basis(sightings.read))[:, None] for t in self.terms]
        return np.stack(columns, axis=2)


def on_readings(
    sightings: Sightings,
    *,
    distance: Floats | float = 0.0,
    azimuth: Floats | float = 0.0,
    elevation: Floats | float = 0.0,
) -> Floats:
    """A design (n, 3) or (n, 3, p) from corrections (truth - reading) (n,) or (n, p) of front-face coordinates.

    The elevation's sign is turned on the back face, whose raw elevation runs backwards, and all are negated:
    a reading changes by minus its correction.
    """
    corrections = [np.asarray(c, dtype=np.float64) for c in (distance, azimuth, elevation)]
    design = np.empty((len(sightings), 3, *max((c.shape[1:] for c in corrections), key=len)))
    for j, correction in enumerate(corrections):
        design[:, j] = -correction
    design[sightings.face == 2, 2] *= -1.0
    return design


def by_displacement(sightings: Sightings, displacement: Floats) -> Floats:
    """Change (n, 3, p) of the raw readings when targets move by (n, 3, p) [m] in the network frame."""
    change: Floats = sightings.by_target @ displacement
    return change


def parameter_names(effects: Iterable[Effect]) -> list[str]:
    """Names of all parameters in order, with the place where an effect is confined to one."""
    names = []
    for effect in effects:
        place = ",".join(effect.stations + effect.targets)
        names += [p.name + (f"@{place}" if place else "") for p in effect.parameters]
    return names
