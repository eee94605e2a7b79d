"""Units of input and output. Inside the program every number is in SI units: metre, radian, second, kelvin.

Each parameter declares the unit in which it is displayed: ``displayed = value / SI_PER_UNIT[unit]``.
"""

import functools
import math
import re
from decimal import Decimal
from types import MappingProxyType

MICROMETRE = 1e-6
"""Micrometre [m]."""
MILLIMETRE = 1e-3
"""Millimetre [m]."""
MICRORADIAN = 1e-6
"""Microradian [rad]."""
ARCSECOND = math.pi / 648_000
"""Arc second [rad]."""
DEGREE = math.pi / 180
"""Degree [rad]."""
GON = math.pi / 200
"""Gon [rad]."""
CENTESIMAL_SECOND = GON * 1e-4
"""Size [rad] of the unit cc, which is 1e-4 gon."""
QUARTER_TURN = 0.5 * math.pi
"""Quarter of a full turn [rad]."""
PPM = 1e-6
"""Part per million, as a number: 1e-6."""
EARTH_RADIUS = 6_371_000.0
"""Mean radius of the earth [m]."""

SI_PER_UNIT = MappingProxyType(
    {
        "um": MICROMETRE,
        "mm": MILLIMETRE,
        "cm": 0.01,
        "m": 1.0,
        "in": 0.0254,
        "ft": 0.3048,
        "usft": 1200 / 3937,
        "urad": MICRORADIAN,
        "mrad": 1e-3,
        "arcsec": ARCSECOND,
        "cc": CENTESIMAL_SECOND,
        "mgon": GON * 1e-3,
        "deg": DEGREE,
        "gon": GON,
        "mil": math.pi / 3200,
        "rad": 1.0,
        "ppm": PPM,
        "um/m": PPM,
        "ms": 1e-3,
        "s": 1.0,
        "min": 60.0,
        "h": 3600.0,
        "K": 1.0,
        "K/m": 1.0,
        "hPa": 1.0,
        "": 1.0,
        "um/h": MICROMETRE / 3600,
        "urad/h": MICRORADIAN / 3600,
        "ppm/h": PPM / 3600,
        "ppm/K": PPM,
        "um/K": MICROMETRE,
        "um2/m": MICROMETRE**2,
        "um2/m3": MICROMETRE**2,
    }
)
"""Size of each unit in SI units, by the name of the unit. Pressures remain in hPa."""

