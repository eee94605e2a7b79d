"""State of the model selection: adjustment, variance components, residual space and search."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.refit import Refit, refit_with_effects
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Bools, Floats
from ltsim.diagnosis.evidence import WIDE_PRIOR_SIGMA_FACTOR, log_restricted_likelihood
from ltsim.diagnosis.hypotheses import Hypothesis, Model
from ltsim.diagnosis.instruments import ConstantContradiction
from ltsim.diagnosis.noise import NoiseHypothesisSet, noise_hypotheses
from ltsim.diagnosis.noise_centring import centring_hypotheses_with_evidence, with_declared_centring
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


@dataclass
class SelectionState:
    """State of the model selection on a recording without blunders."""

    baseline_adjustment: Adjustment
    """Ordinary adjustment, from which all other adjustments start."""
    is_used_reading: Bools
    """Flags (n, 3) of the readings that are used, for n pointings."""
    seed: int
    """Seed of the random draws of simulated recordings."""
    level: float | None = 0.05
    """False-alarm rate of the search; None for a search without p-value."""
    tests_ordinary_constants: bool = True
    """True if changes of the constants of the ordinary calibration are also hypotheses."""
    identified_effects: tuple[CandidateEffect, ...] = ()
    """Catalogue effects among the simple causes of the network, from which a second search starts if the noise is
    larger than declared."""
    reading_sigmas: Floats = field(init=False)
    """Standard deviations (n, 3) of the readings of n pointings, with the selected changes of the noise."""
    noise_changes: list[NoiseHypothesis] = field(default_factory=list)
    """Selected changes of the noise."""
    space: ResidualSpace = field(init=False)
    """Residual space of the present adjustment."""
    noise_hypotheses: NoiseHypothesisSet = field(init=False)
    """Hypotheses of changes of the noise in this residual space."""
    _searcher: Searcher | None = None
    """Search in this residual space; None before its first use."""
    _previous_searcher: Searcher | None = None
    """Search in the previous residual space, whose projected design matrices can be used again."""

    def __post_init__(self) -> None:
        self.reading_sigmas = self.recording.sigma()
        self.set_adjustment(self.baseline_adjustment)

    @property
    def searcher(self) -> Searcher:
        """Search in the residual space of the present adjustment, created on first use."""
        if self._searcher is None:
            before = self._previous_searcher
            is_reusable = before is not None and before.space.n_equations == self.space.n_equations
            catalogue_designs = (
                None
                if before is None or not is_reusable
                else before.catalogue_designs.with_weights_of(before.space, self.space)
            )
            trials = n_simulated_recordings(self.space, self.level) if before is None and self.level else 0
            self._previous_searcher = None
            self._searcher = Searcher(
                self.space,
                self.seed,
                trials,
                catalogue_designs=catalogue_designs,
                tests_ordinary_constants=self.tests_ordinary_constants,
            )
        return self._searcher

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
            adjust,
            with_declared_centring(old.recording, noise_changes),
            old.construction,
            sigma=sigma,
            reading_mask=self.is_used_reading,
            effect_prior_sigma=WIDE_PRIOR_SIGMA_FACTOR,
            prior=old.problem.prior,
        )

        def with_causes(effects: Sequence[LinearEffect] = (), start_state: NetworkState | None = None) -> Adjustment:
            """Adjustment with effects in addition to the causes of the baseline."""
            return adjusted(effects=(*effects, *old.effects), start_state=start_state)

        return refit_with_effects(with_causes if old.effects else adjusted, effects, start_state=old.state)

    def release_priors(self, contradictions: Sequence[ConstantContradiction]) -> None:
        """Removal of the prior of instrument constants that contradict their reference, followed by an adjustment."""
        old = self.baseline_adjustment
        freed = np.zeros(old.state.instrument_parameters.shape, dtype=bool)
        for contradiction in contradictions:
            owners = [self.recording.instruments.index(name) for name in contradiction.instruments]
            freed[owners, old.construction.parameter_names.index(contradiction.parameter.name)] = True
        prior = old.problem.prior.with_widened_sigmas(freed)
        self.baseline_adjustment = adjust(
            old.recording,
            old.construction,
            effects=old.effects,
            sigma=old.recording.sigma(),
            reading_mask=self.is_used_reading,
            start_state=old.state,
            prior=prior,
        )
        self.set_adjustment(self.refit((), self.reading_sigmas).adjustment)

    def set_adjustment(self, adjustment: Adjustment) -> None:
        """Replacement of the present adjustment, with its residual space and the search in it."""
        self.space, self._previous_searcher, self._searcher = (
            ResidualSpace.from_adjustment(adjustment),
            self._searcher or self._previous_searcher,
            None,
        )
        self.noise_hypotheses = self._noise_hypotheses(self.space)

    def ranked_noise_changes(self, model: Model) -> list[tuple[float, NoiseHypothesis]]:
        """Pairs of a log evidence and the most probable noise change of each kind, given a model.

        They are sorted by decreasing evidence.
        """
        redundancy = self.space.redundancy - np.sum(model.basis**2, axis=1)
        ranked = self.noise_hypotheses.ranked_noise_changes(model.residual, redundancy, model.basis)
        for gain, hypothesis in centring_hypotheses_with_evidence(self.space.with_effects(model.effects)):
            ranked.append((gain + self.noise_hypotheses.log_prior_of_family(hypothesis.family), hypothesis))
        return sorted(ranked, key=lambda entry: -entry[0])

    def add_noise_change(self, new_hypothesis: NoiseHypothesis) -> None:
        """Addition of a change of the noise; the sizes of an equal change that was selected before are increased."""
        for i, change in enumerate(self.noise_changes):
            if change.effect == new_hypothesis.effect:
                values = tuple(a + b for a, b in zip(change.sizes, new_hypothesis.sizes, strict=True))
                larger = replace(
                    change,
                    sizes=values,
                    chi2_drop=change.chi2_drop + new_hypothesis.chi2_drop,
                    log_evidence=change.log_evidence + new_hypothesis.log_evidence,
                    log_occam_factor=change.log_occam_factor + new_hypothesis.log_occam_factor,
                )
                self.noise_changes = [*self.noise_changes[:i], larger, *self.noise_changes[i + 1 :]]
                break
        else:
            self.noise_changes = [*self.noise_changes, new_hypothesis]
        self.reading_sigmas = self._sigmas_with_noise_changes(self.noise_changes)

    @property
    def log_evidence_of_noise(self) -> float:
        """Log evidence of the selected changes of the noise without effects, up to a constant of the recording.

        It is the restricted log likelihood of the present adjustment, plus for each change its log evidence minus its
        log likelihood ratio at the time of its selection.
        """
        return log_restricted_likelihood(self.space.adjustment) + sum(
            n.log_prior_times_occam_factor for n in self.noise_changes
        )

    def log_evidence_with_effects(self, members: Sequence[Hypothesis]) -> float:
        """Log evidence of hypotheses together with the selected changes of the noise.

        The changes of the noise are estimated with the hypotheses in the model. The result is comparable with
        `log_evidence_of_noise`, the log evidence without the hypotheses.
        """
        state = copy(self)
        state.space = ResidualSpace.from_adjustment(state.estimate_variance_components([h.effect for h in members]))
        return state.log_evidence_of_noise + Model.from_space(members, state.space).penalised_log_evidence

    def replace_by(self, state: SelectionState) -> None:
        """Replacement of this state by another `state` of the same recording."""
        vars(self).update(vars(state))

    def estimate_variance_components(self, effects: Sequence[CandidateEffect]) -> Adjustment:
        """Adjustment with variance components estimated by REML (Foerstner 1979), with `effects` in the model."""
        for _ in range(N_VARIANCE_ITERATIONS):
            self.noise_changes = [
                replace(
                    estimate,
                    chi2_drop=change.chi2_drop,
                    log_evidence=change.log_evidence + estimate.log_occam_factor - change.log_occam_factor,
                )
                for estimate, change in zip(self._noise_estimates(effects), self.noise_changes, strict=True)
            ]
            self.reading_sigmas = self._sigmas_with_noise_changes(self.noise_changes)
        return self.refit((), self.reading_sigmas).adjustment

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
        quieter = not any(getattr(change.effect, "repetition", "") for change in self.noise_changes)
        return NoiseHypothesisSet.from_space(
            space, noise_hypotheses(space.sightings, self.recording.instruments), allows_quieter=quieter
        )

    def prune_variance_components(self, effects: Sequence[CandidateEffect]) -> None:
        """New estimation of the variance components with `effects` in the model.

        Changes of the noise without a positive log evidence are removed.
        """
        self.estimate_variance_components(effects)
        self.noise_changes = [
            n
            for n, change in zip(self.noise_changes, self._noise_estimates(effects), strict=True)
            if 0.5 * change.chi2_drop + change.log_prior > 0.0
        ]
        self.reading_sigmas = self._sigmas_with_noise_changes(self.noise_changes)
        self.set_adjustment(self.estimate_variance_components(effects))

    def _sigmas_with_noise_changes(self, noise_changes: Sequence[NoiseHypothesis]) -> Floats:
        """Standard deviations (n, 3) of the readings of n pointings with the given changes of the noise."""
        sigma, sightings = self.recording.sigma(), self.baseline_adjustment.sightings
        for change in noise_changes:
            sigma = np.sqrt(change.effect.variance(sightings, sigma, np.array(change.sizes)))
        return sigma
