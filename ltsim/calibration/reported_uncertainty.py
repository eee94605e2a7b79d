"""Reported standard deviations: scaled by sigma0 if the readings contradict the model, and with errors of the air."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from scipy.linalg import block_diag

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.coordinate_uncertainty import (
    MAX_POINTS_IN_COVARIANCE_FILE,
    covariance_due_to_air,
    longest_range,
    relevant_air_uncertainty,
    reported_joint_covariance,
    rms_displacements_by_shared_air_error,
)
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.result import noise_rows
from ltsim.calibration.schema import FitEntry, FittedEffectEntry, ReflectorEntry, StationPose
from ltsim.calibration.uncertainty import HiddenError
from ltsim.core.arrays import Floats
from ltsim.core.notation import number_text
from ltsim.core.probability import TWO_SIDED_GLOBAL_TEST_LEVEL
from ltsim.core.units import ARCSECOND, MICROMETRE, MILLIMETRE
from ltsim.physics.effects.air import air_uncertainty_text
from ltsim.recordings.pointings import has_all_sigma_columns
from ltsim.recordings.specification import noise_origin
from ltsim.recordings.summary import recording_noise_text

FittedEntryT = TypeVar("FittedEntryT", FittedEffectEntry, ReflectorEntry)
"""Type of a result entry with estimated parameters: of an effect or of a reflector."""
MIN_RELATIVE_HIDDEN_DISPLACEMENT = 0.2
"""Limit of the rms displacement of the targets by an error that does not change the readings, divided by their rms
standard deviation. An error with a larger ratio is reported."""


def uncertainty_factor(fit: FitEntry, *, is_sigma0_credible: bool | None = None) -> float:
    """Factor on the standard deviations: sigma0 if the readings contradict the model, otherwise 1.

    It is sigma0 if sigma0 is significantly above 1 and not because of single readings. `is_sigma0_credible` states
    whether the verdict on the tests prefers sigma0 to the declared noise. If it is None, the global test decides, at
    the level `TWO_SIDED_GLOBAL_TEST_LEVEL`.
    """
    if fit.sigma0 is None or fit.sigma0 <= 1.0:
        return 1.0
    is_rejected = fit.p_value is not None and fit.p_value < TWO_SIDED_GLOBAL_TEST_LEVEL / 2
    return fit.sigma0 if (is_rejected if is_sigma0_credible is None else is_sigma0_credible) else 1.0


def with_reported_uncertainty(calibration: Calibration) -> Calibration:
    """Copy of a calibration whose standard deviations include errors of the air and a rejected model.

    The standard deviations are multiplied by sigma0 if the readings contradict the model.
    """
    verdict, adjustment = calibration.verdict, calibration.adjustment
    factor = uncertainty_factor(
        calibration.fit, is_sigma0_credible=verdict.is_sigma0_credible if verdict.case else None
    )
    if adjustment is None:
        return calibration
    unknowns = adjustment.problem.unknowns
    covariance = factor**2 * calibration.target_covariances + covariance_due_to_air(adjustment, unknowns.target_columns)
    stations = covariance_due_to_air(adjustment, unknowns.pose_columns)
    return calibration.with_changes(
        covariance=_scaled_parameter_covariance(calibration, factor),
        target_covariances=covariance,
        stations=tuple(
            _scaled_pose(pose, factor, added) for pose, added in zip(calibration.stations, stations, strict=True)
        ),
        effects=tuple(_scaled_fitted_entry(effect, factor) for effect in calibration.effects),
        reflectors=tuple(_scaled_fitted_entry(reflector, factor) for reflector in calibration.reflectors),
        noise_text=_noise_text(adjustment),
        constants_included=bool(calibration.instrument_parameter_names) or adjustment.recording.is_corrected,
        uncertainty_factor=factor,
        air_text=_air_text(adjustment),
        hidden_errors=_hidden_errors(adjustment, covariance),
    )


def point_covariance(calibration: Calibration, *, with_stations: bool = False) -> Floats | None:
    """Joint covariance (3 P, 3 P) [m^2] of P points: all targets and, if requested, the positions of all stations.

    The result is None for a calibration without network, and for too many points.
    """
    adjustment = calibration.adjustment
    n_stations = len(calibration.stations) if with_stations else 0
    if adjustment is None or len(calibration.target_names) + n_stations > MAX_POINTS_IN_COVARIANCE_FILE:
        return None
    return reported_joint_covariance(
        adjustment, sigma_factor=calibration.uncertainty_factor, with_stations=with_stations
    )


def _scaled_parameter_covariance(calibration: Calibration, factor: float) -> Floats:
    """Covariance of the parameters if the noise of the readings is `factor` times as large and the prior is unchanged.

    The shape is (parameters, parameters) for the parameters of all instruments. With the covariance C in prior standard
    deviations, C^-1 - 1 is the information of the readings, which is divided by the square of the factor.
    """
    covariance, adjustment = calibration.covariance, calibration.adjustment
    free_indices = np.flatnonzero(~calibration.is_fixed.ravel())
    if factor == 1.0 or not len(free_indices) or adjustment is None:
        return covariance
    if calibration.method != "network":
        return factor**2 * covariance
    root = block_diag(*adjustment.problem.prior.whitening_matrices)[np.ix_(free_indices, free_indices)]
    size, basis = np.linalg.eigh(root @ covariance[np.ix_(free_indices, free_indices)] @ root.T)
    size = np.clip(size, np.finfo(np.float64).tiny, 1.0)
    widened_root = np.linalg.solve(root, basis * np.sqrt(1.0 / (1.0 + (1.0 / size - 1.0) / factor**2)))
    new_covariance = np.zeros_like(covariance)
    new_covariance[np.ix_(free_indices, free_indices)] = widened_root @ widened_root.T
    return new_covariance


def _scaled_pose(pose: StationPose, factor: float, covariance_due_to_air: Floats) -> StationPose:
    """Pose with standard deviations multiplied by `factor`, plus the covariance (6, 6) due to errors of the air.

    Components that define the frame keep the standard deviation 0.
    """
    air = np.sqrt(np.diag(covariance_due_to_air))
    sigma_by_field = {}
    for name, unit, part in (
        ("sigma_position_mm", MILLIMETRE, air[:3]),
        ("sigma_rotation_arcsec", ARCSECOND, air[3:]),
    ):
        sigma = getattr(pose, name)
        if sigma is not None:
            given = np.array([np.nan if value is None else value for value in sigma])
            reported = np.where(given == 0.0, 0.0, np.hypot(factor * given, part / unit))
            sigma_by_field[name] = tuple(reported.tolist())
    return pose.with_values(**sigma_by_field)


def _scaled_fitted_entry(entry: FittedEntryT, factor: float) -> FittedEntryT:
    """Entry of an effect or reflector with standard deviations multiplied by `factor`."""
    parameters = tuple(p if p.sigma is None else p.with_values(sigma=factor * p.sigma) for p in entry.parameters)
    return entry.with_values(parameters=parameters)


def _hidden_errors(adjustment: Adjustment, covariance: Floats) -> tuple[HiddenError, ...]:
    """Errors that do not change the readings but displace the targets noticeably compared with their sigmas.

    `covariance` (targets, 3, 3) [m^2] is the covariance of the coordinates of each target.
    """
    variance = np.einsum("tii->t", covariance)
    is_determined = np.isfinite(variance)
    if not is_determined.any():
        return ()
    usual, sizes = np.sqrt(np.mean(variance[is_determined])), rms_displacements_by_shared_air_error(adjustment)
    return tuple(
        HiddenError(error_text=name, rms_target_error_um=size / MICROMETRE)
        for name, size in sorted(sizes.items(), key=lambda item: -item[1])
        if size > MIN_RELATIVE_HIDDEN_DISPLACEMENT * usual
    )


def _noise_text(adjustment: Adjustment) -> str:
    """Text on the noise of the readings in the fit: estimated, or from the recording, a data sheet or a default."""
    recording, rows = adjustment.recording, noise_rows(adjustment)
    source_text = noise_origin(recording.notes)
    if rows:
        texts = [
            f"{row.observable}{f' of {row.instrument}' if row.instrument else ''} {number_text(row.median_sigma, 3)} "
            f"{row.unit} ("
            + (f"{number_text(row.factor, 3)} times {source_text})" if row.factor_sigma else f"{source_text})")
            for row in rows
        ]
        return f"{', '.join(texts)}; estimated from the readings"
    if has_all_sigma_columns(recording):
        return "declared for each reading"
    sheets = {recording.setup.instrument_named(name).sheet for name in recording.instruments} - {None}
    origin = f"of the data sheet {', '.join(sorted(map(str, sheets)))}" if sheets else source_text
    return f"{recording_noise_text(recording)}; {origin}"


def _air_text(adjustment: Adjustment) -> str:
    """Text on the errors of the air in the standard deviations; empty for short ranges or undeclared air."""
    air = relevant_air_uncertainty(adjustment)
    if air is None or not (air.temperature_k or air.gradient_k_per_m or air.turbulence_um2_per_m3):
        return ""
    return air_uncertainty_text(air, longest_range(adjustment))
