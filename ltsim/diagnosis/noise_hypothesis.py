"""Hypothesis of a change of the noise."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from ltsim.diagnosis.prior import log_prior_by_base_rate, log_prior_of_each_explanation
from ltsim.diagnosis.schema import Equivalent
from ltsim.physics.effects.linear_effect import CandidateNoiseEffect


@dataclass(frozen=True)
class NoiseHypothesis:
    """Hypothesis of a change of the noise. The sizes of its parameters are one point of a grid, or estimates."""

    family: str
    """Name of the kind of noise change. It begins with `unknown` for a kind outside the catalogue."""
    effect: CandidateNoiseEffect
    """Effect that changes the noise."""
    sizes: tuple[float, ...]
    """Sizes of its parameters [SI]."""
    size_sigmas: tuple[float, ...] = ()
    """Standard deviations of estimated sizes [SI]; empty for a point of a grid."""
    chi2_drop: float = 0.0
    """Twice the log restricted likelihood ratio of the estimates."""
    log_evidence: float = 0.0
    """Log evidence of this change of the noise, with its prior."""
    log_occam_factor: float = 0.0
    """Log evidence of the sizes of many groups minus the log likelihood ratio of their estimates; 0 for other changes.
    """
    probability: float = 0.0
    """Posterior probability that the effect is the cause."""
    equivalents: tuple[Equivalent, ...] = ()
    """Other effects that cannot be excluded."""

    @property
    def log_prior(self) -> float:
        """Log prior probability of a change of the noise, in the catalogue or outside it, among all explanations."""
        return log_prior_of_each_explanation("scatter" if self.family.startswith("unknown") else "noise", 1)

    @property
    def log_prior_times_occam_factor(self) -> float:
        """Log of the prior times the Occam factor: log evidence minus log likelihood ratio of the estimated sizes.

        It is at most the log prior. A log evidence without approximation may exceed a log likelihood ratio in the
        diagonal form.
        """
        return min(self.log_evidence - 0.5 * self.chi2_drop, self.log_prior)


def log_prior_of_noise_family(family: str, families: Collection[str]) -> float:
    """Log prior of a family of noise changes among `families`, in the catalogue or outside it (`unknown`).

    The probability of a change in the catalogue is divided in proportion to the base rates of the effects.
    """
    in_catalogue = [name for name in families if not name.startswith("unknown")]
    if family.startswith("unknown"):
        return log_prior_of_each_explanation("scatter", len(families) - len(in_catalogue))
    return float(log_prior_by_base_rate("noise", in_catalogue)[in_catalogue.index(family)])
