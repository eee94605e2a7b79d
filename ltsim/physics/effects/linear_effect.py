"""Linear effects: changes of the readings that are linear in parameters, which an adjustment estimates.

`LinearEffect` is the interface that `MeasurementModel`, `NetworkProblem` and `ResidualSpace` use. A subclass defines
`name`, `parameters` and `design`. `CandidateEffect` adds the interface for a search that compares effects.
`CandidateNoiseEffect` is a change of the variance of the readings. An effect of the catalogue (`effects.effect.Effect`)
is a `CandidateEffect` with a known physical cause.

Sign: a parameter is a correction, true value - reading. The change of a reading by the effect is minus this correction.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, Self

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.units import ARCSECOND, MILLIMETRE, PPM, SI_PER_UNIT
from ltsim.recordings.setup import Prior
from ltsim.scene.sightings import Sightings

SpecifiedQuantity = Literal["angle", "offset", "range_scale", "range_offset"]
"""Quantity of an instrument for which its specification states a standard deviation: the prior standard deviation of
all parameters that belong to the quantity."""


@dataclass(frozen=True)
class Parameter:
    """Parameter of an effect (such as a beam tilt), with display unit, description and prior standard deviation."""

    name: str
    """Name of the parameter, unique within its effect."""
    unit: str
    """Display unit, a key of `units.SI_PER_UNIT`; all computations use SI units."""
    description: str
    """Description, shown to users, such as `delay of the range`."""
    prior_sigma: float
    """Prior standard deviation [SI] if the specification of the instrument states none. A diagnosis uses it as
    plausible size of the parameter."""
    specified_quantity: SpecifiedQuantity | None = None
    """Quantity (such as `angle`) whose standard deviation in the instrument's specification is the prior standard
    deviation of the parameter.

    If None, the prior standard deviation is `prior_sigma`.
    """
    is_nonnegative: bool = False
    """True if the parameter cannot be negative (such as a thickness)."""

    def prior_sigma_from(self, prior: Prior) -> float:
        """Prior standard deviation [SI] from the instrument's specification `prior`.

        It is `prior_sigma` if the specification states none for this parameter.
        """
        if self.name in prior.parameters:
            return prior.parameters[self.name] * self.si_per_display_unit
        if self.specified_quantity is None:
            return self.prior_sigma
        return {
            "angle": prior.angle_arcsec * ARCSECOND,
            "offset": prior.offset_mm * MILLIMETRE,
            "range_scale": prior.range_scale_ppm * PPM,
            "range_offset": prior.range_offset_mm * MILLIMETRE,
        }[self.specified_quantity]

    @property
    def si_per_display_unit(self) -> float:
        """Value of the display unit in SI units, such as 1e-6 for um."""
        return SI_PER_UNIT[self.unit]


def axis_parameters(name: str, unit: str, description: str, prior_sigma: float) -> tuple[Parameter, ...]:
    """Parameters `name-x`, `name-y` and `name-z`: motions along, or rotations about, the axes of the network frame.

    `unit` is the display unit, `description` the description without the axis, and `prior_sigma` the prior standard
    deviation [SI] of each parameter.
    """
    return tuple(
        Parameter(f"{name}-{axis}", unit, f"{description} the network's {axis} axis", prior_sigma) for axis in "xyz"
    )


@dataclass(frozen=True)
class ShapeParameter:
    """Shape parameter: a constant (period, time constant, onset time) on which the readings depend nonlinearly.

    A shape parameter is a field of its effect. A diagnosis tries values between two bounds.
    """

    name: str
    """Name of the shape parameter, and of the field of the effect with its value."""
    unit: str
    """Display unit, a key of `units.SI_PER_UNIT`."""
    description: str
    """Description, shown to users, such as `width of the transition`."""
    lower_bound: float
    """Smallest value [SI] that a diagnosis tries."""
    upper_bound: float
    """Largest value [SI] that a diagnosis tries."""
    has_logarithmic_grid: bool = False
    """True if the values that a diagnosis tries are evenly spaced in their logarithm."""
    n_grid_values: int = 9
    """Number of values that a diagnosis tries."""
    has_reciprocal_grid: bool = False
    """True if the values that a diagnosis tries are evenly spaced in their reciprocal (such as wavelengths)."""

    def grid_values(self) -> Floats:
        """Values (n_grid_values,) [SI] of the shape parameter, from bound to bound, that a diagnosis tries.

        They are evenly spaced, in the logarithm if `has_logarithmic_grid`, in the reciprocal if `has_reciprocal_grid`.
        """
        if self.has_reciprocal_grid:
            return 1.0 / np.linspace(1.0 / self.upper_bound, 1.0 / self.lower_bound, self.n_grid_values)
        if self.has_logarithmic_grid:
            return np.geomspace(self.lower_bound, self.upper_bound, self.n_grid_values)
        return np.linspace(self.lower_bound, self.upper_bound, self.n_grid_values)

    def neighbouring_grid_interval(self, value: float) -> tuple[float, float]:
        """Interval (lower, upper) [SI] around `value`, one grid step to either side, within the bounds."""
        grid = np.sort(self.grid_values())
        if len(grid) < 2:
            return value, value
        i = int(np.clip(np.searchsorted(grid, value), 1, len(grid) - 1))
        below, above = float(grid[i - 1]), float(grid[i])
        lower = value * below / above if self.has_logarithmic_grid else value - (above - below)
        upper = value * above / below if self.has_logarithmic_grid else value + (above - below)
        return max(lower, min(self.lower_bound, value)), min(upper, max(self.upper_bound, value))


class Linearisation(NamedTuple):
    """Change of the readings by an effect for given values of its parameters, with the derivatives of this change."""

    reading_change: Floats
    """Change (n, 3) [m, rad, rad] of the raw readings of n pointings by the effect."""
    parameter_derivatives: Floats
    """Derivatives (n, 3, p) of the change of the readings in n pointings with respect to the p parameters of the
    effect."""
    geometry_derivatives: tuple[Floats, Floats] | None = None
    """Derivatives of the change of the readings of n pointings with respect to target coordinates (n, 3, 3) and to
    station motions (n, 3, 6).

    None if these derivatives are neglected, because the change is small compared with the distance.
    """


class LinearEffect(Protocol):
    """Interface of an effect: a change of the readings that is, at least to first order, linear in its parameters."""

    @property
    @abstractmethod
    def name(self) -> str:
        """Name of the effect, such as `beam-tilt`."""

    @property
    @abstractmethod
    def parameters(self) -> tuple[Parameter, ...]:
        """The p parameters of the effect. The `prior_sigma` of each is its value for a large but plausible effect."""

    @abstractmethod
    def design(self, sightings: Sightings) -> Floats:
        """Derivatives (n, 3, p) of the raw readings of n pointings with respect to the p parameters [SI].

        The readings are range [m], azimuth and elevation [rad].
        """

    @property
    def plausible_sizes(self) -> Floats:
        """Plausible sizes (p,) of the p parameters [SI]."""
        return np.array([p.prior_sigma for p in self.parameters], dtype=np.float64)

    @property
    def stations(self) -> tuple[str, ...]:
        """Names of the stations at which the effect acts; empty for all stations."""
        return ()

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the targets at which the effect acts; empty for all targets."""
        return ()

    def reading_change(self, sightings: Sightings, parameter_values: Floats) -> Floats:
        """Change (n, 3) [m, rad, rad] of the raw readings of n pointings for values (p,) [SI] of p parameters."""
        return self.design(sightings) @ parameter_values

    def linearise(self, sightings: Sightings, parameter_values: Floats) -> Linearisation:
        """Change of the readings of n pointings for the values (p,) [SI] of the p parameters, with its derivatives."""
        return Linearisation(self.reading_change(sightings, parameter_values), self.design(sightings))

    def gauge_design(self, first_targets: Ints, second_targets: Ints, points: Floats) -> Floats:
        """Derivatives (g, p) of g known lengths with respect to the p parameters.

        They are zero for effects that change only readings. `first_targets` and `second_targets` (g,) are the indices
        of the targets at the ends of the lengths. `points` (T, 3) [m] are the coordinates of all T targets.
        """
        return np.zeros((len(first_targets), len(self.parameters)))

    @property
    def place_text(self) -> str:
        """Names of the stations and targets where the effect acts, separated by commas; empty for all."""
        return ",".join(self.stations + self.targets)

    def pointing_indicator(self, sightings: Sightings) -> Floats:
        """Indicator (n,) of the pointings on which the effect acts: 1 for these, 0 for the others of n pointings."""
        acts = np.ones(len(sightings), dtype=bool)
        if self.stations:
            acts &= _has_permitted_name(sightings.station, sightings.station_indices_by_name, self.stations)
        if self.targets:
            acts &= _has_permitted_name(sightings.target, sightings.target_indices_by_name, self.targets)
        return acts.astype(np.float64)


