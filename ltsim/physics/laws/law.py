"""Empirical law: a change of a reading or instrument constant that is a function of a regressor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.physics.effects.linear_effect import CandidateEffect, Parameter
from ltsim.physics.laws.accumulations import FIXED_COUNT_RESET_FUNCTION, POINTING_DECAY_FUNCTION, TIME_DECAY_FUNCTION
from ltsim.physics.laws.columns import N_CURVE_MODES, N_FINER_CURVE_MODES, N_PRODUCT_CURVE_MODES, indicator_columns
from ltsim.physics.laws.formula_regressors import formula_regressors
from ltsim.physics.laws.places import MIN_GROUP_TARGETS
from ltsim.physics.laws.regressor_library import (
    CANDIDATE_LAG_TIME_CONSTANTS,
    MAX_SEPARATE_AMOUNTS,
    WAVE_FREQUENCY_STEP,
    contains_several_targets,
)
from ltsim.physics.laws.regressors import (
    CLOCK_COVARIATES,
    CONSTANT_REGRESSOR,
    Regressor,
    piecewise_regressor,
    scalar_regressor,
    smooth_regressor,
    switch_regressor,
)
from ltsim.physics.laws.responses import RESPONSE_AND_DESIGN_BY_NAME, Response
from ltsim.recordings.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings

FACE_SIGN_REGRESSOR = scalar_regressor("face", "power")
"""Regressor (function of covariates) with +1 in face 1, -1 in face 2. An elevation error proportional to this regressor
is an error of the vertical index."""
MAX_CANDIDATE_STEP_POSITIONS = 41
"""Largest number of positions (values of a covariate) that a diagnosis tries for a step or ramp of an error law."""
PARTS_SEPARATE_BY_SETUP = ("reading", "instrument", "circle", "stand")
"""Parts of the measurement (`Response.changed_part`) whose errors may have separate coefficients in each set-up."""
MAX_CANDIDATE_SWITCH_EDGES = 60
"""Largest number of values of a covariate that a diagnosis tries for turning an error on or off."""
MAX_STEPS_IN_MOVED_LAW = 4
"""Largest number of steps and ramps of an error law whose positions a local search varies; each costs time."""
MAX_STEP_MOVE_GAPS = 6
"""Largest number of gaps between values of the covariate by which a local search moves a step or ramp, and smallest
number of gaps between two steps (a few pointings do not determine the size of a step)."""
FUNCTIONS_WITH_SCALED_CONSTANT = (
    *("decay", "fading", "relaxing", "saturated", "lagging", "hysteresis", "saw", "slack", "within", "stuck"),
    *(TIME_DECAY_FUNCTION, POINTING_DECAY_FUNCTION),
)
"""Names of functions, and kinds of regressors (functions of covariates), with a positive constant that a local search
multiplies by factors from 0.6 to 1.7."""
LATCH_THRESHOLD_SHIFT_FRACTIONS = np.array([-0.06, -0.02, 0.02, 0.06])
"""Shifts of the on and off thresholds of a latch in a local search, as fractions of the span of the covariate."""


@dataclass(frozen=True)
class EmpiricalLaw(CandidateEffect):
    """Empirical law: a change of one quantity of the measurement (the response) as a function of covariates."""

    stations: tuple[str, ...] = ()
    """Names of the stations at which the law acts; empty for all."""
    targets: tuple[str, ...] = ()
    """Names of the targets at which the law acts; empty for all."""
    response: Response = RESPONSE_AND_DESIGN_BY_NAME["distance"][0]
    """Response: quantity of the measurement, such as the vertical index, that the law changes."""
    regressor: Regressor = CONSTANT_REGRESSOR
    """Regressor: function of covariates, such as a wave in time, to which the change is proportional."""
    instruments: tuple[str, ...] = ()
    """Names of the instruments at which the law acts; empty for all."""
    length_scale_index: int = 0
    """Index of the length scale of the smooth curve of the regressor (function of covariates), which selects the prior
    in `Regressor.coefficient_sigmas`."""
    has_coefficients_per_setup: bool = False
    """True if the law has separate coefficients for each set-up."""
    component_ratio: tuple[float, ...] = ()
    """Fixed ratio of the c components of the changed quantity, as a unit vector (c,); empty if each component has
    separate coefficients.

    With a fixed ratio all components have the same coefficients. If the law is separate for S set-ups, the ratio has c
    S elements.
    """

    name = "unknown"

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Coefficients with priors, one per component of the changed quantity and column of the function."""
        spread = self.regressor.coefficient_sigmas[self.length_scale_index] * self.response.plausible_size
        n, unit = self.n_setup_components, self.response.display_unit
        spreads = spread * np.sqrt(n) if self.component_ratio else np.tile(spread, n)
        return tuple(Parameter(f"coefficient {i}", unit, "coefficient", float(s)) for i, s in enumerate(spreads, 1))

    @property
    def n_setup_components(self) -> int:
        """Number of components of the changed quantity times the number of set-ups with separate coefficients."""
        return len(self.response.component_names) * (len(self.stations) if self.has_coefficients_per_setup else 1)

    @property
    def observables(self) -> tuple[str, ...]:
        """Names of the observables that the law changes."""
        return self.response.observables or OBSERVABLES

    @property
    def covariates(self) -> tuple[str, ...]:
        """Names of the law's covariates as they are written to files."""
        return self.regressor.covariate_names_in_files

    def design(self, sightings: Sightings) -> Floats:
        """Derivatives (n, 3, k) of the raw readings of n pointings with respect to the k coefficients of the law."""
        _, response_design = RESPONSE_AND_DESIGN_BY_NAME[self.response.name]
        derivatives = self.change_by_common_coefficient(response_design(sightings), sightings)
        design: Floats = derivatives[:, :, :, None] * self.columns(sightings)[:, None, None, :]
        return design.reshape(len(sightings), 3, -1)

    def change_by_common_coefficient(
        self, component_changes: Floats, sightings: Sightings, rows: Ints | None = None
    ) -> Floats:
        """Derivatives (r, ..., 1) of the readings of r pointings by the common coefficient of all components.

        `component_changes` (r, ..., c) are the derivatives with respect to each of c components, which
        `component_ratio` combines; a law without a fixed ratio returns them unchanged. `rows` (r,) are the indices of
        the pointings, by default all.
        """
        if not self.component_ratio:
            return component_changes
        ratios = np.reshape(self.component_ratio, (len(self.response.component_names), -1)).T
        if self.has_coefficients_per_setup:
            position = np.full(len(sightings.station_names), -1)
            position[[sightings.station_names.index(name) for name in self.stations]] = np.arange(len(self.stations))
            which = position[sightings.station if rows is None else sightings.station[rows]]
            ratios = np.where(which[:, None] >= 0, ratios[which], 0.0)
        along: Floats = np.einsum(
            "r...c,rc->r...", component_changes, np.broadcast_to(ratios, (len(component_changes), ratios.shape[1]))
        )
        return along[..., None]

    def columns(self, sightings: Sightings) -> Floats:
        """Values (n, k) of the k functions of covariates in n pointings, zero at places where the law does not act.

        If S set-ups have separate coefficients and no fixed `component_ratio`, the shape is (n, S k).
        """
        columns = self.regressor.columns(sightings, acts_on_targets=self.response.changed_part == "target")
        columns = columns * self.pointing_indicator(sightings)[:, None]
        if not self.has_coefficients_per_setup or self.component_ratio:
            return columns
        setup_indices = [sightings.station_names.index(name) for name in self.stations]
        is_at_setup = indicator_columns(sightings.station, setup_indices)
        return (is_at_setup[:, :, None] * columns[:, None, :]).reshape(len(sightings), -1)

    @property
    def depends_on_permanent_region(self) -> bool:
        """True if the law depends on a region of the hall that acts during the whole measurement."""
        return self.regressor.region is not None

    def without_time_limit(self) -> EmpiricalLaw:
        """Copy of a law in a region of the hall without a time limit; other laws are returned unchanged."""
        first, *others = self.regressor.factors or (self.regressor,)
        gated = first.region is not None and [f.kind for f in others] == ["switch"]
        return replace(self, regressor=first) if gated else self

    @property
    def region_centre(self) -> tuple[float, ...]:
        """Centre [m] of the region of the hall on which the law depends; empty for a law without region."""
        return self.regressor.hall_region.centre if self.regressor.hall_region else ()

    @property
    def region_centre_axes(self) -> str:
        """Axes of the coordinates in `region_centre`, such as `xy`."""
        return self.regressor.hall_region.bounded_axes if self.regressor.hall_region else ""

    def centred_at(self, centre: tuple[float, ...]) -> EmpiricalLaw:
        """Copy of the law whose region of the hall has its centre at `centre` [m]."""
        region = self.regressor.hall_region
        if region is None:
            return self
        return replace(self, regressor=self.regressor.with_region(replace(region, centre=centre)))

    def neighbours(self, sightings: Sightings) -> list[EmpiricalLaw]:
        """Copies of the law that a local search tries, each with one slightly changed constant, step or region."""
        regressor = self.regressor
        if regressor.kind in ("wave", "cycle"):
            step = 2 * np.pi * WAVE_FREQUENCY_STEP / float(np.ptp(sightings.covariate_values[regressor.covariates[0]]))
            rates = regressor.constant + step * np.linspace(-0.9, 0.9, 19)
            return [replace(self, regressor=replace(regressor, constant=float(r))) for r in rates if r > 0]
        if self._steps_or_switch_to_move is not None:
            return self._with_moved_steps(sightings, self._steps_or_switch_to_move)
        if regressor.hall_region is not None:
            is_near = any(f.kind == "near" for f in (regressor, *regressor.factors))
            neighbours = [
                r
                for r in regressor.hall_region.local_search_variants()
                if not is_near or contains_several_targets(r, sightings)
            ]
            return [replace(self, regressor=regressor.with_region(region)) for region in neighbours]
        if regressor.function in FUNCTIONS_WITH_SCALED_CONSTANT or regressor.kind in FUNCTIONS_WITH_SCALED_CONSTANT:
            sizes = [regressor.constant * scale for scale in (0.6, 0.8, 1.25, 1.7)]
            return [replace(self, regressor=replace(regressor, constant=size)) for size in sizes]
        if regressor.kind == "latch":
            return self._with_moved_thresholds(sightings)
        if regressor.function == FIXED_COUNT_RESET_FUNCTION:
            return [replace(self, regressor=replace(regressor, constant=regressor.constant + k)) for k in (-1.0, 1.0)]
        return []

    def _with_moved_thresholds(self, sightings: Sightings) -> list[EmpiricalLaw]:
        """Copies of the law with a slightly changed threshold of its latch (on above one, off below the other)."""
        regressor = self.regressor
        steps = np.ptp(sightings.covariate_values[regressor.covariates[0]]) * LATCH_THRESHOLD_SHIFT_FRACTIONS
        neighbours = [replace(regressor, constant=regressor.constant + float(step)) for step in steps]
        neighbours += [replace(regressor, release_threshold=regressor.release_threshold + float(s)) for s in steps]
        return [replace(self, regressor=d) for d in neighbours if d.release_threshold < d.constant]

    @property
    def _steps_or_switch_to_move(self) -> Regressor | None:
        """Steps, ramps or a switch (on, off) that a local search moves; None without them, or for a law of a region."""
        step_factors = [f for f in (self.regressor, *self.regressor.factors) if f.kind in ("pieces", "switch")]
        movable_factors = [f for f in step_factors if f.kind == "switch" or len(f.factors) <= MAX_STEPS_IN_MOVED_LAW]
        return movable_factors[0] if movable_factors and self.regressor.hall_region is None else None

    def _with_moved_steps(self, sightings: Sightings, steps: Regressor) -> list[EmpiricalLaw]:
        """Copies of the law with one of its `steps` one gap between covariate values further, or with another lag."""
        x = np.unique(sightings.covariate_values[steps.covariates[0]][self.pointing_indicator(sightings) > 0])
        gaps = np.searchsorted(x, [piece.constant for piece in steps.factors])
        laws = []
        for i, piece in enumerate(steps.factors):
            for k in range(max(gaps[i] - MAX_STEP_MOVE_GAPS, 1), min(gaps[i] + MAX_STEP_MOVE_GAPS, len(x) - 1) + 1):
                if (
                    np.isfinite(piece.constant)
                    and np.abs(np.delete(gaps, i) - k).min(initial=MAX_STEP_MOVE_GAPS) >= MAX_STEP_MOVE_GAPS
                ):
                    moved = replace(piece, constant=float(0.5 * (x[k - 1] + x[k])))
                    regressor = replace(steps, factors=(*steps.factors[:i], moved, *steps.factors[i + 1 :]))
                    laws.append(self._with_replaced_factor(steps, regressor))
        return laws + [self._with_replaced_factor(steps, replace(steps, constant=k)) for k in _candidate_lags(steps)]

    def _with_replaced_factor(self, old_factor: Regressor, new_factor: Regressor) -> EmpiricalLaw:
        """Copy of the law with `new_factor` in place of `old_factor` (its whole function or one of its factors)."""
        if self.regressor == old_factor:
            return replace(self, regressor=new_factor)
        factors = tuple(new_factor if factor == old_factor else factor for factor in self.regressor.factors)
        return replace(self, regressor=replace(self.regressor, factors=factors))

    def candidate_formulas(self, sightings: Sightings) -> list[EmpiricalLaw]:
        """Laws in which a formula with at most one constant replaces the smooth curve of this law."""
        if self.regressor.kind == "smooth":
            short = formula_regressors(sightings, self.regressor.covariates[0])
            return [replace(self, regressor=regressor, length_scale_index=0) for regressor in short]
        if self.regressor.function == "decay":
            return [replace(self, regressor=replace(self.regressor, function="relaxing"))]
        if self.regressor.kind != "product":
            return []
        options = [
            list(formula_regressors(sightings, f.covariates[0], is_reduced_set=True)) if f.kind == "smooth" else [f]
            for f in self.regressor.factors
        ]
        products = [Regressor("product", factors=factors) for factors in product(*options)]
        return [replace(self, regressor=regressor, length_scale_index=0) for regressor in products]

    def candidate_forms_by_kind(self, sightings: Sightings) -> dict[str, list[list[EmpiricalLaw]]]:
        """Other forms of the law by kind (`curve`, `formula`): lists of laws that differ only in length scale."""
        regressor, forms = self.regressor, {"curve": [self], "formula": self.candidate_formulas(sightings)}
        if regressor.kind == "smooth":
            n_modes = N_FINER_CURVE_MODES if regressor.constant > N_PRODUCT_CURVE_MODES else N_CURVE_MODES
            forms["fine"] = [replace(self, regressor=smooth_regressor(regressor.covariates[0], n_modes))]
        if MIN_GROUP_TARGETS <= len(self.targets) <= MAX_SEPARATE_AMOUNTS and self.response.changed_part == "target":
            per_target = regressor.with_amount_per_target(self.targets)
            forms["members"] = [replace(self, regressor=per_target, length_scale_index=0)]
        if regressor.kind == "wave":
            forms["cycle"] = [replace(self, regressor=replace(regressor, kind="cycle"))]

        def with_length_scales(law: EmpiricalLaw) -> list[EmpiricalLaw]:
            return [replace(law, length_scale_index=k) for k in range(len(law.regressor.coefficient_sigmas))]

        return {kind: [with_length_scales(law) for law in laws] for kind, laws in forms.items() if laws}

    def candidate_steps_and_ramps(self, sightings: Sightings) -> list[Regressor]:
        """Steps and ramps, at gaps between values of the covariate, whose sum may replace the law's smooth curve."""
        curved = [f for f in (self.regressor, *self.regressor.factors) if f.kind == "smooth"]
        if len(curved) != 1:
            return []
        name = curved[0].covariates[0]
        x = np.unique(sightings.covariate_values[name][self.pointing_indicator(sightings) > 0])
        x = x[np.unique(np.linspace(0, len(x) - 1, MAX_CANDIDATE_STEP_POSITIONS).round().astype(int))]
        edges = 0.5 * (x[1:] + x[:-1])
        return [scalar_regressor(name, function, float(edge)) for function in ("step", "ramp") for edge in edges]

    def with_steps_and_ramps(self, steps: Sequence[Regressor]) -> EmpiricalLaw:
        """Copy of the law with a sum of the given steps and ramps in place of its smooth curve."""
        pieces, regressor = piecewise_regressor(steps), self.regressor
        if regressor.kind == "product":
            pieces = replace(regressor, factors=tuple(pieces if f.kind == "smooth" else f for f in regressor.factors))
        return replace(self, regressor=pieces, length_scale_index=0)

    @property
    def switchable_factor(self) -> Regressor | None:
        """Curve or wave (the whole function, or its factor of time) that a switch (on, off) may replace; else None."""
        if self.regressor.kind in ("smooth", "wave"):
            return self.regressor
        curves = (f for f in self.regressor.factors if f.kind in ("smooth", "wave") and f.covariates == ("time",))
        return next(curves, None) if self.regressor.kind == "product" else None

    def candidate_switch_steps(self, sightings: Sightings) -> list[Regressor]:
        """Steps at which the law may be turned on or off: in its covariate, or in time if it depends on a region."""
        curve = self.switchable_factor
        if curve is None and not self.depends_on_permanent_region:
            return []
        name = curve.covariates[0] if curve else "time"
        x = np.unique(sightings.covariate_values[name][self.pointing_indicator(sightings) > 0])
        x = x[np.unique(np.linspace(0, len(x) - 1, MAX_CANDIDATE_SWITCH_EDGES).round().astype(int))]
        return [scalar_regressor(name, "step", float(edge)) for edge in 0.5 * (x[1:] + x[:-1])]

    def with_sum_of_steps(self, steps: Sequence[Regressor]) -> EmpiricalLaw:
        """Copy of the law whose function, or a factor of it, is a sum of steps with separate coefficients."""
        return replace(self, regressor=self._regressor_with_switch(piecewise_regressor(steps)), length_scale_index=0)

    def with_switch(self, edge_steps: Sequence[Regressor]) -> EmpiricalLaw:
        """Copy of the law that acts only in intervals of a covariate, which begin and end at `edge_steps`."""
        return replace(self, regressor=self._regressor_with_switch(switch_regressor(edge_steps)), length_scale_index=0)

    def _regressor_with_switch(self, gate_regressor: Regressor) -> Regressor:
        """Function of covariates with a switch: `gate_regressor` (steps) in place of a curve, or times a length."""
        if self.depends_on_permanent_region:
            return Regressor("product", factors=(self.regressor, gate_regressor))
        others = [f for f in self.regressor.factors if f != self.switchable_factor]
        return Regressor("product", factors=(gate_regressor, *others)) if others else gate_regressor

    def equivalent_vertical_index_law(self, sightings: Sightings) -> EmpiricalLaw:
        """Law of the vertical index that is equivalent to this law of the elevation; if there is none, the law itself.

        Both laws are equivalent if the elevation error changes sign with the face, or, with readings in one face only,
        if the law depends only on time or on additional columns of the recording.
        """
        if self.response.name != "elevation":
            return self
        index = replace(RESPONSE_AND_DESIGN_BY_NAME["vertical index"][0], plausible_size=self.response.plausible_size)
        regressor = self.regressor
        names = {*regressor.covariates, *(n for f in regressor.factors for n in f.covariates)}
        single_face = not np.ptp(sightings.face)
        if single_face and names <= {*CLOCK_COVARIATES, *sightings.covariates}:
            return replace(self, response=index)
        face, *rest = regressor.factors or (regressor, CONSTANT_REGRESSOR)
        is_index = face == FACE_SIGN_REGRESSOR and len(rest) == 1
        return replace(self, response=index, regressor=rest[0]) if is_index else self

    def with_coefficients_per_setup(self, sightings: Sightings) -> EmpiricalLaw | None:
        """Copy of the law with separate coefficients per set-up; None if the law or network does not permit this."""
        stations = tuple(sightings.station_names)
        is_restricted = len(self.stations) > 1 or self.targets or self.instruments
        is_unsuitable = (
            self.regressor.kind in ("product", "amounts") or self.response.changed_part not in PARTS_SEPARATE_BY_SETUP
        )
        if is_restricted or is_unsuitable or not 2 <= len(stations) <= MAX_SEPARATE_AMOUNTS:
            return None
        return replace(self, stations=stations, has_coefficients_per_setup=True)

    def law_at_setup_of_largest_effect(
        self, coefficient_mean: Floats, coefficient_covariance: Floats, sightings: Sightings
    ) -> tuple[EmpiricalLaw, Floats, Floats, Floats]:
        """Law at the set-up where its change is largest, the direction of this change, its coefficients and covariance.

        The coefficients (c, k) and their covariance (c, k, c, k) are those of c components and k columns at this
        set-up. The direction is a unit vector (c,), or a single component if the units of the components differ. The
        arguments are mean and covariance of all coefficients [SI].
        """
        n_components, k = len(self.response.component_names), self.regressor.n_columns
        if self.component_ratio:
            ratios = np.array(self.component_ratio)
            coefficient_mean = np.kron(ratios, coefficient_mean).astype(np.float64)
            coefficient_covariance = np.kron(np.outer(ratios, ratios), coefficient_covariance).astype(np.float64)
        shape = (n_components, len(coefficient_mean) // (n_components * k), k)
        means, spread = coefficient_mean.reshape(shape), coefficient_covariance.reshape(*shape, *shape)
        columns = self.regressor.columns(sightings)
        if self.has_coefficients_per_setup:
            rows = [sightings.station == sightings.station_names.index(name) for name in self.stations]
            size = [float(np.sum((columns[r] @ means[:, i].T) ** 2)) for i, r in enumerate(rows)]
        largest = int(np.argmax(size)) if self.has_coefficients_per_setup else 0
        law = self
        if self.has_coefficients_per_setup:
            law = replace(
                self, stations=(self.stations[largest],), has_coefficients_per_setup=False, component_ratio=()
            )
        moved = columns[law.pointing_indicator(sightings) > 0] @ means[:, largest].T
        moved = moved - moved.mean(axis=0) if self.regressor.kind != "constant" else moved
        main_direction = np.linalg.svd(moved, full_matrices=False)[2][0]
        if self.response.component_units:
            main_direction = np.eye(n_components)[np.argmax(np.sum(moved**2, axis=0))]
        main_direction = main_direction * np.sign(main_direction[np.argmax(np.abs(main_direction))])
        return law, main_direction, means[:, largest], spread[:, largest, :, :, largest, :]


def _candidate_lags(steps: Regressor) -> list[float]:
    """Lags [s] that a local search tries for a switch in time in place of its lag; empty for other functions."""
    if steps.kind != "switch" or steps.covariates != ("time",):
        return []
    return [0.0, *(steps.constant * s for s in (0.6, 1.7))] if steps.constant else list(CANDIDATE_LAG_TIME_CONSTANTS)
