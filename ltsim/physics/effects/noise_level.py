import numpy as np

from ltsim.core.arrays import Floats
from ltsim.physics.effects.effect import LightPathStage, NoiseEffect, Parameter
from ltsim.scene.sightings import Sightings

MIN_VARIANCE_FACTOR = 0.01
"""Smallest permitted factor on a variance."""


class NoiseLevel(NoiseEffect):
    """Noise level: all readings of a kind have a larger or smaller standard deviation than declared.

    variance = sigma^2 (1 + v), v the variance added over the stated one, for each observable. Negative: less noise.

    Size: v between -0.5 and 3.
    Like: turbulence (grows with the range), many small effects at once.
    Separate by: repeats: pointings of one target from one station show the noise without any model.
    Valid: factors on the variance from 0.1 up.
    Source: Teunissen 2000, Testing Theory: an introduction (weights come before tests).
    Status: validated: zero gives the stated variance.
    """

    name = "noise-level"
    min_relative_size = -0.95
    stage = LightPathStage.NOISE
    parameters = (
        Parameter("noise-distance", "", "variance added to the ranges, divided by the declared variance", 1.0),
        Parameter("noise-azimuth", "", "variance added to the azimuths, divided by the declared variance", 1.0),
        Parameter("noise-elevation", "", "variance added to the elevations, divided by the declared variance", 1.0),
    )

    def variance(self, sightings: Sightings, sigma: Floats, values: Floats) -> Floats:
        factor = 1.0 + self.row_weights(sightings)[:, None] * values
        return sigma**2 * np.maximum(factor, MIN_VARIANCE_FACTOR)
