"""Strength of a cause after the least-squares adjustment, and error of the targets, linearised at the truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from .hall import LENGTH_SIGMA, Hall
from .tracker import GUARANTEED, Array, Change, Index, Pointings, within_a_turn

STEPS = np.full(3, 1e-4)
"""Step of central differences in each coordinate [m] or rotation [rad]."""


@dataclass(frozen=True)
class Network:
    """Whitened observation equations.

    Unknowns: targets, constants of each tracker, shifts and rotations of all stations but the first. Rows: readings (3
    n), reference lengths (g), guarantees of the constants (16 K).
    """

    hall: Hall
    design: Array
    base: Array
    """(n, 3) Readings without noise and without a cause."""
    basis: Array
    """Orthonormal basis of the columns of the design matrix."""

    @classmethod
    def of(cls, hall: Hall) -> Self:
        """Observation equations of a hall."""
        design = _design(hall)
        return cls(hall, design, hall.pointings.readings(), np.linalg.qr(design)[0])

    def signature(self, change: Change) -> Array:
        """(m,) Whitened change of the readings and lengths."""
        return self.whitened(self.hall.pointings.readings(change) - self.base, change.lengths)

    def whitened(self, readings: Array, lengths: Array | None = None) -> Array:
        """(m,) Differences of readings (n, 3) and lengths (g,) divided by their standard deviations."""
        difference = readings.copy()
        difference[:, 1] = within_a_turn(difference[:, 1])
        whole = self._rows(difference / self.hall.sigma)
        if lengths is not None:
            whole[difference.size : difference.size + len(lengths)] = lengths / LENGTH_SIGMA
        return whole

    def _rows(self, readings: Array) -> Array:
        return np.concatenate([readings.ravel(), np.zeros(len(self.design) - readings.size)])

    def strengths(self, change: Change) -> Array:
        """(4,) Strength of a change in each observable and in the lengths; their sum is the strength of the change.

        The strength is the noncentrality after the least squares; for noise it is the expected decrease of minus twice
        the restricted log likelihood.
        """
        if change.variance is not None:
            return self.noise_strengths(1.0 + change.variance)
        return self.mean_strengths(self.signature(change))

    def mean_strengths(self, columns: Array) -> Array:
        """(4,) Noncentrality of a whitened change (m,) by observable and in the lengths: change times its residual."""
        return self._by_observable(columns * self.residual(columns))

    def noise_strengths(self, factor: Array) -> Array:
        """(4,) Expected decrease of minus twice the restricted log likelihood, for variance factors (n, 3)."""
        factor = factor.ravel()
        return self._by_observable(self.redundancy * (factor - 1.0 - np.log(factor)))

    @property
    def redundancy(self) -> Array:
        """(3 n,) Redundancy number of each reading."""
        return np.asarray(1.0 - (self.basis[: self.base.size] ** 2).sum(axis=1))

    def residual(self, columns: Array) -> Array:
        """(m, ...) Residuals of whitened columns after adjustment of the unknowns."""
        return np.asarray(columns - self.basis @ (self.basis.T @ columns))

    def _by_observable(self, values: Array) -> Array:
        readings = self.base.size
        return np.append(values[:readings].reshape(-1, 3).sum(axis=0), values[readings:].sum())

    def target_error(
        self, noise: tuple[Array, Array], change: Change, modelled_changes: Sequence[Change] = ()
    ) -> float:
        """Rms error [um] of the targets after the best rigid fit.

        `noise` is standard normal noise of the readings (n, 3) and lengths (g,). The sizes of `modelled_changes` are
        estimated in addition to the unknowns.
        """
        points, constants = self.hall.pointings.points, self.hall.pointings.constants
        spread = np.ones(self.base.shape) if change.variance is None else np.sqrt(1.0 + change.variance)
        right = self.signature(change) + self._rows(spread * noise[0])
        start = self.base.size + len(noise[1])
        right[self.base.size : start] = noise[1]
        right[start:] = -(constants / GUARANTEED).ravel()
        design = np.column_stack(
            [self.design, *(self.signature(part) for part in modelled_changes if part.variance is None)]
        )
        if modelled_changes and change.variance is not None:
            weight = np.concatenate([spread.ravel(), np.ones(len(right) - spread.size)])
            design, right = design / weight[:, None], right / weight
        size = np.sqrt((design**2).sum(axis=0))
        size = np.where(size > 0, size, 1.0)
        moved = (np.linalg.lstsq(design / size, right, rcond=1e-12)[0] / size)[: points.size]
        rigid = np.vstack([np.hstack([np.eye(3), np.cross(p, np.eye(3))]) for p in points])
        moved -= rigid @ np.linalg.lstsq(rigid, moved, rcond=None)[0]
        return float(1e6 * np.sqrt((moved**2).sum() / len(points)))


def _design(hall: Hall) -> Array:
    """(m, q) Whitened design matrix."""
    p, bars = hall.pointings, np.arange(len(hall.bars))
    targets, trackers, stations = len(p.points), len(p.constants), len(p.position)
    readings = np.concatenate(
        [
            _derivatives(p, "target", p.target, targets, STEPS),
            _derivatives(p, "constants", p.tracker, trackers, GUARANTEED),
            *(_derivatives(p, part, p.station, stations, STEPS)[:, :, 3:] for part in ("station", "turn")),
        ],
        axis=2,
    )
    ends = p.points[hall.bars]
    way = (ends[:, 1] - ends[:, 0]) / hall.lengths[:, None] / LENGTH_SIGMA
    lengths = np.zeros((len(bars), targets, 3))
    lengths[bars, hall.bars[:, 0]], lengths[bars, hall.bars[:, 1]] = -way, way
    reference_residuals = np.zeros((len(bars) + p.constants.size, readings.shape[2]))
    reference_residuals[: len(bars), : 3 * targets] = lengths.reshape(len(bars), -1)
    guarantees = np.diag(1.0 / np.tile(GUARANTEED, trackers))
    reference_residuals[len(bars) :, 3 * targets : 3 * targets + p.constants.size] = guarantees
    return np.vstack([(readings / hall.sigma[:, :, None]).reshape(3 * hall.n, -1), reference_residuals])


def _derivatives(p: Pointings, part: str, owner: Index, owners: int, steps: Array) -> Array:
    """(n, 3, owners * k) Derivatives of the readings by a part of `Change`, with k columns for each owner."""
    derivatives = np.zeros((len(p), 3, owners, len(steps)))
    for column, step in enumerate(np.diag(steps)):
        moved = np.tile(step, (len(p), 1))
        change = p.readings(Change(**{part: moved})) - p.readings(Change(**{part: -moved}))
        change[:, 1] = within_a_turn(change[:, 1])
        derivatives[np.arange(len(p)), :, owner, column] = change / (2 * steps[column])
    return derivatives.reshape(len(p), 3, -1)
