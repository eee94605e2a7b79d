"""Uncertainty of the air along the beams that was not measured; a budget includes it where ranges are long.

Three causes, each a catalogue effect: another temperature along the beams of a station (`station-weather`: 0.95 ppm/K
of a range), a vertical gradient there (`air-gradient`: light bends by beta G d^2 / 2) and turbulence (`turbulence`: a
variance of C d^3 across the beam). At 10 m the sizes below are 5 um along and 11 um across the beam, at 40 m 19 um and
110 um, under what makers guarantee across the beam there (15 um + 6 um/m).
"""

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICROMETRE, MILLIMETRE
from ltsim.physics.effects.air_gradient import AirGradient
from ltsim.physics.effects.rays import bending
from ltsim.physics.effects.station_weather import StationWeather
from ltsim.physics.effects.turbulence import Turbulence
from ltsim.recordings.setup import NonNegative, TomlSection
from ltsim.scene.sightings import Sightings


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

    def errors(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 2 S) of the raw readings by a sigma of the temperature and of the gradient of each station."""
        scale = bending() * self.temperature_k
        columns = []
        for name in sightings.station_names:
            columns.append(StationWeather(stations=(name,)).design(sightings) * scale)
            columns.append(AirGradient(stations=(name,)).design(sightings) * self.gradient_k_per_m)
        return np.concatenate(columns, axis=2)

    def variance(self, sightings: Sightings) -> Floats:
        """Variance (n, 3) that turbulence adds to the readings."""
        size = np.array([self.turbulence_um2_per_m3 * MICROMETRE**2, 0.0])
        return Turbulence().variance(sightings, np.zeros((len(sightings), 3)), size)

    def across(self, range_: float) -> float:
        """Standard deviation [m] across the beam at a range [m]."""
        bent = 0.5 * bending() * self.gradient_k_per_m * range_**2
        return float(np.hypot(bent, np.sqrt(self.turbulence_um2_per_m3 * range_**3) * MICROMETRE))

    def along(self, range_: float) -> float:
        """Standard deviation [m] along the beam at a range [m]."""
        return bending() * self.temperature_k * range_

    def words(self, longest: float) -> str:
        """The numbers, and what they make at the longest range [m]."""
        return (
            f"air: {self.temperature_k:g} K along the beams of a station, a vertical gradient of "
            f"{self.gradient_k_per_m:g} K/m and turbulence of {self.turbulence_um2_per_m3:g} um2/m3 (one sigma each), "
            f"at {longest:.0f} m {self.along(longest) / MICROMETRE:.0f} um along and "
            f"{self.across(longest) / MICROMETRE:.0f} um across the beam"
        )
