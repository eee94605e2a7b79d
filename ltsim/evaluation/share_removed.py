"""What only a simulation knows: the error against the truth, and which share of what could be corrected was.

The error of a recording has a part that no parameters remove (noise, effects outside the model) and a part that the
true parameters would remove, the correctable one. In mean squares they add, so the share of a method is
(R - C) / (R - P) of the mean squares of raw, calibrated and perfectly corrected readings, over all trials together: 1
for a calibrator that found the truth, 0 for one that did nothing, negative for one that did harm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Floats
from ltsim.evaluation.clouds import measured_points, on_points, station_means
from ltsim.model.construction import Construction
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


def share_removed(
    recording: Recording,
    true_points: Floats,
    construction: Construction,
    *,
    calibrated: Floats,
    true_parameters: Floats,
) -> ShareRemoved:
    """Errors of what the stations measured, raw, calibrated, and with the true parameters.

    Each station's targets are fitted rigidly to the true ones first, since a pose is never known: an error
    that a pose absorbs whole (azimuth index, station height) is none to a user.

    Parameters
    ----------
    recording : Recording
    true_points : (T, 3) float, [m]
        In the order of ``recording.targets``.
    construction : Construction
        That both parameter vectors belong to.
    calibrated, true_parameters : (p,) or (n, p) float [SI]
    """

    def error(values: Floats | None) -> float:
        return cloud_error(recording, measured_points(recording, construction, values), true_points)

    return ShareRemoved(error(None), error(calibrated), error(true_parameters))


def cloud_error(recording: Recording, points: Floats, true_points: Floats) -> float:
    """Rms [m] over stations and targets of the distance to the truth, after a rigid fit of each station.

    `points` (n, 3) [m] are in the instruments' frames.
    """
    clouds = station_means(recording, points)
    gap = np.stack([on_points(cloud, true_points) - true_points for cloud in clouds])
    return float(np.sqrt(np.nanmean(np.sum(gap**2, axis=2))))


def target_error(points: Floats, true_points: Floats) -> float:
    """Rms [m] over targets (T, 3) of the distance of adjusted targets to the truth, after one rigid fit."""
    gap = on_points(points, true_points) - true_points
    return float(np.sqrt(np.nanmean(np.sum(gap**2, axis=1))))
