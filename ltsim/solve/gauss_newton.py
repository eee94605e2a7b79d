"""Gauss-Newton iteration with Levenberg-Marquardt damping, for any problem that implements the protocol."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Generic, Protocol, TypeVar

from ltsim.core.arrays import Floats
from ltsim.core.errors import ConvergenceError
from ltsim.solve.elimination import BlockFactor, BlockSystem, SingularSystemError

X = TypeVar("X")
TOLERANCE = 1e-8
"""Squared length of a step, in the metric of the normal matrix (standard deviations), below which the iteration has
converged.
"""
REUSE_LIMIT = 1.0
"""Squared length [standard deviations] of a step below which the design is reused for one more step."""
CERTAIN_CONVERGENCE = 1e-4
"""Fraction of the tolerance below which no further step is computed: a millionth of a standard deviation."""
NEGLIGIBLE_DAMPING = 1e-5
"""Damping up to which a short step counts as convergence; with more damping steps are short anyway."""
ROUNDING_LENGTH = 1e-4
"""Squared length below which steps that no longer decrease are rounding errors (large coordinates)."""


class Problem(Protocol[X]):
    """Interface of a problem to the Gauss-Newton iteration.

    A point X may be any object, such as a state with rotations.
    """

    def linearise(self, x: X) -> BlockSystem:
        """Whitened linear system at x."""

    def residual(self, x: X) -> Floats:
        """Whitened residual of that system alone."""

    def retract(self, x: X, step: Floats) -> X:
        """Point that a step from x leads to."""


class Status(Enum):
    """Termination status of an iteration; the value is a sentence for the user."""

    CONVERGED = "the last step was far below one standard deviation"
    STALLED = "no damped step reduces the sum of squares further"
    CAPPED = "the limit of iterations was reached before the steps became small"
    SINGULAR = "the observations with their declared noise do not determine all unknowns"
    LOST = "the observations determine every unknown, but contradict each other too much for any further step"
    PLANNED = "nothing was solved: the observations are only planned"


@dataclass(frozen=True)
class Solution(Generic[X]):
    """Result of the Gauss-Newton iteration: the last point and its linear system."""

    x: X
    cost: float
    iterations: int
    status: Status
    factor: BlockFactor | None
    """Factorised undamped normal equations at x; None if they are singular."""
    system: BlockSystem

    @property
    def converged(self) -> bool:
        """True if x is the optimum, or the state for which observations are planned."""
        return self.status in (Status.CONVERGED, Status.PLANNED)

    def require_success(self) -> Solution[X]:
        """The solution if it converged; raises `ConvergenceError` with the status sentence otherwise."""
        if not self.converged:
            raise ConvergenceError(f"the adjustment did not converge: {self.status.value}", self)
        return self


def planned(problem: Problem[X], x: X) -> Solution[X]:
    """Solution of planned observations at x: it has precision, but no readings.

    Raises SingularSystemError if they leave a direction undetermined.
    """
    system = problem.linearise(x)
    return Solution(x, system.cost, 0, Status.PLANNED, BlockFactor(system), system)


def solve(problem: Problem[X], start: X, *, cap: int = 30) -> Solution[X]:
    """Minimum of a sum of squares from `start` in at most `cap` iterations."""
    x, damping, before, held = start, 0.0, float("inf"), False
    system = problem.linearise(x)
    for iteration in range(1, cap + 1):
        factor, damping = _damped(system, damping)
        held = held or (factor is not None and not damping)
        if factor is None:
            return Solution(x, system.cost, iteration, Status.LOST if held else Status.SINGULAR, None, system)
        step = factor.step()
        length = _length(system, step)
        if not damping and length < ROUNDING_LENGTH and length > before / 4:
            return Solution(x, system.cost, iteration, Status.CONVERGED, factor, system)
        # The next step is as much shorter than this one as this one was than the one before.
        sure = length * length < CERTAIN_CONVERGENCE * TOLERANCE * before < float("inf")
        trial, before, near = problem.retract(x, step), length, length < REUSE_LIMIT and not damping
        if near and sure:
            system = _system_after(system, system.residual, step)
            return Solution(trial, system.cost, iteration, Status.CONVERGED, factor, system)
        if near:
            final = _last_step(problem, trial, system, factor)
            if final is not None:
                x, system = final
                return Solution(x, system.cost, iteration, Status.CONVERGED, factor, system)
        del factor  # two designs are enough in memory
        ahead, whole = problem.linearise(trial), damping < NEGLIGIBLE_DAMPING
        if ahead.cost <= system.cost * (1 + 1e-12) + TOLERANCE or (whole and length < ROUNDING_LENGTH):
            x, system = trial, ahead
            damping = 0.0 if damping < 1e-9 else damping / 10
            if whole and length < TOLERANCE:
                return _finish(x, system, iteration, Status.CONVERGED, held=held)
        elif damping > 1e8:
            return _finish(x, system, iteration, Status.STALLED, held=held)
        else:
            damping = max(10 * damping, 1e-6)
    return _finish(x, system, cap, Status.CAPPED, held=held)


def _length(system: BlockSystem, step: Floats) -> float:
    """Squared length of a step in standard deviations."""
    moved = system.design @ step
    return float(moved @ moved)


def _last_step(problem: Problem[X], x: X, system: BlockSystem, factor: BlockFactor) -> tuple[X, BlockSystem] | None:
    """Final point and system by a step with the previous design; None if the iteration has not converged with it.

    After a step of a standard deviation the design is the same to five digits: one more step with it, for the residual
    found there, ends below the tolerance.
    """
    residual = problem.residual(x)
    step = factor.step(residual)
    if not _length(system, step) < TOLERANCE:
        return None
    return problem.retract(x, step), _system_after(system, residual, step)


def _system_after(system: BlockSystem, residual: Floats, step: Floats) -> BlockSystem:
    """System after a step, with the same design and the residual of the new point."""
    return BlockSystem(system.design, residual - system.design @ step, system.n_reduced)


def _damped(system: BlockSystem, damping: float) -> tuple[BlockFactor | None, float]:
    """Factor with at least `damping`, more if the normal matrix is singular, and the damping used."""
    while True:
        try:
            return BlockFactor(system, damping), damping
        except SingularSystemError:
            if damping >= 1e-2:
                return None, damping
            damping = max(100 * damping, 1e-10)


def _finish(x: X, system: BlockSystem, iteration: int, status: Status, *, held: bool) -> Solution[X]:
    try:
        factor = BlockFactor(system)
    except SingularSystemError:
        return Solution(x, system.cost, iteration, Status.LOST if held else Status.SINGULAR, None, system)
    return Solution(x, system.cost, iteration, status, factor, system)
