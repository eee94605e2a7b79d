"""Noise level."""

from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.effect import NoiseEffect, Parameter, Stage
from ltsim.scene.sightings import Sightings

LEAST = 0.01
"""Smallest factor on a variance."""
QUIETER = (-0.35, -0.6, -0.8)


@dataclass(frozen=True)
class NoiseLevel(NoiseEffect):
    """Noise level: all readings of a kind scatter more, or less, than the set-up states.

    variance = sigma^2 (1 + v), v the variance added over the stated one, for each observable. Negative: less noise.

    Size: v between -0.5 and 3.
    Like: turbulence (grows with the range), many small effects at once.
    Separate by: repeats: pointings of one target from one station show the noise without any model.
    Valid: factors on the variance from 0.1 up.
    Source: Teunissen 2000, Testing Theory: an introduction (weights come before tests).
    Status: validated: zero gives the stated variance.
    """

    name = "noise-level"
    least = -0.95
    stage = Stage.NOISE
    parameters = (
        Parameter("noise-distance", "", "variance added to the ranges over the stated", 1.0),
        Parameter("noise-azimuth", "", "variance added to the azimuths over the stated", 1.0),
        Parameter("noise-elevation", "", "variance added to the elevations over the stated", 1.0),
    )

    def size_grid(self) -> list[tuple[float, ...]]:
        """Sizes that a diagnosis tries: larger noise, and smaller where `least` allows it."""
        subsets = [*np.eye(3), np.array([0.0, 1.0, 1.0]), np.ones(3)]
        sizes = (*(size for size in QUIETER if size > self.least), 0.25, 0.6, 1.5, 4.0, 12.0)
        return [tuple(float(size * v) for v in subset) for subset in subsets for size in sizes]

    def variance(self, sightings: Sightings, sigma: Floats, values: Floats) -> Floats:
        """Variance (n, 3) of the readings."""
        factor = 1.0 + self.mask(sightings)[:, None] * values
        return sigma**2 * np.maximum(factor, LEAST)
