"""Search for the effects of a model by forward, backward and exchange steps.

All catalogue effects and empirical laws are screened given the model. The few with the largest evidence are evaluated
without approximation: the evidence is integrated over shape parameters on a grid around the optimum, and curves of laws
are compared with formulas. The hypothesis with the largest evidence is added to the model. Then each effect in the
model is tested again given the others, and is replaced or removed if the evidence of the model increases. Pairs of
effects are also exchanged for a single effect.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.evidence import log_sum_exp
from ltsim.core.arrays import MAX_TEMPORARY_ENTRIES, Floats, Ints
from ltsim.core.rounding import MAX_LOG_EVIDENCE_ROUNDING_ERROR, NORMAL_EQUATIONS_TOLERANCE
from ltsim.diagnosis.catalogue_designs import (
    ORDINARY_CALIBRATION_EFFECT_TYPES,
    CatalogueDesigns,
    catalogue_candidate_effects,
)
from ltsim.diagnosis.evidence import (
    N_EXACTLY_EVALUATED_HYPOTHESES,
    coefficient_posterior,
    indices_by_evidence,
)
from ltsim.diagnosis.evidence_calculator import EvidenceCalculator
from ltsim.diagnosis.forms import evaluate_law_forms, min_log_evidence_for_forms
from ltsim.diagnosis.hypotheses import EffectModel, Hypothesis, HypothesisRanking, log_prior_odds_of_repetition
from ltsim.diagnosis.law_batch import LawBatch, ScreenedLaw, evaluate_law_batches
from ltsim.diagnosis.law_search_space import law_batches
from ltsim.diagnosis.null_ensemble import NullEnsemble
from ltsim.diagnosis.prior import MAX_MODEL_EFFECTS, MIN_EFFECT_LOG_EVIDENCE
from ltsim.diagnosis.schema import ParameterEstimate
from ltsim.diagnosis.shape_parameters import (
    estimates_averaged_over_shapes,
    integrate_over_shapes,
    region_centre_estimates,
)
from ltsim.physics.laws.catalogue_names import equivalent_effect_name
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.sizes import displayed_sizes

MAX_COEFFICIENTS_OF_SIMPLE_EFFECT = 10
"""Largest number of coefficients of a simple effect. An effect with more coefficients may imitate several effects; if
the selected model has such an effect, a second search starts from the most probable simple hypothesis. A curve in one
covariate has this number of coefficients: a slope and `N_CURVE_MODES` eigenfunctions."""
N_EXACTLY_EVALUATED_IN_LARGE_NETWORK = 3
"""Number of catalogue effects, and of laws (functions of covariates), evaluated exactly per step in a large network."""
MAX_RANKED_LAWS = 400
"""Largest number of empirical laws (errors as functions of covariates) in a ranking of hypotheses."""
MIN_INTEGRATED_TO_REFIT_SIGMA_RATIO = 1.15
"""Ratio of the posterior sigma of a parameter, integrated over shape parameters, to the sigma of the refit (Laplace's
approximation). Above this ratio the integrated posterior is reported."""


class ScreeningResult(NamedTuple):
    """Approximate log evidence of all hypotheses given the effects of a model (result of a screening)."""

    effect_log_evidence: Floats
    """Log evidence (h,) of each of h variants (places, shape parameters) of catalogue effects, without prior."""
    family_log_evidence: Floats
    """Log evidence (families,) of each catalogue effect, averaged over its places and shape parameters, with prior."""
    laws: list[ScreenedLaw]
    """Laws (functions of covariates) with the largest evidence at each place (stations, targets or instruments)."""
    test_statistic: float
    """Test statistic of the global test: log of the summed evidence of all hypotheses."""
    null_test_statistics: Floats
    """Values (trials,) of the test statistic for each simulated recording (trial) without effects."""


class Searcher:
    """Search for catalogue effects, and for errors that are functions of covariates, after one adjustment."""

    def __init__(
        self,
        space: ResidualSpace,
        seed: int,
        n_trials: int = 0,
        *,
        catalogue_designs: CatalogueDesigns | None = None,
        tests_ordinary_constants: bool = True,
    ) -> None:
        """Search whose p-value is computed from `n_trials` recordings simulated with `seed`.

        `catalogue_designs` are the design matrices of another search on the same readings, which saves computing time.
        With `tests_ordinary_constants` the search also tests changes of the ordinary instrument constants.
        """
        self.residual_space = space
        self.null_ensemble = NullEnsemble.from_residual_space(space, seed, n_trials)
        self.uses_fewer_evaluations = self.is_large_network
        if catalogue_designs is None:
            every = catalogue_candidate_effects(space.sightings, space.adjustment.recording.instruments)
            catalogue_designs = CatalogueDesigns.from_residual_space(
                space,
                [
                    effect
                    for effect in every
                    if tests_ordinary_constants or type(effect) not in ORDINARY_CALIBRATION_EFFECT_TYPES
                ],
            )
        self.catalogue_designs = catalogue_designs
        self.law_batches: list[LawBatch] = law_batches(space, tests_ordinary_constants=tests_ordinary_constants)
        self.empty_model = EffectModel.from_residual_space((), space)
        self._rankings: dict[frozenset[str], HypothesisRanking] = {}
        self._projected_designs: OrderedDict[str, tuple[Floats, Floats]] = OrderedDict()
        self.evidence_calculator = EvidenceCalculator(space)
        self.empty_model_screening = self._screening(self.empty_model)

    @property
    def is_large_network(self) -> bool:
        """True for a network that is too large for an orthonormal basis of its estimated parameters."""
        return self.null_ensemble.uses_monte_carlo_gram

    @property
    def _n_exactly_evaluated(self) -> int:
        """Number of catalogue effects, and of laws (functions of covariates), evaluated without approximation."""
        return N_EXACTLY_EVALUATED_IN_LARGE_NETWORK if self.uses_fewer_evaluations else N_EXACTLY_EVALUATED_HYPOTHESES

    def without_rows(self, rows: Ints) -> Searcher:
        """Search that does not use f observations `rows` (f,), with as few exact evaluations as in large networks.

        It is equivalent to a search that also estimates an error of each of these observations. The best laws of each
        kind are not evaluated, to save time. Gram matrices of all observations are still used.
        """
        unit = np.zeros((self.residual_space.n_equations, len(rows)))
        unit[rows, np.arange(len(rows))] = 1.0
        reduced = copy(self)
        reduced.residual_space, reduced.uses_fewer_evaluations = self.residual_space.with_design_columns(unit), True
        reduced.null_ensemble = self.null_ensemble.with_model(
            reduced.residual_space.whitened_residuals, self.empty_model.projected_basis
        )
        reduced.empty_model = EffectModel.from_residual_space((), reduced.residual_space)
        reduced._rankings, reduced._projected_designs = {}, OrderedDict()
        reduced.evidence_calculator = EvidenceCalculator(reduced.residual_space)
        reduced.empty_model_screening = reduced._screening(reduced.empty_model)
        return reduced

    def ranking(self, conditioning_model: EffectModel) -> HypothesisRanking:
        """Ranking of all hypotheses given a model; only the most probable are evaluated without approximation."""
        key = frozenset(h.effect_key for h in conditioning_model.hypotheses)
        if key not in self._rankings:
            self._rankings[key] = self._compute_ranking(conditioning_model)
        return self._rankings[key]

    def _screening(self, conditioning_model: EffectModel) -> ScreeningResult:
        """Approximate log evidences of catalogue effects and laws (functions of covariates), given a model."""
        probe = (
            self.null_ensemble.with_model(conditioning_model.residual, conditioning_model.projected_basis)
            if conditioning_model.hypotheses
            else self.null_ensemble
        )
        values, null_values, self.catalogue_designs = self.catalogue_designs.screen(probe)
        families = self.catalogue_designs.log_evidence_by_family(values) + self.catalogue_designs.log_prior_by_family
        laws: list[ScreenedLaw] = []
        statistic, null = (
            log_sum_exp(families),
            log_sum_exp(null_values + self.catalogue_designs.log_prior_by_family[:, None]),
        )
        for hits_here, law_total, law_null_values in evaluate_law_batches(self.law_batches, probe):
            laws += hits_here
            statistic, null = np.logaddexp(statistic, law_total), np.logaddexp(null, law_null_values)
        return ScreeningResult(values, families, laws, float(statistic), null)

    def _compute_ranking(self, conditioning_model: EffectModel) -> HypothesisRanking:
        """Ranking of all hypotheses given the effects of a model; `ranking` caches the result."""
        values, families, laws, _, _ = (
            self._screening(conditioning_model) if conditioning_model.hypotheses else self.empty_model_screening
        )
        hypotheses = self._law_hypotheses(laws, conditioning_model)
        for i, family in enumerate(indices_by_evidence(families, MAX_LOG_EVIDENCE_ROUNDING_ERROR)):
            hypotheses.append(
                self._best_hypothesis_of_family(
                    int(family),
                    values,
                    float(families[family]),
                    conditioning_model,
                    is_exact=i < self._n_exactly_evaluated,
                )
            )
        hypotheses = [
            replace(h, log_evidence=h.log_evidence + log_prior_odds_of_repetition(h, conditioning_model.hypotheses))
            for h in hypotheses
        ]
        hypotheses = [hypotheses[i] for i in indices_by_evidence(np.array([h.log_evidence for h in hypotheses]))]
        return HypothesisRanking(tuple(hypotheses), float(log_sum_exp(np.array([h.log_evidence for h in hypotheses]))))

    def _best_hypothesis_of_family(
        self,
        family_index: int,
        effect_log_evidence: Floats,
        family_log_evidence: float,
        conditioning_model: EffectModel,
        *,
        is_exact: bool,
    ) -> Hypothesis:
        """Most probable variant of a catalogue effect, with its log evidence averaged over all variants.

        Variants differ in stations, targets and shape parameters. Unless `is_exact`, the results are approximate
        values: `effect_log_evidence` (h,) of all h variants, and `family_log_evidence` of this effect.
        """
        designs = self.catalogue_designs
        indices = np.flatnonzero(designs.family_indices == family_index)
        indices = indices[indices_by_evidence(effect_log_evidence[indices], MAX_LOG_EVIDENCE_ROUNDING_ERROR)]
        prior = float(designs.log_prior_by_family[family_index] - np.log(len(indices)))
        best = Hypothesis(designs.effects[indices[0]], prior, family_log_evidence, designs.family_names[family_index])
        if not is_exact:
            return best
        for i in designs.local_optima(indices, effect_log_evidence):
            effect, value = integrate_over_shapes(self.evidence_calculator, designs.effects[i], conditioning_model)
            others = np.delete(effect_log_evidence[indices], np.flatnonzero(indices == i))
            whole = float(log_sum_exp(np.append(others, value))) + prior
            if i == indices[0] or value + prior > best.log_evidence:
                best = replace(best, effect=effect, log_evidence=whole)
        return best

    def _law_hypotheses(self, laws: Sequence[ScreenedLaw], conditioning_model: EffectModel) -> list[Hypothesis]:
        """Hypotheses of `laws`; those with the largest approximate evidence are evaluated with all functions.

        In small networks the most probable law of each changed quantity and kind of function is evaluated in all forms
        too, because a local search can increase the evidence of some kinds.
        """
        entries, evaluated = [], set[tuple[object, ...]]()
        kinds = set[tuple[str, str, bool]]()
        order = indices_by_evidence(np.array([h.log_evidence for h in laws]), MAX_LOG_EVIDENCE_ROUNDING_ERROR)
        laws = [laws[i] for i in order[:MAX_RANKED_LAWS]]
        for hit in laws:
            place, driver = hit.place, hit.regressor.with_field_centred_on(hit.place.targets)
            law = EmpiricalLaw(place.stations, place.targets, hit.response, driver, place.instruments)
            key = (hit.response.name, driver.kind, driver.covariate_names_in_files, place.stations, place.targets)
            kind = hit.response.name, driver.kind, len(place.targets) == 1
            chosen = len(evaluated) < self._n_exactly_evaluated or not (self.uses_fewer_evaluations or kind in kinds)
            if chosen and key not in evaluated and hit.log_evidence > min_log_evidence_for_forms(laws[0].log_evidence):
                evaluated.add(key)
                kinds.add(kind)
                entries += evaluate_law_forms(
                    self.evidence_calculator,
                    law,
                    hit.log_prior,
                    conditioning_model,
                    with_steps_and_switches=not self.uses_fewer_evaluations,
                )
            else:
                entries.append(Hypothesis(law, hit.log_prior, hit.log_evidence, equivalent_effect_name(law)))
        return entries

    def estimates(
        self, hypothesis: Hypothesis, reduced_model: EffectModel, refit_estimates: Sequence[ParameterEstimate]
    ) -> tuple[ParameterEstimate, ...]:
        """Estimates of the parameters and shape parameters of a hypothesis.

        The result is `refit_estimates`, or means over all values of the shape parameters if these means have much
        larger standard deviations (`MIN_INTEGRATED_TO_REFIT_SIGMA_RATIO`).
        """
        effect = hypothesis.effect
        if isinstance(effect, EmpiricalLaw):
            sizes = displayed_sizes(
                effect, self.residual_space.sightings, *self.law_coefficients(effect, reduced_model)
            )
            return (
                *(ParameterEstimate(**size._asdict()) for size in sizes),
                *region_centre_estimates(self.evidence_calculator, effect, reduced_model),
            )
        marginal = estimates_averaged_over_shapes(self.evidence_calculator, effect, reduced_model, refit_estimates)
        both = ((marginal[e.name].sigma, e.sigma) for e in refit_estimates if e.name in marginal)
        wider = any(integrated > MIN_INTEGRATED_TO_REFIT_SIGMA_RATIO * refit for integrated, refit in both)
        estimates = [marginal.get(e.name, e) if wider else e for e in refit_estimates]
        if "time" in marginal and all(e.name != "time" for e in estimates):
            estimates.append(marginal["time"])
        return (*estimates, *region_centre_estimates(self.evidence_calculator, effect, reduced_model))

    def law_coefficients(self, law: EmpiricalLaw, reduced_model: EffectModel) -> tuple[Floats, Floats]:
        """Posterior mean (k,) and covariance (k, k) of k coefficients of `law`, given effects of `reduced_model`."""
        gram, score = self.evidence_calculator.grams_and_scores([law], reduced_model)[0]
        return coefficient_posterior(gram, score, law.plausible_sizes)[:2]

    def model_with(self, hypotheses: Sequence[Hypothesis]) -> EffectModel:
        """Model that consists of the given hypotheses, with the residuals after their estimation."""
        if not hypotheses:
            return self.empty_model
        designs, norms = zip(*map(self._projected_design, hypotheses), strict=True)
        return EffectModel(tuple(hypotheses), designs, norms, self.residual_space.whitened_residuals)

    def model_without(self, model: EffectModel, effect_index: int) -> EffectModel:
        """Model without the effect that has the index `effect_index`."""
        return self.model_with(model.hypotheses[:effect_index] + model.hypotheses[effect_index + 1 :])

    def _projected_design(self, hypothesis: Hypothesis) -> tuple[Floats, Floats]:
        """Design matrix (m, k) of a hypothesis in the residual space, and column norms (k,) before its projection."""
        key = hypothesis.effect_key
        if key not in self._projected_designs:
            whole = self.evidence_calculator.whitened_design(hypothesis.effect)
            space = self.residual_space
            self._projected_designs[key] = space.project(whole), space.norms_without_centring(whole)
        self._projected_designs.move_to_end(key)
        while sum(rows.size for rows, _ in self._projected_designs.values()) > MAX_TEMPORARY_ENTRIES:
            self._projected_designs.popitem(last=False)
        return self._projected_designs[key]

    def select_effects(self, *, requires_effect: bool, start_hypotheses: Sequence[Hypothesis] = ()) -> EffectModel:
        """Selected model, in which each further effect increases the log evidence by `MIN_EFFECT_LOG_EVIDENCE` or more.

        The search begins with `start_hypotheses` in the model. With `requires_effect` the result has at least one
        effect. A curve with many coefficients can imitate several effects. If the result has such a curve, the search
        is repeated from the most probable simple hypothesis, and the model with more evidence is selected.
        """
        begin = self.model_after_exchanges(self.model_with(start_hypotheses))
        best_model = self._forward_selection(begin, requires_effect=requires_effect)
        is_simple = [len(h.plausible_sizes) <= MAX_COEFFICIENTS_OF_SIMPLE_EFFECT for h in best_model.hypotheses]
        if not all(is_simple):
            ranked = self.ranking(self.empty_model).hypotheses
            simple = [h for h in ranked if len(h.plausible_sizes) <= MAX_COEFFICIENTS_OF_SIMPLE_EFFECT][:1]
            models = [
                best_model,
                *(self._forward_selection(self.model_with([h]), requires_effect=True) for h in simple),
            ]
            best_model = max(models, key=lambda m: m.penalised_log_evidence - MIN_EFFECT_LOG_EVIDENCE * len(m.effects))
        return self._pruned_and_renamed_model(best_model)

    def model_by_forward_steps(self, rival_log_evidence: float) -> EffectModel:
        """Model from forward steps alone, whose log evidence is a lower bound of that of a search with backward steps.

        The steps end when the log evidence exceeds `rival_log_evidence`, that of an alternative, or could not exceed it
        even if all further effects gained as much evidence as the last effect.
        """
        return self._forward_selection(self.empty_model, requires_effect=True, rival_log_evidence=rival_log_evidence)

    def _forward_selection(
        self, model: EffectModel, *, requires_effect: bool, rival_log_evidence: float | None = None
    ) -> EffectModel:
        """Model after a forward selection that starts with `model`; with `requires_effect` it has at least one effect.

        Without `rival_log_evidence` the effects in the model are tested again after each step.
        """
        again = rival_log_evidence is None
        for depth in range(len(model.hypotheses), MAX_MODEL_EFFECTS):
            ranking, least = self.ranking(model), MIN_EFFECT_LOG_EVIDENCE + model.discrepancy_penalty
            if ranking.total_log_evidence < least and (depth or not requires_effect):
                break
            grown = _best_model([self.model_with((*model.hypotheses, h)) for h in ranking.hypotheses[:3]])
            grown = self.model_after_exchanges(grown) if again and not self.uses_fewer_evaluations else grown
            if depth and grown.penalised_log_evidence < model.penalised_log_evidence + MIN_EFFECT_LOG_EVIDENCE:
                break
            gain, model = grown.penalised_log_evidence - model.penalised_log_evidence, grown
            if (
                rival_log_evidence is not None
                and not model.penalised_log_evidence
                < rival_log_evidence
                < model.penalised_log_evidence + gain * (MAX_MODEL_EFFECTS - 1 - depth)
            ):
                break
        return self.model_after_exchanges(model) if again and self.uses_fewer_evaluations else model

    def _pruned_and_renamed_model(self, model: EffectModel) -> EffectModel:
        """Model without the effects that its other effects explain, and with the most probable name of each effect."""
        for hypothesis in model.hypotheses[::-1]:
            others = self.model_without(model, model.hypotheses.index(hypothesis))
            ranking = self.ranking(others)
            if others.hypotheses and ranking.total_log_evidence < MIN_EFFECT_LOG_EVIDENCE + others.discrepancy_penalty:
                model = others
            elif (likeliest := ranking.most_probable_name()) != hypothesis.name:
                better = next(h for h in ranking.hypotheses if h.name == likeliest)
                model = self.model_with((*others.hypotheses, better))
        return model

    def model_after_exchanges(self, model: EffectModel) -> EffectModel:
        """Model after backward and exchange steps, in which its effects are replaced, removed or merged."""
        for turn in range(2):
            before = model.penalised_log_evidence
            model = self._exchange_step(model, n_dropped=1)
            if not (turn or self.uses_fewer_evaluations):
                model = self._exchange_step(model, n_dropped=2)
            if model.penalised_log_evidence <= before + 1e-6:
                break
        return model

    def _exchange_step(self, model: EffectModel, n_dropped: int) -> EffectModel:
        """Model in which `n_dropped` effects at a time are replaced by one, or removed, if the evidence increases."""
        for dropped in combinations(range(len(model.hypotheses)), n_dropped):
            if len(model.hypotheses) < 2 or max(dropped) >= len(model.hypotheses):
                continue
            others = tuple(h for i, h in enumerate(model.hypotheses) if i not in dropped)
            rest = self.model_with(others)
            made = [self.model_with((*others, h)) for h in self.ranking(rest).hypotheses[: 2 if others else 6]]
            model = _best_model([model, *made, *([rest] if others else [])])
        return model


def _best_model(models: Sequence[EffectModel]) -> EffectModel:
    """Model with the largest log evidence; of several equal models the first."""
    most = max(model.penalised_log_evidence for model in models)
    return next(model for model in models if model.penalised_log_evidence >= most - NORMAL_EQUATIONS_TOLERANCE)
