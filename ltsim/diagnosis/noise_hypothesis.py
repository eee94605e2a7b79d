"""Noise hypothesis: the readings scatter more or less than declared."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

from ltsim.diagnosis.prior import log_prior_by_base_rate, log_prior_of_each_explanation
from ltsim.diagnosis.schema import EquivalentEffect
from ltsim.physics.effects.linear_effect import CandidateNoiseEffect


@dataclass(frozen=True)
class NoiseHypothesis:
    """Noise hypothesis: an effect that changes the noise level, with tried or estimated sizes of its parameters."""

    family_name: str
    """Name of the kind of noise hypothesis (noise other than declared); it begins with `unknown` for a kind outside the
    catalogue."""
    effect: CandidateNoiseEffect
    """Effect that changes the noise level."""
    sizes: tuple[float, ...]
    """Values [SI] of the parameters of the effect on the noise, such as added variances divided by the declared
    variance."""
    size_sigmas: tuple[float, ...] = ()
    """Standard deviations of estimated sizes [SI]; empty if the sizes are values of a grid that are tried."""
    chi2_drop: float = 0.0
    """Twice the log restricted likelihood ratio of the noise with the estimated sizes to the declared noise."""
    log_evidence: float = 0.0
    """Log evidence of the hypothesis of changed noise, with its prior."""
    log_occam_factor: float = 0.0
    """Log of the Occam factor of separate noise of many groups: log evidence minus log likelihood ratio of the
    estimates; 0 for other hypotheses."""
    probability: float = 0.0
    """Posterior probability that the changed noise level is the cause of the misfit."""
    equivalents: tuple[EquivalentEffect, ...] = ()
    """Other effects that cannot be excluded as the cause of the misfit."""

    @property
    def log_prior(self) -> float:
        """Log prior probability of the noise hypothesis; kinds of the catalogue have another one than unknown kinds."""
        return log_prior_of_each_explanation("scatter" if self.family_name.startswith("unknown") else "noise", 1)

    @property
    def log_prior_times_occam_factor(self) -> float:
        """Log of the prior times the Occam factor: log evidence minus log likelihood ratio of the estimated sizes.

        The result is limited to the log prior, because a log evidence without approximation may exceed a log likelihood
        ratio with independent readings.
        """
        return min(self.log_evidence - 0.5 * self.chi2_drop, self.log_prior)

    def sum_with(self, added_change: NoiseHypothesis) -> NoiseHypothesis:
        """Sum of this hypothesis of changed noise and another one with the same effect: the sizes are added."""
        return replace(
            self,
            sizes=tuple(a + b for a, b in zip(self.sizes, added_change.sizes, strict=True)),
            chi2_drop=self.chi2_drop + added_change.chi2_drop,
            log_evidence=self.log_evidence + added_change.log_evidence,
            log_occam_factor=self.log_occam_factor + added_change.log_occam_factor,
        )


def log_prior_of_noise_family(family_name: str, family_names: Collection[str]) -> float:
    """Log prior probability of the kind of hypothesis of changed noise `family_name` among the kinds `family_names`.

    A kind is a catalogue effect, or begins with `unknown`. The probability of a change in the catalogue is divided in
    proportion to the base rates of the effects.
    """
    in_catalogue = [name for name in family_names if not name.startswith("unknown")]
    if family_name.startswith("unknown"):
        return log_prior_of_each_explanation("scatter", len(family_names) - len(in_catalogue))
    return float(log_prior_by_base_rate("noise", in_catalogue)[in_catalogue.index(family_name)])
