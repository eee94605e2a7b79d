"""Nonlinear refit of a network with some effects, including the constants of their shapes."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from itertools import repeat
from typing import NamedTuple

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.core.arrays import Floats, Ints
from ltsim.physics.effects.signature import CandidateEffect, Parameter, ShapeParameter, Signature
from ltsim.physics.model.measurement import NetworkState
from ltsim.scene.sightings import Sightings

ITERATIONS = 4
"""Largest number of steps of the constants: a refit starts at the grid point of a search."""
LINEAR = 1e-5
"""Relative change of a constant over which readings are linear: a range of 20 m contains a thousand short waves."""
HALVINGS = 4
"""Largest number of halvings of a step that increases chi-square, for constants with a poor start."""
NO_WORSE = 1e-3
"""Increase of chi-square that counts as zero: that of a constant 0.03 standard deviations from its optimum."""
FELT = 1e-3
"""Smallest change of a reading, relative to the effect, by a tenth of a shape constant at which the constant is
estimated.
"""


@dataclass(frozen=True)
class ShapeDirection(Signature):
    """Signature of a change of one of an effect's shape constants, by which a refit estimates the constant.

    The parameter is the change of the constant relative to its size.
    """

    base: CandidateEffect
    values: tuple[float, ...]
    constant: ShapeParameter

    name = "shape"
    parameters = (Parameter("relative-change", "", "relative change of a shape constant", 1.0),)

    def design(self, sightings: Sightings) -> Floats:
        """Central difference (n, 3, 1) by the relative change of the constant."""
        now, values = self.now, np.array(self.values)
        up, down = (
            self.base.with_constants(**{self.constant.name: now * (1 + s)}).design(sightings) @ values
            for s in (LINEAR, -LINEAR)
        )
        change: Floats = ((up - down) / (2 * LINEAR))[:, :, None]
        return change

    @property
    def now(self) -> float:
        """Present value of the constant [SI]."""
        return float(getattr(self.base, self.constant.name))

    def moved(self, change: float) -> float:
        """Constant after a relative change, within its bounds and at most halved or doubled."""
        moved = self.now * (1 + np.clip(change, -0.5, 1.0))
        return float(np.clip(moved, self.constant.lower_bound, self.constant.upper_bound))


@dataclass(frozen=True)
class FirstOrder(CandidateEffect):
    """Effect in first-order form at one state of the network, used if the exact form prevents convergence.

    An encoder error with thousands of periods, for example, changes by a large part of a period between iterations.
    """

    base: CandidateEffect
    at: Floats = field(compare=False, repr=False)
    name: str = ""
    parameters: tuple[Parameter, ...] = ()
    stations: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    observables: tuple[str, ...] = ()
    covariates: tuple[str, ...] = ()

    @classmethod
    def of(cls, base: CandidateEffect, sightings: Sightings) -> FirstOrder:
        """First-order form of an effect at a state of the network."""
        identity = (base.name, base.parameters, base.stations, base.targets, base.observables, base.covariates)
        return cls(base, base.design(sightings), *identity)

    def design(self, sightings: Sightings) -> Floats:
        """Design (n, 3, p) of the effect at that state."""
        return self.at

    def gauge_design(self, first: Ints, second: Ints, points: Floats) -> Floats:
        """Derivative (g, p) of the reference lengths with respect to the effect's parameters."""
        return self.base.gauge_design(first, second, points)


def _directions(
    effect: CandidateEffect, values: Floats, sightings: Sightings, fixed: Collection[str]
) -> list[ShapeDirection]:
    """Shape constants of an effect that influence the readings smoothly, except the `fixed` ones."""
    directions = []
    size = float(np.abs(effect.design(sightings) @ values).max())
    for shape in type(effect).shape_parameters:
        now = getattr(effect, shape.name)
        if shape.name in fixed or not isinstance(now, float) or now == 0.0 or shape.n_grid_values < 2:
            continue
        direction = ShapeDirection(effect, tuple(values), shape)
        if float(np.abs(direction.design(sightings)).max()) > FELT * size:
            directions.append(direction)
    return directions


class Estimated(NamedTuple):
    """Estimate of a parameter or shape constant of an effect [SI]."""

    parameter: Parameter | ShapeParameter
    value: float
    sigma: float
    """Standard deviation; infinite for a constant with which the adjustment did not converge."""


@dataclass(frozen=True)
class Refit:
    """Refitted network, the effects with their final shapes, and the estimates of each.

    There are no estimates for effects with which the adjustment did not converge, nor for constants without influence
    on the readings.
    """

    adjustment: Adjustment
    effects: tuple[CandidateEffect, ...]
    estimates: tuple[tuple[Estimated, ...], ...]


