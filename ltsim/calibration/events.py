"""Events in a history: steps of a parameter that stand out of how it moves from one calibration to the next.

A tracker's parameters move from day to day, more than their standard deviations say, and that is no event. The spread
of the steps is found from the steps themselves; a step is judged by the spread of the others, the one that stands out
most is taken out, and the rest is judged again (a service and a blow do not hide each other).

Where the days between calibrations are known, part of that spread may grow with them (a random walk) and part may not
(what every calibration brings anew): variance s^2 (1 - g + g days / median days). No g is chosen: the chance of a step
is the mean over `SHARES`, each weighted by how likely it makes the other steps.
"""

import numpy as np
from scipy import special

from ltsim.calibration.history import LEVEL, History
from ltsim.calibration.history_schema import EventEntry
from ltsim.core.arrays import Bools, Floats, Ints

LEAST_STEPS = 3
"""Steps from which one can stand out of the others; with so few only a gross one does."""
ENOUGH_STEPS = 5
"""Steps that a spread of their own can be told from, so that a step that does not stand out is a usual one."""
SHARES = np.linspace(0.0, 1.0, 5)
"""Parts of the variance of usual steps that grow with the days between."""


def can_tell(history: History) -> bool:
    """Whether there are steps enough for one to stand out of the others."""
    return len(history) > LEAST_STEPS


def events(history: History) -> tuple[EventEntry, ...]:
    """The steps that stand out, in the order of time; none where there are too few to tell.

    Each by the chance of as large a one over all steps and parameters (Bonferroni).
    """
    if not can_tell(history):
        return ()
    steps = [change.parameters for change in history.changes()]
    difference, sigma = (np.array([[getattr(p, key) for p in own] for own in steps]) for key in ("difference", "sigma"))
    known = np.flatnonzero((sigma > 0).all(axis=0)).tolist()
    growth, looks = _growth(history), len(steps) * max(len(known), 1)
    each = {k: _steps(difference[:, k], sigma[:, k], growth, LEVEL / looks) for k in known}
    found = sorted((i, k, usual, p) for k, own in each.items() for i, usual, p in own)
    return tuple(
        EventEntry(
            **{"from": history.labels[i], "to": history.labels[i + 1]},
            name=history.construction.names[k],
            unit=history.construction.parameters[k].unit,
            difference=difference[i, k],
            sigma=sigma[i, k],
            usual=usual,
            p_value=min(1.0, p * looks),
        )
        for i, k, usual, p in found
    )


def _growth(history: History) -> Floats:
    """Days of each step over their median; ones where they are not known."""
    between = np.diff(history.days) if history.days is not None else np.zeros(0)
    middle = float(np.median(between)) if len(between) else 0.0
    return between / middle if middle > 0 else np.ones(len(history) - 1)


def _steps(difference: Floats, sigma: Floats, growth: Floats, level: float) -> list[tuple[int, float, float]]:
    """Steps (K - 1,) of one parameter that stand out at a level: which, how large they usually are, and the chance."""
    usual: Bools = np.ones(len(difference), dtype=bool)
    found: list[tuple[int, float, float]] = []
    while usual.sum() > LEAST_STEPS - 1:
        steps = np.flatnonzero(usual)
        judged = [_judged(difference, sigma, growth, int(i), steps[steps != i]) for i in steps]
        best = int(np.argmin([p for p, _ in judged]))
        p, spread = judged[best]
        if p >= level:
            break
        usual[steps[best]] = False
        found.append((int(steps[best]), spread, p))
    return found


def _judged(difference: Floats, sigma: Floats, growth: Floats, step: int, others: Ints) -> tuple[float, float]:
    """Two-sided chance of a step by the spread of the others, and its usual size beyond the standard deviations."""
    likelihood, chance, usual = np.zeros(len(SHARES)), np.zeros(len(SHARES)), np.zeros(len(SHARES))
    for n, share in enumerate(SHARES):
        shape = 1.0 - share + share * growth
        scale = _scale(difference[others], sigma[others], shape[others])
        variance = sigma**2 + scale * shape
        gap = difference[others] ** 2 / variance[others] + np.log(variance[others] / sigma[others] ** 2)
        likelihood[n] = -0.5 * float(np.sum(gap))
        chance[n] = 2.0 * special.stdtr(len(others), -abs(difference[step]) / np.sqrt(variance[step]))
        usual[n] = scale * shape[step]
    weight = np.exp(likelihood - likelihood.max())
    weight /= weight.sum()
    return float(weight @ chance), float(np.sqrt(weight @ usual))


def _scale(difference: Floats, sigma: Floats, shape: Floats) -> float:
    """The variance (0 at least) that, times `shape`, makes chi-square the number of steps beside the estimates'."""
    from scipy.optimize import brentq  # a tenth of a second that few need

    def excess(variance: float) -> float:
        return float(np.sum(difference**2 / (sigma**2 + variance * shape))) - len(difference)

    if excess(0.0) <= 0:
        return 0.0
    highest = float(np.sum(difference**2))
    while excess(highest) > 0:  # steps without time between them have no part of what grows
        if highest > MOST * float(np.sum(difference**2)):
            return highest
        highest *= 10.0
    return float(brentq(excess, 0.0, highest, rtol=1e-6))


MOST = 1e6
"""Largest variance that is tried, over the sum of squared steps: the search ends there where no finite one suffices."""
