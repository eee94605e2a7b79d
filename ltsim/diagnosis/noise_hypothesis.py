"""Hypothesis of a change of the noise."""

from __future__ import annotations

from dataclasses import dataclass

from ltsim.diagnosis.prior import log_prior_share
from ltsim.diagnosis.schema import Equivalent
from ltsim.physics.effects.linear_effect import CandidateNoiseEffect


@dataclass(frozen=True)
class NoiseHypothesis:
    """Change of the noise with its sizes, which are a point of a grid, or estimates."""

    family: str
    """Name of the kind of noise change, which begins with `unknown` if the catalogue has none of them."""
    effect: CandidateNoiseEffect
    """Effect that changes the noise."""
    sizes: tuple[float, ...]
    """Sizes of its parameters [SI]."""
    size_sigmas: tuple[float, ...] = ()
    """Standard deviations of estimated sizes [SI]; empty for a point of a grid."""
    chi2_drop: float = 0.0
    """Twice the log restricted likelihood ratio of the estimates."""
    evidence: float = 0.0
    """Log evidence of this change of the noise, with its prior."""
    probability: float = 0.0
    """Posterior probability that the effect is the cause."""
    equivalents: tuple[Equivalent, ...] = ()
    """Other effects that cannot be excluded."""

    @property
    def log_prior(self) -> float:
        """Log prior probability of a change of the noise, in the catalogue or outside it, among all explanations."""
        return log_prior_share("scatter" if self.family.startswith("unknown") else "noise", 1)
