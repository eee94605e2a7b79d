"""Does what looks like noise repeat? Noise is new at every pointing; physics left out of the model is not.

k readings of one kind of one target from one station: where they share what is left out, of variance v over the stated
one, their mean has variance 1 + k v and their differences 1; where each has its own, both have 1 + v.
"""

from __future__ import annotations

import numpy as np

from ltsim.adjust.residual_space import ResidualSpace
from ltsim.arrays import Floats, Ints

DECISIVE = 10.0
"""Expected evidence (drop of chi2) from which noise and a law count as told apart."""
MOST_REPEATS = 5
LEAST_SHARE = 0.05
"""Redundancy that a mean of repeats has at least."""


def repeats(space: ResidualSpace, factor: Floats, residual: Floats) -> float:
    """Log likelihood ratio of added variance that repeats over one that is new at every pointing; 0 without repeats.

    Parameters
    ----------
    factor : (n, 3) float
        Variance of the readings over the stated one.
    residual : (m,) float
        Whitened residuals, readings first.
    """
    s = space.sightings
    pair = s.station * len(s.target_names) + s.target
    return max(_ratio(space, factor, residual, pair), _ratio(space, factor, residual, 2 * pair + (s.face == 2)))


def deciding_repeats(space: ResidualSpace, factor: Floats, stations: tuple[str, ...] = ()) -> str:
    """A sentence: how often each target must be measured again to tell noise from a law, and by how much it would.

    The expected evidence is twice the Kullback-Leibler divergence of noise from a law of the same variance.
    """
    s = space.sightings
    _, pair, count = np.unique(s.station * len(s.target_names) + s.target, return_inverse=True, return_counts=True)
    added = np.maximum(np.where(space.use, factor - 1.0, 0.0), 0.0)
    v = np.array([np.bincount(pair, added[:, j]) / count for j in range(3)])
    now = _divergence(v, count)
    for further in range(1, MOST_REPEATS + 1):
        then = _divergence(v, count + further)
        if then > max(DECISIVE, 2.0 * now):
            where = f" from {', '.join(stations)}" if stations else ""
            times = "once more" if further == 1 else f"{further} more times"
            gain = f"expected chi-square between noise and a law from {now:.0f} to {then:.0f}"
            return f"measure each target {times}{where}: {gain}"
    return "the repeats there are tell noise from a law that repeats; another order of the work, from one that does not"


def _divergence(v: Floats, count: Ints) -> float:
    """Twice the divergence, summed over groups of `count` (g,) readings of added variance v (3, g)."""
    mean, alone = 1.0 + count * v, 1.0 + v
    of_means = alone / mean - 1.0 - np.log(alone / mean)
    of_differences = (count - 1) * (v - np.log(alone))
    return float((of_means + of_differences)[:, count > 1].sum())


def _ratio(space: ResidualSpace, factor: Floats, residual: Floats, group: Ints) -> float:
    """The ratio where readings of one `group` (n,) and one kind share what is left out."""
    used = space.use
    share, added = space.redundancy[: int(used.sum())], factor[used] - 1.0
    r = residual[: len(share)]
    key = (3 * group[:, None] + np.arange(3))[used]
    _, key, count = np.unique(key, return_inverse=True, return_counts=True)
    more = np.bincount(key, added)
    again = (count > 1) & (more > 0)
    mean_share = np.maximum(1.0 - np.bincount(key, 1.0 - share), LEAST_SHARE)
    together = 1.0 + np.maximum(more, 0.0)
    square = np.bincount(key, r) ** 2 / count
    shared = square * (1 - 1 / together) - mean_share * np.log(together)
    alone = np.bincount(key, r**2 * (1 - 1 / (1 + added)) - share * np.log(1 + added))
    return 0.5 * float((shared - alone)[again].sum())
