"""Next measurement: the one that gives most information on the instrument, or that decides between explanations.

The expected evidence between two explanations is a chi-square difference: the part of the true signature that the best
instance of the rival, at any of its places and shapes, does not explain. Since the true one is unknown, the smaller
difference is used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain

import numpy as np

from ltsim.adjustment import adjust
from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.remedies.detectability import thinned
from ltsim.adjustment.remedies.network import Network
from ltsim.adjustment.remedies.remedy import (
    EFFORT,
    Remedy,
    advice,
    calibrated_length,
    further_pointings,
    further_stations,
    listed,
    other_ways,
    returns,
)
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError
from ltsim.core.values import ValueEquality
from ltsim.physics.effects import find_effect, title_of
from ltsim.physics.effects.effect import Effect, NoiseEffect
from ltsim.physics.effects.signature import Signature
from ltsim.physics.effects.verbs import effect_tuple
from ltsim.physics.model.construction import declared_construction
from ltsim.recordings.exchange import RecordingSource, recording_of

DECISIVE = 10.0
"""Expected difference of chi-square from which two explanations count as distinguished."""
FINALISTS = 24
"""Number of additional places whose evidence is computed completely: those with most information on the instrument."""
MOVE = 1200.0
"""Default time [s] to move the instrument and set it up."""

Progress = Callable[[str, float], None]
"""Progress callback: name of the step, and finished fraction."""


def quiet(*_arguments: object) -> None:
    """Progress callback that does nothing."""


@dataclass(frozen=True)
class Explanation:
    """Effect at the place and with the shape that fit a recording best, and its size (q,) [SI]."""

    effect: Effect
    values: Floats


def space_of(adjustment: Adjustment, extra_effects: Sequence[Signature] = ()) -> ResidualSpace:
    """Residual space of an adjustment with `extra_effects` in the model."""
    return ResidualSpace.of(adjustment).with_effects(extra_effects)


def explanation(space: ResidualSpace, name: str) -> Explanation:
    """Explanation of a recording by the effect `name`, at the place and with the shape of the best fit.

    Raises ModelError for an unknown effect, and for one without a signature in this recording.
    """
    kind = find_effect(name)
    if issubclass(kind, NoiseEffect):
        raise ModelError(f"{name} is a change of the noise; only effects that shift readings can be separated here")
    best: Explanation | None = None
    least = float(space.residual @ space.residual)
    for effect in kind.candidates(space.sightings):
        values, sum_of_squares = _fitted(space, effect, space.residual)
        if sum_of_squares < least:
            least, best = sum_of_squares, Explanation(effect, values)
    if best is None:
        raise ModelError(f"{name} has no signature in this recording, so its size cannot be estimated from it")
    return best


def _fitted(space: ResidualSpace, effect: Effect, residual: Floats) -> tuple[Floats, float]:
    """Size (q,) of an effect that fits a projected vector best, and the remaining squared length."""
    projected = space.project(space.signature(effect))
    if not np.isfinite(projected).all() or not projected.any():
        return np.zeros(len(effect.parameters)), float(residual @ residual)
    values = np.asarray(np.linalg.lstsq(projected, residual, rcond=1e-6)[0], dtype=np.float64)
    return values, float(np.sum((residual - projected @ values) ** 2))


@dataclass(frozen=True)
class Rivals:
    """Rival explanations with all their alternative instances."""

    first: Explanation
    second: Explanation
    rival_instances: tuple[list[tuple[float, Effect]], list[tuple[float, Effect]]]
    """Alternative instances of the second explanation, with the part of the first that each leaves unexplained in the
    present recording, the smallest first; then the same with exchanged roles. Additional pointings never decrease these
    parts.
    """

    @classmethod
    def of(cls, space: ResidualSpace, first: Explanation, second: Explanation) -> Rivals:
        """Rivals of two explanations in the residual space of a recording."""
        return cls(
            first,
            second,
            (_rival_instances(space, first, second.effect), _rival_instances(space, second, first.effect)),
        )

    @property
    def now(self) -> float:
        """Evidence in the present recording."""
        return min(instances[0][0] for instances in self.rival_instances)

    def evidence(self, space: ResidualSpace) -> float:
        """Expected difference of chi-square in a longer recording, for either explanation."""
        least = []
        for truth, rival_instances in zip((self.first, self.second), self.rival_instances, strict=True):
            signature = space.project(space.signature(truth.effect) @ truth.values)
            smallest = float(signature @ signature)
            for before, effect in rival_instances:
                if before >= smallest:
                    break
                smallest = min(smallest, _fitted(space, effect, signature)[1])
            least.append(smallest)
        return min(least)


def _rival_instances(space: ResidualSpace, truth: Explanation, rival: Effect) -> list[tuple[float, Effect]]:
    signature = space.project(space.signature(truth.effect) @ truth.values)
    instances = [rival, *thinned(type(rival).candidates(space.sightings))]
    return sorted(((_fitted(space, effect, signature)[1], effect) for effect in instances), key=lambda pair: pair[0])


@dataclass(frozen=True)
class Proposal(ValueEquality):
    """Proposed measurement and its expected benefit."""

    remedy: Remedy
    sharper: float
    """Factor on the geometric mean of the parameters' standard deviations; below one is better."""
    serves: str
    """Parameter that gains most, and the factor on its standard deviation."""
    serves_factor: float
    evidence: dict[str, float] = field(default_factory=dict)
    """Expected chi-square difference between the first explanation and each other one, by name."""

    @classmethod
    def of(cls, remedy: Remedy, adjustment: Adjustment, evidence: dict[str, float] | None = None) -> Proposal:
        """Proposal from a remedy's gain for the first instrument of a planned network.

        Gain 1 for one without parameters.
        """
        if not adjustment.construction.n_parameters:
            return cls(remedy, 1.0, "", 1.0, evidence or {})
        before, after = adjustment.instrument_covariance, remedy.network.adjustment.instrument_covariance
        sharper = np.exp(0.5 / len(before) * (np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1]))
        ratio = np.sqrt(np.diag(after) / np.diag(before))
        best = int(np.argmin(ratio))
        return cls(
            remedy, float(sharper), adjustment.construction.parameter_names[best], float(ratio[best]), evidence or {}
        )

    @property
    def distinguished(self) -> tuple[str, ...]:
        """Names of the explanations that would be distinguished from the first."""
        return tuple(name for name, value in self.evidence.items() if value >= DECISIVE)

    @property
    def decides(self) -> bool:
        """True if all would be distinguished from the first."""
        return bool(self.evidence) and len(self.distinguished) == len(self.evidence)

    @property
    def rank(self) -> tuple[int, int, float, float]:
        """Sort key, smaller is better: number of distinguished explanations, then effort, then evidence."""
        near = sum(min(value, DECISIVE) for value in self.evidence.values())
        if not self.distinguished:
            return 0, 0, 0.0, -near
        return -len(self.distinguished), EFFORT.index(self.remedy.kind), self.remedy.seconds, -near


