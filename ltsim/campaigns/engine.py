"""Calibrators of blocks of trials: the one that users have, recording after recording, and the batched network.

Where the time of a trial goes (paper's workshop: 420 readings, 130 unknowns, one core): see benchmarks/README.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.datum import InnerDatum
from ltsim.adjustment.evaluation.clouds import on_points
from ltsim.calibration.distance import calibrate_distance
from ltsim.calibration.network import calibrate_network
from ltsim.campaigns.network import BatchNetwork
from ltsim.campaigns.schema import CONVERGED, FAILED, FULL, STATUSES
from ltsim.campaigns.truth import Block, CellTruth
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import LtsimError
from ltsim.geometry.rigid import rigid_motion
from ltsim.physics.effects.effect import Effect
from ltsim.physics.effects.smr_incidence import SmrIncidence
from ltsim.physics.model.construction import Construction, ideal
from ltsim.recordings.recording import Recording
from ltsim.recordings.references import ReferenceLengths
from ltsim.simulation.simulator import certified_by

SUSPECT = 0.6e-3
SUSPECT_FACTOR = 10.0
"""A pointing this far off [m], and this many times further than the usual one, the full solver may screen out."""


@dataclass(frozen=True)
class Calibrated:
    """Calibrated trials of a block."""

    values: Floats
    """(I, p, B) [SI]."""
    sigma: Floats
    """Predicted standard deviations, (I, p) or (I, p, B) [SI]."""
    points: Floats
    """Adjusted targets less true ones, in any frame; NaN where the method gives none, (T, 3, B) [m]."""
    chi2: Floats
    """(B,)."""
    status: Ints
    """Index into `STATUSES`, (B,)."""
    extra: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """Parameters of further effects; empty for none, (q, B) [SI]."""
    extra_sigma: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """Standard deviations of these, (q, 1) or (q, B) [SI]."""
    reflectors: Mapping[str, Floats] = field(default_factory=dict)
    """Parameters (14, B) [SI] of `smr-incidence` of each reflector whose error is estimated, by its name."""

    @property
    def estimates(self) -> tuple[Floats, Floats]:
        """(I p + q, B) [SI] each: all parameters of a trial, instrument after instrument, and their sigmas."""
        trials = len(self.chi2)
        sigma = self.sigma if self.sigma.ndim == 3 else self.sigma[:, :, None]
        parts = [(self.values, sigma), (self.extra, self.extra_sigma)]
        values = [v.reshape(-1, trials) for v, _ in parts]
        sigmas = [np.broadcast_to(s, v.shape).reshape(-1, trials) for v, s in parts]
        return np.concatenate(values), np.concatenate(sigmas)

    @classmethod
    def none(cls, truth: CellTruth, construction: Construction, effects: Sequence[Effect], trials: int) -> Calibrated:
        """Trials without a result, with a sigma per trial."""
        values = np.full((len(truth.recording.instruments), construction.size, trials), np.nan)
        points = np.full((*truth.state.points.shape[:2], trials), np.nan)
        extra = np.full((sum(len(e.parameters) for e in effects), trials), np.nan)
        lost = np.full(trials, STATUSES.index(FAILED))
        reflectors = {name: np.zeros((len(SmrIncidence.parameters), trials)) for name in truth.reflectors}
        return cls(values, values.copy(), points, np.full(trials, np.nan), lost, extra, extra.copy(), reflectors)

    def take(self, trial: int, source: Calibrated, place: int) -> None:
        """Copy one trial from another batch, with its sigmas where each trial has its own."""
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
    """Further effects that are estimated."""
    method: str = "network"
    """Name of the method, as of `spec.Method`."""

    def calibrate(self, block: Block, wanted: Ints) -> Calibrated:
        """Calibrate a block; trials that are not wanted may be left out (NaN)."""
        raise NotImplementedError

    def difference(self, block: Block, trial: int, calibrated: Calibrated) -> float:
        """Largest difference [sigma] of a trial from the calibrator that users have; NaN where that is itself."""
        return float("nan")


def recording_of(truth: CellTruth, block: Block, trial: int) -> Recording:
    """Recording of a trial, as any calibrator takes it: readings and declared lengths, no truth."""
    recording = truth.recording.with_readings(truth.readings(block, trial))
    lengths = ReferenceLengths.of(recording)
    return certified_by(recording, (lengths.length + block.gauge_error[:, trial]) / lengths.factor)


def placed_on(adjustment: Adjustment, goal: Floats) -> Floats:
    """Adjusted targets (T, 3) [m] moved rigidly onto others; NaN for those that the readings do not determine.

    Ranges have no hand: of two mirror images the one that fits better counts.
    """
    lost = np.isin(adjustment.recording.targets, adjustment.undetermined_targets)
    points = np.where(lost[:, None], np.nan, adjustment.state.points)
    if adjustment.recording.measured[:, 1:].any():
        return on_points(points, goal)
    hands = [on_points(points * hand, goal) for hand in (1.0, [1.0, 1.0, -1.0])]
    return min(hands, key=lambda moved: float(np.nansum((moved - goal) ** 2)))


def members(truth: CellTruth, sets: Ints) -> tuple[Bools, Floats]:
    """Flags (O, T): True where a set saw a target completely; and weight (n,) of each pointing in its set's mean."""
    recording, targets = truth.recording, len(truth.recording.targets)
    whole = np.asarray(recording.measured.all(axis=1) & truth.recorded.all())
    key = sets * targets + recording.target
    count = np.bincount(key[whole], minlength=(int(sets.max()) + 1) * targets)
    return count.reshape(-1, targets) > 0, np.where(whole, 1.0 / np.maximum(count[key], 1), 0.0)


