"""Units at the edges. Inside, every float is SI: metre, radian, second, kelvin difference.

A parameter declares the unit a person reads it in; `FACTOR[unit]` is that unit in SI, so
``shown = value / FACTOR[unit]``.
"""

from __future__ import annotations

import math
import re
from types import MappingProxyType

MICROMETRE = 1e-6
MILLIMETRE = 1e-3
MICRORADIAN = 1e-6
ARCSECOND = math.pi / 648_000
DEGREE = math.pi / 180
GON = math.pi / 200
PPM = 1e-6

FACTOR = MappingProxyType(
    {
        "um": MICROMETRE,
        "mm": MILLIMETRE,
        "m": 1.0,
        "urad": MICRORADIAN,
        "mrad": 1e-3,
        "arcsec": ARCSECOND,
        "deg": DEGREE,
        "gon": GON,
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

ALIKE = (
    frozenset({"um", "mm", "m"}),
    frozenset({"urad", "mrad", "arcsec", "deg", "gon", "rad"}),
    frozenset({"ms", "s", "min", "h"}),
    frozenset({"um/m", "ppm"}),
)
"""Units of one kind, which can be converted."""
BY_ENDING = MappingProxyType(
    {
        "_c_per_h": "°C/h", "_per_k": "1/K", "_mm": "mm", "_um": "um", "_deg": "deg", "_arcsec": "arcsec",
        "_ppm": "ppm", "_c": "°C", "_hpa": "hPa", "_pct": "%", "_percent": "%", "_s": "s", "_h": "h",
    }
)  # fmt: skip
"""Units by the ending of a key."""
BY_BEGINNING = MappingProxyType({"seconds": "s", "minutes": "min", "hours": "h"})
"""Units by a word at the beginning of a key."""
_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\d\s]\S*)\s*")


def unit_of_key(key: str) -> str:
    """The unit that a key carries in its name; empty where it carries none."""
    for ending, name in BY_ENDING.items():
        if key.endswith(ending):
            return name
    return BY_BEGINNING.get(key.partition("_")[0], "")


def in_unit(text: str, unit: str) -> float | None:
    """A number with its unit, such as ``2 urad``, in another unit of the same kind; None where it is none."""
    found = _QUANTITY.fullmatch(text)
    if found is None:
        return None
    value, own = float(found[1]), found[2].replace("µ", "u").replace('"', "arcsec")
    if own == unit:
        return value
    if not any({own, unit} <= kind for kind in ALIKE):
        return None
    return float(f"{value * FACTOR[own] / FACTOR[unit]:.15g}")
