"""Display step of an instrument: the largest usual step of which all its readings are multiples.

The noise that is assumed for a total station is not smaller than this step, because an instrument displays only
significant digits. The step is determined from the values. The number of digits in the file can be larger, for example
for angles in degrees, minutes and seconds and for lengths converted from feet.
"""

from collections.abc import Sequence

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import ARCSECOND, DEGREE, GON, MILLIMETRE, SI_PER_UNIT
from ltsim.recordings.setup import Instrument
from ltsim.recordings.specification import ASSUMED_TOTAL_STATION, ASSUMED_TOTAL_STATION_NOISE_NOTE

ANGLE_DISPLAY_STEPS = tuple(
    sorted(
        (
            *(step * ARCSECOND for step in (60.0, 30.0, 20.0, 10.0, 5.0, 2.0, 1.0)),
            *(step * unit for unit in (DEGREE, GON) for step in (1e-2, 5e-3, 2e-3, 1e-3, 5e-4)),
        ),
        reverse=True,
    )
)
"""Usual display steps [rad] of angles, the largest first; smaller steps are negligible compared with the assumed noise.
"""
FOOT_DISPLAY_STEPS = tuple(step * SI_PER_UNIT["ft"] for step in (0.1, 0.05, 0.01, 0.005, 0.001))
"""Usual display steps [m] of distances in feet, the largest first."""
LENGTH_DISPLAY_STEPS = tuple(sorted((*FOOT_DISPLAY_STEPS, 0.1, 0.05, 0.01, 0.005, 0.001), reverse=True))
"""Usual display steps [m] of distances in metres or feet, the largest first."""
MAX_DEVIATION_FROM_STEP_MULTIPLE = 1e-4
"""Largest deviation of a reading from a multiple of a step, divided by the step, that rounding of 15 digits can
explain."""
MIN_READINGS_FOR_DISPLAY_STEP = 10
"""Smallest number of different readings in the determination of a display step; fewer may be multiples of it by chance.
"""


def display_step_of_readings(readings: Floats, steps: Sequence[float]) -> float:
    """Largest of `steps` of which all finite values among n `readings` (n,) are multiples; 0 if there is none.

    `steps` are in descending order and have the unit of the readings.
    """
    readings = readings[np.isfinite(readings)]
    if len(np.unique(readings)) < MIN_READINGS_FOR_DISPLAY_STEP:
        return 0.0
    ratios = (readings / step for step in steps)
    matches = (bool(np.all(np.abs(ratio - np.round(ratio)) < MAX_DEVIATION_FROM_STEP_MULTIPLE)) for ratio in ratios)
    return next((step for step, is_match in zip(steps, matches, strict=True) if is_match), 0.0)


def total_station_with_assumed_noise(readings: Floats, reason: str) -> tuple[Instrument, str]:
    """Total station with assumed noise, at least the display steps of its readings, and a note that reports the noise.

    `readings` (n, 3) of n pointings are distance, azimuth, elevation [m, rad, rad]. `reason` is the part of the note
    that says why the file is attributed to a total station.
    """
    noise = ASSUMED_TOTAL_STATION.noise
    distance_mm = display_step_of_readings(readings[:, 0], LENGTH_DISPLAY_STEPS) / MILLIMETRE
    angle_arcsec = display_step_of_readings(readings[:, 1:].ravel(), ANGLE_DISPLAY_STEPS) / ARCSECOND
    noise = noise.model_copy(
        update={
            "distance_mm": max(noise.distance_mm, float(f"{distance_mm:.3g}")),
            "azimuth_arcsec": max(noise.azimuth_arcsec, float(f"{angle_arcsec:.3g}")),
            "elevation_arcsec": max(noise.elevation_arcsec, float(f"{angle_arcsec:.3g}")),
        }
    )
    text = ASSUMED_TOTAL_STATION_NOISE_NOTE.format(
        distance=noise.distance_mm, ppm=noise.distance_ppm, angle=noise.azimuth_arcsec, reason=reason
    )
    return ASSUMED_TOTAL_STATION.model_copy(update={"noise": noise}), text
