"""Combinations of parameters that a recording does not determine, and additional measurements that would.

In units of the prior sigmas the parameters' covariance has eigenvalues between 0 and 1: one minus an eigenvalue is the
gain, the fraction of the prior variance along that combination that the readings removed. A combination with a gain
below one half is called undetermined: its prior is more precise than the readings alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

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
"""Gain below which combinations count as equally undetermined, so that simple rotations of them are reported."""
MIN_REPORTED_COEFFICIENT = 0.1
"""Smallest coefficient of a combination that is reported."""
MIN_WORTHWHILE_GAIN_INCREASE = 0.05
"""Smallest increase of a gain that is worth a measurement."""


@dataclass(frozen=True)
class ParameterCombination:
    """Combination of parameters: a unit vector (p,) in prior sigmas, and its gain."""

    vector: Floats
    """Unit vector (p,) in prior sigmas."""
    gain: float
    """Fraction of the prior variance that the readings removed."""

    def coefficients(self, names: Sequence[str]) -> dict[str, float]:
        """Coefficients above 0.1 by name, largest first; the largest is positive."""
        vector = self.vector * np.sign(self.vector[np.argmax(np.abs(self.vector))])
        order = np.argsort(-np.abs(vector), kind="stable")
        return {names[i]: float(vector[i]) for i in order if abs(vector[i]) > MIN_REPORTED_COEFFICIENT}


def gains_and_combinations(covariance: Floats, prior_sigma: Floats) -> tuple[Floats, Floats]:
    """Gains (p,) in ascending order, and their combinations (p, p) in prior sigmas.

    A gain is 1 minus the posterior variance over the prior variance.
    """
    scaled = covariance / np.outer(prior_sigma, prior_sigma)
    remaining, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    return np.clip(1.0 - remaining[::-1], 0.0, 1.0), vectors[:, ::-1]


def undetermined_combinations(covariance: Floats, prior_sigma: Floats) -> list[ParameterCombination]:
    """Combinations with a gain below one half, the least determined first.

    `covariance` (p, p) is the posterior covariance.
    """
    gain, vectors = gains_and_combinations(covariance, prior_sigma)
    silent = gain < MAX_UNINFORMATIVE_GAIN
    vectors = np.concatenate([rotate_to_simple_structure(vectors[:, silent]), vectors[:, ~silent]], axis=1)
    scaled = covariance / np.outer(prior_sigma, prior_sigma)
    gain = 1.0 - np.einsum("ij,ik,kj->j", vectors, scaled, vectors)
    combinations = [
        ParameterCombination(vectors[:, i], float(max(gain[i], 0.0)))
        for i in np.flatnonzero(gain < MIN_DETERMINED_GAIN)
    ]
    return sorted(combinations, key=lambda direction: direction.gain)


def rotate_to_simple_structure(vectors: Floats, steps: int = 200) -> Floats:
    """Orthonormal columns rotated among themselves so that each has few large coefficients.

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
        u, spread, right = np.linalg.svd(vectors.T @ cubic)
        rotation = u @ right
        total = float(spread.sum())
        if total < before * (1 + 1e-9):
            break
        before = total
    return vectors @ rotation


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
    now = _gains_of_combinations(network, directions)
    cheap = [r for r in (second_face_remedy(network), *calibrated_length_remedy(network)) if r]
    worth = chain(cheap, return_remedies(network, 0.0, [0]), near_reflector_remedies(network))  # the cheapest first
    tried = [(r.instruction, _gains_of_combinations(r.network, directions)) for r in worth]
    return [
        [
            _determining_sentence(d, now[i][k], [(words, gain[i][k]) for words, gain in tried])
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
        return [[0.0 for _ in combinations] for combinations in directions]
    return [
        [float(1.0 - (d.vector / sigma) @ block @ (d.vector / sigma)) for d in combinations]
        for block, sigma, combinations in zip(covariance, prior, directions, strict=True)
    ]


def _determining_sentence(
    direction: ParameterCombination, present_gain: float, remedies_with_gains: Sequence[tuple[str, float]]
) -> str:
    """Sentence on the measurement that determines one direction.

    `remedies_with_gains` are remedies with their gains, `present_gain` is the present gain.
    """
    if present_gain >= MIN_DETERMINED_GAIN > direction.gain:
        return advice_sentence("determined already", then=present_gain)
    enough = [pair for pair in remedies_with_gains if pair[1] >= MIN_DETERMINED_GAIN]
    words, then = (
        enough[0] if enough else max(remedies_with_gains, key=lambda pair: pair[1], default=("", present_gain))
    )
    if then - present_gain < MIN_WORTHWHILE_GAIN_INCREASE:
        return advice_sentence("not determined")
    return advice_sentence("determined", do=words, now=direction.gain, then=then)
