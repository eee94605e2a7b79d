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
    negligible_up_to_mm: NonNegative = 10_000.0
    """Longest line of sight of a network up to which the adjustment neglects the uncertainty of the air."""

    def is_relevant(self, max_range: float) -> bool:
        """True if the longest line of sight of a network, `max_range` [m], exceeds `negligible_up_to_mm`."""
        return max_range > self.negligible_up_to_mm * MILLIMETRE


NO_AIR_UNCERTAINTY = AirUncertainty(temperature_k=0.0, gradient_k_per_m=0.0, turbulence_um2_per_m3=0.0)
"""Zero uncertainty of the air, for formats of outdoor surveys: the standard deviations of their observations include
the atmosphere."""
