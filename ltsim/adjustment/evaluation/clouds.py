"""Points of each station in its instrument frame, alignment of stations to one frame, and errors of simulated points.

Errors are known in simulations only. A correction with the true instrument parameters removes one part of an error, the
correctable part; the other part remains (noise, unmodelled effects). Let R, C and P be the mean squared errors over all
trials of raw readings, of calibrated readings, and of readings corrected with the true parameters. A calibration
removes the fraction (R - C) / (R - P) of the correctable error. The fraction is 1 for a calibration with the true
parameters, 0 for a calibration without effect, and negative for a calibration that increases errors.
"""

from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.core.errors import NetworkError
from ltsim.geometry.polar import from_polar
from ltsim.geometry.rigid import align_rigidly
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.recordings.recording import Recording


def measured_points(
    recording: Recording, construction: GeometricErrorModel | None = None, parameter_values: Floats | None = None
) -> Floats:
    """Measured points in instrument frames, shape (pointings, 3) [m]; NaN for incomplete pointings.

    The points are corrected by the parameters `parameter_values` of the error model `construction`, (parameters,) or
    (pointings, parameters) [SI]; without it the points are not corrected.
    """
    is_complete = recording.is_measured.all(axis=1)
    points = np.full((len(recording), 3), np.nan)
    raw_readings = recording.readings[is_complete]
    if construction is None or parameter_values is None:
        points[is_complete] = from_polar(raw_readings)
    else:
        points[is_complete] = construction.points_from_readings(
            raw_readings, parameter_values if parameter_values.ndim == 1 else parameter_values[is_complete]
        )
    return points


def station_point_clouds(recording: Recording, points: Floats, row_mask: Bools | None = None) -> Floats:
    """Mean point of each target from each station, shape (stations, targets, 3) [m]; NaN for a target not measured.

    `points` (pointings, 3) are averaged over faces and repeats; `row_mask` selects pointings.
    """
    cloud_shape = (len(recording.stations), len(recording.targets))
    is_complete = np.isfinite(points).all(axis=1)
    if row_mask is not None:
        is_complete &= row_mask
    station_and_target = (recording.station[is_complete], recording.target[is_complete])
    total, count = np.zeros((*cloud_shape, 3)), np.zeros(cloud_shape)
    np.add.at(total, station_and_target, points[is_complete])
    np.add.at(count, station_and_target, 1.0)
    return np.where(count[:, :, None] > 0, total / np.maximum(count, 1.0)[:, :, None], np.nan)


def align_to_points(cloud: Floats, target_points: Floats) -> Floats:
    """Points `cloud` (targets, 3) [m] of a station after the best rigid fit to `target_points`, over common targets.

    NetworkError is raised unless at least three common targets are not on one line.
    """
    is_shared = np.isfinite(cloud[:, 0]) & np.isfinite(target_points[:, 0])
    rotation, translation = align_rigidly(cloud[is_shared], target_points[is_shared])
    return cloud @ rotation.T + translation


def align_to_first_station(clouds: Floats, names: tuple[str, ...]) -> Floats:
    """Points `clouds` (stations, targets, 3) [m] of all stations after a rigid fit to the frame of the first station.

    A station with fewer than three targets in common with the first station is fitted to the mean points of the
    stations fitted before. `names` are the stations. Raises NetworkError for a station that cannot be fitted.
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
    """Rms distances [m] of points from the true points: uncorrected, calibrated, corrected with the true parameters."""

    raw_rms: float
    """Rms error [m] of the uncorrected points."""
    calibrated_rms: float
    """Rms error [m] of the points corrected with the estimated parameters."""
    true_parameters_rms: float
    """Rms error [m] of the points corrected with the true parameters."""

    @property
    def removed_error_fraction(self) -> float:
        """Removed fraction (R - C) / (R - P) of mean squared errors: R raw, C calibrated, P with true parameters."""
        return removed_error_fraction(self.raw_rms, self.calibrated_rms, self.true_parameters_rms)


def removed_error_fraction(
    raw_errors: Floats | float, calibrated_errors: Floats | float, true_parameter_errors: Floats | float
) -> float:
    """Fraction of the correctable mean squared error that a calibration removed, over all trials together.

    The arguments are the rms errors [m] of each trial: of raw readings, of calibrated readings, and of readings
    corrected with the true parameters. The correctable error is the first mean square minus the third. The result is
    NaN if this difference is not positive.
    """
    squares = (float(np.nanmean(np.square(error))) for error in (raw_errors, calibrated_errors, true_parameter_errors))
    before, after, perfect = squares
    return (before - after) / (before - perfect) if before > perfect else float("nan")


def cloud_error(recording: Recording, points: Floats, true_points: Floats) -> float:
    """Rms distance [m] of points from the true points over stations and targets, after a rigid fit of each station.

    `points` (pointings, 3) [m] are in instrument frames, `true_points` (targets, 3) [m] in the network frame. The fit
    removes errors that a pose absorbs completely (azimuth index, height of the station).
    """
    clouds = station_point_clouds(recording, points)
    gap = np.stack([align_to_points(cloud, true_points) - true_points for cloud in clouds])
    return float(np.sqrt(np.nanmean(np.sum(gap**2, axis=2))))
