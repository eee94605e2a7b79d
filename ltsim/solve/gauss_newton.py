"""Gauss-Newton iteration with Levenberg-Marquardt damping, for any object with the methods of `LeastSquaresProblem`."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Generic, Protocol, TypeVar

from ltsim.core.arrays import Floats
from ltsim.core.errors import ConvergenceError
from ltsim.solve.elimination import BlockSystem, FactorisedNormals, SingularSystemError

UnknownsT = TypeVar("UnknownsT")
"""Type of the values of all unknowns, for example `NetworkState`."""
MAX_ITERATIONS = 60
"""Largest number of steps of any iteration that normally ends at a tolerance. If each step multiplies the error by 0.74
or less, the error is below `SQRT_MACHINE_EPSILON` (1.5e-8) after 60 steps. An iteration that needs more steps counts as
not convergent.
"""
MAX_DECISION_CHANGES = 6
"""Largest number of alternations between an estimate and a decision that depends on it, for example on outliers,
widened priors or selected causes. The alternation ends when the decision does not change. If decisions repeat in a
cycle, the last one counts.
"""
MAX_CONVERGENCE_RATIO = 0.9
"""Largest ratio of a step (or misclosure) to the previous one in a converging iteration. A secant step uses at most
this ratio too, so that it is at most ten times the last change."""
SQUARED_STEP_TOLERANCE = 1e-8
"""Squared length of a step, in units of the standard deviations of the unknowns, at which the iteration has converged.
"""
MAX_SQUARED_STEP_FOR_REUSE = 1.0
"""Limit of the squared length of a step, in units of the standard deviations of the unknowns. After a shorter step, the
next step uses the same design matrix, to save its computation."""
MAX_PREDICTED_STEP_TO_TOLERANCE_RATIO = 1e-4
"""Limit of the predicted squared length of the next step, divided by `SQUARED_STEP_TOLERANCE`. If the ratio is smaller,
the next step is not computed, because its length is below a millionth of a standard deviation."""
MAX_NEGLIGIBLE_DAMPING = 1e-5
"""Limit of the Levenberg-Marquardt damping for convergence. With a larger damping a short step is no convergence,
because the damping itself shortens the steps."""
MAX_SQUARED_ROUNDING_STEP = 1e-4
"""Limit of the squared length of steps, in units of the standard deviations of the unknowns. Shorter steps that no
longer decrease count as rounding errors and end the iteration. Such errors occur with large coordinates."""


class LeastSquaresProblem(Protocol[UnknownsT]):
    """Interface of a nonlinear least-squares problem to the Gauss-Newton iteration.

    The values of the unknowns may be any object, such as a `NetworkState` with rotation matrices.
    """

    def linearise(self, x: UnknownsT) -> BlockSystem:
        """Whitened linear system (design matrix and residuals) at the values `x` of the unknowns."""

    def whitened_residuals(self, x: UnknownsT) -> Floats:
        """Whitened residuals (m,) of m observations at the values `x` of the unknowns, without the design matrix."""

    def retract(self, values: UnknownsT, step: Floats) -> UnknownsT:
        """Values of the unknowns after a `step` (u,) of all u unknowns from `values`."""


class TerminationStatus(Enum):
    """Termination status of the Gauss-Newton iteration; the value of a member is its description for the user."""

    CONVERGED = "the last step was far below one standard deviation"
    STALLED = "no damped step reduces the sum of squares further"
    MAX_ITERATIONS_REACHED = "the limit of iterations was reached before the steps became small"
    SINGULAR = "the observations with their declared noise do not determine all unknowns"
    CONTRADICTORY = "the observations determine every unknown, but contradict each other too much for any further step"
    PLANNED = "nothing was solved: the observations are only planned"


@dataclass(frozen=True)
class Solution(Generic[UnknownsT]):
    """Result of the Gauss-Newton iteration: last values of the unknowns, linear system and termination status."""

    x: UnknownsT
    """Values of the unknowns after the last iteration."""
    sum_of_squares: float
    """Sum of squared whitened residuals at the values `x` of the unknowns."""
    n_iterations: int
    """Number of iterations; 0 for planned observations."""
    status: TerminationStatus
    """Reason why the iteration ended."""
    factor: FactorisedNormals | None
    """Factorised undamped normal equations at the values `x` of the unknowns; None if they are singular."""
    system: BlockSystem
    """Whitened linear system at the values `x` of the unknowns."""

    @property
    def has_converged(self) -> bool:
        """True if the iteration converged, or if the observations are only planned and nothing was iterated."""
        return self.status in (TerminationStatus.CONVERGED, TerminationStatus.PLANNED)

    def require_success(self) -> Solution[UnknownsT]:
        """The solution itself if the iteration converged; otherwise `ConvergenceError` with the status is raised."""
        if not self.has_converged:
            raise ConvergenceError(f"the adjustment did not converge: {self.status.value}", self)
        return self


def solution_for_plan(problem: LeastSquaresProblem[UnknownsT], unknowns: UnknownsT) -> Solution[UnknownsT]:
    """Solution for planned observations at the values `unknowns`, for the precision of the unknowns; no iteration.

    Raises SingularSystemError if the observations do not determine all unknowns.
    """
    system = problem.linearise(unknowns)
    return Solution(unknowns, system.sum_of_squares, 0, TerminationStatus.PLANNED, FactorisedNormals(system), system)


def solve(
    problem: LeastSquaresProblem[UnknownsT], start_values: UnknownsT, *, max_iterations: int = 30
) -> Solution[UnknownsT]:
    """Least-squares solution by the Gauss-Newton iteration with Levenberg-Marquardt damping.

    The iteration starts at the values `start_values` of the unknowns and has at most `max_iterations` steps.
    """
    x, damping, previous_length, had_regular_normals = start_values, 0.0, float("inf"), False
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
    """Squared length of a `step` (u,) of u unknowns, in units of their standard deviations (Mahalanobis)."""
    prediction_change = block_system.design @ step
    return float(prediction_change @ prediction_change)


def _step_with_previous_design(
    problem: LeastSquaresProblem[UnknownsT],
    unknowns: UnknownsT,
    block_system: BlockSystem,
    normal_equations: FactorisedNormals,
) -> tuple[UnknownsT, BlockSystem] | None:
    """Values of the unknowns and linear system after one more step with the previous design matrix.

    The result is None if this step is longer than `SQUARED_STEP_TOLERANCE`. `unknowns` are the present values,
    `block_system` is the previous system and `normal_equations` its factor. After a step of one standard deviation the
    design matrix is the same to five digits. It is therefore used again, with new residuals.
    """
    residual = problem.whitened_residuals(unknowns)
    step = normal_equations.step(residual)
    if not _squared_step_length(block_system, step) < SQUARED_STEP_TOLERANCE:
        return None
    return problem.retract(unknowns, step), _system_after_step(block_system, residual, step)


def _system_after_step(block_system: BlockSystem, residual: Floats, step: Floats) -> BlockSystem:
    """Linear system with the same design matrix and the residuals that remain of `residual` after a `step`."""
    return BlockSystem(block_system.design, residual - block_system.design @ step, block_system.n_retained)


def _damped_factor(block_system: BlockSystem, damping: float) -> tuple[FactorisedNormals | None, float]:
    """Factorised normal equations and their damping: `damping`, or larger if the normal matrix is singular.

    The factorised normal equations are None if the matrix is singular even with a damping of 0.01.
    """
    while True:
        try:
            return FactorisedNormals(block_system, damping), damping
        except SingularSystemError:
            if damping >= 1e-2:
                return None, damping
            damping = max(100 * damping, 1e-10)


def _final_solution(
    unknowns: UnknownsT,
    block_system: BlockSystem,
    n_iterations: int,
    termination_status: TerminationStatus,
    *,
    had_regular_normals: bool,
) -> Solution[UnknownsT]:
    """Solution at the values `unknowns`, with undamped normal equations and `termination_status`.

    If the normal equations are singular, the status is `CONTRADICTORY` or `SINGULAR`: with `had_regular_normals` they
    were regular in an earlier iteration, so that contradicting observations are the cause.
    """
    try:
        factor = FactorisedNormals(block_system)
    except SingularSystemError:
        return Solution(
            unknowns,
            block_system.sum_of_squares,
            n_iterations,
            TerminationStatus.CONTRADICTORY if had_regular_normals else TerminationStatus.SINGULAR,
            None,
            block_system,
        )
    return Solution(unknowns, block_system.sum_of_squares, n_iterations, termination_status, factor, block_system)
