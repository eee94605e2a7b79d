"""Noise that differs between groups of readings: the whole recording, targets, set-ups, or readings in a heavy tail.

Sizes of arrays below: m observation equations, g groups, and a number of trials (recordings whose residuals are
evaluated together: the recording itself, or simulated recordings).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import scipy.sparse as sp
from scipy.special import expit, log_expit, logit

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.adjustment.significance import MIN_REPEATS_FOR_VARIANCE
from ltsim.calibration.evidence import log_sum_exp
from ltsim.core.arrays import Floats
from ltsim.diagnosis.evidence import log_restricted_likelihood_ratio, normalised_probabilities
from ltsim.physics.effects.linear_effect import CandidateNoiseEffect
from ltsim.physics.effects.noise_level import NoiseLevel
from ltsim.physics.laws.variance import VarianceFunction, noise_groups
from ltsim.recordings.recording import OBSERVABLES

GROUP_VARIANCE_FACTORS = np.geomspace(0.05, 400.0, 96)
"""Factors on the variance of a group of readings, in steps of 10 %, over which the evidence is averaged."""
COARSE_GROUP_VARIANCE_FACTORS = np.geomspace(1.5, 400.0, 15)
"""Factors on the variance of one of many groups of readings, over which the evidence is averaged; only clearly larger
variances are tried."""
NOISY_GROUP_FRACTIONS = np.array([0.05, 0.15, 0.5])
"""Fractions of targets, set-ups or readings with larger noise than declared, over which the evidence is averaged."""
MIN_READINGS_FOR_HEAVY_TAIL = 60
"""Smallest number of readings in a recording for which the search tries a heavy tail of their error distribution."""
MAX_READINGS_FOR_HEAVY_TAIL = 4000
"""Largest number of readings in a recording for which the search tries a heavy tail of their error distribution, to
limit the computing time."""
HEAVY_TAIL_VARIANCE_FACTORS = np.array([4.0, 12.0, 36.0, 100.0])
"""Factors on the variance of readings in a heavy tail of the error distribution, over which the evidence is averaged.
They correspond to two to ten times the declared standard deviation."""
NOISY_OBSERVABLE_SETS: tuple[tuple[str, ...], ...] = (*((name,) for name in OBSERVABLES), OBSERVABLES[1:], OBSERVABLES)
"""Sets of observables that may have larger noise together."""


@dataclass(frozen=True)
class GroupNoiseHypothesis:
    """Hypothesis of changed noise with a separate variance factor for each of g groups of readings."""

    effect: CandidateNoiseEffect
    """Effect on the noise level, with one parameter per group of readings."""
    group_indicators: sp.csr_array
    """Indicators (g, m) of those of m observations that belong to each of g groups."""
    variance_factor_grid: Floats
    """Variance factors of a group over which the evidence is averaged."""

    @property
    def name(self) -> str:
        """Name of this kind of hypothesis of changed noise."""
        return self.effect.name

    def log_evidence_by_group(self, residual: Floats, redundancy: Floats) -> Floats:
        """Log evidence (g, trials) that the noise of a group differs from the declared noise, for each of g groups.

        It is averaged over variance factors. `residual` (m, trials) are m whitened residuals of each recording (trial),
        and `redundancy` (m,) their redundancy numbers.
        """
        squares, share = self.group_indicators @ residual**2, self.group_indicators @ redundancy
        log_totals = log_sum_exp(
            log_restricted_likelihood_ratio(squares, share[:, None], self.variance_factor_grid[:, None, None])
        )
        return log_totals - np.log(len(self.variance_factor_grid))

    def log_evidence(self, residual: Floats, redundancy: Floats) -> Floats:
        """Log evidence (trials,) of the changed noise in each recording (trial), from m residuals (m, trials).

        `redundancy` (m,) are the redundancy numbers of the m residuals.
        """
        raise NotImplementedError

    def limited_to_most_probable_place(self, residual: Floats, redundancy: Floats) -> tuple[GroupNoiseHypothesis, ...]:
        """Copies of the hypothesis, limited to the targets, the station or the region with the largest evidence.

        The result is empty for a hypothesis that cannot be limited in this way.
        """
        del residual, redundancy
        return ()

    def expected_variance_factors(self, residual: Floats, redundancy: Floats) -> Floats:
        """Posterior mean (m,) of the variance factors of m observations, for residuals (m,); 1 outside all groups."""
        factors: Floats = 1.0 + self.group_indicators.T @ self._expected_added_variance(residual, redundancy)
        return factors

    def _expected_added_variance(self, residual: Floats, redundancy: Floats) -> Floats:
        """Posterior mean (g,) of the added variance of each of g groups, in units of the declared variance."""
        raise NotImplementedError

    def _added_variance_if_noisy(self, residual: Floats, redundancy: Floats) -> Floats:
        """Posterior mean (g,) of the added variance of each of g groups of readings, if its noise is not as declared.

        The added variance is divided by the declared variance.
        """
        log_ratios = log_restricted_likelihood_ratio(
            self.group_indicators @ residual**2, self.group_indicators @ redundancy, self.variance_factor_grid[:, None]
        )
        mean_added_variance: Floats = np.sum(
            normalised_probabilities(log_ratios) * (self.variance_factor_grid[:, None] - 1.0), axis=0
        )
        return mean_added_variance

    def most_likely_effect(self, residual: Floats, redundancy: Floats) -> CandidateNoiseEffect:
        """Effect on the noise with the most probable observables and time windows for m whitened residuals (m,).

        The sizes of the effect are estimated afterwards.
        """
        del residual, redundancy
        return self.effect


class RecordingNoiseLevel(GroupNoiseHypothesis):
    """Noise level of the whole recording: one variance factor for all observables, or separate factors."""

    @classmethod
    def from_residual_space(cls, space: ResidualSpace, *, allows_noise_below_declared: bool) -> RecordingNoiseLevel:
        """Hypothesis on the noise level of a recording, from the residual space of its adjustment.

        The level is below the declared one only if `allows_noise_below_declared`.

        The level is below the declared one only if `allows_noise_below_declared`.
        """
        level, kind = NoiseLevel(), np.nonzero(space.is_used_reading)[1]
        group_indicators = sp.csr_array(
            (np.ones(len(kind)), (kind, np.arange(len(kind)))), (len(OBSERVABLES), space.n_equations)
        )
        return cls(
            level,
            group_indicators,
            GROUP_VARIANCE_FACTORS
            if allows_noise_below_declared
            else GROUP_VARIANCE_FACTORS[GROUP_VARIANCE_FACTORS > 1.0],
        )

    def log_evidence(self, residual: Floats, redundancy: Floats) -> Floats:
        """Log evidence (trials,) of a changed noise level for each recording (trial), from m residuals (m, trials).

        A common factor of each set of observables in `NOISY_OBSERVABLE_SETS`, and separate factors of some observables,
        have equal prior probabilities.
        """
        alternatives = self._log_evidence_of_alternatives(residual, redundancy)
        return log_sum_exp(alternatives) - np.log(len(alternatives))

    @property
    def _common_groups(self) -> list[tuple[Floats, RecordingNoiseLevel]]:
        """Indicators (g,) of the observables of each set in `NOISY_OBSERVABLE_SETS`, and noise level of the set."""
        flags = [np.isin(OBSERVABLES, names).astype(np.float64) for names in NOISY_OBSERVABLE_SETS]
        return [(f, replace(self, group_indicators=sp.csr_array(f[None, :] @ self.group_indicators))) for f in flags]

    def _log_evidence_of_alternatives(self, residual: Floats, redundancy: Floats) -> Floats:
        """Log evidence (sets + 1, trials) of a common factor of each set of observables, then of separate factors.

        With separate factors the noise of at least one observable differs from the declared noise.
        """
        common = [level.log_evidence_by_group(residual, redundancy)[0] for _, level in self._common_groups]
        any_observable = np.logaddexp(0.0, self.log_evidence_by_group(residual, redundancy)).sum(axis=0)
        separate = (
            any_observable
            + np.log(-np.expm1(-np.maximum(any_observable, np.finfo(np.float64).tiny)))
            - np.log(2.0 ** len(OBSERVABLES) - 1.0)
        )
        return np.vstack([*common, separate])

    def _expected_added_variance(self, residual: Floats, redundancy: Floats) -> Floats:
        """Posterior mean (g,) of the added variance of each of g observables, divided by the declared variance.

        It is an average over common factors and separate factors.
        """
        probabilities = normalised_probabilities(
            self._log_evidence_of_alternatives(residual[:, None], redundancy)[:, 0]
        )
        each = self.log_evidence_by_group(residual[:, None], redundancy)[:, 0]
        noisy = expit(each) / max(-np.expm1(log_expit(-each).sum()), np.finfo(np.float64).tiny)
        added: Floats = probabilities[-1] * noisy * self._added_variance_if_noisy(residual, redundancy)
        for probability, (is_in_set, level) in zip(probabilities[:-1], self._common_groups, strict=True):
            added = added + probability * is_in_set * level._added_variance_if_noisy(residual, redundancy)[0]
        return added


class GroupNoiseMixture(GroupNoiseHypothesis):
    """Noise that is larger than declared for a fraction of the targets, of the stations, or of the readings."""

    @classmethod
    def candidates(cls, space: ResidualSpace) -> tuple[GroupNoiseMixture, ...]:
        """Hypotheses of separate noise by target and by station, and of a heavy tail, in a residual space.

        The residual space is the space of whitened observations without the part that the unknowns absorb. Targets and
        stations have a common factor for all observables, or a separate factor for each.
        """
        banks, kinds = [], len(OBSERVABLES)
        for each, per_observable in product(("target", "station"), (False, True)):
            names, of = noise_groups(space.sightings, each)
            if len(names) < MIN_REPEATS_FOR_VARIANCE:
                continue
            key = of[:, None] * kinds + np.arange(kinds) if per_observable else np.repeat(of[:, None], kinds, axis=1)
            rows = key[space.is_used_reading]
            shape = len(names) * (kinds if per_observable else 1), space.n_equations
            group_indicators = sp.csr_array((np.ones(len(rows)), (rows, np.arange(len(rows)))), shape)
            banks.append(
                cls(
                    VarianceFunction(group_kind=each, group_names=names, has_variance_per_observable=per_observable),
                    group_indicators,
                    COARSE_GROUP_VARIANCE_FACTORS,
                )
            )
        if MIN_READINGS_FOR_HEAVY_TAIL <= space.n_equations <= MAX_READINGS_FOR_HEAVY_TAIL:
            banks += [cls._heavy_tail(space, acts) for acts in NOISY_OBSERVABLE_SETS]
        return tuple(banks)

    @classmethod
    def _heavy_tail(cls, space: ResidualSpace, observables: tuple[str, ...]) -> GroupNoiseMixture:
        """Hypothesis of a heavy tail: a fraction of the readings of `observables` has larger noise than declared."""
        pointing, kind = np.nonzero(space.is_used_reading)
        column = np.array([observables.index(o) if o in observables else -1 for o in OBSERVABLES])[kind]
        places = np.flatnonzero(column >= 0)
        reading_indices = pointing[places] * len(observables) + column[places]
        names, _ = noise_groups(space.sightings, "reading")
        group_indicators = sp.csr_array(
            (np.ones(len(reading_indices)), (reading_indices, places)),
            (len(names) * len(observables), space.n_equations),
        )
        effect = VarianceFunction(
            observables, group_kind="reading", group_names=names, has_variance_per_observable=True
        )
        return cls(effect, group_indicators, HEAVY_TAIL_VARIANCE_FACTORS)

    @property
    def name(self) -> str:
        """Name of this kind of hypothesis of changed noise."""
        return f"unknown:noise:each {getattr(self.effect, 'group_kind', '')}"

    def log_evidence(self, residual: Floats, redundancy: Floats) -> Floats:
        """Log evidence (trials,) for each recording (trial), averaged over the fraction of noisy groups.

        `residual` (m, trials) are m whitened residuals of each recording, and `redundancy` (m,) their redundancy
        numbers.
        """
        return log_sum_exp(self._log_evidence_by_fraction(residual, redundancy)) - np.log(len(NOISY_GROUP_FRACTIONS))

    def _log_evidence_by_fraction(self, residual: Floats, redundancy: Floats) -> Floats:
        """Log evidence (q, trials) for each recording (trial) and each of q fractions of noisy groups."""
        each = self.log_evidence_by_group(residual, redundancy)
        return np.stack([np.logaddexp(np.log1p(-q), np.log(q) + each).sum(axis=0) for q in NOISY_GROUP_FRACTIONS])

    def _expected_added_variance(self, residual: Floats, redundancy: Floats) -> Floats:
        """Posterior mean (g,) of the added variance of each of g groups of readings, divided by the declared variance.

        It is an average over the fraction of noisy groups.
        """
        weight = normalised_probabilities(self._log_evidence_by_fraction(residual[:, None], redundancy)[:, 0])
        log_odds = (
            self.log_evidence_by_group(residual[:, None], redundancy)[:, 0] + logit(NOISY_GROUP_FRACTIONS)[:, None]
        )
        added: Floats = weight @ expit(log_odds) * self._added_variance_if_noisy(residual, redundancy)
        return added
