"""Calibrators of batches of trials: calibration of each recording by `lt.calibrate`, and batch network adjustment.

The file benchmarks/README.md lists the run time of each step per trial (paper's workshop: 420 readings, 130 unknowns,
one core).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.datum import InnerConstraintDatum
from ltsim.adjustment.evaluation.clouds import align_to_points
from ltsim.calibration.distance import calibrate_distance
from ltsim.calibration.network import calibrate_network
from ltsim.campaigns.batch_network import BatchNetwork
from ltsim.campaigns.schema import BATCH_CONVERGED, FULL_SOLVER, TRIAL_STATUSES, WITHOUT_RESULT
from ltsim.campaigns.true_network import TrialBatch, TrueNetwork
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import LtsimError
from ltsim.geometry.rigid import rigid_motion_jacobian
from ltsim.physics.effects.effect import Effect
from ltsim.physics.effects.smr_incidence import SmrIncidence
from ltsim.physics.model.construction import GeometricErrorModel, ideal_construction
from ltsim.recordings.recording import Recording
from ltsim.recordings.references import ReferenceLengths
from ltsim.simulation.simulator import with_certified_reference_lengths

MIN_GROSS_ERROR_DISPLACEMENT_M = 0.6e-3
"""Limit of the displacement [m] of a measured point from its nominal position. If this limit and
`MIN_GROSS_ERROR_DISPLACEMENT_RATIO` are exceeded, the trial may contain a gross error, and is calibrated by
`lt.calibrate`, which rejects gross errors."""
MIN_GROSS_ERROR_DISPLACEMENT_RATIO = 10.0
"""Limit of the ratio of the largest to the median displacement of measured points from their nominal positions. If it
is exceeded, the trial may contain a gross error."""


@dataclass(frozen=True)
class CalibratedBatch:
    """Results of a calibration method for each trial of a batch."""

    instrument_values: Floats
    """Estimated instrument parameters, (instruments, parameters, trials) [SI]."""
    instrument_sigmas: Floats
    """Standard deviations of the instrument parameters [SI]: (instruments, parameters) if all trials share them, else
    (instruments, parameters, trials)."""
    target_errors: Floats
    """Adjusted minus true coordinates of the targets, (targets, 3, trials) [m], both in the same frame; NaN for a
    calibration by distances, which adjusts no targets."""
    chi2: Floats
    """Chi-square of each trial, (trials,)."""
    status_indices: Ints
    """Status of each trial, (trials,), as index into `TRIAL_STATUSES`."""
    effect_values: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """Estimated parameters of effects, (effect parameters, trials) [SI]; (0, 0) if no effect is estimated."""
    effect_sigmas: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """Standard deviations of the parameters of effects [SI]: (effect parameters, 1) if all trials share them, else
    (effect parameters, trials)."""
    incidence_parameters: Mapping[str, Floats] = field(default_factory=dict)
    """Estimated parameters, (14, trials) [SI], of the effect `smr-incidence` (range error by incidence angle), by name
    of the reflector; only reflectors whose error is estimated."""

    @property
    def estimates_and_sigmas(self) -> tuple[Floats, Floats]:
        """All estimated parameters, and their standard deviations, each (all parameters, trials) [SI].

        The rows are the parameters of each instrument, followed by those of the effects.
        """
        n_trials = len(self.chi2)
        sigma = self.instrument_sigmas if self.instrument_sigmas.ndim == 3 else self.instrument_sigmas[:, :, None]
        value_groups = [(self.instrument_values, sigma), (self.effect_values, self.effect_sigmas)]
        flat_values = [v.reshape(-1, n_trials) for v, _ in value_groups]
        sigmas = [np.broadcast_to(s, v.shape).reshape(-1, n_trials) for v, s in value_groups]
        return np.concatenate(flat_values), np.concatenate(sigmas)

    @classmethod
    def from_failed_trials(
        cls, true_network: TrueNetwork, construction: GeometricErrorModel, effects: Sequence[Effect], n_trials: int
    ) -> CalibratedBatch:
        """Results for `n_trials` trials without a solution: all estimates are NaN, and the status is `failed`."""
        instrument_values = np.full(
            (len(true_network.recording.instruments), construction.n_parameters, n_trials), np.nan
        )
        points = np.full((*true_network.state.target_points.shape[:2], n_trials), np.nan)
        effect_values = np.full((sum(len(e.parameters) for e in effects), n_trials), np.nan)
        is_lost = np.full(n_trials, TRIAL_STATUSES.index(WITHOUT_RESULT))
        reflectors = {name: np.zeros((len(SmrIncidence.parameters), n_trials)) for name in true_network.reflector_masks}
        return cls(
            instrument_values,
            instrument_values.copy(),
            points,
            np.full(n_trials, np.nan),
            is_lost,
            effect_values,
            effect_values.copy(),
            reflectors,
        )

    def copy_results_of_trial(self, trial: int, source_batch: CalibratedBatch, source_trial: int) -> None:
        """Copying of the results of trial `source_trial` of `source_batch` to trial `trial` of this batch, in place.

        Standard deviations are copied only if they differ between trials.
        """
        per_trial = ("instrument_sigmas", "effect_sigmas") if self.instrument_sigmas.ndim == 3 else ()
        for name in ("chi2", "status_indices", "instrument_values", "target_errors", "effect_values", *per_trial):
            mine, theirs = getattr(self, name), getattr(source_batch, name)
            if len(mine):
                shared = theirs.ndim < mine.ndim
                mine[..., trial] = theirs if shared else theirs[..., min(source_trial, theirs.shape[-1] - 1)]
        for name, values in self.incidence_parameters.items():
            if name in source_batch.incidence_parameters:
                values[:, trial] = source_batch.incidence_parameters[name][:, source_trial]


@dataclass(frozen=True)
class TrialCalibrator:
    """Base class of the calibrators of a campaign, one for each calibration method."""

    true_network: TrueNetwork
    """True network geometry of the calibrated trials."""
    construction: GeometricErrorModel
    """Geometric error model of the instrument, whose parameters are estimated."""
    effects: tuple[Effect, ...] = ()
    """Effects that are estimated in addition to the instrument parameters."""
    method: str = "network"
    """Name of the calibration method in the campaign file."""

    def calibrate(self, trial_batch: TrialBatch, trial_indices: Ints) -> CalibratedBatch:
        """Results for the trials of a batch; those of trials whose index is not in `trial_indices` may be NaN."""
        raise NotImplementedError

    def largest_solver_difference(self, trial_batch: TrialBatch, trial: int, results: CalibratedBatch) -> float:
        """Largest difference between `results` of this calibrator for a trial and `lt.calibrate`, in sigmas.

        The difference is NaN if this calibrator itself calls `lt.calibrate`.
        """
        return float("nan")


def recording_of_trial(true_network: TrueNetwork, trial_batch: TrialBatch, trial: int) -> Recording:
    """Recording of the trial with index `trial` in a batch: readings and declarations, without true values."""
    recording = true_network.recording.with_readings(true_network.trial_readings(trial_batch, trial))
    lengths = ReferenceLengths.from_recording(recording)
    return with_certified_reference_lengths(
        recording, (lengths.lengths + trial_batch.length_errors[:, trial]) / lengths.expansion_factors
    )


def align_targets(adjustment: Adjustment, reference_points: Floats) -> Floats:
    """Adjusted targets (targets, 3) [m] after rigid alignment to `reference_points`; NaN for undetermined targets.

    If only ranges were measured, the network and its mirror image are equally possible; the one that fits better is
    used.
    """
    is_lost = np.isin(adjustment.recording.targets, adjustment.undetermined_targets)
    points = np.where(is_lost[:, None], np.nan, adjustment.state.target_points)
    if adjustment.recording.is_measured[:, 1:].any():
        return align_to_points(points, reference_points)
    hands = [align_to_points(points * hand, reference_points) for hand in (1.0, [1.0, 1.0, -1.0])]
    return min(hands, key=lambda moved: float(np.nansum((moved - reference_points) ** 2)))


def measured_targets_and_weights(true_network: TrueNetwork, set_numbers: Ints) -> tuple[Bools, Floats]:
    """Mask (sets, targets) of the targets measured completely in each set of pointings, and weights (pointings,).

    `set_numbers` (pointings,) is the number of the set (one station, or one station and face) of each pointing. The
    weight of a pointing is its share in the mean point of its set and target.
    """
    recording, targets = true_network.recording, len(true_network.recording.targets)
    is_complete = np.asarray(recording.is_measured.all(axis=1) & true_network.is_recorded_observable.all())
    key = set_numbers * targets + recording.target
    n_members = np.bincount(key[is_complete], minlength=(int(set_numbers.max()) + 1) * targets)
    return n_members.reshape(-1, targets) > 0, np.where(is_complete, 1.0 / np.maximum(n_members[key], 1), 0.0)


def possible_gross_error_mask(reading_deviations: Floats, local_points: Floats) -> Bools:
    """Mask (trials,) of the trials that may contain a gross error, and are therefore calibrated by `lt.calibrate`.

    `reading_deviations` (pointings, 3, trials) are readings minus nominal readings. `local_points` are the targets in
    the instruments' frames [m], (pointings, 3, trials), or (pointings, 3, 1) if all trials share them.
    """
    horizontal = np.hypot(local_points[:, 0], local_points[:, 1])
    miss = reading_deviations * np.stack(
        [np.ones_like(horizontal), horizontal, np.sqrt(np.sum(local_points**2, axis=1))], axis=1
    )
    far: Bools = np.max(np.abs(miss), axis=(0, 1)) > MIN_GROSS_ERROR_DISPLACEMENT_M
    for trial in np.flatnonzero(far):
        size = np.linalg.norm(miss[:, :, trial], axis=1)
        far[trial] = size.max() > MIN_GROSS_ERROR_DISPLACEMENT_RATIO * np.median(size)
    return far


@dataclass(frozen=True)
class SerialCalibrator(TrialCalibrator):
    """Calibrator that calibrates each recording separately by `lt.calibrate` (full solver)."""

    uses_applied_corrections: bool = False
    """True to return the corrections that `ltsim calibrate` applies, in place of the estimates; the standard deviations
    of the estimates are returned in both cases."""

    def calibrate(self, trial_batch: TrialBatch, trial_indices: Ints) -> CalibratedBatch:
        """Results for the trials of a batch; only the trials with the indices `trial_indices` are calibrated."""
        calibrated = CalibratedBatch.from_failed_trials(
            self.true_network, self.construction, self.effects, trial_batch.reading_deviations.shape[2]
        )
        for trial in trial_indices.tolist():
            try:
                adjustment, values, sigma = self.adjust_recording(
                    recording_of_trial(self.true_network, trial_batch, trial)
                )
            except LtsimError:
                continue
            if adjustment is None or not np.all(np.isfinite(values)):
                continue
            calibrated.instrument_values[:, :, trial], calibrated.instrument_sigmas[:, :, trial] = values, sigma
            n_extra = len(calibrated.effect_values)
            calibrated.effect_values[:, trial] = adjustment.state.extra_parameters[:n_extra]
            calibrated.effect_sigmas[:, trial] = np.sqrt(np.diag(adjustment.effect_covariance)[:n_extra])
            if self.method == "network":
                for name, parameters in adjustment.problem.model.incidence_parameters_by_reflector(
                    adjustment.state.extra_parameters
                ).items():
                    calibrated.incidence_parameters[name][:, trial] = parameters
            true = self.true_network.state.target_points
            calibrated.target_errors[:, :, trial] = align_targets(adjustment, true) - true
            calibrated.chi2[trial], calibrated.status_indices[trial] = (
                adjustment.chi2,
                TRIAL_STATUSES.index(BATCH_CONVERGED),
            )
        return calibrated

    def adjust_recording(self, recording: Recording) -> tuple[Adjustment | None, Floats, Floats]:
        """Adjustment of a recording, its estimated instrument parameters, and their standard deviations.

        The arrays have the shape (instruments, parameters) [SI]. The adjustment is None for a calibration by distances,
        which adjusts no network.
        """
        if self.uses_applied_corrections:
            calibration = calibrate_network(recording, self.construction, recommend_measurements=False)
            return calibration.adjustment, calibration.applied_values, calibration.sigma
        if self.method == "network":
            adjustment = adjust(recording, self.construction, effects=self.effects)
            adjustment.solution.require_success()
            variance = np.diag(adjustment.retained_covariance)[adjustment.problem.unknowns.instrument_columns]
            return adjustment, adjustment.state.instrument_parameters, np.sqrt(variance)
        calibration = calibrate_distance(recording, self.construction, method=self.method, advise=False)
        return calibration.adjustment, calibration.estimates, calibration.sigma


@dataclass(frozen=True)
class BatchCalibrator(TrialCalibrator):
    """Calibrator that processes all trials in one network geometry together.

    Trials that do not converge, or that may contain gross errors, are calibrated one by one by `lt.calibrate`.
    """

    @cached_property
    def serial_calibrator(self) -> SerialCalibrator:
        """Calibrator by `lt.calibrate`, for trials that do not converge in the batch, and for verification."""
        return SerialCalibrator(self.true_network, self.construction, self.effects, self.method)

    @cached_property
    def batch_network(self) -> BatchNetwork:
        """Network with nominal readings, whose inverted normal matrix is used to adjust all trials."""
        true_network, built = self.true_network, self.construction if self.method == "network" else ideal_construction()
        program, recorded = true_network.kinematic_chain(built), true_network.is_recorded_observable
        return BatchNetwork(
            true_network.recording, true_network.state, built, program, self.effects, is_adjusted_observable=recorded
        )

    def calibrate_batch(self, trial_batch: TrialBatch, trial_indices: Ints) -> tuple[CalibratedBatch, Bools]:
        """Results of the joint calibration of the trials of a batch, and mask (trials,) of the converged trials.

        `trial_indices` are the trials for which slow computations, trial by trial, are permitted.
        """
        network, fit = (
            self.batch_network,
            self.batch_network.fit_trials(trial_batch.reading_deviations, trial_batch.length_errors),
        )
        status, sigma = np.zeros(len(fit.chi2), dtype=np.int64), network.parameter_sigmas
        extra_columns = slice(network.block_end_indices[2], network.block_end_indices[2] + len(fit.effect_values))
        effect_sigmas = np.sqrt(np.diag(network.covariance)[extra_columns, None]) if self.effects else np.zeros((0, 1))
        other_arrays = fit.effect_values, effect_sigmas, fit.incidence_parameters
        return CalibratedBatch(
            fit.instrument_values, sigma, fit.target_increments, fit.chi2, status, *other_arrays
        ), fit.has_converged

    def calibrate(self, trial_batch: TrialBatch, trial_indices: Ints | None = None) -> CalibratedBatch:
        """Results for the trials of a batch; slow `lt.calibrate` is used only for `trial_indices`, if given."""
        trial_indices = np.arange(len(trial_batch.trial_numbers)) if trial_indices is None else trial_indices
        calibrated, good = self.calibrate_batch(trial_batch, trial_indices)
        is_sufficient = good & ~possible_gross_error_mask(
            trial_batch.reading_deviations, self.true_network.sightings.local_points[:, :, None]
        )
        single_trials = trial_indices[~is_sufficient[trial_indices]]
        per_trial = self.serial_calibrator.calibrate(trial_batch, single_trials) if len(single_trials) else calibrated
        for trial in single_trials.tolist():
            calibrated.copy_results_of_trial(trial, per_trial, trial)
            calibrated.status_indices[trial] = TRIAL_STATUSES.index(
                WITHOUT_RESULT if per_trial.status_indices[trial] else FULL_SOLVER
            )
        return calibrated

    def largest_solver_difference(self, trial_batch: TrialBatch, trial: int, results: CalibratedBatch) -> float:
        """Largest difference of parameters and targets of a trial between `results` and `lt.calibrate`, in sigmas.

        Targets are compared after a rigid fit, relative to their standard deviations after this fit. The difference is
        NaN for a failed trial.
        """
        serial_batch = self.serial_calibrator.calibrate(trial_batch, np.array([trial]))
        if serial_batch.status_indices[trial] != 0:
            return float("nan")
        value_differences = (
            np.abs(serial_batch.instrument_values[:, :, trial] - results.instrument_values[:, :, trial])
            / results.instrument_sigmas
        )
        truth = self.true_network.state.target_points
        batch = truth + results.target_errors[:, :, trial]
        gap = (
            np.abs(align_to_points(truth + serial_batch.target_errors[:, :, trial], batch) - batch) / self.target_sigmas
        )
        return float(max(value_differences.max(initial=0.0), np.nanmax(gap)))

    @cached_property
    def target_sigmas(self) -> Floats:
        """Standard deviation (targets, 3) [m] of the adjusted targets after a rigid fit to other coordinates."""
        start, end = self.batch_network.block_end_indices[:2]
        covariance = self.batch_network.covariance[start:end, start:end]
        columns = np.arange(end - start).reshape(-1, 3)
        points = self.true_network.state.target_points
        datum = InnerConstraintDatum.from_columns(
            rigid_motion_jacobian(points, points.mean(axis=0)), columns, covariance.__matmul__
        )
        blocks = datum.transform_covariance(covariance[columns[:, :, None], columns[:, None, :]], columns)
        return np.sqrt(np.einsum("tii->ti", blocks))
