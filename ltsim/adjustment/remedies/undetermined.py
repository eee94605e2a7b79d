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
from ltsim.adjustment.remedies.network import Network
from ltsim.adjustment.remedies.remedy import advice, calibrated_length, near_reflectors, other_face, returns
from ltsim.core.arrays import Floats
from ltsim.core.errors import NetworkError
from ltsim.physics.model.construction import Construction

DETERMINED = 0.5
"""Smallest gain of a determined combination."""
UNINFORMATIVE = 0.01
"""Gain below which combinations count as equally undetermined, so that simple rotations of them are reported."""
SHOWN = 0.1
"""Smallest coefficient of a combination that is reported."""
MATERIAL = 0.05
"""Smallest increase of a gain that is worth a measurement."""


@dataclass(frozen=True)
class Direction:
    """Combination of parameters: a unit vector (p,) in prior sigmas, and its gain."""

    vector: Floats
    gain: float

    def coefficients(self, names: Sequence[str]) -> dict[str, float]:
        """Coefficients above 0.1 by name, largest first; the largest is positive."""
        vector = self.vector * np.sign(self.vector[np.argmax(np.abs(self.vector))])
        order = np.argsort(-np.abs(vector), kind="stable")
        return {names[i]: float(vector[i]) for i in order if abs(vector[i]) > SHOWN}


def gains(covariance: Floats, prior_sigma: Floats) -> tuple[Floats, Floats]:
    """Gains (p,) in ascending order, and their combinations (p, p) in prior sigmas.

    A gain is 1 minus the posterior variance over the prior variance.
    """
    scaled = covariance / np.outer(prior_sigma, prior_sigma)
    remaining, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    return np.clip(1.0 - remaining[::-1], 0.0, 1.0), vectors[:, ::-1]


def undetermined(covariance: Floats, prior_sigma: Floats) -> list[Direction]:
    """Combinations with a gain below one half, the least determined first.

    `covariance` (p, p) is the posterior covariance.
    """
    gain, vectors = gains(covariance, prior_sigma)
    silent = gain < UNINFORMATIVE
    vectors = np.concatenate([simple_rotation(vectors[:, silent]), vectors[:, ~silent]], axis=1)
    scaled = covariance / np.outer(prior_sigma, prior_sigma)
    gain = 1.0 - np.einsum("ij,ik,kj->j", vectors, scaled, vectors)
    combinations = [Direction(vectors[:, i], float(max(gain[i], 0.0))) for i in np.flatnonzero(gain < DETERMINED)]
    return sorted(combinations, key=lambda direction: direction.gain)


def simple_rotation(vectors: Floats, steps: int = 200) -> Floats:
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


def determining(
    adjustment: Adjustment, construction: Construction, directions: Sequence[Sequence[Direction]]
) -> list[list[str]]:
    """Sentences per instrument: for each undetermined direction, the measurement that determines it.

    It is the first remedy that increases the gain above one half, or the one with the largest increase. `construction`
    has the parameters of the directions; `directions` has one sequence per instrument.
    """
    if not any(directions):
        return [[] for _ in directions]
    network = Network.of(adjustment, construction)
    now = _gains_along(network, directions)
    cheap = [r for r in (other_face(network), *calibrated_length(network)) if r]
    worth = chain(cheap, returns(network, 0.0, [0]), near_reflectors(network))  # the cheapest first
    tried = [(r.words, _gains_along(r.network, directions)) for r in worth]
    return [
        [_sentence(d, now[i][k], [(words, gain[i][k]) for words, gain in tried]) for k, d in enumerate(combinations)]
        for i, combinations in enumerate(directions)
    ]


def _gains_along(network: Network, directions: Sequence[Sequence[Direction]]) -> list[list[float]]:
    """Gain along each direction of each instrument in a network; empty for an undetermined network."""
    try:
        covariance, prior = network.parameter_covariance()
    except NetworkError:
        return [[0.0 for _ in combinations] for combinations in directions]
    return [
        [float(1.0 - (d.vector / sigma) @ block @ (d.vector / sigma)) for d in combinations]
        for block, sigma, combinations in zip(covariance, prior, directions, strict=True)
    ]


def _sentence(direction: Direction, now: float, tried: Sequence[tuple[str, float]]) -> str:
    """Sentence on the measurement that determines one direction.

    `tried` are remedies with their gains, `now` is the present gain.
    """
    if now >= DETERMINED > direction.gain:
        return advice("determined already", then=now)
    enough = [pair for pair in tried if pair[1] >= DETERMINED]
    words, then = enough[0] if enough else max(tried, key=lambda pair: pair[1], default=("", now))
    if then - now < MATERIAL:
        return advice("not determined")
    return advice("determined", do=words, now=direction.gain, then=then)
