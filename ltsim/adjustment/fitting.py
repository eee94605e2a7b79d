"""One pose or one point from whatever was read: small fits from many starts at once, the best is taken.

Used only for approximate coordinates, where a station or a target cannot be had in closed form: bearings without
ranges, ranges without bearings, a level, a known mark.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Bools, Floats, Ints
from ltsim.geometry.polar import polar_jacobian, to_polar, wrap
from ltsim.geometry.rotations import about_z, cross_matrix, from_rotation_vector

ITERATIONS = 60
SAME = 1e-3
"""Solutions closer than this [m, rad] are one."""
CLEARLY = 4.0
"""A solution is clear when the next best one is this many times worse (in standard deviations, squared)."""
WORST = 300.0
"""[standard deviations, rms]: approximate coordinates that fit worse than this are none."""
FLOOR = 1e-4
"""[share of the range, rad] taken for the standard deviation of everything: neighbours are only roughly placed yet."""
BEST = 150
"""Starts that are followed: those that fit best."""
ROWS = 12
"""Rows that are fitted, evenly chosen."""

Evaluate = Callable[[Floats, Floats], tuple[Floats, Floats]]
Move = Callable[[Floats, Floats, Floats], tuple[Floats, Floats]]


@dataclass(frozen=True)
class Sight:
    """Rows for one fit: front-face readings (k, 3) [m, rad, rad] with NaN where not measured; horizontal distances."""

    readings: Floats
    horizontal: Bools
    lift: Floats

    @property
    def count(self) -> int:
        """Number of readings."""
        return int(np.isfinite(self.readings).sum())

    def few(self) -> tuple[Ints, Sight]:
        """At most `ROWS` of the rows."""
        k = len(self.readings)
        rows = np.arange(k) if k <= ROWS else np.linspace(0, k - 1, ROWS).astype(np.int64)
        return rows, Sight(self.readings[rows], self.horizontal[rows], self.lift[rows])

    def residual(self, local: Floats) -> tuple[Floats, Floats]:
        """Residuals (b, 3 k) in parts of the range and their derivatives (b, 3 k, 3) by the local points (b, k, 3)."""
        size, rows = local.shape[:2]
        polar = to_polar(local.reshape(-1, 3))
        by = polar_jacobian(polar, np.ones(len(polar), dtype=np.int64)).reshape(size, rows, 3, 3)
        polar = polar.reshape(size, rows, 3)
        range_ = polar[:, :, 0].copy()
        flat = self.horizontal
        by[:, flat, 0] = (
            np.cos(polar[:, flat, 2])[..., None] * by[:, flat, 0]
            - (polar[:, flat, 0] * np.sin(polar[:, flat, 2]))[..., None] * by[:, flat, 2]
        )
        polar[:, flat, 0] *= np.cos(polar[:, flat, 2])
        gap = self.readings - polar
        gap[:, :, 1:] = wrap(gap[:, :, 1:])
        scale = np.stack([1.0 / range_, np.cos(polar[:, :, 2]), np.ones_like(range_)], axis=2) / FLOOR
        gap, by = gap * scale, by * scale[..., None]
        unread = np.isnan(self.readings)
        gap[:, unread], by[:, unread] = 0.0, 0.0
        return gap.reshape(size, -1), by.reshape(size, -1, 3)


def fit_pose(
    sight: Sight, points: Floats, *, level: bool = False, position: Floats | None = None
) -> tuple[Floats, Floats] | None:
    """Position (3,) and rotation (3, 3) of a station that sees known points (k, 3); None where that is not clear.

    Parameters
    ----------
    sight, points
        What was read, and the points it was read to.
    level : bool
        The vertical axis is that of the network.
    position : (3,) float, optional, [m]
        Where the station stands, if that is known.
    """
    rows, sight = sight.few()
    points = points[rows] + sight.lift
    range_, azimuth, elevation = (bool(np.isfinite(sight.readings[:, i]).any()) for i in range(3))
    tilted = not level and (azimuth or elevation)
    high = position is None and (range_ or elevation or not level)
    free = np.array([position is None] * 2 + [high] + [tilted] * 2 + [azimuth])
    if sight.count < free.sum():
        return None
    places = _places(points) if position is None else position[None]
    turns = _turns(not tilted) if azimuth or tilted else np.eye(3)[None]
    places = places if high or position is not None else places[:-2]
    x = np.repeat(places, len(turns), axis=0)
    rotation = np.tile(turns, (len(places), 1, 1))

    def evaluate(x: Floats, rotation: Floats) -> tuple[Floats, Floats]:
        arm = points[None] - x[:, None]
        gap, by_local = sight.residual(arm @ rotation)
        turned = by_local @ np.swapaxes(rotation, 1, 2)
        three = turned.reshape(len(x), -1, 3, 3)
        by_turn = (three @ cross_matrix(arm)).reshape(len(x), -1, 3)
        return gap, np.concatenate([-turned, by_turn], axis=2)[:, :, free]

    def move(x: Floats, rotation: Floats, step: Floats) -> tuple[Floats, Floats]:
        whole = np.zeros((len(x), 6))
        whole[:, free] = step
        return x + whole[:, :3], from_rotation_vector(whole[:, 3:]) @ rotation

    cost, x, rotation = _descend(evaluate, move, x, rotation)
    apart = np.linalg.norm(x - x[0], axis=1) / (1 + np.abs(points - x[0]).max()) + np.linalg.norm(
        rotation - rotation[0], axis=(1, 2)
    )
    return (x[0], rotation[0]) if _clear(cost, apart, sight.count) else None


def fit_point(sight: Sight, position: Floats, rotation: Floats) -> Floats | None:
    """A point (3,) seen from known stations at `position` (k, 3), `rotation` (k, 3, 3); None where not clear."""
    rows, sight = sight.few()
    position, rotation = position[rows], rotation[rows]
    if sight.count < 3:
        return None
    lifted = position - sight.lift
    x = _along(sight.readings, lifted, rotation)
    if not len(x):
        return None

    def evaluate(x: Floats, _: Floats) -> tuple[Floats, Floats]:
        local = np.einsum("kji,bkj->bki", rotation, x[:, None] - lifted[None])
        gap, by_local = sight.residual(local)
        by = by_local.reshape(len(x), -1, 3, 3) @ np.swapaxes(rotation, 1, 2)[None]
        return gap, by.reshape(len(x), -1, 3)

    def move(x: Floats, same: Floats, step: Floats) -> tuple[Floats, Floats]:
        return x + step, same

    cost, x, _ = _descend(evaluate, move, x, np.zeros((len(x), 1)))
    apart = np.linalg.norm(x - x[0], axis=1) / (1 + np.linalg.norm(lifted - x[0], axis=1).max())
    return x[0] if _clear(cost, apart, sight.count) else None


def _clear(cost: Floats, apart: Floats, count: int) -> bool:
    """Whether the first of the solutions, sorted by cost, is good and the only one as good."""
    if not cost[0] < WORST**2 * count:
        return False
    other = cost[apart > SAME]
    return not len(other) or float(other[0]) > CLEARLY * float(cost[0]) + count


def _descend(evaluate: Evaluate, move: Move, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Levenberg-Marquardt from the best starts at once: costs, ascending, and where they were reached."""
    with np.errstate(divide="ignore", invalid="ignore"):
        best = np.argsort(_cost(evaluate(x, y)[0]))[:BEST]
        x, y = x[best], y[best]
        gap, by = evaluate(x, y)
        cost, damping = _cost(gap), np.full(len(x), 1e-3)
        for _ in range(ITERATIONS):
            normal = np.nan_to_num(np.swapaxes(by, 1, 2) @ by, posinf=0.0)
            weight = damping[:, None] * np.einsum("bii->bi", normal) + 1e-9
            lifted = normal + weight[:, :, None] * np.eye(normal.shape[1])
            right = np.nan_to_num(np.einsum("bmi,bm->bi", by, gap), posinf=0.0)
            there, turned = move(x, y, np.linalg.solve(lifted, right[..., None])[..., 0])
            new_gap, new_by = evaluate(there, turned)
            new_cost = _cost(new_gap)
            better = new_cost < cost
            slow = ~better | (new_cost > cost * (1 - 1e-9))
            x, y = _choose(better, there, x), _choose(better, turned, y)
            gap, by = _choose(better, new_gap, gap), _choose(better, new_by, by)
            cost = np.where(better, new_cost, cost)
            damping = np.where(better, damping / 5, np.minimum(damping * 5, 1e9))
            if np.all(slow & (~better | (damping < 1e-6)) & ((damping > 1e3) | (damping < 1e-6))):
                break
    order = np.argsort(cost)
    return cost[order], x[order], y[order]


