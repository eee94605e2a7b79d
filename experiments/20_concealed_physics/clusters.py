"""Shares and quantiles with intervals that know that recordings of one law are alike."""

from __future__ import annotations

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
    n, names = len(hits), sorted(set(clusters))
    if not n:
        return {"right": 0, "of": 0}
    k, c = int(sum(hits)), len(names)
    p, largest = k / n, n / c
    by = {name: [0, 0] for name in names}
    for hit, name in zip(hits, clusters, strict=True):
        by[name][0] += bool(hit)
        by[name][1] += 1
    if 0 < k < n and c > 1:
        between = sum((right - p * of) ** 2 for right, of in by.values()) * c / (c - 1)
        effect = float(np.clip(between / (n * p * (1 - p)), 1.0, largest))
    else:
        effect = largest
    m, z = n / effect, float(student.ppf(0.975, c - 1)) if c > 1 else 12.7
    middle, half = (
        (p + z**2 / (2 * m)) / (1 + z**2 / m),
        z / (1 + z**2 / m) * np.sqrt(p * (1 - p) / m + (z / m) ** 2 / 4),
    )
    low, high = float(max(middle - half, 0.0)), float(min(middle + half, 1.0))
    return {"right": k, "of": n, "laws": c, "share": p, "low": low, "high": high, "design_effect": effect}


def quantile(values: Sequence[float], clusters: Sequence[str], level: float) -> dict[str, Any]:
    """A quantile with its 95 % interval over resamples of whole clusters."""
    found = {name: [v for v, c in zip(values, clusters, strict=True) if c == name] for name in sorted(set(clusters))}
    if not found:
        return {"of": 0}
    rng, groups = np.random.default_rng(0), list(found.values())
    drawn = [np.quantile(np.concatenate([groups[i] for i in rng.integers(0, len(groups), len(groups))]), level)
             for _ in range(RESAMPLES)]  # fmt: skip
    low, high = np.quantile(drawn, [0.025, 0.975])
    return {"value": float(np.quantile(values, level)), "low": float(low), "high": float(high), "of": len(values)}
