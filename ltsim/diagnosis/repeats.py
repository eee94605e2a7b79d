"""Means of repeated readings: sums over repeats, their redundancy and their variance."""

import numpy as np
import scipy.sparse as sp

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.adjustment.significance import MIN_CHECKED_REDUNDANCY
from ltsim.core.arrays import Floats
from ltsim.physics.laws.variance import REPEATS_PER_FACE


def repeat_means(space: ResidualSpace, faces: str = REPEATS_PER_FACE) -> sp.csr_array:
    """Matrix (g, m) that adds readings of one kind, target, station and optionally face.

    The sums are divided by the square root of their number of terms.
    """
    s = space.sightings
    pair = 2 * (s.station * len(s.target_names) + s.target) + ((s.face == 2) & (faces == REPEATS_PER_FACE))
    key = (3 * pair[:, None] + np.arange(3))[space.used_readings]
    _, group, count = np.unique(key, return_inverse=True, return_counts=True)
    keep = count[group] > 1
    _, number = np.unique(group[keep], return_inverse=True)
    places = np.flatnonzero(keep)
    shape = (int(number.max(initial=-1)) + 1, space.n_rows)
    return sp.csr_array((1.0 / np.sqrt(count[group[keep]]), (number, places)), shape)


def redundancy_of_means(means: sp.csr_array, redundancy: Floats) -> Floats:
    """Redundancy (g,) of means: the adjustment absorbs an error common to repeats by the sum of their leverages."""
    lost = (means > 0).astype(np.float64) @ (1.0 - redundancy)
    return np.maximum(1.0 - lost, MIN_CHECKED_REDUNDANCY)


def relative_variance_of_means(means: sp.csr_array, added_variance: Floats) -> Floats:
    """Relative added variance (g,) of means whose members share that of the first rows: k v."""
    padded = np.append(added_variance, np.zeros(means.shape[1] - len(added_variance)))
    return np.maximum((means > 0).astype(np.float64) @ padded, 0.0)
