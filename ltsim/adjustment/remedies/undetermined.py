"""Combinations of parameters that a recording does not determine, and further measurements that would.

In units of the prior sigmas the parameters' covariance has eigenvalues between 0 and 1: one minus an eigenvalue is
the gain, the share of the prior variance along that combination which the readings removed. A combination with a
gain under one half is called undetermined: it was known better before than the readings alone would tell it.
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
"""Least gain of a determined combination."""
UNINFORMATIVE = 0.01
"""Combinations with less gain than this are alike: any rotation among them is as good, a simple one is shown."""
SHOWN = 0.1
"""Smallest coefficient that is named."""
MATERIAL = 0.05
"""Least rise of a gain that is worth a measurement."""


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
    """Gains (p,), 1 less posterior over prior variance, ascending; their combinations (p, p) in prior sigmas."""
    scaled = covariance / np.outer(prior_sigma, prior_sigma)
    remaining, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    return np.clip(1.0 - remaining[::-1], 0.0, 1.0), vectors[:, ::-1]


def undetermined(covariance: Floats, prior_sigma: Floats) -> list[Direction]:
    """Combinations with a gain under one half, the least known first.

    `covariance` (p, p) is that after the adjustment, priors included.
    """
    gain, vectors = gains(covariance, prior_sigma)
    silent = gain < UNINFORMATIVE
    vectors = np.concatenate([simple_rotation(vectors[:, silent]), vectors[:, ~silent]], axis=1)
    scaled = covariance / np.outer(prior_sigma, prior_sigma)
    gain = 1.0 - np.einsum("ij,ik,kj->j", vectors, scaled, vectors)
    combinations = [Direction(vectors[:, i], float(max(gain[i], 0.0))) for i in np.flatnonzero(gain < DETERMINED)]
    return sorted(combinations, key=lambda direction: direction.gain)


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

    The first remedy that lifts a gain above one half is named, else the one that lifts it most. `construction` is the
    one whose parameters are meant; `directions` has one sequence an instrument.
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
    """Gain along each direction of each instrument in a network; none in one too poor to be solved."""
    try:
        covariance, prior = network.parameter_covariance()
    except NetworkError:
        return [[0.0 for _ in combinations] for combinations in directions]
    return [
        [float(1.0 - (d.vector / sigma) @ block @ (d.vector / sigma)) for d in combinations]
        for block, sigma, combinations in zip(covariance, prior, directions, strict=True)
    ]


def _sentence(direction: Direction, now: float, tried: Sequence[tuple[str, float]]) -> str:
    """Sentence on what determines one direction: `tried` are remedies with their gains, `now` the gain without them."""
    if now >= DETERMINED > direction.gain:
        return advice("determined already", then=now)
    enough = [pair for pair in tried if pair[1] >= DETERMINED]
    words, then = enough[0] if enough else max(tried, key=lambda pair: pair[1], default=("", now))
    if then - now < MATERIAL:
        return advice("not determined")
    return advice("determined", do=words, now=direction.gain, then=then)
