"""Eq. 9 of the paper as printed, for trials that share a geometry: no combination is left at zero.

`BatchDistance` with every combination that changes a compared distance at all. Weak combinations move far, so each
step takes the trial's own matrix, of least squares too.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ltsim.arrays import Floats, Ints
from ltsim.calibration.distance_solver import Estimate, solve_equation_9
from ltsim.campaigns.distance import CLOSED, BatchDistance
from ltsim.campaigns.single import Single
from ltsim.campaigns.truth import Block

CAP = 30


@dataclass(frozen=True)
class BatchEquation9(BatchDistance):
    """The minimum of eq. 9: `method` is `distance` for least squares, `distance-l1` for least absolute deviations."""

    @cached_property
    def single(self) -> Single:
        """The calibrator that users have."""
        return Single(self.truth, self.construction, (), self.method.replace("distance", "equation-9"))

    @cached_property
    def estimate(self) -> Estimate:
        """At nominal readings."""
        return solve_equation_9(self.problem, "squares" if self.method == "distance" else "absolute")

    def _own(self, readings: Floats) -> Floats:
        """All combinations (q, k) that the objective sees."""
        return self._kept

    def _squares(self, block: Block, wanted: Ints) -> tuple[Floats, Floats]:
        """Parameters (I, p, B) [SI], and the largest last move (B,) in prior sigmas; inf where not wanted."""
        prior, trials = self.problem.prior_sigma[:, :, None], block.deviation.shape[2]
        unknowns, moved = np.zeros((self.problem.prior_sigma.size, trials)), np.full(trials, np.inf)
        for _ in range(CAP):
            active = wanted[moved[wanted] >= CLOSED]
            if not len(active):
                break
            residual = self._residual(block, unknowns[:, active].reshape(*prior.shape[:2], -1) * prior, active)
            for gap, trial in zip(residual.T, active.tolist(), strict=True):
                by_unknown = self.problem.by_parameter(self._readings(block, trial), unknowns[:, trial])
                design = self._pair_rows.compare @ (by_unknown @ self._kept)
                step = self._kept @ np.linalg.solve(design.T @ design, -design.T @ gap)
                unknowns[:, trial] += step
                moved[trial] = np.abs(step).max()
        return unknowns.reshape(*prior.shape[:2], trials) * prior, moved