def suspects(deviation: Floats, local: Floats) -> Bools:
    """(B,) trials with a pointing so far off that the full solver's screening must decide about it.

    Deviations (n, 3, B) are those of readings to points `local` (n, 3, B), or (n, 3, 1) where all trials share them.
    """
    across = np.hypot(local[:, 0], local[:, 1])
    miss = deviation * np.stack([np.ones_like(across), across, np.sqrt(np.sum(local**2, axis=1))], axis=1)
    far: Bools = np.max(np.abs(miss), axis=(0, 1)) > SUSPECT
    for trial in np.flatnonzero(far):
        size = np.linalg.norm(miss[:, :, trial], axis=1)
        far[trial] = size.max() > SUSPECT_FACTOR * np.median(size)
    return far


@dataclass(frozen=True)
class Single(Calibrator):
    """Serial engine: each recording calibrated on its own by `lt.calibrate`."""

    applied: bool = False
    """Flag: corrections applied to readings replace the estimates; the sigmas stay those of the estimates."""

    def calibrate(self, block: Block, wanted: Ints) -> Calibrated:
        """Calibrate the wanted trials of a block."""
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
            calibrated.extra[:, trial] = adjustment.state.extra[:n_extra]
            calibrated.extra_sigma[:, trial] = np.sqrt(np.diag(adjustment.extra_covariance)[:n_extra])
            if self.method == "network":
                for name, parameters in adjustment.problem.model.reflectors(adjustment.state.extra).items():
                    calibrated.reflectors[name][:, trial] = parameters
            true = self.truth.state.points
            calibrated.points[:, :, trial] = placed_on(adjustment, true) - true
            calibrated.chi2[trial], calibrated.status[trial] = adjustment.chi2, STATUSES.index(CONVERGED)
        return calibrated

    def solved(self, recording: Recording) -> tuple[Adjustment | None, Floats, Floats]:
        """The adjustment of a recording, its instruments' parameters and their standard deviations (I, p) [SI]."""
        if self.applied:
            calibration = calibrate_network(recording, self.construction, advise=False)
            return calibration.adjustment, calibration.applied, calibration.sigma
        if self.method == "network":
            adjustment = adjust(recording, self.construction, effects=self.effects)
            adjustment.solution.require_success()
            variance = np.diag(adjustment.reduced_covariance)[adjustment.problem.unknowns.instrument]
            return adjustment, adjustment.state.instrument, np.sqrt(variance)
        calibration = calibrate_distance(recording, self.construction, method=self.method, advise=False)
        return calibration.adjustment, calibration.values, calibration.sigma


