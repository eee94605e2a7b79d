"""Nonlinear refit of a network with some effects, the constants of their shapes included."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from itertools import repeat
from typing import NamedTuple

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.core.arrays import Floats, Ints
from ltsim.physics.effects.signature import Parameter, ShapeParameter, Signature, Tunable
from ltsim.physics.model.measurement import State
from ltsim.scene.sightings import Sightings

ITERATIONS = 4
"""Steps of the constants at most: a refit begins where a search has found them on a grid."""
LINEAR = 1e-5
"""Relative change of a constant over which readings change linearly: a range of 20 m has a thousand short waves."""
HALVINGS = 4
"""Maximum number of halvings of a step that fits worse, for constants that begin far off."""
NO_WORSE = 1e-3
"""Rise of chi-square that counts as none: that of a constant 0.03 standard deviations off its best value."""
FELT = 1e-3
"""A shape constant whose change by a tenth moves no reading by this share of its effect is not estimated."""


@dataclass(frozen=True)
class ShapeDirection(Signature):
    """Signature of a change of one of an effect's shape constants, with which a refit estimates the constant.

    The parameter is the change of the constant relative to its size.
    """

    base: Tunable
    values: tuple[float, ...]
    constant: ShapeParameter

    name = "shape"
    parameters = (Parameter("relative-change", "", "relative change of a shape constant", 1.0),)

    def design(self, sightings: Sightings) -> Floats:
        """Central difference (n, 3, 1) by the relative change of the constant."""
        now, values = self.now, np.array(self.values)
        up, down = (
            self.base.reshaped(**{self.constant.name: now * (1 + s)}).design(sightings) @ values
            for s in (LINEAR, -LINEAR)
        )
        change: Floats = ((up - down) / (2 * LINEAR))[:, :, None]
        return change

    @property
    def now(self) -> float:
        """The constant [SI]."""
        return float(getattr(self.base, self.constant.name))

    def moved(self, change: float) -> float:
        """The constant after a relative change, within its bounds; at once it halves or doubles at most."""
        moved = self.now * (1 + np.clip(change, -0.5, 1.0))
        return float(np.clip(moved, self.constant.low, self.constant.high))


@dataclass(frozen=True)
class FirstOrder(Tunable):
    """An effect in its first-order form at one state of the network, where the exact one keeps a refit from ending.

    An encoder error of thousands of lines, say, moves by a good part of a period while the network settles.
    """

    base: Tunable
    at: Floats = field(compare=False, repr=False)
    name: str = ""
    parameters: tuple[Parameter, ...] = ()
    stations: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    observables: tuple[str, ...] = ()
    covariates: tuple[str, ...] = ()

    @classmethod
    def of(cls, base: Tunable, sightings: Sightings) -> FirstOrder:
        """An effect at a state of the network."""
        identity = (base.name, base.parameters, base.stations, base.targets, base.observables, base.covariates)
        return cls(base, base.design(sightings), *identity)

    def design(self, sightings: Sightings) -> Floats:
        """The design (n, 3, p) of the effect as it was."""
        return self.at

    def gauge_design(self, first: Ints, second: Ints, points: Floats) -> Floats:
        """Derivative (g, p) of the known lengths by the effect's parameters."""
        return self.base.gauge_design(first, second, points)


def _directions(effect: Tunable, values: Floats, sightings: Sightings, fixed: Collection[str]) -> list[ShapeDirection]:
    """Shape constants of an effect that the readings feel and that vary smoothly, less those that are `fixed`."""
    directions = []
    size = float(np.abs(effect.design(sightings) @ values).max())
    for shape in type(effect).shape:
        now = getattr(effect, shape.name)
        if shape.name in fixed or not isinstance(now, float) or now == 0.0 or shape.steps < 2:
            continue
        direction = ShapeDirection(effect, tuple(values), shape)
        if float(np.abs(direction.design(sightings)).max()) > FELT * size:
            directions.append(direction)
    return directions


class Estimated(NamedTuple):
    """A parameter or a shape constant of an effect [SI]."""

    parameter: Parameter | ShapeParameter
    value: float
    sigma: float
    """Standard deviation; infinite for a constant beside which the adjustment did not converge."""


