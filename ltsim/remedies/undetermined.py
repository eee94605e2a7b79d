"""Which combinations of parameters a recording does not determine.

In units of the prior sigmas the parameters' covariance has eigenvalues between 0 and 1: one minus an eigenvalue is
the gain, the share of the prior variance along that combination which the readings removed. A combination with a
gain under one half is called undetermined: it was known better before than the readings alone would tell it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Floats

DETERMINED = 0.5
"""Least gain of a determined combination."""
SILENT = 0.01
"""Combinations with less gain than this are alike: any rotation among them is as good, a simple one is shown."""
SHOWN = 0.1
"""Smallest coefficient that is named."""


@dataclass(frozen=True)
class Direction:
    """A unit vector (p,) in units of the prior sigmas, and its gain."""

    vector: Floats
    gain: float

    def coefficients(self, names: Sequence[str]) -> dict[str, float]:
        """Coefficients above 0.1 by name, largest first; the largest is positive."""
        vector = self.vector * np.sign(self.vector[np.argmax(np.abs(self.vector))])
        order = np.argsort(-np.abs(vector), kind="stable")
        return {names[i]: float(vector[i]) for i in order if abs(vector[i]) > SHOWN}


def gains(covariance: Floats, prior_sigma: Floats) -> tuple[Floats, Floats]:
    """Gains (p,), ascending, and their combinations (p, p) as columns, in units of the prior sigmas."""
    scaled = covariance / np.outer(prior_sigma, prior_sigma)
    remaining, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    return np.clip(1.0 - remaining[::-1], 0.0, 1.0), vectors[:, ::-1]


def undetermined(covariance: Floats, prior_sigma: Floats) -> list[Direction]:
    """Combinations with a gain under one half, the least known first.

    Parameters
    ----------
    covariance : (p, p) float
        After the adjustment, priors included.
    prior_sigma : (p,) float
    """
    gain, vectors = gains(covariance, prior_sigma)
    silent = gain < SILENT
    vectors = np.concatenate([simple_rotation(vectors[:, silent]), vectors[:, ~silent]], axis=1)
    scaled = covariance / np.outer(prior_sigma, prior_sigma)
    gain = 1.0 - np.einsum("ij,ik,kj->j", vectors, scaled, vectors)
    found = [Direction(vectors[:, i], float(max(gain[i], 0.0))) for i in np.flatnonzero(gain < DETERMINED)]
    return sorted(found, key=lambda direction: direction.gain)


def simple_rotation(vectors: Floats, steps: int = 200) -> Floats:
    """Orthonormal columns rotated among themselves so that each holds few large coefficients.

    References
    ----------
    Kaiser, The varimax criterion, Psychometrika 23 (1958) 187.
    """
    count = vectors.shape[1]
    if count < 2:
        return vectors
    rotation, before = np.eye(count), 0.0
    for _ in range(steps):
        turned = vectors @ rotation
        cubic = turned**3 - turned * np.mean(turned**2, axis=0)
        left, spread, right = np.linalg.svd(vectors.T @ cubic)
        rotation = left @ right
        total = float(spread.sum())
        if total < before * (1 + 1e-9):
            break
        before = total
    return vectors @ rotation
