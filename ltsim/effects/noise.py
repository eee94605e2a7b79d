"""Noise and resolution as an instrument's maker states them, and noise that is not what is stated.

sigma of a range = constant + ppm * range; of the angles a constant across the beam, so that the azimuth's is divided by
cos(elevation). Source: recording-format ltsim-recording/1; the same rule as `Recording.sigma`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.effect import NoiseEffect, Parameter, Stage
from ltsim.recording.setup import Noise
from ltsim.scene.sightings import Sightings
from ltsim.units import ARCSECOND, MILLIMETRE, PPM

PAPER_ANGLE_ARCSEC = 0.018
PAPER_DISTANCE_UM = 0.1
"""Steps of the encoders and of the range (Sensors 2021, 21, 7479, section 2.1.1)."""
LEAST_COSINE = 1e-6


def white_noise_sigma(sightings: Sightings, noise: Sequence[Noise]) -> Floats:
    """Standard deviation (n, 3) [m, rad, rad] of range, azimuth and elevation of every pointing.

    Parameters
    ----------
    sightings : Sightings
    noise : sequence of Noise
        One an instrument, in the order of `sightings.instrument`.
    """
    rows = [[m.distance_mm, m.distance_ppm, m.azimuth_arcsec, m.elevation_arcsec] for m in noise]
    units = np.array([MILLIMETRE, PPM, ARCSECOND, ARCSECOND])
    constant, per_metre, azimuth, elevation = (np.array(rows) * units)[sightings.instrument].T
    across = np.maximum(np.abs(np.cos(sightings.elevation)), LEAST_COSINE)
    return np.stack([constant + per_metre * sightings.range_, azimuth / across, elevation], axis=1)


def quantised(readings: Floats, step: Floats) -> Floats:
    """Readings (n, 3) rounded to whole steps (3,) or (n, 3) [m, rad, rad]; a step of 0 leaves them."""
    step = np.broadcast_to(step, readings.shape)
    return np.where(step > 0.0, step * np.round(readings / np.where(step > 0.0, step, 1.0)), readings)


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


@dataclass(frozen=True)
class StationNoise(NoiseLevel):
    """Noise of one station: an unsteady stand, a fan or the sun makes its readings scatter more than stated.

    variance = sigma^2 (1 + v) at that station.

    Size: v of 0.5 to 10.
    Like: noise-level (all stations), a target or station that moves often.
    Separate by: repeats at that station.
    Valid: white from pointing to pointing.
    Source: Teunissen 2000, Testing Theory: an introduction (weights come before tests).
    Status: validated: zero gives the stated variance, other stations keep theirs.
    """

    name = "station-noise"
    least = 0.0
    covariates = ("place",)
    scope = "station"
