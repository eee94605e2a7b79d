"""Causes of a difference of scale: errors of temperature, and distances in another unit."""

from ltsim.core.notation import number_text
from ltsim.core.units import PPM
from ltsim.physics.effects.rays import relative_index_decrease_per_kelvin

STEEL_EXPANSION_PER_KELVIN = 11.5 * PPM
"""Coefficient of thermal expansion [1/K] of gauge steel, by ISO 3650:1998, section 6.3: (11.5 +- 1.0) ppm/K."""
MAX_TEMPERATURE_ERROR_K = 70.0
"""Largest error of a temperature [K] that is named as a cause: degrees Fahrenheit entered as degrees Celsius in a hall
at 45 degrees Celsius, 113 - 45 = 68 K."""
UNIT_TEXT_BY_FACTOR = {
    1.0 / 0.3048: "feet were recorded as metres",
    0.3048: "metres were recorded as feet",
    1.0 / 25.4: "inches were recorded as millimetres",
    25.4: "millimetres were recorded as inches",
    1.0 / 2.54: "inches were recorded as centimetres",
    2.54: "centimetres were recorded as inches",
    1e-3: "metres were recorded as millimetres",
    1e3: "millimetres were recorded as metres",
    0.1: "centimetres were recorded as millimetres",
    10.0: "millimetres were recorded as centimetres",
}
"""Text on a wrong unit of distances, by the factor of recorded to correct distances that the unit causes."""
MAX_RELATIVE_DIFFERENCE_FROM_UNIT_FACTOR = 1e-3
"""Largest relative difference between an estimated factor and that of a unit. It is larger than any scale error of an
instrument in a correct unit."""


def temperature_errors_text(scale: float, *, is_of_distances: bool = False, expansion_per_k: float = 0.0) -> str:
    """Text on the temperature errors that cause a relative difference `scale` of lengths and measured distances.

    With `is_of_distances` only the air is a possible cause, otherwise also the temperature of reference lengths. Their
    declared expansion is `expansion_per_k` [1/K], 0 for steel. Errors above `MAX_TEMPERATURE_ERROR_K` are not named.
    """
    difference = "scale error" if is_of_distances else "difference"
    air_error_k = abs(scale) / relative_index_decrease_per_kelvin()
    length_error_k = abs(scale / (expansion_per_k or STEEL_EXPANSION_PER_KELVIN))
    lengths_text = f"lengths with {expansion_per_k / PPM:g} ppm/K" if expansion_per_k else "steel lengths"
    causes = []
    if length_error_k < MAX_TEMPERATURE_ERROR_K and not is_of_distances:
        causes.append(f"a temperature of {lengths_text} that is wrong by {number_text(length_error_k, 2)} K")
    if air_error_k < MAX_TEMPERATURE_ERROR_K:
        causes.append(f"an air temperature that is wrong by {number_text(air_error_k, 2)} K")
    if not causes:
        return f"no error of a temperature causes such a {difference}"
    return f"{', or '.join(causes)}{',' * (len(causes) > 1)} causes such a {difference}"


def has_temperature_cause(scale: float) -> bool:
    """True if a temperature error of steel up to `MAX_TEMPERATURE_ERROR_K` causes the relative difference `scale`."""
    return abs(scale) < MAX_TEMPERATURE_ERROR_K * STEEL_EXPANSION_PER_KELVIN


def unit_error_text(scale: float) -> str:
    """Text on the unit that causes the relative error `scale` of all distances; empty if no unit has this factor."""
    factor = 1.0 + scale
    texts = (
        text
        for unit_factor, text in UNIT_TEXT_BY_FACTOR.items()
        if abs(factor / unit_factor - 1.0) < MAX_RELATIVE_DIFFERENCE_FROM_UNIT_FACTOR
    )
    return next(texts, "")
