"""Variance components: how large the noise of each observable, or of each instrument, shows itself to be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ltsim.adjust.problem import NetworkProblem
from ltsim.adjust.reliability import redundancy_of
from ltsim.arrays import Bools, Floats, Ints
from ltsim.model.measurement import State
from ltsim.recording.recording import OBSERVABLES
from ltsim.solve.gauss_newton import Solution

Grouping = Literal["observable", "instrument"]
CLOSE = 2e-3
PASSES = 50
LEAST = 3.0
"""Redundancy below which a group says too little about its noise: it keeps the stated one."""


@dataclass(frozen=True)
class Component:
    """The noise of one group of readings.

    Attributes
    ----------
    observable : str
    instrument : str
        '' where all instruments are one group.
    factor : float
        On the stated standard deviations.
    sigma : float
        One standard deviation of `factor`; infinite where it could not be estimated.
    redundancy : float
        Of the group's readings together.
    """

    observable: str
    instrument: str
    factor: float
    sigma: float
    redundancy: float

    @property
    def is_stated(self) -> bool:
        """Whether the stated noise lies within three standard deviations."""
        return not abs(self.factor - 1.0) > 3.0 * self.sigma


def estimated_components(
    problem: NetworkProblem,
    solution: Solution[State],
    grouping: Grouping,
    find: Callable[[NetworkProblem, State], tuple[NetworkProblem, Solution[State]]],
    use: Bools | None = None,
) -> tuple[NetworkProblem, Solution[State], tuple[Component, ...]]:
    """The problem with its standard deviations scaled group by group until each agrees with its residuals.

    `find` solves a problem, perhaps leaving readings out; it is offered all of `use` (n, 3) anew each time.

    References
    ----------
    Foerstner, Ein Verfahren zur Schaetzung von Varianz- und Kovarianzkomponenten, AVN 86 (1979) 446: the variance of
    a group is its weighted sum of squares over its redundancy, iterated to one. Where it converges it is the
    maximum likelihood of the residuals (Helmert's estimate).
    """
    group = _groups(problem, grouping)
    count = int(group.max()) + 1
    factor = np.ones(count)
    stated, redundancy = problem.sigma, np.zeros(count, dtype=np.float64)
    available = problem.use if use is None else use
    for _ in range(PASSES):
        if solution.factor is None:
            break
        used = problem.use
        share = redundancy_of(problem, solution.factor)[used]
        whitened = (problem.residuals(problem.model.predict(solution.x)) / problem.sigma)[used]
        redundancy = np.bincount(group[used], share, count).astype(np.float64)
        square = np.bincount(group[used], whitened**2, count)
        enough = redundancy > LEAST
        change = np.where(enough, np.sqrt(square / np.where(enough, redundancy, 1.0)), 1.0)
        factor = factor * np.maximum(change, 0.1)
        whole = replace(problem, sigma=stated * factor[group], use=available)
        problem, solution = find(whole, solution.x)
        if np.max(np.abs(change - 1.0)) < CLOSE:
            break
    return problem, solution, _components(problem, grouping, factor, redundancy)


def _groups(problem: NetworkProblem, grouping: Grouping) -> Ints:
    """Group (n, 3) of every reading."""
    observable = np.broadcast_to(np.arange(3), problem.use.shape)
    if grouping == "observable":
        return observable
    return 3 * problem.model.recording.instrument[:, None] + observable


def _components(
    problem: NetworkProblem, grouping: Grouping, factor: Floats, redundancy: Floats
) -> tuple[Component, ...]:
    names = problem.model.recording.instruments if grouping == "instrument" else ("",)
    sigma = np.where(redundancy > LEAST, factor / np.sqrt(2 * np.maximum(redundancy, LEAST)), np.inf)
    return tuple(
        Component(OBSERVABLES[k % 3], names[k // 3], float(factor[k]), float(sigma[k]), float(redundancy[k]))
        for k in range(len(factor))
    )
