"""Calibrators of blocks of trials: the public one, recording by recording, and the batch network.

benchmarks/README.md has the run time of a trial by step (paper's workshop: 420 readings, 130 unknowns, one core).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.datum import InnerDatum
from ltsim.adjustment.evaluation.clouds import align_to_points
from ltsim.calibration.distance import calibrate_distance
from ltsim.calibration.network import calibrate_network
from ltsim.campaigns.network import BatchNetwork
from ltsim.campaigns.schema import CONVERGED, FAILED, FULL, STATUSES
from ltsim.campaigns.truth import CellTruth, TrialBatch
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import LtsimError
from ltsim.geometry.rigid import rigid_motion
from ltsim.physics.effects.effect import Effect
from ltsim.physics.effects.smr_incidence import SmrIncidence
from ltsim.physics.model.construction import Construction, ideal_construction
from ltsim.recordings.recording import Recording
from ltsim.recordings.references import ReferenceLengths
from ltsim.simulation.simulator import with_certificates

SUSPECT_M = 0.6e-3
SUSPECT_FACTOR = 10.0
"""Ratio to the usual deviation, and deviation [m], above which a pointing may be a gross error that only the full
solver rejects.
"""


@dataclass(frozen=True)
class Calibrated:
    """Results of the calibration of a block of trials."""

    values: Floats
    """Estimated instrument parameters, (I, p, B) [SI]."""
    sigma: Floats
    """Predicted standard deviations of the parameters, (I, p) or (I, p, B) [SI]."""
    points: Floats
    """Adjusted minus true targets in any frame, (T, 3, B) [m]; NaN for a method without targets."""
    chi2: Floats
    """Chi-square of each trial, (B,)."""
    status: Ints
    """Index into `STATUSES`, (B,)."""
    extra: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """Parameters of additional effects, (q, B) [SI]; empty for none."""
    extra_sigma: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """Standard deviations of these parameters, (q, 1) or (q, B) [SI]."""
    reflectors: Mapping[str, Floats] = field(default_factory=dict)
    """Parameters (14, B) [SI] of `smr-incidence` of each reflector with an estimated error, by name."""

    @property
    def estimates(self) -> tuple[Floats, Floats]:
        """All parameters, instrument by instrument and then effects, and their sigmas, each (I p + q, B) [SI]."""
        trials = len(self.chi2)
        sigma = self.sigma if self.sigma.ndim == 3 else self.sigma[:, :, None]
        parts = [(self.values, sigma), (self.extra, self.extra_sigma)]
        values = [v.reshape(-1, trials) for v, _ in parts]
        sigmas = [np.broadcast_to(s, v.shape).reshape(-1, trials) for v, s in parts]
        return np.concatenate(values), np.concatenate(sigmas)

    @classmethod
    def none(cls, truth: CellTruth, construction: Construction, effects: Sequence[Effect], trials: int) -> Calibrated:
        """Results of trials without a solution."""
        values = np.full((len(truth.recording.instruments), construction.n_parameters, trials), np.nan)
        points = np.full((*truth.state.target_points.shape[:2], trials), np.nan)
        extra = np.full((sum(len(e.parameters) for e in effects), trials), np.nan)
        lost = np.full(trials, STATUSES.index(FAILED))
        reflectors = {name: np.zeros((len(SmrIncidence.parameters), trials)) for name in truth.reflectors}
        return cls(values, values.copy(), points, np.full(trials, np.nan), lost, extra, extra.copy(), reflectors)

    def take(self, trial: int, source: Calibrated, place: int) -> None:
        """Copy of the result of one trial from another batch, including its sigmas if they differ by trial."""
        per_trial = ("sigma", "extra_sigma") if self.sigma.ndim == 3 else ()
        for name in ("chi2", "status", "values", "points", "extra", *per_trial):
            mine, theirs = getattr(self, name), getattr(source, name)
            if len(mine):
                shared = theirs.ndim < mine.ndim
                mine[..., trial] = theirs if shared else theirs[..., min(place, theirs.shape[-1] - 1)]
        for name, values in self.reflectors.items():
            if name in source.reflectors:
                values[:, trial] = source.reflectors[name][:, place]


@dataclass(frozen=True)
class Calibrator:
    """Base class of the calibrators that a campaign compares."""

    truth: CellTruth
    construction: Construction
    """Construction whose parameters are estimated."""
    effects: tuple[Effect, ...] = ()
    """Additional effects that are estimated."""
    method: str = "network"
    """Name of the method, as of `spec.Method`."""

    def calibrate(self, block: TrialBatch, wanted: Ints) -> Calibrated:
        """Calibrated block; trials that are not wanted may be NaN."""
        raise NotImplementedError

    def difference(self, block: TrialBatch, trial: int, calibrated: Calibrated) -> float:
        """Largest difference [sigma] of a trial from the public calibrator; NaN for that calibrator itself."""
        return float("nan")


def recording_of(truth: CellTruth, block: TrialBatch, trial: int) -> Recording:
    """Recording of a trial for any calibrator: readings and declared lengths, without truth."""
    recording = truth.recording.with_readings(truth.readings(block, trial))
    lengths = ReferenceLengths.of(recording)
    return with_certificates(recording, (lengths.length + block.gauge_error[:, trial]) / lengths.factor)


def placed_on(adjustment: Adjustment, goal: Floats) -> Floats:
    """Adjusted targets (T, 3) [m] after rigid alignment to others; NaN for undetermined ones.

    Ranges do not determine the handedness: of the two mirror images the one that fits better is used.
    """
    lost = np.isin(adjustment.recording.targets, adjustment.undetermined_targets)
    points = np.where(lost[:, None], np.nan, adjustment.state.target_points)
    if adjustment.recording.measured[:, 1:].any():
        return align_to_points(points, goal)
    hands = [align_to_points(points * hand, goal) for hand in (1.0, [1.0, 1.0, -1.0])]
    return min(hands, key=lambda moved: float(np.nansum((moved - goal) ** 2)))


def members(truth: CellTruth, sets: Ints) -> tuple[Bools, Floats]:
    """Flags (O, T) of the completely measured targets of each set, and weight (n,) of each pointing in its mean."""
    recording, targets = truth.recording, len(truth.recording.targets)
    whole = np.asarray(recording.measured.all(axis=1) & truth.recorded.all())
    key = sets * targets + recording.target
    count = np.bincount(key[whole], minlength=(int(sets.max()) + 1) * targets)
    return count.reshape(-1, targets) > 0, np.where(whole, 1.0 / np.maximum(count[key], 1), 0.0)


def suspects(deviation: Floats, local: Floats) -> Bools:
    """Flags (B,) of the trials with a pointing so far off that the full solver must decide about it.

    `deviation` (n, 3, B) are deviations of readings to points `local`, (n, 3, B) or (n, 3, 1) for common points.
    """
    across = np.hypot(local[:, 0], local[:, 1])
    miss = deviation * np.stack([np.ones_like(across), across, np.sqrt(np.sum(local**2, axis=1))], axis=1)
    far: Bools = np.max(np.abs(miss), axis=(0, 1)) > SUSPECT_M
    for trial in np.flatnonzero(far):
        size = np.linalg.norm(miss[:, :, trial], axis=1)
        far[trial] = size.max() > SUSPECT_FACTOR * np.median(size)
    return far


@dataclass(frozen=True)
class SerialCalibrator(Calibrator):
    """Serial calibrator: each recording is calibrated separately by `lt.calibrate`."""

    applied: bool = False
    """True if the applied corrections replace the estimates; sigmas remain those of the estimates."""

    def calibrate(self, block: TrialBatch, wanted: Ints) -> Calibrated:
        """Calibrated block; only the wanted trials are computed."""
        calibrated = Calibrated.none(self.truth, self.construction, self.effects, block.deviation.shape[2])
        for trial in wanted.tolist():
            try:
                adjustment, values, sigma = self.solved(recording_of(self.truth, block, trial))
            except LtsimError:
                continue
            if adjustment is None or not np.all(np.isfinite(values)):
                continue
            calibrated.values[:, :, trial], calibrated.sigma[:, :, trial] = values, sigma
            n_extra = len(calibrated.extra)
            calibrated.extra[:, trial] = adjustment.state.extra_parameters[:n_extra]
            calibrated.extra_sigma[:, trial] = np.sqrt(np.diag(adjustment.extra_covariance)[:n_extra])
            if self.method == "network":
                for name, parameters in adjustment.problem.model.incidence_parameters_by_reflector(
                    adjustment.state.extra_parameters
                ).items():
                    calibrated.reflectors[name][:, trial] = parameters
            true = self.truth.state.target_points
            calibrated.points[:, :, trial] = placed_on(adjustment, true) - true
            calibrated.chi2[trial], calibrated.status[trial] = adjustment.chi2, STATUSES.index(CONVERGED)
        return calibrated

    def solved(self, recording: Recording) -> tuple[Adjustment | None, Floats, Floats]:
        """Adjustment of a recording, and its instruments' parameters with standard deviations, (I, p) [SI] each."""
        if self.applied:
            calibration = calibrate_network(recording, self.construction, recommend_measurements=False)
            return calibration.adjustment, calibration.applied_values, calibration.sigma
        if self.method == "network":
            adjustment = adjust(recording, self.construction, effects=self.effects)
            adjustment.solution.require_success()
            variance = np.diag(adjustment.reduced_covariance)[adjustment.problem.unknowns.instrument_columns]
            return adjustment, adjustment.state.instrument_parameters, np.sqrt(variance)
        calibration = calibrate_distance(recording, self.construction, method=self.method, advise=False)
        return calibration.adjustment, calibration.estimates, calibration.sigma