def refit(
    adjusted: Callable[..., Adjustment],
    effects: Sequence[CandidateEffect],
    *,
    start: NetworkState,
    fixed: Sequence[Collection[str]] = (),
) -> Refit:
    """Adjustment with effects, in which shape constants are estimated together with their uncertainty.

    Parameters
    ----------
    adjusted : callable
        The adjustment with `effects` from a `start`, both by name.
    effects : sequence of Tunable
    start : State
        Start state of the network.
    fixed : sequence of collections of str, optional
        Names of each effect's constants that are fixed and not reported.
    """
    stay = fixed or [()] * len(effects)
    current = list(effects)
    fitted = joint = adjusted(effects=current, start=start)
    if not fitted.solution.converged:
        sightings = fitted.problem.model.sightings(start)
        current = [FirstOrder.of(effect, sightings) for effect in current]
        fitted = joint = adjusted(effects=current, start=start)
    directions: list[list[ShapeDirection]] = [[] for _ in current]
    for _ in range(ITERATIONS if any(type(e).shape_parameters for e in current) else 0):
        values = _split(current, fitted.state.extra_parameters)
        each = zip(current, values, stay, strict=True)
        directions = [_directions(effect, sizes, fitted.sightings, out) for effect, sizes, out in each]
        flat = [d for group in directions for d in group]
        if not flat:
            break
        joint = adjusted(effects=[*current, *flat], start=fitted.state)
        if not joint.solution.converged:
            break
        first = sum(len(effect.parameters) for effect in current)
        changes = joint.state.extra_parameters[first : first + len(flat)]
        if np.all(np.abs(changes) < LINEAR):
            break
        step = _step(adjusted, current, directions, changes, fitted)
        if step is None:
            break
        current, fitted = step
    named = tuple(e.base if isinstance(e, FirstOrder) else e for e in current)
    return Refit(fitted, named, _estimates(fitted, joint, current, directions))


def _step(
    adjusted: Callable[..., Adjustment],
    effects: list[CandidateEffect],
    directions: list[list[ShapeDirection]],
    changes: Floats,
    before: Adjustment,
) -> tuple[list[CandidateEffect], Adjustment] | None:
    """Effects with changed constants and their adjustment, after halvings until chi-square does not increase.

    It is None otherwise.
    """
    for share in 0.5 ** np.arange(1 + HALVINGS):
        moved = _reshaped(effects, directions, share * changes)
        tried = adjusted(effects=moved, start=before.state)
        if tried.solution.converged and tried.chi2 <= before.chi2 + NO_WORSE:
            return moved, tried
    return None


def _split(effects: Sequence[Signature], extra: Floats) -> list[Floats]:
    """Values of the parameters of each effect."""
    sizes = [len(e.parameters) for e in effects]
    return np.split(extra[: sum(sizes)], np.cumsum(sizes)[:-1]) if sizes else []


def _reshaped(
    effects: list[CandidateEffect], directions: list[list[ShapeDirection]], changes: Floats
) -> list[CandidateEffect]:
    """Effects with relative changes of their shape constants."""
    change = iter(changes.tolist())
    moves = [{d.constant.name: d.moved(next(change)) for d in group} for group in directions]
    return [effect.with_constants(**moved) if moved else effect for effect, moved in zip(effects, moves, strict=True)]


def _estimates(
    fitted: Adjustment,
    joint: Adjustment,
    effects: Sequence[CandidateEffect],
    directions: list[list[ShapeDirection]],
) -> tuple[tuple[Estimated, ...], ...]:
    """Estimates with uncertainty; those of parameters include the uncertainty of estimated shape constants."""
    shaped = joint.solution.converged and len(joint.effects) > len(effects)
    carrier = joint if shaped else fitted
    if not (effects and carrier.solution.converged):
        return tuple(() for _ in effects)
    sigma = _split(carrier.effects, np.sqrt(np.maximum(np.diag(carrier.extra_covariance), 0.0)))
    relative = iter(sigma[len(effects) :]) if shaped else repeat(np.full(1, np.inf))
    rows = []
    for i, (effect, values) in enumerate(zip(effects, _split(effects, fitted.state.extra_parameters), strict=True)):
        row = [Estimated(*estimate) for estimate in zip(effect.parameters, values, sigma[i], strict=True)]
        for direction in directions[i]:
            now = float(getattr(effect, direction.constant.name))
            row.append(Estimated(direction.constant, now, float(next(relative)[0]) * abs(now)))
        rows.append(tuple(row))
    return tuple(rows)
