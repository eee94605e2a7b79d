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

Conventions of all cards: Delta = truth - reading, the correction to add to a reading; a change of a reading is
therefore minus its correction, and a parameter that is no correction says so. Azimuth az counts counter-clockwise seen
from above, elevation el from the horizontal plane; d is the range, f is +1 on face 1 and -1 on face 2. D_r, D_t, D_v
are lengths along the beam, to its left and upward: Delta_d, d cos(el) Delta_azimuth and d Delta_elevation.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from itertools import product
from typing import Any, ClassVar, Literal, Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.physics.effects.signature import (
    NoiseSignature,
    Parameter as Parameter,
    PriorKind as PriorKind,
    ShapeParameter as ShapeParameter,
    Signature as Signature,
    Tunable,
    along_axes as along_axes,
    by_displacement as by_displacement,
    on_readings as on_readings,
)
from ltsim.scene.sightings import Sightings

Scope = Literal["all", "station", "target", "pointing", "reading"]


class Stage(IntEnum):
    """Stage on the path of the light at which an effect acts; the simulator applies effects in this order."""

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
class Effect(Tunable):
    """Base of all effects; see the module for the contract."""

    stations: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    coarse: float = field(default=1.0, kw_only=True)
    """Times its usual size that is plausible where the instrument is coarser than a laser tracker."""

    name: ClassVar[str]
    stage: ClassVar[Stage]
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    observables: ClassVar[tuple[str, ...]] = ("distance", "azimuth", "elevation")
    covariates: ClassVar[tuple[str, ...]] = ()
    scope: ClassVar[Scope] = "all"
    plural: ClassVar[bool] = False
    """Several of them in one recording are nothing unusual: bad readings, nests and targets."""

    @property
    def spread(self) -> Floats:
        """Plausible sizes (p,) of its parameters [SI]."""
        return self.coarse * super().spread

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


@dataclass(frozen=True)
class NoiseEffect(NoiseSignature, Effect):
    """A change of the noise."""


@dataclass(frozen=True)
class Mistake(Effect):
    """A blunder at the work: something else was measured, or a finished reading was written down wrongly.

    The simulator makes it by doing the wrong thing (`done`, `written`), so that the instrument's errors and the noise
    are those of what was really done; `design` says what it does to an ideal reading. A mistake of its size is mended
    before an adjustment, so a search has no candidates.
    """

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """No candidates: `possible` lists the mistakes."""
        return []

    @classmethod
    def possible(cls, sightings: Sightings) -> list[Self]:
        """Every such mistake that can have happened."""
        raise NotImplementedError

    def done(self, sightings: Sightings) -> Sightings:
        """Sightings that were really measured."""
        return sightings

    def written(self, sightings: Sightings, readings: Floats) -> Floats:
        """Readings (n, 3) as they were written down, from finished readings (n, 3)."""
        return readings


Basis = Callable[[Floats], Floats]


def unity(raw: Floats) -> Floats:
    """The constant basis."""
    return np.ones(len(raw))


@dataclass(frozen=True)
class Lobe:
    """The basis cos or sin of a multiple of a raw reading (1 azimuth, 2 elevation)."""

    wave: Literal["cos", "sin"]
    column: int
    order: float = 1

    def __call__(self, raw: Floats) -> Floats:
        """(n,) of raw readings (n, 3)."""
        angle: Floats = self.order * raw[:, self.column]
        return np.cos(angle) if self.wave == "cos" else np.sin(angle)


@dataclass(frozen=True)
class Power:
    """The basis range to a power."""

    order: int = 1

    def __call__(self, raw: Floats) -> Floats:
        """(n,) of raw readings (n, 3)."""
        return raw[:, 0] ** self.order


@dataclass(frozen=True)
class Term:
    """A parameter's part in a kinematic chain: ``error[slot] += value * basis(raw)``."""

    slot: str
    basis: Basis = unity


@dataclass(frozen=True)
class SlotEffect(Effect):
    """An error of the instrument's geometry: each parameter feeds a slot of the kinematic chain.

    The construction evaluates it exactly; `design` is its first-order form.
    """

    terms: ClassVar[tuple[Term, ...]]

    def design(self, sightings: Sightings) -> Floats:
        acts = self.mask(sightings)
        columns = [sightings.slot_responses[t.slot] * (acts * t.basis(sightings.read))[:, None] for t in self.terms]
        return np.stack(columns, axis=2)
