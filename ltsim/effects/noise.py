"""Noise and resolution as an instrument's maker states them."""

from collections.abc import Sequence

import numpy as np

from ltsim.arrays import Floats
from ltsim.recording.recording import noise_sigma
from ltsim.recording.setup import Noise
from ltsim.scene.sightings import Sightings

PAPER_ANGLE_ARCSEC = 0.018
PAPER_DISTANCE_UM = 0.1
"""Steps of the encoders and of the range (Sensors 2021, 21, 7479, section 2.1.1)."""


def white_noise_sigma(sightings: Sightings, noise: Sequence[Noise]) -> Floats:
    """Standard deviation (n, 3) [m, rad, rad] of every pointing's readings; `noise` is that of each instrument."""
    return noise_sigma(noise, sightings.instrument, sightings.range_, sightings.elevation)


def quantised(readings: Floats, step: Floats) -> Floats:
    """Readings (n, 3) rounded to whole steps (3,) or (n, 3) [m, rad, rad]; a step of 0 leaves them."""
    step = np.broadcast_to(step, readings.shape)
    return np.where(step > 0.0, step * np.round(readings / np.where(step > 0.0, step, 1.0)), readings)
