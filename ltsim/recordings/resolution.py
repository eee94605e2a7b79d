"""Resolution of the readings of a file: the largest usual step of which all values are multiples.

A total station shows about as many digits as it measures, so its default noise is no smaller than the step of its
readings. The values decide and not the digits of the file: degrees, minutes and seconds, and lengths that were
converted from feet, have digits beyond their step.
"""

from collections.abc import Sequence

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import ARCSECOND, DEGREE, GON, MILLIMETRE, SI_PER_UNIT
from ltsim.recordings.setup import Instrument
from ltsim.recordings.specification import TOTAL_STATION, TOTAL_STATION_NOTE

ANGLE_STEPS = tuple(
    sorted(
        (
            *(step * ARCSECOND for step in (60.0, 30.0, 20.0, 10.0, 5.0, 2.0, 1.0)),
            *(step * unit for unit in (DEGREE, GON) for step in (1e-2, 5e-3, 2e-3, 1e-3, 5e-4)),
        ),
        reverse=True,
    )
)
"""Steps [rad] of the displays of theodolites, the largest first; 1 arcsec and less is the noise of the default."""
FOOT_STEPS = tuple(step * SI_PER_UNIT["ft"] for step in (0.1, 0.05, 0.01, 0.005, 0.001))
"""Steps [m] of the displays of distance meters in feet, the largest first."""
LENGTH_STEPS = tuple(sorted((*FOOT_STEPS, 0.1, 0.05, 0.01, 0.005, 0.001), reverse=True))
"""Steps [m] of the displays of distance meters in metres and in feet, the largest first."""
MAX_STEP_DEVIATION = 1e-4
"""Largest difference of a value from a multiple of a step, in steps: rounding of numbers with 15 digits."""
MIN_VALUES_FOR_STEP = 10
"""Smallest number of different values that show a step: fewer may all be multiples by chance."""


def reading_step(readings: Floats, steps: Sequence[float]) -> float:
    """Largest of descending `steps` of which all finite values of `readings` (n,) are multiples; 0 without one."""
    readings = readings[np.isfinite(readings)]
    if len(np.unique(readings)) < MIN_VALUES_FOR_STEP:
        return 0.0
    ratios = (readings / step for step in steps)
    matches = (bool(np.all(np.abs(ratio - np.round(ratio)) < MAX_STEP_DEVIATION)) for ratio in ratios)
    return next((step for step, is_match in zip(steps, matches, strict=True) if is_match), 0.0)


def default_total_station(readings: Floats, reason: str) -> tuple[Instrument, str]:
    """Default total station, with a noise no smaller than the steps of its readings (n, 3) [m, rad], and its note."""
    noise = TOTAL_STATION.noise
    distance_mm = reading_step(readings[:, 0], LENGTH_STEPS) / MILLIMETRE
    angle_arcsec = reading_step(readings[:, 1:].ravel(), ANGLE_STEPS) / ARCSECOND
    noise = noise.model_copy(
        update={
            "distance_mm": max(noise.distance_mm, float(f"{distance_mm:.3g}")),
            "azimuth_arcsec": max(noise.azimuth_arcsec, float(f"{angle_arcsec:.3g}")),
            "elevation_arcsec": max(noise.elevation_arcsec, float(f"{angle_arcsec:.3g}")),
        }
    )
    text = TOTAL_STATION_NOTE.format(
        distance=noise.distance_mm, ppm=noise.distance_ppm, angle=noise.azimuth_arcsec, reason=reason
    )
    return TOTAL_STATION.model_copy(update={"noise": noise}), text
