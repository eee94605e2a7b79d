"""Which explanation of a mismatch holds: the evidence between effects, in a recording and in one that is longer.

The expected evidence between two explanations is what the best instance of the rival, at any of its places and shapes,
leaves of the true signature: a difference of chi-square. Nobody knows which of the two is true; the smaller counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.arrays import Floats
from ltsim.effects import find_effect
from ltsim.effects.effect import Effect, NoiseEffect
from ltsim.effects.signature import Signature
from ltsim.errors import ModelError
from ltsim.remedies.detectability import thinned

DECISIVE = 10.0
"""Expected difference of chi-square from which two explanations count as told apart."""


@dataclass(frozen=True)
class Explanation:
    """An effect at the place and with the shape that fit a recording best, and its size (q,) [SI]."""

    effect: Effect
    values: Floats


def space_of(adjustment: Adjustment, beside: Sequence[Signature] = ()) -> ResidualSpace:
    """The residual space of an adjustment with effects `beside` estimated too."""
    return ResidualSpace.of(adjustment).beside(beside)


def explanation(space: ResidualSpace, name: str) -> Explanation:
    """The effect called `name` where, and with the shape with which, it fits the residuals best.

    Raises
    ------
    ModelError
        When there is no such effect, or it leaves no trace in this recording.
    """
    kind = find_effect(name)
    if issubclass(kind, NoiseEffect):
        raise ModelError(f"{name} is a change of the noise; only effects that shift readings can be told apart here")
    best: Explanation | None = None
    least = float(space.residual @ space.residual)
    for effect in kind.candidates(space.sightings):
        values, left = _fitted(space, effect, space.residual)
        if left < least:
            least, best = left, Explanation(effect, values)
    if best is None:
        raise ModelError(f"{name} leaves no trace in this recording; no size of it can be taken from it")
    return best


def _fitted(space: ResidualSpace, effect: Effect, residual: Floats) -> tuple[Floats, float]:
    """Size (q,) of an effect that fits a projected vector best, and the square of what it leaves."""
    left = space.project(space.signature(effect))
    if not np.isfinite(left).all() or not left.any():
        return np.zeros(len(effect.parameters)), float(residual @ residual)
    values = np.asarray(np.linalg.lstsq(left, residual, rcond=1e-6)[0], dtype=np.float64)
    return values, float(np.sum((residual - left @ values) ** 2))


@dataclass(frozen=True)
class Rivals:
    """Two explanations, with all that could stand in for either."""

    first: Explanation
    second: Explanation
    stand_ins: tuple[list[tuple[float, Effect]], list[tuple[float, Effect]]]
    """Every instance of the second and what it leaves of the first in the recording as it is, the least
    first; then the other way round. More pointings never leave less.
    """

    @classmethod
    def of(cls, space: ResidualSpace, first: Explanation, second: Explanation) -> Rivals:
        """As a recording leaves them."""
        return cls(first, second, (_stand_ins(space, first, second.effect), _stand_ins(space, second, first.effect)))

    @property
    def now(self) -> float:
        """Evidence in the recording as it is."""
        return min(found[0][0] for found in self.stand_ins)

    def evidence(self, space: ResidualSpace) -> float:
        """Expected difference of chi-square in a longer recording, whichever of the two holds."""
        least = []
        for truth, stand_ins in zip((self.first, self.second), self.stand_ins, strict=True):
            signature = space.project(space.signature(truth.effect) @ truth.values)
            smallest = float(signature @ signature)
            for before, effect in stand_ins:
                if before >= smallest:
                    break
                smallest = min(smallest, _fitted(space, effect, signature)[1])
            least.append(smallest)
        return min(least)


def _stand_ins(space: ResidualSpace, truth: Explanation, rival: Effect) -> list[tuple[float, Effect]]:
    signature = space.project(space.signature(truth.effect) @ truth.values)
    instances = [rival, *thinned(type(rival).candidates(space.sightings))]
    return sorted(((_fitted(space, effect, signature)[1], effect) for effect in instances), key=lambda pair: pair[0])
