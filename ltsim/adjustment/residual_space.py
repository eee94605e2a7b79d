"""Residual space of an adjustment: the part of any signature that remains after the adjustment.

Residuals are correlated: a signature g of an effect appears in them as P g, where P is the projector onto the residual
space. Tests of a diagnosis and the detectability of a plan use it, in whitened units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.significance import UNCHECKED
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.physics.effects.signature import Signature
from ltsim.scene.sightings import Sightings
from ltsim.solve.projection import Projection


@dataclass(frozen=True)
class ResidualSpace:
    """Projector onto the residual space, and the residuals."""

    projection: Projection
    """Projector that removes the whitened design, and additional signatures if they are in the model."""
    residual: Floats
    """Whitened residuals, orthogonal to the design, (m,)."""
    adjustment: Adjustment

    @classmethod
    def of(cls, adjustment: Adjustment) -> Self:
        """The residual space at the optimum of an adjustment."""
        projection = adjustment.projection
        residual = projection.project(adjustment.solution.system.residual[:, None])[:, 0]
        return cls(projection, residual, adjustment)

    @property
    def sightings(self) -> Sightings:
        """Geometry of the pointings."""
        return self.adjustment.sightings

    @property
    def use(self) -> Bools:
        """Flags (n, 3) of the readings in use, which are the first rows."""
        return self.adjustment.problem.use

    @property
    def sigma(self) -> Floats:
        """Standard deviations of the readings, (n, 3)."""
        return self.adjustment.problem.sigma

    @property
    def size(self) -> int:
        """Number of rows m."""
        return len(self.residual)

    @cached_property
    def redundancy(self) -> Floats:
        """Redundancy of each row, (m,): derivative of its residual with respect to its error."""
        return 1.0 - self.projection.leverage()

    @cached_property
    def _readings(self) -> tuple[Ints, Floats]:
        """Indices (r,) of the readings in use, and their inverse standard deviations (r, 1)."""
        place = np.flatnonzero(self.use)
        return place, 1.0 / self.sigma.reshape(-1)[place, None]

    def whiten(self, design: Floats, gauge: Floats | None = None) -> Floats:
        """Whitened rows (m, q) from designs (n, 3, q) of readings and (g, q) of reference lengths."""
        rows = np.zeros((self.size, design.shape[2]))
        place, weight = self._readings
        readings = design.reshape(-1, design.shape[2])
        np.multiply(readings if self.use.all() else readings[place], weight, out=rows[: len(place)])
        if gauge is not None and len(gauge):
            rows[len(place) : len(place) + len(gauge)] = self.adjustment.problem.gauge.whitened(gauge)
        return rows

    def unwhitened(self, change: Floats) -> Floats:
        """Readings (n, 3) [m, rad, rad] of whitened rows (m,); 0 for readings that are not in use."""
        readings = np.zeros(self.use.shape)
        readings[self.use] = change[: int(self.use.sum())] * self.sigma[self.use]
        return readings

    def signature(self, law: Signature) -> Floats:
        """Whitened signature (m, q) of a law, before projection."""
        gauge = self.adjustment.problem.gauge
        lengths = law.gauge_design(gauge.first, gauge.second, self.adjustment.state.target_points)
        return self.whiten(law.design(self.sightings), lengths)

    def project(self, rows: Floats) -> Floats:
        """Residual part of signatures (m, q), or of one vector (m,), after the adjustment."""
        return self.projection.project(rows if rows.ndim > 1 else rows[:, None]).reshape(rows.shape)

    def chi2_drop(self, signature: Floats) -> tuple[float, int]:
        """Decrease of chi-square when signatures (m, q) are estimated too, and the number of estimable ones."""
        scores = self._visible(signature).T @ self.residual
        return float(scores @ scores), len(scores)

    def _visible(self, signature: Floats) -> Floats:
        return orthonormal(self.project(signature), np.linalg.norm(signature, axis=0))

    def augmented(self, signature: Floats) -> ResidualSpace:
        """Residual space with signatures (m, q) in the model."""
        visible = self._visible(signature)
        residual = self.residual - visible @ (visible.T @ self.residual)
        return ResidualSpace(self.projection.extended(visible), residual, self.adjustment)

    def with_effects(self, laws: Sequence[Signature]) -> ResidualSpace:
        """Residual space with some laws in the model."""
        return self.augmented(np.hstack([self.signature(law) for law in laws])) if laws else self

    def moved_targets(self, signature: Floats) -> Floats:
        """Shift (T, 3) [m] of the adjusted targets by a change (m,) of the whitened readings."""
        adjustment = self.adjustment
        inside = (adjustment.solution.system.design.T @ signature)[:, None]
        change: Floats = adjustment.factor.covariance_columns(inside)[:, 0][adjustment.problem.unknowns.target]
        return change


def orthonormal(projected: Floats, norms: Floats) -> Floats:
    """Orthonormal columns (m, r) that span the `projected` signatures (m, q).

    Directions without projection are dropped.

    Directions are compared with the lengths `norms` (q,) of the complete signatures, so that units have no influence.
    """
    unit = projected / np.where(norms > 0, norms, 1.0)
    strength, turn = np.linalg.eigh(unit.T @ unit)
    is_visible = strength > UNCHECKED
    basis: Floats = unit @ (turn[:, is_visible] / np.sqrt(strength[is_visible]))
    return basis
