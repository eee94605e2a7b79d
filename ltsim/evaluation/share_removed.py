"""What only a simulation knows: the error against the truth, and which share of what could be corrected was.

The error of a recording has a part that no parameters remove (noise, effects outside the model) and a part that the
true parameters would remove, the correctable one. In mean squares they add, so the share of a method is
(R - C) / (R - P) of the mean squares of raw, calibrated and perfectly corrected readings, over all trials together: 1
for a calibrator that found the truth, 0 for one that did nothing, negative for one that did harm.
"""

from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Floats
from ltsim.evaluation.clouds import on_points, station_means
from ltsim.recording.recording import Recording


@dataclass(frozen=True)
class ShareRemoved:
    """Root-mean-square errors against the truth [m]."""

    raw: float
    calibrated: float
    true_parameters: float

    @property
    def share(self) -> float:
        """Share of the correctable mean square that was removed."""
        return share(self.raw, self.calibrated, self.true_parameters)


def share(raw: Floats | float, calibrated: Floats | float, true_parameters: Floats | float) -> float:
    """Share of the correctable mean square that was removed, of the errors (N,) of N trials; NaN: nothing was."""
    squares = (float(np.nanmean(np.square(error))) for error in (raw, calibrated, true_parameters))
    before, after, perfect = squares
    return (before - after) / (before - perfect) if before > perfect else float("nan")


def cloud_error(recording: Recording, points: Floats, true_points: Floats) -> float:
    """Rms [m] over stations and targets of the distance to the truth, after a rigid fit of each station.

    `points` (n, 3) [m] are in the instruments' frames. A pose is never known: an error that it absorbs whole (azimuth
    index, station height) is none to a user.
    """
    clouds = station_means(recording, points)
    gap = np.stack([on_points(cloud, true_points) - true_points for cloud in clouds])
    return float(np.sqrt(np.nanmean(np.sum(gap**2, axis=2))))
