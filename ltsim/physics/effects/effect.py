"""Base class of the effects of the catalogue, which simulator, calibrator, planner and diagnosis use.

An effect is one physical cause of a difference between the ideal reading and the reading of the instrument. It has
these properties and methods:

* `parameters`: name, unit, meaning and prior of each parameter. Effects are linear in their parameters.
* `design(sightings)` (n, 3, p): change of the raw readings of n pointings (range [m], azimuth, elevation [rad]) per
  unit of each of the p parameters. Calibrator, planner and diagnosis need nothing else.
* `reading_change(sightings, values)` (n, 3): exact change of the readings, which the simulator adds. By default it is
  the design times the values. An effect that is not exactly linear, such as a ray through a temperature field,
  overrides this method.
* `shape_parameters`: constants that enter nonlinearly, such as a time constant or a wavelength, with bounds. They are
  fields of the instance, and a diagnosis searches their values.
* `stations`, `targets`: names of the stations and targets where the effect acts, empty for all. `candidates` lists the
  effects with the stations, targets and shape parameters that a search tries.

Conventions of all catalogue entries: Delta = true value - reading is the correction to add to a reading. The change of
a reading is therefore minus its correction. If a parameter is not a correction, its entry says so. The azimuth az
counts counter-clockwise as seen from above, and the elevation el from the horizontal plane. The range is d. The sign f
is +1 in face 1 and -1 in face 2. D_r, D_t and D_v are lengths along the beam, to its left and upward: Delta_d, d
cos(el) Delta_azimuth and d Delta_elevation.
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
    ShapeParameter as ShapeParameter,
    SpecifiedQuantity as SpecifiedQuantity,
    axis_parameters as axis_parameters,
    design_from_displacements as design_from_displacements,
    design_from_front_face_corrections as design_from_front_face_corrections,
)
from ltsim.scene.sightings import Sightings

CandidateScope = Literal["all", "station", "target", "pointing", "reading"]
"""Part of the recording in which one instance of an effect acts: the whole recording (`all`), a single station, a
single target, a pair of station and target (`pointing`), or a single reading."""


class LightPathStage(IntEnum):
    """Stage of the light path at which an effect acts; the simulator applies the effects in the order of the stages."""

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
    """Base class of the effects of the catalogue: physical causes that change the readings of a tracker."""

    stations: tuple[str, ...] = ()
    """Names of the stations at which the effect acts; empty for all stations."""
    targets: tuple[str, ...] = ()
    """Names of the targets at which the effect acts; empty for all targets."""
    plausible_size_factor: float = field(default=1.0, kw_only=True)
    """Factor on the plausible sizes of the parameters, above 1 for instruments less accurate than a tracker (total
    stations)."""

    name: ClassVar[str]
    """Name of the effect in the catalogue: lower-case words joined by hyphens."""
    light_path_stage: ClassVar[LightPathStage]
    """Stage of the light path at which the effect acts."""
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    """The p parameters of the effect; the change of the readings is linear in them."""
    observables: ClassVar[tuple[str, ...]] = ("distance", "azimuth", "elevation")
    """Names of the observables that the effect changes."""
    covariates: ClassVar[tuple[str, ...]] = ()
    """Names of the quantities on which the effect depends, such as `time` or `azimuth`."""
    scope: ClassVar[CandidateScope] = "all"
    """Part of the recording in which one instance of the effect acts, such as a station (see `CandidateScope`)."""
    may_recur: ClassVar[bool] = False
    """True for an effect that commonly occurs several times in a recording, such as an outlier or a badly seated
    reflector."""
    base_rate: ClassVar[float] = 1.0
    """Relative frequency of the effect in practice, an expert judgement: 8 very common, 4 common, 2 frequent, 1
    occasional, 0.5 rare. The prior probability that any catalogue effect shifts readings is divided among these
    effects in proportion to their frequencies. The prior probability of a changed noise level is divided in the same
    way among the noise effects."""

    @property
    def plausible_sizes(self) -> Floats:
        """Plausible sizes (p,) [SI] of the p parameters, with the factor `plausible_size_factor`."""
        return self.plausible_size_factor * super().plausible_sizes

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Effects that a diagnosis tries: one per part of the recording (`scope`) and value of the shape parameters.

        An effect with other candidates, such as steps between two pointings, overrides this method.
        """
        places: list[dict[str, Any]] = [{}]
        if cls.scope == "station":
            places = [{"stations": (name,)} for name in sightings.station_names]
        elif cls.scope == "target":
            places = [{"targets": (name,)} for name in sightings.target_names]
        grids = [[(s.name, float(v)) for v in s.grid_values()] for s in cls.shape_parameters]
        shapes: list[dict[str, Any]] = [dict(shape) for shape in product(*grids)]
        return [cls(**place, **shape) for place in places for shape in shapes]


