"""Noise and resolution as an instrument's maker states them, and noise that is not what is stated.

sigma of a range = constant + ppm * range; of the angles a constant across the beam, so that the azimuth's is divided by
cos(elevation). Source: recording-format ltsim-recording/1; the same rule as `Recording.sigma`.
"""

from collections.abc import Sequence

import numpy as np

from ltsim.arrays import Floats
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
