"""Network adjustment by other solvers, with the same exact forward model, from the nominal network.

The unknowns are poses of all stations but the first, targets and parameters. The rows are readings, reference lengths
and priors, divided by their standard deviations. All solvers use the same vectorised residual and Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg
from scipy.optimize import least_squares

from ltsim.adjustment.prior import prior_sigmas
from ltsim.adjustment.rows import GaugeRows
from ltsim.core.arrays import Floats
from ltsim.geometry.polar import wrap_angle
from ltsim.geometry.rigid import cross_matrix, matrix_from_rotation_vector
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.physics.model.measurement import NetworkState
from ltsim.recordings.recording import Recording

TOLERANCE = 1e-8
"""Largest tolerance with which all solvers end within 0.001 sigma of the optimum."""


@dataclass(frozen=True)
class DenseProblem:
    """Dense least-squares problem of a recording, around a start.

    Attributes
    ----------
    recording : Recording
        Recording of one instrument, with all pointings measured, without levels and control points.
    construction : GeometricErrorModel
    start : NetworkState
    """

    recording: Recording
    construction: GeometricErrorModel
    start: NetworkState
    _designs: dict[bytes, tuple[Floats, ...]] = field(default_factory=dict)

    @cached_property
    def _start(self) -> tuple[Floats, Floats, Floats]:
        return self.start.station_positions, self.start.station_rotations, self.start.target_points

    @cached_property
    def _gauge(self) -> GaugeRows:
        return GaugeRows.from_recording(self.recording)

    @cached_property
    def _sigma(self) -> Floats:
        return self.recording.reading_sigmas()

    @cached_property
    def _prior_sigma(self) -> Floats:
        return prior_sigmas(self.recording, self.construction)[0]

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return 6 * (len(self._start[0]) - 1) + self._start[2].size + self.construction.n_parameters

    def state(self, x: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Positions, rotations, targets and parameters for the unknowns (K,)."""
        position, rotation, points = self._start
        poses = 6 * (len(position) - 1)
        pose = np.concatenate([np.zeros((1, 6)), x[:poses].reshape(-1, 6)])
        turned = matrix_from_rotation_vector(pose[:, 3:]) @ rotation
        moved = points + x[poses : poses + points.size].reshape(-1, 3)
        return position + pose[:, :3], turned, moved, x[poses + points.size :]

    def _local(self, x: Floats) -> tuple[Floats, ...]:
        """Points in the tracker frame (n, 3) [m], and the geometry."""
        position, rotation, points, values = self.state(x)
        turn = rotation[self.recording.station]
        arm = points[self.recording.target] - position[self.recording.station]
        return np.einsum("nji,nj->ni", turn, arm), arm, turn, points, values

    def _readings_and_geometry(self, x: Floats) -> tuple[Floats, ...]:
        """Readings (n, 3) and geometry, which are cached for the Jacobian at the same unknowns."""
        key = x.tobytes()
        if key not in self._designs:
            local, *geometry = self._local(x)
            self._designs.clear()
            self._designs[key] = (
                self.construction.readings_from_points(local, self.recording.face, geometry[-1]),
                *geometry,
            )
        return self._designs[key]

    def _design_and_geometry(self, x: Floats) -> tuple[Floats, ...]:
        """Derivatives of the readings by point and by parameters, and geometry; the readings are cached."""
        key = x.tobytes()
        if key in self._designs:
            raw, *geometry = self._designs[key]
            return (*self.construction.reading_design(raw, geometry[-1]), *geometry)
        local, *geometry = self._local(x)
        raw, *by = self.construction.readings_and_design(local, self.recording.face, geometry[-1])
        self._designs.clear()
        self._designs[key] = (raw, *geometry)
        return (*by, *geometry)

    def residual(self, x: Floats) -> Floats:
        """Predicted minus observed values (m,), divided by sigma."""
        raw, _, _, points, values = self._readings_and_geometry(x)
        gap = raw - self.recording.readings
        gap[:, 1:] = wrap_angle(gap[:, 1:])
        lengths = (self._gauge.predict(points) - self._gauge.lengths) / self._gauge.total_sigmas
        return np.concatenate([(gap / self._sigma).ravel(), lengths, values / self._prior_sigma])

    def jacobian(self, x: Floats) -> Floats:
        """Derivative (m, K) of the residual."""
        by_point, by_value, arm, turn, points, values = self._design_and_geometry(x)
        by_target = by_point @ np.swapaxes(turn, 1, 2) / self._sigma[:, :, None]
        by_pose = np.concatenate([-by_target, by_target @ cross_matrix(arm)], axis=2)
        n, (poses, targets) = len(arm), (6 * (len(self._start[0]) - 1), points.size)
        design = np.zeros((3 * n + len(self._gauge) + len(values), self.size))
        rows = np.arange(3 * n).reshape(n, 3, 1)
        moves = self.recording.station > 0
        columns = (6 * (self.recording.station - 1))[:, None, None] + np.arange(6)
        design[rows[moves], columns[moves]] = by_pose[moves]
        columns = poses + (3 * self.recording.target)[:, None, None] + np.arange(3)
        design[rows, columns] = by_target
        columns = np.arange(poses + targets, self.size)
        design[rows, columns] = by_value / self._sigma[:, :, None]
        self._add_reference_points(design, points, 3 * n, poses)
        design[3 * n + len(self._gauge) :, poses + targets :] = np.diag(1.0 / self._prior_sigma)
        return design

    def _add_reference_points(self, design: Floats, points: Floats, start: int, poses: int) -> None:
        gauge = self._gauge
        unit = gauge.line_directions(points) / gauge.total_sigmas[:, None]
        at = start + np.arange(len(gauge))[:, None]
        design[at, poses + 3 * gauge.first_targets[:, None] + np.arange(3)] = unit
        design[at, poses + 3 * gauge.second_targets[:, None] + np.arange(3)] = -unit


