"""Gauss-Newton with Levenberg-Marquardt damping: the loop, once, for any problem of the protocol."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Generic, Protocol, TypeVar

from ltsim.core.arrays import Floats
from ltsim.core.errors import ConvergenceError
from ltsim.solve.elimination import BlockFactor, BlockSystem, SingularSystemError

X = TypeVar("X")
TOLERANCE = 1e-8
"""Squared length of a step, measured by the normal matrix (in standard deviations), below which the end is reached."""
NEAR = 1.0
"""Squared length [standard deviations] of a step after which the last design is tried once more."""
SURE = 1e-4
"""Share of the tolerance below which the next step is not looked at: a millionth of a standard deviation."""
SLIGHT = 1e-5
"""Damping that leaves a step what it is: a short step under more of it proves nothing."""
ROUNDED = 1e-4
"""Squared length below which steps that no longer become shorter are rounding error (large coordinates)."""


class Problem(Protocol[X]):
    """Interface of a problem to the Gauss-Newton loop; a point X may be any object (a state with rotations)."""

    def linearise(self, x: X) -> BlockSystem:
        """The whitened linear system at x."""

    def residual(self, x: X) -> Floats:
        """The whitened residual of that system alone."""

    def retract(self, x: X, step: Floats) -> X:
        """The point reached from x by a step."""


class Status(Enum):
    """Termination status of an iteration, in a sentence for the user."""

    CONVERGED = "the last step was far below one standard deviation"
    STALLED = "no step, however damped, lowers the sum of squares further"
    CAPPED = "the cap on iterations was reached before the steps became small"
    SINGULAR = "some unknowns are not determined by the observations and their stated noise"
    LOST = "the observations contradict each other so far that no step leads on, although they determine every unknown"
    PLANNED = "nothing was solved: the state is where the observations are planned"


@dataclass(frozen=True)
class Solution(Generic[X]):
    """Result of the Gauss-Newton loop: the last point and its linear system."""

    x: X
    cost: float
    iterations: int
    status: Status
    factor: BlockFactor | None
    """Factorised undamped normal equations at x; None where they are singular."""
    system: BlockSystem

    @property
    def converged(self) -> bool:
        """True when x is the optimum: it was reached, or the observations are planned there."""
        return self.status in (Status.CONVERGED, Status.PLANNED)

    def require_success(self) -> Solution[X]:
        """The solution if it converged; raises `ConvergenceError` with the status sentence otherwise."""
        if not self.converged:
            raise ConvergenceError(f"the adjustment did not converge: {self.status.value}", self)
        return self


def planned(problem: Problem[X], x: X) -> Solution[X]:
    """The solution of observations that are to be made at x: all that is known of precision, nothing of readings.

    SingularSystemError when they would leave a direction undetermined.
    """
    system = problem.linearise(x)
    return Solution(x, system.cost, 0, Status.PLANNED, BlockFactor(system), system)


def solve(problem: Problem[X], start: X, *, cap: int = 30) -> Solution[X]:
    """Minimise a sum of squares from `start` in at most `cap` iterations."""
    x, damping, before, held = start, 0.0, float("inf"), False
    system = problem.linearise(x)
    for iteration in range(1, cap + 1):
        factor, damping = _damped(system, damping)
        held = held or (factor is not None and not damping)
        if factor is None:
            return Solution(x, system.cost, iteration, Status.LOST if held else Status.SINGULAR, None, system)
        step = factor.step()
        length = _length(system, step)
        if not damping and length < ROUNDED and length > before / 4:
            return Solution(x, system.cost, iteration, Status.CONVERGED, factor, system)
        # The next step is as much shorter than this one as this one was than the one before.
        sure = length * length < SURE * TOLERANCE * before < float("inf")
        trial, before, near = problem.retract(x, step), length, length < NEAR and not damping
        if near and sure:
            system = _after(system, system.residual, step)
            return Solution(trial, system.cost, iteration, Status.CONVERGED, factor, system)
        if near:
            final = _last_step(problem, trial, system, factor)
            if final is not None:
                x, system = final
                return Solution(x, system.cost, iteration, Status.CONVERGED, factor, system)
        del factor  # two designs are enough in memory
        ahead, whole = problem.linearise(trial), damping < SLIGHT
        if ahead.cost <= system.cost * (1 + 1e-12) + TOLERANCE or (whole and length < ROUNDED):
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
    """The end of the iteration with the design of the step before, which led to x; None where that is not the end.

    After a step of a standard deviation the design is the same to five digits: one more step with it, for the residual
    found there, ends below the tolerance.
    """
    residual = problem.residual(x)
    step = factor.step(residual)
    if not _length(system, step) < TOLERANCE:
        return None
    return problem.retract(x, step), _after(system, residual, step)


def _after(system: BlockSystem, residual: Floats, step: Floats) -> BlockSystem:
    """The system where a step led from `residual`, by the same design."""
    return BlockSystem(system.design, residual - system.design @ step, system.n_reduced)


def _damped(system: BlockSystem, damping: float) -> tuple[BlockFactor | None, float]:
    """The factor with at least `damping`, more where the normal matrix is singular."""
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
