"""Trials calibrated one recording after the other, by the calibrators that users have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.arrays import Floats, Ints
from ltsim.calibration import calibrate_distance, calibrate_network
from ltsim.campaigns.engine import CONVERGED, Calibrated, recording_of
from ltsim.campaigns.truth import Block, Truth
from ltsim.effects.effect import Effect
from ltsim.errors import LtsimError
from ltsim.model.construction import Construction


@dataclass(frozen=True)
class Single:
    """One recording after the other, by the calibrator that users have."""

    truth: Truth
    construction: Construction
    effects: tuple[Effect, ...]
    method: str
    applied: bool = False
    """What is taken out of readings stands in place of the estimates, which keep their sigmas."""

    def calibrate(self, block: Block, wanted: Ints) -> Calibrated:
        """Calibrate the wanted trials of a block."""
        found = Calibrated.none(self.truth, self.construction, self.effects, block.deviation.shape[2])
        for trial in wanted:
            self._one(block, int(trial), found)
        return found

    def _one(self, block: Block, trial: int, found: Calibrated) -> None:
        recording = recording_of(self.truth, block, trial)
        adjustment: Adjustment | None = None
        try:
            if self.applied:
                calibration = calibrate_network(recording, self.construction, advise=False)
                adjustment, values, sigma = calibration.adjustment, calibration.applied, calibration.sigma
            elif self.method == "network":
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
        if self.effects:
            found.extra_sigma[:, trial] = np.sqrt(np.diag(adjustment.extra_covariance))
        found.put(trial, adjustment, self.truth.state.points, CONVERGED)

    def difference(self, block: Block, trial: int, found: Calibrated) -> float:
        """It is what others are compared with."""
        return float("nan")


def network_sigma(adjustment: Adjustment) -> Floats:
    """Standard deviations (I, p) [SI] of the instruments' parameters."""
    at = adjustment.problem.unknowns.instrument
    variance = np.diag(adjustment.kept_covariance)[at]
    return np.sqrt(variance)
