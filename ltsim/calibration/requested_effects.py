"""Estimation of effects that the user requests, together with the calibration.

An effect is a physical effect from the list of ltsim, or an empirical law: a function of time, angles and so on that
describes changes of the readings.

Stations, targets and shape parameters (period, time constant, onset time) that the user does not fix are selected so
that chi-square decreases most. The shape parameters are then adjusted with all other unknowns. The p-value of the
decrease is corrected for the number of tested combinations of stations, targets and shape parameters.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from ltsim.adjustment import Adjustment
from ltsim.adjustment.refit import ParameterEstimate, Refit, refit_with_effects
from ltsim.adjustment.reliability import neg_log_p_chi2
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.schema import FittedEffectEntry, FittedParameterEntry
from ltsim.core.errors import ModelError, option_text
from ltsim.core.units import SI_PER_UNIT
from ltsim.physics.effects.effect import Blunder, Effect, NoiseEffect
from ltsim.physics.effects.linear_effect import CandidateEffect, LinearEffect, Parameter, ShapeParameter
from ltsim.physics.effects.verbs import LOCATION_FIELD_NAMES
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.sizes import displayed_sizes
from ltsim.physics.laws.text_form import law_suffix, regressor_text
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.recordings.recording import Recording
from ltsim.solve.gauss_newton import MAX_DECISION_CHANGES


@dataclass(frozen=True)
class RequestedEffect:
    """Effect (or empirical law, a function such as `elevation ~ time`) that the user requests, and its fixed fields."""

    effect: CandidateEffect
    """Effect with the requested stations, targets and shape parameters."""
    fixed_fields: frozenset[str] = frozenset()
    """Names of the fields whose values the user gave; the readings determine the other fields."""

    def require_estimable(self, recording: Recording, construction: GeometricErrorModel) -> None:
        """Check that the effect can be estimated in the calibration of a recording; raises ModelError otherwise."""
        effect, name = self.effect, self.effect.name
        if isinstance(effect, NoiseEffect):
            how = f"use {option_text('noise_from_data=True')} to estimate the noise"
            raise ModelError(f"{name} changes the noise, not the readings; {how}")
        if isinstance(effect, Blunder):
            raise ModelError(f"{name} is a blunder in the recording and has no size; ltsim diagnose corrects it")
        parameter_names = {p.name for p in effect.parameters}
        if not effect.place_text and parameter_names <= set(construction.parameter_names):
            raise ModelError(
                f"{name} is always estimated in a calibration; restrict it to a station, as in {name}:NAME"
            )
        for kind, names in zip(LOCATION_FIELD_NAMES, (recording.stations, recording.targets), strict=True):
            lost = sorted(set(getattr(effect, kind)) - set(names))
            if lost:
                raise ModelError(f"{name}: the recording has no {kind[:-1]} '{lost[0]}'")

    def candidates(self, adjustment: Adjustment) -> Sequence[CandidateEffect]:
        """Variants of the effect (stations, targets, shape parameters) that agree with the fields fixed by the user."""
        if not isinstance(self.effect, Effect):
            return [self.effect]
        matching = [
            c
            for c in self.effect.candidates(adjustment.sightings)
            if all(getattr(c, key) == getattr(self.effect, key) for key in self.fixed_fields)
        ]
        if matching:
            return matching
        free_shapes = [s for s in self.effect.shape_parameters if s.name not in self.fixed_fields]
        grids = product(*([(s.name, float(v)) for v in s.grid_values()] for s in free_shapes))
        return [self.effect.with_shape_parameters(**dict(shape)) for shape in grids]


def fit_with_requested_effects(
    adjust_with: Callable[[Sequence[CandidateEffect]], Adjustment],
    unreported_effects: Sequence[CandidateEffect],
    requested_effects: Sequence[RequestedEffect],
) -> tuple[Adjustment, tuple[FittedEffectEntry, ...]]:
    """Adjustment with the requested effects, and the entry of each effect for the result.

    The stations, targets and shape parameters of each effect are selected with all previous effects in the model.
    `adjust_with` makes the adjustment with given effects in its model. The `unreported_effects` are estimated first and
    have no entry.
    """
    adjustment, fits = adjust_with(unreported_effects), list[FittedEffectEntry]()
    fit, fixed = Refit(adjustment, tuple(unreported_effects), ()), [frozenset[str]()] * len(unreported_effects)
    for wanted in requested_effects:
        candidates, space = wanted.candidates(adjustment), ResidualSpace.from_adjustment(adjustment)
        best = max(
            candidates, key=lambda effect: float(neg_log_p_chi2(*space.chi2_drop(space.whitened_design(effect))))
        )
        freedom, before = space.chi2_drop(space.whitened_design(best))[1], adjustment.chi2
        if freedom:
            fixed.append(wanted.fixed_fields)
            adjustment, fit = _refit_with_best_shape_parameters(adjust_with, [*fit.effects, best], fixed)
        estimated = best if freedom else wanted.effect
        place = (
            "" if isinstance(estimated, EmpiricalLaw) and estimated.has_coefficients_per_setup else estimated.place_text
        )
        drop = max(before - adjustment.chi2, 0.0)
        name, tried = effect_display_name(best, adjustment), len(candidates)
        fits.append(
            FittedEffectEntry(
                effect=name, place_text=place, chi2_drop=drop, n_distinguishable_parameters=freedom, n_candidates=tried
            )
        )
    n_unreported = len(unreported_effects)
    rows = (
        _law_size_entries(effect, adjustment)
        if isinstance(effect, EmpiricalLaw)
        else _effect_entries(effect, estimated, given)
        for effect, estimated, given in zip(
            fit.effects[n_unreported:], fit.estimates[n_unreported:], fixed[n_unreported:], strict=True
        )
    )
    return adjustment, tuple(
        entry.model_copy(update={"parameters": next(rows)}) if entry.n_distinguishable_parameters else entry
        for entry in fits
    )


def _refit_with_best_shape_parameters(
    adjust_with: Callable[[Sequence[CandidateEffect]], Adjustment],
    effects: Sequence[CandidateEffect],
    fixed_fields: Sequence[frozenset[str]],
) -> tuple[Adjustment, Refit]:
    """Adjustment with effects whose shape parameters minimise chi-square, and the last refit of these parameters.

    `fixed_fields` are the names of the fields of each effect that keep their value.
    """
    for _ in range(MAX_DECISION_CHANGES):
        adjustment = adjust_with(effects)
        near = adjustment.with_effects
        fit = refit_with_effects(near, effects, start_state=adjustment.state, fixed_shape_parameters=fixed_fields)
        if fit.effects == tuple(effects):
            break
        effects = fit.effects
    return adjustment, fit


def effect_display_name(effect: LinearEffect, adjustment: Adjustment) -> str:
    """Name of an effect for users; for an empirical law its text, such as `elevation ~ time`."""
    if not isinstance(effect, EmpiricalLaw):
        return effect.name
    regressor_name = regressor_text(effect.regressor, has_clock=adjustment.recording.has_clock)
    return f"{effect.response.name} ~ {regressor_name}{law_suffix(effect)}"


def _law_size_entries(law: EmpiricalLaw, adjustment: Adjustment) -> tuple[FittedParameterEntry, ...]:
    """Entries of the estimated sizes (such as the amplitude) of an empirical law in an adjustment."""
    effects_before = adjustment.effects[: adjustment.effects.index(law)]
    first_parameter = sum(len(effect.parameters) for effect in effects_before)
    columns = slice(first_parameter, first_parameter + len(law.parameters))
    component_sizes = displayed_sizes(
        law,
        adjustment.sightings,
        adjustment.state.extra_parameters[columns],
        adjustment.effect_covariance[columns, columns],
    )
    return tuple(FittedParameterEntry(**size._asdict()) for size in component_sizes)


def _effect_entries(
    effect: CandidateEffect, estimates: Sequence[ParameterEstimate], fixed_fields: frozenset[str]
) -> tuple[FittedParameterEntry, ...]:
    """Result entries of an estimated effect: its sizes, then its shape parameters, both fixed and estimated ones.

    `fixed_fields` are the names of the shape parameters that the user fixed.
    """
    parameter_entries = [_parameter_entry(*estimate) for estimate in estimates]
    words = [
        FittedParameterEntry(name=key, value=value if isinstance(value, str) else float(value), unit="")
        for key, value in vars(effect).items()
        if isinstance(value, str) or type(value) is int  # the order of a harmonic
    ]
    shape_entries = [
        _parameter_entry(s, getattr(effect, s.name), np.inf) for s in effect.shape_parameters if s.name in fixed_fields
    ]
    n_parameters = len(effect.parameters)
    return (*parameter_entries[:n_parameters], *words, *shape_entries, *parameter_entries[n_parameters:])


def _parameter_entry(parameter: Parameter | ShapeParameter, estimate: float, sigma: float) -> FittedParameterEntry:
    """Entry of an estimated parameter or shape parameter in display units; `estimate` and `sigma` are in SI units."""
    unit = SI_PER_UNIT[parameter.unit]
    spread = float(sigma / unit) if np.isfinite(sigma) else None
    return FittedParameterEntry(name=parameter.name, value=float(estimate / unit), sigma=spread, unit=parameter.unit)
