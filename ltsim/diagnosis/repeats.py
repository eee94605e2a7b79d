"""Means of repeated readings, for errors that repeated readings of a target share."""

import numpy as np
import scipy.sparse as sp

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.adjustment.significance import MIN_CHECKED_REDUNDANCY
from ltsim.core.arrays import Floats
from ltsim.physics.laws.variance import REPEATS_PER_FACE


def normalised_sum_matrix_of_repeats(space: ResidualSpace, repetition_kind: str = REPEATS_PER_FACE) -> sp.csr_array:
    """Matrix (g, m) that maps the m observations of a residual space to g scaled means of repeated readings.

    The residual space is the space of whitened observations without the part that the unknowns absorb. Repeated
    readings have the same observable, target and station. If `repetition_kind` is `REPEATS_PER_FACE`, they also have
    the same face. A scaled mean is a sum of readings divided by the square root of their number.
    """
    s = space.sightings
    pair = 2 * (s.station * len(s.target_names) + s.target) + ((s.face == 2) & (repetition_kind == REPEATS_PER_FACE))
    key = (3 * pair[:, None] + np.arange(3))[space.is_used_reading]
    _, group, count = np.unique(key, return_inverse=True, return_counts=True)
    keep = count[group] > 1
    _, number = np.unique(group[keep], return_inverse=True)
    places = np.flatnonzero(keep)
    shape = (int(number.max(initial=-1)) + 1, space.n_equations)
    return sp.csr_array((1.0 / np.sqrt(count[group[keep]]), (number, places)), shape)


def redundancy_of_means(averaging_matrix: sp.csr_array, redundancy: Floats) -> Floats:
    """Redundancy numbers (g,) of g means of repeated readings, from the redundancy numbers (m,) of m readings.

    The adjustment absorbs an error that repeated readings share in proportion to the sum of their leverages.
    `averaging_matrix` (g, m) maps the readings to the means.
    """
    lost = (averaging_matrix > 0).astype(np.float64) @ (1.0 - redundancy)
    return np.maximum(1.0 - lost, MIN_CHECKED_REDUNDANCY)


def added_variance_of_means(averaging_matrix: sp.csr_array, added_variance: Floats) -> Floats:
    """Added variance (g,) of g scaled means of repeated readings that share their errors.

    Added variances are divided by the declared variance. `added_variance` (k,) contains the added variances of the
    first k observations. The added variance of a mean is the sum over its readings, because the errors of these
    readings are equal. `averaging_matrix` maps the readings to the means.
    """
    padded = np.append(added_variance, np.zeros(averaging_matrix.shape[1] - len(added_variance)))
    return np.maximum((averaging_matrix > 0).astype(np.float64) @ padded, 0.0)
