"""Least-squares problem of a network adjustment: whitened residuals and design matrix from a recording."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ltsim.adjustment.marks import StationMarks
from ltsim.adjustment.prior import ParameterPrior, prior_sigmas
from ltsim.adjustment.rows import (
    ControlRows,
    GaugeRows,
    LevelRows,
    MarkDifferenceRows,
    YawRows,
    free_motions,
)
from ltsim.adjustment.structure import NetworkRows, UnknownColumns
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import NetworkError
from ltsim.geometry.polar import wrap_angle
from ltsim.geometry.rigid import cross_matrix
from ltsim.physics.model.construction import declared_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState, Prediction
from ltsim.solve.design import DESIGN_ROWS_PER_BATCH, DesignMatrix, SparsityPattern, to_dense
from ltsim.solve.elimination import BlockSystem

DATUM_CONSTRAINT_SIGMAS = np.full(6, 1e-8)
"""Standard deviations (6,) [m, rad] of the equations that fix the pose of a station as datum. These equations do not
influence the adjusted shape. For correct covariances their standard deviations are far below the standard deviations of
the network; even smaller values would cause rounding errors.
"""
WEAK_EFFECT_PRIOR_FACTOR = 300.0
"""Default standard deviation of the weak prior of a parameter of additional effects, divided by the plausible size of
the parameter."""


@dataclass(frozen=True)
class NetworkProblem(NetworkRows):
    """Least-squares problem with poses, targets, instrument parameters and additional effects as unknowns.

    Its equations (rows) are in this order: readings in use (pointing by pointing: range, azimuth, elevation), reference
    lengths, control points, known marks under stations, known differences, levels, yaws, constraints of undetermined
    unknowns, priors of the instrument parameters, weak priors of the additional effects, datum.
    """

    reading_sigmas: Floats
    """Standard deviations of the readings of n pointings, (n, 3) [m, rad, rad]."""
    prior: ParameterPrior
    """Prior of the instrument parameters."""
    effect_prior_sigmas: Floats
    """Standard deviations (q,) [SI] of the weak priors of the q parameters of additional effects; infinite: no
    prior."""
    free_motions: Floats
    """Rigid motions (6, f) that no observation determines, so that the datum fixes them: f translations [m] and
    rotations [rad]."""

    @classmethod
    def from_model(
        cls,
        model: MeasurementModel,
        *,
        sigma: Floats | None = None,
        reading_mask: Bools | None = None,
        effect_prior_sigma: float = WEAK_EFFECT_PRIOR_FACTOR,
        prior: ParameterPrior | None = None,
    ) -> NetworkProblem:
        """Least-squares problem of a measurement model, with the reference values of its recording.

        `sigma` (n, 3) [m, rad, rad] are the standard deviations of the readings of n pointings, by default the declared
        ones, and `reading_mask` (n, 3) selects readings. `effect_prior_sigma` is the standard deviation of the weak
        prior of each parameter of additional effects, divided by its plausible size. `prior` is the prior of the
        instrument parameters, by default that in `setup.toml`.
        """
        recording = model.recording
        marks = StationMarks.from_recording(recording)
        is_used = recording.is_usable_reading if reading_mask is None else recording.is_usable_reading & reading_mask
        gauge, control, levels = (
            GaugeRows.from_recording(recording),
            ControlRows.from_recording(recording),
            LevelRows.from_recording(recording, is_used),
        )
        mark_control, yaws = ControlRows.from_stations(recording, marks), YawRows.from_recording(recording, is_used)
        differences = MarkDifferenceRows.from_marks(recording, marks)
        effect_sigmas = [effect_prior_sigma * size for effect in model.effects for size in effect.plausible_sizes]
        effect_sigmas += [size for errors in model.nuisance_errors for size in errors.plausible_sizes]
        return cls(
            model=model,
            reading_sigmas=recording.reading_sigmas() if sigma is None else sigma,
            prior=prior or ParameterPrior.from_sigmas(prior_sigmas(recording, model.construction)),
            effect_prior_sigmas=np.array(effect_sigmas, dtype=np.float64),
            free_motions=free_motions(control, mark_control, differences, levels, yaws),
            is_used_reading=is_used,
            gauge_rows=gauge,
            control_rows=control,
            level_rows=levels,
            yaw_rows=yaws,
            marks=marks,
            control_rows_of_marks=mark_control,
            difference_rows=differences,
            unknowns=UnknownColumns.from_model(model, gauge, marks, differences),
        )

    def with_model(self, model: MeasurementModel) -> NetworkProblem:
        """Least-squares problem with another measurement model of the same pointings, and the same reference values."""
        new_problem = NetworkProblem.from_model(
            model, sigma=self.reading_sigmas, reading_mask=self.is_used_reading, prior=self.prior
        )
        differences = new_problem.difference_rows.subset(
            np.isin(new_problem.difference_rows.names, self.difference_rows.names)
        )
        return replace(new_problem, effect_prior_sigmas=self.effect_prior_sigmas, difference_rows=differences)

    def with_instrument_constants(
        self, state: NetworkState, *, requires_length: bool = True
    ) -> tuple[NetworkProblem, NetworkState]:
        """Problem and state with the instrument parameters as unknowns with priors, for tests of reference values.

        The unknown zero and scale of the distances make the test of a reference length uncertain, also if the network
        is adjusted without instrument parameters. Problem and state are returned unchanged if they contain instrument
        parameters, or if `requires_length` is True and there is no reference length.
        """
        recording = self.model.recording
        if (requires_length and not len(self.gauge_rows)) or self.model.construction.n_parameters:
            return self, state
        try:
            construction = declared_construction(recording)
        except NetworkError:  # instruments of two designs have no common parameters
            return self, state
        prior = ParameterPrior.from_sigmas(prior_sigmas(recording, construction))
        parameters = np.zeros((len(recording.instruments), construction.n_parameters))
        problem = replace(self, prior=prior).with_model(replace(self.model, construction=construction))
        return problem, replace(state, instrument_parameters=parameters)

    def with_positions_of_model(self, model: MeasurementModel) -> NetworkProblem:
        """Copy of the problem for the measurement model `model` of a plan with other station and target positions.

        The set-up and the pointings of `model` are the same; the order of the pointings may differ. Only the
        undetermined unknowns, and if possible the sparsity pattern, are reused.
        """
        moved, mine, theirs = replace(self, model=model), self.model.recording, model.recording
        moved = replace(moved, reading_sigmas=theirs.reading_sigmas())
        vars(moved)["undetermined_unknowns"] = self.undetermined_unknowns
        if np.array_equal(mine.station, theirs.station) and np.array_equal(mine.target, theirs.target):
            vars(moved)["_sparsity_pattern"] = self._sparsity_pattern
        return moved

    def is_undetermined_difference(self, is_undetermined_target: Bools) -> Bools:
        """Flags (k,), True for those of the k known differences that have an undetermined end and no influence.

        An end is undetermined if it is an undetermined target or a station without readings, or if its height is
        undetermined and part of the difference. `is_undetermined_target` (T,) has a flag for each of T targets.
        """
        structure, stations = self.undetermined_unknowns, len(self.unknowns.pose_columns)
        stands, heights = np.zeros((2, stations + 1), dtype=bool)
        stands[structure.stations_without_readings], heights[structure.height_undetermined_stations] = True, True
        is_undetermined = np.concatenate([is_undetermined_target, stands])[
            self.difference_rows.start_and_end_indices
        ].any(axis=0)
        open_ = np.concatenate([structure.is_height_undetermined_target, heights])[
            self.difference_rows.start_and_end_indices
        ].any(axis=0)
        return np.asarray(is_undetermined | (open_ & self.difference_rows.is_declared_coordinate[:, 2]))

    def reading_residuals(self, readings: Floats) -> Floats:
        """Observed minus predicted readings (n, 3) [m, rad, rad] of n pointings; NaN if not measured.

        `readings` (n, 3) are the predicted readings. Differences of angles are reduced to +-180 deg.
        """
        gap = self.model.recording.readings - readings
        gap[:, 1:] = wrap_angle(gap[:, 1:])
        return gap

    def whitened_residuals(self, state: NetworkState) -> Floats:
        """Whitened residuals (m,) of all m equations at the values `state` of the unknowns."""
        return self._whitened_residuals_of(state, self.model.predict(state))

    def _whitened_residuals_of(self, state: NetworkState, readings: Floats) -> Floats:
        """Whitened residuals (m,) of all m equations at a state; `readings` (n, 3) are the predicted readings."""
        pointings = (self.reading_residuals(readings) / self.reading_sigmas)[self.is_used_reading]
        gauge = self.gauge_rows.decorrelate(self.length_residuals(state))
        control = self.control_rows.whitened_residuals(state.target_points[self.control_rows.point_indices])
        marks = self.control_rows_of_marks.whitened_residuals(
            state.station_positions[self.control_rows_of_marks.point_indices]
        )
        differences = self.difference_rows.whitened_residuals(
            self.difference_rows.predict(state.target_points, state.station_positions)
        )
        levels = -self.level_rows.axis_tilts(state.station_rotations) / self.level_rows.tilt_sigmas[:, None]
        yaws = self.yaw_rows.yaw_residuals(state.station_rotations) / self.yaw_rows.yaw_sigmas
        fixed_residuals = np.zeros(self.undetermined_unknowns.n_fixing_equations)
        prior = self.prior.whitened_residuals(state.instrument_parameters)
        effect_residuals = -(state.extra_parameters / self.effect_prior_sigmas)[np.isfinite(self.effect_prior_sigmas)]
        datum = np.zeros(self.free_motions.shape[1])
        references = pointings, gauge, control, marks, differences, levels.ravel(), yaws
        return np.concatenate([*references, fixed_residuals, prior, effect_residuals, datum])

    def length_residuals(self, state: NetworkState) -> Floats:
        """Declared minus adjusted lengths (g,) [m] of the g reference lengths at a state."""
        return (
            self.gauge_rows.lengths
            - self.gauge_rows.predict(state.target_points)
            - self._reference_length_design(state) @ state.extra_parameters
        )

    def retract(self, state: NetworkState, step: Floats) -> NetworkState:
        """Network state after a `step` (u,) of all u unknowns from `state`."""
        unknowns = self.unknowns
        return state.with_increments(
            step[unknowns.pose_columns],
            step[unknowns.target_columns],
            step[unknowns.instrument_columns],
            step[unknowns.effect_columns],
        )

    def linearise(self, state: NetworkState) -> BlockSystem:
        """Linearised adjustment problem at the values `state` of the unknowns: whitened residuals and design matrix."""
        return self.linear_system(state, self.model.linearise(state))

    def linear_system(self, state: NetworkState, prediction: Prediction) -> BlockSystem:
        """Linearised problem at a state, from the predicted readings and their derivatives at this state."""
        residual, values = (
            self._whitened_residuals_of(state, prediction.readings),
            self._whitened_derivatives(state, prediction),
        )
        del prediction  # the prediction takes as much memory as the design matrix
        design = self._sparsity_pattern.make_design_matrix(values)
        if self.gauge_rows.correlation_cholesky_factor is not None:
            design = self._decorrelate_lengths(design)
        return BlockSystem(design, residual, self.unknowns.n_retained)

    def _decorrelate_lengths(self, design: DesignMatrix) -> DesignMatrix:
        """Design matrix in which the rows of reference lengths, which may share errors, are decorrelated."""
        first_length_row = int(self.is_used_reading.sum())
        end_row = first_length_row + len(self.gauge_rows)
        lengths = self.gauge_rows.decorrelate_scaled(to_dense(design[first_length_row:end_row]))
        if isinstance(design, np.ndarray):
            return np.vstack([design[:first_length_row], lengths, design[end_row:]])
        return sp.vstack([design[:first_length_row], sp.csr_array(lengths), design[end_row:]], format="csr")

    @cached_property
    def _sparsity_pattern(self) -> SparsityPattern:
        """Sparsity pattern of the design matrix, the same for all states of the network."""
        return SparsityPattern(self._columns_by_row_kind(), self.unknowns.n_columns)

    def _columns_by_row_kind(self) -> list[Ints]:
        """Column indices of nonzero elements of the design matrix: an array (equations, elements) per equation kind."""
        recording, at, gauge = self.model.recording, self.unknowns, self.gauge_rows
        blocks = (
            at.pose_columns[recording.station],
            at.target_columns[recording.target],
            at.instrument_columns[recording.instrument],
        )
        pointings = np.concatenate([*blocks, np.tile(at.effect_columns, (len(recording), 1))], axis=1)
        target_columns = (
            at.target_columns[gauge.first_targets],
            at.target_columns[gauge.second_targets],
            np.tile(at.effect_columns, (len(gauge), 1)),
        )
        anchors = at.pose_columns[self.undetermined_unknowns.datum_stations].ravel()
        return [
            pointings[np.nonzero(self.is_used_reading)[0]],
            np.concatenate(target_columns, axis=1),
            np.repeat(
                at.target_columns[self.control_rows.point_indices],
                self.control_rows.is_declared_coordinate.sum(axis=1),
                axis=0,
            ),
            np.repeat(
                at.pose_columns[self.control_rows_of_marks.point_indices, :3],
                self.control_rows_of_marks.is_declared_coordinate.sum(axis=1),
                axis=0,
            ),
            np.repeat(
                at.position_columns[self.difference_rows.start_and_end_indices.T].reshape(-1, 6),
                self.difference_rows.is_declared_coordinate.sum(axis=1),
                axis=0,
            ),
            np.repeat(at.pose_columns[self.level_rows.station_indices, 3:], 2, axis=0),
            at.pose_columns[self.yaw_rows.station_indices, 3:],
            self.undetermined_unknowns.fixed_columns,
            self._prior_row_columns(),
            at.effect_columns[np.isfinite(self.effect_prior_sigmas)][:, None],
            np.tile(anchors, (self.free_motions.shape[1], 1)),
        ]

    def _whitened_derivatives(self, state: NetworkState, prediction: Prediction) -> Iterator[Floats]:
        """Nonzero elements of the whitened design matrix by equation kind, in the order of `_columns_by_row_kind`."""
        yield from self._reading_derivatives(prediction)
        direction = self.gauge_rows.line_directions(state.target_points)
        gauge = np.concatenate([direction, -direction, self._reference_length_design(state)], axis=1)
        yield gauge / self.gauge_rows.total_sigmas[:, None]
        yield self.control_rows.derivatives()
        yield self.control_rows_of_marks.derivatives()
        yield self.difference_rows.derivatives()
        yield self.level_rows.tilt_derivatives(state.station_rotations) / self.level_rows.tilt_sigmas[:, None, None]
        yield self.yaw_rows.yaw_derivatives(state.station_rotations) / self.yaw_rows.yaw_sigmas[:, None]
        yield self.undetermined_unknowns.fixing_coefficients(state) / DATUM_CONSTRAINT_SIGMAS[0]
        yield (
            self.prior.whitening_matrices
            if self.prior.has_correlations
            else 1.0 / self.prior.sigma[np.isfinite(self.prior.sigma)]
        )
        yield 1.0 / self.effect_prior_sigmas[np.isfinite(self.effect_prior_sigmas)]
        yield self._datum_rows(state)

    def _reading_derivatives(self, prediction: Prediction) -> Iterator[Floats]:
        """Nonzero elements of the whitened design matrix for the readings in use, in batches to limit the memory."""
        derivatives = [
            prediction.pose_derivatives,
            prediction.target_derivatives,
            prediction.instrument_derivatives,
            prediction.extra_derivatives,
        ]
        held = self.prior.is_fixed[self.model.recording.instrument][:, None]
        step = DESIGN_ROWS_PER_BATCH // 3
        for first in range(0, len(self.is_used_reading), step):
            piece = slice(first, first + step)
            parts = [part[piece] for part in derivatives]
            if held.any():  # only its prior determines a fixed parameter, which therefore stays at its mean
                parts[2] = np.where(held[piece], 0.0, parts[2])
            use = self.is_used_reading[piece]
            yield np.concatenate(parts, axis=2)[use] / self.reading_sigmas[piece][use][:, None]

    def _prior_row_columns(self) -> Ints:
        """Column indices (m, 1) of the m equations of the prior, or (m, p) if its p parameters are correlated."""
        columns = self.unknowns.instrument_columns
        if self.prior.has_correlations:
            return np.repeat(columns, columns.shape[1], axis=0)
        return columns[np.isfinite(self.prior.sigma)][:, None]

    def _reference_length_design(self, state: NetworkState) -> Floats:
        """Changes (g, q) of g reference lengths per unit of each of the q parameters of additional effects."""
        ends = self.gauge_rows.first_targets, self.gauge_rows.second_targets
        columns = [effect.gauge_design(*ends, state.target_points) for effect in self.model.effects_and_nuisance_errors]
        return np.hstack([np.zeros((len(self.gauge_rows), 0)), *columns])

    def _datum_rows(self, state: NetworkState) -> Floats:
        """Coefficients (f, 6 a) of whitened equations that fix the f free rigid motions at the a `datum_stations`."""
        return self.free_motions_at_datum_stations(state) / np.tile(
            DATUM_CONSTRAINT_SIGMAS, len(self.undetermined_unknowns.datum_stations)
        )

    def free_motions_at_datum_stations(self, state: NetworkState) -> Floats:
        """Changes (f, 6 a) of the poses of the a `datum_stations` by the f free motions, which the datum fixes."""
        anchors = self.undetermined_unknowns.datum_stations
        motion = self.free_motions / np.linalg.norm(self.free_motions, axis=0)
        turn = np.broadcast_to(motion[3:].T[:, None, :], (motion.shape[1], len(anchors), 3))
        rotation_part = (cross_matrix(turn) @ state.station_positions[anchors][:, :, None])[..., 0]
        shift = motion[:3].T[:, None, :] + rotation_part
        datum_rows = np.concatenate(
            [shift, turn if self.undetermined_unknowns.fixes_datum_rotations else np.zeros_like(shift)], axis=2
        )
        return datum_rows.reshape(len(datum_rows), 6 * len(anchors))

    @cached_property
    def level_row_slice(self) -> slice:
        """Slice that selects the equations of the levels (two per level) among all equations."""
        first_level_row = (
            int(self.is_used_reading.sum())
            + len(self.gauge_rows)
            + self.control_rows.n_coordinates
            + self.control_rows_of_marks.n_coordinates
        )
        first_level_row += self.difference_rows.n_coordinates
        return slice(first_level_row, first_level_row + 2 * len(self.level_rows))

    @property
    def dof(self) -> int:
        """Degrees of freedom: number of observations and priors minus number of unknowns.

        Weak priors of additional effects do not count as observations, free rigid motions do not count as unknowns.
        """
        n_priors = int(np.isfinite(self.prior.sigma).sum())
        n_lengths = int(np.isfinite(self.gauge_rows.total_sigmas).sum())
        n_lengths -= n_lengths > 0 and not self.gauge_rows.is_scale_determined
        nuisances = sum(len(errors.parameters) for errors in self.model.nuisance_errors)
        references = (
            self.control_rows.n_coordinates
            + self.control_rows_of_marks.n_coordinates
            + self.difference_rows.n_coordinates
        )
        references += n_lengths + 2 * len(self.level_rows) + len(self.yaw_rows) + n_priors + nuisances
        n_free_motions = self.free_motions.shape[1] - self.undetermined_unknowns.fixes_heights
        unknown = (
            self.unknowns.n_columns
            - n_free_motions
            - self.undetermined_unknowns.n_fixing_equations
            + self.undetermined_unknowns.n_coordinates_of_unmeasured_targets
        )
        return int(self.is_used_reading.sum()) + references - unknown
