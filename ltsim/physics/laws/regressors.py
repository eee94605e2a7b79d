"""Regressors: functions of covariates (quantities of a pointing, such as its time) on which an error may depend.

A regressor has k columns in the design matrix, and a prior of their k coefficients.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.physics.laws.accumulations import accumulation_column, latch_column as latched
from ltsim.physics.laws.columns import (
    CIRCULAR_COVARIATES,
    MEMORY_COVARIATE_PREFIXES,
    N_CURVE_MODES,
    N_HARMONICS_OF_CYCLE,
    first_order_lag_columns,
    fourier_columns,
    function_column,
    group_means,
    has_natural_zero,
    indicator_columns,
    lagged_values,
    polynomial_field_columns,
    scaled_to_unit_rms,
    smooth_curve_columns,
    smooth_curve_sigmas,
)
from ltsim.scene.regions import HallRegion
from ltsim.scene.sightings import Sightings

CLOCK_COVARIATES = ("time", "station-time")
"""Names of the covariates that are times."""
COVARIATE_NAMES_IN_FILES = {
    "station": "place",
    "x": "place",
    "y": "place",
    "z": "place",
    "station-time": "time",
    "repeat": "time",
    "count": "time",
    "parity": "approach",
    "seating-parity": "approach",
    "bearing": "azimuth",
    "circle": "azimuth",
    "vertical-circle": "elevation",
    "nest-direction": "incidence",
    "air_temperature_c": "temperature",
}
"""Names of covariates in files by their names in this package, if both names differ."""


MEMORY_OPERATOR_INPUT_COVARIATES = ("azimuth", "elevation", "distance", "target")
"""Names of covariates whose value at the previous pointing, and whose change since then, are covariates too."""


def name_without_memory_prefix(covariate: str) -> str:
    """Name of a covariate without a prefix that refers to earlier pointings, such as `azimuth` for `last-azimuth`."""
    how, _, base = covariate.partition("-")
    return base if base and f"{how}-" in MEMORY_COVARIATE_PREFIXES else covariate


def covariate_names_in_files(covariates: Iterable[str]) -> tuple[str, ...]:
    """Names, in files, of the given covariates; `approach` stands for all that depend on earlier motions."""
    memory = {
        name
        for name in covariates
        if name == "lapse"
        or (
            name_without_memory_prefix(name) != name
            and name_without_memory_prefix(name) in MEMORY_OPERATOR_INPUT_COVARIATES
        )
    }
    return tuple(
        dict.fromkeys(
            "approach"
            if n in memory
            else COVARIATE_NAMES_IN_FILES.get(name_without_memory_prefix(n), name_without_memory_prefix(n))
            for n in covariates
        )
    )


@dataclass(frozen=True)
class Regressor:
    """Regressor: a function of covariates (such as the time) to which an unknown error is proportional.

    The kinds of functions are:

    - `constant`: 1 at every pointing.
    - `smooth`: a curve in a covariate, made of eigenfunctions.
    - `wave`: cosine and sine of `constant` times a covariate. `cycle`: a periodic function of any shape.
    - `simple`: a formula with one covariate and at most one constant.
    - `product`: the product of other regressors.
    - `pieces`: a sum of steps and ramps of one covariate.
    - `switch`: 1 and 0 alternately, with changes at steps of one covariate.
    - `lagging`: a covariate after a first-order lag.
    - `amounts`: a separate value for each station, instrument, target or previous target.
    - `field`: a constant and a linear or quadratic function of the position in the hall.
    - `passage`: the length of the line of sight in a region of the hall. With the function `lever` each part of this
      length is weighted by the fraction of the line beyond it.
    - `near`: 1 for a target at the centre of a region, decreasing with the distance of the target.
    - `state`: an accumulated quantity, which decays or is reset (`laws.accumulations`).
    - `latch`: 1 after a covariate rose above the threshold `constant`, 0 after it fell below `release_threshold`.
    """

    kind: str
    """Kind of the function, such as `smooth`, `wave`, `product` or `amounts`."""
    covariates: tuple[str, ...] = ()
    """Names of the covariates (quantities of a pointing) of the function."""
    function: str = ""
    """Name of the function, for the kinds `simple`, `state` and `passage`."""
    constant: float = 0.0
    """Constant of the function, for the kinds `simple`, `wave`, `cycle`, `state` and `latch`. Time constant [s] of a
    lag, also of a switch (0 for no lag).

    For other kinds it is a number: of eigenfunctions of a curve, of separate values, or of steps and ramps; for a field
    it is the order of the polynomial.
    """
    factors: tuple[Regressor, ...] = ()
    """Regressors that compose this one: factors of a product, steps and ramps of a sum, or steps of a switch."""
    field_or_amount_targets: tuple[str, ...] = ()
    """Names of targets: for a polynomial of the position (`field`) those whose mean position is its origin, for
    separate values (`amounts`) those with a value; empty for all."""
    region: HallRegion | None = None
    """Region of the hall of a `passage` or `near` regressor; None for other kinds."""
    release_threshold: float = 0.0
    """Value of the covariate below which a latch changes from 1 to 0."""

    def columns(self, sightings: Sightings, *, acts_on_targets: bool = False) -> Floats:
        """Columns (n, k) of the regressor in the design matrix, for n pointings, each with an rms of about one.

        A law describes an error as a function of covariates. If the law moves targets (`acts_on_targets`), the columns
        are relative to the pointings at which the targets have their declared coordinates: those at the start of the
        measurement, or those at which the additional column of the recording is zero. Without such pointings each
        column has zero mean.
        """
        columns = self._unreduced_columns(sightings, acts_on_targets)
        if not acts_on_targets or self.kind in ("constant", "field", "amounts", "product"):
            return columns
        columns = columns - columns[self._is_at_declared_coordinates(sightings)].mean(axis=0)
        return scaled_to_unit_rms(columns) if self.kind == "simple" else columns

    def _is_at_declared_coordinates(self, sightings: Sightings) -> Bools:
        """Mask (n,) of the pointings at which moving targets have their declared coordinates.

        The pointings are those at the start of the measurement, or those at which the additional column is zero.
        """
        full_mask = np.ones(len(sightings), dtype=bool)
        name = "".join(self.covariates)
        if name == "time" and self.kind in ("simple", "pieces"):
            return np.asarray(sightings.time == sightings.time.min())
        x = np.abs(sightings.covariates.get(name, full_mask))
        return x == np.nanmin(x) if has_natural_zero(x) else full_mask

    def _unreduced_columns(self, sightings: Sightings, acts_on_targets: bool) -> Floats:
        """Columns (n, k) of the regressor for n pointings, without subtraction of reference values."""
        name = "".join(self.covariates[:1])
        if self.region is not None:
            return scaled_to_unit_rms(self._region_column(self.region, sightings)[:, None])
        match self.kind:
            case "constant":
                return np.ones((len(sightings), 1))
            case "smooth":
                return smooth_curve_columns(name, sightings.covariate_values[name], int(self.constant))
            case "wave" | "cycle":
                return fourier_columns(self.constant * sightings.covariate_values[name], self.n_columns // 2)
            case "field":
                return polynomial_field_columns(
                    sightings, self.covariates, self.field_or_amount_targets, is_quadratic=self.constant > 1
                )
            case "simple":
                return function_column(sightings, name, self.function, self.constant)
            case "state" | "latch":
                return scaled_to_unit_rms(self._accumulation_or_latch_column(sightings, name)[:, None])
            case "lagging":
                return first_order_lag_columns(sightings, name, self.constant)
            case "amounts":
                return indicator_columns(*self._group_indices(sightings))
            case "switch":
                edges = [factor.constant for factor in self.factors]
                on = np.searchsorted(edges, sightings.covariate_values[name]) % 2
                values = lagged_values(on.astype(np.float64), sightings, self.constant) if self.constant else on
                return scaled_to_unit_rms(values.astype(np.float64)[:, None])
            case "pieces":
                return np.hstack([factor.columns(sightings) for factor in self.factors])
        return self._product_columns(sightings, acts_on_targets)

    def _accumulation_or_latch_column(self, sightings: Sightings, name: str) -> Floats:
        """Values (n,) in n pointings of an accumulated quantity or a latch, minus their mean.

        An accumulated quantity is the sum of the changes of a covariate over the pointings. A latch is on once a
        covariate exceeds a threshold, and off once it is below a lower one.
        """
        if self.kind == "latch":
            return latched(sightings, name, self.constant, self.release_threshold)
        return accumulation_column(sightings, name, self.function, self.constant)

    def _region_column(self, region: HallRegion, sightings: Sightings) -> Floats:
        """Values (n,) in n pointings of a regressor that depends on a `region` of the hall.

        For the kind `passage` they are the length [m] of the line of sight in the region, with the function
        `DEFLECTION_FUNCTION` weighted by the lever (fraction of the line beyond a point). For the kind `near` they are
        the weight of the region at the target.
        """
        if self.kind == "near":
            return region.target_weights(sightings)
        return (
            region.lever_weighted_path_lengths(sightings)
            if self.function == DEFLECTION_FUNCTION
            else region.path_lengths(sightings)
        )

    def _group_indices(self, sightings: Sightings) -> tuple[Ints, Ints]:
        """Index (n,) of the group of each of n pointings, and indices (k,) of the k groups with a separate value.

        Groups are stations, instruments, targets or previous targets.
        """
        if self.covariates == ("station",):
            return sightings.station, np.unique(sightings.station)
        if self.covariates == ("instrument",):
            return sightings.instrument, np.unique(sightings.instrument)
        all_targets = np.arange(len(sightings.target_names))
        if self.covariates == ("last-target",):
            return np.where(
                sightings.previous_pointing_indices >= 0, sightings.target[sightings.previous_pointing_indices], -1
            ), all_targets
        ids = [sightings.target_names.index(name) for name in self.field_or_amount_targets]
        return sightings.target, np.array(ids) if ids else all_targets

    def _product_columns(self, sightings: Sightings, acts_on_targets: bool) -> Floats:
        """Columns (n, k) of a product for n pointings: all products of one column of each factor."""
        product = np.ones((len(sightings), 1))
        for factor in self.factors:
            part = factor.columns(sightings, acts_on_targets=acts_on_targets)
            if factor.kind == "smooth" and self.has_curve_per_instrument:
                part = part - group_means(part, sightings.instrument)
            elif factor.kind == "smooth":
                part = np.hstack([np.ones((len(part), 1)), part])
            product = (product[:, :, None] * part[:, None, :]).reshape(len(sightings), -1)
        return scaled_to_unit_rms(product) if self.hall_region and product.shape[1] == 1 else product

    @property
    def has_curve_per_instrument(self) -> bool:
        """True if each instrument has a separate curve with a mean of zero.

        The ordinary calibration of each instrument already contains the mean of its curve.
        """
        return any(factor.covariates == ("instrument",) for factor in self.factors)

    @cached_property
    def coefficient_sigmas(self) -> tuple[Floats, ...]:
        """Prior standard deviations (k,) of the k coefficients, as a tuple; a curve has one array per length scale."""
        match self.kind:
            case "constant" | "simple" | "passage" | "near" | "state" | "latch" | "switch":
                return (np.ones(1),)
            case "wave" | "lagging":
                return (np.full(2, np.sqrt(0.5)),)
            case "amounts" | "pieces":
                return (np.ones(int(self.constant)),)
            case "cycle":
                return (np.repeat(1.0 / np.arange(1, N_HARMONICS_OF_CYCLE + 1), 2) / np.sqrt(2.0),)
            case "field":
                spread = np.concatenate([np.ones(4), np.full(6 if self.constant > 1 else 0, 0.5)])
                return (spread / np.linalg.norm(spread),)
            case "smooth":
                return smooth_curve_sigmas(self.covariates[0] in CIRCULAR_COVARIATES, int(self.constant))
        spread = np.ones(1)
        for factor in self.factors:
            part = factor.coefficient_sigmas[0]
            part = np.append(1.0, part) if factor.kind == "smooth" and not self.has_curve_per_instrument else part
            spread = np.outer(spread, part / np.linalg.norm(part)).ravel()
        return (spread,)

    @property
    def hall_region(self) -> HallRegion | None:
        """Region of the hall of the regressor or of one of its factors; None without a region."""
        return next((f.region for f in (self, *self.factors) if f.region is not None), None)

    def with_region(self, region: HallRegion) -> Regressor:
        """Copy of the regressor with another region of the hall, also in its factors."""
        if self.region is None:
            factors = tuple(f.with_region(region) if f.region is not None else f for f in self.factors)
            return replace(self, factors=factors)
        return replace(self, region=region, covariates=tuple(region.bounded_axes))

    def with_field_centred_on(self, targets: tuple[str, ...]) -> Regressor:
        """Copy of the regressor with the mean position of `targets` as origin of its polynomial of the position."""
        if all(f.kind != "field" for f in self.factors):
            return self
        factors = tuple(replace(f, field_or_amount_targets=targets) if f.kind == "field" else f for f in self.factors)
        return replace(self, factors=factors)

    def with_amount_per_target(self, targets: tuple[str, ...]) -> Regressor:
        """Product of this regressor, without a polynomial of the position (`field`), and a value per target.

        `targets` are the names of the targets with a separate value.
        """
        other_factors = [f for f in self.factors or (self,) if f.kind != "field"]
        separate_amounts = group_amounts_regressor("target", len(targets), targets)
        return Regressor("product", factors=(*other_factors, separate_amounts))

    @property
    def n_columns(self) -> int:
        """Number k of columns of the regressor in the design matrix."""
        return len(self.coefficient_sigmas[0])

    @property
    def covariate_names_in_files(self) -> tuple[str, ...]:
        """Names of the regressor's covariates as they are written to files."""
        names = [*self.covariates, *(name for factor in self.factors for name in factor.covariates)]
        return covariate_names_in_files(names)


