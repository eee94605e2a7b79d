"""Point clouds of stations in their instrument frames, alignment of the clouds, and errors of points in simulations.

In simulations the errors of points are known. A correction with the true instrument parameters removes the correctable
part of an error; noise and unmodelled effects remain. Let R, C and P be the mean squared errors of points from raw
readings, from calibrated readings, and from readings corrected with the true parameters, over all trials. A calibration
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
    """Measured points (n, 3) [m] of n pointings in instrument frames; NaN for incomplete pointings.

    They are corrected with the values of the p parameters of the error model `construction`, `parameter_values` (p,) or
    (n, p) [SI]. Without a model or values the points are not corrected.
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
    """Mean points (S, T, 3) [m] of T targets measured from S stations; NaN if a station did not measure a target.

    `points` (n, 3) [m] of n pointings are averaged over faces and repeats; `row_mask` (n,) selects pointings.
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
    """Points (T, 3) [m] of a station, `cloud`, after the best rigid fit to `target_points` (T, 3) [m].

    The fit uses the targets without NaN in either array. Raises NetworkError if fewer than three are common, or if they
    lie on one line.
    """
    is_shared = np.isfinite(cloud[:, 0]) & np.isfinite(target_points[:, 0])
    rotation, translation = align_rigidly(cloud[is_shared], target_points[is_shared])
    return cloud @ rotation.T + translation


def align_to_first_station(clouds: Floats, names: tuple[str, ...]) -> Floats:
    """Points (S, T, 3) [m] of T targets from S stations, after a rigid fit of each cloud to the first station.

    `clouds` (S, T, 3) [m] are the points in instrument frames. A station with fewer than three targets in common with
    the first station is fitted to the mean points of the stations fitted before. `names` are the names of the stations.
    Raises NetworkError for a station that cannot be fitted.
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
            message = f"station {names[station]} cannot be aligned to the other stations: {problem}"
            raise NetworkError(message) from None
        new = is_measured[station] & (count == 0)
        shared += is_measured[:, new].sum(axis=1)
        total[is_measured[station]] += placed_points[station, is_measured[station]]
        count += is_measured[station]
    return placed_points


@dataclass(frozen=True)
class CalibrationErrors:
    """Rms errors [m] of points in a simulation: uncorrected, calibrated, and corrected with the true parameters."""

    raw_rms: float
    """Rms error [m] of the uncorrected points."""
    calibrated_rms: float
    """Rms error [m] of the points corrected with the estimated parameters."""
    true_parameters_rms: float
    """Rms error [m] of the points corrected with the true parameters."""

    @property
    def removed_error_fraction(self) -> float:
        """Fraction (R - C) / (R - P) of the correctable mean squared error that the calibration removed.

        R, C and P are the mean squared errors of raw points, calibrated points, and points corrected with the true
        parameters.
        """
        return removed_error_fraction(self.raw_rms, self.calibrated_rms, self.true_parameters_rms)


def removed_error_fraction(
    raw_errors: Floats | float, calibrated_errors: Floats | float, true_parameter_errors: Floats | float
) -> float:
    """Fraction of the correctable mean squared error that a calibration removed, over all trials together.

    The arguments are rms errors [m] of points in each trial of a simulation, in this order: uncorrected, calibrated,
    and corrected with the true parameters. The correctable error is the mean square of the first minus that of the
    third. The result is NaN if this difference is not positive.
    """
    squares = (float(np.nanmean(np.square(error))) for error in (raw_errors, calibrated_errors, true_parameter_errors))
    before, after, perfect = squares
    return (before - after) / (before - perfect) if before > perfect else float("nan")


def rms_point_error(recording: Recording, points: Floats, true_points: Floats) -> float:
    """Rms distance [m] of measured from true points, over stations and targets, after a rigid fit of each station.

    `points` (n, 3) [m] of n pointings are in instrument frames, `true_points` (T, 3) [m] in the network frame. The fit
    removes errors that a pose absorbs completely, such as errors of azimuth index or station height.
    """
    clouds = station_point_clouds(recording, points)
    gap = np.stack([align_to_points(cloud, true_points) - true_points for cloud in clouds])
    return float(np.sqrt(np.nanmean(np.sum(gap**2, axis=2))))
