"""What a network's least squares leaves of a cause, and how far off its targets come out; linear about the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .hall import LENGTH_SIGMA, Hall
from .tracker import CONSTANTS, GUARANTEED, Array, Change, readings_of, within_a_turn

STEP = 1e-4
"""[m, rad] Of central differences."""


@dataclass(frozen=True)
class Network:
    """Whitened equations: poses but the first, targets, constants of each tracker, known lengths.

    Rows: readings (3 n), lengths (g), guarantees (16 K).
    """

    hall: Hall
    design: Array
    base: Array
    """(n, 3) Readings without noise and cause."""
    basis: Array
    """Orthonormal columns that span the design."""

    @classmethod
    def of(cls, hall: Hall) -> Network:
        """The equations of a hall."""
        design = _design(hall)
        return cls(hall, design, hall.pointings.readings(), np.linalg.qr(design)[0])

    def signature(self, change: Change) -> Array:
        """(m,) Whitened change of the readings."""
        difference = self.hall.pointings.readings(change) - self.base
        difference[:, 1] = within_a_turn(difference[:, 1])
        whole = self._rows(difference / self.hall.sigma)
        if change.lengths is not None:
            whole[difference.size : difference.size + len(change.lengths)] = change.lengths / LENGTH_SIGMA
        return whole

    def _rows(self, readings: Array) -> Array:
        return np.concatenate([readings.ravel(), np.zeros(len(self.design) - readings.size)])

    def strength(self, change: Change) -> float:
        """Noncentrality that is left; for noise the expected drop of minus twice the restricted log likelihood."""
        return float(self.strengths(change).sum())

    def strengths(self, change: Change) -> Array:
        """(4,) What distance, azimuth, elevation and lengths have in it: their changes times what is left of these."""
        readings = self.base.size
        if change.variance is not None:
            factor = 1.0 + change.variance.ravel()
            each = (1.0 - (self.basis[:readings] ** 2).sum(axis=1)) * (factor - 1.0 - np.log(factor))
        else:
            whole = self.signature(change)
            each = whole * (whole - self.basis @ (self.basis.T @ whole))
        return np.append(each[:readings].reshape(-1, 3).sum(axis=0), each[readings:].sum())

    def noise(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """Standard noise of the readings (n, 3), and that of the lengths (g,)."""
        return rng.standard_normal(self.base.shape), rng.standard_normal(len(self.hall.bars))

    def target_error(self, noise: tuple[Array, Array], change: Change, told: Sequence[Change] = ()) -> float:
        """Error [um, rms] of the targets after the best rigid fit; `told`: whose sizes are estimated too."""
        constants = self.hall.pointings.constants
        spread = np.ones(self.base.shape) if change.variance is None else np.sqrt(1.0 + change.variance)
        right = self.signature(change) + self._rows(spread * noise[0])
        start = self.base.size + len(noise[1])
        right[self.base.size : start] = noise[1]
        right[start:] = -(constants / GUARANTEED).ravel()
        design = np.column_stack([self.design, *(self.signature(part) for part in told if part.variance is None)])
        if told and change.variance is not None:
            weight = np.concatenate([spread.ravel(), np.ones(len(right) - spread.size)])
            design, right = design / weight[:, None], right / weight
        size = np.sqrt((design**2).sum(axis=0))
        size = np.where(size > 0, size, 1.0)
        found = np.linalg.lstsq(design / size, right, rcond=1e-12)[0] / size
        points = self.hall.pointings.points
        poses = 6 * (len(self.hall.stations) - 1)
        moved = found[poses : poses + points.size].reshape(points.shape)
        rigid = np.vstack([np.hstack([np.eye(3), _cross(p)]) for p in points])
        moved = moved.ravel() - rigid @ np.linalg.lstsq(rigid, moved.ravel(), rcond=None)[0]
        return float(1e6 * np.sqrt((moved**2).sum() / len(points)))


def _cross(p: Array) -> Array:
    """(3, 3) What turns a small rotation vector into the displacement of a point."""
    x, y, z = p
    return np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])


def _design(hall: Hall) -> Array:
    """(m, q) Whitened derivatives by central differences of the exact tracker."""
    p = hall.pointings
    n, stations, points = len(p), len(p.position), len(p.points)
    local, back, constants = p.local(), p.face == 2, p.constants[p.tracker]
    by_local = _differences(lambda x: readings_of(x, back, constants), local, np.full(3, STEP))
    by_constant = _differences(lambda c: readings_of(local, back, c), constants, GUARANTEED)
    by_point = by_local @ np.swapaxes(p.rotation[p.station], 1, 2)
    arm = p.arm
    by_turn = -by_point @ np.stack([_cross(a) for a in arm])
    poses, rows = 6 * (stations - 1), np.arange(n)[:, None, None]
    q = poses + 3 * points + 16 * len(p.constants)
    readings = np.zeros((n, 3, q))
    axes, k = np.arange(3)[None, :, None], np.arange(3)[None, None, :]
    free = np.flatnonzero(p.station > 0)
    first = 6 * (p.station[free] - 1)[:, None, None]
    readings[rows[free], axes, first + k] = -by_point[free]
    readings[rows[free], axes, first + 3 + k] = by_turn[free]
    readings[rows, axes, poses + 3 * p.target[:, None, None] + k] = by_point
    places = poses + 3 * points + len(CONSTANTS) * p.tracker[:, None, None] + np.arange(len(CONSTANTS))[None, None, :]
    readings[rows, axes, places] = by_constant
    whitened = (readings / hall.sigma[:, :, None]).reshape(3 * n, q)
    lengths = np.zeros((len(hall.bars), q))
    for row, (a, b) in enumerate(hall.bars.tolist()):
        way = (p.points[b] - p.points[a]) / hall.lengths[row] / LENGTH_SIGMA
        lengths[row, poses + 3 * a : poses + 3 * a + 3] = -way
        lengths[row, poses + 3 * b : poses + 3 * b + 3] = way
    guarantees = np.zeros((p.constants.size, q))
    guarantees[:, q - p.constants.size :] = np.diag(1.0 / np.tile(GUARANTEED, len(p.constants)))
    return np.vstack([whitened, lengths, guarantees])


def _differences(function: object, at: Array, steps: Array) -> Array:
    """(n, 3, k) Derivatives of readings by each column of `at` (n, k)."""
    assert callable(function)
    found = []
    for column, step in enumerate(steps):
        moved = np.zeros(at.shape)
        moved[:, column] = step
        change = function(at + moved) - function(at - moved)
        change[:, 1] = within_a_turn(change[:, 1])
        found.append(change / (2 * step))
    return np.stack(found, axis=2)
