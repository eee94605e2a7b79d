"""Wrong unit: the readings of a station are in other units, count another way, or hold zeniths for elevations.

The reading becomes the reading times a factor, or its complement to a right angle, or counts clockwise; the slips are
those of `recording.slips`.

Size: metres.
Like: nothing; the pose fit misses by metres.
Separate by: nothing is needed.
Valid: the parameter is 1 where it happened and 0 elsewhere. A mistake of this size is mended before an adjustment, so
`candidates` is empty and `possible` lists the mistakes. Weather in a wrong unit is station-weather.
Source: definitions of the units; BIPM, The International System of Units (SI Brochure).
Status: validated on the readings: what the mend gives back is what was read.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.effect import Mistake, Parameter, Stage
from ltsim.scene.sightings import Sightings

Slip = Literal["inch", "metre", "gon", "zenith"]
MISTAKES: dict[Slip, tuple[tuple[int, ...], float]] = {
    "inch": ((0,), 1 / 25.4),
    "metre": ((0,), 1e-3),
    "gon": ((1, 2), 10 / 9),
    "zenith": ((2,), -1.0),
}
"""Columns that are wrong, and the factor on what is read."""
SEEN = ("distance", "azimuth", "elevation")


@dataclass(frozen=True)
class WrongUnit(Mistake):
    """Readings of a station in another unit."""

    mistake: Slip = "gon"

    name = "wrong-unit"
    stage = Stage.ELECTRONICS
    scope = "station"
    parameters = (Parameter("mistaken", "", "1 where the unit is wrong", 1.0),)

    def __post_init__(self) -> None:
        object.__setattr__(self, "observables", tuple(SEEN[c] for c in MISTAKES[self.mistake][0]))

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """None: see the card."""
        return []

    @classmethod
    def possible(cls, sightings: Sightings) -> list[Self]:
        """Every mistake at every station."""
        return [cls((name,), mistake=mistake) for name in sightings.station_names for mistake in MISTAKES]

    def written(self, sightings: Sightings, readings: Floats) -> Floats:
        """The readings in the wrong unit."""
        columns, factor = MISTAKES[self.mistake]
        other = readings.copy()
        for c in columns:
            other[:, c] *= factor
        if self.mistake == "zenith":
            other[:, 2] += np.pi / 2
        return np.where(self.mask(sightings)[:, None] > 0, other, readings)

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 1) of the raw readings when the unit is wrong, exact."""
        return (self.written(sightings, sightings.raw) - sightings.raw)[:, :, None]
