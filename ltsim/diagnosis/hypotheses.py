"""Hypotheses, models (sets of hypotheses), and rankings of hypotheses given a model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace, orthonormal_columns
from ltsim.adjustment.significance import MIN_LOG_EVIDENCE_CERTAIN, MIN_REPORTED_PROBABILITY
from ltsim.calibration.evidence import LOG_PRIOR_OF_EFFECT_SIZES, RELATIVE_EFFECT_SIZES, log_sum_exp
from ltsim.core.arrays import Floats, Ints
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE
from ltsim.diagnosis.evidence import index_of_most_evidence
from ltsim.diagnosis.prior import LOG_PRIOR_ODDS_OF_REPETITION, P_UNMODELLED_CAUSE
from ltsim.diagnosis.schema import EquivalentEffect
from ltsim.physics.effects import find_effect
from ltsim.physics.effects.linear_effect import CandidateEffect

MAX_LISTED_EQUIVALENT_EFFECTS = 3
"""Largest number of equivalent effects (effects that cannot be excluded as the cause) that a finding lists."""


@dataclass(frozen=True)
class Hypothesis:
    """Hypothesis: possible cause of a misfit, an effect at given stations and targets with given shape parameters.

    Shape parameters enter the readings nonlinearly (period, time constant, onset time).
    """

    effect: CandidateEffect
    """Catalogue effect or empirical law (error as a function of covariates), with the stations and targets where it
    acts and with its shape parameters."""
    log_prior: float
    """Log prior probability of the effect at these stations and targets with these shape parameters."""
    log_evidence: float
    """Log evidence of the effect with its prior, averaged over similar shape parameters, given other effects in a
    model."""
    name: str
    """Name of the effect in the catalogue, or `unknown`."""

    @property
    def plausible_sizes(self) -> Floats:
        """Plausible sizes (k,) of the k coefficients of the effect [SI]."""
        return self.effect.plausible_sizes

    @property
    def is_catalogued(self) -> bool:
        """True if the hypothesis is a catalogue effect, False for an empirical law outside the catalogue.

        An empirical law describes an error as a function of covariates.
        """
        return self.name != "unknown"

    @property
    def effect_key(self) -> str:
        """Text that identifies the effect with its stations, targets and shape parameters."""
        return repr(self.effect)


@dataclass(frozen=True)
class EffectModel:
    """Model: a set of hypotheses that are true at the same time, with the residuals after their estimation."""

    hypotheses: tuple[Hypothesis, ...]
    """Hypotheses of the model, one per effect."""
    projected_designs: tuple[Floats, ...]
    """Design matrix (m, k) of each effect, projected onto the residual space: change of m whitened residuals per unit
    of its k coefficients."""
    design_column_norms: tuple[Floats, ...]
    """Norms (k,) of the k design columns of each effect before the projection onto the residual space."""
    baseline_residual: Floats = field(repr=False)
    """Whitened residuals (m,) of m observation equations in the adjustment without the effects of the model."""

    @classmethod
    def from_residual_space(cls, hypotheses: Sequence[Hypothesis], space: ResidualSpace) -> EffectModel:
        """Model with the given hypotheses in the residual space `space` of an adjustment.

        The residual space is the space of whitened observations without the part that the unknowns absorb.
        """
        designs = [space.whitened_design(h.effect) for h in hypotheses]
        norms = map(space.norms_without_centring, designs)
        return cls(tuple(hypotheses), tuple(map(space.project, designs)), tuple(norms), space.whitened_residuals)

    @property
    def effects(self) -> list[CandidateEffect]:
        """Effects of the hypotheses in the model."""
        return [h.effect for h in self.hypotheses]

    @cached_property
    def projected_basis(self) -> Floats:
        """Orthonormal basis (m, e) of e vectors for the changes of m whitened residuals by all effects in the model."""
        if not self.hypotheses:
            return np.zeros((len(self.baseline_residual), 0))
        return orthonormal_columns(np.hstack(self.projected_designs), np.concatenate(self.design_column_norms))

    @cached_property
    def residual(self) -> Floats:
        """Whitened residuals (m,) of m observation equations in the adjustment with all effects of the model."""
        residual: Floats = self.baseline_residual - self.projected_basis @ (
            self.projected_basis.T @ self.baseline_residual
        )
        return residual

    @cached_property
    def gram_and_score(self) -> tuple[Floats, Floats]:
        """Gram matrix (k, k) of the k design columns of all effects, and their products (k,) with the residuals.

        The columns are projected onto the residual space. The residuals are those of the adjustment without effects.
        """
        projected_design = np.hstack(self.projected_designs)
        return projected_design.T @ projected_design, projected_design.T @ self.baseline_residual

    @cached_property
    def discrepancy_penalty(self) -> float:
        """Additional log evidence required of a further effect, because the function of an empirical law is imperfect.

        An empirical law describes an error as a function of covariates. A model with catalogue effects only has the
        penalty 0.
        """
        if all(h.is_catalogued for h in self.hypotheses):
            return 0.0
        norms = np.concatenate(self.design_column_norms)
        unit = 1.0 / np.where(norms > 0, norms, 1.0)
        gram, score = self.gram_and_score
        eigenvalues, eigenvectors = np.linalg.eigh(gram * np.outer(unit, unit))
        is_visible = eigenvalues > NORMAL_EQUATIONS_TOLERANCE
        return (
            0.5
            * UNCERTAIN_CHI2_FRACTION_OF_LAW
            * float(np.sum((eigenvectors.T @ (unit * score))[is_visible] ** 2 / eigenvalues[is_visible]))
        )

    @cached_property
    def log_evidence(self) -> float:
        """Log evidence of the model with the priors of its effects, averaged over their sizes."""
        if not self.hypotheses:
            return 0.0
        log_prior_odds = sum(
            log_prior_odds_of_repetition(h, self.hypotheses[:i]) for i, h in enumerate(self.hypotheses)
        )
        return _size_averaged_log_evidence(self) + sum(h.log_prior for h in self.hypotheses) + log_prior_odds

    @property
    def penalised_log_evidence(self) -> float:
        """Log evidence of the model minus a penalty, `discrepancy_penalty`, for each effect after the first."""
        return self.log_evidence - self.discrepancy_penalty * max(len(self.hypotheses) - 1, 0)


UNCERTAIN_CHI2_FRACTION_OF_LAW = 0.05
"""Fraction of the chi-square decrease by an empirical law (error as a function of covariates) that the decrease by a
further effect must exceed. The function is an approximation, and a second effect could otherwise describe its error."""


@dataclass(frozen=True)
class HypothesisRanking:
    """Ranking of the hypotheses that may be added to a model, in the order of decreasing evidence."""

    hypotheses: tuple[Hypothesis, ...]
    """Hypotheses in the order of decreasing log evidence."""
    total_log_evidence: float
    """Log of the sum of the evidence of all hypotheses, of which only the most probable are evaluated without
    approximation."""
    log_evidence_of_unmodelled_cause: float = -np.inf
    """Log evidence of a cause that is no hypothesis of the ranking; minus infinity if it is not considered."""
    log_evidence_of_no_cause: float = 0.0
    """Log evidence of the absence of any cause: 0, or a larger value if held-out readings contradict the model."""

    def most_probable_of_each_kind(self) -> list[Hypothesis]:
        """Hypotheses with the largest evidence: one of each catalogue effect, and one law of each response.

        An empirical law describes an error as a function of covariates. The response is the quantity that an empirical
        law changes. The order is that of the ranking.
        """
        first: dict[tuple[str, str], Hypothesis] = {}
        for hypothesis in self.hypotheses:
            first.setdefault(
                (hypothesis.name, getattr(getattr(hypothesis.effect, "response", None), "name", "")), hypothesis
            )
        return list(first.values())

    def with_further_hypotheses(self, rivals: Sequence[Hypothesis]) -> HypothesisRanking:
        """Copy of the ranking that also contains the hypotheses `rivals`, which explain the same residuals."""
        hypotheses = sorted([*self.hypotheses, *rivals], key=lambda h: -h.log_evidence)
        log_total = float(log_sum_exp(np.array([self.total_log_evidence, *(h.log_evidence for h in rivals)])))
        return HypothesisRanking(tuple(hypotheses), log_total)

    def with_unmodelled_cause(self, log_bayes_factor: float) -> HypothesisRanking:
        """Copy of the ranking with an unmodelled cause, given its log Bayes factor against the first hypothesis.

        An unmodelled cause is no hypothesis of the ranking, but resembles its first hypothesis.
        """
        return replace(
            self,
            log_evidence_of_unmodelled_cause=self.total_log_evidence
            + log_bayes_factor
            + float(np.log(P_UNMODELLED_CAUSE / (1.0 - P_UNMODELLED_CAUSE))),
        )

    def with_held_out_evidence(self, log_odds_of_model: float) -> HypothesisRanking:
        """Copy of the ranking in which all causes together have at most the odds of the model by held-out readings.

        `log_odds_of_model` are the log odds of the model against no effect; 0 if held-out readings do not contradict
        the model.
        """
        if log_odds_of_model >= 0.0:
            return self
        total = float(np.logaddexp(self.total_log_evidence, self.log_evidence_of_unmodelled_cause))
        return replace(self, log_evidence_of_no_cause=max(self.log_evidence_of_no_cause, total - log_odds_of_model))

    def most_probable_name(self) -> str:
        """Most probable name of the cause; `unknown` if it is more probable than all catalogue effects together."""
        return most_probable_name(self.probabilities_by_name())

    @cached_property
    def posterior_probabilities(self) -> Floats:
        """Posterior probability of each hypothesis; an unmodelled cause and no cause are among the alternatives."""
        log_evidences = np.array([h.log_evidence for h in self.hypotheses])
        probabilities: Floats = np.exp(log_evidences - self._log_evidence_sum)
        return probabilities

    @cached_property
    def _log_evidence_sum(self) -> float:
        """Log of the sum of the evidence of all hypotheses, of an unmodelled cause, and of no cause."""
        rest = [self.log_evidence_of_unmodelled_cause, self.log_evidence_of_no_cause]
        return float(np.logaddexp.reduce([*(h.log_evidence for h in self.hypotheses), *rest]))

    @property
    def p_no_cause(self) -> float:
        """Posterior probability that there is no cause: neither a hypothesis of the ranking nor an unmodelled cause."""
        return float(np.exp(self.log_evidence_of_no_cause - self._log_evidence_sum))

    @cached_property
    def p_unmodelled_cause(self) -> float:
        """Posterior probability of a cause that is no hypothesis of the ranking."""
        return float(np.exp(self.log_evidence_of_unmodelled_cause - self._log_evidence_sum))

    def posterior_probability_of(self, is_counted: Callable[[Hypothesis], bool]) -> float:
        """Sum of the posterior probabilities of the hypotheses for which `is_counted` is true."""
        return min(
            sum(
                w for h, w in zip(self.hypotheses, self.posterior_probabilities.tolist(), strict=True) if is_counted(h)
            ),
            1.0,
        )

    def probabilities_by_name(self) -> dict[str, float]:
        """Sum of the posterior probabilities of the hypotheses with each name, including `unknown`."""
        p_by_name = {"unknown": self.p_unmodelled_cause} if self.p_unmodelled_cause else {}
        for hypothesis, weight in zip(self.hypotheses, self.posterior_probabilities.tolist(), strict=True):
            p_by_name[hypothesis.name] = min(p_by_name.get(hypothesis.name, 0.0) + weight, 1.0)
        return p_by_name


def most_probable_name(probabilities: Mapping[str, float]) -> str:
    """Most probable name of a cause; `unknown` if it is more probable than all other names together.

    `probabilities` are the probabilities by name.
    """
    p_by_name = {name: p for name, p in probabilities.items() if name != "unknown"}
    return (
        "unknown"
        if probabilities.get("unknown", 0.0) > sum(p_by_name.values())
        else max(p_by_name, key=lambda name: p_by_name[name])
    )


def probability_and_equivalents(
    probabilities: Mapping[str, float], name: str
) -> tuple[float, tuple[EquivalentEffect, ...]]:
    """Probability of the cause `name`, and the most probable other names that are not excluded.

    `probabilities` are the probabilities by name.
    """
    equivalents = [
        EquivalentEffect(effect=other_name, probability=p)
        for other_name, p in probabilities.items()
        if other_name != name and p > MIN_REPORTED_PROBABILITY
    ]
    return probabilities.get(name, 0.0), tuple(
        sorted(equivalents, key=lambda other: -other.probability)[:MAX_LISTED_EQUIVALENT_EFFECTS]
    )


def _size_averaged_log_evidence(model: EffectModel) -> float:
    """Log evidence of a model, averaged over factors t on the plausible sizes of its effects.

    The coefficients of an effect in the model have the prior N(0, (t size)^2) with their plausible sizes. The sum
    covers only the factors near the combination of factors with the largest evidence.
    """
    gram, score = model.gram_and_score
    spread, owner = _plausible_sizes_and_effect_indices(model.hypotheses)
    count, whole = len(model.hypotheses), 1.0 + float(model.baseline_residual @ model.baseline_residual)
    bordered_matrix = np.block([[gram, score[:, None]], [score, whole]])
    unit_prior = np.diag(np.append(np.ones(len(score)), 0.0))

    def log_evidence_at_sizes(sizes: Ints) -> Floats:
        """Log evidence (b,), with prior, of b sets of sizes (b, effects), as indices of `RELATIVE_EFFECT_SIZES`."""
        scale = np.pad(RELATIVE_EFFECT_SIZES[sizes][:, owner] * spread, ((0, 0), (0, 1)), constant_values=1.0)
        factor = np.linalg.cholesky(bordered_matrix * scale[:, :, None] * scale[:, None, :] + unit_prior)
        fit = 0.5 * np.sum(factor[:, -1, :-1] ** 2, axis=1)  # the last row of the factor holds the solved residual
        half_log_determinants = np.sum(np.log(np.diagonal(factor, axis1=1, axis2=2)[:, :-1]), axis=1)
        value: Floats = fit - half_log_determinants + LOG_PRIOR_OF_EFFECT_SIZES[sizes].sum(axis=1)
        return value

    best, every = (
        np.full(count, int(np.flatnonzero(RELATIVE_EFFECT_SIZES == 1.0)[0])),
        np.arange(len(RELATIVE_EFFECT_SIZES)),
    )
    neighbours = [every] * count
    for _ in range(2 if count > 1 else 0):
        for i in range(count):
            tried = np.tile(best, (len(RELATIVE_EFFECT_SIZES), 1))
            tried[:, i] = every
            values = log_evidence_at_sizes(tried)
            best[i] = index_of_most_evidence(values)
            neighbours[i] = every[values > values.max() - MIN_LOG_EVIDENCE_CERTAIN]
    return float(log_sum_exp(log_evidence_at_sizes(np.array(list(product(*neighbours))))))


def _plausible_sizes_and_effect_indices(hypotheses: Sequence[Hypothesis]) -> tuple[Floats, Ints]:
    """Plausible sizes (k,) of all k coefficients of the effects in a model, and indices (k,) of their effects."""
    size_sets = [h.plausible_sizes for h in hypotheses]
    return np.concatenate(size_sets), np.repeat(np.arange(len(size_sets)), [len(spread) for spread in size_sets])


def log_prior_odds_of_repetition(hypothesis: Hypothesis, other_hypotheses: Sequence[Hypothesis]) -> float:
    """Log prior odds of a rare case: a second effect with the same name as another effect of the model.

    `other_hypotheses` are the other effects in the model. The result is 0 if none of them has the name of `hypothesis`,
    or if the effect often occurs twice.
    """
    if hypothesis.name not in {h.name for h in other_hypotheses}:
        return 0.0
    return 0.0 if hypothesis.is_catalogued and find_effect(hypothesis.name).may_recur else LOG_PRIOR_ODDS_OF_REPETITION
