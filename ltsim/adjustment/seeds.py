"""How a network can begin where no station has measured ranges and both angles: two bundles of beams, or ranges alone.

Both are algebra, exact for exact readings, and known up to scale (beams) or up to reflection (ranges).
"""

from __future__ import annotations

import numpy as np

from ltsim.arrays import Floats

LEAST_BEAMS = 8
LEAST_RANGES = 10


def relative_orientation(first: Floats, second: Floats) -> tuple[Floats, Floats] | None:
    """Place (3,) and rotation (3, 3) of a second station in the first's frame from beams to k >= 8 common targets.

    The distance of the stations is 1. None where the beams do not determine it.

    Parameters
    ----------
    first, second : (k, 3) float
        Unit vectors to the same targets, each in its station's frame.

    References
    ----------
    Longuet-Higgins, Nature 293 (1981) 133: the essential matrix, of whose four factorisations the one is right that
    has all targets in front of both stations.
    """
    equations = (first[:, :, None] * second[:, None, :]).reshape(len(first), 9)
    _, singular, right = np.linalg.svd(equations)
    if len(first) < LEAST_BEAMS or singular[7] < 1e-6 * singular[0]:
        return None
    left, _, other = np.linalg.svd(right[8].reshape(3, 3))
    left, other = left * np.linalg.det(left), other * np.linalg.det(other)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    best: tuple[int, Floats, Floats] | None = None
    for turn in (quarter, quarter.T):
        rotation = left @ turn @ other
        for place in (left[:, 2], -left[:, 2]):
            front = _in_front(first, second @ rotation.T, place)
            if best is None or front > best[0]:
                best = front, place, rotation
    if best is None or best[0] < 0.8 * len(first):
        return None
    return best[1], best[2]


def _in_front(first: Floats, second: Floats, place: Floats) -> int:
    """How many beams of two stations, the second at `place`, meet in front of both."""
    cosine = np.sum(first * second, axis=1)
    a, b = first @ place, second @ place
    along, back = a - cosine * b, cosine * a - b
    return int(np.sum((along > 0) & (back > 0)))


def multilaterate(ranges: Floats) -> tuple[Floats, Floats] | None:
    """Stations (S, 3) and targets (T, 3) from all ranges (S, T) [m] between them; None where that is not possible.

    Needs four stations off one plane and ten targets; the result may be the mirror image.

    Notes
    -----
    Differences of squared ranges to a first station and target are products: a matrix of rank three, which gives
    both sides up to an affinity. That the first station sees the targets at its ranges is linear in the ten numbers
    that remain.
    """
    if ranges.shape[0] < 4 or ranges.shape[1] < LEAST_RANGES:
        return None
    squares = ranges**2
    product = -0.5 * (squares - squares[:1] - squares[:, :1] + squares[0, 0])
    left, singular, right = np.linalg.svd(product)
    if singular[2] < 1e-6 * singular[0]:
        return None
    stations, targets = left[:, :3] * singular[:3], right[:3].T
    x, y, z = targets.T
    quadratic = np.stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z], axis=1)
    values = np.linalg.lstsq(quadratic[1:], (squares[0] - squares[0, 0])[1:], rcond=None)[0]
    metric = values[[0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(3, 3)
    size, axes = np.linalg.eigh(metric)
    if size[0] <= 0:
        return None
    root = np.sqrt(size)[:, None] * axes.T
    shift = np.linalg.solve(root.T, values[6:])
    return stations @ np.linalg.inv(root), targets @ root.T + shift
