"""Uncertainty of adjusted coordinates: joint covariance, and displacements by errors of air temperature and refraction.

The stochastic model of the adjustment does not contain these errors of the air. Therefore they are added here.

To first order the unknowns depend on the whitened observations by P = N^-1 A', with the normal matrix N and the
whitened design matrix A. An error that shifts the whitened observations by s displaces the unknowns by P s. If s is the
shift by one standard deviation of the error, the covariance of the unknowns due to it is P s s' P'.
"""

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp

from ltsim.adjustment.adjustment import Adjustment
from ltsim.core.arrays import Floats, Ints, batches
from ltsim.core.units import PPM
from ltsim.geometry.rigid import rigid_motion_jacobian
from ltsim.physics.effects.air import reading_changes_per_air_sigma, turbulence_variance
from ltsim.physics.effects.rays import relative_index_decrease_per_kelvin
from ltsim.recordings.air import AirUncertainty
from ltsim.recordings.coordinates import covariance_csv_text
from ltsim.recordings.epoch_coordinates import AXIS_NAMES
from ltsim.solve.design import DESIGN_ROWS_PER_BATCH, DesignMatrix, to_dense, weight_rows

COVARIANCE_FILE_NAME = "targets.covariance.csv"
"""Name of the file with the joint covariance of the coordinates in `targets.csv`."""
POINTS_COVARIANCE_FILE_NAME = "points.covariance.csv"
"""Name of the file with the joint covariance of the coordinates of targets and stations in `points.csv`."""
STATION_NAME_ENDING = " (station)"
"""Ending of the name of a station in `points.csv` if a target has the same name."""
MAX_POINTS_IN_COVARIANCE_FILE = 400
"""Largest number of points for which the joint covariance is written to a file. The file grows with the square of the
number of points and has 20 MB at the limit."""


def point_names(adjustment: Adjustment, *, with_stations: bool) -> tuple[str, ...]:
    """Names of T targets and, if requested, of S stations; a station with a target's name gets a different name."""
    names = list(adjustment.recording.targets)
    for station in adjustment.recording.stations if with_stations else ():
        name = station
        while name in names:
            name += STATION_NAME_ENDING
        names.append(name)
    return tuple(names)


def point_columns(adjustment: Adjustment, *, with_stations: bool) -> Ints:
    """Columns (P, 3), in the design matrix, of the coordinates of P points: T targets and, if requested, S stations."""
    unknowns = adjustment.problem.unknowns
    columns = unknowns.target_columns
    return np.concatenate([columns, unknowns.pose_columns[:, :3]]) if with_stations else columns


def joint_covariance(adjustment: Adjustment, *, with_stations: bool = False) -> Floats:
    """Joint covariance (3 P, 3 P) [m^2] of x, y and z of P points, point by point; NaN for undetermined coordinates.

    The points are T targets and, if requested, the positions of S stations. Coordinates of a station that define the
    frame have the covariance 0.
    """
    columns = point_columns(adjustment, with_stations=with_stations).ravel()
    unit = np.zeros((adjustment.problem.unknowns.n_columns, len(columns)))
    unit[columns, np.arange(len(columns))] = 1.0
    covariance = adjustment.factorised_normals.multiply_by_covariance(unit)[columns]
    if adjustment.datum is not None:
        covariance = adjustment.datum.transform_covariance(covariance[None], columns[None])[0]
    variance = np.einsum("tii->ti", adjustment.target_covariances).ravel()
    if with_stations:
        variance = np.append(variance, np.einsum("tii->ti", adjustment.pose_covariance)[:, :3])
    covariance[variance == 0.0] = covariance[:, variance == 0.0] = 0.0
    covariance[np.isnan(variance)] = covariance[:, np.isnan(variance)] = np.nan
    return 0.5 * (covariance + covariance.T)


