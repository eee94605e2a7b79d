"""Targets after a diagnosis: averaged over the explanations that the recording leaves open.

Each explanation shifts the adjusted coordinates; sizes are shrunk by their prior, and what cannot be told apart is
averaged by its probability, no effect at all among it (Bayesian model averaging; Hoeting et al. 1999, Statistical
Science 14). The curve of a law that nobody knows is not quite right, and differences of evidence smaller than that may
show tell nothing between laws. The covariance adds what the explanations disagree by.

The shift s of the targets by laws that nobody knows is taken off as far as it is safe. Before, coordinates err by s and
by an error e of which s tells nothing; taking off t s makes the sum of squares grow by t^2 s's - 2 t (s's + s'e), a
normal variable.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.refit import Refit
from ltsim.core.arrays import Floats
from ltsim.diagnosis.diagnosis import Targets
from ltsim.diagnosis.evidence import posterior, shares, wide_posterior
from ltsim.diagnosis.hypotheses import Found, Hypothesis, Ranking
from ltsim.diagnosis.search import Searcher
from ltsim.diagnosis.shapes import all_shapes
from ltsim.geometry.rigid import less_rigid
from ltsim.physics.effects.effect import NoiseEffect
from ltsim.physics.laws.law import Law
from ltsim.physics.laws.variance import VarianceFunction

WORSE, HARM = 0.05, 0.03
"""Share by which the error of coordinates may grow when a law is taken off, and the chance that it grows by more."""
MOST_OPEN, LEAST = 12, 0.003
"""Explanations that are averaged at most, and the probability below which one does not count."""


def averaged_targets(searcher: Searcher, found: Found, rankings: Sequence[Ranking], fitted: Refit) -> Targets:
    """The targets of a refit, moved by what other explanations of each finding would move them, times their chance."""
    refitted = [replace(h, effect=effect) for h, effect in zip(found.members, fitted.effects, strict=True)]
    points = fitted.adjustment.state.points - together(searcher, searcher.with_members(refitted))
    by_laws, open_ = np.zeros_like(points), [np.zeros((0, *points.shape))]
    for i, ranking in enumerate(rankings):
        others = searcher.without(found, i)
        weights, shifts = _open(searcher, others, found.members[i], ranking, 1.0 + found.misfit)
        mean = np.einsum("k,kti->ti", weights, shifts)
        points += mean
        by_laws += mean if not found.members[i].known else 0.0
        open_.append(np.sqrt(weights)[:, None, None] * (shifts - mean))
    apart = np.concatenate(open_)
    kept = (1.0 - _safe_share(fitted.adjustment, by_laws, apart)) * by_laws
    spread = np.concatenate([apart, kept[None]])
    covariance = fitted.adjustment.target_covariance + np.einsum("kti,ktj->tij", spread, spread)
    return Targets(points - kept, covariance, spread)


def _safe_share(adjusted: Adjustment, change: Floats, apart: Floats) -> float:
    """The largest share of a change (T, 3) [m] of the targets that is safe; explanations are (k, T, 3) apart."""
    problem, points = adjusted.problem, np.nan_to_num(adjusted.state.points)
    shift = less_rigid(np.nan_to_num(change).reshape(-1, 1), points - points.mean(axis=0), problem.free)[:, 0]
    along = np.zeros(adjusted.solution.system.design.shape[1])
    along[problem.unknowns.target.ravel()] = shift
    disagreed = np.nan_to_num(apart).reshape(len(apart), len(shift)) @ shift
    spread = float(along @ adjusted.factor.covariance_columns(along[:, None])[:, 0] + disagreed @ disagreed)
    noise = float(np.nansum(np.einsum("tii->t", adjusted.target_covariance)) + np.nansum(apart**2))
    return safe_share(float(shift @ shift), spread, noise)


def safe_share(size: float, spread: float, noise: float) -> float:
    """The largest share t of s to take off, with which t^2 s's - 2 t (s's + s'e) is small but for a chance of `HARM`.

    Small is ((1 + WORSE)^2 - 1) (s's + e'e), e'e at its expectation.

    Parameters
    ----------
    size, spread, noise : float
        s's, the variance of s'e, the expectation of e'e.
    """
    if size == 0.0:
        return 1.0
    bad = -float(ndtri(HARM)) * np.sqrt(spread) - size
    grown = ((1.0 + WORSE) ** 2 - 1.0) * (size + noise)
    return min(1.0, float(np.sqrt(bad**2 + size * grown) - bad) / size)


def _open(
    searcher: Searcher, others: Found, chosen: Hypothesis, ranking: Ranking, blur: float
) -> tuple[Floats, Floats]:
    """Probabilities (k,) of explanations, the chosen one first, and the shift (k, T, 3) of the targets by each.

    Evidence tells explanations apart by its parts of `blur`.
    """
    none, *rest_of = shares(np.array([0.0, *(h.value for h in ranking.entries)]) / blur).tolist()
    likely = [(h, p) for h, p in zip(ranking.entries, rest_of, strict=True) if p > LEAST]
    entries = [(h, p) for h, p in likely if not isinstance(h.effect, NoiseEffect | VarianceFunction)]
    entries = [(h, p) for h, p in entries[:MOST_OPEN] if h.key != chosen.key]
    rest = max(1.0 - none - sum(p for _, p in entries), 0.0)
    told = _shaped(searcher, others, chosen)
    shifts = [shift_of(searcher, others, h) for h, _ in (*told, *entries)]
    shifts.append(np.zeros_like(shifts[0]))
    weights = np.array([*(rest * p for _, p in told), *(p for _, p in entries), none])
    return weights / weights.sum(), np.array(shifts)


def _shaped(searcher: Searcher, others: Found, chosen: Hypothesis) -> list[tuple[Hypothesis, float]]:
    """An explanation with the likeliest of its shapes, and their probabilities."""
    shapes = (
        [] if isinstance(chosen.effect, Law) else all_shapes(searcher.exact, chosen.effect, others, {}, plausible=True)
    )
    if not shapes:
        return [(chosen, 1.0)]
    weights = shares(np.array([one.log_weight for one in shapes]))
    ranked = sorted(zip(shapes, weights, strict=True), key=lambda pair: -pair[1])[:MOST_OPEN]
    return [(replace(chosen, effect=one.effect), float(p)) for one, p in ranked if p > LEAST]


def together(searcher: Searcher, found: Found) -> Floats:
    """Shift (T, 3) [m] of the adjusted targets by all members of a set as a refit has them, to first order."""
    if not found.members:
        return np.zeros((len(searcher.space.sightings.points), 3))
    mean = wide_posterior(*found.products, np.concatenate([h.spread for h in found.members]))[0]
    signatures = np.hstack([searcher.space.signature(h.effect) for h in found.members])
    return -searcher.space.moved_targets(signatures @ mean)


def shift_of(searcher: Searcher, others: Found, hypothesis: Hypothesis) -> Floats:
    """Shift (T, 3) [m] of the adjusted targets when an explanation, its size shrunk by its prior, is taken out."""
    moments = searcher.exact.moments([hypothesis.effect], others)[0]
    mean = posterior(*moments, hypothesis.spread)[0]
    return -searcher.space.moved_targets(searcher.space.signature(hypothesis.effect) @ mean)
