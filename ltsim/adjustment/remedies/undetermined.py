"""Combinations of parameters that a recording does not determine, and additional measurements that would.

In units of the prior sigmas the parameters' covariance has eigenvalues between 0 and 1: one minus an eigenvalue is the
gain, the fraction of the prior variance along that combination that the readings removed. A combination with a gain
below one half is called undetermined: its prior is more precise than the readings alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, combinations

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.remedies.network import PlannedNetwork
from ltsim.adjustment.remedies.remedy import (
    advice_sentence,
    calibrated_length_remedy,
    near_reflector_remedies,
    return_remedies,
    second_face_remedy,
)
from ltsim.core.arrays import Floats
from ltsim.core.errors import NetworkError
from ltsim.physics.model.construction import Construction

MIN_DETERMINED_GAIN = 0.5
"""Smallest gain of a determined combination."""
MAX_UNINFORMATIVE_GAIN = 0.01
"""Gain below which combinations count as equally undetermined; they are then rotated to combinations of few parameters.
"""
MIN_REPORTED_COEFFICIENT = 0.1
"""Smallest coefficient of a combination that is reported."""
MIN_WORTHWHILE_GAIN_INCREASE = 0.25
"""Smallest increase of a gain that is worth a measurement: half of the gain of a determined combination."""


GAIN_ROUNDING_ERROR = 1e-9
"""Gain, and difference of gains, that rounding may produce."""
MAX_EQUAL_COEFFICIENT_DIFFERENCE = 1e-6
"""Relative difference up to which coefficients count as equal, so that rounding decides neither a sign nor an order."""
MAX_ROTATION_SWEEPS = 200
"""Largest number of sweeps of planar rotations."""
MIN_ROTATION_ANGLE = 1e-13
"""Largest angle [rad] of a sweep after which they have converged."""


@dataclass(frozen=True)
class ParameterCombination:
    """Combination of parameters: a unit vector (p,) in prior sigmas, and its gain."""

    vector: Floats
    """Unit vector (p,) in prior sigmas."""
    gain: float
    """Fraction of the prior variance that the readings removed."""

    def coefficients(self, names: Sequence[str]) -> dict[str, float]:
        """Coefficients above 0.1 by name, largest first; the largest is positive, the first of equally large ones."""
        size = np.abs(self.vector)
        order = np.argsort(-np.round(size / MAX_EQUAL_COEFFICIENT_DIFFERENCE), kind="stable")
        sign = np.sign(self.vector[_first_of_largest(size)])
        return {names[i]: float(sign * self.vector[i]) for i in order if size[i] > MIN_REPORTED_COEFFICIENT}


def gains_and_combinations(covariance: Floats, prior_sigma: Floats) -> tuple[Floats, Floats]:
    """Gains (p,) in ascending order, and their combinations (p, p) in prior sigmas.

    A gain is 1 minus the posterior variance over the prior variance.
    """
    scaled_covariance = covariance / np.outer(prior_sigma, prior_sigma)
    remaining, vectors = np.linalg.eigh(0.5 * (scaled_covariance + scaled_covariance.T))
    return np.clip(1.0 - remaining[::-1], 0.0, 1.0), vectors[:, ::-1]


def undetermined_combinations(covariance: Floats, prior_sigma: Floats) -> list[ParameterCombination]:
    """Combinations with a gain below one half, the least determined first.

    `covariance` (p, p) is the posterior covariance.
    """
    gain, vectors = gains_and_combinations(covariance, prior_sigma)
    is_silent = gain < MAX_UNINFORMATIVE_GAIN
    vectors = np.concatenate([rotate_to_simple_structure(vectors[:, is_silent]), vectors[:, ~is_silent]], axis=1)
    scaled_covariance = covariance / np.outer(prior_sigma, prior_sigma)
    gain = 1.0 - np.einsum("ij,ik,kj->j", vectors, scaled_covariance, vectors)
    gain = np.where(gain < GAIN_ROUNDING_ERROR, 0.0, gain)
    weak = [ParameterCombination(vectors[:, i], float(gain[i])) for i in np.flatnonzero(gain < MIN_DETERMINED_GAIN)]
    return sorted(weak, key=lambda d: (round(d.gain / GAIN_ROUNDING_ERROR), _first_of_largest(np.abs(d.vector))))


def _first_of_largest(sizes: Floats) -> int:
    """Index of the first of the largest sizes that are equal up to rounding."""
    return int(np.flatnonzero(sizes >= (1.0 - MAX_EQUAL_COEFFICIENT_DIFFERENCE) * sizes.max())[0])


def rotate_to_simple_structure(vectors: Floats) -> Floats:
    """Orthonormal columns rotated among themselves so that each has few large coefficients.

    The result depends on the span of the columns alone: planar rotations of pairs begin at a basis of it that is formed
    by the projections of the parameters, and converge to rounding.

    References
    ----------
    Kaiser, The varimax criterion, Psychometrika 23 (1958) 187.
    """
    columns = list(_basis_of_span(vectors).T)
    for _ in range(MAX_ROTATION_SWEEPS):
        largest = 0.0
        for i, j in combinations(range(len(columns)), 2):
            x, y = columns[i], columns[j]
            u, v = x**2 - y**2, 2.0 * x * y
            sine = 2.0 * (u @ v - u.sum() * v.sum() / len(u))
            cosine = u @ u - v @ v - (u.sum() ** 2 - v.sum() ** 2) / len(u)
            if np.hypot(sine, cosine) > GAIN_ROUNDING_ERROR:
                angle = 0.25 * np.arctan2(sine, cosine)
                columns[i], columns[j] = (
                    np.cos(angle) * x + np.sin(angle) * y,
                    np.cos(angle) * y - np.sin(angle) * x,
                )
                largest = max(largest, abs(angle))
        if largest < MIN_ROTATION_ANGLE:
            break
    return np.array(columns).reshape(-1, len(vectors)).T


def _basis_of_span(vectors: Floats) -> Floats:
    """Orthonormal basis (p, k) of the span of orthonormal columns (p, k), by pivoted Cholesky of its projector."""
    projector, basis = vectors @ vectors.T, np.empty_like(vectors)
    for k in range(vectors.shape[1]):
        i = _first_of_largest(np.diag(projector))
        basis[:, k] = projector[:, i] / np.sqrt(projector[i, i])
        projector = projector - np.outer(basis[:, k], basis[:, k])
    return basis


def determining_sentences(
    adjustment: Adjustment, construction: Construction, directions: Sequence[Sequence[ParameterCombination]]
) -> list[list[str]]:
    """Sentences per instrument: for each undetermined direction, the measurement that determines it.

    It is the first remedy that increases the gain above one half, or the one with the largest increase. `construction`
    has the parameters of the directions; `directions` has one sequence per instrument.
    """
    if not any(directions):
        return [[] for _ in directions]
    network = PlannedNetwork.from_adjustment(adjustment, construction)
    present_gains = _gains_of_combinations(network, directions)
    cheap = [r for r in (second_face_remedy(network), *calibrated_length_remedy(network)) if r]
    candidates = chain(
        cheap, return_remedies(network, 0.0, [0]), near_reflector_remedies(network)
    )  # the cheapest first
    evaluated = [(r.instruction, _gains_of_combinations(r.network, directions)) for r in candidates]
    return [
        [
            _determining_sentence(d, present_gains[i][k], [(words, gain[i][k]) for words, gain in evaluated])
            for k, d in enumerate(combinations)
        ]
        for i, combinations in enumerate(directions)
    ]


def _gains_of_combinations(
    network: PlannedNetwork, directions: Sequence[Sequence[ParameterCombination]]
) -> list[list[float]]:
    """Gain along each direction of each instrument in a network; empty for an undetermined network."""
    try:
        covariance, prior = network.parameter_covariance()
    except NetworkError:
        return [[0.0 for _ in weak] for weak in directions]
    return [
        [float(1.0 - (d.vector / sigma) @ block @ (d.vector / sigma)) for d in weak]
        for block, sigma, weak in zip(covariance, prior, directions, strict=True)
    ]


def _determining_sentence(
    direction: ParameterCombination, present_gain: float, remedies_with_gains: Sequence[tuple[str, float]]
) -> str:
    """Sentence on the measurement that determines one direction.

    `remedies_with_gains` are remedies with their gains, `present_gain` is the present gain.
    """
    if present_gain >= MIN_DETERMINED_GAIN > direction.gain:
        return advice_sentence("determined already", then=present_gain)
    is_sufficient = [pair for pair in remedies_with_gains if pair[1] >= MIN_DETERMINED_GAIN]
    words, then = (
        is_sufficient[0]
        if is_sufficient
        else max(remedies_with_gains, key=lambda pair: pair[1], default=("", present_gain))
    )
    if then - present_gain < MIN_WORTHWHILE_GAIN_INCREASE:
        return advice_sentence("not determined")
    return advice_sentence("determined", do=words, now=direction.gain, then=then)