def reported_joint_covariance(
    adjustment: Adjustment,
    shared_displacements: Floats | None = None,
    *,
    sigma_factor: float = 1.0,
    with_stations: bool = False,
) -> Floats:
    """Joint covariance (3 P, 3 P) [m^2] of P points with all errors that a result reports.

    The points are T targets and, if requested, the positions of S stations. The covariance of the adjustment is
    multiplied by the square of `sigma_factor`. The covariance due to errors of the air is added, and the covariance due
    to k independent errors that displace all points. `shared_displacements` (k, P, 3) [m] contains the displacements by
    one standard deviation of each of these errors.
    """
    covariance = sigma_factor**2 * joint_covariance(adjustment, with_stations=with_stations)
    is_fixed = np.diag(covariance) == 0.0
    columns = point_columns(adjustment, with_stations=with_stations).reshape(1, -1)
    covariance = covariance + covariance_due_to_air(adjustment, columns)[0]
    if shared_displacements is not None:
        errors = shared_displacements.reshape(len(shared_displacements), -1)
        covariance = covariance + errors.T @ errors
    covariance[is_fixed] = covariance[:, is_fixed] = 0.0
    return covariance


def named_covariance_csv_text(names: Sequence[str], covariance: Floats) -> str:
    """Content of a covariance file of P points, without undetermined coordinates.

    `covariance` (3 P, 3 P) [m^2] is the joint covariance of the points `names`.
    """
    determined_indices = np.flatnonzero(np.isfinite(np.diag(covariance)))
    coordinates = [f"{name}.{axis}" for name in names for axis in AXIS_NAMES]
    return covariance_csv_text(
        [coordinates[i] for i in determined_indices.tolist()],
        covariance[np.ix_(determined_indices, determined_indices)],
    )


TEMPERATURE_ERROR_NAME = "temperature of the air"
"""Name, in an uncertainty budget, of the error of the air temperature at each station."""
GRADIENT_ERROR_NAME = "gradient of the air"
"""Name, in an uncertainty budget, of the error of the vertical temperature gradient at each station."""
TURBULENCE_ERROR_NAME = "turbulence"
"""Name, in an uncertainty budget, of the error of each reading by turbulence."""


def displacement_per_observation(adjustment: Adjustment, columns: Ints) -> Floats:
    """Displacements (m, k) of k unknowns by a change of each of m observations by one standard deviation.

    `columns` (k,) are the columns of the unknowns in the design matrix.
    """
    return np.asarray(adjustment.solution.system.design @ _covariance_columns(adjustment, columns))


def _covariance_columns(adjustment: Adjustment, columns: Ints) -> Floats:
    """Covariances (u, k) of all u unknowns with the k unknowns `columns` (k,), in the datum of the adjustment."""
    unit = np.zeros((adjustment.problem.unknowns.n_columns, len(columns)))
    unit[columns, np.arange(len(columns))] = 1.0
    spread = adjustment.factorised_normals.multiply_by_covariance(unit)
    if adjustment.datum is not None:
        spread = spread - adjustment.datum.motion_cross_covariance @ adjustment.datum.free_motions[columns].T
    return np.asarray(spread)


def relevant_air_uncertainty(
    adjustment: Adjustment, air_uncertainty: AirUncertainty | None = None
) -> AirUncertainty | None:
    """Uncertainty of air temperature, gradient and turbulence; None if all ranges are too short to be affected.

    By default `air_uncertainty` is the uncertainty that `setup.toml` declares.
    """
    declared_air = air_uncertainty or adjustment.recording.setup.air or AirUncertainty()
    is_used = adjustment.problem.is_used_reading.any(axis=1)
    return declared_air if declared_air.is_relevant(longest_range(adjustment)) and is_used.any() else None


def longest_range(adjustment: Adjustment) -> float:
    """Longest range [m] of a pointing in use."""
    return float(np.max(adjustment.sightings.range_, where=adjustment.problem.is_used_reading.any(axis=1), initial=0.0))