def effect_parameter_names(effects: Iterable[tuple[str, str, Sequence[str]]]) -> list[str]:
    """Unique names of the parameters of several effects, such as ``head-sag:sag S2`` for the station S2.

    `effects` are triples: name of the effect, text of the stations and targets where it acts, and names of its
    parameters. The parameter of a second equal effect gets a number, as in ``head-sag:sag S2 #2``.
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
    """Base class of catalogue effects that change the noise of readings but not their mean."""


@dataclass(frozen=True)
class Blunder(Effect):
    """Base class of blunders: a wrong point was measured, or a correct reading was recorded wrongly.

    The simulator reproduces the mistake (`measured_sightings`, `recorded_readings`), with the instrument errors and the
    noise of the point that was measured. `design` is the change of an ideal reading. Blunders are corrected before an
    adjustment, so that a diagnosis tries none.
    """

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Empty list, because a diagnosis tries no blunders (see `possible_blunders`)."""
        return []

    @classmethod
    def possible_blunders(cls, sightings: Sightings) -> list[Self]:
        """All blunders of this class that can occur in a network."""
        raise NotImplementedError

    def measured_sightings(self, sightings: Sightings) -> Sightings:
        """Sightings with the measured targets and faces; because of the blunder the recording names other ones."""
        return sightings

    def recorded_readings(self, sightings: Sightings, readings: Floats) -> Floats:
        """Readings (n, 3) of n pointings as they are recorded with the blunder, from the correct readings (n, 3)."""
        return readings


BasisFunction = Callable[[Floats], Floats]
"""Function from n raw readings (n, 3) (range [m], azimuth and elevation [rad]) to n values (n,). A geometric error is
such a function times its parameter."""


def constant_basis(readings: Floats) -> Floats:
    """Values (n,) of a constant error per unit of its parameter at n raw readings (n, 3): 1 for each reading."""
    return np.ones(len(readings))


@dataclass(frozen=True)
class HarmonicBasis:
    """Basis function of a geometric error: cosine or sine of a multiple of the azimuth or elevation reading."""

    function: Literal["cos", "sin"]
    """Function of the angle: `cos` or `sin`."""
    reading_column: int
    """Column of the angle in an array of readings: 1 for the azimuth, 2 for the elevation."""
    order: float = 1
    """Factor on the angle: number of periods per turn."""

    def __call__(self, readings: Floats) -> Floats:
        """Values (n,) of the basis function (error per unit of its parameter) at n raw readings (n, 3).

        The columns of the readings are range [m], azimuth and elevation [rad].
        """
        angle: Floats = self.order * readings[:, self.reading_column]
        return np.cos(angle) if self.function == "cos" else np.sin(angle)


@dataclass(frozen=True)
class RangePowerBasis:
    """Basis function of a geometric error: a power of the range."""

    exponent: int = 1
    """Exponent of the range."""

    def __call__(self, readings: Floats) -> Floats:
        """Values (n,) of the basis function (error per unit of its parameter) at n raw readings (n, 3).

        The columns of the readings are range [m], azimuth and elevation [rad].
        """
        return readings[:, 0] ** self.exponent


@dataclass(frozen=True)
class ChainErrorTerm:
    """Term of a geometric error of the instrument: a parameter times a basis function of the readings.

    The term is added to one of the errors of the kinematic chain.
    """

    chain_error_key: str
    """Key of the error in the kinematic chain, such as `beam-tilt`."""
    basis: BasisFunction = constant_basis
    """Basis function: function of the raw readings by which the parameter is multiplied."""


@dataclass(frozen=True)
class ChainErrorEffect(Effect):
    """Base class of geometric errors of the instrument: errors of its kinematic chain.

    `GeometricErrorModel` evaluates a geometric error exactly; `design` is the first-order form.
    """

    terms: ClassVar[tuple[ChainErrorTerm, ...]]
    """Terms of the geometric error, one per parameter: the parameter times a function of the readings."""

    def design(self, sightings: Sightings) -> Floats:
        acts = self.pointing_indicator(sightings)
        columns = [
            sightings.reading_change_by_error_key[t.chain_error_key]
            * (acts * t.basis(sightings.instrument_readings))[:, None]
            for t in self.terms
        ]
        return np.stack(columns, axis=2)
