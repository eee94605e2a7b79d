"""Uncertainty of the air along the beams, as declared in the table `[air]` of `setup.toml`."""

from ltsim.core.units import MILLIMETRE
from ltsim.recordings.keys import NonNegative, TomlSection


class AirUncertainty(TomlSection):
    """Standard deviations of temperature, vertical temperature gradient and turbulence of the air along the beams.

    Set a standard deviation to 0 if the instrument or the user has already corrected the readings for this property.
    """

    temperature_k: NonNegative = 0.5
    """Standard deviation [K] of the mean air temperature along the beams of a station minus the temperature at its
    weather station."""
    gradient_k_per_m: NonNegative = 0.1
    """Standard deviation [K/m] of the vertical temperature gradient at a station: 0.1 in good halls, 1 to 2 in heated
    halls."""
    turbulence_um2_per_m3: NonNegative = 0.1
    """Variance of the turbulent displacement of a beam, divided by the cube of the range [um^2/m^3]. The displacement
    is perpendicular to the beam, at the reflector."""
    negligible_up_to_mm: NonNegative = 10_000.0
    """Length [mm] of the longest line of sight of a network up to which the adjustment neglects the uncertainty of the
    air."""

    def is_relevant(self, max_range: float) -> bool:
        """True if the adjustment must model the uncertainty of the air.

        This is so if the longest line of sight of a network, `max_range` [m], exceeds `negligible_up_to_mm`.
        """
        return max_range > self.negligible_up_to_mm * MILLIMETRE


NO_AIR_UNCERTAINTY = AirUncertainty(temperature_k=0.0, gradient_k_per_m=0.0, turbulence_um2_per_m3=0.0)
"""Uncertainty of 0 for all properties of the air, for formats of outdoor surveys: their declared standard deviations of
observations already include the atmosphere."""
