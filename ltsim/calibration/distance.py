"""Calibration by the distance objective of Sensors 2021, 21, 7479, and adjustment of the network with the result."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import special

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.prior import prior_sigmas
from ltsim.adjustment.snooping import screen_gross_errors
from ltsim.calibration import result
from ltsim.calibration.arrays import CalibrationArrays
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.combinations import UndeterminedEntry
from ltsim.calibration.correct import corrected_readings
from ltsim.calibration.distance_solver import (
    DistanceEstimate,
    ObjectiveNorm,
    minimum_comparison_sentences,
    solve_all_combinations,
    solve_determined_combinations,
)
from ltsim.calibration.objective import DistanceProblem
from ltsim.calibration.prior_information import ParameterSelection
from ltsim.calibration.schema import FitEntry
from ltsim.calibration.undetermined import undetermined_entries
from ltsim.core.arrays import Floats, Ints
from ltsim.physics.model.construction import GeometricErrorModel, declared_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState
from ltsim.recordings.recording import Recording
from ltsim.recordings.reflectors import require_equal_radii
from ltsim.recordings.result_file import ResultSource
from ltsim.solve.design import to_dense

OBJECTIVE_NORM_BY_DISTANCE_METHOD: dict[str, ObjectiveNorm] = {
    "distance": "squares",
    "distance-l1": "absolute",
    "equation-9": "squares",
    "equation-9-l1": "absolute",
}
"""Norm that each method of calibration by distances minimises: `squares` (sum of squares) or `absolute` (sum of
absolute values)."""


def calibrate_distance(
    recording: Recording,
    construction: GeometricErrorModel | None = None,
    *,
    method: str = "distance",
    advise: bool = True,
    parameter_selection: ParameterSelection | None = None,
    bound_in_prior_sigmas: float | None = None,
) -> Calibration:
    """Calibration by a distance method (Sensors 2021, 21, 7479, eq. 9 and 10), with options as in `ltsim.calibrate`.

    Stations and targets are computed by an adjustment of the corrected readings. Their covariance includes the
    uncertainty of the parameters, which were estimated from the same readings.
    """
    require_equal_radii(recording, f"the method {method}")
    model = construction or declared_construction(recording)
    parameter_prior = (parameter_selection or ParameterSelection()).prior_of(recording, model)
    prior, held = parameter_prior.sigma, parameter_prior.is_fixed
    source = ResultSource.from_recording(recording)
    recording, _, gross, _ = screen_gross_errors(recording)
    usable = recording.with_readings(np.where(gross[:, None], np.nan, recording.readings))
    start_values = np.where(held, parameter_prior.mean / prior, 0.0).ravel()
    problem, norm, notes = (
        DistanceProblem(usable, model, prior),
        OBJECTIVE_NORM_BY_DISTANCE_METHOD[method],
        tuple[str, ...](),
    )
    if method.startswith("equation-9"):
        estimate = solve_all_combinations(
            problem,
            norm,
            bound_in_prior_sigmas=bound_in_prior_sigmas,
            start_values=start_values,
            fixed_mask=held.ravel(),
        )
    else:
        estimate = solve_determined_combinations(problem, norm, start_values=start_values, fixed_mask=held.ravel())
        notes = minimum_comparison_sentences(problem, norm, estimate, held.ravel()) if advise else ()
    parameter_values = estimate.unknowns.reshape(prior.shape) * prior
    applied_values = parameter_values[0] if len(parameter_values) == 1 else parameter_values[recording.instrument]
    corrected_recording = recording.with_readings(corrected_readings(recording, model, applied_values))
    adjustment = adjust(corrected_recording)
    adjustment.solution.require_success()
    propagation = DistanceErrorPropagation(recording, model, parameter_values, estimate, adjustment)
    added_covariance = propagation.network_covariance_from_parameter_errors()
    unknowns = adjustment.problem.unknowns
    pose = adjustment.pose_covariance
    added_pose = added_covariance[unknowns.pose_columns[:, :, None], unknowns.pose_columns[:, None, :]]
    pose = np.where(pose == 0.0, 0.0, pose + added_pose)  # components that define the frame stay exact
    scale = prior.ravel()
    null_space = np.array([d.coefficient_vector for d in estimate.undetermined_combinations]).reshape(-1, len(scale))
    arrays = CalibrationArrays(
        construction=model,
        instruments=recording.instruments,
        estimates=parameter_values,
        prior_sigma=prior,
        covariance=estimate.covariance * np.outer(scale, scale),
        null_space=null_space,
        is_fixed=held,
        target_names=recording.targets,
        target_points=adjustment.state.target_points,
        target_covariances=adjustment.target_covariances
        + added_covariance[unknowns.target_columns[:, :, None], unknowns.target_columns[:, None, :]],
        adjustment=adjustment,
    )
    return Calibration.from_arrays(
        arrays,
        method=method,
        fit=_network_fit_entry(propagation),
        undetermined=_undetermined_entries(adjustment, model, estimate, recommend_measurements=advise),
        frame=result.frame_text(adjustment),
        stations=result.station_poses(adjustment, pose),
        criteria=result.criteria_entry(recording, adjustment, model, parameter_values, corrects_reflectors=False),
        outliers=result.outlier_rows(adjustment),
        undetermined_targets=tuple(
            recording.targets[i] for i in np.flatnonzero(adjustment.problem.undetermined_unknowns.is_unmeasured_target)
        ),
        recording=source,
        notes=(*result.range_zero_notes(adjustment), *notes),
    )


def _network_fit_entry(propagation: DistanceErrorPropagation) -> FitEntry:
    """Fit statistics of the network adjusted with the parameters; `dof` is the expected chi-square, rounded."""
    chi2, estimate = propagation.adjustment.chi2, propagation.distance_estimate
    mean, variance = propagation.chi2_moments()
    expected_chi2 = round(mean)
    redundant = propagation.adjustment.dof > 0 and expected_chi2 > 0
    status = "capped", "the limit of iterations was reached before the steps became small"
    if estimate.has_converged:
        status = "converged", "the last step changed no parameter by more than 1e-7 of its prior sigma"
    return FitEntry(
        chi2=chi2,
        dof=expected_chi2,
        sigma0=float(np.sqrt(chi2 / expected_chi2)) if redundant else None,
        p_value=propagation.chi2_p_value(chi2) if redundant else None,
        iterations=estimate.n_iterations,
        status=status[0],
        sentence=status[1],
        chi2_sigma=float(np.sqrt(variance)),
    )


def _undetermined_entries(
    adjustment: Adjustment,
    construction: GeometricErrorModel,
    estimate: DistanceEstimate,
    *,
    recommend_measurements: bool,
) -> tuple[UndeterminedEntry, ...]:
    """Result entries of the combinations of parameters that the measured distances do not determine.

    With `recommend_measurements` the entries name the measurement that would determine the combination.
    """
    instruments = adjustment.recording.instruments
    if len(instruments) == 1:
        return undetermined_entries(
            adjustment,
            construction,
            [list(estimate.undetermined_combinations)],
            recommend_measurements=recommend_measurements,
        )
    names, advice = construction.instrument_parameter_names(instruments), "calibrate with the method network"
    return tuple(
        UndeterminedEntry(combination=d.coefficients(names), gain=d.gain, cure=advice, measurement=advice)
        for d in estimate.undetermined_combinations
    )


@dataclass(frozen=True)
class DistanceErrorPropagation:
    """Propagation of errors of parameters, which were estimated from distances, through the network adjustment.

    Let e be the whitened noise of the readings and the gauge (reflectors at known distances). Let A be the matrix that
    maps observations to adjusted unknowns, D the design matrix of the adjustment, B the design matrix of the
    parameters, and dx the error of the parameters. The error of the network is A e - A B dx, and the residuals are R e
    - R B dx with R = 1 - D A.

    The parameters are estimated from the same readings, so that dx is correlated with e. The estimator is not the
    adjustment: its residuals are larger than the degrees of freedom imply.
    """

    recording: Recording
    """Recording with uncorrected readings."""
    construction: GeometricErrorModel
    """Geometric error model of the instruments."""
    estimates: Floats
    """Estimated parameters, shape (instruments, parameters) [SI]."""
    distance_estimate: DistanceEstimate
    """Parameters estimated from distances between targets, with their covariance."""
    adjustment: Adjustment
    """Adjustment of the corrected readings, without parameters."""

    @cached_property
    def _used_reading_indices(self) -> Ints:
        """Indices of the readings in use in the flattened array of all readings."""
        return np.flatnonzero(self.adjustment.problem.is_used_reading.ravel())

    @cached_property
    def _whitened_design(self) -> Floats:
        """Whitened design matrix D of readings and reference lengths, shape (observations, unknowns of the network)."""
        n_rows = len(self._used_reading_indices) + len(self.adjustment.problem.gauge_rows)
        return to_dense(self.adjustment.solution.system.design[:n_rows])

    @cached_property
    def _unknowns_per_observation(self) -> Floats:
        """Matrix A (unknowns, observations) that maps whitened observations to the adjusted unknowns of the network."""
        return self.adjustment.factorised_normals.multiply_by_covariance(np.ascontiguousarray(self._whitened_design.T))

    @cached_property
    def _parameter_design(self) -> Floats:
        """Whitened design matrix B of the parameters, shape (observations, parameters of all instruments).

        The parameters are in units of their prior standard deviations. Rows of reference lengths are zero.
        """
        recording, (count, size) = self.recording, self.estimates.shape
        state = self.adjustment.state
        linear_state = NetworkState(
            state.station_positions, state.station_rotations, state.target_points, self.estimates
        )
        by_value = MeasurementModel(recording, self.construction).linearise(linear_state).instrument_derivatives
        prior = prior_sigmas(recording, self.construction)[recording.instrument]
        design = np.zeros((len(recording), 3, count, size))
        design[np.arange(len(recording)), :, recording.instrument] = by_value * prior[:, None, :]
        whitened = (design / self.adjustment.problem.reading_sigmas[:, :, None, None]).reshape(-1, count * size)
        gauge = np.zeros((len(self.adjustment.problem.gauge_rows), count * size))
        return np.concatenate([whitened[self._used_reading_indices], gauge])

    @cached_property
    def _noise_parameter_cross_covariance(self) -> Floats:
        """Covariance of the whitened noise with the error of the parameters, shape (observations, parameters)."""
        readings = 3 * len(self.recording)
        noise = self.distance_estimate.covariance_with_observations
        return np.concatenate([noise[:, self._used_reading_indices], noise[:, readings:]], axis=1).T

    def network_covariance_from_parameter_errors(self) -> Floats:
        """Contribution of the parameters' error to the covariance (unknowns, unknowns) of the network."""
        through = self._unknowns_per_observation @ self._parameter_design
        cross_covariance = (self._unknowns_per_observation @ self._noise_parameter_cross_covariance) @ through.T
        return through @ self.distance_estimate.covariance @ through.T - cross_covariance - cross_covariance.T

    def _projection_onto_residuals(self, observation_vectors: Floats) -> Floats:
        """Part of the observation vectors (one per column) that remains in the residuals of the adjustment."""
        return observation_vectors - self._whitened_design @ (self._unknowns_per_observation @ observation_vectors)

    def chi2_moments(self) -> tuple[float, float]:
        """Expected value and variance of the adjustment's chi-square, if the model and the declared noise are right."""
        systematic, noise = (
            self._projection_onto_residuals(self._parameter_design),
            self._projection_onto_residuals(self._noise_parameter_cross_covariance),
        )
        stacked = np.concatenate([systematic, noise], axis=1)
        identity = np.eye(systematic.shape[1])
        block_matrix = np.block(
            [[self.distance_estimate.covariance, -identity], [-identity, np.zeros_like(identity)]]
        ) @ (stacked.T @ stacked)
        n_free = float(self.adjustment.dof)
        return n_free + float(np.trace(block_matrix)), 2 * (
            n_free + 2 * float(np.trace(block_matrix)) + float(np.sum(block_matrix * block_matrix.T))
        )

    def chi2_p_value(self, chi2: float) -> float:
        """Probability of a chi-square above `chi2`, by Satterthwaite's approximation with a scaled chi-square."""
        mean, variance = self.chi2_moments()
        scale = variance / (2 * mean)
        return float(special.chdtrc(mean / scale, max(chi2 / scale, 0.0)))
