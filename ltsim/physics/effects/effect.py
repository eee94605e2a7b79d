"""Interface of an effect: the base class that simulator, calibrator, planner and diagnosis share.

An effect is one physical cause of a difference between the ideal reading and the reading of the instrument. Simulator,
calibrator, planner and diagnosis use the same object:

* `parameters`: name, unit, meaning, prior. Effects are linear in their parameters.
* `design(sightings)` (n, 3, p): change of the raw reading (range [m], azimuth, elevation [rad]) per unit of
  each parameter. Calibrator, planner and diagnoser need nothing else.
* `reading_change(sightings, values)` (n, 3): exact change of the readings, which the simulator adds. By default it is
  the design times the values. An effect that is not exactly linear, such as a ray through a temperature field,
  overrides this method.
* `shape_parameters`: constants that enter nonlinearly, such as a time constant or a wavelength, with bounds. They are
  fields of the instance, and a diagnosis searches their values.
* `stations`, `targets`: names of the places where the effect acts, empty for all. `candidates` lists the effects with
  the places and constants that a search tries.

Conventions of all catalogue entries: Delta = truth - reading is the correction to add to a reading. The change of a
reading is therefore minus its correction. If a parameter is not a correction, its entry says so. Azimuth az counts
counter-clockwise seen from above, elevation el from the horizontal plane; d is the range, f is +1 on face 1 and -1 on
face 2. D_r, D_t, D_v are lengths along the beam, to its left and upward: Delta_d, d cos(el) Delta_azimuth and
d Delta_elevation.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from itertools import product
from typing import Any, ClassVar, Literal, Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.physics.effects.linear_effect import (
    CandidateEffect,
    CandidateNoiseEffect,
    LinearEffect as LinearEffect,
    Parameter as Parameter,
    PriorKind as PriorKind,
    ShapeParameter as ShapeParameter,
    axis_parameters as axis_parameters,
    design_from_displacements as design_from_displacements,
    design_from_front_face_corrections as design_from_front_face_corrections,
)
from ltsim.scene.sightings import Sightings

PlaceScope = Literal["all", "station", "target", "pointing", "reading"]
"""Kind of place at which candidates of an effect act: everywhere, or at single stations, targets, pointings or
readings."""


class LightPathStage(IntEnum):
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
class Effect(CandidateEffect):
    """Base class of all effects; the module docstring describes its interface."""

    stations: tuple[str, ...] = ()
    """Names of the stations at which the effect acts; empty for all."""
    targets: tuple[str, ...] = ()
    """Names of the targets at which the effect acts; empty for all."""
    size_factor: float = field(default=1.0, kw_only=True)
    """Factor on the plausible sizes of the parameters; it exceeds 1 for instruments that are less accurate than a
    tracker."""

    name: ClassVar[str]
    stage: ClassVar[LightPathStage]
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    observables: ClassVar[tuple[str, ...]] = ("distance", "azimuth", "elevation")
    covariates: ClassVar[tuple[str, ...]] = ()
    scope: ClassVar[PlaceScope] = "all"
    may_recur: ClassVar[bool] = False
    """True for an effect that commonly occurs several times in a recording: outliers, nests, targets."""
    base_rate: ClassVar[float] = 1.0
    """Relative frequency of the effect in practice, an expert judgement: 8 very common, 4 common, 2 frequent, 1
    occasional, 0.5 rare. The prior probability that any effect of the catalogue shifts readings is divided among these
    effects in proportion to their frequencies; that of a change of the noise is divided likewise."""

    @property
    def size_scales(self) -> Floats:
        """Plausible sizes (p,) of the parameters [SI]."""
        return self.size_factor * super().size_scales

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Effects that a diagnosis tries: one for each place in the effect's scope and each value of its constants.

        An effect whose places depend on the recording, such as a change point between two pointings, overrides this
        method.
        """
        places: list[dict[str, Any]] = [{}]
        if cls.scope == "station":
            places = [{"stations": (name,)} for name in sightings.station_names]
        elif cls.scope == "target":
            places = [{"targets": (name,)} for name in sightings.target_names]
        grids = [[(s.name, float(v)) for v in s.grid()] for s in cls.shape_parameters]
        shapes: list[dict[str, Any]] = [dict(shape) for shape in product(*grids)]
        return [cls(**place, **shape) for place in places for shape in shapes]


