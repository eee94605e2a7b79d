"""Declared uncertainty of the air along the beams."""

from ltsim.core.units import MILLIMETRE
from ltsim.recordings.keys import NonNegative, TomlSection


class AirUncertainty(TomlSection):
    """Uncertainty of the air along the beams, as standard deviations of its properties.

    The standard deviation of a measured property is 0.
    """

    temperature_k: NonNegative = 0.5
    """Standard deviation of the difference between the mean air temperature along the beams of a station and the
    temperature at its weather station."""
    gradient_k_per_m: NonNegative = 0.1
    """Standard deviation of the vertical temperature gradient at a station: 0.1 in good halls, 1 to
    2 in heated ones.
    """
    turbulence_um2_per_m3: NonNegative = 0.1
    """Variance by which turbulence displaces a line of sight perpendicular to the beam, divided by the cube of its
    range."""
    beyond_mm: NonNegative = 10_000.0
    """Length of the longest line of sight of a network above which the adjustment takes the uncertainty of the air into
    account; a shorter network neglects it."""

    def is_relevant(self, max_range: float) -> bool:
        """True if the uncertainty of the air matters in a network whose longest range is `max_range` [m]."""
        return max_range > self.beyond_mm * MILLIMETRE


NO_AIR_UNCERTAINTY = AirUncertainty(temperature_k=0.0, gradient_k_per_m=0.0, turbulence_um2_per_m3=0.0)
"""Zero uncertainty of the air, for formats of outdoor surveys: the standard deviations of their observations include
the atmosphere."""