@dataclass(frozen=True)
class BatchCalibrator(Calibrator):
    """Batch calibrator of trials with a common geometry; trials that do not converge use the public calibrator.

    Trials that need gross-error screening also use the public calibrator.
    """

    @cached_property
    def single(self) -> SerialCalibrator:
        """Public calibrator, for single trials."""
        return SerialCalibrator(self.truth, self.construction, self.effects, self.method)

    @cached_property
    def network(self) -> BatchNetwork:
        """Factorised network from which the targets are computed."""
        truth, built = self.truth, self.construction if self.method == "network" else ideal_construction()
        program, recorded = truth.program_of(built), truth.recorded
        return BatchNetwork(truth.recording, truth.state, built, program, self.effects, recorded=recorded)

    def together(self, block: TrialBatch, wanted: Ints) -> tuple[Calibrated, Bools]:
        """Calibrated block by the batch, and flags (B,) of the converged trials."""
        network, fit = self.network, self.network.fit(block.deviation, block.gauge_error)
        status, sigma = np.zeros(len(fit.chi2), dtype=np.int64), network.sigma_values
        extra_columns = slice(network.sizes[2], network.sizes[2] + len(fit.extra))
        extra = np.sqrt(np.diag(network.covariance)[extra_columns, None]) if self.effects else np.zeros((0, 1))
        further = fit.extra, extra, fit.reflectors
        return Calibrated(fit.values, sigma, fit.points, fit.chi2, status, *further), fit.converged

    def calibrate(self, block: TrialBatch, wanted: Ints | None = None) -> Calibrated:
        """Calibrated block; `wanted` (default all) are the trials that may use the single calibrator."""
        wanted = np.arange(len(block.trials)) if wanted is None else wanted
        calibrated, good = self.together(block, wanted)
        enough = good & ~suspects(block.deviation, self.truth.sightings.local[:, :, None])
        alone = wanted[~enough[wanted]]
        per_trial = self.single.calibrate(block, alone) if len(alone) else calibrated
        for trial in alone.tolist():
            calibrated.take(trial, per_trial, trial)
            calibrated.status[trial] = STATUSES.index(FAILED if per_trial.status[trial] else FULL)
        return calibrated

    def difference(self, block: TrialBatch, trial: int, calibrated: Calibrated) -> float:
        """Largest difference [sigma] of parameters and targets of a trial from the single calibrator.

        Targets are compared after a rigid fit, relative to their standard deviations in that frame. NaN for a failed
        trial.
        """
        other = self.single.calibrate(block, np.array([trial]))
        if other.status[trial] != 0:
            return float("nan")
        values = np.abs(other.values[:, :, trial] - calibrated.values[:, :, trial]) / calibrated.sigma
        truth = self.truth.state.target_points
        batch = truth + calibrated.points[:, :, trial]
        gap = np.abs(align_to_points(truth + other.points[:, :, trial], batch) - batch) / self.sigma_targets
        return float(max(values.max(initial=0.0), np.nanmax(gap)))

    @cached_property
    def sigma_targets(self) -> Floats:
        """Standard deviation (T, 3) [m] of the adjusted targets after a rigid fit to other coordinates."""
        start, end = self.network.sizes[:2]
        covariance = self.network.covariance[start:end, start:end]
        columns = np.arange(end - start).reshape(-1, 3)
        points = self.truth.state.target_points
        datum = InnerDatum.from_columns(rigid_motion(points, points.mean(axis=0)), columns, covariance.__matmul__)
        blocks = datum.transform_covariance(covariance[columns[:, :, None], columns[:, None, :]], columns)
        return np.sqrt(np.einsum("tii->ti", blocks))
