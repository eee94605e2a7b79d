"""Findings of a selected model for the report, each with place, size, probability and sentence."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import expit

from ltsim.adjustment.prior import prior_sigmas
from ltsim.adjustment.refit import Refit
from ltsim.adjustment.significance import FAMILY_WISE_LEVEL, MIN_SIGNIFICANT_SIGMAS
from ltsim.core.arrays import Floats
from ltsim.core.notation import MAX_LISTED_ITEMS, number_text
from ltsim.core.rounding import SQRT_MACHINE_EPSILON
from ltsim.diagnosis.catalogue_designs import ORDINARY_CALIBRATION_EFFECT_TYPES
from ltsim.diagnosis.detectability import (
    separating_measurement_sentence,
    target_distortion_um,
)
from ltsim.diagnosis.evidence import (
    coefficient_posterior,
    log_bayes_factor_of_discrepancy,
    log_evidence_of_wrong_readings,
    observables_changed_by_effect,
)
from ltsim.diagnosis.forms import response_curve
from ltsim.diagnosis.global_test import GlobalTestResult
from ltsim.diagnosis.hypotheses import EffectModel, Hypothesis, HypothesisRanking, probability_and_equivalents
from ltsim.diagnosis.prior import P_EVEN_ODDS
from ltsim.diagnosis.schema import Finding, FindingEvidence, FindingScope, ParameterEstimate
from ltsim.diagnosis.scopes import effect_scope
from ltsim.diagnosis.selection_state import SelectionState
from ltsim.diagnosis.sentences import (
    MIN_PROBABILITY_OF_PROBABLE_CAUSE,
    catalogue_effect_sentence,
    estimate_without_clock,
    is_implausible_size,
    law_sentence,
    law_text,
)
from ltsim.physics.effects.effect import ChainErrorEffect, Effect
from ltsim.physics.effects.linear_effect import CandidateEffect, n_parameters_and_shape_parameters
from ltsim.physics.effects.outlier import Outlier
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.places import instrument_places
from ltsim.physics.laws.regressors import covariate_names_in_files
from ltsim.physics.laws.text_form import regressor_text
from ltsim.recordings.recording import OBSERVABLES

MIN_CHI2_FRACTION_OF_LISTED_READINGS = 0.8
"""Smallest fraction of the chi-square decrease by a finding that the readings listed in its sentence have together."""


@dataclass(frozen=True)
class SelectedModelFit:
    """Selected model of a recording after its nonlinear refit, from which the findings are reported."""

    selection_state: SelectionState
    """State of the model selection after its last step: adjustment, noise and search."""
    global_test: GlobalTestResult
    """Result of the global tests of the recording."""
    model: EffectModel
    """Set of the selected effects."""
    refit: Refit
    """Nonlinear adjustment with the selected effects in its model."""
    has_test_findings: bool = False
    """True if findings of tests, or on the noise, are reported in addition to the selected effects."""
    held_out_log_odds: float = 0.0
    """Log odds of the selected effects against no effect; negative if held-out readings contradict them, otherwise
    0."""

    def _ranking_of_alternatives(self, effect_index: int) -> HypothesisRanking:
        """Ranking of all alternatives to a selected effect, with changed noise levels and an unmodelled cause.

        `effect_index` is the index of the effect in the model.
        """
        searcher, model = self.selection_state.searcher, self.model
        reduced_model = searcher.model_without(model, effect_index)
        noises = [
            Hypothesis(change.effect, 0.0, value, change.effect.name)
            for value, change in self.selection_state.ranked_noise_hypotheses(reduced_model)
        ]
        effect, spread = self.refit.effects[effect_index], model.hypotheses[effect_index].plausible_sizes
        moments = searcher.evidence_calculator.grams_and_scores([effect], reduced_model)[0]
        coefficient_means = coefficient_posterior(*moments, spread)[0]
        redundancy = searcher.residual_space.redundancy - np.sum(model.projected_basis**2, axis=1)
        shift = searcher.residual_space.whitened_design(effect) @ coefficient_means
        likeness = log_bayes_factor_of_discrepancy(searcher.residual_space, shift, model.residual, redundancy)
        ranking = searcher.ranking(reduced_model).with_further_hypotheses(noises).with_unmodelled_cause(likeness)
        return ranking.with_held_out_evidence(self.held_out_log_odds)

    def p_same_name(self, effect_index: int) -> float:
        """Posterior probability that the cause is an effect with the same name as the given effect in the model.

        `effect_index` is the index of the effect in the model. For an unknown effect the result is the probability that
        an unknown effect acts on the same observables.
        """
        hypothesis, ranking = self.model.hypotheses[effect_index], self.rankings_of_alternatives[effect_index]
        if hypothesis.is_catalogued:
            return ranking.probabilities_by_name().get(hypothesis.name, 0.0)
        changed_observables = set(hypothesis.effect.observables)
        p_same = ranking.posterior_probability_of(
            lambda h: not h.is_catalogued and set(h.effect.observables) == changed_observables
        )
        return p_same + P_EVEN_ODDS * ranking.p_unmodelled_cause

    @cached_property
    def rankings_of_alternatives(self) -> list[HypothesisRanking]:
        """Rankings of the alternatives to each selected effect, one ranking per effect."""
        return [self._ranking_of_alternatives(i) for i in range(len(self.model.hypotheses))]

    @cached_property
    def p_same_scope(self) -> list[float]:
        """Probabilities, one per selected effect, that the cause is an effect of any name with the same scope.

        The scope is the observables, stations, targets and covariates of the effect.
        """
        return [self._p_same_scope_of(i) for i in range(len(self.model.hypotheses))]

    @cached_property
    def squared_residual_decreases(self) -> list[Floats]:
        """Decrease of the m squared whitened residuals by each selected effect, given the other effects."""
        reduced_models = (
            self.selection_state.searcher.model_without(self.model, i) for i in range(len(self.model.hypotheses))
        )
        return [others.residual**2 - self.model.residual**2 for others in reduced_models]

    @cached_property
    def unreported_effect_keys(self) -> tuple[str, ...]:
        """Keys (`Hypothesis.effect_key`) of the selected effects that are too improbable to be reported.

        An effect is reported if it is probable, or if it is certain that there is a cause, whatever its name. The
        effect with the largest chi-square decrease is also reported if there is no other finding.
        """
        hypotheses, gains = self.model.hypotheses, [gain.sum() for gain in self.squared_residual_decreases]
        p_real = [self.p_real(i) for i in range(len(hypotheses))]
        has_certain_cause = [self.p_cause(i) >= 1.0 - FAMILY_WISE_LEVEL for i in range(len(hypotheses))]
        is_doubtful = [
            p < MIN_PROBABILITY_OF_PROBABLE_CAUSE
            and not (is_certain and (p > 0.0 or gain == max(gains)))
            and (gain < max(gains) or self.has_test_findings)
            for p, is_certain, gain in zip(p_real, has_certain_cause, gains, strict=True)
        ]
        return tuple(hypothesis.effect_key for hypothesis, doubt in zip(hypotheses, is_doubtful, strict=True) if doubt)

    def p_real(self, effect_index: int) -> float:
        """Probability that a selected effect is real under any name, and not the result of several wrong readings.

        `effect_index` is the index of the effect in the model. The probability is 0 if neither a size nor the decrease
        of chi-square is significant. It is also 0 if neither place, nor observable, nor function of the effect is
        determined.
        """
        effect, gain = self.refit.effects[effect_index], float(self.squared_residual_decreases[effect_index].sum())
        size_estimates = [size for size in self.refit.estimates[effect_index] if size.parameter in effect.parameters]
        is_significant = isinstance(
            effect, EmpiricalLaw
        ) or gain > MIN_SIGNIFICANT_SIGMAS**2 * n_parameters_and_shape_parameters(effect)
        is_significant |= any(abs(size.value) > MIN_SIGNIFICANT_SIGMAS * size.sigma for size in size_estimates)
        p_same_scope = self.p_same_scope[effect_index]
        anywhere = FindingScope(covariates=covariate_names_in_files(effect.covariates))
        is_specific = self._scope_of_effect(effect) != anywhere or p_same_scope >= MIN_PROBABILITY_OF_PROBABLE_CAUSE
        if not (is_significant and is_specific):
            return 0.0
        p_not_wrong_readings = 1.0 - self.p_wrong_readings[effect_index]
        return max(self.p_same_name(effect_index) * p_not_wrong_readings, self._p_located(effect_index))

    def p_cause(self, effect_index: int) -> float:
        """Probability that some cause at the place of a selected effect produced the residuals that it explains.

        `effect_index` is the index of the effect in the model. Wrong readings are such a cause only if the effect acts
        on single targets; otherwise they are at other places.
        """
        p_elsewhere = 0.0 if self._is_at_single_targets(effect_index) else self.p_wrong_readings[effect_index]
        return (1.0 - self.rankings_of_alternatives[effect_index].p_no_cause) * (1.0 - p_elsewhere)

    def _is_at_single_targets(self, effect_index: int) -> bool:
        """True if an effect acts on single targets. Wrong readings at its place are then readings to these targets.

        `effect_index` is the index of the effect in the model.
        """
        effect = self.model.hypotheses[effect_index].effect
        return not isinstance(effect, EmpiricalLaw) and bool(self._scope_of_effect(effect).targets)

    def _p_located(self, effect_index: int) -> float:
        """Probability of a cause with the place, observables and covariates of an effect, or of wrong readings there.

        `effect_index` is the index of the effect in the model.
        """
        p_wrong = self.p_wrong_readings[effect_index]
        return self.p_same_scope[effect_index] * (1.0 - p_wrong) + p_wrong * self._is_at_single_targets(effect_index)

    @cached_property
    def p_wrong_readings(self) -> list[float]:
        """Probabilities, one per selected effect, that its cause is several wrong readings with separate errors.

        Readings that are wrong with and without the effect are no alternative to the effect.
        """
        searcher, model = self.selection_state.searcher, self.model
        prior, space = searcher.catalogue_designs.log_prior_of_family(Outlier.name), searcher.residual_space
        with_effects = log_evidence_of_wrong_readings(space, model.residual, model.projected_basis, prior)
        probabilities = []
        for i, hypothesis in enumerate(model.hypotheses):
            if isinstance(hypothesis.effect, Outlier):
                probabilities.append(0.0)
                continue
            others = searcher.model_without(model, i)
            without_effect = log_evidence_of_wrong_readings(space, others.residual, others.projected_basis, prior)
            gain = model.log_evidence - others.log_evidence  # wrong readings would have the same penalty as the effect
            probabilities.append(float(expit(without_effect - with_effects - gain)))
        return probabilities

    def finding_of_effect(self, effect_index: int) -> Finding:
        """Finding that reports a selected effect, given the other selected effects.

        `effect_index` is the index of the effect in the model.
        """
        searcher, model, ranking = (
            self.selection_state.searcher,
            self.model,
            self.rankings_of_alternatives[effect_index],
        )
        space, others = searcher.residual_space, searcher.model_without(model, effect_index)
        hypothesis = replace(model.hypotheses[effect_index], effect=self.refit.effects[effect_index])
        effect, name = hypothesis.effect, hypothesis.name
        p_wrong, p_by_name = self.p_wrong_readings[effect_index], ranking.probabilities_by_name()
        p_by_name = {rival: p * (1.0 - p_wrong) for rival, p in p_by_name.items()}
        p_by_name[Outlier.name] = p_by_name.get(Outlier.name, 0.0) + p_wrong
        probability = self.p_same_name(effect_index) * (1.0 - p_wrong)
        rivals = probability_and_equivalents(p_by_name, name)[1]
        p_same_scope = self._p_located(effect_index)
        gain = self.squared_residual_decreases[effect_index]
        coefficient_means = coefficient_posterior(
            *searcher.evidence_calculator.grams_and_scores([effect], others)[0], hypothesis.plausible_sizes
        )[0]
        design_columns, rows = space.whitened_design(effect), int(space.is_used_reading.sum())
        shift = design_columns @ coefficient_means
        projected_design = searcher.model_with([hypothesis]).projected_designs[0] @ coefficient_means
        scope = self._scope_of_effect(
            effect, observables_changed_by_effect(space.is_used_reading, shift[:rows], projected_design[:rows])
        )
        estimates = self._estimates_of_effect(effect_index, hypothesis, others)
        sentence, further_values = "", dict[str, object]()
        if isinstance(effect, EmpiricalLaw):
            regressor = regressor_text(effect.regressor, has_clock=self.selection_state.recording.has_clock)
            law = law_text(effect, regressor)
            sentence = law_sentence(scope, estimates, p_same_scope, law)
            further_values = {"carrier": effect.response.name, "driver": regressor}
            further_values |= {} if hypothesis.is_catalogued else {"formula": law}
            curve = response_curve(effect, space.sightings, *searcher.law_coefficients(effect, others))
            further_values |= {} if curve is None else {"curve": curve}
        elif isinstance(effect, Effect):
            other_effects = [e for k, e in enumerate(self.refit.effects) if k != effect_index]
            measurement = separating_measurement_sentence(
                self.selection_state.baseline_adjustment, name, [rival.effect for rival in rivals], other_effects
            )
            further_values = {"separate_by": measurement} if measurement else {}
        if hypothesis.is_catalogued:
            doubt = self._plausibility_sentence(effect, estimates)
            sentence = catalogue_effect_sentence(name, scope, estimates, probability, p_same_scope=p_same_scope) + doubt
        distortion = target_distortion_um(space, shift)
        n_touched = max(int(np.count_nonzero(design_columns.any(axis=1))), 1)
        sigmas_text = number_text(np.sqrt(max(float(gain.sum()), 0.0) / n_touched), 2)
        sentence += (
            f" Without a correction, this effect causes residuals of {sigmas_text} sigma (rms) and shifts the targets "
            f"by {number_text(distortion, 2)} um (rms).{self._decisive_readings_sentence(gain)}"
        )
        return Finding(
            effect=name,
            known=hypothesis.is_catalogued,
            where=scope,
            parameters=estimates,
            evidence=FindingEvidence(
                chi2_drop=float(gain.sum()),
                parameters=model.projected_basis.shape[1] - others.projected_basis.shape[1],
                p_value=self.global_test.p_value_of(ranking.total_log_evidence),
                probability=probability,
                p_same_scope=p_same_scope,
            ),
            sentence=sentence,
            target_shift_rms_um=distortion,
            equivalents=rivals,
        ).with_values(**further_values)

    def _decisive_readings_sentence(self, chi2_decreases: Floats) -> str:
        """Sentence that lists the few readings with most of the chi-square decrease; empty if these are many.

        `chi2_decreases` (m,) is the decrease in each of the m observation equations.
        """
        use, recording = self.selection_state.searcher.residual_space.is_used_reading, self.selection_state.recording
        reading_gain = chi2_decreases[: int(use.sum())]
        order = np.argsort(-reading_gain)
        min_sum = MIN_CHI2_FRACTION_OF_LISTED_READINGS * max(float(chi2_decreases.sum()), SQRT_MACHINE_EPSILON)
        n_readings = int(np.searchsorted(np.cumsum(reading_gain[order]), min_sum)) + 1
        if n_readings > MAX_LISTED_ITEMS:
            return ""
        row_and_observable = [
            (int(row), int(kind))
            for row, kind in zip(*(part[order[:n_readings]] for part in np.nonzero(use)), strict=True)
        ]
        station, target = recording.stations, recording.targets
        names = (
            f"{OBSERVABLES[k]} from {station[recording.station[i]]} to {target[recording.target[i]]} (row {i + 1})"
            for i, k in row_and_observable
        )
        return f" Most of the decrease of chi-square is in the {', the '.join(names)}."

    def _p_same_scope_of(self, effect_index: int) -> float:
        """Sum of the probabilities of all hypotheses with the same observables, place and covariates as an effect.

        `effect_index` is the index of the effect in the model. All effects that act on the same targets count as having
        the same scope. The reason is that a target that moved, is badly seated or was read wrongly changes the same
        readings.
        """
        effect = self.model.hypotheses[effect_index].effect

        def scope_of(candidate: CandidateEffect) -> FindingScope:
            """Scope (observables, place, covariates) of a candidate, for comparison with the selected effect."""
            scope = self._scope_of_effect(candidate)
            if scope.targets and not isinstance(effect, EmpiricalLaw):
                return FindingScope(targets=scope.targets)
            return scope.model_copy(update={"observables": tuple(sorted(candidate.observables))})

        scope = scope_of(effect)
        return self.rankings_of_alternatives[effect_index].posterior_probability_of(
            lambda h: scope_of(h.effect) == scope
        )

    def _scope_of_effect(self, effect: CandidateEffect, default_observables: tuple[str, ...] = ()) -> FindingScope:
        """Scope of an effect: its observables, stations, targets or instrument, and covariates.

        An effect at all set-ups of one of several instruments has the instrument in place of the stations.
        `default_observables` are the observables of an effect that does not restrict them.
        """
        scope = effect_scope(effect, default_observables)
        for tracker in instrument_places(
            self.selection_state.searcher.residual_space.sightings, self.selection_state.recording.instruments
        ):
            if set(scope.stations) == set(tracker.stations) and isinstance(effect, ChainErrorEffect):
                return scope.model_copy(update={"stations": (), "instruments": tracker.instruments})
        return scope

    def _plausibility_sentence(self, effect: CandidateEffect, estimates: Sequence[ParameterEstimate]) -> str:
        """Sentence on the declared prior of an instrument constant, or on an implausible size; otherwise empty."""
        recording = self.selection_state.recording
        if isinstance(effect, ORDINARY_CALIBRATION_EFFECT_TYPES):
            name = recording.instruments[self._instrument_index(effect)]
            prior = recording.setup.instrument_named(name).prior
            declared = ((p.prior_sigma_from(prior) / p.si_per_display_unit, p.unit) for p in effect.parameters)
            sigmas = ", ".join(f"{number_text(sigma, 2)} {unit}" for sigma, unit in declared)
            return f" The set-up declares that this instrument constant is zero with a standard deviation of {sigmas}."
        implausible = " Such a size is hardly plausible for this cause: check other causes too."
        return implausible if is_implausible_size(effect, estimates) else ""

    def _constant_estimates_without_prior(self, effect: CandidateEffect) -> tuple[ParameterEstimate, ...]:
        """Estimates of the instrument constants of an effect of the ordinary calibration, without their prior.

        All other constants of the instrument have their prior.
        """
        adjustment, which = self.selection_state.baseline_adjustment, self._instrument_index(effect)
        prior = prior_sigmas(self.selection_state.recording, adjustment.construction)[which]
        variance = np.diag(adjustment.instrument_covariance_of(which))
        factors = 1.0 / np.maximum(1.0 - variance / prior**2, SQRT_MACHINE_EPSILON)
        value, sigma = adjustment.state.instrument_parameters[which] * factors, np.sqrt(variance * factors)
        indices = (adjustment.construction.parameter_names.index(p.name) for p in effect.parameters)
        return tuple(
            ParameterEstimate.from_si(p, value[k], sigma[k]) for p, k in zip(effect.parameters, indices, strict=True)
        )

    def _instrument_index(self, effect: CandidateEffect) -> int:
        """Index of the instrument at whose set-ups an effect acts."""
        recording = self.selection_state.recording
        index = recording.stations.index(effect.stations[0]) if effect.stations else int(recording.station[0])
        return int(recording.instrument[recording.station == index][0])

    def _estimates_of_effect(
        self, effect_index: int, hypothesis: Hypothesis, reduced_model: EffectModel
    ) -> tuple[ParameterEstimate, ...]:
        """Estimates of the sizes and shape parameters of a selected effect.

        In a recording without times, numbers of pointings replace them. `effect_index` is the index of the effect,
        `hypothesis` the effect after the refit, and `reduced_model` the model without the effect.
        """
        refitted = [
            ParameterEstimate.from_si(*estimate)
            for estimate in self.refit.estimates[effect_index]
            if np.isfinite(estimate.sigma)
        ]
        if isinstance(hypothesis.effect, ORDINARY_CALIBRATION_EFFECT_TYPES):
            return self._constant_estimates_without_prior(hypothesis.effect)
        estimates = self.selection_state.searcher.estimates(hypothesis, reduced_model, refitted)
        return (
            estimates
            if self.selection_state.recording.has_clock
            else tuple(estimate_without_clock(e) for e in estimates)
        )