def _has_permitted_name(
    name_indices: Ints, indices_by_name: Mapping[str, Sequence[int]], permitted_names: Sequence[str]
) -> Bools:
    """Mask (n,) of the station or target indices `name_indices` (n,) whose name is one of `permitted_names`.

    `indices_by_name` has the indices of the stations or targets with each name.
    """
    ids = [i for name in permitted_names for i in indices_by_name.get(name, ())]
    return name_indices == ids[0] if len(ids) == 1 else np.isin(name_indices, ids)


class CandidateEffect(LinearEffect, Protocol):
    """Interface of an effect that a diagnosis compares with other effects; it may have shape parameters."""

    shape_parameters: ClassVar[tuple[ShapeParameter, ...]] = ()
    """Shape parameters (period, time constant, onset time) of the effect; the value of each is a field of the
    instance."""
    n_neighbour_directions: ClassVar[int] = 1
    """Number of shape parameters or coordinates that `neighbours` varies independently of each other."""

    @property
    @abstractmethod
    def observables(self) -> tuple[str, ...]:
        """Observables that the effect changes: distance, azimuth, elevation."""

    @property
    @abstractmethod
    def covariates(self) -> tuple[str, ...]:
        """Names of the quantities on which the effect depends, such as `time` or `azimuth`."""

    def neighbours(self, sightings: Sightings) -> Sequence[Self]:
        """Copies of the effect with slightly changed shape parameters, which a local search tries."""
        return ()

    @property
    def region_centre(self) -> tuple[float, ...]:
        """Centre [m] of the region of the hall where the effect acts, in the network frame.

        Empty for an effect that is not confined to a region of the hall.
        """
        return ()

    @property
    def region_centre_axes(self) -> str:
        """Axes of the coordinates in `region_centre`, such as `xyz`, or `xy` for a vertical column."""
        return "xyz"[: len(self.region_centre)]

    def centred_at(self, centre: tuple[float, ...]) -> Self:
        """Copy of the effect whose region of the hall has its centre at `centre` [m].

        An effect without such a region is returned itself.
        """
        return self

    def with_shape_parameters(self, **constants: Any) -> Self:
        """Copy of the effect with other values of the given shape parameters, which are fields of the dataclass."""
        return replace(self, **constants)  # type: ignore[type-var]


