"""Evidence of hypotheses that differ in kind, place, shape and number of parameters.

Mean shifts: with T the drop in chi2 of a signature of r visible directions, the marginal likelihood ratio against no
effect, under Zellner's g-prior (a size that gives a noncentrality of about g r), is
    exp(T/2 * g / (1 + g)) (1 + g)^(-r/2),
averaged over g, because nobody knows how strong an effect is. Places and shapes are averaged as well: whoever tries
more of them pays for it (the look-elsewhere effect). Changes of the noise are averaged over a grid of sizes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ltsim.arrays import Bools, Floats, Ints
from ltsim.effects.effect import Parameter
from ltsim.recording.recording import OBSERVABLES

STRENGTHS = np.array([10.0, 40.0, 160.0, 640.0])
"""Values of g: noncentralities per parameter that an effect worth naming may have."""

PLAUSIBLE = 3.0
"""Sizes up to so many prior sigmas are not marked down."""


def log_evidence(drop: Floats, rank: Floats | Ints) -> Floats:
    """Log marginal likelihood ratio of mean shifts; `drop` (..., k) of chi2, `rank` (k,) visible directions."""
    g = STRENGTHS.reshape(-1, *([1] * np.ndim(drop)))
    terms = 0.5 * drop * g / (1.0 + g) - 0.5 * rank * np.log1p(g)
    top = terms.max(axis=0)
    averaged: Floats = top + np.log(np.exp(terms - top).mean(axis=0))
    return averaged


def log_means(values: Floats, groups: Ints, count: int) -> Floats:
    """Log of the mean of exp(values) of each of `count` groups, none of them empty; (k,) or (k, trials) values."""
    order = np.argsort(groups, kind="stable")
    starts = np.searchsorted(groups[order], np.arange(count))
    top = np.maximum.reduceat(values[order], starts, axis=0)
    total = np.add.reduceat(np.exp(values[order] - top[groups[order]]), starts, axis=0)
    size = np.bincount(groups, minlength=count).reshape(-1, *([1] * (values.ndim - 1)))
    means: Floats = top + np.log(total / size)
    return means


MAINLY = 0.8
"""Share of the evidence from which one observable is said to carry it."""


def carried_by(use: Bools, gain: Floats) -> tuple[str, ...]:
    """The observable that carries a gain (r,) of the readings in `use` (n, 3); empty: several do."""
    by_reading = np.zeros(use.shape)
    by_reading[use] = gain
    by_kind = by_reading.sum(axis=0)
    top = int(np.argmax(by_kind))
    return (OBSERVABLES[top],) if by_kind[top] > MAINLY * by_kind.sum() else ()


IMPOSSIBLE = 12.0
"""What a size of the wrong sign costs in log evidence."""


def plausibility(parameters: Sequence[Parameter], values: Floats) -> float:
    """Log weight of parameter values (q,) [SI]: 0 up to `PLAUSIBLE` prior sigmas, then falling fast.

    Hardly any is left below zero for what is never negative.
    """
    sizes = values / np.array([p.prior_sigma for p in parameters])
    excess = np.log(np.maximum(np.abs(sizes) / PLAUSIBLE, 1.0))
    wrong = any(p.positive and size < 0.0 for p, size in zip(parameters, sizes, strict=True))
    return -2.0 * float(np.max(excess**2, initial=0.0)) - IMPOSSIBLE * wrong