@dataclass(frozen=True)
class Engine(Calibrator):
    """Network calibrations of trials that share a geometry, a block at once.

    Trials for which that is not enough go to the calibrator that users have.
    """

    @cached_property
    def single(self) -> Single:
        """The calibrator that users have."""
        return Single(self.truth, self.construction, self.effects, self.method)

    @cached_property
    def network(self) -> BatchNetwork:
        """The factorised network that gives the targets."""
        truth, built = self.truth, self.construction if self.method == "network" else ideal()
        program, recorded = truth.program_of(built), truth.recorded
        return BatchNetwork(truth.recording, truth.state, built, program, self.effects, recorded=recorded)

    def together(self, block: Block, wanted: Ints) -> tuple[Calibrated, Bools]:
        """The block by the batch, and which of its trials (B,) have converged."""
        network, fit = self.network, self.network.fit(block.deviation, block.gauge_error)
        status, sigma = np.zeros(len(fit.chi2), dtype=np.int64), network.sigma_values
        extra_columns = slice(network.sizes[2], network.sizes[2] + len(fit.extra))
        extra = np.sqrt(np.diag(network.covariance)[extra_columns, None]) if self.effects else np.zeros((0, 1))
        further = fit.extra, extra, fit.reflectors
        return Calibrated(fit.values, sigma, fit.points, fit.chi2, status, *further), fit.converged

    def calibrate(self, block: Block, wanted: Ints | None = None) -> Calibrated:
        """Calibrate a block; the wanted trials, by default all, are those that the single calibrator is asked for."""
        wanted = np.arange(len(block.trials)) if wanted is None else wanted
        calibrated, good = self.together(block, wanted)
        enough = good & ~suspects(block.deviation, self.truth.sightings.local[:, :, None])
        alone = wanted[~enough[wanted]]
        per_trial = self.single.calibrate(block, alone) if len(alone) else calibrated
        for trial in alone.tolist():
            calibrated.take(trial, per_trial, trial)
            calibrated.status[trial] = STATUSES.index(FAILED if per_trial.status[trial] else FULL)
        return calibrated

    def difference(self, block: Block, trial: int, calibrated: Calibrated) -> float:
        """Largest difference [sigma] of a calibrated trial from the single calibrator's, over parameters and targets.

        Targets are compared after a rigid fit, by their standard deviations in that frame. NaN for a failed one.
        """
        other = self.single.calibrate(block, np.array([trial]))
        if other.status[trial] != 0:
            return float("nan")
        values = np.abs(other.values[:, :, trial] - calibrated.values[:, :, trial]) / calibrated.sigma
        truth = self.truth.state.points
        batch = truth + calibrated.points[:, :, trial]
        gap = np.abs(on_points(truth + other.points[:, :, trial], batch) - batch) / self.sigma_targets
        return float(max(values.max(initial=0.0), np.nanmax(gap)))

    @cached_property
    def sigma_targets(self) -> Floats:
        """Standard deviation (T, 3) [m] of the adjusted targets after a rigid fit to any others."""
        start, end = self.network.sizes[:2]
        covariance = self.network.covariance[start:end, start:end]
        columns = np.arange(end - start).reshape(-1, 3)
        points = self.truth.state.points
        datum = InnerDatum.tied_to(rigid_motion(points, points.mean(axis=0)), columns, covariance.__matmul__)
        blocks = datum.transformed(covariance[columns[:, :, None], columns[:, None, :]], columns)
        return np.sqrt(np.einsum("tii->ti", blocks))
