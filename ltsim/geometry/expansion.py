"""Growth of a body with its temperature: L(T) = L_0 (1 + a (T - T_0)), and what is not known of it.

a is the mean coefficient of linear expansion between T_0 and T, both temperatures those of the body and not of the air.
To first order the factor errs by (T - T_0) da + a dT. Bodies of one material share da, those at one thermometer dT.

References
----------
Sensors 2021, 21, 7479, eq. 15, which lacks the length. JCGM 100:2008, H.1 (both errors of an end gauge).
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Expansion:
    """Thermal expansion of a body relative to its length at the reference temperature."""

    factor: float = 1.0
    """1 + a (T - T_0)."""
    by_coefficient: float = 0.0
    by_temperature: float = 0.0
    """Change of the factor when the coefficient, or the temperature, is one standard deviation larger."""

    @classmethod
    def of(
        cls,
        coefficient: float,
        kelvin: float,
        sigma_coefficient: float | None = None,
        sigma_kelvin: float | None = None,
    ) -> Expansion:
        """Expansion of a body `kelvin` above its reference temperature, with `coefficient` [1/K]; no sigma: exact."""
        return cls(1.0 + coefficient * kelvin, kelvin * (sigma_coefficient or 0.0), coefficient * (sigma_kelvin or 0.0))
