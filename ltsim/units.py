"""Units at the edges. Inside, every float is SI: metre, radian, second, kelvin difference.

A parameter declares the unit a person reads it in; `FACTOR[unit]` is that unit in SI, so
``shown = value / FACTOR[unit]``.
"""

from __future__ import annotations

import math
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
