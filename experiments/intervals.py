"""Shares and quantiles with 95 % intervals that know that rows of one cluster (a law, a site) are alike."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import t as student

RESAMPLES = 2000


def share(hits: Sequence[bool], clusters: Sequence[str]) -> dict[str, Any]:
    """How many are right, with the 95 % interval of Wilson for the effective number of independent recordings.

    The design effect is the variance between clusters over that of independent draws, between 1 and the mean size of
    a cluster; where all are right, or none, nothing tells it, and the number of clusters is taken.
    """
    n, k = len(hits), int(sum(hits))
    if not n:
        return {"right": 0, "of": 0}
    own = np.unique(clusters, return_inverse=True)[1]
    right, of = np.bincount(own, np.asarray(hits, dtype=np.float64)), np.bincount(own)
    c, p = len(of), k / n
    effect = n / c
    if 0 < k < n and c > 1:
        between = ((right - p * of) ** 2).sum() * c / (c - 1)
        effect = float(np.clip(between / (n * p * (1 - p)), 1.0, effect))
    m, z = n / effect, float(student.ppf(0.975, c - 1)) if c > 1 else 12.7
    middle = (p + z**2 / (2 * m)) / (1 + z**2 / m)
    half = z / (1 + z**2 / m) * np.sqrt(p * (1 - p) / m + (z / m) ** 2 / 4)
    low, high = float(max(middle - half, 0.0)), float(min(middle + half, 1.0))
    return {"right": k, "of": n, "laws": c, "share": p, "low": low, "high": high, "design_effect": effect}


def quantile(values: Sequence[float], clusters: Sequence[str], level: float) -> dict[str, Any]:
    """A quantile with its 95 % interval over resamples of whole clusters."""
    if not values:
        return {"of": 0}
    numbers, names = np.array(values), np.array(clusters)
    groups = [numbers[names == name] for name in np.unique(names)]
    rng = np.random.default_rng(0)
    drawn = [np.quantile(np.concatenate([groups[i] for i in rng.integers(0, len(groups), len(groups))]), level)
             for _ in range(RESAMPLES)]  # fmt: skip
    low, high = np.quantile(drawn, [0.025, 0.975])
    return {"value": float(np.quantile(values, level)), "low": float(low), "high": float(high), "of": len(values)}
