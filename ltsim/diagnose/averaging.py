"""Targets after a diagnosis: averaged over the explanations that the recording leaves open.

Each explanation shifts the adjusted coordinates; sizes are shrunk by their prior, and what cannot be told apart is
averaged by its probability, no effect at all among it (Bayesian model averaging; Hoeting et al. 1999, Statistical
Science 14). The covariance adds what the explanations disagree by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ltsim.arrays import Floats
from ltsim.diagnose.diagnosis import Targets
from ltsim.diagnose.evidence import posterior, shares, wide_posterior
from ltsim.diagnose.law import Law
from ltsim.diagnose.noise import NoisePattern
from ltsim.diagnose.refit import Refit
from ltsim.diagnose.search import Searcher
from ltsim.diagnose.sets import Found, Hypothesis, Ranking
from ltsim.diagnose.shapes import all_shapes
from ltsim.effects.effect import NoiseEffect

MOST_OPEN = 12
LEAST = 0.003
"""Explanations less probable than this do not count."""


def averaged_targets(searcher: Searcher, found: Found, rankings: Sequence[Ranking], fitted: Refit) -> Targets:
    """The targets of a refit, moved by what other explanations of each finding would move them, times their chance."""
    adjusted = fitted.adjustment
    points, covariance = adjusted.state.points.copy(), adjusted.target_covariance.copy()
    for i, ranking in enumerate(rankings):
        others = searcher.without(found, i)
        weights, shifts = _open(searcher, others, found.members[i], ranking)
        mean = np.einsum("k,kti->ti", weights, shifts)
        refitted = replace(found.members[i], effect=fitted.effects[i])
        points += mean - shift_of(searcher, others, refitted, wide=True)
        apart = shifts - mean
        covariance += np.einsum("k,kti,ktj->tij", weights, apart, apart)
    return Targets(points, covariance)


def _open(searcher: Searcher, others: Found, chosen: Hypothesis, ranking: Ranking) -> tuple[Floats, Floats]:
    """Probabilities (k,) of explanations, the chosen one first, and the shift (k, T, 3) of the targets by each."""
    none, *rest_of = shares(np.array([0.0, *(h.value for h in ranking.entries)])).tolist()
    likely = [(h, p) for h, p in zip(ranking.entries, rest_of, strict=True) if p > LEAST]
    entries = [(h, p) for h, p in likely if not isinstance(h.effect, NoiseEffect | NoisePattern)]
    entries = [(h, p) for h, p in entries[:MOST_OPEN] if h.key != chosen.key]
    rest = max(1.0 - none - sum(p for _, p in entries), 0.0)
    told = _shaped(searcher, others, chosen)
    shifts = [shift_of(searcher, others, h) for h, _ in (*told, *entries)]
    shifts.append(np.zeros_like(shifts[0]))
    weights = np.array([*(rest * p for _, p in told), *(p for _, p in entries), none])
    return weights / weights.sum(), np.array(shifts)


def _shaped(searcher: Searcher, others: Found, chosen: Hypothesis) -> list[tuple[Hypothesis, float]]:
    """An explanation with the likeliest of its shapes, and their probabilities."""
    shapes = [] if isinstance(chosen.effect, Law) else all_shapes(searcher, chosen.effect, others, {}, plausible=True)
    if not shapes:
        return [(chosen, 1.0)]
    weights = shares(np.array([one.log_weight for one in shapes]))
    ranked = sorted(zip(shapes, weights, strict=True), key=lambda pair: -pair[1])[:MOST_OPEN]
    return [(replace(chosen, effect=one.effect), float(p)) for one, p in ranked if p > LEAST]


def shift_of(searcher: Searcher, others: Found, hypothesis: Hypothesis, *, wide: bool = False) -> Floats:
    """Shift (T, 3) [m] of the adjusted targets when an explanation is taken out of the readings.

    Its size is shrunk by its prior, or, `wide`, that of the refit.
    """
    moments = searcher.moments(hypothesis.effect, others)
    mean = (wide_posterior if wide else posterior)(*moments, hypothesis.spread)[0]
    return -searcher.space.moved_targets(searcher.space.signature(hypothesis.effect) @ mean)
