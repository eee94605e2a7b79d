"""Thermal expansion of a body, L(T) = L_0 (1 + a (T - T_0)), and its uncertainty.

L is the length of the body at its temperature T, and L_0 its length at its reference temperature T_0. The coefficient a
is the mean coefficient of linear expansion between T_0 and T. To first order the error of the ratio L(T) / L_0 is
(T - T_0) da + a dT, with the error da of the coefficient and the error dT of T - T_0. Bodies of one material share da.
Bodies whose temperature is measured by one thermometer share dT.

References
----------
Sensors 2021, 21, 7479, eq. 15, which lacks the length. JCGM 100:2008, H.1 (both errors of an end gauge).
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ThermalExpansion:
    """Length of a body divided by its length at the reference temperature, and the uncertainty of this ratio."""

    length_ratio: float = 1.0
    """Length of the body at its present temperature, divided by its length at the reference temperature."""
    ratio_change_per_coefficient_sigma: float = 0.0
    """Change of the length ratio if the coefficient of expansion is in error by one standard deviation."""
    ratio_change_per_temperature_sigma: float = 0.0
    """Change of the length ratio if the temperature of the body is in error by one standard deviation."""

    @classmethod
    def from_temperature_difference(
        cls,
        coefficient_per_k: float,
        temperature_difference: float,
        sigma_coefficient: float | None = None,
        sigma_temperature: float | None = None,
    ) -> ThermalExpansion:
        """Expansion of a body that is warmer than its reference temperature by `temperature_difference` [K].

        `coefficient_per_k` is the coefficient of linear expansion [1/K]. `sigma_coefficient` [1/K] and
        `sigma_temperature` [K] are the standard deviations of the coefficient and of the temperature difference; None
        counts as zero.
        """
        return cls(
            1.0 + coefficient_per_k * temperature_difference,
            temperature_difference * (sigma_coefficient or 0.0),
            coefficient_per_k * (sigma_temperature or 0.0),
        )
