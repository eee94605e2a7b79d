"""Network adjustment of all trials in one network geometry: one factorisation, exact residuals and gradients.

The normal matrix N of the nominal network is inverted once. A step is ``inverse @ gradient`` for all trials in one
matrix product. The gradient is computed from the exact residuals at the state of each trial, so that the iteration
converges to the optimum of the trial for any N. N only determines the speed: a step reduces the distance to the optimum
by a factor of about 1e-3, since errors of micrometres in metres hardly change the design matrix.

The residual of a pointing is the difference between the measured point and the target. The derivative of an ideal
tracker's readings converts this difference to readings, with an error of 1e-5 standard deviations of a reading.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ltsim.adjustment.frame import DeclaredFrame
from ltsim.adjustment.problem import NetworkProblem
from ltsim.campaigns.batch_fit import MAX_DISTANCE_TO_OPTIMUM, BatchFit
from ltsim.campaigns.chain_program import ChainProgram
from ltsim.campaigns.kernels import network_gradient
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import SetupError
from ltsim.geometry.rigid import pose_design
from ltsim.physics.effects.effect import Effect
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.physics.model.incidence import IncidenceErrors
from ltsim.physics.model.measurement import MeasurementModel, NetworkState, Prediction, sightings_at_state
from ltsim.recordings.recording import Recording
from ltsim.scene.sightings import Sightings
from ltsim.solve.chain import inverse_from_cholesky
from ltsim.solve.design import cholesky_where_determined, scale_to_unit_diagonal, to_dense

MAX_NETWORK_FIT_STEPS = 8
"""Largest number of Gauss-Newton steps in the network adjustment of a trial."""
MIN_STEP_CONTRACTION_RATIO = 1e-3
"""Smallest assumed ratio of the distances to the optimum after and before a step; a larger ratio is estimated from the
last two steps."""


@dataclass(frozen=True)
class SharedDerivatives:
    """Derivatives of one network that are reused for another network with the same set-up and pointings."""

    network: BatchNetwork
    """Network from which the derivatives are taken; it has the same set-up and pointings but other coordinates."""
    point_derivatives: Floats
    """Derivative of the nominal readings with respect to the targets in the instruments' frames, (pointings, 3, 3)."""
    parameter_derivatives: Floats
    """Derivative of the nominal readings with respect to the instrument parameters, (pointings, 3, parameters)."""


