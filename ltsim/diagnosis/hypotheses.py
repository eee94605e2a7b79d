"""Hypotheses, models (sets of hypotheses), and rankings of hypotheses given a model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product

import numpy as np

from ltsim.adjustment.residual_space import orthonormal_columns
from ltsim.adjustment.significance import MIN_LOG_EVIDENCE_CERTAIN, MIN_REPORTED_PROBABILITY
from ltsim.calibration.evidence import EVIDENCE_SIZES, LOG_SIZE_PRIOR, log_sum_exp
from ltsim.core.arrays import Floats, Ints
from ltsim.core.rounding import MAX_SOLUTION_ROUNDING_ERROR
from ltsim.diagnosis.evidence import index_of_best
from ltsim.diagnosis.prior import LOG_ODDS_REPEATED, P_UNMODELLED
from ltsim.diagnosis.schema import Equivalent
from ltsim.physics.effects import find_effect
from ltsim.physics.effects.signature import CandidateEffect

MAX_EQUIVALENTS = 3
"""Largest number of reported equivalents."""


@dataclass(frozen=True)
class Hypothesis:
    """Hypothesis: possible cause of a misfit, with the log prior of its place and shape.

    Attributes
    ----------
    effect : CandidateEffect
    log_prior : float
    log_evidence : float
        Log evidence given the model at its evaluation, prior and shapes included.
    name : str
        Id of the catalogue effect, or `unknown`.
    """

    effect: CandidateEffect
    log_prior: float
    log_evidence: float
    name: str

    @property
    def plausible_sizes(self) -> Floats:
        """Plausible sizes (k,) of its coefficients [SI]."""
        return self.effect.size_scales

    @property
    def is_catalogued(self) -> bool:
        """True if it is an effect of the catalogue."""
        return self.name != "unknown"

    @property
    def key(self) -> str:
        """Key that distinguishes two findings."""
        return repr(self.effect)


@dataclass(frozen=True)
class Model:
    """Model: a set of hypotheses; its basis and residual are computed on demand.

    Attributes
    ----------
    members : tuple of Hypothesis
    projected_signatures : tuple of (m, k) float
        Signatures of the members, projected onto the residual space.
    signature_norms : tuple of (k,) float
        Lengths of the signatures' columns before the projection.
    baseline_residual : (m,) float
        Residual of the empty model.
    """

    members: tuple[Hypothesis, ...]
    projected_signatures: tuple[Floats, ...]
    signature_norms: tuple[Floats, ...]
    baseline_residual: Floats = field(repr=False)

    @property
    def effects(self) -> list[CandidateEffect]:
        """Effects of the members."""
        return [h.effect for h in self.members]

    @cached_property
    def basis(self) -> Floats:
        """Orthonormal basis (m, e) of the projected signatures."""
        if not self.members:
            return np.zeros((len(self.baseline_residual), 0))
        return orthonormal_columns(np.hstack(self.projected_signatures), np.concatenate(self.signature_norms))

    @cached_property
    def residual(self) -> Floats:
        """Residual (m,) with the members modelled."""
        residual: Floats = self.baseline_residual - self.basis @ (self.basis.T @ self.baseline_residual)
        return residual

    @cached_property
    def gram_and_scores(self) -> tuple[Floats, Floats]:
        """Gram matrix (k, k) of the projected signatures, and their products (k,) with the baseline residual."""
        projected_signature = np.hstack(self.projected_signatures)
        return projected_signature.T @ projected_signature, projected_signature.T @ self.baseline_residual

    @cached_property
    def discrepancy_penalty(self) -> float:
        """Log evidence that the discrepancy of an empirical law may produce; a further effect must exceed it."""
        if all(h.is_catalogued for h in self.members):
            return 0.0
        norms = np.concatenate(self.signature_norms)
        unit = 1.0 / np.where(norms > 0, norms, 1.0)
        gram, score = self.gram_and_scores
        strength, turn = np.linalg.eigh(gram * np.outer(unit, unit))
        is_visible = strength > MAX_SOLUTION_ROUNDING_ERROR
        return (
            0.5
            * RELATIVE_MODEL_ERROR
            * float(np.sum((turn.T @ (unit * score))[is_visible] ** 2 / strength[is_visible]))
        )

    @cached_property
    def score(self) -> float:
        """Log evidence of the model, averaged over sizes, with priors and the discrepancy penalty."""
        if not self.members:
            return 0.0
        likeness = sum(log_odds_repeated(h, self.members[:i]) for i, h in enumerate(self.members))
        doubt = self.discrepancy_penalty * (len(self.members) - 1)
        return _log_evidence_over_sizes(self) + sum(h.log_prior for h in self.members) + likeness - doubt


RELATIVE_MODEL_ERROR = 0.05
"""Relative model error of an empirical law: this fraction of the chi-square that it explains is not attributed to a
second effect.
"""


@dataclass(frozen=True)
class Ranking:
    """Ranking of hypotheses given a model, in the order of their evidence.

    Attributes
    ----------
    entries : tuple of Hypothesis
    log_evidence_total : float
        Log sum over them, the first ones evaluated without approximation.
    log_evidence_unmodelled : float
        Log evidence of an unmodelled cause.
    """

    entries: tuple[Hypothesis, ...]
    log_evidence_total: float
    log_evidence_unmodelled: float = -np.inf

    def with_rivals(self, rivals: Sequence[Hypothesis]) -> Ranking:
        """Ranking with additional hypotheses."""
        entries = sorted([*self.entries, *rivals], key=lambda h: -h.log_evidence)
        total = float(log_sum_exp(np.array([self.log_evidence_total, *(h.log_evidence for h in rivals)])))
        return Ranking(tuple(entries), total)

    def with_unmodelled_cause(self, log_bayes_factor: float) -> Ranking:
        """Ranking with an unmodelled cause, of a given log Bayes factor against the best hypothesis."""
        return replace(
            self,
            log_evidence_unmodelled=self.log_evidence_total
            + log_bayes_factor
            + float(np.log(P_UNMODELLED / (1.0 - P_UNMODELLED))),
        )

    def most_probable_name(self) -> str:
        """Most probable name."""
        return most_probable_name(self.probabilities_by_name())

    @cached_property
    def posterior_probabilities(self) -> Floats:
        """Posterior probability (k,) of each among all hypotheses and none."""
        logs = np.array([h.log_evidence for h in self.entries])
        probabilities: Floats = np.exp(logs - self._log_evidence_sum)
        return probabilities

    @cached_property
    def _log_evidence_sum(self) -> float:
        """Log sum of the evidence of all hypotheses and none."""
        return float(np.logaddexp.reduce([*(h.log_evidence for h in self.entries), self.log_evidence_unmodelled, 0.0]))

    @property
    def p_none(self) -> float:
        """Posterior probability that no hypothesis is true, nor any unmodelled cause."""
        return float(np.exp(-self._log_evidence_sum))

    @cached_property
    def p_unmodelled(self) -> float:
        """Posterior probability of an unmodelled cause."""
        return float(np.exp(self.log_evidence_unmodelled - self._log_evidence_sum))

    def posterior_probability_of(self, is_counted: Callable[[Hypothesis], bool]) -> float:
        """Posterior probability of the `is_counted` hypotheses together."""
        return min(
            sum(w for h, w in zip(self.entries, self.posterior_probabilities.tolist(), strict=True) if is_counted(h)),
            1.0,
        )

    def probabilities_by_name(self) -> dict[str, float]:
        """Posterior probability of each name."""
        by_name = {"unknown": self.p_unmodelled} if self.p_unmodelled else {}
        for hypothesis, weight in zip(self.entries, self.posterior_probabilities.tolist(), strict=True):
            by_name[hypothesis.name] = min(by_name.get(hypothesis.name, 0.0) + weight, 1.0)
        return by_name


def most_probable_name(probabilities: Mapping[str, float]) -> str:
    """Most probable name; `unknown` if that is more probable than all names together."""
    by_name = {name: chance for name, chance in probabilities.items() if name != "unknown"}
    return (
        "unknown"
        if probabilities.get("unknown", 0.0) > sum(by_name.values())
        else max(by_name, key=lambda name: by_name[name])
    )


def name_probabilities(chances: Mapping[str, float], name: str) -> tuple[float, tuple[Equivalent, ...]]:
    """Probability of a name, and the most probable other names that are not excluded."""
    others = [
        Equivalent(effect=n, probability=p) for n, p in chances.items() if n != name and p > MIN_REPORTED_PROBABILITY
    ]
    return chances.get(name, 0.0), tuple(sorted(others, key=lambda other: -other.probability)[:MAX_EQUIVALENTS])


def _log_evidence_over_sizes(model: Model) -> float:
    """Log evidence of coefficients with prior N(0, (t spread)^2) of each member, averaged over all sizes t.

    Only sizes near the optimum of a member, with the others at their optimum, are summed.
    """
    gram, score = model.gram_and_scores
    spread, owner = _plausible_sizes(model.members)
    count, whole = len(model.members), 1.0 + float(model.baseline_residual @ model.baseline_residual)
    bordered_matrix = np.block([[gram, score[:, None]], [score, whole]])
    unit_prior = np.diag(np.append(np.ones(len(score)), 0.0))

    def evidence(sizes: Ints) -> Floats:
        """Log evidence with prior (b,) at sizes (b, members)."""
        scale = np.pad(EVIDENCE_SIZES[sizes][:, owner] * spread, ((0, 0), (0, 1)), constant_values=1.0)
        factor = np.linalg.cholesky(bordered_matrix * scale[:, :, None] * scale[:, None, :] + unit_prior)
        fit = 0.5 * np.sum(factor[:, -1, :-1] ** 2, axis=1)  # the last row of the factor holds the solved residual
        size = np.sum(np.log(np.diagonal(factor, axis1=1, axis2=2)[:, :-1]), axis=1)
        value: Floats = fit - size + LOG_SIZE_PRIOR[sizes].sum(axis=1)
        return value

    best, every = np.full(count, int(np.flatnonzero(EVIDENCE_SIZES == 1.0)[0])), np.arange(len(EVIDENCE_SIZES))
    neighbours = [every] * count
    for _ in range(2 if count > 1 else 0):
        for i in range(count):
            tried = np.tile(best, (len(EVIDENCE_SIZES), 1))
            tried[:, i] = every
            values = evidence(tried)
            best[i] = index_of_best(values)
            neighbours[i] = every[values > values.max() - MIN_LOG_EVIDENCE_CERTAIN]
    return float(log_sum_exp(evidence(np.array(list(product(*neighbours))))))


def _plausible_sizes(members: Sequence[Hypothesis]) -> tuple[Floats, Ints]:
    """Plausible sizes (k,) of all coefficients, and the member (k,) of each."""
    size_sets = [h.plausible_sizes for h in members]
    return np.concatenate(size_sets), np.repeat(np.arange(len(size_sets)), [len(spread) for spread in size_sets])


def log_odds_repeated(hypothesis: Hypothesis, other_members: Sequence[Hypothesis]) -> float:
    """Log prior odds of a repeated effect of a kind that rarely occurs twice; 0 for all others."""
    if hypothesis.name not in {h.name for h in other_members}:
        return 0.0
    return 0.0 if hypothesis.is_catalogued and find_effect(hypothesis.name).may_recur else LOG_ODDS_REPEATED
