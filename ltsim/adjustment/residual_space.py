"""Residual space of an adjustment: projection of errors of observations onto the residuals.

The residual space is the orthogonal complement of the columns of the whitened design matrix. An effect that changes the
whitened observations by a vector g per unit of its parameter changes the whitened residuals by P g, where P is the
projector onto the residual space. The tests of a diagnosis and the detectability of effects in a plan use P.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.coordinate_uncertainty import point_columns
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE
from ltsim.physics.effects.linear_effect import LinearEffect
from ltsim.scene.sightings import Sightings
from ltsim.solve.projection import ResidualProjector, make_residual_projector

MAX_SCREENED_ENTRIES = 3_000_000
"""Largest number of entries of the design columns of all hypotheses that are projected onto the residual space, to
limit the processor time. Of more hypotheses only the most promising ones are projected."""


@dataclass(frozen=True)
class ResidualSpace:
    """Whitened residuals of an adjustment with m equations, and projector onto its residual space.

    The residual space is the orthogonal complement of the columns of the whitened design matrix.
    """

    projector: ResidualProjector
    """Projector onto the orthogonal complement of the columns of the whitened design matrix, including those of
    additional effects."""
    whitened_residuals: Floats
    """Whitened residuals of the m equations of the adjustment, (m,)."""
    adjustment: Adjustment
    """Adjustment to which the residuals belong."""

    @classmethod
    def from_adjustment(cls, adjustment: Adjustment) -> Self:
        """Residuals and projector at the solution of an adjustment; not cached, because the basis takes up to 32 MB."""
        solution = adjustment.solution
        projector = make_residual_projector(solution.system, solution.factor)
        residual = projector.project(solution.system.whitened_residuals[:, None])[:, 0]
        return cls(projector, residual, adjustment)

    @property
    def sightings(self) -> Sightings:
        """Range, direction and covariates (such as time) of each pointing, computed from the adjusted network."""
        return self.adjustment.sightings

    @property
    def is_used_reading(self) -> Bools:
        """Flags (n, 3) of the readings of n pointings that are in use; their equations precede all others."""
        return self.adjustment.problem.is_used_reading

    @property
    def reading_sigmas(self) -> Floats:
        """Standard deviations of the readings of n pointings, (n, 3) [m, rad, rad]."""
        return self.adjustment.problem.reading_sigmas

    @property
    def n_equations(self) -> int:
        """Number m of equations of the adjustment: observations, priors and datum."""
        return len(self.whitened_residuals)

    @cached_property
    def redundancy(self) -> Floats:
        """Redundancy numbers (m,) of the m equations, 0 to 1: part of an error that the residual shows."""
        return 1.0 - self.projector.leverage()

    @cached_property
    def _used_reading_weights(self) -> tuple[Ints, Floats]:
        """Flat indices (r,) of the r readings in use, and their inverse standard deviations (r, 1)."""
        place = np.flatnonzero(self.is_used_reading)
        return place, 1.0 / self.reading_sigmas.reshape(-1)[place, None]

    def whiten(self, design: Floats, reference_length_changes: Floats | None = None) -> Floats:
        """Whitened design columns (m, q) of m equations, from changes of readings and reference lengths.

        `design` (n, 3, q) contains the changes of the readings of n pointings per unit of q parameters, and
        `reference_length_changes` (g, q) [m] those of g reference lengths (gauge). Other equations do not change.
        """
        whitened_rows = np.zeros((self.n_equations, design.shape[2]))
        place, weight = self._used_reading_weights
        readings = design.reshape(-1, design.shape[2])
        np.multiply(
            readings if self.is_used_reading.all() else readings[place], weight, out=whitened_rows[: len(place)]
        )
        if reference_length_changes is not None and len(reference_length_changes):
            whitened_rows[len(place) : len(place) + len(reference_length_changes)] = (
                self.adjustment.problem.gauge_rows.decorrelate(reference_length_changes)
            )
        return whitened_rows

    def unwhiten(self, whitened_change: Floats) -> Floats:
        """Changes (n, 3) [m, rad, rad] of the readings of n pointings, from whitened changes (m,); 0 if unused."""
        readings = np.zeros(self.is_used_reading.shape)
        readings[self.is_used_reading] = (
            whitened_change[: int(self.is_used_reading.sum())] * self.reading_sigmas[self.is_used_reading]
        )
        return readings

    def whitened_design(self, effect: LinearEffect) -> Floats:
        """Whitened design columns (m, q) of m equations for an effect with q parameters."""
        return self.whiten(effect.design(self.sightings), self._gauge_design(effect))

    def nonzero_whitened_design(self, effect: LinearEffect) -> tuple[Ints, Floats]:
        """Indices (r,) of the r equations that an effect of q parameters changes, and their whitened design (r, q).

        The result contains the nonzero rows of `whitened_design`; if these are few, the computation is much faster.
        """
        place, weight = self._used_reading_weights
        readings = effect.design(self.sightings).reshape(-1, len(effect.parameters))
        changed = np.flatnonzero(np.logical_or.reduce([column != 0.0 for column in readings.T]))
        rows = self._equation_of_reading[changed]
        changed, rows = changed[rows >= 0], rows[rows >= 0]
        lengths = self.adjustment.problem.gauge_rows.decorrelate(self._gauge_design(effect))
        changed_lengths = np.flatnonzero(lengths.any(axis=1))
        return (
            np.append(rows, len(place) + changed_lengths),
            np.vstack([readings[changed] * weight[rows], lengths[changed_lengths]]),
        )

    def _gauge_design(self, effect: LinearEffect) -> Floats:
        """Derivatives (g, q) of the g reference lengths (gauge) with respect to the q parameters of an effect."""
        gauge = self.adjustment.problem.gauge_rows
        return effect.gauge_design(gauge.first_targets, gauge.second_targets, self.adjustment.state.target_points)

    @cached_property
    def _equation_of_reading(self) -> Ints:
        """Equation index (3 n,) of each reading of n pointings; -1 for a reading that is not in use."""
        place, _ = self._used_reading_weights
        equations = np.full(self.is_used_reading.size, -1)
        equations[place] = np.arange(len(place))
        return equations

    def project(self, design_columns: Floats) -> Floats:
        """Projections (m, q) of q whitened columns (m, q), or of one vector (m,), off the columns of all unknowns."""
        return self.projector.project(design_columns if design_columns.ndim > 1 else design_columns[:, None]).reshape(
            design_columns.shape
        )

    def chi2_drop(self, design_columns: Floats) -> tuple[float, int]:
        """Decrease of chi-square and its degrees of freedom, if the q parameters of `design_columns` are estimated too.

        The columns (m, q) are the whitened changes of m equations per unit of the parameters.
        """
        scores = self._projected_basis(design_columns).T @ self.whitened_residuals
        return float(scores @ scores), len(scores)

    def _projected_basis(self, design_columns: Floats) -> Floats:
        """Orthonormal basis (m, r) of the span of `design_columns` after projection off all unknowns.

        The columns (m, q) are the whitened changes of m equations per unit of q parameters; r is the dimension.
        """
        return orthonormal_columns(self.project(design_columns), self.norms_without_centring(design_columns))

    def norms_without_centring(self, design_columns: Floats) -> Floats:
        """Lengths (q,) of q `design_columns` (m, q), without the part that centring errors in the model absorb.

        Centring errors with a large standard deviation absorb nearly all of an effect. The part of an effect that
        remains in the residuals is therefore compared with these lengths, and not with those of the original columns.
        """
        squares = lowest = np.sum(design_columns**2, axis=0)
        if not self._centring_normals:
            return np.sqrt(squares)
        changes = np.zeros((*self.is_used_reading.shape, design_columns.shape[1]))
        changes[self.is_used_reading] = design_columns[: int(self.is_used_reading.sum())]
        for rows, occupation, slope, normals in self._centring_normals:
            scores = np.zeros((len(normals), 3, design_columns.shape[1]))
            np.add.at(scores, occupation, np.einsum("nki,nkq->niq", slope, changes[rows]))
            absorbed = np.einsum("niq,niq->q", scores, np.linalg.solve(normals, scores))
            lowest = np.minimum(lowest, squares - absorbed)
        return np.sqrt(np.maximum(lowest, 0.0))

    @cached_property
    def _centring_normals(self) -> list[tuple[Ints, Ints, Floats, Floats]]:
        """Indices (r,) of pointings and occupations, slopes and normal matrices, for each kind of centring errors.

        An occupation is one placement of a reflector on a target. The slopes (r, 3, 3) are the whitened changes of the
        readings per unit displacement of the reflector. The normal matrices (k, 3, 3) of k occupations include the
        prior of the displacements.
        """
        entries = []
        for errors in self.adjustment.problem.model.centring_errors:
            rows = np.flatnonzero(errors.occupation_indices >= 0)
            slope = self.sightings.target_derivatives[rows] / self.reading_sigmas[rows, :, None]
            slope = np.where(self.is_used_reading[rows, :, None], slope, 0.0)
            normals = np.tile(np.eye(3) / errors.displacement_sigma**2, (errors.n_occupations, 1, 1))
            np.add.at(normals, errors.occupation_indices[rows], np.einsum("nki,nkj->nij", slope, slope))
            entries.append((rows, errors.occupation_indices[rows], slope, normals))
        return entries

    def with_design_columns(self, design_columns: Floats) -> ResidualSpace:
        """Residual space after the estimation of q further unknowns, which have the `design_columns` (m, q)."""
        basis = self._projected_basis(design_columns)
        residual = self.whitened_residuals - basis @ (basis.T @ self.whitened_residuals)
        return ResidualSpace(self.projector.with_removed_columns(basis), residual, self.adjustment)

    def with_effects(self, effects: Sequence[LinearEffect]) -> ResidualSpace:
        """Residual space after the estimation of the parameters of `effects` as further unknowns."""
        if not effects:
            return self
        return self.with_design_columns(np.hstack([self.whitened_design(effect) for effect in effects]))

    def target_shifts(self, design_columns: Floats) -> Floats:
        """Shifts (T, 3) [m] of T adjusted targets by a whitened change `design_columns` (m,) of the m equations."""
        return self.point_shifts(design_columns)[: len(self.adjustment.recording.targets)]

    def point_shifts(self, design_columns: Floats) -> Floats:
        """Shifts (T + S, 3) [m] of T adjusted targets and S stations by a whitened change of the m equations.

        `design_columns` (m,) is the change.
        """
        adjustment = self.adjustment
        normal_side = (adjustment.solution.system.design.T @ design_columns)[:, None]
        change: Floats = adjustment.factorised_normals.multiply_by_covariance(normal_side)[:, 0][
            point_columns(adjustment, with_stations=True)
        ]
        return change


def orthonormal_columns(projected_columns: Floats, norms: Floats) -> Floats:
    """Orthonormal basis (m, r) of the span of q projected design columns (m, q), of dimension r.

    `norms` (q,) are the lengths of the columns before the projection. Directions with a length that is negligible
    relative to `norms` are omitted.
    """
    unit = projected_columns / np.where(norms > 0, norms, 1.0)
    strength, turn = np.linalg.eigh(unit.T @ unit)
    is_visible = strength > NORMAL_EQUATIONS_TOLERANCE
    basis: Floats = unit @ (turn[:, is_visible] / np.sqrt(strength[is_visible]))
    return basis
