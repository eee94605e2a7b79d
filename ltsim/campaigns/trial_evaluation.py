"""Evaluation of the calibrations of a batch of trials: disagreement of stations, and errors relative to true values.

`ltsim.adjustment.evaluation` computes the same quantities for single recordings; tests compare both.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ltsim.campaigns.cloud_kernels import (
    MICROMETRES_PER_METRE,
    add_squared_errors,
    add_weighted_points,
    align_rigidly,
    coordinate_criterion,
    distance_criterion,
    transform_to_network,
)
from ltsim.campaigns.columns import ResultColumns
from ltsim.campaigns.kernels import compute_points
from ltsim.campaigns.trial_calibrators import CalibratedBatch, measured_targets_and_weights
from ltsim.campaigns.true_network import TrialBatch, TrueNetwork
from ltsim.core.arrays import Bools, Floats
from ltsim.geometry.rigid import determines_pose
from ltsim.physics.effects.effect import Effect
from ltsim.physics.model.construction import GeometricErrorModel, ideal_construction

MAX_COLLINEAR_SPREAD_RATIO = 1e-3
"""Limit of the spread of targets across a line, divided by their spread along it. Targets with a smaller ratio count as
collinear; they determine no frame, because the rotation about the line is undetermined."""


@dataclass(frozen=True)
class TrialEvaluator:
    """Evaluator of calibrations of trials in one true network geometry.

    Quantities that do not depend on the method are computed once per batch of trials.
    """

    true_network: TrueNetwork
    """True network geometry of the trials."""

    @cached_property
    def _measured_targets_and_weights(self) -> tuple[Bools, Floats]:
        """Mask (stations, targets) of completely measured targets; weight (pointings,) of each pointing in its mean."""
        return measured_targets_and_weights(self.true_network, self.true_network.recording.station)

    @property
    def is_measured(self) -> Bools:
        """Mask (stations, targets) of the targets that each station measured completely."""
        return self._measured_targets_and_weights[0]

    @cached_property
    def can_compute_criteria(self) -> bool:
        """True if the disagreement of the stations in distances and coordinates can be computed.

        This needs at least two stations. Each must share enough targets with the first station to determine its pose
        relative to the first station.
        """
        return len(self.is_measured) > 1 and bool(self._determines_frame(self.is_measured & self.is_measured[0]).all())

    @cached_property
    def is_frame_determined(self) -> Bools:
        """Mask (stations,) of the stations whose targets determine a frame; others have no error of measured points."""
        return self._determines_frame(self.is_measured)

    def _determines_frame(self, is_used_target: Bools) -> Bools:
        """Mask (target sets,) of the sets of targets that determine a frame.

        `is_used_target` (target sets, targets) contains a mask of the targets of each set.
        """
        return determines_pose(
            self._true_targets(1)[:, :, 0], is_used_target, min_relative_width=MAX_COLLINEAR_SPREAD_RATIO
        )

    def mean_points_by_station(
        self,
        reading_deviations: Floats,
        construction: GeometricErrorModel | None = None,
        parameter_values: Floats | None = None,
    ) -> Floats:
        """Mean measured point of each target from each station, in the nominal network frame.

        The shape is (stations, targets, 3, trials) [m]; the mean is over faces and repeats. `reading_deviations`
        (pointings, 3, trials) are readings minus nominal readings. The readings are corrected by the parameters
        `parameter_values` (instruments, parameters, trials) [SI] of the geometric error model `construction`, if given.
        """
        recording, trials = self.true_network.recording, reading_deviations.shape[2]
        if construction is None or parameter_values is None:
            construction, parameter_values = ideal_construction(), np.zeros((len(recording.instruments), 0, trials))
        points, clouds = np.empty(reading_deviations.shape), np.zeros((*self.is_measured.shape, 3, trials))
        compute_points(
            self.true_network.kinematic_chain(construction),
            recording.instrument,
            reading_deviations,
            parameter_values,
            points,
        )
        add_weighted_points(points, recording.station, recording.target, self._measured_targets_and_weights[1], clouds)
        transform_to_network(
            clouds,
            np.ascontiguousarray(self.true_network.state.station_rotations),
            self.true_network.state.station_positions,
        )
        return clouds

    def criteria_columns(self, clouds: Floats, stage: str) -> ResultColumns:
        """Columns of the disagreement of stations in distances and coordinates, mean and maximum [um].

        `clouds` (stations, targets, 3, trials) [m] are the points of each station. `stage` is the word `before` or
        `after` (calibration) in the names of the columns.
        """
        trials = clouds.shape[3]
        columns = {
            f"{kind}_{stage}_{which}_um": np.empty(trials)
            for kind in ("distance", "coordinate")
            for which in ("mean", "max")
        }
        mean, largest, coordinate_mean, coordinate_largest = columns.values()
        distance_criterion(clouds, self.is_measured, mean, largest)
        placed_points = np.empty_like(clouds)
        placed_points[0] = clouds[0]
        for s in range(1, len(placed_points)):
            align_rigidly(clouds[s], clouds[0], self.is_measured[s] & self.is_measured[0], placed_points[s])
        coordinate_criterion(placed_points, self.is_measured, coordinate_mean, coordinate_largest)
        return columns

    def _true_targets(self, n_trials: int) -> Floats:
        """True positions of the targets for each of `n_trials` trials, (targets, 3, trials) [m]."""
        points = self.true_network.state.target_points
        return points if points.ndim == 3 else np.ascontiguousarray(np.repeat(points[:, :, None], n_trials, axis=2))

    def measured_point_error(self, clouds: Floats) -> Floats:
        """Rms distance (trials,) [um] between measured and true targets, after a rigid fit of each station's points.

        `clouds` (stations, targets, 3, trials) [m] are the points measured from each station. Stations whose targets
        determine no frame are left out. The result is NaN if no station remains.
        """
        trials = clouds.shape[3]
        truth, total, count = self._true_targets(trials), np.zeros(trials), 0
        aligned = np.empty_like(truth)
        for cloud, visible in zip(
            clouds[self.is_frame_determined], self.is_measured[self.is_frame_determined], strict=True
        ):
            align_rigidly(cloud, truth, visible, aligned)
            count += add_squared_errors(aligned, truth, visible, total)
        return MICROMETRES_PER_METRE * np.sqrt(total / count) if count else np.full(trials, np.nan)

    def adjusted_target_error(self, points: Floats) -> Floats:
        """Rms error (trials,) [um] of adjusted targets after a rigid fit of all targets to the true positions.

        `points` (targets, 3, trials) [m] are adjusted minus true coordinates. Undetermined targets (NaN) are left out.
        """
        is_determined = np.isfinite(points).all(axis=1)
        error = np.full(points.shape[2], np.nan)
        patterns = np.ones((1, len(points)), dtype=bool) if is_determined.all() else np.unique(is_determined, axis=1).T
        for pattern, fixed in zip(patterns, self._determines_frame(patterns), strict=True):
            if fixed:
                trials = np.flatnonzero(np.all(is_determined == pattern[:, None], axis=0))
                truth = np.ascontiguousarray(self._true_targets(len(error))[:, :, trials])
                moved, total = np.empty_like(truth), np.zeros(len(trials))
                align_rigidly(truth + points[:, :, trials], truth, pattern, moved)
                count = add_squared_errors(moved, truth, pattern, total)
                error[trials] = MICROMETRES_PER_METRE * np.sqrt(total / count)
        return error

    def method_independent_columns(self, trial_batch: TrialBatch) -> ResultColumns:
        """Columns that all methods share: disagreement and error before calibration, error with true parameters."""
        raw_clouds = self.mean_points_by_station(trial_batch.reading_deviations)
        perfect = self.mean_points_by_station(
            trial_batch.reading_deviations, self.true_network.construction, trial_batch.instrument_values
        )
        columns: ResultColumns = self.criteria_columns(raw_clouds, "before") if self.can_compute_criteria else {}
        columns["error_raw_um"] = self.measured_point_error(raw_clouds)
        columns["error_true_parameters_um"] = self.measured_point_error(perfect)
        return columns

    def method_columns(
        self,
        trial_batch: TrialBatch,
        estimates: CalibratedBatch,
        construction: GeometricErrorModel,
        effects: Sequence[Effect] = (),
    ) -> ResultColumns:
        """Columns of a method: disagreement of stations and errors of points, with readings corrected by its estimates.

        As in `calibrate` and `evaluate`, the estimated range errors of reflectors by incidence angle are corrected too.
        Other nuisance errors with a prior remain in the readings. The correction by true parameters corrects no
        nuisance error.
        """
        deviation = trial_batch.reading_deviations
        if estimates.incidence_parameters:
            deviation = deviation.copy()
            deviation[:, 0] -= self.true_network.incidence_errors(estimates.incidence_parameters)
        if effects:
            deviation = deviation - np.einsum(
                "ncqb,qb->ncb", self.true_network.effect_design(tuple(effects)), estimates.effect_values
            )
        corrected_clouds = self.mean_points_by_station(deviation, construction, estimates.instrument_values)
        columns: ResultColumns = self.criteria_columns(corrected_clouds, "after") if self.can_compute_criteria else {}
        columns["error_calibrated_um"] = self.measured_point_error(corrected_clouds)
        columns["target_error_um"] = self.adjusted_target_error(estimates.target_errors)
        return columns
