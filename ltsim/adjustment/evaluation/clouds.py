"""Targets of each station in its own frame, alignment of stations to one frame, errors relative to the truth.

The truth is known in simulations only. The error of a recording has a part that no parameters remove (noise, unmodelled
effects) and a correctable part that the true parameters would remove. Their mean squares add, so that the share of a
method is (R - C) / (R - P) of the mean squares of raw, calibrated and perfectly corrected readings, over all trials
together: 1 for a calibrator with the true parameters, 0 for one without effect, negative for one that increases errors.
"""

from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.core.errors import NetworkError
from ltsim.geometry.alignment import align_rigidly
from ltsim.geometry.polar import from_polar
from ltsim.physics.model.construction import Construction
from ltsim.recordings.recording import Recording


def measured_points(
    recording: Recording, construction: Construction | None = None, values: Floats | None = None
) -> Floats:
    """Measured points (n, 3) [m] in the instruments' frames; NaN for incomplete pointings.

    They are corrected by a construction's parameters (p,), or (n, p) where instruments differ [SI]; by default raw.
    """
    is_complete = recording.is_measured.all(axis=1)
    points = np.full((len(recording), 3), np.nan)
    raw_readings = recording.readings[is_complete]
    if construction is None or values is None:
        points[is_complete] = from_polar(raw_readings)
    else:
        points[is_complete] = construction.point(raw_readings, values if values.ndim == 1 else values[is_complete])
    return points


def station_point_clouds(recording: Recording, points: Floats, row_mask: Bools | None = None) -> Floats:
    """Mean (S, T, 3), over faces and repeats, of the points (n, 3) of each station and target; NaN for none."""
    size = (len(recording.stations), len(recording.targets))
    is_complete = np.isfinite(points).all(axis=1)
    if row_mask is not None:
        is_complete &= row_mask
    at = (recording.station[is_complete], recording.target[is_complete])
    total, count = np.zeros((*size, 3)), np.zeros(size)
    np.add.at(total, at, points[is_complete])
    np.add.at(count, at, 1.0)
    return np.where(count[:, :, None] > 0, total / np.maximum(count, 1.0)[:, :, None], np.nan)


def align_to_points(cloud: Floats, target_points: Floats) -> Floats:
    """Cloud (T, 3) aligned rigidly to `target_points` (T, 3) by least squares over common targets.

    Raises NetworkError for fewer than three common targets that are not collinear.
    """
    is_shared = np.isfinite(cloud[:, 0]) & np.isfinite(target_points[:, 0])
    rotation, translation = align_rigidly(cloud[is_shared], target_points[is_shared])
    return cloud @ rotation.T + translation


def align_to_first_station(clouds: Floats, names: tuple[str, ...]) -> Floats:
    """Clouds (S, T, 3), each aligned rigidly to the first station's frame.

    A station with fewer than three targets in common with the first is aligned to the mean of those aligned before; in
    the paper all stations see all targets. Raises NetworkError with the name of a station that cannot be aligned.
    """
    placed_points = np.full_like(clouds, np.nan)
    placed_points[0] = clouds[0]
    is_measured = np.isfinite(clouds[:, :, 0])
    total, count = np.where(is_measured[0][:, None], clouds[0], 0.0), is_measured[0].astype(np.int64)
    direct, shared = is_measured @ is_measured[0].astype(np.int64), is_measured @ is_measured[0].astype(np.int64)
    is_unaligned = np.arange(len(clouds)) > 0
    while is_unaligned.any():
        station = int(np.argmax(np.where(is_unaligned, direct, -1)))
        goal = clouds[0]
        if direct[station] < 3:
            station = int(np.argmax(np.where(is_unaligned, shared, -1)))
            goal = np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], np.nan)
        is_unaligned[station] = False
        try:
            placed_points[station] = align_to_points(clouds[station], goal)
        except NetworkError as problem:
            message = f"station {names[station]} cannot be joined to the others: {problem}"
            raise NetworkError(message) from None
        new = is_measured[station] & (count == 0)
        shared += is_measured[:, new].sum(axis=1)
        total[is_measured[station]] += placed_points[station, is_measured[station]]
        count += is_measured[station]
    return placed_points


@dataclass(frozen=True)
class CalibrationErrors:
    """Root mean square errors relative to the truth [m]: raw, calibrated, with true parameters."""

    raw_rms: float
    calibrated_rms: float
    true_parameters_rms: float

    @property
    def share_removed(self) -> float:
        """Fraction of the correctable mean square that was removed."""
        return share(self.raw_rms, self.calibrated_rms, self.true_parameters_rms)


def share(raw_errors: Floats | float, calibrated_errors: Floats | float, true_parameters: Floats | float) -> float:
    """Fraction of the correctable mean square that was removed, from the errors (N,) of N trials.

    It is NaN if nothing is correctable.
    """
    squares = (float(np.nanmean(np.square(error))) for error in (raw_errors, calibrated_errors, true_parameters))
    before, after, perfect = squares
    return (before - after) / (before - perfect) if before > perfect else float("nan")


def cloud_error(recording: Recording, points: Floats, true_points: Floats) -> float:
    """Rms distance [m] to the truth over stations and targets, after a rigid fit of each station.

    `points` (n, 3) [m] are in the instruments' frames. Poses are unknown to users: an error that the pose absorbs
    completely (azimuth index, station height) is not counted.
    """
    clouds = station_point_clouds(recording, points)
    gap = np.stack([align_to_points(cloud, true_points) - true_points for cloud in clouds])
    return float(np.sqrt(np.nanmean(np.sum(gap**2, axis=2))))
