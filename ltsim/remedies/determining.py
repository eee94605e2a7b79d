"""What further measurement would determine a combination that a recording does not: found by computing it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from ltsim.adjustment.adjustment import Adjustment
from ltsim.errors import NetworkError
from ltsim.model.construction import Construction
from ltsim.remedies.network import Network
from ltsim.remedies.remedy import Remedy, known_length, near_reflectors, other_face, returns
from ltsim.remedies.undetermined import DETERMINED, Direction
from ltsim.remedies.words import advice

MATERIAL = 0.05
"""Least rise of a gain that is worth a measurement."""


def determining(
    adjustment: Adjustment, construction: Construction, directions: Sequence[Sequence[Direction]]
) -> list[list[str]]:
    """For each instrument's undetermined directions a sentence: what would determine them.

    The first remedy that lifts a gain above one half is named, else the one that lifts it most.

    Parameters
    ----------
    adjustment : Adjustment
        Of the network as it is.
    construction : Construction
        Whose parameters are meant.
    directions : one sequence an instrument
    """
    if not any(directions):
        return [[] for _ in directions]
    network = Network.of(adjustment, construction)
    now = _gains_along(network, directions)
    tried = [(r.words, _gains_along(r.network, directions)) for r in _worth_a_thought(network)]
    return [
        [_sentence(d, now[i][k], [(words, gain[i][k]) for words, gain in tried]) for k, d in enumerate(own)]
        for i, own in enumerate(directions)
    ]


def _worth_a_thought(network: Network) -> Iterator[Remedy]:
    """Remedies for a whole survey, the cheapest first."""
    both = other_face(network)
    yield from [both] if both else []
    yield from known_length(network)
    yield from returns(network, 0.0, [0])
    yield from near_reflectors(network)


def _gains_along(network: Network, directions: Sequence[Sequence[Direction]]) -> list[list[float]]:
    """Gain along each direction of each instrument in a network; none in one too poor to be solved."""
    try:
        covariance, prior = network.parameter_covariance()
    except NetworkError:
        return [[0.0 for _ in own] for own in directions]
    return [
        [float(1.0 - (d.vector / sigma) @ block @ (d.vector / sigma)) for d in own]
        for block, sigma, own in zip(covariance, prior, directions, strict=True)
    ]


def _sentence(direction: Direction, now: float, tried: Sequence[tuple[str, float]]) -> str:
    """What determines one direction: remedies with the gains that they reach; `now` is the network's own gain."""
    if now >= DETERMINED > direction.gain:
        return advice("determined already", then=now)
    enough = [pair for pair in tried if pair[1] >= DETERMINED]
    words, then = enough[0] if enough else max(tried, key=lambda pair: pair[1], default=("", now))
    if then - now < MATERIAL:
        return advice("not determined")
    return advice("determined", do=words, now=direction.gain, then=then)