class CandidateNoiseEffect(CandidateEffect, Protocol):
    """Interface of a change of the noise: its parameters are added variances or factors on variances.

    The mean of the readings does not change.
    """

    min_relative_size: ClassVar[float] = 0.0
    """Smallest permitted value of a parameter, divided by its prior standard deviation. With 0 the effect can only
    increase the noise."""

    @abstractmethod
    def variance(self, sightings: Sightings, sigma: Floats, parameter_values: Floats) -> Floats:
        """Variance (n, 3) of the readings of n pointings, from their declared standard deviations `sigma` (n, 3).

        `parameter_values` (p,) [SI] are the values of the p parameters. If all are zero, the variance must be sigma^2.
        Each reading must depend on at most one parameter.
        """

    def candidate_parameter_values(self) -> list[tuple[float, ...]]:
        """Parameter values [SI] that a diagnosis tries: six sizes of each parameter alone and of all together."""
        n_parameters = len(self.parameters)
        subsets = [*np.eye(n_parameters), *([np.ones(n_parameters)] if n_parameters > 1 else [])]
        return [
            tuple(size * subset * self.plausible_sizes)
            for subset in subsets
            for size in (0.05, 0.15, 0.4, 1.0, 3.0, 10.0)
        ]

    def design(self, sightings: Sightings) -> Floats:
        """Derivatives (n, 3, p) of the mean readings of n pointings with respect to the p parameters: zeros."""
        return np.zeros((len(sightings), 3, len(self.parameters)))


def design_from_front_face_corrections(
    sightings: Sightings,
    *,
    distance: Floats | float = 0.0,
    azimuth: Floats | float = 0.0,
    elevation: Floats | float = 0.0,
) -> Floats:
    """Change (n, 3) or (n, 3, p) of the raw readings of n pointings from corrections of readings reduced to face 1.

    `distance` [m], `azimuth` and `elevation` [rad] are corrections (true value minus reading), (n,), or their
    derivatives (n, p) with respect to p parameters. A reading changes by minus its correction. In face 2 the sign of
    the elevation is reversed, because the raw elevation decreases there.
    """
    corrections = [np.asarray(c, dtype=np.float64) for c in (distance, azimuth, elevation)]
    design = np.empty((len(sightings), 3, *max((c.shape[1:] for c in corrections), key=len)))
    for j, correction in enumerate(corrections):
        design[:, j] = -correction
    design[sightings.face == 2, 2] *= -1.0
    return design


def design_from_displacements(sightings: Sightings, displacement: Floats) -> Floats:
    """Derivatives (n, 3, p) of the readings of n pointings with respect to p parameters that displace targets.

    `displacement` (n, 3, p) [m] are the derivatives of the displacement of the target in each pointing.
    """
    acts = np.flatnonzero(displacement.any(axis=(1, 2)))
    if 2 * len(acts) > len(displacement):
        return sightings.target_derivatives @ displacement
    change = np.zeros(displacement.shape)
    change[acts] = sightings.target_derivatives[acts] @ displacement[acts]
    return change


def n_parameters_and_shape_parameters(effect: CandidateEffect) -> int:
    """Number of parameters of an effect plus the number of its shape parameters; a position counts as three."""
    constants = (value for name, value in vars(effect).items() if name != "plausible_size_factor")
    return len(effect.parameters) + sum(np.size(value) for value in constants if _is_number(value))


def _is_number(value: object) -> bool:
    """True for an integer or a float, False for a bool and any other type."""
    return isinstance(value, float) or (
        isinstance(value, tuple) and all(isinstance(v, float) for v in value) and value != ()
    )
