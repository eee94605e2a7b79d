"""The paper's distance objective for all trials with a common geometry.

As for the network, the normal matrix at the nominal network gives the steps of all trials, and the gradient is exact
for the readings and parameters of each trial, so that the iteration converges to the optimum of the trial. The nominal
network decides which combinations are estimated and which remain zero.

For least absolute deviations each step is the solution of a linear program with the matrix and combinations of the
trial, because small differences between matrices may change the optimal vertex. Equation 9 as printed estimates every
combination that changes a compared distance. Weakly determined combinations change much, so that each step uses the
matrix of the trial too.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ltsim.adjustment.prior import prior_sigmas
from ltsim.calibration.distance import DISTANCE_METHODS
from ltsim.calibration.distance_solver import (
    ComparedDistances,
    DistanceEstimate,
    mean_deviation_rows,
    pair_difference_rows,
    solve_distances,
    solve_equation_9,
)
from ltsim.calibration.objective import DistanceProblem, SetDistances
from ltsim.campaigns.cloud_kernels import distance_forces, station_means
from ltsim.campaigns.engine import BatchCalibrator, Calibrated, members
from ltsim.campaigns.kernels import points_of, pull_points
from ltsim.campaigns.network import BatchFit
from ltsim.campaigns.program import ChainProgram
from ltsim.campaigns.truth import TrialBatch
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.geometry.polar import wrap
from ltsim.solve.absolute import solve_least_absolute

CAP = 10
CAP_OF_WEAK = 30
"""Largest number of steps; the second value applies to weakly determined combinations by least squares."""
CONVERGED_CHANGE = 3e-5
"""Largest change of an unknown, in prior sigmas, of a converged trial; the remaining error is a hundredth of it."""


@dataclass(frozen=True)
class BatchDistance(BatchCalibrator):
    """Batch calibration by distances (`distance`, `equation-9`).

    By least squares, or by least absolute deviations with `-l1`.
    """

    method: str = "distance"

    @property
    def absolute(self) -> bool:
        """True for an estimate by least absolute deviations."""
        return self.method.endswith("-l1")

    @property
    def as_printed(self) -> bool:
        """True if every combination that changes the objective is estimated."""
        return self.method.startswith("equation-9")

    @cached_property
    def problem(self) -> DistanceProblem:
        """Distance objective at the nominal network."""
        recording = self.truth.recording
        return DistanceProblem(recording, self.construction, prior_sigmas(recording, self.construction))

    @cached_property
    def estimate(self) -> DistanceEstimate:
        """Estimate at nominal readings: zero, its covariance, and the combinations that are not estimated."""
        if self.as_printed:
            return solve_equation_9(self.problem, "absolute" if self.absolute else "squares")
        return solve_distances(self.problem, DISTANCE_METHODS[self.method])

    @cached_property
    def _distances(self) -> SetDistances:
        return self.problem.distances_at(np.zeros(self.problem.prior_sigma.size))

    @cached_property
    def _determined(self) -> Floats:
        """Estimated combinations, (q, k)."""
        excluded = np.array([d.vector for d in self.estimate.undetermined_combinations]).reshape(
            -1, self.problem.prior_sigma.size
        )
        return np.linalg.svd(np.eye(excluded.shape[1]) - excluded.T @ excluded)[0][
            :, : excluded.shape[1] - len(excluded)
        ]

    @cached_property
    def step_matrix(self) -> Floats:
        """Matrix (q, q) from half a gradient to a step in prior sigmas, within the estimated combinations."""
        rows, determined = self._mean_rows, self._determined
        normal = rows.unknown_derivatives.T @ rows.unknown_derivatives
        return determined @ np.linalg.inv(determined.T @ normal @ determined) @ determined.T

    @cached_property
    def _mean_rows(self) -> ComparedDistances:
        return mean_deviation_rows(self.problem, self._distances)

    @cached_property
    def _pair_rows(self) -> ComparedDistances:
        return pair_difference_rows(self.problem, self._distances)

    @property
    def _program(self) -> ChainProgram:
        return self.truth.program_of(self.construction)

    @cached_property
    def _membership(self) -> tuple[Ints, Bools, Floats, Ints]:
        """Set of each pointing, what each set saw, each pointing's share in its mean, pairs of the gauge."""
        gauge, sets = self.problem.reference_lengths, self.problem.set_numbers
        visible, share = members(self.truth, sets)
        return sets, visible, share, np.stack([gauge.first, gauge.second], axis=1).reshape(-1, 2)

    def together(self, block: TrialBatch, wanted: Ints) -> tuple[Calibrated, Bools]:
        """Calibrated block with the network adjusted from the corrected readings, and flags of converged trials."""
        values, moved = self._squares(block) if self.method == "distance" else self._per_trial(block, wanted)
        fit = self._adjusted(block, values)
        spread = np.sqrt(np.diag(self.estimate.covariance)).reshape(values.shape[:2]) * self.problem.prior_sigma
        status = np.zeros(len(moved), dtype=np.int64)
        return Calibrated(values, spread, fit.points, fit.chi2, status), (moved < CONVERGED_CHANGE) & fit.converged

    def _squares(self, block: TrialBatch) -> tuple[Floats, Floats]:
        """Parameters (I, p, B) [SI], and largest change (B,) in the last step in prior sigmas."""
        deviation, prior = block.deviation, self.problem.prior_sigma[:, :, None]
        sets, visible, share, gauge = self._membership
        recording, trials = self.truth.recording, deviation.shape[2]
        length = self.problem.reference_lengths.length[:, None] + block.gauge_error
        values = np.zeros((*self.problem.prior_sigma.shape, trials))
        points, moved = np.empty(deviation.shape), np.full(trials, np.inf)
        for _ in range(CAP):
            points_of(self._program, recording.instrument, deviation, values, points)
            clouds = np.zeros((*visible.shape, 3, trials))
            station_means(points, sets, recording.target, share, clouds)
            forces, gradient = np.zeros_like(clouds), np.zeros_like(values)
            distance_forces(clouds, visible, gauge, length, forces, np.zeros(trials))
            membership = (recording.instrument, sets, recording.target, share)
            pull_points(self._program, *membership, deviation, values, forces, gradient)
            step = self.step_matrix @ (gradient * prior).reshape(-1, trials)
            values += step.reshape(values.shape) * prior
            moved = np.abs(step).max(axis=0)
            if not np.any(moved >= CONVERGED_CHANGE):
                break
        return values, moved

    def _per_trial(self, block: TrialBatch, wanted: Ints) -> tuple[Floats, Floats]:
        """Parameters and largest change, as `_squares`, of the wanted trials, each by its own matrix.

        Inf for other trials.
        """
        prior, trials = self.problem.prior_sigma[:, :, None], block.deviation.shape[2]
        unknowns, moved = np.zeros((self.problem.prior_sigma.size, trials)), np.full(trials, np.inf)
        readings = {trial: self.truth.recording.readings + block.deviation[:, :, trial] for trial in wanted.tolist()}
        determined = {
            trial: self._determined if self.as_printed else self._combinations(trial_readings)
            for trial, trial_readings in readings.items()
        }
        for iteration in range(CAP if self.absolute else CAP_OF_WEAK):
            active = wanted[moved[wanted] >= CONVERGED_CHANGE]
            if not len(active):
                break
            residual = self._residual(block, unknowns[:, active].reshape(*prior.shape[:2], -1) * prior, active)
            for gap, trial in zip(residual.T, active.tolist(), strict=True):
                by_unknown = self.problem.parameter_derivatives(readings[trial], unknowns[:, trial])
                design = self._pair_rows.comparison_matrix @ (by_unknown @ determined[trial])
                if self.absolute:  # every step but the first is short
                    step = solve_least_absolute(design, -gap, start=np.zeros(design.shape[1]) if iteration else None)
                else:
                    step = np.linalg.solve(design.T @ design, -design.T @ gap)
                unknowns[:, trial] += determined[trial] @ step
                moved[trial] = np.abs(determined[trial] @ step).max()
        return unknowns.reshape(*prior.shape[:2], trials) * prior, moved

    def _combinations(self, readings: Floats) -> Floats:
        """Combinations (q, k) of a trial: the axes of its objective that are nearest to the estimated ones."""
        design = self._mean_rows.comparison_matrix @ self.problem.parameter_derivatives(
            readings, np.zeros(self.problem.prior_sigma.size)
        )
        axes = np.linalg.eigh(design.T @ design)[1]
        nearest = np.argsort(np.linalg.norm(self._determined.T @ axes, axis=0))[len(axes) - self._determined.shape[1] :]
        return axes[:, nearest]

    def _residual(self, block: TrialBatch, values: Floats, trials: Ints) -> Floats:
        """Terms (R, B) of eq. 9 for some trials at their parameters (I, p, B)."""
        deviation, values = (np.ascontiguousarray(a) for a in (block.deviation[:, :, trials], values))
        points = np.empty(deviation.shape)
        points_of(self._program, self.truth.recording.instrument, deviation, values, points)
        change = self.problem.distances_of_points(points) - self._distances.lengths[:, None]
        rows, gauge = self._pair_rows, self.problem.reference_lengths
        certified = gauge.decorrelate(block.gauge_error[:, trials])
        by_gauge = rows.noise_derivatives[:, rows.noise_derivatives.shape[1] - len(gauge) :]
        return rows.residuals[:, None] + rows.comparison_matrix @ change + by_gauge @ certified

    def _adjusted(self, block: TrialBatch, values: Floats) -> BatchFit:
        deviation = block.deviation
        points = np.empty(deviation.shape)
        points_of(self._program, self.truth.recording.instrument, deviation, values, points)
        x, y, z = points[:, 0], points[:, 1], points[:, 2]
        flat = np.hypot(x, y)
        back = (self.truth.recording.face == 2)[:, None]
        azimuth, elevation = np.arctan2(y, x), np.arctan2(z, flat)
        raw = np.stack(
            [np.hypot(flat, z), azimuth + np.where(back, np.pi, 0.0), np.where(back, np.pi - elevation, elevation)],
            axis=1,
        )
        corrected = raw - self.truth.recording.readings[:, :, None]
        corrected[:, 1:] = wrap(corrected[:, 1:])
        return self.network.fit(corrected, block.gauge_error)
