"""Network adjustment of all trials in one network geometry: one factorisation, exact residuals and gradients.

The normal matrix N of the nominal (error-free) network is inverted once. A step is ``inverse @ gradient`` for all
trials in one matrix product. The gradient is computed from the exact residuals at the current unknowns of each trial,
so that the iteration converges to the optimum of the trial for any N. The matrix N only determines the speed: a step
reduces the distance to the optimum by a factor of about 1e-3, since errors of micrometres in metres hardly change the
design matrix.

The residual of a pointing is the difference between the measured point and the target. The derivative of an ideal
tracker's readings converts this difference to readings, with an error of 1e-5 standard deviations of a reading.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ltsim.campaigns.kernels import network_gradient
from ltsim.campaigns.nominal_network import NominalNetwork
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.physics.model.incidence import IncidenceErrors
from ltsim.solve.design import to_dense

MAX_DISTANCE_TO_OPTIMUM = 5e-5
"""Largest distance of a converged trial from the optimum. The distance is the norm of the remaining step, with each
unknown divided by its standard deviation. A trial with a larger distance is calibrated again by `lt.calibrate`."""
MAX_NETWORK_FIT_STEPS = 8
"""Largest number of Gauss-Newton steps in the network adjustment of a trial."""
MIN_ASSUMED_CONVERGENCE_RATE = 1e-3
"""Smallest assumed convergence rate, that is, ratio of the distances to the optimum after and before a step. A larger
rate is estimated from the last two steps."""


@dataclass(frozen=True)
class BatchFit:
    """Adjusted networks of a batch of trials; the last axis of each array is the trial."""

    target_increments: Floats
    """Adjusted minus nominal coordinates of the targets, (targets, 3, trials) [m]."""
    instrument_values: Floats
    """Estimated instrument parameters, (instruments, parameters, trials) [SI]."""
    effect_values: Floats
    """Estimated parameters of the effects in addition to the instrument parameters, (effect parameters, trials) [SI].
    """
    incidence_parameters: Mapping[str, Floats]
    """Estimated parameters (14, trials) [SI] of the effect `smr-incidence` (range error by incidence angle), by name of
    the reflector."""
    chi2: Floats
    """Chi-square of the adjustment of each trial, (trials,)."""
    distance_to_optimum: Floats
    """Estimated distance to the optimum after the last step, (trials,). It is the norm of the remaining step, with each
    unknown divided by its standard deviation."""

    @property
    def has_converged(self) -> Bools:
        """Mask (trials,) of the converged trials; a distance of NaN counts as not converged."""
        return self.distance_to_optimum < MAX_DISTANCE_TO_OPTIMUM


def multiply_by_trial(matrix: Floats, columns: Floats) -> Floats:
    """Product (rows, trials) of `matrix` with the column of each trial in `columns` (terms, trials).

    All trials share a matrix (rows, terms); a matrix of shape (trials, rows, terms) differs between trials.
    """
    if matrix.ndim == 2:
        return matrix @ columns
    return np.matmul(matrix, columns.T[:, :, None])[:, :, 0].T


@dataclass(frozen=True)
class BatchNetwork(NominalNetwork):
    """Network linearised at nominal (error-free) readings, for the adjustment of many trials together."""

    def gauss_newton_step(self, gradient: Floats) -> Floats:
        """Gauss-Newton step (unknowns, trials); `gradient` is the negative gradient of half the sum of squares."""
        return self.covariance @ gradient

    @cached_property
    def _gradient_inputs(self) -> tuple[np.ndarray, ...]:
        """Index arrays, sight vectors, rotations, derivatives and weights that the compiled gradient function needs."""
        recording, state = self.recording, self.state
        arm = state.target_points[recording.target] - state.station_positions[recording.station]
        places = (recording.instrument, recording.station, recording.target)
        return (
            *places,
            arm,
            np.ascontiguousarray(state.station_rotations),
            self._point_derivatives,
            1.0 / self.reading_sigmas,
        )

    @cached_property
    def _bench_tested_reflector_change(self) -> Floats | None:
        """Expected change (pointings, 3, 1) [m, rad, rad] of readings by bench-tested reflectors; None without any."""
        if not any(
            isinstance(error, IncidenceErrors) and error.mean_parameters.any() for error in self.model.nuisance_errors
        ):
            return None
        return self.model.change_by_extra_parameters(
            self._sightings_in_floor_plan_frame, self.state_with_zero_parameters.extra_parameters
        )[:, :, None]

    def fit_trials(self, reading_deviations: Floats, length_errors: Floats | None = None) -> BatchFit:
        """Adjusted network of each trial.

        `reading_deviations` (pointings, 3, trials) [m, rad, rad] are readings minus nominal readings. `length_errors`
        (lengths, trials) [m] are declared minus true reference lengths; None without reference lengths.
        """
        if self._bench_tested_reflector_change is not None:
            reading_deviations = reading_deviations - self._bench_tested_reflector_change
        x, predicted = self._first_newton_step(reading_deviations, length_errors)
        last_costs = np.full(x.shape[1], np.inf)
        gradient, cost = np.empty_like(x), np.empty(x.shape[1])
        for _ in range(2, MAX_NETWORK_FIT_STEPS + 1):
            self._write_gradient_and_cost(x, reading_deviations, length_errors, predicted, gradient, cost)
            step = self.gauss_newton_step(gradient)
            x += step
            squared = np.maximum(np.einsum("kb,kb->b", step, gradient), 0.0)
            remainder = np.sqrt(squared) * np.maximum(MIN_ASSUMED_CONVERGENCE_RATE, np.sqrt(squared / last_costs))
            if not np.any(remainder >= MAX_DISTANCE_TO_OPTIMUM):
                break
            last_costs = squared
        _, points, values, extra = self.split_unknowns(x)
        effects, reflectors = (
            extra[: self.model.n_effect_parameters],
            self.model.incidence_parameters_by_reflector(extra),
        )
        return BatchFit(points, values, effects, reflectors, cost - squared, remainder)

    @property
    def _has_additional_parameters(self) -> bool:
        """True if effects or nuisance errors are estimated in addition to the instrument parameters."""
        return self.block_end_indices[3] > self.block_end_indices[2]

    @cached_property
    def _affected_readings(self) -> tuple[Ints, Floats, Floats]:
        """Indices of the readings that effects change, and the design matrix of the effects, plain and whitened.

        Nuisance errors that the recording declares count as effects. The indices (affected readings,) refer to the
        flattened readings. The designs have the shape (affected readings, effect parameters), or (trials, affected
        readings, effect parameters) if each trial has a separate geometry.
        """
        flattened = self._additional_parameter_design.reshape(self.reading_sigmas.size, -1)
        indices = np.flatnonzero(flattened.any(axis=1))
        return indices, flattened[indices], flattened[indices] / self.reading_sigmas.reshape(-1, 1)[indices]

    @cached_property
    def _first_step_matrices(self) -> tuple[Floats, Floats, Floats]:
        """Matrices of the first Newton step of an adjustment, and matrix of the readings predicted after this step.

        The step is the first matrix times the reading deviations, plus the second times the residuals of all other
        observations. The third matrix, (readings, unknowns), does not contain effects, because their changes are
        subtracted from the readings.
        """
        use, design = self.problem.is_used_reading, np.zeros((3 * len(self.recording), self.block_end_indices[-1]))
        design[use.ravel()] = to_dense(self._whitened_design_and_residuals()[0])[
            : int(use.sum()), self.column_order
        ]  # whitened; zero for unmeasured readings
        # An unmeasured reading has no row; its prediction starts at the nominal reading.
        predicting = (
            np.where(use, self.problem.reading_sigmas, 0.0).reshape(-1, 1) * design[:, : self.block_end_indices[2]]
        )
        by_reading = self.covariance @ (design / self.reading_sigmas.reshape(-1, 1)).T
        return by_reading, self.covariance @ self._non_reading_design[0].T, predicting

    def _first_newton_step(self, reading_deviations: Floats, length_errors: Floats | None) -> tuple[Floats, Floats]:
        """First step (unknowns, trials), and predicted minus nominal readings (pointings, 3, trials) after it.

        `reading_deviations` are readings minus nominal readings, `length_errors` (lengths, trials) [m] declared minus
        true reference lengths.
        """
        nowhere = np.zeros((self.block_end_indices[-1], reading_deviations.shape[2]))
        other_residuals = self._non_reading_residuals(nowhere, length_errors)
        if self._factorisation.sparse_design is not None:
            return self._sparse_first_step(self._factorisation.sparse_design, reading_deviations, other_residuals)
        by_reading, by_other, predicting = self._first_step_matrices
        x = by_reading @ reading_deviations.reshape(len(predicting), -1) + by_other @ other_residuals
        return x, (predicting @ x[: self.block_end_indices[2]]).reshape(reading_deviations.shape)

    def _sparse_first_step(
        self, design: sp.csr_array, reading_deviations: Floats, other_residuals: Floats
    ) -> tuple[Floats, Floats]:
        """First step (unknowns, trials), and predicted minus nominal readings (pointings, 3, trials) after it.

        The network has the sparse whitened `design` (rows, unknowns) of all observations. `other_residuals` (rows,
        trials) are the whitened residuals of the observations except readings.
        """
        use, order = self.problem.is_used_reading, self.column_order
        sigma = self.problem.reading_sigmas[use][:, None]
        x = self.covariance @ (design.T @ np.concatenate([reading_deviations[use] / sigma, other_residuals]))[order]
        without_effects, predicted = np.zeros_like(x), np.zeros_like(reading_deviations)
        without_effects[order[: self.block_end_indices[2]]] = x[: self.block_end_indices[2]]
        predicted[use] = sigma * (design @ without_effects)[: len(sigma)]
        return x, predicted

    def _write_gradient_and_cost(
        self,
        increments: Floats,
        reading_deviations: Floats,
        length_errors: Floats | None,
        predicted: Floats,
        gradient: Floats,
        cost: Floats,
    ) -> None:
        """Negative gradient (unknowns, trials) and sum of squares (trials,), written to `gradient` and `cost`.

        `increments` (unknowns, trials) are the unknowns minus their nominal values. `predicted` (pointings, 3, trials)
        are predicted minus nominal readings; they are improved by one Newton step.
        """
        gradient[:], cost[:] = 0.0, 0.0
        pose, points, values, extra = self.split_unknowns(increments)
        if self._has_additional_parameters:
            rows, design, whitened = self._affected_readings
            reading_deviations = reading_deviations.copy()
            reading_deviations.reshape(-1, len(cost))[rows] -= multiply_by_trial(design, extra)
        by_pose, by_points, by_values, by_extra = self.split_unknowns(gradient)
        residual = np.empty(reading_deviations.shape)
        arrays = (self.kinematic_chain, *self._gradient_inputs, reading_deviations, pose, points, values, predicted)
        network_gradient(*arrays, residual, by_pose, by_points, by_values, cost)
        if self._has_additional_parameters:
            by_extra += multiply_by_trial(np.swapaxes(whitened, -2, -1), residual.reshape(-1, len(cost))[rows])
        residuals = self._non_reading_residuals(increments, length_errors)
        gradient += multiply_by_trial(np.swapaxes(self._non_reading_design[0], -2, -1), residuals)
        cost += np.sum(residuals**2, axis=0)

    def _non_reading_residuals(self, increments: Floats, length_errors: Floats | None) -> Floats:
        """Whitened residuals (rows, trials) of reference lengths, control points, levels, priors and datum.

        The residuals of lengths are exact, all others are linear in `increments` (unknowns, trials), the unknowns minus
        their nominal values.
        """
        design, nominal = self._non_reading_design
        residuals = nominal - multiply_by_trial(design, increments)
        gauge = self.problem.gauge_rows
        if len(gauge):
            moved = self.split_unknowns(increments)[1]
            arm = (
                self.state.target_points[gauge.first_targets] - self.state.target_points[gauge.second_targets]
            ).reshape(len(gauge), 3, -1)
            change = moved[gauge.first_targets] - moved[gauge.second_targets]
            length = np.sqrt(np.sum(arm**2, axis=1))
            linear = length + np.sum(arm * change, axis=1) / length
            bent = linear - np.sqrt(np.sum((arm + change) ** 2, axis=1))
            if length_errors is not None:
                bent += length_errors
            residuals[: len(gauge)] += gauge.decorrelate(bent)
        return residuals