@dataclass(frozen=True)
class Refit:
    """A refitted network, the effects with their final shapes, and what is known of each.

    Nothing is told of effects beside which the adjustment did not converge, nor of constants that no reading feels.
    """

    adjustment: Adjustment
    effects: tuple[Tunable, ...]
    estimates: tuple[tuple[Estimated, ...], ...]


def refit(
    adjusted: Callable[..., Adjustment],
    effects: Sequence[Tunable],
    *,
    start: State,
    fixed: Sequence[Collection[str]] = (),
) -> Refit:
    """Adjust with effects; shape constants are estimated with them, and their uncertainty is carried along.

    Parameters
    ----------
    adjusted : callable
        The adjustment with `effects` from a `start`, both by name.
    effects : sequence of Tunable
    start : State
        Of the network.
    fixed : sequence of collections of str, optional
        Names of each effect's constants that stay as they are and are not told.
    """
    stay = fixed or [()] * len(effects)
    current = list(effects)
    fitted = joint = adjusted(effects=current, start=start)
    if not fitted.solution.converged:
        sightings = fitted.problem.model.sightings(start)
        current = [FirstOrder.of(effect, sightings) for effect in current]
        fitted = joint = adjusted(effects=current, start=start)
    directions: list[list[ShapeDirection]] = [[] for _ in current]
    for _ in range(ITERATIONS if any(type(e).shape for e in current) else 0):
        values = _split(current, fitted.state.extra)
        each = zip(current, values, stay, strict=True)
        directions = [_directions(effect, sizes, fitted.sightings, out) for effect, sizes, out in each]
        flat = [d for group in directions for d in group]
        if not flat:
            break
        joint = adjusted(effects=[*current, *flat], start=fitted.state)
        if not joint.solution.converged:
            break
        first = sum(len(effect.parameters) for effect in current)
        changes = joint.state.extra[first : first + len(flat)]
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
    effects: list[Tunable],
    directions: list[list[ShapeDirection]],
    changes: Floats,
    before: Adjustment,
) -> tuple[list[Tunable], Adjustment] | None:
    """Effects with changed constants and their adjustment, halved until it fits no worse; None where it never does."""
    for share in 0.5 ** np.arange(1 + HALVINGS):
        moved = _reshaped(effects, directions, share * changes)
        tried = adjusted(effects=moved, start=before.state)
        if tried.solution.converged and tried.chi2 <= before.chi2 + NO_WORSE:
            return moved, tried
    return None


def _split(effects: Sequence[Signature], extra: Floats) -> list[Floats]:
    """The values of each effect's parameters."""
    sizes = [len(e.parameters) for e in effects]
    return np.split(extra[: sum(sizes)], np.cumsum(sizes)[:-1]) if sizes else []


def _reshaped(effects: list[Tunable], directions: list[list[ShapeDirection]], changes: Floats) -> list[Tunable]:
    """Effects with relative changes of their shape constants."""
    change = iter(changes.tolist())
    moves = [{d.constant.name: d.moved(next(change)) for d in group} for group in directions]
    return [effect.reshaped(**moved) if moved else effect for effect, moved in zip(effects, moves, strict=True)]


def _estimates(
    fitted: Adjustment,
    joint: Adjustment,
    effects: Sequence[Tunable],
    directions: list[list[ShapeDirection]],
) -> tuple[tuple[Estimated, ...], ...]:
    """Estimates with uncertainty; that of the parameters includes the shapes' where these were estimated."""
    shaped = joint.solution.converged and len(joint.effects) > len(effects)
    carrier = joint if shaped else fitted
    if not (effects and carrier.solution.converged):
        return tuple(() for _ in effects)
    sigma = _split(carrier.effects, np.sqrt(np.maximum(np.diag(carrier.extra_covariance), 0.0)))
    relative = iter(sigma[len(effects) :]) if shaped else repeat(np.full(1, np.inf))
    rows = []
    for i, (effect, values) in enumerate(zip(effects, _split(effects, fitted.state.extra), strict=True)):
        row = [Estimated(*estimate) for estimate in zip(effect.parameters, values, sigma[i], strict=True)]
        for direction in directions[i]:
            now = float(getattr(effect, direction.constant.name))
            row.append(Estimated(direction.constant, now, float(next(relative)[0]) * abs(now)))
        rows.append(tuple(row))
    return tuple(rows)
