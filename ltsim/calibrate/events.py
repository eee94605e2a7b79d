"""Events in a history: steps of a parameter that stand out of how it moves from one calibration to the next.

A tracker's parameters move from day to day, more than their standard deviations say, and that is no event. The spread
of the steps is found from the steps themselves; a step is judged by the spread of the others, the one that stands out
most is taken out, and the rest is judged again (a service and a blow do not hide each other).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize, special

from ltsim.arrays import Bools, Floats, Ints
from ltsim.calibrate.history import LEVEL, History

LEAST_STEPS = 5
"""Steps that a spread of their own can be told from."""


@dataclass(frozen=True)
class Event:
    """One step of one parameter.

    Attributes
    ----------
    step : int
        From calibration number `step` to the next.
    parameter : int
    difference, sigma : float [SI]
        Later minus earlier, and its standard deviation by the two calibrations.
    usual : float [SI]
        Standard deviation of the parameter's own steps, without that of their estimates.
    p_value : float
        Over all steps and parameters (Bonferroni).
    """

    step: int
    parameter: int
    difference: float
    sigma: float
    usual: float
    p_value: float


def can_tell(history: History) -> bool:
    """Whether there are steps enough to know how a parameter moves from one calibration to the next."""
    return len(history) > LEAST_STEPS


def events(history: History, level: float = LEVEL) -> list[Event]:
    """The steps that stand out, in the order of time; none where there are too few to tell."""
    if not can_tell(history):
        return []
    changes = history.changes()
    difference = np.array([change.difference for change in changes])
    sigma = np.array([change.sigma for change in changes])
    known = np.flatnonzero((sigma > 0).all(axis=0))
    looks = len(changes) * max(len(known), 1)
    found: list[Event] = []
    for k in known.tolist():
        found += _of_parameter(difference[:, k], sigma[:, k], k, level, looks)
    return sorted(found, key=lambda event: (event.step, event.parameter))


def _of_parameter(difference: Floats, sigma: Floats, parameter: int, level: float, looks: int) -> list[Event]:
    usual: Bools = np.ones(len(difference), dtype=bool)
    found: list[Event] = []
    while usual.sum() > LEAST_STEPS - 1:
        steps = np.flatnonzero(usual)
        judged = [_judged(difference, sigma, int(i), steps[steps != i]) for i in steps]
        best = int(np.argmin([p for p, _ in judged]))
        p, spread = judged[best]
        if p * looks >= level:
            break
        i = int(steps[best])
        usual[i] = False
        found.append(Event(i, parameter, float(difference[i]), float(sigma[i]), spread, min(1.0, p * looks)))
    return found


def _judged(difference: Floats, sigma: Floats, step: int, others: Ints) -> tuple[float, float]:
    """Two-sided chance of a step by the spread of the others, and that spread beyond their standard deviations."""
    spread = _spread(difference[others], sigma[others])
    t = difference[step] / np.hypot(sigma[step], spread)
    return float(2.0 * special.stdtr(len(others), -abs(t))), spread


def _spread(difference: Floats, sigma: Floats) -> float:
    """The spread that, added to the standard deviations, makes chi-square equal to the number of steps; 0 at least."""

    def excess(variance: float) -> float:
        return float(np.sum(difference**2 / (sigma**2 + variance))) - len(difference)

    if excess(0.0) <= 0:
        return 0.0
    return float(np.sqrt(optimize.brentq(excess, 0.0, float(np.sum(difference**2)), rtol=1e-6)))
