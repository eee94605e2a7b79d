"""Phase refractive index of moist air by Ciddor's equation.

Source: Ciddor, Applied Optics 35 (1996) 1566. The vapour pressure and the compressibility follow the NIST Engineering
Metrology Toolbox (Stone and Zimmerman, NIST; Appendix A). The equation is valid from 300 to 1700 nm, from -40 to 100 C
and from 100 to 1400 hPa, with an uncertainty of 2e-8.
"""

from functools import lru_cache

import numpy as np

from ltsim.core.arrays import Floats

GAS_CONSTANT = 8.314472
"""Molar gas constant [J/(mol K)], as in Ciddor (1996)."""
WATER_MOLAR_MASS = 0.018015
"""Molar mass of water [kg/mol]."""
HELIUM_NEON_WAVELENGTH = 633e-9
"""Vacuum wavelength of the helium-neon laser [m]."""


def saturation_vapour_pressure(temperature: Floats) -> Floats:
    """Saturation vapour pressure [Pa] over water at the given temperatures [C] (IAPWS-IF97, region 4)."""
    kelvin = temperature + 273.15
    omega = kelvin - 2.38555575678e-1 / (kelvin - 6.50175348448e2)
    a = omega**2 + 1.16705214528e3 * omega - 7.24213167032e5
    b = -1.70738469401e1 * omega**2 + 1.20208247025e4 * omega - 3.23255503223e6
    c = 1.49151086135e1 * omega**2 - 4.82326573616e3 * omega + 4.05113405421e5
    return 1e6 * (2 * c / (-b + np.sqrt(b**2 - 4 * a * c))) ** 4


def _compressibility(temperature: Floats, pressure: float, water_mole_fraction: Floats) -> Floats:
    """Compressibility factor of moist air (1 for an ideal gas).

    It depends on temperature [C], pressure [Pa] and mole fraction of water vapour. Source: Ciddor 1996, appendix A.
    """
    kelvin = temperature + 273.15
    linear = 1.58123e-6 - 2.9331e-8 * temperature + 1.1043e-10 * temperature**2
    linear = (
        linear
        + (5.707e-6 - 2.051e-8 * temperature) * water_mole_fraction
        + (1.9898e-4 - 2.376e-6 * temperature) * water_mole_fraction**2
    )
    ratio = pressure / kelvin
    return 1.0 - ratio * linear + ratio**2 * (1.83e-11 - 0.765e-8 * water_mole_fraction**2)


def refractivity(
    temperature: Floats,
    *,
    pressure: float = 101_325.0,
    humidity: float = 50.0,
    wavelength: float = HELIUM_NEON_WAVELENGTH,
) -> Floats:
    """Refractivity: phase refractive index minus one, of air with 450 umol/mol of carbon dioxide.

    Parameters
    ----------
    temperature : float array, [C]
        Air temperature.
    pressure : float, [Pa]
        Air pressure.
    humidity : float, [%]
        Relative humidity.
    wavelength : float, [m]
        Wavelength in vacuum.
    """
    temperature = np.asarray(temperature, dtype=np.float64)
    wave = (1e-6 / wavelength) ** 2
    dry = 1e-8 * (5_792_105.0 / (238.0185 - wave) + 167_917.0 / (57.362 - wave))
    vapour = 1.022e-8 * (295.235 + 2.6422 * wave - 0.032380 * wave**2 + 0.004028 * wave**3)
    enhancement = 1.00062 + 3.14e-8 * pressure + 5.6e-7 * temperature**2
    share = humidity / 100.0 * enhancement * saturation_vapour_pressure(temperature) / pressure
    mass = 1e-3 * (28.9635 + 12.011e-6 * 50.0)

    def density(temperature: Floats, pressure: float, vapour_fraction: Floats) -> Floats:
        """Molar density [mol/m^3] at temperature [C], pressure [Pa] and mole fraction of water vapour."""
        return pressure / (
            _compressibility(temperature, pressure, vapour_fraction) * GAS_CONSTANT * (temperature + 273.15)
        )

    standard = density(np.array(15.0), 101_325.0, np.array(0.0)) * mass
    saturated = density(np.array(20.0), 1333.0, np.array(1.0)) * WATER_MOLAR_MASS
    air = density(temperature, pressure, share)
    return air * ((1.0 - share) * mass / standard * dry + share * WATER_MOLAR_MASS / saturated * vapour)


@lru_cache
def refractive_index_decrease_per_kelvin(temperature: float = 20.0) -> float:
    """Decrease beta = -dn/dT [1/K] of the refractive index n of air with the temperature T, at `temperature` [C].

    The derivative is a central difference at constant pressure and relative humidity (the default values of
    `refractivity`). The amount of water vapour therefore increases with the temperature.
    """
    warm, cold = (float(refractivity(np.array(temperature + d))) for d in (0.5, -0.5))
    return cold - warm
