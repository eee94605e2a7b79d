"""Does what looks like noise repeat? Noise is new at every pointing; physics left out of the model is not.

k readings of one kind of one target from one station: where they share what is left out, of variance v over the stated
one, their mean has variance 1 + k v and their differences 1; where each has its own, both have 1 + v.
"""

from __future__ import annotations

import numpy as np

from ltsim.adjust.residual_space import ResidualSpace
from ltsim.arrays import Floats, Ints

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