def effect_parameter_names(effects: Iterable[tuple[str, str, Sequence[str]]]) -> list[str]:
    """Unique names of the parameters of effects, each given by its name, its place and the names of its parameters.

    They are ``head-sag:sag``, ``head-sag:sag S2`` with a place, and ``head-sag:sag S2 #2`` for a second equal effect.
    """
    names, counts = list[str](), Counter[str]()
    for effect_name, place_text, parameter_names in effects:
        for parameter_name in parameter_names:
            name = f"{effect_name}:{parameter_name} {place_text}".rstrip()
            counts[name] += 1
            names.append(f"{name} #{counts[name]}" if counts[name] > 1 else name)
    return names


@dataclass(frozen=True)
class NoiseEffect(CandidateNoiseEffect, Effect):
    """Base class of effects that change the noise and not the mean."""


@dataclass(frozen=True)
class Blunder(Effect):
    """Base class of blunders: another point was measured, or a correct reading was recorded wrongly.

    The simulator reproduces the wrong action (`measured_sightings`, `recorded_readings`). Instrument errors and noise
    are therefore those of the actual measurement, while `design` is the change of an ideal reading. Blunders are
    corrected before an adjustment, so that a search has no candidates.
    """

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Empty list, because a search does not try blunders; `possible_blunders` lists them."""
        return []

    @classmethod
    def possible_blunders(cls, sightings: Sightings) -> list[Self]:
        """List of all blunders of this kind that are possible in a network."""
        raise NotImplementedError

    def measured_sightings(self, sightings: Sightings) -> Sightings:
        """Sightings of the points that were actually measured."""
        return sightings

    def recorded_readings(self, sightings: Sightings, readings: Floats) -> Floats:
        """Readings (n, 3) with the blunder, as recorded, from correct readings (n, 3)."""
        return readings


BasisFunction = Callable[[Floats], Floats]
"""Function of the raw readings (n, 3) that multiplies a parameter, with values (n,)."""


def constant_basis(readings: Floats) -> Floats:
    """Values (n,) of the constant basis function: 1 for every pointing."""
    return np.ones(len(readings))


@dataclass(frozen=True)
class HarmonicBasis:
    """Basis function: cosine or sine of a multiple of the azimuth or elevation reading."""

    function: Literal["cos", "sin"]
    reading_column: int
    order: float = 1
    """Multiple of the reading."""

    def __call__(self, readings: Floats) -> Floats:
        """Values (n,) of the basis at raw readings (n, 3)."""
        angle: Floats = self.order * readings[:, self.reading_column]
        return np.cos(angle) if self.function == "cos" else np.sin(angle)


@dataclass(frozen=True)
class RangePowerBasis:
    """Basis function: a power of the range."""

    exponent: int = 1

    def __call__(self, readings: Floats) -> Floats:
        """Values (n,) of the basis at raw readings (n, 3)."""
        return readings[:, 0] ** self.exponent


@dataclass(frozen=True)
class SlotTerm:
    """Term of a geometric error: a parameter times a basis function, added to a slot of the kinematic chain."""

    slot: str
    """Name of the slot of the kinematic chain."""
    basis: BasisFunction = constant_basis
    """Function of the raw readings that multiplies the parameter."""


@dataclass(frozen=True)
class SlotEffect(Effect):
    """Base class of geometric errors of the instrument; each parameter acts on a slot of the kinematic chain.

    `GeometricErrorModel` evaluates the error exactly; `design` is its first-order form.
    """

    terms: ClassVar[tuple[SlotTerm, ...]]

    def design(self, sightings: Sightings) -> Floats:
        acts = self.row_weights(sightings)
        columns = [
            sightings.slot_responses[t.slot] * (acts * t.basis(sightings.instrument_readings))[:, None]
            for t in self.terms
        ]
        return np.stack(columns, axis=2)
