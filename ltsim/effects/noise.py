"""White noise: the standard deviations that an instrument's maker states.

sigma of a range = constant + ppm * range; of the angles a constant across the beam, so that the azimuth's is
divided by cos(elevation). Source: recording-format ltsim-recording/1; the same rule as `Recording.sigma`.
"""

from collections.abc import Sequence

import numpy as np

from ltsim.arrays import Floats
from ltsim.recording.setup import Noise
from ltsim.scene.sightings import Sightings
from ltsim.units import ARCSECOND, MILLIMETRE, PPM

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