CONSTANT_REGRESSOR = Regressor("constant")
"""Regressor with the value 1 at every pointing."""
COORDINATE_COVARIATES = ("x", "y", "z")
"""Names of the covariates that are coordinates of the target."""


def with_position_dependence(regressors: Sequence[Regressor], polynomial_order: int) -> list[Regressor]:
    """Products of each regressor with a polynomial of the position, so that its size varies across the hall.

    The polynomial is linear for `polynomial_order` 1 and quadratic for 2.
    """
    field = Regressor("field", COORDINATE_COVARIATES, constant=polynomial_order)
    return [Regressor("product", factors=(regressor, field)) for regressor in regressors]


def scalar_regressor(covariate: str, function: str, constant: float = 1.0) -> Regressor:
    """Regressor with one column: the function `function` (such as a key of `FORMULA_FUNCTIONS`) of one covariate."""
    return Regressor("simple", (covariate,), function, constant)


DEFLECTION_FUNCTION = "lever"
"""Name of the function of a `passage` regressor for a region of the hall that deflects lines of sight. A deflection
at a point moves the end of the line in proportion to the length beyond the point. The measured direction thus
changes by the deflection times the fraction of the line beyond the point (lever)."""


def path_length_regressor(region: HallRegion, function: str = "") -> Regressor:
    """Regressor with the length of the line of sight in a region of the hall.

    With the function `DEFLECTION_FUNCTION` each part of this length is weighted by the fraction of the line beyond it.
    """
    return Regressor("passage", tuple(region.bounded_axes), function, region=region)


