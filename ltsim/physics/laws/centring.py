"""Centring errors as a form of noise: a random displacement of the reflector at each occupation of a target."""

from __future__ import annotations

from dataclasses import dataclass

from ltsim.core.arrays import Floats
from ltsim.core.units import MILLIMETRE
from ltsim.physics.effects.linear_effect import Parameter
from ltsim.physics.laws.variance import VarianceFunction
from ltsim.recordings.centring_errors import CentringUncertainty, Occupation
from ltsim.scene.sightings import Sightings

OCCUPATION_TEXTS: dict[Occupation, str] = {
    "station": "for each set-up",
    "instrument_setup": "for each occupation by an instrument",
    "target_setup": "at each occupation",
    "day": "each day",
}
"""Phrases for users: when a reflector is placed on its target again, by the kind of occupation."""


def shared_errors_sentence(sigma_text: str) -> str:
    """Sentence on centring errors at all set-ups, with the text of the standard deviation of a displacement."""
    return (
        f"Repeated pointings of a target from one set-up share errors of {sigma_text} (standard deviation) along "
        "each axis: the reflectors were placed anew at each set-up (centring), or errors repeat in all rounds. "
        "The repeats are not independent."
    )


@dataclass(frozen=True)
class CentringVariance(VarianceFunction):
    """Hypothesis of centring errors: a random displacement of the reflector at each occupation of a target.

    All pointings of an occupation share its displacement, so that the variance of single readings does not change. The
    adjustment estimates the displacements. Their prior standard deviation is the parameter of the hypothesis.
    """

    occupation: Occupation = "station"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Only parameter: the standard deviation of the displacements along each axis."""
        return (Parameter("centring", "mm", "standard deviation of a displacement along each axis", MILLIMETRE),)

    @property
    def regressor_text(self) -> str:
        """Text of the regressor in reports: the displacement differs by occupation of the target."""
        return "occupation of the target"

    @property
    def text(self) -> str:
        """Description of the centring errors, for users."""
        return f"reflectors that are centred anew {OCCUPATION_TEXTS[self.occupation]}"

    def sentence(self, sigma_text: str) -> str:
        """Sentence on centring errors with the text of the standard deviation of a displacement."""
        if self.occupation == "station":
            return shared_errors_sentence(sigma_text)
        return f"Centring errors: {self.text}, with a standard deviation of {sigma_text} along each axis."

    def variance(self, sightings: Sightings, sigma: Floats, parameter_values: Floats) -> Floats:
        """Variance (n, 3) of the three readings of n pointings: the declared one, without the displacements."""
        return sigma**2

    def uncertainty(self, sigma: float) -> CentringUncertainty:
        """Declaration of the centring errors for `setup.toml`, with a standard deviation `sigma` [m]."""
        return CentringUncertainty(sigma_mm=sigma / MILLIMETRE, occupation=self.occupation)
