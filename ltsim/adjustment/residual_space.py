"""The residual space of an adjustment: what an adjustment leaves of any signature.

Residuals are correlated and smeared; a signature g of an effect shows as P g, with P the projector off everything that
is estimated. Tests of a diagnosis and the detectability of a plan live there, in whitened units.
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
    """The projection off what is estimated, and the residuals off it."""

    projection: Projection
    """Off the whitened design, and further signatures where they are estimated too."""
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
        """Readings in use, the first rows, (n, 3)."""
        return self.adjustment.problem.use

    @property
    def sigma(self) -> Floats:
        """(n, 3) standard deviations of the readings."""
        return self.adjustment.problem.sigma

    @property
    def size(self) -> int:
        """Number of rows m."""
        return len(self.residual)

    @cached_property
    def redundancy(self) -> Floats:
        """Share of an error of a row that stays in its residual, (m,)."""
        return 1.0 - self.projection.leverage()

    @cached_property
    def _readings(self) -> tuple[Ints, Floats]:
        """Places (r,) of the readings in use among all, and one over their standard deviations (r, 1)."""
        place = np.flatnonzero(self.use)
        return place, 1.0 / self.sigma.reshape(-1)[place, None]

    def whiten(self, design: Floats, gauge: Floats | None = None) -> Floats:
        """Rows (m, q) of a design (n, 3, q) on readings and (g, q) on known lengths."""
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
        """Whitened signature (m, q) of a law, before the adjustment takes its share."""
        gauge = self.adjustment.problem.gauge
        lengths = law.gauge_design(gauge.first, gauge.second, self.adjustment.state.points)
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
        """The residual space when signatures (m, q) are estimated too."""
        visible = self._visible(signature)
        residual = self.residual - visible @ (visible.T @ self.residual)
        return ResidualSpace(self.projection.extended(visible), residual, self.adjustment)

    def with_effects(self, laws: Sequence[Signature]) -> ResidualSpace:
        """The residual space when some laws are estimated too."""
        return self.augmented(np.hstack([self.signature(law) for law in laws])) if laws else self

    def moved_targets(self, signature: Floats) -> Floats:
        """Shift (T, 3) [m] of the adjusted targets by a change (m,) of the whitened readings."""
        adjustment = self.adjustment
        inside = (adjustment.solution.system.design.T @ signature)[:, None]
        change: Floats = adjustment.factor.covariance_columns(inside)[:, 0][adjustment.problem.unknowns.target]
        return change


def orthonormal(projected: Floats, norms: Floats) -> Floats:
    """Orthonormal columns (m, r) spanning what is `projected` (m, q) of signatures; invisible directions are dropped.

    Directions are compared with the lengths `norms` (q,) of the whole signatures, so no unit and no absolute tolerance
    enters.
    """
    unit = projected / np.where(norms > 0, norms, 1.0)
    strength, turn = np.linalg.eigh(unit.T @ unit)
    is_visible = strength > UNCHECKED
    basis: Floats = unit @ (turn[:, is_visible] / np.sqrt(strength[is_visible]))
    return basis
