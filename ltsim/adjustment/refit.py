"""Adjustment of a network with effects whose shape parameters are estimated.

A shape parameter is a constant of an effect that enters nonlinearly, such as a period, time constant or onset time. The
other parameters of an effect, such as amplitudes, enter linearly.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from itertools import repeat
from typing import NamedTuple

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.core.arrays import Floats, Ints
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE
from ltsim.physics.effects.linear_effect import CandidateEffect, LinearEffect, Parameter, ShapeParameter
from ltsim.physics.model.measurement import NetworkState
from ltsim.scene.sightings import Sightings
from ltsim.solve.gauss_newton import MAX_DECISION_CHANGES

SHAPE_CHANGE_TOLERANCE = 1e-5
"""Relative change of a shape parameter (such as a period) in numerical derivatives; also the change at which its
iteration ends. The readings are linear over this change, even if a range contains a thousand periods of a range error.
"""
MAX_STEP_HALVINGS = 4
"""Largest number of halvings of a step of the shape parameters that increases chi-square."""
MIN_SHAPE_INFLUENCE = 1e-3
"""Smallest influence of a shape parameter that is estimated: largest change of a reading per relative change of the
shape parameter, divided by the largest change of a reading by the whole effect.
"""


@dataclass(frozen=True)
class LinearisedShapeParameter(LinearEffect):
    """Linearised change of an effect by a change of one shape parameter (such as a period), to estimate this parameter.

    Its only parameter is the relative change of the shape parameter (such as a period or time constant).
    """

    effect: CandidateEffect
    """Effect whose shape parameter (such as a period) changes."""
    parameter_values: tuple[float, ...]
    """Values of the parameters of the effect [SI]."""
    shape_parameter: ShapeParameter
    """Shape parameter that changes, such as a period or time constant."""

    name = "shape"
    """Name of the linearised effect of a change of a shape parameter, such as a period."""
    parameters = (Parameter("relative-change", "", "relative change of a shape parameter", 1.0),)
    """Parameter of the linearised change: relative change of the shape parameter."""

    def design(self, sightings: Sightings) -> Floats:
        """Derivatives (n, 3, 1) of the readings of n pointings by the relative change of the shape parameter."""
        now, values = self.present_shape_value, np.array(self.parameter_values)
        up, down = (
            self.effect.with_shape_parameters(**{self.shape_parameter.name: now * (1 + s)}).design(sightings) @ values
            for s in (SHAPE_CHANGE_TOLERANCE, -SHAPE_CHANGE_TOLERANCE)
        )
        change: Floats = ((up - down) / (2 * SHAPE_CHANGE_TOLERANCE))[:, :, None]
        return change

    @property
    def present_shape_value(self) -> float:
        """Present value of the shape parameter [SI]."""
        return float(getattr(self.effect, self.shape_parameter.name))

    def changed_shape_value(self, relative_change: float) -> float:
        """Shape parameter [SI] after a relative change, within its bounds and at most halved or doubled."""
        new_value = self.present_shape_value * (1 + np.clip(relative_change, -0.5, 1.0))
        return float(np.clip(new_value, self.shape_parameter.lower_bound, self.shape_parameter.upper_bound))


@dataclass(frozen=True)
class FirstOrderEffect(CandidateEffect):
    """Effect with a constant design matrix, used if the adjustment with the exact effect does not converge.

    For example, an encoder error with thousands of periods changes by a large part of a period between iterations. The
    design matrix is that at one state of the network.
    """

    exact_effect: CandidateEffect
    """Effect whose design matrix is fixed. The fields after `design_at_state` have the values of this effect."""
    design_at_state: Floats = field(compare=False, repr=False)
    """Fixed design matrix: change (n, 3, p) of the readings of n pointings per unit of each of p parameters."""
    name: str = ""
    """Name of the effect."""
    parameters: tuple[Parameter, ...] = ()
    """Parameters of the effect."""
    stations: tuple[str, ...] = ()
    """Names of the stations where the effect acts; empty for all."""
    targets: tuple[str, ...] = ()
    """Names of the targets where the effect acts; empty for all."""
    observables: tuple[str, ...] = ()
    """Observables that the effect changes."""
    covariates: tuple[str, ...] = ()
    """Covariates on which the effect depends."""

    @classmethod
    def from_effect(cls, effect: CandidateEffect, sightings: Sightings) -> FirstOrderEffect:
        """Effect with its design matrix fixed at the ranges and directions `sightings`."""
        identity = (
            effect.name,
            effect.parameters,
            effect.stations,
            effect.targets,
            effect.observables,
            effect.covariates,
        )
        return cls(effect, effect.design(sightings), *identity)

    def design(self, sightings: Sightings) -> Floats:
        """Fixed design matrix (n, 3, p) for n pointings and p parameters, independent of `sightings`."""
        return self.design_at_state

    def gauge_design(self, first_targets: Ints, second_targets: Ints, points: Floats) -> Floats:
        """Derivatives (g, p) [m / SI] of g lengths between targets (indices) at `points` (T, 3) [m] by p parameters."""
        return self.exact_effect.gauge_design(first_targets, second_targets, points)


def _linearised_shape_parameters(
    effect: CandidateEffect, parameter_values: Floats, sightings: Sightings, fixed_shape_parameters: Collection[str]
) -> list[LinearisedShapeParameter]:
    """Linearised changes by those shape parameters of an effect that influence readings and are not fixed.

    `parameter_values` [SI] are the values of the linear parameters of the effect.
    """
    linearised_shapes = []
    largest_change = float(np.abs(effect.design(sightings) @ parameter_values).max())
    for shape in type(effect).shape_parameters:
        now = getattr(effect, shape.name)
        if shape.name in fixed_shape_parameters or not isinstance(now, float) or now == 0.0 or shape.n_grid_values < 2:
            continue
        linearised_shape = LinearisedShapeParameter(effect, tuple(parameter_values), shape)
        if float(np.abs(linearised_shape.design(sightings)).max()) > MIN_SHAPE_INFLUENCE * largest_change:
            linearised_shapes.append(linearised_shape)
    return linearised_shapes


class ParameterEstimate(NamedTuple):
    """Estimate of a linear parameter or shape parameter of an effect, with its standard deviation."""

    parameter: Parameter | ShapeParameter
    """Estimated parameter (such as an amplitude) or shape parameter (such as a period)."""
    value: float
    """Estimated value [SI]."""
    sigma: float
    """Standard deviation [SI]; infinite if the adjustment did not converge with this parameter as an unknown."""


@dataclass(frozen=True)
class Refit:
    """Network adjusted with some effects, and the estimates of their linear and shape parameters (such as periods)."""

    adjustment: Adjustment
    """Network adjusted with the effects in its model."""
    effects: tuple[CandidateEffect, ...]
    """Effects with the estimated values of their shape parameters."""
    estimates: tuple[tuple[ParameterEstimate, ...], ...]
    """Estimates for each effect: first its linear parameters, then its estimated shape parameters. They are empty if
    the adjustment did not converge.
    """


def refit_with_effects(
    adjust_function: Callable[..., Adjustment],
    effects: Sequence[CandidateEffect],
    *,
    start_state: NetworkState,
    fixed_shape_parameters: Sequence[Collection[str]] = (),
) -> Refit:
    """Adjustment with effects whose shape parameters (such as periods) are estimated with their uncertainty.

    Parameters
    ----------
    adjust_function : callable
        Function that adjusts the network; its keyword arguments are `effects` and `start_state`.
    effects : sequence of CandidateEffect
        Effects in the model, with start values of their shape parameters.
    start_state : NetworkState
        Start state of the network.
    fixed_shape_parameters : sequence of collections of str, optional
        Names, for each effect, of shape parameters that are fixed: neither estimated nor reported.
    """
    fixed_names = fixed_shape_parameters or [()] * len(effects)
    current = list(effects)
    fitted = with_shapes = adjust_function(effects=current, start_state=start_state)
    if not fitted.solution.has_converged:
        sightings = fitted.problem.model.sightings(start_state)
        current = [FirstOrderEffect.from_effect(effect, sightings) for effect in current]
        fitted = with_shapes = adjust_function(effects=current, start_state=start_state)
    linearised_shapes: list[list[LinearisedShapeParameter]] = [[] for _ in current]
    for _ in range(MAX_DECISION_CHANGES if any(type(e).shape_parameters for e in current) else 0):
        values = _values_by_effect(current, fitted.state.extra_parameters)
        each = zip(current, values, fixed_names, strict=True)
        linearised_shapes = [
            _linearised_shape_parameters(effect, sizes, fitted.sightings, out) for effect, sizes, out in each
        ]
        flat = [d for group in linearised_shapes for d in group]
        if not flat:
            break
        with_shapes = adjust_function(effects=[*current, *flat], start_state=fitted.state)
        if not with_shapes.solution.has_converged:
            break
        first = sum(len(effect.parameters) for effect in current)
        changes = with_shapes.state.extra_parameters[first : first + len(flat)]
        if np.all(np.abs(changes) < SHAPE_CHANGE_TOLERANCE):
            break
        step = _damped_step(adjust_function, current, linearised_shapes, changes, fitted)
        if step is None:
            break
        current, fitted = step
    named = tuple(e.exact_effect if isinstance(e, FirstOrderEffect) else e for e in current)
    return Refit(fitted, named, _estimates_with_uncertainty(fitted, with_shapes, current, linearised_shapes))


def _damped_step(
    adjust_function: Callable[..., Adjustment],
    effects: list[CandidateEffect],
    linearised_shapes: list[list[LinearisedShapeParameter]],
    changes: Floats,
    last_adjustment: Adjustment,
) -> tuple[list[CandidateEffect], Adjustment] | None:
    """Effects with changed shape parameters, and the adjustment with these effects; None if chi-square increases.

    `adjust_function` adjusts the network. `changes` are the relative changes of all shape parameters, in the order of
    the `linearised_shapes`. They are halved, at most `MAX_STEP_HALVINGS` times, until chi-square is not larger than in
    `last_adjustment`.
    """
    for share in 0.5 ** np.arange(1 + MAX_STEP_HALVINGS):
        moved = _effects_with_moved_shape_parameters(effects, linearised_shapes, share * changes)
        tried = adjust_function(effects=moved, start_state=last_adjustment.state)
        if tried.solution.has_converged and tried.chi2 <= last_adjustment.chi2 * (1.0 + NORMAL_EQUATIONS_TOLERANCE):
            return moved, tried
    return None


def _values_by_effect(effects: Sequence[LinearEffect], parameter_values: Floats) -> list[Floats]:
    """Values of the linear parameters of each effect, from an array with the values of all effects in order."""
    n_parameters = [len(e.parameters) for e in effects]
    return np.split(parameter_values[: sum(n_parameters)], np.cumsum(n_parameters)[:-1]) if n_parameters else []


def _effects_with_moved_shape_parameters(
    effects: list[CandidateEffect], linearised_shapes: list[list[LinearisedShapeParameter]], changes: Floats
) -> list[CandidateEffect]:
    """Effects after relative `changes` of shape parameters (such as periods), in the order of `linearised_shapes`."""
    change = iter(changes.tolist())
    moves = [
        {d.shape_parameter.name: d.changed_shape_value(next(change)) for d in group} for group in linearised_shapes
    ]
    return [
        effect.with_shape_parameters(**moved) if moved else effect for effect, moved in zip(effects, moves, strict=True)
    ]


def _estimates_with_uncertainty(
    adjustment: Adjustment,
    adjustment_with_shapes: Adjustment,
    effects: Sequence[CandidateEffect],
    linearised_shapes: list[list[LinearisedShapeParameter]],
) -> tuple[tuple[ParameterEstimate, ...], ...]:
    """Estimates of the linear and shape parameters of each effect, with standard deviations.

    `adjustment_with_shapes` has the shape parameters as unknowns, so that its standard deviations include their
    uncertainty. If it did not converge, the standard deviations are those of `adjustment`.
    """
    has_shape_estimates = adjustment_with_shapes.solution.has_converged
    has_shape_estimates = has_shape_estimates and len(adjustment_with_shapes.effects) > len(effects)
    source = adjustment_with_shapes if has_shape_estimates else adjustment
    if not (effects and source.solution.has_converged):
        return tuple(() for _ in effects)
    sigma = _values_by_effect(source.effects, np.sqrt(np.maximum(np.diag(source.effect_covariance), 0.0)))
    relative = iter(sigma[len(effects) :]) if has_shape_estimates else repeat(np.full(1, np.inf))
    estimates = []
    for i, (effect, values) in enumerate(
        zip(effects, _values_by_effect(effects, adjustment.state.extra_parameters), strict=True)
    ):
        row = [ParameterEstimate(*estimate) for estimate in zip(effect.parameters, values, sigma[i], strict=True)]
        for linearised_shape in linearised_shapes[i]:
            now = float(getattr(effect, linearised_shape.shape_parameter.name))
            row.append(ParameterEstimate(linearised_shape.shape_parameter, now, float(next(relative)[0]) * abs(now)))
        estimates.append(tuple(row))
    return tuple(estimates)
