import numpy as np

from ltsim.core.arrays import Floats
from ltsim.physics.effects.effect import LightPathStage, NoiseEffect, Parameter
from ltsim.scene.sightings import Sightings

MIN_VARIANCE_FACTOR = 0.01
"""Smallest factor on a variance that is used in place of smaller ones, so that no variance is zero or negative."""


class NoiseLevel(NoiseEffect):
    """Noise level: all readings of a kind have a larger or smaller standard deviation than declared.

    variance = sigma^2 (1 + v), with v the added variance divided by the declared one, for each observable. A negative v
    means less noise.

    Size: v between -0.5 and 3.
    Similar to: turbulence (grows with the range), many small effects at once.
    Separate by: repeated pointings of one target from one station, whose scatter is the noise.
    Validity: factors on the variance from 0.1 up.
    Source: Teunissen 2000, Testing Theory: an introduction (weights come before tests).
    Validation: validated: with v = 0 the variance is the declared one.
    """

    name = "noise-level"
    base_rate = 4.0
    """High relative frequency of this effect in practice (1 means occasional): declared standard deviations are mostly
    limits from a data sheet, which differ from the scatter of the readings in most recordings. The frequency is an
    expert judgement, as all prior probabilities of causes."""
    min_relative_size = -0.95
    light_path_stage = LightPathStage.NOISE
    parameters = (
        Parameter("noise-distance", "", "variance added to the ranges, divided by the declared variance", 1.0),
        Parameter("noise-azimuth", "", "variance added to the azimuths, divided by the declared variance", 1.0),
        Parameter("noise-elevation", "", "variance added to the elevations, divided by the declared variance", 1.0),
    )

    def variance(self, sightings: Sightings, sigma: Floats, parameter_values: Floats) -> Floats:
        factor = 1.0 + self.pointing_indicator(sightings)[:, None] * parameter_values
        return sigma**2 * np.maximum(factor, MIN_VARIANCE_FACTOR)