Solver = Callable[[DenseProblem], Floats]


def numpy_gauss_newton(problem: DenseProblem) -> Floats:
    """Solution (K,) by Gauss-Newton iterations on the normal equations."""
    x = np.zeros(problem.size)
    for _ in range(20):
        design = problem.jacobian(x)
        scale = 1.0 / np.linalg.norm(design, axis=0)
        scaled = design * scale
        step = scale * scipy.linalg.solve(scaled.T @ scaled, -scaled.T @ problem.residual(x), assume_a="pos")
        x = x + step
        if np.linalg.norm(design @ step) < 1e-4:
            break
    return x


def scipy_analytic(problem: DenseProblem) -> Floats:
    """Solution (K,) by `scipy.optimize.least_squares`, its fastest method, analytic Jacobian and scaled unknowns."""
    start = np.zeros(problem.size)
    scale = 1.0 / np.linalg.norm(problem.jacobian(start), axis=0)
    solution = least_squares(
        lambda z: problem.residual(scale * z),
        start,
        jac=lambda z: problem.jacobian(scale * z) * scale,
        method="lm",
        ftol=TOLERANCE,
        xtol=TOLERANCE,
        gtol=TOLERANCE,
    )
    x: Floats = scale * solution.x
    return x


def scipy_differences(problem: DenseProblem) -> Floats:
    """Solution (K,) by `scipy.optimize.least_squares` with finite differences.

    Only `trf` ends within 0.001 sigma of the optimum; `lm` ends at a distance of 0.1 sigma.
    """
    settings = {"x_scale": "jac", "ftol": TOLERANCE, "xtol": TOLERANCE, "gtol": TOLERANCE}
    x: Floats = least_squares(problem.residual, np.zeros(problem.size), jac="2-point", **settings).x
    return x


def pyceres_solver() -> Solver | None:
    """Ceres solver with one residual block and the analytic Jacobian; None if pyceres is not installed."""
    try:
        import pyceres
    except ImportError:
        return None

    class Block(pyceres.CostFunction):  # type: ignore[misc]
        def __init__(self, problem: DenseProblem, scale: Floats) -> None:
            super().__init__()
            self.problem, self.scale = problem, scale
            self.set_num_residuals(len(problem.residual(np.zeros(problem.size))))
            self.set_parameter_block_sizes([problem.size])

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:  # noqa: N802
            x = self.scale * parameters[0]
            residuals[:] = self.problem.residual(x)
            if jacobians is not None:
                jacobians[0][:] = (self.problem.jacobian(x) * self.scale).ravel()
            return True

    def solve(problem: DenseProblem) -> Floats:
        scale = 1.0 / np.linalg.norm(problem.jacobian(np.zeros(problem.size)), axis=0)
        x = np.zeros(problem.size)
        whole = pyceres.Problem()
        whole.add_residual_block(Block(problem, scale), None, [x])
        options = pyceres.SolverOptions()
        options.linear_solver_type = pyceres.LinearSolverType.DENSE_NORMAL_CHOLESKY
        options.function_tolerance = options.parameter_tolerance = options.gradient_tolerance = TOLERANCE
        options.num_threads = 1
        options.minimizer_progress_to_stdout = False
        pyceres.solve(options, whole, pyceres.SolverSummary())
        solution: Floats = scale * x
        return solution

    return solve
