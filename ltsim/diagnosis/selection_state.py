"""State of the model selection: adjustment, variance components, residual space and search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.refit import Refit, refit_with_effects
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Bools, Floats
from ltsim.diagnosis.catalogue_designs import CatalogueDesigns
from ltsim.diagnosis.evidence import WIDE_PRIOR_SIGMA_FACTOR, log_restricted_likelihood
from ltsim.diagnosis.hypotheses import EffectModel, Hypothesis
from ltsim.diagnosis.instruments import InstrumentConstantContradiction
from ltsim.diagnosis.noise import NoiseHypothesisSet, noise_hypotheses
from ltsim.diagnosis.noise_centring import log_evidence_and_centring_hypotheses, with_declared_centring
from ltsim.diagnosis.noise_estimation import with_estimated_sizes
from ltsim.diagnosis.noise_hypothesis import NoiseHypothesis
from ltsim.diagnosis.null_ensemble import n_simulated_recordings
from ltsim.diagnosis.search import Searcher
from ltsim.physics.effects.linear_effect import CandidateEffect, LinearEffect
from ltsim.physics.laws.variance import CentringVariance
from ltsim.physics.model.measurement import NetworkState
from ltsim.recordings.recording import Recording

N_VARIANCE_ITERATIONS = 2
"""Number of adjustments with new weights, which is sufficient for the convergence of the variance components."""


@dataclass(frozen=True)
class SelectionState:
    """State of the model selection on a recording without blunders; each step of the selection returns a new state."""

    baseline_adjustment: Adjustment
    """Ordinary adjustment, from which all other adjustments start."""
    is_used_reading: Bools
    """Flags (n, 3) of the readings of n pointings that are used."""
    seed: int
    """Seed of the random draws of simulated recordings."""
    false_alarm_rate: float | None
    """False-alarm rate of the search for effects; None for a search without p-value."""
    tests_ordinary_constants: bool
    """True if changes of the instrument constants of the ordinary calibration are also hypotheses."""
    effects_of_uncorrected_causes: tuple[CandidateEffect, ...]
    """Catalogue effects among the simple causes (such as outliers or moved targets) of the network, from which a second
    search for effects starts if the noise is larger than declared."""
    reading_sigmas: Floats
    """Standard deviations (n, 3) [m, rad, rad] of the readings of n pointings, with the selected noise hypotheses
    (noise other than declared)."""
    residual_space: ResidualSpace
    """Residual space of the adjustment with the present weights: whitened observations without the part that the
    unknowns absorb."""
    selected_noise_hypotheses: tuple[NoiseHypothesis, ...] = ()
    """Hypotheses of changed noise that have been selected."""
    earlier_catalogue_designs: CatalogueDesigns | None = None
    """Design matrices of the catalogue effects from the latest search in an earlier state; None before the first
    search."""

    @classmethod
    def from_adjustment(
        cls,
        adjustment: Adjustment,
        is_used_reading: Bools,
        seed: int,
        false_alarm_rate: float | None = 0.05,
        *,
        tests_ordinary_constants: bool = True,
        effects_of_uncorrected_causes: tuple[CandidateEffect, ...] = (),
    ) -> SelectionState:
        """State of the model selection before its first step, from the ordinary adjustment.

        The other arguments are attributes of the state.
        """
        return cls(
            adjustment,
            is_used_reading,
            seed,
            false_alarm_rate,
            tests_ordinary_constants,
            effects_of_uncorrected_causes,
            adjustment.recording.reading_sigmas(),
            ResidualSpace.from_adjustment(adjustment),
        )

    @cached_property
    def searcher(self) -> Searcher:
        """Search for effects in the residuals of the present adjustment.

        The search uses the design matrices of an earlier search, with other weights, if the observation equations are
        the same. Only the first search of a recording has a p-value.
        """
        earlier = self.earlier_catalogue_designs
        is_reusable = earlier is not None and earlier.n_equations == self.residual_space.n_equations
        return Searcher(
            self.residual_space,
            self.seed,
            n_simulated_recordings(self.residual_space, self.false_alarm_rate)
            if earlier is None and self.false_alarm_rate
            else 0,
            catalogue_designs=earlier.with_weights_of(self.residual_space)
            if earlier is not None and is_reusable
            else None,
            tests_ordinary_constants=self.tests_ordinary_constants,
        )

    @cached_property
    def noise_hypotheses(self) -> NoiseHypothesisSet:
        """Hypotheses of changed noise in the residual space of the present adjustment.

        The residual space is the space of whitened observations without the part that the unknowns absorb.
        """
        return self._noise_hypotheses(self.residual_space)

    @property
    def empty_model(self) -> EffectModel:
        """Model without effects."""
        return EffectModel.from_residual_space((), self.residual_space)

    @property
    def recording(self) -> Recording:
        """Recording without blunders, whose set-up declares the centring errors among the selected noise hypotheses."""
        return with_declared_centring(self.baseline_adjustment.recording, self.selected_noise_hypotheses)

    def refit(
        self,
        effects: Sequence[CandidateEffect],
        sigma: Floats,
        selected_noise_hypotheses: Sequence[NoiseHypothesis] | None = None,
    ) -> Refit:
        """Nonlinear adjustment with effects in the model and standard deviations `sigma` (n, 3) of n pointings.

        Without effects and hypotheses of changed noise it is the ordinary adjustment. Parameters have a prior standard
        deviation of `WIDE_PRIOR_SIGMA_FACTOR` times their plausible size, because the readings may not determine some
        combinations. Centring errors among `selected_noise_hypotheses` (by default those of the state) are in the
        model.
        """
        selected_noise_hypotheses = (
            self.selected_noise_hypotheses if selected_noise_hypotheses is None else selected_noise_hypotheses
        )
        if not (effects or selected_noise_hypotheses):
            return Refit(self.baseline_adjustment, (), ())
        old = self.baseline_adjustment
        adjusted = partial(
            adjust,
            with_declared_centring(old.recording, selected_noise_hypotheses),
            old.construction,
            sigma=sigma,
            reading_mask=self.is_used_reading,
            effect_prior_sigma=WIDE_PRIOR_SIGMA_FACTOR,
            prior=old.problem.prior,
        )

        def with_causes(effects: Sequence[LinearEffect], start_state: NetworkState) -> Adjustment:
            """Adjustment with `effects` in addition to the simple causes of the ordinary adjustment.

            The adjustment starts from the unknowns `start_state`. Simple causes are, for example, outliers and moved
            targets.
            """
            return adjusted(effects=(*effects, *old.effects), start_state=start_state)

        return refit_with_effects(with_causes if old.effects else adjusted, effects, start_state=old.state)

    def with_widened_priors(self, contradictions: Sequence[InstrumentConstantContradiction]) -> SelectionState:
        """State of the model selection after an adjustment without the prior of the contradicting instrument constants.

        `contradictions` are the instrument constants that contradict their reference.
        """
        old = self.baseline_adjustment
        freed = np.zeros(old.state.instrument_parameters.shape, dtype=bool)
        for contradiction in contradictions:
            owners = [self.recording.instruments.index(name) for name in contradiction.instruments]
            freed[owners, old.construction.parameter_names.index(contradiction.parameter.name)] = True
        prior = old.problem.prior.with_widened_sigmas(freed)
        baseline = adjust(
            old.recording,
            old.construction,
            effects=old.effects,
            sigma=old.recording.reading_sigmas(),
            reading_mask=self.is_used_reading,
            start_state=old.state,
            prior=prior,
        )
        return self._with_attributes(baseline_adjustment=baseline)._with_space_of_refit()

    def _with_attributes(self, **attributes: object) -> SelectionState:
        """Copy of the selection state with other attributes; a search in it keeps its design matrices."""
        searcher: Searcher | None = vars(self).get("searcher")  # no search is started for its design matrices alone
        designs = self.earlier_catalogue_designs if searcher is None else searcher.catalogue_designs
        return replace(self, earlier_catalogue_designs=designs, **attributes)  # type: ignore[arg-type]

    def _with_space_of_refit(self) -> SelectionState:
        """State of the model selection with the equations of an adjustment without effects, with the present noise."""
        adjustment = self.refit((), self.reading_sigmas).adjustment
        return self._with_attributes(residual_space=ResidualSpace.from_adjustment(adjustment))

    def ranked_noise_hypotheses(self, model: EffectModel) -> list[tuple[float, NoiseHypothesis]]:
        """Most probable hypothesis of each kind of changed noise, preceded by its log evidence given a model's effects.

        The pairs are sorted by decreasing evidence.
        """
        redundancy = self.residual_space.redundancy - np.sum(model.projected_basis**2, axis=1)
        ranked = self.noise_hypotheses.ranked_noise_hypotheses(model.residual, redundancy, model.projected_basis)
        for gain, hypothesis in log_evidence_and_centring_hypotheses(self.residual_space.with_effects(model.effects)):
            ranked.append((gain + self.noise_hypotheses.log_prior_of_family(hypothesis.family_name), hypothesis))
        return sorted(ranked, key=lambda entry: -entry[0])

    def with_noise_hypothesis(self, hypothesis: NoiseHypothesis, effects: Sequence[CandidateEffect]) -> SelectionState:
        """State of the model selection after the addition of changed noise, estimated with `effects` in the model.

        If a hypothesis with the same effect was selected before, the sizes are added. All noise hypotheses are then
        estimated together.
        """
        new_change = with_estimated_sizes(
            self.residual_space.with_effects(effects), self.residual_space.reading_sigmas, hypothesis
        )
        if all(change.effect != new_change.effect for change in self.selected_noise_hypotheses):
            return self._with_selected_noise_hypotheses(
                (*self.selected_noise_hypotheses, new_change)
            ).with_estimated_noise(effects)
        selected_noise_hypotheses = [
            change if change.effect != new_change.effect else change.sum_with(new_change)
            for change in self.selected_noise_hypotheses
        ]
        return self._with_selected_noise_hypotheses(selected_noise_hypotheses).with_estimated_noise(effects)

    def _with_selected_noise_hypotheses(self, selected_noise_hypotheses: Sequence[NoiseHypothesis]) -> SelectionState:
        """State of the model selection with other hypotheses of changed noise, and resulting standard deviations."""
        changed = self._with_attributes(selected_noise_hypotheses=tuple(selected_noise_hypotheses))
        return changed._with_attributes(reading_sigmas=changed._sigmas_with_noise_hypotheses(selected_noise_hypotheses))

    @property
    def log_evidence_of_noise(self) -> float:
        """Log evidence of the selected hypotheses of changed noise without effects, up to a constant of the recording.

        It is the restricted log likelihood of the present adjustment, plus a term for each hypothesis. The term is its
        log evidence minus its log likelihood ratio at the time of its selection.
        """
        return log_restricted_likelihood(self.residual_space.adjustment) + sum(
            n.log_prior_times_occam_factor for n in self.selected_noise_hypotheses
        )

    def log_evidence_with_effects(self, hypotheses: Sequence[Hypothesis]) -> float:
        """Log evidence of effects together with the selected hypotheses of changed noise.

        The noise is estimated with the effects of `hypotheses` in the model. The result is comparable with
        `log_evidence_of_noise`, the log evidence without these effects.
        """
        state = self.with_estimated_noise([h.effect for h in hypotheses])
        return (
            state.log_evidence_of_noise
            + EffectModel.from_residual_space(hypotheses, state.residual_space).penalised_log_evidence
        )

    def with_estimated_noise(self, effects: Sequence[CandidateEffect]) -> SelectionState:
        """State of the model selection with variance components estimated by REML (Foerstner 1979).

        The residual space is the space of whitened observations without the part that the unknowns absorb. `effects`
        are in the model. The residual space is that of an adjustment with the estimated noise.
        """
        return self._with_estimated_variances(effects)._with_space_of_refit()

    def _with_estimated_variances(self, effects: Sequence[CandidateEffect]) -> SelectionState:
        """State of the model selection with estimated variance components, but with the present residual space.

        The residual space is the space of whitened observations without the part that the unknowns absorb. The
        components are estimated by REML, with `effects` in the model.
        """
        state = self
        for _ in range(N_VARIANCE_ITERATIONS):
            estimates = state._noise_estimates(effects)
            state = state._with_selected_noise_hypotheses(
                [
                    replace(
                        estimate,
                        chi2_drop=change.chi2_drop,
                        log_evidence=change.log_evidence + estimate.log_occam_factor - change.log_occam_factor,
                    )
                    for estimate, change in zip(estimates, state.selected_noise_hypotheses, strict=True)
                ]
            )
        return state

    def _noise_estimates(self, effects: Sequence[CandidateEffect]) -> list[NoiseHypothesis]:
        """Selected noise hypotheses with new estimates of their sizes, with `effects` in the model.

        The sizes of each hypothesis are estimated given the other hypotheses. Centring errors are estimated in an
        adjustment without centring errors. In an adjustment with them, the displacements have absorbed part of an
        effect.
        """
        space = ResidualSpace.from_adjustment(self.refit((), self.reading_sigmas).adjustment).with_effects(effects)
        estimates = list[NoiseHypothesis]()
        for i, change in enumerate(self.selected_noise_hypotheses):
            others, residual_space = [*estimates, *self.selected_noise_hypotheses[i + 1 :]], space
            if isinstance(change.effect, CentringVariance):
                adjustment = self.refit((), self.reading_sigmas, others).adjustment
                residual_space = ResidualSpace.from_adjustment(adjustment).with_effects(effects)
            estimates.append(with_estimated_sizes(residual_space, self._sigmas_with_noise_hypotheses(others), change))
        return estimates

    def expected_variance_factors(self, effects: Sequence[CandidateEffect]) -> Floats:
        """Posterior mean (n, 3) of factors on the declared variances of n pointings, with `effects` in the model.

        Each selected hypothesis of changed noise is averaged over its alternatives, given the others.
        """
        factors = np.ones(self.reading_sigmas.shape)
        for change in (n for n in self.selected_noise_hypotheses if not isinstance(n.effect, CentringVariance)):
            others = self._sigmas_with_noise_hypotheses([n for n in self.selected_noise_hypotheses if n is not change])
            space = ResidualSpace.from_adjustment(self.refit((), others).adjustment).with_effects(effects)
            factors *= self._noise_hypotheses(space).expected_variance_factors()
        return factors

    def _noise_hypotheses(self, space: ResidualSpace) -> NoiseHypothesisSet:
        """Hypotheses of changed noise in the residual space `space`.

        The residual space is the space of whitened observations without the part that the unknowns absorb.
        """
        quieter = not any(
            getattr(change.effect, "shared_error_repetition", "") for change in self.selected_noise_hypotheses
        )
        return NoiseHypothesisSet.from_residual_space(
            space, noise_hypotheses(space.sightings, self.recording.instruments), allows_noise_below_declared=quieter
        )

    def with_pruned_noise(self, effects: Sequence[CandidateEffect]) -> SelectionState:
        """State of the model selection with new estimates of the noise, with `effects` in the model.

        Hypotheses of changed noise without a positive log evidence are removed.
        """
        state = self._with_estimated_variances(effects)
        supported = [
            n
            for n, change in zip(state.selected_noise_hypotheses, state._noise_estimates(effects), strict=True)
            if 0.5 * change.chi2_drop + change.log_prior > 0.0
        ]
        return state._with_selected_noise_hypotheses(supported).with_estimated_noise(effects)

    def _sigmas_with_noise_hypotheses(self, selected_noise_hypotheses: Sequence[NoiseHypothesis]) -> Floats:
        """Standard deviations (n, 3) [m, rad, rad] of the readings of n pointings, given a changed noise."""
        sigma, sightings = self.recording.reading_sigmas(), self.baseline_adjustment.sightings
        for change in selected_noise_hypotheses:
            sigma = np.sqrt(change.effect.variance(sightings, sigma, np.array(change.sizes)))
        return sigma
