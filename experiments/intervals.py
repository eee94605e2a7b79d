"""Proportions and quantiles with 95 % intervals for rows that are correlated within a cluster (a law, a site)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import t as student

RESAMPLES = 2000


def proportion(successes: Sequence[bool], clusters: Sequence[str]) -> dict[str, Any]:
    """Number of successes, with Wilson's 95 % interval for the effective number of independent rows.

    The design effect is the variance between clusters over that of independent draws, between 1 and the mean size of
    a cluster; if all rows are successes, or none is, the effective number is the number of clusters.
    """
    n, k = len(successes), int(sum(successes))
    if not n:
        return {"count": 0, "total": 0}
    cluster_numbers = np.unique(clusters, return_inverse=True)[1]
    count, total = np.bincount(cluster_numbers, np.asarray(successes, dtype=np.float64)), np.bincount(cluster_numbers)
    c, p = len(total), k / n
    effect = n / c
    if 0 < k < n and c > 1:
        between = ((count - p * total) ** 2).sum() * c / (c - 1)
        effect = float(np.clip(between / (n * p * (1 - p)), 1.0, effect))
    m, z = n / effect, float(student.ppf(0.975, c - 1)) if c > 1 else 12.7
    middle = (p + z**2 / (2 * m)) / (1 + z**2 / m)
    half = z / (1 + z**2 / m) * np.sqrt(p * (1 - p) / m + (z / m) ** 2 / 4)
    low, high = float(max(middle - half, 0.0)), float(min(middle + half, 1.0))
    return {"count": k, "total": n, "clusters": c, "proportion": p, "low": low, "high": high, "design_effect": effect}


def quantile(values: Sequence[float], clusters: Sequence[str], level: float) -> dict[str, Any]:
    """Quantile with its 95 % interval by resampling of whole clusters."""
    if not values:
        return {"total": 0}
    numbers, names = np.array(values), np.array(clusters)
    groups = [numbers[names == name] for name in np.unique(names)]
    rng = np.random.default_rng(0)
    drawn = [np.quantile(np.concatenate([groups[i] for i in rng.integers(0, len(groups), len(groups))]), level)
             for _ in range(RESAMPLES)]  # fmt: skip
    low, high = np.quantile(drawn, [0.025, 0.975])
    return {"value": float(np.quantile(values, level)), "low": float(low), "high": float(high), "total": len(values)}
