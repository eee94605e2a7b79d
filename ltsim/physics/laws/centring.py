"""Noise hypothesis of centring errors: a random displacement of the reflector at each occupation of a target."""

from __future__ import annotations

from dataclasses import dataclass

from ltsim.core.arrays import Floats
from ltsim.core.units import MILLIMETRE
from ltsim.physics.effects.linear_effect import Parameter
from ltsim.physics.laws.variance import VarianceFunction
from ltsim.recordings.centring_errors import CentringUncertainty, OccupationGrouping
from ltsim.scene.sightings import Sightings

RECENTRING_PHRASE_BY_OCCUPATION_GROUPING: dict[OccupationGrouping, str] = {
    "station": "for each set-up",
    "instrument_setup": "for each occupation by an instrument",
    "target_setup": "at each occupation",
    "day": "each day",
}
"""Phrases for users that say when a reflector is placed on its target again, by the kind of occupation."""


def shared_errors_sentence(sigma_text: str) -> str:
    """Sentence for users on centring errors at all set-ups.

    `sigma_text` is the standard deviation of a displacement as text with its unit.
    """
    return (
        f"Repeated pointings of a target from one set-up have common errors of {sigma_text} (standard deviation) along "
        "each axis: the reflectors were placed anew at each set-up (centring), or errors repeat in all rounds. "
        "The repeats are not independent."
    )


@dataclass(frozen=True)
class CentringVariance(VarianceFunction):
    """Noise hypothesis of centring errors: a random displacement of the reflector at each placement on a target.

    All pointings of a placement have the same displacement, so that the variance of single readings does not change.
    The adjustment estimates the displacements as unknowns. Their prior standard deviation is the parameter of the
    hypothesis.
    """

    occupation_grouping: OccupationGrouping = "station"
    """Kind of occupation, which says when a reflector is placed on its target again (such as at every set-up)."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Only parameter of the hypothesis: the standard deviation of the displacements along each axis."""
        return (Parameter("centring", "mm", "standard deviation of a displacement along each axis", MILLIMETRE),)

    @property
    def regressor_text(self) -> str:
        """Name, shown to users, of the covariate of the displacements: the occupation of the target."""
        return "occupation of the target"

    @property
    def text(self) -> str:
        """Description, shown to users, of the centring errors."""
        return f"reflectors that are centred anew {RECENTRING_PHRASE_BY_OCCUPATION_GROUPING[self.occupation_grouping]}"

    def sentence(self, sigma_text: str) -> str:
        """Sentence for users on the centring errors.

        `sigma_text` is the standard deviation of a displacement as text with its unit.
        """
        if self.occupation_grouping == "station":
            return shared_errors_sentence(sigma_text)
        return f"Centring errors: {self.text}, with a standard deviation of {sigma_text} along each axis."

    def variance(self, sightings: Sightings, sigma: Floats, parameter_values: Floats) -> Floats:
        """Variance (n, 3) of the three readings of n pointings: the declared variance, without the displacements."""
        return sigma**2

    def as_declared_uncertainty(self, sigma: float) -> CentringUncertainty:
        """Centring errors with the standard deviation `sigma` [m], as an entry of `setup.toml` declares them."""
        return CentringUncertainty(sigma_mm=sigma / MILLIMETRE, occupation=self.occupation_grouping)
