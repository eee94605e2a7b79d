"""The calibrators of a campaign behind one door: a block of trials in, calibrated trials out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ltsim.adjust.adjustment import Adjustment, adjust
from ltsim.arrays import Floats, Ints
from ltsim.calibrate import calibrate_distance
from ltsim.campaign.cell import fitted_construction, fitted_effects
from ltsim.campaign.engine import CONVERGED, FAILED, STATUSES, Calibrated, Engine, recording_of
from ltsim.campaign.spec import Method
from ltsim.campaign.truth import Block, Truth
from ltsim.effects.effect import Effect
from ltsim.errors import LtsimError
from ltsim.evaluate.clouds import on_points
from ltsim.model.construction import Construction


class Calibrator(Protocol):
    """What a campaign needs of a method."""

    @property
    def construction(self) -> Construction:
        """Whose parameters are estimated."""
        ...

    def calibrate(self, block: Block, wanted: Ints) -> Calibrated:
        """Calibrate a block; trials that are not wanted may be left out (NaN)."""
        ...

    def difference(self, block: Block, trial: int, found: Calibrated) -> float:
        """Largest difference [sigma] of a trial from the calibrator that users have; NaN where that is itself."""
        ...


@dataclass(frozen=True)
class Single:
    """One recording after the other, by the calibrator that users have."""

    truth: Truth
    construction: Construction
    effects: tuple[Effect, ...]
    method: str

    def calibrate(self, block: Block, wanted: Ints) -> Calibrated:
        """Calibrate the wanted trials of a block."""
        trials = block.deviation.shape[2]
        instruments = len(self.truth.recording.instruments)
        found = Calibrated(
            np.full((instruments, self.construction.size, trials), np.nan),
            np.full((instruments, self.construction.size, trials), np.nan),
            np.full((*self.truth.state.points.shape, trials), np.nan),
            np.full(trials, np.nan),
            np.full(trials, STATUSES.index(FAILED)),
        )
        for trial in wanted:
            self._one(block, int(trial), found)
        return found

    def _one(self, block: Block, trial: int, found: Calibrated) -> None:
        recording = recording_of(self.truth, block, trial)
        adjustment: Adjustment | None = None
        try:
            if self.method == "network":
                adjustment = adjust(recording, self.construction, effects=self.effects)
                adjustment.solution.require_success()
                values, sigma = adjustment.state.instrument, network_sigma(adjustment)
            else:
                calibration = calibrate_distance(recording, self.construction, method=self.method, advise=False)
                adjustment = calibration.adjustment
                values, sigma = calibration.values, calibration.sigma
        except LtsimError:
            return
        if adjustment is None or not np.all(np.isfinite(values)):
            return
        found.values[:, :, trial], found.sigma[:, :, trial] = values, sigma
        found.points[:, :, trial] = on_true_points(adjustment.state.points, self.truth)
        found.chi2[trial] = adjustment.chi2
        found.status[trial] = STATUSES.index(CONVERGED)

    def difference(self, block: Block, trial: int, found: Calibrated) -> float:
        """It is what others are compared with."""
        return float("nan")


def network_sigma(adjustment: Adjustment) -> Floats:
    """Standard deviations (I, p) [SI] of the instruments' parameters."""
    at = adjustment.problem.layout.instrument
    variance = np.diag(adjustment.kept_covariance)[at]
    return np.sqrt(variance)


def on_true_points(points: Floats, truth: Truth) -> Floats:
    """Adjusted targets (T, 3) [m] less true ones, after a rigid fit."""
    gap: Floats = on_points(points, truth.state.points) - truth.state.points
    return gap


@dataclass(frozen=True)
class Batch:
    """The batched network adjustment."""

    engine: Engine

    @property
    def construction(self) -> Construction:
        """Whose parameters are estimated."""
        return self.engine.construction

    def calibrate(self, block: Block, wanted: Ints) -> Calibrated:
        """Calibrate a block whole."""
        return self.engine.calibrate(block)

    def difference(self, block: Block, trial: int, found: Calibrated) -> float:
        """Largest difference [sigma] from the full solver."""
        return self.engine.difference(block, trial, found)


def calibrator_of(method: Method, truth: Truth) -> Calibrator:
    """The calibrator that a campaign file asks for."""
    construction, effects = fitted_construction(method), fitted_effects(method)
    if method.solver == "single" or method.method != "network":
        return Single(truth, construction, effects, method.method)
    return Batch(Engine(truth, construction, effects))
