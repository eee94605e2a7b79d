"""Compiled kernel of the paper's distance objective (eq. 9 and 10, least squares) for a block of trials."""

from __future__ import annotations

import numpy as np

from ltsim.arrays import Bools, Floats, Ints
from ltsim.campaigns.compiled import compiled


@compiled
def _spread_force(first: Floats, second: Floats, towards: Floats, size: Floats, length: Floats) -> None:
    """Add to the forces on two points, `towards` (2, 3, B), a size (B,) along the line between them."""
    for c in range(3):
        for t in range(len(size)):
            part = size[t] / length[t] * (first[c, t] - second[c, t])
            towards[0, c, t] += part
            towards[1, c, t] -= part


@compiled
def _between(first: Floats, second: Floats, out: Floats) -> None:
    for t in range(len(out)):
        x, y, z = first[0, t] - second[0, t], first[1, t] - second[1, t], first[2, t] - second[2, t]
        out[t] = np.sqrt(x * x + y * y + z * z)


@compiled
def _add(source: Floats, goal: Floats) -> None:
    for c in range(3):
        for t in range(goal.shape[1]):
            goal[c, t] += source[c, t]


@compiled
def _known(gauge: Ints, i: int, j: int) -> int:
    """Which known length a pair of targets has; -1 for none."""
    for g in range(len(gauge)):
        if (gauge[g, 0] == i and gauge[g, 1] == j) or (gauge[g, 0] == j and gauge[g, 1] == i):
            return g
    return -1


@compiled
def distance_forces(clouds: Floats, seen: Bools, gauge: Ints, length: Floats, forces: Floats, cost: Floats) -> None:
    """Half the objective's derivative by the points of all sets, and the objective.

    Parameters
    ----------
    clouds : (O, T, 3, B) float, [m]
        Points of each set (a station and a face).
    seen : (O, T) bool
    gauge : (g, 2) int
        Pairs of targets with known lengths (g, B).
    forces : (O, T, 3, B), cost : (B,)
        Outputs, added to.
    """
    sets, targets, _, trials = clouds.shape
    own, middle = np.empty((sets, trials)), np.empty(trials)
    size, pair = np.empty(trials), np.empty((2, 3, trials))
    for i in range(targets):
        for j in range(i + 1, targets):
            count = 0
            middle[:] = 0.0
            for s in range(sets):
                if seen[s, i] and seen[s, j]:
                    _between(clouds[s, i], clouds[s, j], own[s])
                    count += 1
                    for t in range(trials):
                        middle[t] += own[s, t]
            known = _known(gauge, i, j)
            for s in range(sets):
                if not (seen[s, i] and seen[s, j]):
                    continue
                for t in range(trials):
                    gap = own[s, t] - middle[t] / count
                    size[t] = count * gap
                    cost[t] += count * gap * gap
                if known >= 0:
                    for t in range(trials):
                        gap = own[s, t] - length[known, t]
                        size[t] += gap
                        cost[t] += gap * gap
                pair[:] = 0.0
                _spread_force(clouds[s, i], clouds[s, j], pair, size, own[s])
                _add(pair[0], forces[s, i])
                _add(pair[1], forces[s, j])