def displacements_by_air_error(
    adjustment: Adjustment, displacement_per_observation: Floats, air: AirUncertainty
) -> dict[str, Floats]:
    """Displacements (k, q) of k unknowns by one standard deviation of each of q independent errors of the air.

    The keys are the kinds of error: air temperature and vertical gradient (one error per station), turbulence (one
    error per reading). `displacement_per_observation` (m, k) contains the displacements of these unknowns by a change
    of each of m observations by one standard deviation.
    """
    readings = displacement_per_observation[: int(adjustment.problem.is_used_reading.sum())].T
    common, station = _reading_shifts_by_shared_air_errors(adjustment, air)
    by_station = [
        np.stack([readings[:, station == s] @ shift[station == s] for s in np.unique(station)], axis=-1)
        for shift in common
    ]
    responses = dict(zip((TEMPERATURE_ERROR_NAME, GRADIENT_ERROR_NAME), by_station, strict=True))
    responses[TURBULENCE_ERROR_NAME] = readings * _turbulence_sigma_ratios(adjustment, air)
    return {name: response for name, response in responses.items() if np.any(response)}


def _reading_shifts_by_shared_air_errors(adjustment: Adjustment, air: AirUncertainty) -> tuple[Floats, Ints]:
    """Shifts (2, r) of the r readings in use by errors of air temperature and gradient, and their station indices (r,).

    The errors have the size of one standard deviation. The shifts are in standard deviations of the readings.
    """
    rows, columns = np.nonzero(adjustment.problem.is_used_reading)
    errors = reading_changes_per_air_sigma(air, adjustment.sightings)[rows, columns]
    return (errors / adjustment.problem.reading_sigmas[rows, columns][:, None]).T, adjustment.recording.station[rows]


def _turbulence_sigma_ratios(adjustment: Adjustment, air: AirUncertainty) -> Floats:
    """Ratios (r,) of the standard deviation by turbulence to the declared one, for the r readings in use."""
    rows, columns = np.nonzero(adjustment.problem.is_used_reading)
    variance = turbulence_variance(air, adjustment.sightings)[rows, columns]
    return np.asarray(np.sqrt(variance) / adjustment.problem.reading_sigmas[rows, columns])


def shared_air_error_names(air: AirUncertainty) -> tuple[str, str]:
    """Names, with their sizes, of the two errors of the air that all stations share: temperature, vertical gradient.

    Adjusted poses and targets absorb these errors, so that residuals do not show them.
    """
    scale = air.temperature_k * relative_index_decrease_per_kelvin() / PPM
    return (
        f"air {air.temperature_k:g} K warmer than measured at all stations (scale {scale:.2g} ppm)",
        f"vertical temperature gradient of {air.gradient_k_per_m:g} K/m at all stations",
    )


def displacements_by_shared_air_error(
    adjustment: Adjustment, displacement_per_observation: Floats, air: AirUncertainty
) -> dict[str, Floats]:
    """Displacements (k,) of k unknowns by one standard deviation of each error of the air that all stations share.

    The keys are the `shared_air_error_names`. `displacement_per_observation` (m, k) contains the displacements of the
    unknowns by a change of each of m observations by one standard deviation.
    """
    shifts, _ = _reading_shifts_by_shared_air_errors(adjustment, air)
    return dict(zip(shared_air_error_names(air), shifts @ displacement_per_observation[: shifts.shape[1]], strict=True))