def _cost(gap: Floats) -> Floats:
    return np.nan_to_num(np.sum(gap**2, axis=1), nan=np.inf)


def _choose(better: Bools, new: Floats, old: Floats) -> Floats:
    return np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)


def _places(points: Floats) -> Floats:
    """Where a station may stand: among the points and around them."""
    centre = points.mean(axis=0)
    reach = max(float(np.linalg.norm(points - centre, axis=1).max()), 1.0)
    across = reach * np.array([[np.cos(a), np.sin(a), 0.0] for a in np.arange(8) * np.pi / 4])
    above = np.outer([-reach, reach], [0.0, 0.0, 1.0])
    return np.concatenate([[centre], centre + 0.4 * across, centre + 1.5 * across, centre + above])


def _turns(level: bool) -> Floats:
    yaws = np.stack([about_z(a) for a in np.arange(8) * np.pi / 4])
    if level:
        return yaws
    sides = np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [2, 0, 0], [0, 1, 0], [0, -1, 0]])
    tilts = from_rotation_vector(0.5 * np.pi * sides)
    return np.concatenate([tilt @ yaws for tilt in tilts])


def _along(readings: Floats, position: Floats, rotation: Floats) -> Floats:
    """Points to start from: along the beams that were read, on the spheres of ranges without a beam."""
    starts = []
    for (range_, azimuth, elevation), p, r in zip(readings, position, rotation, strict=True):
        lengths = [range_] if np.isfinite(range_) else np.geomspace(0.3, 300.0, 12)
        azimuths = [azimuth] if np.isfinite(azimuth) else np.arange(8) * np.pi / 4
        levels = [elevation] if np.isfinite(elevation) else [-1.0, -0.3, 0.3, 1.0]
        if np.isfinite([range_, azimuth, elevation]).sum() == 0:
            continue
        for d in lengths:
            for a in azimuths:
                for e in levels:
                    local = d * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
                    starts.append(p + r @ local)
    return np.array(starts[:400]).reshape(-1, 3)
