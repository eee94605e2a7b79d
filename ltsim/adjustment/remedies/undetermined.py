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


ROUNDING = 1e-9
"""Gain, and difference of gains, that rounding may produce."""
TIE = 1e-6
"""Relative difference up to which coefficients count as equal, so that rounding decides neither a sign nor an order."""
MOST_SWEEPS, SMALLEST_ANGLE = 200, 1e-13
"""Largest number of sweeps of planar rotations, and largest angle [rad] of a sweep after which they have converged."""


@dataclass(frozen=True)
class Direction:
    """Combination of parameters: a unit vector (p,) in prior sigmas, and its gain."""

    vector: Floats
    gain: float

    def coefficients(self, names: Sequence[str]) -> dict[str, float]:
        """Coefficients above 0.1 by name, largest first; the largest is positive, the first of equally large ones."""
        size = np.abs(self.vector)
        order = np.argsort(-np.round(size / TIE), kind="stable")
        sign = np.sign(self.vector[_first_of_largest(size)])
        return {names[i]: float(sign * self.vector[i]) for i in order if size[i] > SHOWN}


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
    gain = np.where(gain < ROUNDING, 0.0, gain)
    weak = [Direction(vectors[:, i], float(gain[i])) for i in np.flatnonzero(gain < DETERMINED)]
    return sorted(weak, key=lambda d: (round(d.gain / ROUNDING), _first_of_largest(np.abs(d.vector))))


def _first_of_largest(sizes: Floats) -> int:
    """Index of the first of the largest sizes that are equal up to rounding."""
    return int(np.flatnonzero(sizes >= (1.0 - TIE) * sizes.max())[0])


def simple_rotation(vectors: Floats) -> Floats:
    """Orthonormal columns rotated among themselves so that each has few large coefficients.

    The result depends on the span of the columns alone: planar rotations of pairs begin at a basis of it that is formed
    by the projections of the parameters, and converge to rounding.

    References
    ----------
    Kaiser, The varimax criterion, Psychometrika 23 (1958) 187.
    """
    columns = list(_basis_of_span(vectors).T)
    for _ in range(MOST_SWEEPS):
        largest = 0.0
        for i, j in combinations(range(len(columns)), 2):
            x, y = columns[i], columns[j]
            u, v = x**2 - y**2, 2.0 * x * y
            sine = 2.0 * (u @ v - u.sum() * v.sum() / len(u))
            cosine = u @ u - v @ v - (u.sum() ** 2 - v.sum() ** 2) / len(u)
            if np.hypot(sine, cosine) > ROUNDING:
                angle = 0.25 * np.arctan2(sine, cosine)
                columns[i], columns[j] = (
                    np.cos(angle) * x + np.sin(angle) * y,
                    np.cos(angle) * y - np.sin(angle) * x,
                )
                largest = max(largest, abs(angle))
        if largest < SMALLEST_ANGLE:
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
        [_sentence(d, now[i][k], [(words, gain[i][k]) for words, gain in tried]) for k, d in enumerate(weak)]
        for i, weak in enumerate(directions)
    ]


def _gains_along(network: Network, directions: Sequence[Sequence[Direction]]) -> list[list[float]]:
    """Gain along each direction of each instrument in a network; empty for an undetermined network."""
    try:
        covariance, prior = network.parameter_covariance()
    except NetworkError:
        return [[0.0 for _ in weak] for weak in directions]
    return [
        [float(1.0 - (d.vector / sigma) @ block @ (d.vector / sigma)) for d in weak]
        for block, sigma, weak in zip(covariance, prior, directions, strict=True)
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