CONVERTIBLE_UNIT_GROUPS = (
    frozenset({"um", "mm", "cm", "m", "in", "ft", "usft"}),
    frozenset({"urad", "mrad", "arcsec", "cc", "mgon", "deg", "gon", "mil", "rad"}),
    frozenset({"ms", "s", "min", "h"}),
    frozenset({"um/m", "ppm"}),
)
"""Groups of units that can be converted into each other: lengths, angles, times, and ratios of lengths."""
_SPELLINGS_BY_UNIT = MappingProxyType(
    {
        "deg": "deg degree degrees ° grad° º", "gon": "gon gons grad grads g gr neugrad", "rad": "rad radian radians",
        "dms": "dms ddmmss d_m_s °_'_\" °'\" dd_mm_ss d.ms d.mmss dd.mmss ddd.mmss ddd.mmssss "
        "d_m_s.s dd_mm_ss.s ddd_mm_ss ddd_mm_ss.s d:m:s dd:mm:ss ddd:mm:ss d-m-s dd-mm-ss ddd-mm-ss dddmmss",
        "arcsec": "arcsec arcseconds ″", "cc": "cc", "mgon": "mgon",
        "urad": "urad µrad μrad", "mrad": "mrad", "mm": "mm millimeter millimeters millimetre millimetres",
        "m": "m meter meters metre metres", "in": "in inch inches zoll \"", "cm": "cm", "ft": "ft feet foot ift",
        "usft": "usft ftus us_ft us_survey_feet us_survey_foot", "mil": "mil mils",
        "um": "um µm μm micron microns", "s": "s sec second seconds sek", "ms": "ms", "min": "min", "h": "h hr hours",
        "c": "c °c degc", "hpa": "hpa mbar", "%": "% pct",
    }
)  # fmt: skip
"""Accepted spellings of each unit in lower case, separated by blanks; an underscore stands for a blank."""
UNIT_BY_SPELLING = MappingProxyType(
    {word.replace("_", " "): unit for unit, words in _SPELLINGS_BY_UNIT.items() for word in words.split()}
)
"""Unit by its spelling in lower case; `dms` means degrees, minutes and seconds in one cell."""
ANGLE_UNITS = ("deg", "gon", "rad", "dms", "mil")
"""Units of angles in files; `dms` means degrees, minutes and seconds in one cell."""
LENGTH_UNITS = ("mm", "m", "in", "cm", "ft", "usft", "um")
"""Units of lengths in files."""
SMALL_ANGLE_UNITS = ("arcsec", "cc", "mgon", "urad", "mrad", "deg", "gon", "rad")
"""Units of small angles in files, such as standard deviations."""
_PI = Decimal("3.14159265358979323846264338327950288")
"""Pi with 36 digits, for exact conversions of angles."""
_FULL_CIRCLE_BY_UNIT = MappingProxyType(
    {
        "deg": Decimal(360), "dms": Decimal(360), "gon": Decimal(400), "mil": Decimal(6400), "rad": 2 * _PI,
        "mrad": 2000 * _PI, "urad": 2_000_000 * _PI, "arcsec": Decimal(1_296_000), "cc": Decimal(4_000_000),
        "mgon": Decimal(400_000),
    }
)  # fmt: skip
"""Size of a full circle, by the unit of the angle."""
UNIT_BY_KEY_ENDING = MappingProxyType(
    {
        "_c_per_h": "°C/h", "_per_k": "1/K", "_mm": "mm", "_um": "um", "_deg": "deg", "_arcsec": "arcsec",
        "_ppm": "ppm", "_c": "°C", "_hpa": "hPa", "_pct": "%", "_percent": "%", "_s": "s", "_h": "h",
    }
)  # fmt: skip
"""Unit of a key by the ending of its name: `_mm` means millimetres."""
UNIT_BY_KEY_BEGINNING = MappingProxyType({"seconds": "s", "minutes": "min", "hours": "h"})
"""Unit of a key by the first word of its name: `seconds` means s."""
_QUANTITY_PATTERN = re.compile(r"\s*+([-+]?(?:\d++(?:\.\d*+)?+|\.\d++)(?:[eE][-+]?\d++)?+)\s*+([^\d\s]\S*+)\s*+")
"""Pattern of a number followed by a unit, such as ``2 urad``."""


@functools.cache
def permitted_units_text() -> str:
    """Text with all permitted units, for messages."""
    return f"{', '.join(filter(None, SI_PER_UNIT))}, or '' for a number without a unit"


def unit_ratio(numerator_unit: str, denominator_unit: str) -> Decimal:
    """Exact ratio of two units of the same quantity (angle, length or time): `numerator_unit` / `denominator_unit`."""
    if numerator_unit in _FULL_CIRCLE_BY_UNIT:
        return _FULL_CIRCLE_BY_UNIT[denominator_unit] / _FULL_CIRCLE_BY_UNIT[numerator_unit]
    return Decimal(repr(SI_PER_UNIT[numerator_unit])) / Decimal(repr(SI_PER_UNIT[denominator_unit]))


def unit_of_key(key_name: str) -> str:
    """Unit that the name of a key contains, such as `mm` for `x_mm`; empty text for a key without a unit."""
    for ending, name in UNIT_BY_KEY_ENDING.items():
        if key_name.endswith(ending):
            return name
    return UNIT_BY_KEY_BEGINNING.get(key_name.partition("_")[0], "")


def are_convertible_units(unit: str, other_unit: str) -> bool:
    """True if two units measure the same kind of quantity, for example two units of length."""
    return unit == other_unit or any({unit, other_unit} <= kind for kind in CONVERTIBLE_UNIT_GROUPS)


def parse_quantity_in_unit(text: str, unit: str) -> float | None:
    """Number in the unit `unit`, from a text with a number and a unit, such as ``2 urad``.

    The result is None if the text is not a number with a unit that can be converted into `unit`.
    """
    match = _QUANTITY_PATTERN.fullmatch(text)
    if match is None:
        return None
    value, given = float(match[1]), match[2].replace("µ", "u").replace('"', "arcsec")
    if given == unit:
        return value
    if not are_convertible_units(given, unit):
        return None
    return float(f"{value * SI_PER_UNIT[given] / SI_PER_UNIT[unit]:.15g}")
