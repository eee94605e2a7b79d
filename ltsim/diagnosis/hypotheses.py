"""Hypotheses, sets of findings, rankings: what a search handles."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product

import numpy as np

from ltsim.adjustment.residual_space import VISIBLE, orthonormal
from ltsim.calibration.evidence import LOG_WEIGHTS, SIZES, log_sum_exp
from ltsim.core.arrays import Floats, Ints
from ltsim.diagnosis.evidence import best_of
from ltsim.diagnosis.prior import LOG_ODDS_REPEATED, P_UNMODELLED
from ltsim.physics.effects import find_effect
from ltsim.physics.effects.signature import Tunable


@dataclass(frozen=True)
class Hypothesis:
    """One thing that may be missing from the model, and the log prior of its place and shape.

    Attributes
    ----------
    effect : Tunable
    log_prior : float
    value : float
        Log evidence beside what was found when it was examined, prior and shapes included.
    name : str
        Tunable id, or `unknown`.
    """

    effect: Tunable
    log_prior: float
    value: float
    name: str

    @property
    def spread(self) -> Floats:
        """Plausible sizes (k,) of its coefficients [SI]."""
        return self.effect.spread

    @property
    def is_catalogued(self) -> bool:
        """Whether the catalogue has a card for it."""
        return self.name != "unknown"

    @property
    def key(self) -> str:
        """Key that distinguishes two findings."""
        return repr(self.effect)


@dataclass(frozen=True)
class Model:
    """A set of findings; columns and residual beside it are computed where they are asked for.

    Attributes
    ----------
    members : tuple of Hypothesis
    left : tuple of (m, k) float
        What the adjustment leaves of their signatures.
    norms : tuple of (k,) float
        Lengths of the signatures' columns before that.
    whole : (m,) float
        What is left beside nothing.
    """

    members: tuple[Hypothesis, ...]
    projected: tuple[Floats, ...]
    norms: tuple[Floats, ...]
    baseline_residual: Floats = field(repr=False)

    @property
    def effects(self) -> list[Tunable]:
        """Effects of the members."""
        return [h.effect for h in self.members]

    @cached_property
    def basis(self) -> Floats:
        """(m, e): orthonormal columns of all members."""
        if not self.members:
            return np.zeros((len(self.baseline_residual), 0))
        return orthonormal(np.hstack(self.projected), np.concatenate(self.norms))

    @cached_property
    def residual(self) -> Floats:
        """(m,): what is left beside the members."""
        residual: Floats = self.baseline_residual - self.basis @ (self.basis.T @ self.baseline_residual)
        return residual

    @cached_property
    def products(self) -> tuple[Floats, Floats]:
        """Products (k, k) of what is left of all signatures with each other, and (k,) with the residual."""
        projected = np.hstack(self.projected)
        return projected.T @ projected, projected.T @ self.baseline_residual

    @cached_property
    def discrepancy_penalty(self) -> float:
        """Log evidence that what is left may show because the curve of an unknown law is not quite right."""
        if all(h.is_catalogued for h in self.members):
            return 0.0
        norms = np.concatenate(self.norms)
        unit = 1.0 / np.where(norms > 0, norms, 1.0)
        gram, score = self.products
        strength, turn = np.linalg.eigh(gram * np.outer(unit, unit))
        visible = strength > VISIBLE
        return 0.5 * MISFIT * float(np.sum((turn.T @ (unit * score))[visible] ** 2 / strength[visible]))

    @cached_property
    def score(self) -> float:
        """Log evidence of the set, the sizes of all members averaged, priors and misfit counted."""
        if not self.members:
            return 0.0
        likeness = sum(log_odds_repeated(h, self.members[:i]) for i, h in enumerate(self.members))
        doubt = self.discrepancy_penalty * (len(self.members) - 1)
        return _over_sizes(self) + sum(h.log_prior for h in self.members) + likeness - doubt


MISFIT = 0.05
"""Share of its square to which a law that nobody knows is drawn: what is left of it is no further cause."""


@dataclass(frozen=True)
class Ranking:
    """Hypotheses beside a set in the order of their evidence.

    Attributes
    ----------
    entries : tuple of Hypothesis
    total : float
        Log sum over them, the first computed exactly.
    outside : float
        Log evidence of a cause that nobody listed.
    """

    entries: tuple[Hypothesis, ...]
    total: float
    log_evidence_unmodelled: float = -np.inf

    def with_rivals(self, rivals: Sequence[Hypothesis]) -> Ranking:
        """The ranking with further hypotheses in it."""
        entries = sorted([*self.entries, *rivals], key=lambda h: -h.value)
        total = float(log_sum_exp(np.array([self.total, *(h.value for h in rivals)])))
        return Ranking(tuple(entries), total)

    def with_unmodelled_cause(self, likeness: float) -> Ranking:
        """The ranking with a cause in it that nobody listed, by the log ratio of its likelihood to that of the best."""
        return replace(
            self, log_evidence_unmodelled=self.total + likeness + float(np.log(P_UNMODELLED / (1.0 - P_UNMODELLED)))
        )

    def name(self) -> str:
        """The likeliest name."""
        return likeliest(self.probabilities())

    @cached_property
    def weights(self) -> Floats:
        """Posterior probability (k,) of each among everything that was tried, nothing at all included."""
        logs = np.array([h.value for h in self.entries])
        probabilities: Floats = np.exp(logs - self._whole)
        return probabilities

    @cached_property
    def _whole(self) -> float:
        """Log sum of all explanations, that nothing is missing among them."""
        return float(np.logaddexp.reduce([*(h.value for h in self.entries), self.log_evidence_unmodelled, 0.0]))

    @cached_property
    def p_unmodelled(self) -> float:
        """Posterior probability of a cause that nobody listed."""
        return float(np.exp(self.log_evidence_unmodelled - self._whole))

    def share(self, chosen: Callable[[Hypothesis], bool]) -> float:
        """Posterior probability of some of them together."""
        return min(sum(w for h, w in zip(self.entries, self.weights.tolist(), strict=True) if chosen(h)), 1.0)

    def probabilities(self) -> dict[str, float]:
        """Posterior probability of each name."""
        named = {"unknown": self.p_unmodelled} if self.p_unmodelled else {}
        for hypothesis, weight in zip(self.entries, self.weights.tolist(), strict=True):
            named[hypothesis.name] = min(named.get(hypothesis.name, 0.0) + weight, 1.0)
        return named


def likeliest(chances: Mapping[str, float]) -> str:
    """The likeliest name by its probability; `unknown` where that is likelier than all names together."""
    named = {name: chance for name, chance in chances.items() if name != "unknown"}
    return "unknown" if chances.get("unknown", 0.0) > sum(named.values()) else max(named, key=lambda name: named[name])


NEGLIGIBLE = 6.0
"""Log evidence that a size of one member is behind the best, the others at theirs, from which it is left out."""


def _over_sizes(model: Model) -> float:
    """Log evidence of coefficients with prior N(0, (t spread)^2) of each member, averaged over all sizes t.

    Only sizes that count are summed: those which are near the best of a member while the others are at their best.
    """
    gram, score = model.products
    spread, owner = _spreads(model.members)
    count, whole = len(model.members), 1.0 + float(model.baseline_residual @ model.baseline_residual)
    bordered = np.block([[gram, score[:, None]], [score, whole]])
    unit_prior = np.diag(np.append(np.ones(len(score)), 0.0))

    def evidence(sizes: Ints) -> Floats:
        """Log evidence with prior (b,) at sizes (b, members)."""
        scale = np.pad(SIZES[sizes][:, owner] * spread, ((0, 0), (0, 1)), constant_values=1.0)
        factor = np.linalg.cholesky(bordered * scale[:, :, None] * scale[:, None, :] + unit_prior)
        fit = 0.5 * np.sum(factor[:, -1, :-1] ** 2, axis=1)  # the last row is what the factor makes of the residual
        size = np.sum(np.log(np.diagonal(factor, axis1=1, axis2=2)[:, :-1]), axis=1)
        value: Floats = fit - size + LOG_WEIGHTS[sizes].sum(axis=1)
        return value

    best, every = np.full(count, int(np.flatnonzero(SIZES == 1.0)[0])), np.arange(len(SIZES))
    near = [every] * count
    for _ in range(2 if count > 1 else 0):
        for i in range(count):
            tried = np.tile(best, (len(SIZES), 1))
            tried[:, i] = every
            values = evidence(tried)
            best[i] = best_of(values)
            near[i] = every[values > values.max() - NEGLIGIBLE]
    return float(log_sum_exp(evidence(np.array(list(product(*near))))))


def _spreads(members: Sequence[Hypothesis]) -> tuple[Floats, Ints]:
    """Plausible sizes (k,) of all coefficients, and which member each belongs to."""
    each = [h.spread for h in members]
    return np.concatenate(each), np.repeat(np.arange(len(each)), [len(spread) for spread in each])


def log_odds_repeated(hypothesis: Hypothesis, others: Sequence[Hypothesis]) -> float:
    """Log odds of a second effect of a kind that hardly comes twice."""
    if hypothesis.name not in {h.name for h in others}:
        return 0.0
    return 0.0 if hypothesis.is_catalogued and find_effect(hypothesis.name).plural else LOG_ODDS_REPEATED
