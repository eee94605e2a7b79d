"""Wrong unit (40): the readings of a station are in inches for millimetres, gon for degrees, or zeniths for elevations.

The reading becomes the reading times a factor, or its complement to a right angle.
Like: nothing; the pose fit misses by metres.
Separate by: nothing is needed.
Valid: the parameter is 1 where it happened and 0 elsewhere. A mistake of this size is mended before an adjustment, so
`candidates` is empty and `possible` lists the mistakes. Weather in a wrong unit is station-weather.
Source: physics.md entry 40.
Status: validated on the readings.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.effect import Effect, Parameter, Stage
from ltsim.scene.sightings import Sightings

Mistake = Literal["inch", "metre", "gon", "zenith"]
MISTAKES: dict[Mistake, tuple[tuple[int, ...], float]] = {
    "inch": ((0,), 1 / 25.4),
    "metre": ((0,), 1e-3),
    "gon": ((1, 2), 10 / 9),
    "zenith": ((2,), -1.0),
}
"""Columns that are wrong, and the factor on what is read."""
SEEN = ("distance", "azimuth", "elevation")


@dataclass(frozen=True)
class WrongUnit(Effect):
    """Readings of a station in another unit."""

    mistake: Mistake = "gon"

    name = "wrong-unit"
    number = 40
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

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 1) of the raw readings when the unit is wrong, exact."""
        columns, factor = MISTAKES[self.mistake]
        change = np.zeros((len(sightings), 3))
        for c in columns:
            change[:, c] = (factor - 1.0) * sightings.raw[:, c]
        if self.mistake == "zenith":
            change[:, 2] += np.pi / 2
        wrong: Floats = change * self.mask(sightings)[:, None]
        return wrong[:, :, None]
