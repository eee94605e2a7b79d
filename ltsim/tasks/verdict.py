"""Conformity with a tolerance (JCGM 106), and the agreement of two results (E_n, ISO 13528)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import special

from ltsim.arrays import Floats
from ltsim.tasks.spec import Decision, Tolerance

Judgement = Literal["accepted", "rejected", "undecided"]


@dataclass(frozen=True)
class Conformity:
    """A result against its tolerance."""

    probability: float
    """That the true value lies within the tolerance, given the result."""
    guard: float
    """Width of the guard band inside each limit [unit of the result]."""
    judgement: Judgement
    """``accepted`` where the result lies within the limits less their guard bands, ``rejected`` where it lies outside
    them by more than the guard band, ``undecided`` between. A simple decision has no guard band.
    """
    wrong: float
    """Probability that the judgement is wrong: of a wrong acceptance or of a wrong rejection."""


def conformity(
    value: float, sigma: float, tolerance: Tolerance, decision: Decision, draws: Floats | None = None
) -> Conformity:
    """Judge a result (in the unit of the tolerance) by its distribution: the `draws`, or a normal one.

    References
    ----------
    JCGM 106:2012, clauses 7 (probability of conformity) and 8 (guard bands).
    """
    low = -np.inf if tolerance.lower is None else tolerance.lower
    high = np.inf if tolerance.upper is None else tolerance.upper
    if draws is not None:
        probability = float(np.mean((draws >= low) & (draws <= high)))
    elif sigma > 0:
        probability = float(special.ndtr((high - value) / sigma) - special.ndtr((low - value) / sigma))
    else:
        probability = float(low <= value <= high)
    guard = float(-special.ndtri(decision.risk)) * sigma if decision.rule == "guarded" else 0.0
    if low + guard <= value <= high - guard:
        return Conformity(probability, guard, "accepted", 1.0 - probability)
    if value < low - guard or value > high + guard:
        return Conformity(probability, guard, "rejected", probability)
    return Conformity(probability, guard, "undecided", min(probability, 1.0 - probability))


def normalised_error(value: float, expanded: float, other: float, other_expanded: float) -> float:
    """E_n = difference over the root of the squared expanded uncertainties; |E_n| <= 1 agrees."""
    together = float(np.hypot(expanded, other_expanded))
    gap = value - other
    return gap / together if together > 0 else (0.0 if gap == 0 else float(np.copysign(np.inf, gap)))
