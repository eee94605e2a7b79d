"""State of the model selection: adjustment, variance components, residual space and search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from ltsim.adjustment import Adjustment, adjust_from_state
from ltsim.adjustment.refit import Refit, refit_with_effects
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Bools, Floats
from ltsim.diagnosis.catalogue_designs import CatalogueDesigns
from ltsim.diagnosis.evidence import WIDE_PRIOR_SIGMA_FACTOR, log_restricted_likelihood
from ltsim.diagnosis.hypotheses import Hypothesis, Model
from ltsim.diagnosis.instruments import ConstantContradiction
from ltsim.diagnosis.noise import NoiseHypothesisSet, noise_hypotheses
from ltsim.diagnosis.noise_centring import log_evidence_and_centring_hypotheses, with_declared_centring
from ltsim.diagnosis.noise_estimation import with_estimated_sizes
from ltsim.diagnosis.noise_hypothesis import NoiseHypothesis
from ltsim.diagnosis.null_ensemble import n_simulated_recordings
from ltsim.diagnosis.search import Searcher
from ltsim.physics.effects.linear_effect import CandidateEffect, LinearEffect
from ltsim.physics.laws.centring import CentringVariance
from ltsim.physics.model.measurement import NetworkState
from ltsim.recordings.recording import Recording

N_VARIANCE_ITERATIONS = 2
"""Number of adjustments with new weights, after which the variance components have converged."""


@dataclass(frozen=True)
class SelectionState:
    """State of the model selection on a recording without blunders; each step of the selection returns a new state."""

    baseline_adjustment: Adjustment
    """Ordinary adjustment, from which all other adjustments start."""
    is_used_reading: Bools
    """Flags (n, 3) of the readings that are used, for n pointings."""
    seed: int
    """Seed of the random draws of simulated recordings."""
    false_alarm_rate: float | None
    """False-alarm rate of the search; None for a search without p-value."""
    tests_ordinary_constants: bool
    """True if changes of the constants of the ordinary calibration are also hypotheses."""
    effects_of_uncorrected_causes: tuple[CandidateEffect, ...]
    """Catalogue effects among the simple causes of the network, from which a second search starts if the noise is
    larger than declared."""
    reading_sigmas: Floats
    """Standard deviations (n, 3) of the readings of n pointings, with the selected changes of the noise."""
    space: ResidualSpace
    """Residual space of the present adjustment."""
    noise_changes: tuple[NoiseHypothesis, ...] = ()
    """Selected changes of the noise."""
    earlier_designs: CatalogueDesigns | None = None
    """Design matrices of the most recent search in an earlier state; None before the first search."""

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
        """State before the first step of the selection, from the ordinary adjustment and the attributes of a state."""
        return cls(
            adjustment,
            is_used_reading,
            seed,
            false_alarm_rate,
            tests_ordinary_constants,
            effects_of_uncorrected_causes,
            adjustment.recording.sigma(),
            ResidualSpace.from_adjustment(adjustment),
        )

    @cached_property
    def searcher(self) -> Searcher:
        """Search in the residual space of the present adjustment.

        It uses the design matrices of an earlier search, with other weights, if the rows of the residual space are the
        same. Only the first search of a recording has a p-value.
        """
        earlier = self.earlier_designs
        is_reusable = earlier is not None and earlier.n_equations == self.space.n_equations
        return Searcher(
            self.space,
            self.seed,
            n_simulated_recordings(self.space, self.false_alarm_rate)
            if earlier is None and self.false_alarm_rate
            else 0,
            catalogue_designs=earlier.with_weights_of(self.space) if earlier is not None and is_reusable else None,
            tests_ordinary_constants=self.tests_ordinary_constants,
        )

    @cached_property
    def noise_hypotheses(self) -> NoiseHypothesisSet:
        """Hypotheses of changes of the noise in the residual space of the present adjustment."""
        return self._noise_hypotheses(self.space)

    @property
    def empty_model(self) -> Model:
        """Model without effects."""
        return Model.from_space((), self.space)

    @property
    def recording(self) -> Recording:
        """Recording without blunders, whose set-up declares the centring errors among the selected noise changes."""
        return with_declared_centring(self.baseline_adjustment.recording, self.noise_changes)

    def refit(
        self, effects: Sequence[CandidateEffect], sigma: Floats, noise_changes: Sequence[NoiseHypothesis] | None = None
    ) -> Refit:
        """Nonlinear adjustment with effects in the model and standard deviations `sigma` (n, 3) of n pointings.

        Without effects and changes of the noise it is the ordinary adjustment. Parameters have a prior standard
        deviation of `WIDE_PRIOR_SIGMA_FACTOR` times their plausible size, because the readings may not determine some
        combinations. The centring errors among `noise_changes`, by default among all selected ones, are in the model.
        """
        noise_changes = self.noise_changes if noise_changes is None else noise_changes
        if not (effects or noise_changes):
            return Refit(self.baseline_adjustment, (), ())
        old = self.baseline_adjustment
        adjusted = partial(
            adjust_from_state,
            with_declared_centring(old.recording, noise_changes),
            old.construction,
            sigma=sigma,
            reading_mask=self.is_used_reading,
            effect_prior_sigma=WIDE_PRIOR_SIGMA_FACTOR,
            prior=old.problem.prior,
        )

        def with_causes(effects: Sequence[LinearEffect], start_state: NetworkState) -> Adjustment:
            """Adjustment with effects in addition to the causes of the baseline."""
            return adjusted(effects=(*effects, *old.effects), start_state=start_state)

        return refit_with_effects(with_causes if old.effects else adjusted, effects, start_state=old.state)

    def with_widened_priors(self, contradictions: Sequence[ConstantContradiction]) -> SelectionState:
        """State after an adjustment without the prior of the constants that contradict their reference."""
        old = self.baseline_adjustment
        freed = np.zeros(old.state.instrument_parameters.shape, dtype=bool)
        for contradiction in contradictions:
            owners = [self.recording.instruments.index(name) for name in contradiction.instruments]
            freed[owners, old.construction.parameter_names.index(contradiction.parameter.name)] = True
        prior = old.problem.prior.with_widened_sigmas(freed)
        baseline = adjust_from_state(
            old.recording,
            old.construction,
            effects=old.effects,
            sigma=old.recording.sigma(),
            reading_mask=self.is_used_reading,
            start_state=old.state,
            prior=prior,
        )
        return self._with_attributes(baseline_adjustment=baseline)._with_space_of_refit()

    def _with_attributes(self, **attributes: object) -> SelectionState:
        """Copy of the state with other attributes, and with the design matrices of its search, if there was one."""
        searcher: Searcher | None = vars(self).get("searcher")  # no search is started for its design matrices alone
        designs = self.earlier_designs if searcher is None else searcher.catalogue_designs
        return replace(self, earlier_designs=designs, **attributes)  # type: ignore[arg-type]

    def _with_space_of_refit(self) -> SelectionState:
        """State with the residual space of an adjustment without effects, with the present noise."""
        adjustment = self.refit((), self.reading_sigmas).adjustment
        return self._with_attributes(space=ResidualSpace.from_adjustment(adjustment))

    def ranked_noise_changes(self, model: Model) -> list[tuple[float, NoiseHypothesis]]:
        """Pairs of a log evidence and the most probable noise change of each kind, given a model.

        They are sorted by decreasing evidence.
        """
        redundancy = self.space.redundancy - np.sum(model.basis**2, axis=1)
        ranked = self.noise_hypotheses.ranked_noise_changes(model.residual, redundancy, model.basis)
        for gain, hypothesis in log_evidence_and_centring_hypotheses(self.space.with_effects(model.effects)):
            ranked.append((gain + self.noise_hypotheses.log_prior_of_family(hypothesis.family), hypothesis))
        return sorted(ranked, key=lambda entry: -entry[0])

    def with_noise_change(self, hypothesis: NoiseHypothesis, effects: Sequence[CandidateEffect]) -> SelectionState:
        """State after the addition of a change of the noise, whose sizes are estimated with `effects` in the model.

        If an equal change was selected before, its sizes are increased. All changes of the noise are then estimated
        together.
        """
        new_change = with_estimated_sizes(self.space.with_effects(effects), self.space.reading_sigmas, hypothesis)
        if all(change.effect != new_change.effect for change in self.noise_changes):
            return self._with_noise_changes((*self.noise_changes, new_change)).with_estimated_noise(effects)
        noise_changes = [
            change if change.effect != new_change.effect else change.sum_with(new_change)
            for change in self.noise_changes
        ]
        return self._with_noise_changes(noise_changes).with_estimated_noise(effects)

    def _with_noise_changes(self, noise_changes: Sequence[NoiseHypothesis]) -> SelectionState:
        """State with other changes of the noise and the standard deviations of readings that follow from them."""
        changed = self._with_attributes(noise_changes=tuple(noise_changes))
        return changed._with_attributes(reading_sigmas=changed._sigmas_with_noise_changes(noise_changes))

    @property
    def log_evidence_of_noise(self) -> float:
        """Log evidence of the selected changes of the noise without effects, up to a constant of the recording.

        It is the restricted log likelihood of the present adjustment, plus for each change its log evidence minus its
        log likelihood ratio at the time of its selection.
        """
        return log_restricted_likelihood(self.space.adjustment) + sum(
            n.log_prior_times_occam_factor for n in self.noise_changes
        )

    def log_evidence_with_effects(self, hypotheses: Sequence[Hypothesis]) -> float:
        """Log evidence of hypotheses together with the selected changes of the noise.

        The changes of the noise are estimated with the hypotheses in the model. The result is comparable with
        `log_evidence_of_noise`, the log evidence without the hypotheses.
        """
        state = self.with_estimated_noise([h.effect for h in hypotheses])
        return state.log_evidence_of_noise + Model.from_space(hypotheses, state.space).penalised_log_evidence

    def with_estimated_noise(self, effects: Sequence[CandidateEffect]) -> SelectionState:
        """State with variance components estimated by REML (Foerstner 1979), with `effects` in the model.

        Its residual space is that of an adjustment with the estimated noise.
        """
        return self._with_estimated_variances(effects)._with_space_of_refit()

    def _with_estimated_variances(self, effects: Sequence[CandidateEffect]) -> SelectionState:
        """State with variance components as in `with_estimated_noise`, but with the present residual space."""
        state = self
        for _ in range(N_VARIANCE_ITERATIONS):
            estimates = state._noise_estimates(effects)
            state = state._with_noise_changes(
                [
                    replace(
                        estimate,
                        chi2_drop=change.chi2_drop,
                        log_evidence=change.log_evidence + estimate.log_occam_factor - change.log_occam_factor,
                    )
                    for estimate, change in zip(estimates, state.noise_changes, strict=True)
                ]
            )
        return state

    def _noise_estimates(self, effects: Sequence[CandidateEffect]) -> list[NoiseHypothesis]:
        """Selected changes of the noise with new estimates of their sizes, with `effects` in the model.

        The sizes of each change are estimated given the other changes.

        Centring errors are estimated in an adjustment without centring errors. In an adjustment with them, the
        displacements have absorbed part of an effect.
        """
        space = ResidualSpace.from_adjustment(self.refit((), self.reading_sigmas).adjustment).with_effects(effects)
        estimates = list[NoiseHypothesis]()
        for i, change in enumerate(self.noise_changes):
            others, residual_space = [*estimates, *self.noise_changes[i + 1 :]], space
            if isinstance(change.effect, CentringVariance):
                adjustment = self.refit((), self.reading_sigmas, others).adjustment
                residual_space = ResidualSpace.from_adjustment(adjustment).with_effects(effects)
            estimates.append(with_estimated_sizes(residual_space, self._sigmas_with_noise_changes(others), change))
        return estimates

    def expected_variance_factors(self, effects: Sequence[CandidateEffect]) -> Floats:
        """Posterior mean (n, 3) of factors on the declared variances of n pointings, with `effects` in the model.

        Each selected change of the noise is averaged over its alternatives, given the others.
        """
        factors = np.ones(self.reading_sigmas.shape)
        for change in (n for n in self.noise_changes if not isinstance(n.effect, CentringVariance)):
            others = self._sigmas_with_noise_changes([n for n in self.noise_changes if n is not change])
            space = ResidualSpace.from_adjustment(self.refit((), others).adjustment).with_effects(effects)
            factors *= self._noise_hypotheses(space).expected_variance_factors()
        return factors

    def _noise_hypotheses(self, space: ResidualSpace) -> NoiseHypothesisSet:
        """Hypotheses of changes of the noise in a residual space."""
        quieter = not any(getattr(change.effect, "shared_error_repetition", "") for change in self.noise_changes)
        return NoiseHypothesisSet.from_space(
            space, noise_hypotheses(space.sightings, self.recording.instruments), allows_quieter=quieter
        )

    def with_pruned_noise(self, effects: Sequence[CandidateEffect]) -> SelectionState:
        """State with new estimates of the noise, with `effects` in the model.

        Changes of the noise without a positive log evidence are removed.
        """
        state = self._with_estimated_variances(effects)
        supported = [
            n
            for n, change in zip(state.noise_changes, state._noise_estimates(effects), strict=True)
            if 0.5 * change.chi2_drop + change.log_prior > 0.0
        ]
        return state._with_noise_changes(supported).with_estimated_noise(effects)

    def _sigmas_with_noise_changes(self, noise_changes: Sequence[NoiseHypothesis]) -> Floats:
        """Standard deviations (n, 3) of the readings of n pointings with the given changes of the noise."""
        sigma, sightings = self.recording.sigma(), self.baseline_adjustment.sightings
        for change in noise_changes:
            sigma = np.sqrt(change.effect.variance(sightings, sigma, np.array(change.sizes)))
        return sigma
