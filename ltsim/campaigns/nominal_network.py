"""Network with nominal (error-free) readings: design matrix, normal matrix and standard deviations of the unknowns."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from ltsim.adjustment.frame import DeclaredFrame
from ltsim.adjustment.problem import NetworkProblem
from ltsim.campaigns.kinematic_chain import ChainArrays
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import InputError
from ltsim.geometry.rigid import pose_jacobian
from ltsim.physics.effects.effect import Effect
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.physics.model.measurement import MeasurementModel, NetworkState, Prediction, sightings_at_state
from ltsim.recordings.recording import Recording
from ltsim.scene.sightings import Sightings
from ltsim.solve.chain import inverse_from_cholesky
from ltsim.solve.design import (
    DesignMatrix,
    cholesky_where_determined,
    gram_matrix,
    iterate_row_batches,
    scale_to_unit_diagonal,
    to_dense,
)

MAX_DENSE_NETWORK_ENTRIES = 4_000_000
"""Largest number of entries of a design matrix that is stored as a dense array, in 30 MiB. Dense arrays are faster than
sparse ones for small networks."""


@dataclass(frozen=True)
class SharedDerivatives:
    """Derivatives of the readings of one network, reused for another network with the same set-up and pointings."""

    network: NominalNetwork
    """Network from which the derivatives are taken; it has the same set-up and pointings but other coordinates."""
    point_derivatives: Floats
    """Derivative of the nominal readings with respect to the targets in the instruments' frames, (pointings, 3, 3)."""
    parameter_derivatives: Floats
    """Derivative of the nominal readings with respect to the instrument parameters, (pointings, 3, parameters)."""


class _NormalMatrixFactorisation(NamedTuple):
    """Factorised normal matrix of a nominal network, and design matrices with columns in the order of unknowns."""

    cholesky_factor: Floats
    """Lower Cholesky factor (unknowns, unknowns) of the normal matrix, scaled to a unit diagonal."""
    column_scales: Floats
    """Scales (unknowns,) that give the normal matrix a unit diagonal."""
    non_reading_design: Floats
    """Whitened design (rows, unknowns) of all observations except readings."""
    non_reading_residuals: Floats
    """Whitened nominal residuals (rows, 1) of all observations except readings."""
    sparse_design: sp.csr_array | None
    """Whitened design (rows, unknowns) of all observations, with columns in the order of the least-squares problem;
    None for a network with a dense design."""


