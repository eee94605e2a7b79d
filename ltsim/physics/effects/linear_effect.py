"""Linear effects: changes of the readings, linear in parameters that an adjustment estimates with the network.

`LinearEffect` is the interface that `MeasurementModel`, `NetworkProblem` and `ResidualSpace` use. A subclass defines
`name`, `parameters` and `design`. `CandidateEffect` adds the interface for a search that compares effects, and
`CandidateNoiseEffect` is a change of the variance of the readings. An effect of the catalogue (`effects.effect.Effect`)
is a `CandidateEffect` with a physical cause that has a name.

Sign: a parameter is a correction, true value - reading; the change of a reading is therefore its negative.
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
"""Quantity for which an instrument's specification states a standard deviation, the prior one of parameters."""


@dataclass(frozen=True)
class Parameter:
    """Parameter of an effect, with display unit, description and prior."""

    name: str
    unit: str
    """Display unit, a key of `units.SI_PER_UNIT`; values are in SI units."""
    description: str
    """Description for users, such as `delay of the range`."""
    prior_sigma: float
    """Prior standard deviation [SI] if the specification of the instrument gives none; also the plausible size of the
    parameter in a search."""
    specified_quantity: SpecifiedQuantity | None = None
    """Quantity of the instrument's specification whose standard deviation is the prior one, such as an angle.

    If None, the prior standard deviation is `prior_sigma`.
    """
    is_nonnegative: bool = False
    """True if the parameter is never negative, such as a thickness."""

    def prior_sigma_from(self, prior: Prior) -> float:
        """Prior standard deviation [SI] from the specification `prior`, or `prior_sigma` if it states none."""
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
    """Parameters `name-x`, `name-y` and `name-z` along or about the axes of the network frame, with the display `unit`.

    `description` is the description without the axis, `prior_sigma` the prior standard deviation [SI] of each.
    """
    return tuple(
        Parameter(f"{name}-{axis}", unit, f"{description} the network's {axis} axis", prior_sigma) for axis in "xyz"
    )


@dataclass(frozen=True)
class ShapeParameter:
    """Constant that enters an effect nonlinearly: a field of the effect, searched between bounds."""

    name: str
    """Name of the field of the effect."""
    unit: str
    """Display unit, a key of `units.SI_PER_UNIT`."""
    description: str
    """Description for users, such as `width of the transition`."""
    lower_bound: float
    """Smallest value [SI] of the search."""
    upper_bound: float
    """Largest value [SI] of the search."""
    has_logarithmic_grid: bool = False
    """True if the grid of the search is evenly spaced in the logarithm."""
    n_grid_values: int = 9
    """Number of values on the grid."""
    has_reciprocal_grid: bool = False
    """True if the grid of the search is evenly spaced in the reciprocal."""

    def grid_values(self) -> Floats:
        """Values (n_grid_values,) [SI] between the bounds that a search tries.

        They are evenly spaced in the value, in its logarithm (`has_logarithmic_grid`), or in its reciprocal
        (`has_reciprocal_grid`, as for a wavelength).
        """
        if self.has_reciprocal_grid:
            return 1.0 / np.linspace(1.0 / self.upper_bound, 1.0 / self.lower_bound, self.n_grid_values)
        if self.has_logarithmic_grid:
            return np.geomspace(self.lower_bound, self.upper_bound, self.n_grid_values)
        return np.linspace(self.lower_bound, self.upper_bound, self.n_grid_values)

    def neighbouring_grid_interval(self, value: float) -> tuple[float, float]:
        """Interval (lower, upper) [SI] from one grid step below `value` to one grid step above, within the bounds."""
        grid = np.sort(self.grid_values())
        if len(grid) < 2:
            return value, value
        i = int(np.clip(np.searchsorted(grid, value), 1, len(grid) - 1))
        below, above = float(grid[i - 1]), float(grid[i])
        lower = value * below / above if self.has_logarithmic_grid else value - (above - below)
        upper = value * above / below if self.has_logarithmic_grid else value + (above - below)
        return max(lower, min(self.lower_bound, value)), min(upper, max(self.upper_bound, value))


