"""Errors of temperature that explain a difference of scale, as a reason for users to check temperatures."""

from ltsim.core.notation import number_text
from ltsim.core.units import PPM
from ltsim.physics.effects.rays import relative_index_decrease_per_kelvin

STEEL_EXPANSION_PER_KELVIN = 11.5 * PPM
"""Coefficient of thermal expansion [1/K] of gauge steel, by ISO 3650:1998, section 6.3: (11.5 +- 1.0) ppm/K."""


def temperature_errors_text(scale: float, *, is_of_distances: bool = False) -> str:
    """Text on the temperature errors that cause a relative difference `scale` of lengths and measured distances.

    With `is_of_distances` only the air is a possible cause, otherwise also the temperature of reference lengths.
    """
    air = f"an air temperature that is wrong by {number_text(abs(scale) / relative_index_decrease_per_kelvin(), 2)} K"
    if is_of_distances:
        return f"{air} causes such a scale error"
    steel_error_k = abs(scale) / STEEL_EXPANSION_PER_KELVIN
    steel = f"a temperature of steel lengths that is wrong by {number_text(steel_error_k, 2)} K"
    return f"{steel}, or {air}, causes such a difference"
