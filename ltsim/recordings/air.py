"""Declared uncertainty of the air along the beams."""

from ltsim.core.units import MILLIMETRE
from ltsim.recordings.keys import NonNegative, TomlSection


class Air(TomlSection):
    """Standard deviations of the properties of the air that were not measured; 0 for a property that is known."""

    temperature_k: NonNegative = 0.5
    """Standard deviation of the mean temperature along the beams of a station, less that at its weather station."""
    gradient_k_per_m: NonNegative = 0.1
    """Standard deviation of the vertical temperature gradient at a station; 0.1 in good halls, 1 to 2 if heated."""
    turbulence_um2_per_m3: NonNegative = 0.1
    """Variance of a pointing across the beam over the cube of its range."""
    beyond_mm: NonNegative = 10_000.0
    """The air counts where the longest range is longer than this."""

    def counts(self, longest: float) -> bool:
        """True if a network whose longest range is so long [m] holds the air in its budget."""
        return longest > self.beyond_mm * MILLIMETRE


NO_AIR = Air(temperature_k=0.0, gradient_k_per_m=0.0, turbulence_um2_per_m3=0.0)
"""Air of formats of outdoor surveys: the standard deviations of their observations include the atmosphere."""
