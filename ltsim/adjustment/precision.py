"""Covariances as people read them: ellipsoids of error and correlations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from ltsim.arrays import Floats


@dataclass(frozen=True)
class Ellipsoids:
    """Ellipsoids of error."""

    axes: Floats
    """(k, 3) [m]: semi-axes, the longest first."""
    directions: Floats
    """(k, 3, 3): unit vectors of the axes in the network's frame, one a row."""


def ellipsoids(covariance: Floats, confidence: float | None = None) -> Ellipsoids:
    """Ellipsoids of covariances (k, 3, 3) [m^2]; of one standard deviation, or holding the point with a confidence."""
    missing = np.flatnonzero(np.isnan(covariance).any(axis=(1, 2)))
    values, vectors = np.linalg.eigh(np.nan_to_num(covariance))
    scale = 1.0 if confidence is None else float(np.sqrt(2.0 * special.gammaincinv(1.5, confidence)))
    axes = scale * np.sqrt(np.maximum(values[:, ::-1], 0.0))
    axes[missing] = np.nan
    return Ellipsoids(axes, np.swapaxes(vectors[:, :, ::-1], 1, 2))


def correlation(covariance: Floats) -> Floats:
    """Correlations (k, k) of a covariance (k, k); 0 with what has no variance."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unit = np.divide(1.0, sigma, out=np.zeros_like(sigma), where=sigma > 0)
    matrix: Floats = np.clip(covariance * np.outer(unit, unit), -1.0, 1.0)
    np.fill_diagonal(matrix, 1.0)
    return matrix
