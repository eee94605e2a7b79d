"""Gauss-Newton iteration with Levenberg-Marquardt damping, for any object with the methods of `LeastSquaresProblem`."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Generic, Protocol, TypeVar

from ltsim.core.arrays import Floats
from ltsim.core.errors import ConvergenceError
from ltsim.solve.elimination import BlockFactor, BlockSystem, SingularSystemError

UnknownsT = TypeVar("UnknownsT")
"""Type of one set of values of the unknowns."""
MAX_ITERATIONS = 60
"""Largest number of steps of an iteration that otherwise ends when its error is below a tolerance. If each step reduces
the error to 0.74 of the previous one or less, it is below `SQRT_MACHINE_EPSILON` (1.5e-8) after 60 steps; an iteration
that needs more steps counts as not convergent.
"""
MAX_DECISION_CHANGES = 6
"""Largest number of alternations between an estimate and a decision that depends on it: outliers, noise factors,
widened priors, selected causes. The alternation ends when the decision does not change; if decisions repeat in a cycle,
the last one counts.
"""
MAX_CONVERGENCE_RATIO = 0.9
"""Ratio of the lengths of successive steps, or of successive misclosures, up to which an iteration counts as
converging. It also bounds the estimated ratio in a secant step, which is then at most ten times the last change.
"""
SQUARED_STEP_TOLERANCE = 1e-8
"""Squared length of a step, in units of the standard deviations of the unknowns, below which the iteration has
converged."""
MAX_SQUARED_STEP_FOR_REUSE = 1.0
"""Squared length of a step, in units of the standard deviations of the unknowns, below which the next step uses the
same design matrix."""
MAX_PREDICTED_STEP_TO_TOLERANCE_RATIO = 1e-4
"""Ratio of the predicted squared length of the next step to `SQUARED_STEP_TOLERANCE` below which the next step is not
computed. Its length is then below a millionth of a standard deviation."""
MAX_NEGLIGIBLE_DAMPING = 1e-5
"""Levenberg-Marquardt damping up to which a short step counts as convergence. More damping itself shortens steps."""
MAX_SQUARED_ROUNDING_STEP = 1e-4
"""Squared length, in units of the standard deviations of the unknowns, below which steps that no longer decrease count
as rounding errors and end the iteration. Such errors occur with large coordinates."""


class LeastSquaresProblem(Protocol[UnknownsT]):
    """Interface of a nonlinear least-squares problem to the Gauss-Newton iteration.

    A point is one set of values of the unknowns. It may be any object, such as a network state with rotations.
    """

    def linearise(self, x: UnknownsT) -> BlockSystem:
        """Whitened linear system (design matrix and residuals) at the point x."""

    def whitened_residuals(self, x: UnknownsT) -> Floats:
        """Whitened residuals (m,) of m observations at the point x, computed without the design matrix."""

    def retract(self, point: UnknownsT, step: Floats) -> UnknownsT:
        """Point that results from `point` by a step (u,) of all u unknowns."""


class TerminationStatus(Enum):
    """Termination status of an iteration; the value of a member is its description for the user."""

    CONVERGED = "the last step was far below one standard deviation"
    STALLED = "no damped step reduces the sum of squares further"
    MAX_ITERATIONS_REACHED = "the limit of iterations was reached before the steps became small"
    SINGULAR = "the observations with their declared noise do not determine all unknowns"
    CONTRADICTORY = "the observations determine every unknown, but contradict each other too much for any further step"
    PLANNED = "nothing was solved: the observations are only planned"


@dataclass(frozen=True)
class Solution(Generic[UnknownsT]):
    """Result of the Gauss-Newton iteration: the last point and its linear system."""

    x: UnknownsT
    """Last point of the iteration: the values of the unknowns."""
    sum_of_squares: float
    """Sum of squared whitened residuals at the last point."""
    n_iterations: int
    """Number of iterations; 0 for planned observations."""
    status: TerminationStatus
    """Reason why the iteration ended."""
    factor: BlockFactor | None
    """Factorised undamped normal equations at the last point; None if they are singular."""
    system: BlockSystem
    """Whitened linear system at the last point."""

    @property
    def has_converged(self) -> bool:
        """True if the iteration converged to an optimum, or if the observations are only planned."""
        return self.status in (TerminationStatus.CONVERGED, TerminationStatus.PLANNED)

    def require_success(self) -> Solution[UnknownsT]:
        """Solution itself if the iteration converged; otherwise raises `ConvergenceError` with the status."""
        if not self.has_converged:
            raise ConvergenceError(f"the adjustment did not converge: {self.status.value}", self)
        return self


def solution_for_plan(problem: LeastSquaresProblem[UnknownsT], point: UnknownsT) -> Solution[UnknownsT]:
    """Solution for planned observations: the linear system at `point`, for the precision of the unknowns.

    Raises SingularSystemError if the observations do not determine all unknowns.
    """
    system = problem.linearise(point)
    return Solution(point, system.sum_of_squares, 0, TerminationStatus.PLANNED, BlockFactor(system), system)


def solve(
    problem: LeastSquaresProblem[UnknownsT], start_point: UnknownsT, *, max_iterations: int = 30
) -> Solution[UnknownsT]:
    """Minimum of a sum of squared residuals, by at most `max_iterations` iterations from `start_point`."""
    x, damping, previous_length, had_regular_normals = start_point, 0.0, float("inf"), False
    system = problem.linearise(x)
    for iteration in range(1, max_iterations + 1):
        factor, damping = _damped_factor(system, damping)
        had_regular_normals = had_regular_normals or (factor is not None and not damping)
        if factor is None:
            return Solution(
                x,
                system.sum_of_squares,
                iteration,
                TerminationStatus.CONTRADICTORY if had_regular_normals else TerminationStatus.SINGULAR,
                None,
                system,
            )
        step = factor.step()
        length = _squared_step_length(system, step)
        if not damping and length < MAX_SQUARED_ROUNDING_STEP and length > previous_length / 4:
            return Solution(x, system.sum_of_squares, iteration, TerminationStatus.CONVERGED, factor, system)
        # The ratio of the next step to this one is predicted as the ratio of this step to the previous one.
        sure = (
            length * length
            < MAX_PREDICTED_STEP_TO_TOLERANCE_RATIO * SQUARED_STEP_TOLERANCE * previous_length
            < float("inf")
        )
        trial, previous_length, near = (
            problem.retract(x, step),
            length,
            length < MAX_SQUARED_STEP_FOR_REUSE and not damping,
        )
        if near and sure:
            system = _system_after_step(system, system.whitened_residuals, step)
            return Solution(trial, system.sum_of_squares, iteration, TerminationStatus.CONVERGED, factor, system)
        if near:
            final = _step_with_previous_design(problem, trial, system, factor)
            if final is not None:
                x, system = final
                return Solution(x, system.sum_of_squares, iteration, TerminationStatus.CONVERGED, factor, system)
        del factor  # two designs are enough in memory
        ahead, whole = problem.linearise(trial), damping < MAX_NEGLIGIBLE_DAMPING
        if ahead.sum_of_squares <= system.sum_of_squares * (1 + 1e-12) + SQUARED_STEP_TOLERANCE or (
            whole and length < MAX_SQUARED_ROUNDING_STEP
        ):
            x, system = trial, ahead
            damping = 0.0 if damping < 1e-9 else damping / 10
            if whole and length < SQUARED_STEP_TOLERANCE:
                return _final_solution(
                    x, system, iteration, TerminationStatus.CONVERGED, had_regular_normals=had_regular_normals
                )
        elif damping > 1e8:
            return _final_solution(
                x, system, iteration, TerminationStatus.STALLED, had_regular_normals=had_regular_normals
            )
        else:
            damping = max(10 * damping, 1e-6)
    return _final_solution(
        x, system, max_iterations, TerminationStatus.MAX_ITERATIONS_REACHED, had_regular_normals=had_regular_normals
    )


def _squared_step_length(block_system: BlockSystem, step: Floats) -> float:
    """Squared length of a `step` (u,) of all u unknowns, in units of their standard deviations."""
    prediction_change = block_system.design @ step
    return float(prediction_change @ prediction_change)


def _step_with_previous_design(
    problem: LeastSquaresProblem[UnknownsT], point: UnknownsT, block_system: BlockSystem, normal_equations: BlockFactor
) -> tuple[UnknownsT, BlockSystem] | None:
    """Point and linear system after one more step with the previous design; None if the step is not below tolerance.

    `block_system` is the previous system, `normal_equations` its factor. After a step of one standard deviation the
    design matrix is the same to five digits. It is therefore used again, with the residuals at the new point.
    """
    residual = problem.whitened_residuals(point)
    step = normal_equations.step(residual)
    if not _squared_step_length(block_system, step) < SQUARED_STEP_TOLERANCE:
        return None
    return problem.retract(point, step), _system_after_step(block_system, residual, step)


def _system_after_step(block_system: BlockSystem, residual: Floats, step: Floats) -> BlockSystem:
    """Linear system with the same design matrix after a `step`; its residuals are `residual` minus design @ step."""
    return BlockSystem(block_system.design, residual - block_system.design @ step, block_system.n_retained)


def _damped_factor(block_system: BlockSystem, damping: float) -> tuple[BlockFactor | None, float]:
    """Factorised normal equations and their damping: `damping`, or a larger one if the normal matrix is singular.

    The factorisation is None if the matrix is singular even with a damping of 0.01.
    """
    while True:
        try:
            return BlockFactor(block_system, damping), damping
        except SingularSystemError:
            if damping >= 1e-2:
                return None, damping
            damping = max(100 * damping, 1e-10)


def _final_solution(
    point: UnknownsT,
    block_system: BlockSystem,
    n_iterations: int,
    termination_status: TerminationStatus,
    *,
    had_regular_normals: bool,
) -> Solution[UnknownsT]:
    """Solution at a point with undamped normal equations; if they are singular, its status states the cause.

    `had_regular_normals` is True if the normal equations were regular at an earlier point of the iteration.
    """
    try:
        factor = BlockFactor(block_system)
    except SingularSystemError:
        return Solution(
            point,
            block_system.sum_of_squares,
            n_iterations,
            TerminationStatus.CONTRADICTORY if had_regular_normals else TerminationStatus.SINGULAR,
            None,
            block_system,
        )
    return Solution(point, block_system.sum_of_squares, n_iterations, termination_status, factor, block_system)
