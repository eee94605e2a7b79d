"""Slips of the pen: readings in another unit, counted another way, or of the other face.

One table for all who meet them: readers that refuse a file, the effect that simulates a slip, the diagnosis that mends
a station or a single pointing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Floats
from ltsim.units import FACTOR


@dataclass(frozen=True)
class Slip:
    """What is written down is factor * reading + offset in some columns."""

    name: str
    found: str
    expected: str
    """What stands in the column, and what should."""
    changes: tuple[tuple[int, float, float], ...]
    """Column (0 range, 1 azimuth, 2 elevation), factor, and offset [rad]."""

    @property
    def columns(self) -> tuple[int, ...]:
        """The columns that are wrong."""
        return tuple(column for column, _, _ in self.changes)

    @property
    def cause(self) -> str:
        """The slip in words: metres for millimetres."""
        return f"{self.found} for {self.expected}"

    def written(self, readings: Floats) -> Floats:
        """What is written down (n, 3) of raw readings (n, 3)."""
        other = readings.copy()
        for column, factor, offset in self.changes:
            other[:, column] = factor * readings[:, column] + offset
        return other

    def mended(self, readings: Floats) -> Floats:
        """The raw readings (n, 3) of which `readings` were written down."""
        other = readings.copy()
        for column, factor, offset in self.changes:
            other[:, column] = (readings[:, column] - offset) / factor
        return other


def _length(name: str, found: str, millimetres: float) -> Slip:
    return Slip(name, found, "millimetres", ((0, 1.0 / millimetres, 0.0),))


QUARTER = 0.5 * np.pi
GON, RADIAN = (FACTOR["deg"] / FACTOR[unit] for unit in ("gon", "rad"))

UNIT_SLIPS = (
    _length("inch", "inches", 25.4),
    _length("metre", "metres", 1e3),
    _length("micrometre", "micrometres", 1e-3),
    _length("centimetre", "centimetres", 10.0),
    _length("foot", "feet", 304.8),
    Slip("gon", "gon", "degrees", ((1, GON, 0.0), (2, GON, 0.0))),
    Slip("radian", "radians", "degrees", ((1, RADIAN, 0.0), (2, RADIAN, 0.0))),
    Slip("gon-azimuth", "gon", "degrees of the azimuth", ((1, GON, 0.0),)),
    Slip("gon-elevation", "gon", "degrees of the elevation", ((2, GON, 0.0),)),
    Slip("zenith", "zenith angles", "elevations", ((2, -1.0, QUARTER),)),
    Slip("zenith-gon", "zenith angles in gon", "elevations in degrees", ((1, GON, 0.0), (2, -GON, GON * QUARTER))),
    Slip("clockwise", "clockwise azimuths", "counter-clockwise ones", ((1, -1.0, 0.0),)),
)
"""Another unit, or another way to count; a reading becomes what is written in the wrong unit, read as the right one."""

FACE_SLIPS = (
    Slip("face-azimuth", "the azimuth of the other face", "that of its own", ((1, 1.0, np.pi),)),
    Slip("face-elevation", "the elevation of the other face", "that of its own", ((2, -1.0, np.pi),)),
)
"""One angle of the other face."""