class Linearisation(NamedTuple):
    """Change of the readings by an effect at given parameter values, with its derivatives."""

    reading_change: Floats
    """Change (n, 3) of the raw readings of n pointings."""
    parameter_derivatives: Floats
    """Derivative (n, 3, p) of the change of the readings of n pointings with respect to the p parameters."""
    geometry_derivatives: tuple[Floats, Floats] | None = None
    """Derivatives of the change in n pointings by target coordinates (n, 3, 3) and station motion (n, 3, 6).

    None if these derivatives are neglected, as for all changes that are small compared with the distance.
    """


class LinearEffect(Protocol):
    """Interface of a change of the readings that is linear in its parameters, at least to first order."""

    @property
    @abstractmethod
    def name(self) -> str:
        """Name of the effect, such as `beam-tilt`."""

    @property
    @abstractmethod
    def parameters(self) -> tuple[Parameter, ...]:
        """The p parameters of the effect; the `prior_sigma` of each is the value for a large but plausible effect."""

    @abstractmethod
    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, p) of the raw readings of n pointings per unit of each of p parameters.

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
        """Change (n, 3) of the raw readings of n pointings for the values (p,) [SI] of the p parameters."""
        return self.design(sightings) @ parameter_values

    def linearise(self, sightings: Sightings, parameter_values: Floats) -> Linearisation:
        """Change of the readings at the values (p,) [SI] of the p parameters, with its derivatives."""
        return Linearisation(self.reading_change(sightings, parameter_values), self.design(sightings))

    def gauge_design(self, first_targets: Ints, second_targets: Ints, points: Floats) -> Floats:
        """Change (g, p) [m] of g reference lengths per unit of each of p parameters.

        It is zero unless the effect changes lengths. `first_targets` and `second_targets` (g,) are the indices of the
        targets at the ends of the lengths, `points` (T, 3) [m] are the coordinates of all T targets.
        """
        return np.zeros((len(first_targets), len(self.parameters)))

    @property
    def place_text(self) -> str:
        """Names of the stations and targets at which the effect acts, separated by commas; empty if it acts at all."""
        return ",".join(self.stations + self.targets)

    def pointing_indicator(self, sightings: Sightings) -> Floats:
        """Indicator (n,) of n pointings: 1 for pointings whose readings the effect changes, 0 for others."""
        acts = np.ones(len(sightings), dtype=bool)
        if self.stations:
            acts &= _has_permitted_name(sightings.station, sightings.station_indices_by_name, self.stations)
        if self.targets:
            acts &= _has_permitted_name(sightings.target, sightings.target_indices_by_name, self.targets)
        return acts.astype(np.float64)


def _has_permitted_name(
    name_indices: Ints, indices_by_name: Mapping[str, Sequence[int]], permitted_names: Sequence[str]
) -> Bools:
    """Flags (n,) of the n station or target indices `name_indices` (n,) whose name is one of `permitted_names`.

    `indices_by_name` has the indices that belong to each name.
    """
    ids = [i for name in permitted_names for i in indices_by_name.get(name, ())]
    return name_indices == ids[0] if len(ids) == 1 else np.isin(name_indices, ids)


class CandidateEffect(LinearEffect, Protocol):
    """Interface of an effect that a search compares with other candidates; it may have nonlinear constants."""

    shape_parameters: ClassVar[tuple[ShapeParameter, ...]] = ()
    """Constants on which the effect depends nonlinearly; each is a field of the instance."""
    n_neighbour_directions: ClassVar[int] = 1
    """Number of constants, or of coordinates, that `neighbours` varies independently of each other."""

    @property
    @abstractmethod
    def observables(self) -> tuple[str, ...]:
        """Observables that the effect changes: distance, azimuth, elevation."""

    @property
    @abstractmethod
    def covariates(self) -> tuple[str, ...]:
        """Names of the quantities on which the effect depends, such as `time` or `azimuth`."""

    def neighbours(self, sightings: Sightings) -> Sequence[Self]:
        """Similar effects, with slightly changed constants, that a search tries if this effect is significant."""
        return ()

    @property
    def region_centre(self) -> tuple[float, ...]:
        """Coordinates [m] of the centre of the region of the hall where the effect acts, network frame.

        Empty for an effect that is not confined to a region.
        """
        return ()

    @property
    def region_centre_axes(self) -> str:
        """Axes of the coordinates of `region_centre`, such as `xyz`."""
        return "xyz"[: len(self.region_centre)]

    def centred_at(self, centre: tuple[float, ...]) -> Self:
        """Copy of the effect with its region of the hall centred at `centre` [m]; the effect itself if it has none."""
        return self

    def with_constants(self, **constants: Any) -> Self:
        """Copy of the effect with other values of its constants, which are fields of the dataclass."""
        return replace(self, **constants)  # type: ignore[type-var]


