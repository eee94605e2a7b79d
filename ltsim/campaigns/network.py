"""Network adjustment of all trials with a common geometry: one factorisation, exact residuals and gradients.

The normal matrix N of the nominal network is inverted once. A step is ``inverse @ gradient`` for all trials in one
matrix product; the gradient is that of the exact residuals at each trial's own state, so that the iteration converges
to the optimum of the trial for any N: N only determines the speed (a factor of about 1e-3 a step, since errors of
micrometres in metres hardly change the design).

Residuals are formed where the point that the readings describe meets the target, and carried to the readings by
the ideal tracker's derivative: relative error 1e-5 of a residual, that is 1e-5 sigma in a reading.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ltsim.adjustment.frame import DeclaredFrame
from ltsim.adjustment.problem import NetworkProblem
from ltsim.campaigns.kernels import network_gradient
from ltsim.campaigns.program import ChainProgram
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import SetupError
from ltsim.geometry.rigid import pose_design
from ltsim.physics.effects.effect import Effect
from ltsim.physics.model.construction import Construction
from ltsim.physics.model.incidence import IncidenceErrors
from ltsim.physics.model.measurement import MeasurementModel, NetworkState, Prediction, sightings_of
from ltsim.recordings.recording import Recording
from ltsim.scene.sightings import Sightings
from ltsim.solve.chain import inverse_from_cholesky
from ltsim.solve.design import cholesky_where_determined, scale_to_unit_diagonal, to_dense

CAP = 8
MIN_CONVERGENCE_RATE = 1e-3
"""Smallest assumed ratio of the distances to the optimum after and before a step; larger if previous steps show it."""
TOLERANCE = 5e-5
"""Largest distance to the optimum of a converged trial, in standard deviations (all unknowns together)."""


@dataclass(frozen=True)
class BatchFit:
    """Adjusted trials of a batch; the last index is the trial."""

    points: Floats
    """Adjusted minus nominal targets, (T, 3, B) [m]."""
    values: Floats
    """Instrument parameters, (I, p, B) [SI]."""
    extra: Floats
    """Parameters of additional effects, (q, B) [SI]."""
    reflectors: Mapping[str, Floats]
    """Parameters (14, B) [SI] of `smr-incidence` of each reflector, by name."""
    chi2: Floats
    """Chi-square of each trial, (B,)."""
    remainder: Floats
    """Distance to the optimum after the last step, in standard deviations, (B,)."""

    @property
    def converged(self) -> Bools:
        """Flags (B,) of the converged trials; NaN counts as not converged."""
        return self.remainder < TOLERANCE


@dataclass(frozen=True)
class SharedQuantities:
    """Derivatives and model of a reference network, reused for another network of the same set-up."""

    network: BatchNetwork
    """Batch network of the same set-up and pointings, with other coordinates."""
    by_point: Floats
    """Derivative of the nominal readings with respect to the local points, (n, 3, 3)."""
    by_value: Floats
    """Derivative of the nominal readings with respect to the parameters, (n, 3, p)."""


@dataclass(frozen=True)
class BatchNetwork:
    """Network about its nominal state, for the adjustment of any number of trials."""

    recording: Recording
    """Recording with nominal readings: those of an ideal tracker at `state`."""
    state: NetworkState
    construction: Construction
    """Construction whose parameters are estimated."""
    program: ChainProgram
    """Kinematic chain around the nominal readings."""
    effects: tuple[Effect, ...] = ()
    """Additional effects that are estimated, together with the nuisance errors that the recording declares."""
    shared: SharedQuantities | None = None
    """Quantities common to networks of the same set-up, computed if None; not used with additional effects."""
    recorded: Bools = field(default_factory=lambda: np.ones(3, dtype=bool))
    """Flags (3,) of the observables (range, azimuth, elevation) that are adjusted."""

    @cached_property
    def model(self) -> MeasurementModel:
        """Forward model, as for a single adjustment."""
        model = MeasurementModel(self.recording, self.construction, self.effects)
        if self.shared is not None:
            vars(model)["nuisances"] = self.shared.network.model.nuisance_errors
        return model

    @cached_property
    def problem(self) -> NetworkProblem:
        """Least-squares problem at the nominal state, with the rows of a single adjustment."""
        if self.shared is None:
            return NetworkProblem.from_model(self.model, reading_mask=np.tile(self.recorded, (len(self.recording), 1)))
        return self.shared.network.problem.with_other_positions(self.model)

    @cached_property
    def nominal(self) -> NetworkState:
        """Nominal state with zero parameters."""
        instruments = len(self.recording.instruments)
        return NetworkState(
            self.state.station_positions,
            self.state.station_rotations,
            self.state.target_points,
            np.zeros((instruments, self.construction.n_parameters)),
            np.zeros(self.model.n_extra_parameters),
        )

    @cached_property
    def sizes(self) -> tuple[int, int, int, int]:
        """End indices of poses, targets, parameters and further effects in the vector of unknowns."""
        unknowns = self.problem.unknowns
        pose = unknowns.pose_columns.size
        targets = pose + unknowns.target_columns.size
        values = targets + unknowns.instrument_columns.size
        return pose, targets, values, values + unknowns.extra_columns.size

    @cached_property
    def order(self) -> Ints:
        """Columns (K,) of the problem's design in the order of this class: poses, targets, parameters, effects."""
        if self.shared is not None:
            return self.shared.network.order
        unknowns = self.problem.unknowns
        parts = (unknowns.pose_columns, unknowns.target_columns, unknowns.instrument_columns, unknowns.extra_columns)
        order = np.concatenate([part.ravel() for part in parts])
        if len(np.unique(order)) != unknowns.n_columns:
            raise SetupError('stations that share a mark are not supported by the batch solver; use solver = "single"')
        return order

    @cached_property
    def _other_design(self) -> tuple[Floats, Floats]:
        """Whitened design (r, K) of the rows other than readings, and their nominal residuals (r, 1)."""
        design, residual = self._system
        count = int(self.problem.used_readings.sum())
        return design[count:, self.order], residual[count:, None]

    @cached_property
    def _system(self) -> tuple[Floats, Floats]:
        """Whitened design (m, K) of all rows, with columns in the order of the problem, and residuals (m,)."""
        prediction = (
            self.problem.model.linearised(self.nominal) if self.shared is None else self._prediction(self.shared)
        )
        system = self.problem.linear_system(self.nominal, replace(prediction, extra_derivatives=self._extra_design))
        return to_dense(system.design), system.whitened_residuals

    def _prediction(self, shared: SharedQuantities) -> Prediction:
        """Predicted readings and derivatives at the nominal state, from shared quantities.

        They equal those of `MeasurementModel.linearised`.
        """
        recording, state = self.recording, self.state
        by_target = shared.by_point @ np.swapaxes(state.station_rotations, 1, 2)[recording.station]
        arm = state.target_points[recording.target] - state.station_positions[recording.station]
        by_pose = pose_design(by_target, arm)
        return Prediction(recording.readings, by_pose, by_target, shared.by_value, np.zeros((len(recording), 3, 0)))

    @cached_property
    def root(self) -> tuple[Floats, Floats]:
        """Lower Cholesky factor (K, K) of the nominal normal matrix with unit columns, and column scales (K,).

        Raises SetupError for undetermined unknowns.
        """
        design = self._system[0]
        normal = (design.T @ design).take(self.order, 0).take(self.order, 1)
        unit, scale = scale_to_unit_diagonal(normal, np.diag(normal))
        roots, determined = cholesky_where_determined(unit[None])
        if not determined.all():
            raise SetupError(
                "the network of the scenario does not determine all its unknowns: give priors or more pointings"
            )
        return roots[0], scale

    @cached_property
    def covariance(self) -> Floats:
        """Covariance (K, K) [SI] of all unknowns at the nominal state; the first pose defines the datum."""
        root, scale = self.root
        return inverse_from_cholesky(root) * np.outer(scale, scale)

    @cached_property
    def sigma_values(self) -> Floats:
        """Standard deviation (I, p) [SI] of the parameters after adjustment."""
        (_, start, end, _), (root, scale) = self.sizes, self.root
        last = inverse_from_cholesky(
            root[start:, start:]
        )  # of the last unknowns the inverse is that of the last corner
        roots = np.sqrt(np.diag(last)[: end - start]) * scale[start:end]
        return roots.reshape(self.problem.unknowns.instrument_columns.shape)

    def step(self, gradient: Floats) -> Floats:
        """Gauss-Newton step (K, B) for gradients (K, B)."""
        return self.covariance @ gradient

    @cached_property
    def _geometry(self) -> tuple[np.ndarray, ...]:
        recording, state = self.recording, self.state
        arm = state.target_points[recording.target] - state.station_positions[recording.station]
        places = (recording.instrument, recording.station, recording.target)
        return (*places, arm, np.ascontiguousarray(state.station_rotations), self._by_point, 1.0 / self.sigma)

    @cached_property
    def _by_point(self) -> Floats:
        """Derivative (n, 3, 3) of an ideal tracker's readings with respect to the local point."""
        return sightings_of(self.recording, self.state).jacobian if self.shared is None else self.shared.by_point

    @cached_property
    def _frame(self) -> DeclaredFrame:
        return DeclaredFrame.from_recording(self.recording) if self.shared is None else self.shared.network._frame

    @cached_property
    def _extra_sightings(self) -> Sightings:
        """Sightings on the floor plan, the frame of the full solver for such a network, in which nests are known."""
        state = self.nominal
        motion = self._frame.plan_motion(state.station_positions, state.station_rotations)
        if motion is not None:
            turn, shift = motion
            places = {
                "position": state.station_positions @ turn.T + shift,
                "points": state.target_points @ turn.T + shift,
            }
            state = replace(state, station_rotations=turn @ state.station_rotations, **places)
        if self.shared is None:
            return self.model.sightings(state)
        return self.shared.network._extra_sightings.at(
            state.station_positions, state.station_rotations, state.target_points
        )

    @cached_property
    def _extra_design(self) -> Floats:
        """Change (n, 3, q) of the readings per unit of the parameters of effects and declared errors."""
        if not self.model.extra_effects:
            return np.zeros((len(self.recording), 3, 0))
        return self.model.extra_design(self._extra_sightings)

    @cached_property
    def _expected_shift(self) -> Floats | None:
        """Expected change (n, 3, 1) of the readings by bench tests of reflectors; None for none."""
        if not any(
            isinstance(error, IncidenceErrors) and error.mean_parameters.any() for error in self.model.nuisance_errors
        ):
            return None
        return self.model.extra_change(self._extra_sightings, self.nominal.extra_parameters)[:, :, None]

    @cached_property
    def sigma(self) -> Floats:
        """Standard deviation (n, 3) of the readings; infinite for unmeasured ones."""
        return np.where(self.problem.used_readings, self.problem.sigma, np.inf)

    def split(self, x: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Views of unknowns (K, B): poses (S, 6, B), targets (T, 3, B), parameters (I, p, B), effects (q, B)."""
        pose, targets, values, _ = self.sizes
        shape = self.nominal.instrument_parameters.shape
        return (
            x[:pose].reshape(-1, 6, x.shape[1]),
            x[pose:targets].reshape(-1, 3, x.shape[1]),
            x[targets:values].reshape(*shape, x.shape[1]),
            x[values:],
        )

    def fit(self, deviation: Floats, gauge_error: Floats | None = None) -> BatchFit:
        """Adjusted trials.

        `deviation` (n, 3, B) is readings minus nominal readings, `gauge_error` (g, B) [m] the errors of the reference
        lengths.
        """
        if self._expected_shift is not None:
            deviation = deviation - self._expected_shift
        x, predicted = self._linear_start(deviation, gauge_error)
        before = np.full(x.shape[1], np.inf)
        gradient, cost = np.empty_like(x), np.empty(x.shape[1])
        for _ in range(2, CAP + 1):
            self._gradient(x, deviation, gauge_error, predicted, gradient, cost)
            step = self.step(gradient)
            x += step
            squared = np.maximum(np.einsum("kb,kb->b", step, gradient), 0.0)
            remainder = np.sqrt(squared) * np.maximum(MIN_CONVERGENCE_RATE, np.sqrt(squared / before))
            if not np.any(remainder >= TOLERANCE):
                break
            before = squared
        _, points, values, extra = self.split(x)
        effects, reflectors = (
            extra[: self.model.n_effect_parameters],
            self.model.incidence_parameters_by_reflector(extra),
        )
        return BatchFit(points, values, effects, reflectors, cost - squared, remainder)

    @property
    def _has_extra(self) -> bool:
        return self.sizes[3] > self.sizes[2]

    @cached_property
    def _affected_readings(self) -> tuple[Ints, Floats, Floats]:
        """Readings (r,) among all (3 n,) that effects and declared errors change.

        Their design (r, q), plain and whitened.

        If states have a last index for the trial, designs have it first.
        """
        flat = self._extra_design.reshape(self.sigma.size, -1)
        rows = np.flatnonzero(flat.any(axis=1))
        return rows, flat[rows], flat[rows] / self.sigma.reshape(-1, 1)[rows]

    @cached_property
    def _start_matrices(self) -> tuple[Floats, Floats, Floats]:
        """Matrices from deviations (3 n,) and other rows (r,) to the first step (K,), and to predicted readings.

        Predicted readings include poses, targets and parameters; all other contributions are subtracted from the
        measured ones.
        """
        use, design = self.problem.used_readings, np.zeros((3 * len(self.recording), self.sizes[-1]))
        design[use.ravel()] = self._system[0][: int(use.sum()), self.order]  # whitened; zero where nothing is measured
        # A reading that is not measured has no row; its prediction starts at the nominal reading.
        predicting = np.where(use, self.problem.sigma, 0.0).reshape(-1, 1) * design[:, : self.sizes[2]]
        by_reading = self.covariance @ (design / self.sigma.reshape(-1, 1)).T
        return by_reading, self.covariance @ self._other_design[0].T, predicting

    def _linear_start(self, deviation: Floats, gauge_error: Floats | None) -> tuple[Floats, Floats]:
        """First step from the nominal state as a matrix product, and the readings that it predicts, (n, 3, B)."""
        by_reading, by_other, predicting = self._start_matrices
        nowhere = np.zeros((self.sizes[-1], deviation.shape[2]))
        x = by_reading @ deviation.reshape(len(predicting), -1) + by_other @ self._other_rows(nowhere, gauge_error)
        return x, (predicting @ x[: self.sizes[2]]).reshape(deviation.shape)

    def _gradient(
        self,
        x: Floats,
        deviation: Floats,
        gauge_error: Floats | None,
        predicted: Floats,
        gradient: Floats,
        cost: Floats,
    ) -> None:
        """Gradient (K, B) and cost (B,) at increments x (K, B)."""
        gradient[:], cost[:] = 0.0, 0.0
        pose, points, values, extra = self.split(x)
        if self._has_extra:
            rows, design, whitened = self._affected_readings
            deviation = deviation.copy()
            deviation.reshape(-1, len(cost))[rows] -= each_times(design, extra)
        by_pose, by_points, by_values, by_extra = self.split(gradient)
        residual = np.empty(deviation.shape)
        arrays = (self.program, *self._geometry, deviation, pose, points, values, predicted)
        network_gradient(*arrays, residual, by_pose, by_points, by_values, cost)
        if self._has_extra:
            by_extra += each_times(np.swapaxes(whitened, -2, -1), residual.reshape(-1, len(cost))[rows])
        others = self._other_rows(x, gauge_error)
        gradient += each_times(np.swapaxes(self._other_design[0], -2, -1), others)
        cost += np.sum(others**2, axis=0)

    def _other_rows(self, x: Floats, gauge_error: Floats | None) -> Floats:
        """Whitened residuals (r, B) of reference lengths, control points, levels, priors and datum.

        They are linear, except the lengths, which are exact.
        """
        design, nominal = self._other_design
        rows = nominal - each_times(design, x)
        gauge = self.problem.gauge_rows
        if len(gauge):
            moved = self.split(x)[1]
            arm = (self.state.target_points[gauge.first] - self.state.target_points[gauge.second]).reshape(
                len(gauge), 3, -1
            )
            change = moved[gauge.first] - moved[gauge.second]
            length = np.sqrt(np.sum(arm**2, axis=1))
            linear = length + np.sum(arm * change, axis=1) / length
            bent = linear - np.sqrt(np.sum((arm + change) ** 2, axis=1))
            if gauge_error is not None:
                bent += gauge_error
            rows[: len(gauge)] += gauge.decorrelate(bent)
        return rows


def each_times(matrix: Floats, columns: Floats) -> Floats:
    """Product of columns (k, B) with one matrix, or with a separate one (B, j, k) for each column."""
    if matrix.ndim == 2:
        return matrix @ columns
    return np.matmul(matrix, columns.T[:, :, None])[:, :, 0].T
