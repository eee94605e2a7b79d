"""Which explanation of a mismatch holds: the evidence between effects, in a recording and in one that is longer.

The expected evidence between two explanations is what the best instance of the rival, at any of its places and shapes,
leaves of the true signature: a difference of chi-square. Nobody knows which of the two is true; the smaller counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ltsim.adjust.adjustment import Adjustment
from ltsim.adjust.residual_space import ResidualSpace
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
    space = ResidualSpace.of(adjustment)
    return space.extended(np.hstack([space.signature(effect) for effect in beside])) if beside else space


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
class Question:
    """A first explanation against each of the others, with all that could stand in for either.

    Attributes
    ----------
    explanations : tuple of Explanation
    stand_ins : tuple of tuple of (float, Effect)
        For each pair, first explanation true and then the other one: every instance of the rival with what it leaves
        of the truth in the recording as it is, the least first. More pointings never leave less.
    """

    explanations: tuple[Explanation, ...]
    stand_ins: tuple[tuple[tuple[float, Effect], ...], ...]

    @classmethod
    def of(cls, space: ResidualSpace, explanations: Sequence[Explanation]) -> Question:
        """The question as the recording leaves it."""
        first, *others = explanations
        pairs = [pair for other in others for pair in ((first, other), (other, first))]
        return cls(tuple(explanations), tuple(_stand_ins(space, truth, rival.effect) for truth, rival in pairs))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the explanations."""
        return tuple(e.effect.name for e in self.explanations)

    def now(self) -> dict[str, float]:
        """Evidence between the first and each other in the recording as it is."""
        least = [pair[0][0] for pair in self.stand_ins]
        return dict(zip(self.names[1:], map(min, least[::2], least[1::2]), strict=True))

    def still_open(self, enough: float) -> Question:
        """The question without explanations that the recording tells from the first already; all where it does all."""
        keep = [i for i, value in enumerate(self.now().values()) if value < enough] or range(len(self.names) - 1)
        pairs = [self.stand_ins[2 * i + k] for i in keep for k in (0, 1)]
        return Question((self.explanations[0], *(self.explanations[1 + i] for i in keep)), tuple(pairs))

    def evidence(self, space: ResidualSpace) -> dict[str, float]:
        """Expected difference of chi-square between the first and each other in a longer recording."""
        first, *others = self.explanations
        truths = [truth for other in others for truth in (first, other)]
        least = [_least(space, truth, pair) for truth, pair in zip(truths, self.stand_ins, strict=True)]
        return dict(zip(self.names[1:], map(min, least[::2], least[1::2]), strict=True))


def _signature(space: ResidualSpace, truth: Explanation) -> Floats:
    return space.project(space.signature(truth.effect) @ truth.values)


def _stand_ins(space: ResidualSpace, truth: Explanation, rival: Effect) -> tuple[tuple[float, Effect], ...]:
    signature = _signature(space, truth)
    instances = [rival, *thinned(type(rival).candidates(space.sightings))]
    found = [(_fitted(space, effect, signature)[1], effect) for effect in instances]
    return tuple(sorted(found, key=lambda pair: pair[0]))


def _least(space: ResidualSpace, truth: Explanation, stand_ins: Sequence[tuple[float, Effect]]) -> float:
    """What the best stand-in leaves of the true signature."""
    signature = _signature(space, truth)
    least = float(signature @ signature)
    for before, effect in stand_ins:
        if before >= least:
            break
        least = min(least, _fitted(space, effect, signature)[1])
    return least