class CandidateNoiseEffect(CandidateEffect, Protocol):
    """Change of the noise of readings: its parameters are added variances or factors on variances.

    The mean of the readings does not change.
    """

    min_relative_size: ClassVar[float] = 0.0
    """Smallest permitted value of a parameter, divided by its prior standard deviation. With 0 the effect can only
    increase the noise."""

    @abstractmethod
    def variance(self, sightings: Sightings, sigma: Floats, parameter_values: Floats) -> Floats:
        """Variance (n, 3) of the readings of n pointings with the declared standard deviations `sigma` (n, 3).

        `parameter_values` (p,) [SI] are the values of the p parameters. The variance must be sigma^2 if all are zero,
        and each reading must depend on at most one parameter.
        """

    def candidate_parameter_values(self) -> list[tuple[float, ...]]:
        """Parameter values [SI] that a diagnosis tries: each parameter alone and all together, in several sizes."""
        n_parameters = len(self.parameters)
        subsets = [*np.eye(n_parameters), *([np.ones(n_parameters)] if n_parameters > 1 else [])]
        return [
            tuple(size * subset * self.plausible_sizes)
            for subset in subsets
            for size in (0.05, 0.15, 0.4, 1.0, 3.0, 10.0)
        ]

    def design(self, sightings: Sightings) -> Floats:
        """Change of the mean of the readings of n pointings per unit of each of p parameters: zeros (n, 3, p)."""
        return np.zeros((len(sightings), 3, len(self.parameters)))


def design_from_front_face_corrections(
    sightings: Sightings,
    *,
    distance: Floats | float = 0.0,
    azimuth: Floats | float = 0.0,
    elevation: Floats | float = 0.0,
) -> Floats:
    """Change (n, 3) or (n, 3, p) of raw readings of n pointings from corrections (n,) or (n, p) of front-face readings.

    `distance` [m], `azimuth` and `elevation` [rad] are corrections, true value minus reading, or their values for each
    of p parameters. A reading changes by minus its correction. On the back face the sign of the elevation is reversed,
    because its raw value decreases.
    """
    corrections = [np.asarray(c, dtype=np.float64) for c in (distance, azimuth, elevation)]
    design = np.empty((len(sightings), 3, *max((c.shape[1:] for c in corrections), key=len)))
    for j, correction in enumerate(corrections):
        design[:, j] = -correction
    design[sightings.face == 2, 2] *= -1.0
    return design


def design_from_displacements(sightings: Sightings, displacement: Floats) -> Floats:
    """Change (n, 3, p) of the readings of n pointings by displacements (n, 3, p) [m] of targets by p parameters."""
    acts = np.flatnonzero(displacement.any(axis=(1, 2)))
    if 2 * len(acts) > len(displacement):
        return sightings.target_derivatives @ displacement
    change = np.zeros(displacement.shape)
    change[acts] = sightings.target_derivatives[acts] @ displacement[acts]
    return change


def n_parameters_and_constants(effect: CandidateEffect) -> int:
    """Number of parameters of an effect plus the number of constants (of shape and position) among its fields."""
    constants = (value for name, value in vars(effect).items() if name != "plausible_size_factor")
    return len(effect.parameters) + sum(np.size(value) for value in constants if _is_number(value))


def _is_number(value: object) -> bool:
    return isinstance(value, float) or (
        isinstance(value, tuple) and all(isinstance(v, float) for v in value) and value != ()
    )