@dataclass(frozen=True)
class RankedProposals(ValueEquality):
    """Proposals of further measurements as networks, the best first."""

    proposals: tuple[Proposal, ...]
    between: tuple[str, ...] = ()
    """Names of the explanations to distinguish; empty for information on the instrument."""
    evidence_now: dict[str, float] = field(default_factory=dict)
    """Chi-square difference between the first and each other explanation in the present recording."""

    @property
    def advice(self) -> str:
        """Sentence on the deciding measurement, or on the most informative one without a question."""
        best = self.proposals[0]
        if not self.between:
            return best.remedy.words
        distinguished = best.distinguished or self.between[1:]
        now, then = (
            listed([f"{values[name]:.0f}" for name in distinguished]) for values in (self.evidence_now, best.evidence)
        )
        titles = {name: title_of(name) for name in self.between}
        others = listed([titles[name] for name in distinguished])
        values = {"first": titles[self.between[0]], "others": others, "then": then}
        if not best.distinguished:
            return advice("undecided", needed=DECISIVE, **values)
        sentence = advice("decided", do=best.remedy.words, now=now, **values)
        remaining = [titles[name] for name in self.between[1:] if name not in distinguished]
        return sentence + (advice("left open", others=listed(remaining)) if remaining else "")


def next_measurement(
    recording: RecordingSource,
    *,
    between: Sequence[str] = (),
    with_effects: str | Signature | Sequence[str | Signature] = (),
    minutes_per_move: float = 20.0,
    progress: Progress = quiet,
) -> RankedProposals:
    """Ranking of further measurements after a recording; arguments and errors as of `lt.next_measurement`."""
    measured = recording_of(recording)
    adjustment = adjust(measured, declared_construction(measured))
    adjustment.solution.require_success()
    if len(between) > 1:
        plain = space_of(adjustment)
        extra_effects = [explanation(plain, e).effect if isinstance(e, str) else e for e in effect_tuple(with_effects)]
        space = space_of(adjustment, extra_effects)
        asked = [explanation(space, name) for name in between]
        return deciding(adjustment, asked, extra_effects, seconds_per_move=60.0 * minutes_per_move, progress=progress)
    network, move = Network.of(adjustment), 60.0 * minutes_per_move
    every = *further_pointings(network), *returns(network, move), *further_stations(network, move)
    remedies = [remedy for remedy in every if remedy.is_determined]
    proposals = []
    for done, remedy in enumerate(remedies, 1):
        proposals.append(Proposal.of(remedy, network.adjustment))
        progress("trying further measurements", done / len(remedies))
    return RankedProposals(tuple(sorted(proposals, key=lambda p: p.sharper)))