def covariance_due_to_air(adjustment: Adjustment, columns: Ints, air: AirUncertainty | None = None) -> Floats:
    """Covariances (c, k, k) of c sets of k unknowns due to errors of the air; zero if all ranges are short.

    `columns` (c, k) are the columns of the unknowns in the design matrix A. `air` is the uncertainty of the air, by
    default as declared in `setup.toml`. The result is C A' S A C, with the covariance C of the unknowns and the
    covariance S of the whitened observations due to the air.
    """
    counted, size = relevant_air_uncertainty(adjustment, air), columns.shape[1]
    added_covariance = np.zeros((*columns.shape, size))
    if counted is None:
        return added_covariance
    unknowns, (common, turbulent) = adjustment.problem.unknowns.n_columns, _air_right_hand_sides(adjustment, counted)
    for part in batches(len(columns), unknowns * size):
        batch = columns[part]
        spread = _covariance_columns(adjustment, batch.ravel())
        by_station = (common.T @ spread).T.reshape(len(batch), size, -1)
        sets = spread.T.reshape(len(batch), size, unknowns)
        scattered = (turbulent @ spread).T.reshape(sets.shape)
        added_covariance[part] = by_station @ np.swapaxes(by_station, 1, 2) + sets @ np.swapaxes(scattered, 1, 2)
    variance = np.einsum("cii->ci", added_covariance)
    np.maximum(variance, 0.0, out=variance)  # coordinates that the datum fixes have variance 0, up to rounding
    return added_covariance


def _air_right_hand_sides(adjustment: Adjustment, air: AirUncertainty) -> tuple[Floats, DesignMatrix]:
    """Matrices A' s (u, q) and A' S A (u, u), from which the covariance of u unknowns due to the air is computed.

    A (r, u) is the whitened design matrix of the r readings in use. s (r, q) are the shifts of the whitened readings by
    one standard deviation of q errors: air temperature and vertical gradient at each station. S (r, r) is the
    covariance of the whitened readings due to turbulence.
    """
    common, station = _reading_shifts_by_shared_air_errors(adjustment, air)
    turbulence, design = _turbulence_sigma_ratios(adjustment, air), adjustment.solution.system.design[: len(station)]
    stations, place = np.unique(station, return_inverse=True)
    columns, rows = np.stack([place, len(stations) + place]).ravel(), np.tile(np.arange(len(station)), 2)
    shifts = sp.csr_array((common.ravel(), (rows, columns)), (len(station), 2 * len(stations)))
    normal_matrix_parts = []
    for first in range(0, len(station), DESIGN_ROWS_PER_BATCH):
        row_slice = slice(first, first + DESIGN_ROWS_PER_BATCH)
        turbulent_design = weight_rows(design[row_slice], turbulence[row_slice])
        normal_matrix_parts.append(turbulent_design.T @ turbulent_design)
    return to_dense(design.T @ shifts), sum(normal_matrix_parts)


def rms_displacements_by_shared_air_error(
    adjustment: Adjustment, air: AirUncertainty | None = None
) -> dict[str, float]:
    """Rms displacements [m] of the targets by one standard deviation of each error of the air that all stations share.

    The keys are the `shared_air_error_names`. `air` is the uncertainty of the air, by default as declared in the set-up
    file. The best-fitting rigid motion of the targets is removed. Residuals do not show these errors, so that no test
    of the adjustment detects them.
    """
    chosen = air or adjustment.recording.setup.air or AirUncertainty()
    targets = np.flatnonzero(
        ~adjustment.problem.undetermined_unknowns.is_unmeasured_target & ~adjustment.is_height_undetermined_target
    )
    columns, (shifts, _) = (
        adjustment.problem.unknowns.target_columns[targets].ravel(),
        _reading_shifts_by_shared_air_errors(adjustment, chosen),
    )
    normal_side = np.asarray(adjustment.solution.system.design[: shifts.shape[1]].T @ shifts.T)
    displacements = adjustment.factorised_normals.multiply_by_covariance(normal_side)
    if adjustment.datum is not None:
        displacements = displacements - adjustment.datum.free_motions @ (
            adjustment.datum.motion_cross_covariance.T @ normal_side
        )
    motion = rigid_motion_jacobian(adjustment.state.target_points[targets])
    size_by_target = {}
    for name, response in zip(shared_air_error_names(chosen), displacements[columns].T, strict=True):
        rest = response - motion @ np.linalg.lstsq(motion, response, rcond=None)[0]
        size_by_target[name] = float(np.sqrt(3.0 * np.mean(rest**2))) if len(rest) else 0.0
    return size_by_target
