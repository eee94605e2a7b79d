"""Declared uncertainty of the air along the beams."""

from ltsim.core.units import MILLIMETRE
from ltsim.recordings.keys import NonNegative, TomlSection


class AirUncertainty(TomlSection):
    """Standard deviations of the properties of the air along the beams: temperature, its vertical gradient, turbulence.

    The standard deviation is 0 for a property that was measured along the beams, so that its effect is already
    corrected.
    """

    temperature_k: NonNegative = 0.5
    """Standard deviation of the difference between the mean air temperature along the beams of a station and the
    temperature at its weather station."""
    gradient_k_per_m: NonNegative = 0.1
    """Standard deviation of the vertical temperature gradient at a station: 0.1 in good halls, 1 to
    2 in heated ones.
    """
    turbulence_um2_per_m3: NonNegative = 0.1
    """Variance of the displacement of a line of sight by turbulence, perpendicular to the beam, divided by the cube of
    the range."""
    beyond_mm: NonNegative = 10_000.0
    """Limit of the longest line of sight of a network: above it the adjustment takes the uncertainty of the air into
    account, in a network with only shorter lines of sight the uncertainty is neglected."""

    def is_relevant(self, max_range: float) -> bool:
        """True if the longest line of sight `max_range` [m] exceeds `beyond_mm`, so that the air is not neglected."""
        return max_range > self.beyond_mm * MILLIMETRE


NO_AIR_UNCERTAINTY = AirUncertainty(temperature_k=0.0, gradient_k_per_m=0.0, turbulence_um2_per_m3=0.0)
"""Zero uncertainty of the air, for formats of outdoor surveys: the standard deviations of their observations include
the atmosphere."""