def deciding(
    adjustment: Adjustment,
    explanations: Sequence[Explanation],
    extra_effects: Sequence[Signature] = (),
    *,
    seconds_per_move: float = MOVE,
    first_is_enough: bool = False,
    progress: Progress = quiet,
) -> RankedProposals:
    """Ranking of remedies by the evidence that they give between two or more explanations of an adjusted recording.

    Each explanation is to be distinguished from the first; those already distinguished are ignored. `extra_effects` are
    in the model. With `first_is_enough` the search ends at the first remedy that decides.
    """
    network, (first, *others) = Network.of(adjustment), explanations
    space = space_of(network.adjustment, extra_effects)
    rivals = {other.effect.name: Rivals.of(space, first, other) for other in others}
    decided = [name for name, pair in rivals.items() if pair.now >= DECISIVE]
    if len(decided) < len(rivals):
        rivals = {name: pair for name, pair in rivals.items() if name not in decided}
    suspects = [target for e in explanations for target in e.effect.targets]
    near = sorted(further_pointings(network, suspects), key=_effort)
    again = sorted(returns(network, seconds_per_move), key=_effort)
    late = sorted([*other_ways(network), *calibrated_length(network)], key=_effort)
    total = len(near) + len(again) + FINALISTS + len(late)
    judged: list[Proposal] = []
    every = chain(near, again, _finalists(network, seconds_per_move), late)
    for remedy in (candidate for candidate in every if candidate.is_determined):
        longer = space_of(remedy.network.adjustment, extra_effects)
        evidence = {name: pair.evidence(longer) for name, pair in rivals.items()}
        judged.append(Proposal.of(remedy, network.adjustment, evidence))
        progress("weighing the explanations", min(len(judged) / total, 1.0))
        if first_is_enough and judged[-1].decides:
            break
    ranked = tuple(sorted(judged, key=lambda p: p.rank))
    return RankedProposals(ranked, (first.effect.name, *rivals), {name: pair.now for name, pair in rivals.items()})


def _effort(remedy: Remedy) -> tuple[int, float]:
    return EFFORT.index(remedy.kind), remedy.seconds


def _finalists(network: Network, seconds_per_move: float) -> Iterator[Remedy]:
    """Additional stations with most information on the instrument, the quickest first."""
    remedies = (remedy for remedy in further_stations(network, seconds_per_move) if remedy.is_determined)
    proposals = [Proposal.of(remedy, network.adjustment) for remedy in remedies]
    best = sorted(proposals, key=lambda p: p.sharper)[:FINALISTS]
    yield from sorted((p.remedy for p in best), key=_effort)
