"""The residual space of an adjustment: what an adjustment leaves of any signature.

Residuals are correlated and smeared; a signature g of an effect shows as P g, with P the projector off everything
that is
estimated. All tests of the diagnosis happen there, in whitened units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.adjust.adjustment import Adjustment
from ltsim.arrays import Bools, Floats
from ltsim.effects.effect import Effect
from ltsim.scene.sightings import Sightings
from ltsim.solve.blocks import column_scale

VISIBLE = 1e-6
"""Share of a signature's squared size below which its rest after the adjustment is rounding, not information."""


@dataclass(frozen=True)
class ResidualSpace:
    """Orthonormal basis of what is estimated, and the residuals off it.

    Attributes
    ----------
    basis : (m, u) float
        Orthonormal columns spanning the whitened design.
    residual : (m,) float
        Whitened residuals, orthogonal to the basis.
    sightings : Sightings
    sigma : (n, 3) float
    use : (n, 3) bool
        Readings in use; they are the first rows.
    gauge_rows : slice
    adjustment : Adjustment
    """

    basis: Floats
    residual: Floats
    adjustment: Adjustment

    @classmethod
    def of(cls, adjustment: Adjustment) -> ResidualSpace:
        """The residual space at the optimum of an adjustment."""
        system = adjustment.solution.system
        dense = system.design.toarray() * column_scale(system.design)
        basis, _ = np.linalg.qr(dense)
        residual = system.residual - basis @ (basis.T @ system.residual)
        return cls(basis, residual, adjustment)

    @property
    def sightings(self) -> Sightings:
        """Geometry of the pointings."""
        return self.adjustment.sightings

    @property
    def use(self) -> Bools:
        """(n, 3): readings in use, the first rows."""
        return self.adjustment.problem.use

    @property
    def sigma(self) -> Floats:
        """(n, 3) standard deviations of the readings."""
        return self.adjustment.problem.sigma

    @property
    def size(self) -> int:
        """Number of rows m."""
        return len(self.residual)

    @property
    def redundancy(self) -> Floats:
        """(m,): share of an error of a row that stays in its residual."""
        share: Floats = 1.0 - np.einsum("mu,mu->m", self.basis, self.basis)
        return share

    def whiten(self, design: Floats, gauge: Floats | None = None) -> Floats:
        """Rows (m, q) of a design (n, 3, q) on readings and (g, q) on known lengths."""
        rows = np.zeros((self.size, design.shape[2]))
        used = self.use
        pointing_rows = (design / self.sigma[:, :, None])[used]
        rows[: len(pointing_rows)] = pointing_rows
        if gauge is not None and len(gauge):
            at = len(pointing_rows)
            rows[at : at + len(gauge)] = gauge / self.adjustment.problem.gauge.sigma[:, None]
        return rows

    def signature(self, effect: Effect) -> Floats:
        """Whitened signature (m, q) of an effect, before the adjustment takes its share."""
        gauge = self.adjustment.problem.gauge
        lengths = effect.gauge_design(gauge.first, gauge.second, self.adjustment.state.points)
        return self.whiten(effect.design(self.sightings), lengths)

    def project(self, rows: Floats) -> Floats:
        """What the adjustment leaves of signatures (m, q)."""
        left: Floats = rows - self.basis @ (self.basis.T @ rows)
        return left

    def extended(self, signature: Floats) -> ResidualSpace:
        """The residual space when signatures (m, q) are estimated too."""
        visible = orthonormal(self.project(signature), signature)
        basis = np.hstack([self.basis, visible])
        residual = self.residual - visible @ (visible.T @ self.residual)
        return ResidualSpace(basis, residual, self.adjustment)


def orthonormal(left: Floats, whole: Floats) -> Floats:
    """Orthonormal columns (m, r) spanning what is `left` (m, q) of `whole`; invisible directions are dropped.

    Directions are compared with the size of the whole signature, so no unit and no absolute tolerance enters.
    """
    norm = np.linalg.norm(whole, axis=0)
    norm[norm == 0] = 1.0
    u, s, _ = np.linalg.svd(left / norm, full_matrices=False)
    return u[:, s**2 > VISIBLE]
