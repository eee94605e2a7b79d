"""Interface of an effect: the base class that simulator, calibrator, planner and diagnosis share.

An effect is one physical cause of a difference between the ideal reading and the reading of the instrument. Simulator,
calibrator, planner and diagnosis use the same object:

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
    """Stage of the light path at which an effect acts; the simulator applies effects in this order."""

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
    """Base class of all effects; the module docstring describes its interface."""

    stations: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    coarse: float = field(default=1.0, kw_only=True)
    """Factor on the plausible size for instruments that are coarser than a laser tracker."""

    name: ClassVar[str]
    stage: ClassVar[Stage]
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    observables: ClassVar[tuple[str, ...]] = ("distance", "azimuth", "elevation")
    covariates: ClassVar[tuple[str, ...]] = ()
    scope: ClassVar[Scope] = "all"
    plural: ClassVar[bool] = False
    """True for an effect that commonly occurs several times in a recording: outliers, nests, targets."""

    @property
    def spread(self) -> Floats:
        """Plausible sizes (p,) of the parameters [SI]."""
        return self.coarse * super().spread

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Candidates that a diagnosis tries on a network: all places of the effect's scope, all shapes of its grid.

        An effect whose places depend on the recording, such as a change point between two pointings, overrides this
        method.
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
    """Base class of effects that change the noise and not the mean."""


@dataclass(frozen=True)
class Mistake(Effect):
    """Base class of blunders: another point was measured, or a finished reading was recorded wrongly.

    The simulator reproduces the wrong action (`done`, `written`), so that instrument errors and noise belong to the
    actual measurement; `design` is the change of an ideal reading. A blunder of this size is corrected before an
    adjustment, so that a search has no candidates.
    """

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Candidates for a search: none, since `possible` lists the blunders."""
        return []

    @classmethod
    def possible(cls, sightings: Sightings) -> list[Self]:
        """All blunders of this kind that are possible in a network."""
        raise NotImplementedError

    def done(self, sightings: Sightings) -> Sightings:
        """Sightings that were actually measured."""
        return sightings

    def written(self, sightings: Sightings, readings: Floats) -> Floats:
        """Readings (n, 3) as recorded, from finished readings (n, 3)."""
        return readings


Basis = Callable[[Floats], Floats]


def unity(raw: Floats) -> Floats:
    """Constant basis, 1 for every reading."""
    return np.ones(len(raw))


@dataclass(frozen=True)
class Lobe:
    """Basis function cosine or sine of a multiple of a raw reading (1 azimuth, 2 elevation)."""

    wave: Literal["cos", "sin"]
    column: int
    order: float = 1

    def __call__(self, raw: Floats) -> Floats:
        """Values (n,) of the basis at raw readings (n, 3)."""
        angle: Floats = self.order * raw[:, self.column]
        return np.cos(angle) if self.wave == "cos" else np.sin(angle)


@dataclass(frozen=True)
class Power:
    """Basis function power of the range."""

    order: int = 1

    def __call__(self, raw: Floats) -> Floats:
        """Values (n,) of the basis at raw readings (n, 3)."""
        return raw[:, 0] ** self.order


@dataclass(frozen=True)
class Term:
    """Contribution of a parameter to a slot of a kinematic chain: ``error[slot] += value * basis(raw)``."""

    slot: str
    basis: Basis = unity


@dataclass(frozen=True)
class SlotEffect(Effect):
    """Base class of geometric errors of the instrument; each parameter acts on a slot of the kinematic chain.

    The construction evaluates the error exactly; `design` is its first-order form.
    """

    terms: ClassVar[tuple[Term, ...]]

    def design(self, sightings: Sightings) -> Floats:
        acts = self.mask(sightings)
        columns = [sightings.slot_responses[t.slot] * (acts * t.basis(sightings.read))[:, None] for t in self.terms]
        return np.stack(columns, axis=2)