@dataclass(frozen=True)
class BatchNetwork:
    """Network with nominal (error-free) readings, for the adjustment of a batch of trials."""

    recording: Recording
    """Recording with nominal readings, which an ideal tracker reads at `state`."""
    state: NetworkState
    """Nominal state of the network: true poses of the stations and true targets."""
    construction: GeometricErrorModel
    """Geometric error model of the instruments; its parameters are estimated."""
    chain_program: ChainProgram
    """Kinematic chain of the geometric error model, linearised at the nominal readings."""
    effects: tuple[Effect, ...] = ()
    """Additional effects that are estimated; the nuisance errors that the recording declares are estimated too."""
    shared_derivatives: SharedDerivatives | None = None
    """Derivatives of another network with the same set-up, to be reused; None if they are to be computed."""
    is_adjusted_observable: Bools = field(default_factory=lambda: np.ones(3, dtype=bool))
    """Mask (3,) of the observables (range, azimuth, elevation) that are adjusted."""

    @cached_property
    def model(self) -> MeasurementModel:
        """Measurement model, the same as in the adjustment of a single recording."""
        model = MeasurementModel(self.recording, self.construction, self.effects)
        if self.shared_derivatives is not None:
            vars(model)["nuisance_errors"] = self.shared_derivatives.network.model.nuisance_errors
        return model

    @cached_property
    def problem(self) -> NetworkProblem:
        """Least-squares problem at the nominal state, with the observations of the adjustment of a single recording."""
        if self.shared_derivatives is None:
            return NetworkProblem.from_model(
                self.model, reading_mask=np.tile(self.is_adjusted_observable, (len(self.recording), 1))
            )
        return self.shared_derivatives.network.problem.with_other_positions(self.model)

    @cached_property
    def nominal_state(self) -> NetworkState:
        """Nominal state of the network, with all instrument and effect parameters zero."""
        n_instruments = len(self.recording.instruments)
        return NetworkState(
            self.state.station_positions,
            self.state.station_rotations,
            self.state.target_points,
            np.zeros((n_instruments, self.construction.n_parameters)),
            np.zeros(self.model.n_extra_parameters),
        )

    @cached_property
    def block_end_indices(self) -> tuple[int, int, int, int]:
        """End indices of poses, targets, instrument parameters and effect parameters in the vector of unknowns."""
        unknowns = self.problem.unknowns
        pose = unknowns.pose_columns.size
        targets = pose + unknowns.target_columns.size
        end_of_parameters = targets + unknowns.instrument_columns.size
        return pose, targets, end_of_parameters, end_of_parameters + unknowns.effect_columns.size

    @cached_property
    def column_order(self) -> Ints:
        """Columns (unknowns,) of the design matrix of `problem`, reordered to poses, targets, parameters, effects."""
        if self.shared_derivatives is not None:
            return self.shared_derivatives.network.column_order
        unknowns = self.problem.unknowns
        column_groups = (
            unknowns.pose_columns,
            unknowns.target_columns,
            unknowns.instrument_columns,
            unknowns.effect_columns,
        )
        order = np.concatenate([part.ravel() for part in column_groups])
        if len(np.unique(order)) != unknowns.n_columns:
            raise SetupError('the batch solver does not support stations over a common mark; use solver = "single"')
        return order

    @cached_property
    def _non_reading_design(self) -> tuple[Floats, Floats]:
        """Whitened design (rows, unknowns) of all observations except readings, and nominal residuals (rows, 1)."""
        design, residual = self._whitened_design_and_residuals
        n_readings = int(self.problem.is_used_reading.sum())
        return design[n_readings:, self.column_order], residual[n_readings:, None]

    @cached_property
    def _whitened_design_and_residuals(self) -> tuple[Floats, Floats]:
        """Whitened design (rows, unknowns) of all observations of `problem`, and their nominal residuals (rows,)."""
        prediction = (
            self.problem.model.linearise(self.nominal_state)
            if self.shared_derivatives is None
            else self._nominal_prediction(self.shared_derivatives)
        )
        system = self.problem.linear_system(
            self.nominal_state, replace(prediction, extra_derivatives=self._additional_parameter_design)
        )
        return to_dense(system.design), system.whitened_residuals

    def _nominal_prediction(self, derivatives: SharedDerivatives) -> Prediction:
        """Predicted readings at the nominal state and their derivatives, equal to `MeasurementModel.linearise`."""
        recording, state = self.recording, self.state
        by_target = derivatives.point_derivatives @ np.swapaxes(state.station_rotations, 1, 2)[recording.station]
        arm = state.target_points[recording.target] - state.station_positions[recording.station]
        by_pose = pose_design(by_target, arm)
        return Prediction(
            recording.readings, by_pose, by_target, derivatives.parameter_derivatives, np.zeros((len(recording), 3, 0))
        )

    @cached_property
    def cholesky_and_scales(self) -> tuple[Floats, Floats]:
        """Lower Cholesky factor of the nominal normal matrix, scaled to a unit diagonal, and the scales (unknowns,).

        SetupError is raised for undetermined unknowns.
        """
        design = self._whitened_design_and_residuals[0]
        normal = (design.T @ design).take(self.column_order, 0).take(self.column_order, 1)
        unit, scale = scale_to_unit_diagonal(normal, np.diag(normal))
        roots, determined = cholesky_where_determined(unit[None])
        if not determined.all():
            raise SetupError(
                "the network of the scenario does not determine all unknowns: give priors or more pointings"
            )
        return roots[0], scale

    @cached_property
    def covariance(self) -> Floats:
        """Covariance (unknowns, unknowns) [SI] at the nominal state; the first pose defines the datum."""
        root, scale = self.cholesky_and_scales
        return inverse_from_cholesky(root) * np.outer(scale, scale)

    @cached_property
    def parameter_sigmas(self) -> Floats:
        """Standard deviation (instruments, parameters) [SI] of the instrument parameters after adjustment."""
        (_, start, end, _), (root, scale) = self.block_end_indices, self.cholesky_and_scales
        inverse_block = inverse_from_cholesky(
            root[start:, start:]
        )  # the inverse for the last unknowns needs only the last corner of the factor
        roots = np.sqrt(np.diag(inverse_block)[: end - start]) * scale[start:end]
        return roots.reshape(self.problem.unknowns.instrument_columns.shape)

    def gauss_newton_step(self, gradient: Floats) -> Floats:
        """Gauss-Newton step (unknowns, trials) for the negative gradient of half the sum of squares."""
        return self.covariance @ gradient

    @cached_property
    def _sight_geometry(self) -> tuple[np.ndarray, ...]:
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
    def _point_derivatives(self) -> Floats:
        """Derivative (pointings, 3, 3) of an ideal tracker's readings by the target in the instrument's frame."""
        return (
            sightings_at_state(self.recording, self.state).local_derivatives
            if self.shared_derivatives is None
            else self.shared_derivatives.point_derivatives
        )

    @cached_property
    def _network_frame(self) -> DeclaredFrame:
        return (
            DeclaredFrame.from_recording(self.recording)
            if self.shared_derivatives is None
            else self.shared_derivatives.network._network_frame
        )

    @cached_property
    def _floor_plan_sightings(self) -> Sightings:
        """Pointings in the frame of the floor plan, in which the directions of nests are declared."""
        state = self.nominal_state
        motion = self._network_frame.motion_to_floor_plan(state.station_positions, state.station_rotations)
        if motion is not None:
            turn, shift = motion
            places = {
                "station_positions": state.station_positions @ turn.T + shift,
                "target_points": state.target_points @ turn.T + shift,
            }
            state = replace(state, station_rotations=turn @ state.station_rotations, **places)
        if self.shared_derivatives is None:
            return self.model.sightings(state)
        return self.shared_derivatives.network._floor_plan_sightings.with_geometry(
            state.station_positions, state.station_rotations, state.target_points
        )

    @cached_property
    def _additional_parameter_design(self) -> Floats:
        """Change (pointings, 3, effect parameters) of the readings per unit of each effect or nuisance parameter."""
        if not self.model.extra_effects:
            return np.zeros((len(self.recording), 3, 0))
        return self.model.extra_design(self._floor_plan_sightings)

    @cached_property
    def _expected_reading_change(self) -> Floats | None:
        """Expected change (pointings, 3, 1) of readings by bench-tested reflectors; None without such reflectors."""
        if not any(
            isinstance(error, IncidenceErrors) and error.mean_parameters.any() for error in self.model.nuisance_errors
        ):
            return None
        return self.model.change_by_extra_parameters(self._floor_plan_sightings, self.nominal_state.extra_parameters)[
            :, :, None
        ]

    @cached_property
    def reading_sigmas(self) -> Floats:
        """Standard deviation (pointings, 3) [m, rad, rad] of the readings; infinite for unmeasured readings."""
        return np.where(self.problem.is_used_reading, self.problem.sigma, np.inf)

    def split_unknowns(self, unknowns: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Views of the unknowns (unknowns, trials): poses, targets, instrument parameters and effect parameters.

        The last index of each view is the trial; the first is station, target, instrument or effect parameter.
        """
        pose, targets, values, _ = self.block_end_indices
        shape = self.nominal_state.instrument_parameters.shape
        return (
            unknowns[:pose].reshape(-1, 6, unknowns.shape[1]),
            unknowns[pose:targets].reshape(-1, 3, unknowns.shape[1]),
            unknowns[targets:values].reshape(*shape, unknowns.shape[1]),
            unknowns[values:],
        )

    def fit_trials(self, reading_deviations: Floats, length_errors: Floats | None = None) -> BatchFit:
        """Adjusted network of each trial.

        `reading_deviations` (pointings, 3, trials) are readings minus nominal readings, `length_errors` (lengths,
        trials) [m] are declared minus true reference lengths.
        """
        if self._expected_reading_change is not None:
            reading_deviations = reading_deviations - self._expected_reading_change
        x, predicted = self._first_step(reading_deviations, length_errors)
        last_costs = np.full(x.shape[1], np.inf)
        gradient, cost = np.empty_like(x), np.empty(x.shape[1])
        for _ in range(2, MAX_NETWORK_FIT_STEPS + 1):
            self._gradient(x, reading_deviations, length_errors, predicted, gradient, cost)
            step = self.gauss_newton_step(gradient)
            x += step
            squared = np.maximum(np.einsum("kb,kb->b", step, gradient), 0.0)
            remainder = np.sqrt(squared) * np.maximum(MIN_STEP_CONTRACTION_RATIO, np.sqrt(squared / last_costs))
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
        return self.block_end_indices[3] > self.block_end_indices[2]

    @cached_property
    def _affected_readings(self) -> tuple[Ints, Floats, Floats]:
        """Indices of the readings that effects change, and their design matrix, plain and whitened.

        Effects include declared nuisance errors. The indices (affected readings,) refer to the flattened readings. The
        designs have the shape (affected readings, effect parameters), after an axis of trials for separate geometries.
        """
        flattened = self._additional_parameter_design.reshape(self.reading_sigmas.size, -1)
        indices = np.flatnonzero(flattened.any(axis=1))
        return indices, flattened[indices], flattened[indices] / self.reading_sigmas.reshape(-1, 1)[indices]

    @cached_property
    def _first_step_matrices(self) -> tuple[Floats, Floats, Floats]:
        """Matrices of the first step from the nominal state, and matrix of the readings predicted after this step.

        The step is the first matrix times the reading deviations, plus the second times the residuals of all other
        observations. The third, (readings, unknowns), excludes effects; their changes are subtracted from the readings.
        """
        use, design = self.problem.is_used_reading, np.zeros((3 * len(self.recording), self.block_end_indices[-1]))
        design[use.ravel()] = self._whitened_design_and_residuals[0][
            : int(use.sum()), self.column_order
        ]  # whitened; zero for unmeasured readings
        # An unmeasured reading has no row; its prediction starts at the nominal reading.
        predicting = np.where(use, self.problem.sigma, 0.0).reshape(-1, 1) * design[:, : self.block_end_indices[2]]
        by_reading = self.covariance @ (design / self.reading_sigmas.reshape(-1, 1)).T
        return by_reading, self.covariance @ self._non_reading_design[0].T, predicting

    def _first_step(self, reading_deviations: Floats, length_errors: Floats | None) -> tuple[Floats, Floats]:
        """First step (unknowns, trials), and predicted minus nominal readings (pointings, 3, trials) after it."""
        by_reading, by_other, predicting = self._first_step_matrices
        nowhere = np.zeros((self.block_end_indices[-1], reading_deviations.shape[2]))
        x = by_reading @ reading_deviations.reshape(len(predicting), -1) + by_other @ self._non_reading_residuals(
            nowhere, length_errors
        )
        return x, (predicting @ x[: self.block_end_indices[2]]).reshape(reading_deviations.shape)

    def _gradient(
        self,
        increments: Floats,
        reading_deviations: Floats,
        length_errors: Floats | None,
        predicted: Floats,
        gradient: Floats,
        cost: Floats,
    ) -> None:
        """Negative gradient (unknowns, trials) and sum of squares (trials,), written to `gradient` and `cost`."""
        gradient[:], cost[:] = 0.0, 0.0
        pose, points, values, extra = self.split_unknowns(increments)
        if self._has_additional_parameters:
            rows, design, whitened = self._affected_readings
            reading_deviations = reading_deviations.copy()
            reading_deviations.reshape(-1, len(cost))[rows] -= multiply_by_trial(design, extra)
        by_pose, by_points, by_values, by_extra = self.split_unknowns(gradient)
        residual = np.empty(reading_deviations.shape)
        arrays = (self.chain_program, *self._sight_geometry, reading_deviations, pose, points, values, predicted)
        network_gradient(*arrays, residual, by_pose, by_points, by_values, cost)
        if self._has_additional_parameters:
            by_extra += multiply_by_trial(np.swapaxes(whitened, -2, -1), residual.reshape(-1, len(cost))[rows])
        residuals = self._non_reading_residuals(increments, length_errors)
        gradient += multiply_by_trial(np.swapaxes(self._non_reading_design[0], -2, -1), residuals)
        cost += np.sum(residuals**2, axis=0)

    def _non_reading_residuals(self, increments: Floats, length_errors: Floats | None) -> Floats:
        """Whitened residuals (rows, trials) of reference lengths, control points, levels, priors and datum.

        The residuals of lengths are exact; all others are linear in the `increments` (unknowns, trials).
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


def multiply_by_trial(matrix: Floats, columns: Floats) -> Floats:
    """Product (rows, trials) of one matrix for all trials, or of one per trial, with `columns` (terms, trials)."""
    if matrix.ndim == 2:
        return matrix @ columns
    return np.matmul(matrix, columns.T[:, :, None])[:, :, 0].T
