"""Hypothesis of a change of the noise."""

from __future__ import annotations

from dataclasses import dataclass

from ltsim.diagnosis.prior import log_prior_share
from ltsim.diagnosis.schema import Equivalent
from ltsim.physics.effects.signature import NoiseSignature


@dataclass(frozen=True)
class NoiseHypothesis:
    """A noise effect with sizes: a point of its grid, or estimates with standard deviations and evidence."""

    family: str
    effect: NoiseSignature
    sizes: tuple[float, ...]
    size_sigmas: tuple[float, ...] = ()
    chi2_drop: float = 0.0
    evidence: float = 0.0
    probability: float = 0.0
    equivalents: tuple[Equivalent, ...] = ()

    @property
    def log_prior(self) -> float:
        """Log prior probability of its kind among all explanations."""
        return log_prior_share("scatter" if self.family.startswith("unknown") else "noise", 1)