def nearness_regressor(region: HallRegion) -> Regressor:
    """Regressor that is 1 for a target at the centre of a region and decreases with the distance from the centre."""
    return Regressor("near", tuple(region.bounded_axes), region=region)


def accumulation_regressor(covariate: str, function: str, constant: float) -> Regressor:
    """Regressor that is an accumulated quantity: the sum of the changes of a covariate since the start of the set-up.

    `function` is the name of the decay or reset of the sum, and `constant` its constant (`laws.accumulations`).
    """
    return Regressor("state", (covariate,), function, constant)


def latch_regressor(covariate: str, set_threshold: float, release_threshold: float) -> Regressor:
    """Regressor that is 1 once a covariate exceeds `set_threshold`, and 0 once it is below `release_threshold`."""
    return Regressor("latch", (covariate,), constant=set_threshold, release_threshold=release_threshold)


def group_amounts_regressor(group_kind: str, n_groups: int, targets: tuple[str, ...] = ()) -> Regressor:
    """Regressor with a separate value for each of `n_groups` groups.

    `group_kind` is `station`, `instrument`, `target` or `last-target` (target of the previous pointing). If `targets`
    is given, only these targets have a value.
    """
    return Regressor("amounts", (group_kind,), constant=n_groups, field_or_amount_targets=targets)


def piecewise_regressor(steps: Sequence[Regressor]) -> Regressor:
    """Regressor that is a sum of steps and ramps of one covariate, each with a separate coefficient."""
    return Regressor("pieces", steps[0].covariates, constant=len(steps), factors=tuple(steps))


def switch_regressor(edge_regressors: Sequence[Regressor]) -> Regressor:
    """Regressor that is 1 after the first of the steps `edge_regressors`, 0 after the second, and so on in turn."""
    return Regressor("switch", edge_regressors[0].covariates, factors=tuple(edge_regressors))


def smooth_regressor(covariate: str, n_modes: int = N_CURVE_MODES) -> Regressor:
    """Regressor that is a smooth curve (Gaussian process) in a covariate, with `n_modes` eigenfunctions."""
    return Regressor("smooth", (covariate,), constant=n_modes)
