"""Minimum of the distance objective of Sensors 2021, 21, 7479 (equation 9), for all trials in one network geometry.

The Gauss-Newton steps of all trials use the normal matrix at the nominal (error-free) readings. The gradient is exact
for the readings and parameters of each trial, so that the iteration converges to the optimum of the trial. The nominal
network also determines which linear combinations of parameters are estimated; all others remain zero.

Two cases need the normal matrix of the trial itself. For least absolute deviations each step solves a linear program,
whose optimal vertex depends on small differences between matrices. Equation 9 as printed also estimates weakly
determined combinations of parameters, whose estimates are large.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ltsim.adjustment.prior import prior_sigmas
from ltsim.calibration.distance import OBJECTIVE_NORM_BY_DISTANCE_METHOD
from ltsim.calibration.distance_solver import (
    DistanceComparisons,
    DistanceEstimate,
    mean_deviation_comparisons,
    pair_difference_comparisons,
    solve_all_combinations,
    solve_determined_combinations,
)
from ltsim.calibration.objective import DistanceProblem, PairDistances
from ltsim.campaigns.batch_network import BatchFit
from ltsim.campaigns.cloud_kernels import add_weighted_points, distance_gradient
from ltsim.campaigns.kernels import backpropagate_mean_gradients, compute_points
from ltsim.campaigns.kinematic_chain import ChainArrays
from ltsim.campaigns.trial_calibrators import BatchCalibrator, CalibratedBatch, measured_targets_and_weights
from ltsim.campaigns.true_network import TrialBatch
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.geometry.polar import wrap_angle
from ltsim.solve.least_absolute import solve_least_absolute

MAX_DISTANCE_FIT_STEPS = 10
"""Largest number of Gauss-Newton steps per trial in a calibration by distances between targets."""
MAX_WEAK_COMBINATION_FIT_STEPS = 30
"""Largest number of Gauss-Newton steps per trial in a calibration by distances that also estimates weakly determined
combinations of parameters."""
MAX_LAST_STEP_AT_CONVERGENCE = 3e-5
"""Largest change of an unknown in the last step of a converged trial, in prior standard deviations. The remaining error
is about a hundredth of this change."""


@dataclass(frozen=True)
class BatchDistanceCalibrator(BatchCalibrator):
    """Batch calibration by distances between targets: methods `distance` and `equation-9`.

    The distance objective of Sensors 2021, 21, 7479 is minimised: a sum over the disagreements of distances that
    several stations measured, and over their errors at reference lengths. The unknowns are the parameters of all
    instruments. Methods whose name ends in `-l1` minimise absolute deviations, all others minimise squares.
    """

    method: str = "distance"
    """Name of the calibration method in the campaign file: `distance` or `equation-9`; a name that ends in `-l1`
    selects least absolute deviations instead of least squares."""

    @property
    def uses_absolute_deviations(self) -> bool:
        """True if absolute deviations are minimised, false if squares are."""
        return self.method.endswith("-l1")

    @property
    def estimates_all_combinations(self) -> bool:
        """True if even weakly determined combinations of parameters are estimated (Sensors 2021, 21, 7479, eq. 9)."""
        return self.method.startswith("equation-9")

    @cached_property
    def distance_problem(self) -> DistanceProblem:
        """Distance objective with its observations and priors, at the nominal (error-free) network."""
        recording = self.true_network.recording
        return DistanceProblem(recording, self.construction, prior_sigmas(recording, self.construction))

    @cached_property
    def nominal_estimate(self) -> DistanceEstimate:
        """Estimate at the nominal readings: zero, with its covariance and the combinations that are not estimated."""
        if self.estimates_all_combinations:
            return solve_all_combinations(
                self.distance_problem, "absolute" if self.uses_absolute_deviations else "squares"
            )
        return solve_determined_combinations(self.distance_problem, OBJECTIVE_NORM_BY_DISTANCE_METHOD[self.method])

    @cached_property
    def _nominal_distances(self) -> PairDistances:
        """Distances between the targets as measured from each station, at the nominal readings."""
        return self.distance_problem.distances_at(np.zeros(self.distance_problem.prior_sigma.size))

    @cached_property
    def _estimated_combinations(self) -> Floats:
        """Linear combinations of the parameters that are estimated, as orthonormal columns (unknowns, combinations).

        Each parameter is divided by its prior standard deviation.
        """
        excluded_vectors = np.array(
            [d.coefficient_vector for d in self.nominal_estimate.undetermined_combinations]
        ).reshape(-1, self.distance_problem.prior_sigma.size)
        return np.linalg.svd(np.eye(excluded_vectors.shape[1]) - excluded_vectors.T @ excluded_vectors)[0][
            :, : excluded_vectors.shape[1] - len(excluded_vectors)
        ]

    @cached_property
    def gauss_newton_step_matrix(self) -> Floats:
        """Matrix (unknowns, unknowns) that maps half the objective's gradient to a Gauss-Newton step [prior sigma].

        A step contains only the estimated combinations of parameters.
        """
        rows, determined = self._mean_deviation_comparisons, self._estimated_combinations
        normal = rows.derivatives_by_unknowns.T @ rows.derivatives_by_unknowns
        return determined @ np.linalg.inv(determined.T @ normal @ determined) @ determined.T

    @cached_property
    def _mean_deviation_comparisons(self) -> DistanceComparisons:
        """Deviations of the measured distances from their mean over the stations, at the nominal parameters."""
        return mean_deviation_comparisons(self.distance_problem, self._nominal_distances)

    @cached_property
    def _pair_difference_comparisons(self) -> DistanceComparisons:
        """Comparisons of distances between two targets: measured from two stations, or with a reference length.

        They are computed from the nominal readings, for an instrument without errors.
        """
        return pair_difference_comparisons(self.distance_problem, self._nominal_distances)

    @property
    def _kinematic_chain(self) -> ChainArrays:
        """Kinematic chain of the estimated error model, linearised at the nominal readings."""
        return self.true_network.kinematic_chain(self.construction)

    @cached_property
    def _distance_objective_arrays(self) -> tuple[Ints, Bools, Floats, Ints]:
        """Set of each pointing, mask of the targets of each set, weight of each pointing, and gauge pairs.

        A set contains the pointings of one station in one face. The weight of a pointing is its share in the mean point
        of its set and target. A gauge pair holds the indices of two targets with a reference length. The arrays are
        sets (pointings,), mask (sets, targets), weights (pointings,) and pairs (lengths, 2), in this order.
        """
        gauge, sets = self.distance_problem.reference_lengths, self.distance_problem.station_face_indices
        visible, share = measured_targets_and_weights(self.true_network, sets)
        return sets, visible, share, np.stack([gauge.first_targets, gauge.second_targets], axis=1).reshape(-1, 2)

    def calibrate_batch(self, trial_batch: TrialBatch, trial_indices: Ints) -> tuple[CalibratedBatch, Bools]:
        """Estimates of the trials, and mask (trials,) of the converged trials.

        The targets are adjusted from readings that are corrected by the estimated parameters. `trial_indices` are the
        trials for which slow computations, trial by trial, are permitted.
        """
        values, moved = (
            self._least_squares_estimates(trial_batch)
            if self.method == "distance"
            else self._estimates_with_trial_normal_matrices(trial_batch, trial_indices)
        )
        fit = self._fit_corrected_readings(trial_batch, values)
        spread = (
            np.sqrt(np.diag(self.nominal_estimate.covariance)).reshape(values.shape[:2])
            * self.distance_problem.prior_sigma
        )
        status = np.zeros(len(moved), dtype=np.int64)
        return CalibratedBatch(values, spread, fit.target_increments, fit.chi2, status), (
            moved < MAX_LAST_STEP_AT_CONVERGENCE
        ) & fit.has_converged

    def _least_squares_estimates(self, trial_batch: TrialBatch) -> tuple[Floats, Floats]:
        """Estimated parameters of all trials by least squares, and their largest change in the last step.

        The shapes are (instruments, parameters, trials) [SI] and (trials,) [prior sigma].
        """
        deviation, prior = trial_batch.reading_deviations, self.distance_problem.prior_sigma[:, :, None]
        sets, visible, share, gauge = self._distance_objective_arrays
        recording, trials = self.true_network.recording, deviation.shape[2]
        reference_lengths = self.distance_problem.reference_lengths.lengths[:, None] + trial_batch.length_errors
        parameter_values = np.zeros((*self.distance_problem.prior_sigma.shape, trials))
        points, moved = np.empty(deviation.shape), np.full(trials, np.inf)
        for _ in range(MAX_DISTANCE_FIT_STEPS):
            compute_points(self._kinematic_chain, recording.instrument, deviation, parameter_values, points)
            clouds = np.zeros((*visible.shape, 3, trials))
            add_weighted_points(points, sets, recording.target, share, clouds)
            mean_gradients, gradient = np.zeros_like(clouds), np.zeros_like(parameter_values)
            distance_gradient(clouds, visible, gauge, reference_lengths, mean_gradients, np.zeros(trials))
            membership = (recording.instrument, sets, recording.target, share)
            backpropagate_mean_gradients(
                self._kinematic_chain, *membership, deviation, parameter_values, mean_gradients, gradient
            )
            step = self.gauss_newton_step_matrix @ (gradient * prior).reshape(-1, trials)
            parameter_values += step.reshape(parameter_values.shape) * prior
            moved = np.abs(step).max(axis=0)
            if not np.any(moved >= MAX_LAST_STEP_AT_CONVERGENCE):
                break
        return parameter_values, moved

    def _estimates_with_trial_normal_matrices(
        self, trial_batch: TrialBatch, trial_indices: Ints
    ) -> tuple[Floats, Floats]:
        """Estimated parameters of selected trials, each with its own normal matrix, and their largest last change.

        The parameters have the shape (instruments, parameters, trials) [SI], the changes in the last step (trials,)
        [prior sigma]. `trial_indices` are the indices of the selected trials in the batch; the change of all other
        trials is infinite.
        """
        prior, trials = self.distance_problem.prior_sigma[:, :, None], trial_batch.reading_deviations.shape[2]
        unknowns, moved = np.zeros((self.distance_problem.prior_sigma.size, trials)), np.full(trials, np.inf)
        readings = {
            trial: self.true_network.recording.readings + trial_batch.reading_deviations[:, :, trial]
            for trial in trial_indices.tolist()
        }
        combinations_by_trial = {
            trial: self._estimated_combinations
            if self.estimates_all_combinations
            else self._estimated_combinations_of_trial(trial_readings)
            for trial, trial_readings in readings.items()
        }
        for iteration in range(
            MAX_DISTANCE_FIT_STEPS if self.uses_absolute_deviations else MAX_WEAK_COMBINATION_FIT_STEPS
        ):
            active = trial_indices[moved[trial_indices] >= MAX_LAST_STEP_AT_CONVERGENCE]
            if not len(active):
                break
            residual = self._objective_terms(
                trial_batch, unknowns[:, active].reshape(*prior.shape[:2], -1) * prior, active
            )
            for gap, trial in zip(residual.T, active.tolist(), strict=True):
                by_unknown = self.distance_problem.parameter_derivatives(readings[trial], unknowns[:, trial])
                design = self._pair_difference_comparisons.comparison_matrix @ (
                    by_unknown @ combinations_by_trial[trial]
                )
                if self.uses_absolute_deviations:  # every step except the first is short
                    step = solve_least_absolute(
                        design, -gap, start_solution=np.zeros(design.shape[1]) if iteration else None
                    )
                else:
                    step = np.linalg.solve(design.T @ design, -design.T @ gap)
                unknowns[:, trial] += combinations_by_trial[trial] @ step
                moved[trial] = np.abs(combinations_by_trial[trial] @ step).max()
        return unknowns.reshape(*prior.shape[:2], trials) * prior, moved

    def _estimated_combinations_of_trial(self, readings: Floats) -> Floats:
        """Linear combinations of the unknowns that are estimated in a trial, as columns (unknowns, combinations).

        They are the principal axes of the objective at the trial's `readings` (pointings, 3) that are nearest to the
        combinations estimated at the nominal readings (`_estimated_combinations`).
        """
        design = self._mean_deviation_comparisons.comparison_matrix @ self.distance_problem.parameter_derivatives(
            readings, np.zeros(self.distance_problem.prior_sigma.size)
        )
        axes = np.linalg.eigh(design.T @ design)[1]
        order = np.argsort(np.linalg.norm(self._estimated_combinations.T @ axes, axis=0))[
            len(axes) - self._estimated_combinations.shape[1] :
        ]
        return axes[:, order]

    def _objective_terms(self, trial_batch: TrialBatch, parameter_values: Floats, trial_indices: Ints) -> Floats:
        """Terms whose sum is the distance objective of each trial, shape (terms, trials).

        `trial_indices` (trials,) are the indices of the trials in the batch, `parameter_values` (instruments,
        parameters, trials) [SI] their instrument parameters.
        """
        deviation, parameter_values = (
            np.ascontiguousarray(a) for a in (trial_batch.reading_deviations[:, :, trial_indices], parameter_values)
        )
        points = np.empty(deviation.shape)
        compute_points(
            self._kinematic_chain, self.true_network.recording.instrument, deviation, parameter_values, points
        )
        change = self.distance_problem.distances_of_points(points) - self._nominal_distances.lengths[:, None]
        rows, gauge = self._pair_difference_comparisons, self.distance_problem.reference_lengths
        length_errors = gauge.decorrelate(trial_batch.length_errors[:, trial_indices])
        by_gauge = rows.derivatives_by_noise[:, rows.derivatives_by_noise.shape[1] - len(gauge) :]
        return rows.residuals[:, None] + rows.comparison_matrix @ change + by_gauge @ length_errors

    def _fit_corrected_readings(self, trial_batch: TrialBatch, parameter_values: Floats) -> BatchFit:
        """Network adjustment of the trials, after correction of their readings by `parameter_values` [SI]."""
        deviation = trial_batch.reading_deviations
        points = np.empty(deviation.shape)
        compute_points(
            self._kinematic_chain, self.true_network.recording.instrument, deviation, parameter_values, points
        )
        x, y, z = points[:, 0], points[:, 1], points[:, 2]
        horizontal = np.hypot(x, y)
        is_back_face = (self.true_network.recording.face == 2)[:, None]
        azimuth, elevation = np.arctan2(y, x), np.arctan2(z, horizontal)
        raw_readings = np.stack(
            [
                np.hypot(horizontal, z),
                azimuth + np.where(is_back_face, np.pi, 0.0),
                np.where(is_back_face, np.pi - elevation, elevation),
            ],
            axis=1,
        )
        corrected_readings = raw_readings - self.true_network.recording.readings[:, :, None]
        corrected_readings[:, 1:] = wrap_angle(corrected_readings[:, 1:])
        return self.batch_network.fit_trials(corrected_readings, trial_batch.length_errors)
