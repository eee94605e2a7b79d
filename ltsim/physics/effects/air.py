"""Errors of readings from unmeasured properties of the air along the beams, for uncertainty budgets of long ranges.

There are three causes, each an effect of the catalogue:

* The temperature along the beam differs from the measured one (`station-weather`). A range changes by 0.95 ppm/K.
* The temperature has a vertical gradient G (`air-gradient`). At the range d it displaces the measured point across the
  beam by beta G d^2 / 2; beta is the decrease of the refractive index per kelvin.
* The air is turbulent (`turbulence`). The variance of a point across the beam is C d^3 with a constant C.

With the default values of `AirUncertainty`, a point at 10 m has the standard deviations 5 um along and 11 um across the
beam. At 40 m they are 19 um and 110 um. The value across the beam at 40 m is below the limits of manufacturers (15 um +
6 um/m).
"""

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICROMETRE
from ltsim.physics.effects.air_gradient import AirGradient
from ltsim.physics.effects.rays import relative_index_decrease_per_kelvin
from ltsim.physics.effects.station_weather import StationWeather
from ltsim.physics.effects.turbulence import Turbulence
from ltsim.recordings.air import AirUncertainty
from ltsim.scene.sightings import Sightings


def reading_changes_per_air_sigma(air: AirUncertainty, sightings: Sightings) -> Floats:
    """Change (n, 3, 2) [m, rad, rad] of the readings of n pointings by one standard deviation of the air's properties.

    The last axis has two elements: the temperature along the beam, and the vertical temperature gradient.
    """
    weather = StationWeather().design(sightings) * (relative_index_decrease_per_kelvin() * air.temperature_k)
    return np.concatenate([weather, AirGradient().design(sightings) * air.gradient_k_per_m], axis=2)


def turbulence_variance(air: AirUncertainty, sightings: Sightings) -> Floats:
    """Variance (n, 3) [m2, rad2, rad2] of range, azimuth and elevation in n pointings due to turbulence of the air."""
    parameter_values = np.array([air.turbulence_um2_per_m3 * MICROMETRE**2, 0.0])
    return Turbulence().variance(sightings, np.zeros((len(sightings), 3)), parameter_values)


def air_point_sigma_across_beam(air: AirUncertainty, range_: float) -> float:
    """Standard deviation [m] of a measured point across the beam due to errors of the air, at `range_` [m].

    It contains the uncertainty of the vertical temperature gradient and the turbulence.
    """
    bent = 0.5 * relative_index_decrease_per_kelvin() * air.gradient_k_per_m * range_**2
    return float(np.hypot(bent, np.sqrt(air.turbulence_um2_per_m3 * range_**3) * MICROMETRE))


def air_point_sigma_along_beam(air: AirUncertainty, range_: float) -> float:
    """Standard deviation [m] of a range of `range_` [m] due to the uncertainty of the air temperature."""
    return relative_index_decrease_per_kelvin() * air.temperature_k * range_


def air_uncertainty_text(air: AirUncertainty, max_range: float) -> str:
    """Text for users with the uncertainty of the air, and with the errors of a point at `max_range` [m] that follow."""
    return (
        f"errors of the air (one sigma: {air.temperature_k:g} K along the beams of a station, a vertical gradient of "
        f"{air.gradient_k_per_m:g} K/m and turbulence of {air.turbulence_um2_per_m3:g} um2/m3; "
        f"at {max_range:.0f} m {air_point_sigma_along_beam(air, max_range) / MICROMETRE:.0f} um along and "
        f"{air_point_sigma_across_beam(air, max_range) / MICROMETRE:.0f} um across the beam)"
    )