@dataclass(frozen=True)
class NominalNetwork:
    """Network with nominal (error-free) readings, and the design matrix of its least-squares adjustment."""

    recording: Recording
    """Recording with nominal readings, which an ideal tracker reads at `state`."""
    state: NetworkState
    """True poses of the stations and true positions of the targets, at which the nominal readings are computed."""
    construction: GeometricErrorModel
    """Geometric error model of the instruments; its parameters are estimated."""
    kinematic_chain: ChainArrays
    """Kinematic chain of the geometric error model, linearised at the nominal readings."""
    effects: tuple[Effect, ...] = ()
    """Effects that are estimated in addition to the instrument parameters and to the declared nuisance errors."""
    shared_derivatives: SharedDerivatives | None = None
    """Derivatives of another network with the same set-up, which are reused; None if they have to be computed."""
    is_adjusted_observable: Bools = field(default_factory=lambda: np.ones(3, dtype=bool))
    """Mask (3,) of the observables (range, azimuth, elevation) that are adjusted."""

    @cached_property
    def model(self) -> MeasurementModel:
        """Measurement model that predicts the readings, the same as in the adjustment of a single recording."""
        model = MeasurementModel(self.recording, self.construction, self.effects)
        if self.shared_derivatives is not None:
            vars(model)["nuisance_errors"] = self.shared_derivatives.network.model.nuisance_errors
        return model

    @cached_property
    def problem(self) -> NetworkProblem:
        """Least-squares problem at the nominal unknowns, with the observations of an adjustment of one recording."""
        if self.shared_derivatives is None:
            return NetworkProblem.from_model(
                self.model, reading_mask=np.tile(self.is_adjusted_observable, (len(self.recording), 1))
            )
        return self.shared_derivatives.network.problem.with_positions_of_model(self.model)

    @cached_property
    def state_with_zero_parameters(self) -> NetworkState:
        """True poses and targets, with all parameters of instruments and effects equal to zero."""
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
        """End indices of the blocks of unknowns: poses, targets, instrument parameters, effect parameters."""
        unknowns = self.problem.unknowns
        pose = unknowns.pose_columns.size
        targets = pose + unknowns.target_columns.size
        end_of_parameters = targets + unknowns.instrument_columns.size
        return pose, targets, end_of_parameters, end_of_parameters + unknowns.effect_columns.size

    @cached_property
    def column_order(self) -> Ints:
        """Columns (unknowns,) of the design matrix of `problem` in the order poses, targets, parameters, effects."""
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
            raise InputError('the batch solver does not support stations over a common mark; use solver = "single"')
        return order

    @property
    def cholesky_and_scales(self) -> tuple[Floats, Floats]:
        """Lower Cholesky factor of the nominal normal matrix, scaled to a unit diagonal, and the scales (unknowns,).

        InputError is raised for undetermined unknowns.
        """
        return self._factorisation.cholesky_factor, self._factorisation.column_scales

    @property
    def _non_reading_design(self) -> tuple[Floats, Floats]:
        """Whitened design (rows, unknowns) of all observations except readings, and nominal residuals (rows, 1)."""
        return self._factorisation.non_reading_design, self._factorisation.non_reading_residuals

    @cached_property
    def _factorisation(self) -> _NormalMatrixFactorisation:
        """Factorised normal matrix and designs, computed together so that a dense design matrix is not kept in memory.

        InputError is raised for undetermined unknowns.
        """
        design, residual = self._whitened_design_and_residuals()
        if isinstance(design, np.ndarray):
            gram = design.T @ design
        else:
            row_batches = iterate_row_batches(design, np.ones(design.shape[1]))
            gram = to_dense(gram_matrix(row_batches, design.shape[1]))
        normal = gram.take(self.column_order, 0).take(self.column_order, 1)
        unit, scale = scale_to_unit_diagonal(normal, np.diag(normal))
        roots, determined = cholesky_where_determined(unit[None])
        if not determined.all():
            raise InputError(
                "the network of the scenario does not determine all unknowns: give priors or more pointings"
            )
        n_readings = int(self.problem.is_used_reading.sum())
        other_design = to_dense(design[n_readings:])[:, self.column_order]
        sparse_design = None if isinstance(design, np.ndarray) else design
        return _NormalMatrixFactorisation(roots[0], scale, other_design, residual[n_readings:, None], sparse_design)

    def _whitened_design_and_residuals(self) -> tuple[DesignMatrix, Floats]:
        """Whitened design (rows, unknowns) of all observations of `problem`, and their nominal residuals (rows,).

        The design is a sparse matrix if it has more than `MAX_DENSE_NETWORK_ENTRIES` entries.
        """
        prediction = (
            self.problem.model.linearise(self.state_with_zero_parameters)
            if self.shared_derivatives is None
            else self._nominal_prediction(self.shared_derivatives)
        )
        system = self.problem.linear_system(
            self.state_with_zero_parameters, replace(prediction, extra_derivatives=self._additional_parameter_design)
        )
        is_small = system.design.shape[0] * system.design.shape[1] <= MAX_DENSE_NETWORK_ENTRIES
        return to_dense(system.design) if is_small else system.design, system.whitened_residuals

    def _nominal_prediction(self, derivatives: SharedDerivatives) -> Prediction:
        """Predicted readings at nominal unknowns, with their derivatives, equal to `MeasurementModel.linearise`."""
        recording, state = self.recording, self.state
        by_target = derivatives.point_derivatives @ np.swapaxes(state.station_rotations, 1, 2)[recording.station]
        arm = state.target_points[recording.target] - state.station_positions[recording.station]
        by_pose = pose_jacobian(by_target, arm)
        return Prediction(
            recording.readings, by_pose, by_target, derivatives.parameter_derivatives, np.zeros((len(recording), 3, 0))
        )

    @cached_property
    def covariance(self) -> Floats:
        """Covariance (unknowns, unknowns) [SI] at the nominal unknowns; the pose of the first station is the datum."""
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
        """Frame of the network, as the levels and control points of the recording define it."""
        return (
            DeclaredFrame.from_recording(self.recording)
            if self.shared_derivatives is None
            else self.shared_derivatives.network._network_frame
        )

    @cached_property
    def _sightings_in_floor_plan_frame(self) -> Sightings:
        """Pointings in the frame of the floor plan, in which the directions of nests are declared."""
        state = self.state_with_zero_parameters
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
        return self.shared_derivatives.network._sightings_in_floor_plan_frame.with_geometry(
            state.station_positions, state.station_rotations, state.target_points
        )

    @cached_property
    def _additional_parameter_design(self) -> Floats:
        """Change (pointings, 3, effect parameters) of the readings per unit of each parameter of effects.

        Nuisance errors that the recording declares count as effects.
        """
        if not self.model.effects_and_nuisance_errors:
            return np.zeros((len(self.recording), 3, 0))
        return self.model.extra_design(self._sightings_in_floor_plan_frame)

    @cached_property
    def reading_sigmas(self) -> Floats:
        """Standard deviations of the readings, (pointings, 3) [m, rad, rad]; infinite for unmeasured readings."""
        return np.where(self.problem.is_used_reading, self.problem.reading_sigmas, np.inf)

    def split_unknowns(self, unknowns: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Views of `unknowns` (unknowns, trials) by block: poses, targets, instrument parameters and effect parameters.

        The first axis of each view is station, target, instrument or effect parameter; the last axis is the trial.
        """
        pose, targets, values, _ = self.block_end_indices
        shape = self.state_with_zero_parameters.instrument_parameters.shape
        return (
            unknowns[:pose].reshape(-1, 6, unknowns.shape[1]),
            unknowns[pose:targets].reshape(-1, 3, unknowns.shape[1]),
            unknowns[targets:values].reshape(*shape, unknowns.shape[1]),
            unknowns[values:],
        )
