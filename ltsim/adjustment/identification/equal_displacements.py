"""Test whether displacements of reflectors at a set-up have equal lengths, as after the use of another SMR radius.

A reflector of another radius displaces all targets of a set-up by the same length L along the normals of their nests,
which are unknown here. For k targets with normals uniformly distributed in direction, and the scatter t of the lengths,
the log likelihood ratio of such displacements against random ones with the standard deviation L / sqrt(3) of each
component is

    k [1 + log(L / (6 sqrt(3) t))].

Nests face the instrument more often than not. With the mean cosine c between the normals and the directions to the
set-up, a Fisher distribution of concentration K, coth K - 1/K = c, adds k [log(K / sinh K) + K c].

References
----------
Banerjee et al., Clustering on the unit hypersphere, J. Mach. Learn. Res. 6 (2005) 1345, eq. 4.4: approximation of K.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ltsim.adjustment.identification.evidence import (
    LOG_PRIOR_ODDS_OF_CENTRING,
    log_occam_factor_of_variance,
    log_prior_of_kind,
)
from ltsim.adjustment.identification.nominal_offsets import smr_exchange_text
from ltsim.core.arrays import Floats
from ltsim.core.rounding import SQRT_MACHINE_EPSILON
from ltsim.solve.gauss_newton import MAX_ITERATIONS

MAX_RELATIVE_LENGTH_SCATTER = 0.1
"""Largest scatter of several lengths that count as equal, divided by their rms. The lengths are those of displacements.
"""
MAX_COMMON_TO_RMS_LENGTH_RATIO = 3.0
"""Limit of the estimated common length of displacements, divided by their rms length. A larger estimate is rejected,
because any small displacements lie nearly on the surface of a much larger sphere."""
MIN_TARGETS_FOR_COMMON_LENGTH = 10
"""Smallest number of targets for the estimate of a common length of displacements. The estimate has seven unknowns: the
length and the pose of the set-up.
"""


class CommonDisplacementLength(NamedTuple):
    """Common length of the displacements of all reflectors at a set-up, each along the unknown normal of its nest."""

    length: float
    """Length [m], positive away from the nests. A nest is assumed to be behind its target as seen from the set-up."""
    length_sigma: float
    """Standard deviation of the length [m]."""
    log_evidence_gain: float
    """Gain of log evidence against displacements of random lengths, at least 0."""

    @property
    def is_smr_exchange(self) -> bool:
        """True if the length is the difference of the radii of two common SMRs."""
        return bool(smr_exchange_text(self.length, self.length_sigma))

    @property
    def log_prior_ratio(self) -> float:
        """Logarithm of the prior odds of another SMR against centring errors at the same set-up.

        It is 0 unless the length is a difference of the radii of common SMRs: unmodelled errors, for which centring
        errors have small prior odds, do not cause displacements of such a length.
        """
        if not self.is_smr_exchange:
            return 0.0
        same_place = log_prior_of_kind("reflector-radius", 1) - log_prior_of_kind("centring", 1)
        return same_place - LOG_PRIOR_ODDS_OF_CENTRING


def common_displacement_length(displacements: Floats, sight_vectors: Floats) -> CommonDisplacementLength | None:
    """Common length of displacements (k, 3) [m] of k reflectors at a set-up; None if the lengths differ.

    The displacements are determined except for a rigid motion, which the pose of the set-up absorbs. This motion is
    estimated together with the length. The start values are those without rotation: displacements of equal length then
    lie on a sphere, which is fitted. `sight_vectors` (k, 3) [m] point from the set-up to the targets.
    """
    if len(displacements) < MIN_TARGETS_FOR_COMMON_LENGTH:
        return None
    linear = np.hstack([2.0 * displacements, np.ones((len(displacements), 1))])
    centre = np.linalg.lstsq(linear, np.sum(displacements**2, axis=1))[0]
    motion = np.append(-centre[:3], np.zeros(3))
    length = float(np.sqrt(max(centre[3] + centre[:3] @ centre[:3], 0.0)))
    for _ in range(MAX_ITERATIONS):
        corrected = displacements + motion[:3] + np.cross(motion[3:], sight_vectors)
        size = np.linalg.norm(corrected, axis=1)
        direction = corrected / np.maximum(size, 1e-300)[:, None]
        design = np.hstack([direction, np.cross(sight_vectors, direction), -np.ones((len(displacements), 1))])
        residual = length - size
        step = np.linalg.lstsq(design, residual)[0]
        motion, length = motion + step[:6], length + float(step[6])
        if np.abs(step).max() < SQRT_MACHINE_EPSILON:
            break
    n_redundant = len(displacements) - design.shape[1]
    scatter = float(np.sqrt(np.sum((residual - design @ step) ** 2) / n_redundant))
    rms = float(np.sqrt(np.mean(np.sum(displacements**2, axis=1))))
    if not 0.0 < length < MAX_COMMON_TO_RMS_LENGTH_RATIO * rms or scatter > MAX_RELATIVE_LENGTH_SCATTER * rms:
        return None
    mean_cosine = -float(
        np.mean(np.sum(corrected * sight_vectors, axis=1) / (size * np.linalg.norm(sight_vectors, axis=1)))
    )
    is_away_from_nests = mean_cosine > 0.0
    sigma = scatter * float(np.sqrt(np.linalg.pinv(design.T @ design)[6, 6]))
    gain = n_redundant * (1.0 + float(np.log(length / (6.0 * np.sqrt(3.0) * max(scatter, 1e-300)))))
    gain += float(log_occam_factor_of_variance(n_redundant))
    gain += max(_log_evidence_gain_of_facing_nests(abs(mean_cosine), len(displacements)), 0.0)
    return CommonDisplacementLength(length if is_away_from_nests else -length, sigma, max(gain, 0.0))


def _log_evidence_gain_of_facing_nests(mean_cosine: float, n_targets: int) -> float:
    """Gain of log evidence by a Fisher distribution of the normals about the directions to the set-up.

    `mean_cosine` is the mean cosine between both directions, from 0 to 1, at `n_targets` targets.
    """
    concentration = mean_cosine * (3.0 - mean_cosine**2) / max(1.0 - mean_cosine**2, SQRT_MACHINE_EPSILON)
    if concentration < SQRT_MACHINE_EPSILON:
        return 0.0
    log_sinh = concentration + float(np.log(-0.5 * np.expm1(-2.0 * concentration)))
    per_target = float(np.log(concentration)) - log_sinh + concentration * mean_cosine
    return n_targets * per_target + float(log_occam_factor_of_variance(n_targets))
