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
from ltsim.adjustment.significance import MIN_NUMERICAL_REDUNDANCY
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.physics.effects.signature import Signature
from ltsim.scene.sightings import Sightings
from ltsim.solve.projection import Projection


@dataclass(frozen=True)
class ResidualSpace:
    """Projector onto the residual space, and the residuals."""

    projector: Projection
    """Projector that removes the whitened design, and additional signatures if they are in the model."""
    residuals: Floats
    """Whitened residuals, orthogonal to the design, (m,)."""
    adjustment: Adjustment

    @classmethod
    def from_adjustment(cls, adjustment: Adjustment) -> Self:
        """The residual space at the optimum of an adjustment."""
        projection = adjustment.residual_projector
        residual = projection.project(adjustment.solution.system.whitened_residuals[:, None])[:, 0]
        return cls(projection, residual, adjustment)

    @property
    def sightings(self) -> Sightings:
        """Geometry of the pointings."""
        return self.adjustment.sightings

    @property
    def used_readings(self) -> Bools:
        """Flags (n, 3) of the readings in use, which are the first rows."""
        return self.adjustment.problem.used_readings

    @property
    def sigma(self) -> Floats:
        """Standard deviations of the readings, (n, 3)."""
        return self.adjustment.problem.sigma

    @property
    def n_rows(self) -> int:
        """Number of rows m."""
        return len(self.residuals)

    @cached_property
    def redundancy(self) -> Floats:
        """Redundancy of each row, (m,): derivative of its residual with respect to the error of its observation."""
        return 1.0 - self.projector.leverage()

    @cached_property
    def _used_reading_weights(self) -> tuple[Ints, Floats]:
        """Indices (r,) of the readings in use, and their inverse standard deviations (r, 1)."""
        place = np.flatnonzero(self.used_readings)
        return place, 1.0 / self.sigma.reshape(-1)[place, None]

    def whiten(self, design: Floats, gauge: Floats | None = None) -> Floats:
        """Whitened rows (m, q) from designs (n, 3, q) of readings and (g, q) of reference lengths."""
        rows = np.zeros((self.n_rows, design.shape[2]))
        place, weight = self._used_reading_weights
        readings = design.reshape(-1, design.shape[2])
        np.multiply(readings if self.used_readings.all() else readings[place], weight, out=rows[: len(place)])
        if gauge is not None and len(gauge):
            rows[len(place) : len(place) + len(gauge)] = self.adjustment.problem.gauge_rows.decorrelate(gauge)
        return rows

    def unwhiten(self, change: Floats) -> Floats:
        """Readings (n, 3) [m, rad, rad] of whitened rows (m,); 0 for readings that are not in use."""
        readings = np.zeros(self.used_readings.shape)
        readings[self.used_readings] = change[: int(self.used_readings.sum())] * self.sigma[self.used_readings]
        return readings

    def whitened_signature(self, law: Signature) -> Floats:
        """Whitened signature (m, q) of a law, before projection."""
        gauge = self.adjustment.problem.gauge_rows
        lengths = law.gauge_design(gauge.first_targets, gauge.second_targets, self.adjustment.state.target_points)
        return self.whiten(law.design(self.sightings), lengths)

    def project(self, rows: Floats) -> Floats:
        """Residual part of signatures (m, q), or of one vector (m,), after the adjustment."""
        return self.projector.project(rows if rows.ndim > 1 else rows[:, None]).reshape(rows.shape)

    def chi2_drop(self, signature: Floats) -> tuple[float, int]:
        """Decrease of chi-square when signatures (m, q) are estimated too, and the number of estimable ones."""
        scores = self._projected_basis(signature).T @ self.residuals
        return float(scores @ scores), len(scores)

    def _projected_basis(self, signature: Floats) -> Floats:
        return orthonormal_columns(self.project(signature), np.linalg.norm(signature, axis=0))

    def with_signatures(self, signature: Floats) -> ResidualSpace:
        """Residual space with signatures (m, q) in the model."""
        basis = self._projected_basis(signature)
        residual = self.residuals - basis @ (basis.T @ self.residuals)
        return ResidualSpace(self.projector.with_removed_columns(basis), residual, self.adjustment)

    def with_effects(self, laws: Sequence[Signature]) -> ResidualSpace:
        """Residual space with some laws in the model."""
        return self.with_signatures(np.hstack([self.whitened_signature(law) for law in laws])) if laws else self

    def target_shifts(self, signature: Floats) -> Floats:
        """Shift (T, 3) [m] of the adjusted targets by a change (m,) of the whitened readings."""
        adjustment = self.adjustment
        normal_side = (adjustment.solution.system.design.T @ signature)[:, None]
        change: Floats = adjustment.factorised_normals.covariance_columns(normal_side)[:, 0][
            adjustment.problem.unknowns.target_columns
        ]
        return change


def orthonormal_columns(projected_columns: Floats, norms: Floats) -> Floats:
    """Orthonormal columns (m, r) that span the `projected_columns` signatures (m, q).

    Directions without projection are dropped.

    Directions are compared with the lengths `norms` (q,) of the complete signatures, so that units have no influence.
    """
    unit = projected_columns / np.where(norms > 0, norms, 1.0)
    strength, turn = np.linalg.eigh(unit.T @ unit)
    is_visible = strength > MIN_NUMERICAL_REDUNDANCY
    basis: Floats = unit @ (turn[:, is_visible] / np.sqrt(strength[is_visible]))
    return basis
