"""Projector onto the residual space of a least-squares adjustment, for arbitrary vectors of observations.

With A the whitened design and N = A' A, the hat matrix is H = A N^-1 A' and the projector P = 1 - H. Small systems use
an orthonormal basis of A, large ones the factor of the adjustment, so that cost and memory are proportional to the
nonzeros of the design. Tests compare the two.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TypeAlias

import numpy as np
import scipy.sparse as sp

from ltsim.core.arrays import Floats, Ints
from ltsim.solve.design import DesignMatrix, column_scale, to_dense
from ltsim.solve.elimination import BlockFactor, BlockSystem

MAX_BASIS_ENTRIES = 4_000_000
"""Number of entries below which a design gets an orthonormal basis, because dense products are much faster."""
MAX_UNPROJECTED_OVERLAP = 1e-10
"""Largest inner product of projected unit vectors with unit columns of the design; above it they
are projected again.
"""
MAX_LOCAL_ROWS = 150
"""Number of rows up to which the block of the projector on these rows is computed at once, because many vectors on the
same rows follow.
"""
MAX_LOCAL_ENTRIES = 3_000_000
"""Number of entries of all such blocks in memory, 24 MB."""
MAX_ZERO_EIGENVALUE = 1e-12
"""Eigenvalue of a block of the hat matrix below which it counts as zero."""


@dataclass(frozen=True)
class BasisProjection:
    """Projector from an orthonormal basis (m, u) of the design."""

    basis: Floats
    """Orthonormal basis (m, u) of the design."""

    @classmethod
    def from_design(cls, design: DesignMatrix) -> BasisProjection:
        """Projector onto the residual space of a design."""
        return cls(np.linalg.qr(to_dense(design) * column_scale(design))[0])

    def project(self, rows: Floats) -> Floats:
        """Residual part of vectors (m, q)."""
        return rows - self.basis @ (self.basis.T @ rows)

    def gram_matrices(self, columns: Floats, group_boundaries: Ints, rows: Ints | slice) -> list[Floats]:
        """Gram matrices (k, k) of projected vectors, which are `columns` (r, q) on some rows and zero on all others.

        Group i are the columns edges[i] to edges[i + 1].
        """
        whole_grams, inside = (
            _group_gram_matrices(columns, group_boundaries),
            _group_gram_matrices(self.basis[rows].T @ columns, group_boundaries),
        )
        return [whole - lost for whole, lost in zip(whole_grams, inside, strict=True)]

    def leverage(self) -> Floats:
        """Diagonal (m,) of the hat matrix."""
        return np.einsum("mu,mu->m", self.basis, self.basis)

    def hat_matrix_spectra(self, row_groups: Sequence[Ints]) -> Iterator[tuple[Floats, Floats]]:
        """Eigenvalues (k,) and eigenvectors (f, k) of the hat matrix on groups of f rows.

        Other eigenvalues are zero.
        """
        for rows in row_groups:
            part = self.basis[rows]
            yield _spectrum_of_thin_root(part) if len(rows) > part.shape[1] else np.linalg.eigh(part @ part.T)

    def with_removed_columns(self, columns: Floats) -> BasisProjection:
        """Projector that also removes orthonormal columns (m, e) of the residual space."""
        return BasisProjection(np.hstack([self.basis, columns]))


@dataclass(frozen=True)
class FactorProjection:
    """Projector from the factorised normal equations of a sparse design."""

    design: sp.csr_array
    """Sparse design matrix."""
    factor: BlockFactor
    """Factorised normal equations."""
    added_columns: Floats
    """Further columns (m, e) that are projected out, besides those of the design."""
    _transposed: sp.csr_array = field(repr=False)
    _scale: Floats = field(repr=False)
    _local_blocks: dict[bytes, Floats] = field(default_factory=dict, repr=False)
    """Blocks (r, r) of the projector by their rows."""

    @classmethod
    def from_design(cls, design: DesignMatrix, factor: BlockFactor) -> FactorProjection:
        """Projector onto the residual space of a design."""
        design = sp.csr_array(design)
        return cls(design, factor, np.zeros((design.shape[0], 0)), sp.csr_array(design.T), column_scale(design))

    def project(self, rows: Floats) -> Floats:
        """Residual part of vectors (m, q); projected again if the rounding of the factor is visible."""
        return self._residual_part(rows, slice(None))

    def gram_matrices(self, columns: Floats, group_boundaries: Ints, rows: Ints | slice) -> list[Floats]:
        """Gram matrices (k, k) of projected vectors, as `BasisProjection.gram_matrices`.

        On few rows they follow from the block of the projector on these rows.
        """
        block = self._local_block(rows)
        if block is None:
            return _group_gram_matrices(self._residual_part(columns, rows), group_boundaries)
        projected = block @ columns
        limits = pairwise(group_boundaries.tolist())
        return [columns[:, low:high].T @ projected[:, low:high] for low, high in limits]

    def _local_block(self, rows: Ints | slice) -> Floats | None:
        """Block (r, r) of the projector on few rows, computed once; None on many rows."""
        if isinstance(rows, slice) or not 0 < len(rows) <= MAX_LOCAL_ROWS:
            return None
        key = rows.tobytes()
        block = self._local_blocks.get(key)
        if block is None:
            block = self._residual_part(np.eye(len(rows)), rows)[rows]
            block = 0.5 * (block + block.T)
            if sum(other.size for other in self._local_blocks.values()) + block.size <= MAX_LOCAL_ENTRIES:
                self._local_blocks[key] = block
        return block

    def _residual_part(self, columns: Floats, rows: Ints | slice) -> Floats:
        """Residual part (m, q) of vectors that are zero on all but some rows."""
        inside = (self._transposed if len(columns) == len(self.added_columns) else self.design[rows].T) @ columns
        residual: Floats = self.design @ -self.factor.covariance_columns(inside)
        residual[rows] += columns
        again = self._transposed @ residual
        if np.any(np.abs(again) * self._scale[:, None] > MAX_UNPROJECTED_OVERLAP * np.linalg.norm(columns, axis=0)):
            residual -= self.design @ self.factor.covariance_columns(again)
        if self.added_columns.shape[1]:
            residual -= self.added_columns @ (self.added_columns.T @ residual)
        return residual

    def leverage(self) -> Floats:
        """Diagonal (m,) of the hat matrix."""
        return self.factor.leverage() + np.einsum("me,me->m", self.added_columns, self.added_columns)

    def hat_matrix_spectra(self, row_groups: Sequence[Ints]) -> Iterator[tuple[Floats, Floats]]:
        """Eigenvalues and eigenvectors of the hat matrix on groups of rows, as `BasisProjection.hat_matrix_spectra`."""
        edges = np.cumsum([0, *(len(rows) for rows in row_groups)])
        thick = edges[-1] == 0 or max(len(rows) for rows in row_groups) > self.design.shape[1] // 2
        if thick:
            yield from (self._spectrum_from_covariance(rows) for rows in row_groups)
            return
        hats = self.factor.covariances_of_functions(self.design[np.concatenate(row_groups)], edges)
        for rows, hat in zip(row_groups, hats, strict=True):
            yield np.linalg.eigh(hat + self.added_columns[rows] @ self.added_columns[rows].T)

    def _spectrum_from_covariance(self, rows: Ints) -> tuple[Floats, Floats]:
        """Eigenvalues and eigenvectors on many rows, from the covariance of the unknowns in these rows."""
        part = self.design[rows]
        touched = np.unique(part.indices)
        whole = np.array([0, len(touched)])
        ends = np.arange(len(touched) + 1)
        units = sp.csr_array((1.0 / self._scale[touched], touched, ends), (len(touched), part.shape[1]))
        covariance = next(self.factor.covariances_of_functions(units, whole))
        values, vectors = np.linalg.eigh(covariance)
        root = part[:, touched].toarray() * self._scale[touched] @ (vectors * np.sqrt(np.maximum(values, 0.0)))
        root = np.hstack([root, self.added_columns[rows]])
        return _spectrum_of_thin_root(root) if len(rows) > root.shape[1] else np.linalg.eigh(root @ root.T)

    def with_removed_columns(self, columns: Floats) -> FactorProjection:
        """Projector that also removes orthonormal columns (m, e), as `BasisProjection.with_removed_columns`."""
        return replace(self, added_columns=np.hstack([self.added_columns, columns]), _local_blocks={})


Projection: TypeAlias = BasisProjection | FactorProjection


def make_projection(block_system: BlockSystem, factor: BlockFactor | None) -> Projection:
    """Projector onto the residual space of a system: by a basis for a small system or without a factor."""
    rows, columns = block_system.design.shape
    if factor is None or rows * columns <= MAX_BASIS_ENTRIES:
        return BasisProjection.from_design(block_system.design)
    return FactorProjection.from_design(block_system.design, factor)


def _group_gram_matrices(columns: Floats, group_boundaries: Ints) -> list[Floats]:
    """Gram matrices (k, k) of groups of columns."""
    parts = (columns[:, low:high] for low, high in pairwise(group_boundaries.tolist()))
    return [part.T @ part for part in parts]


def _spectrum_of_thin_root(matrix_root: Floats) -> tuple[Floats, Floats]:
    """Non-zero eigenvalues of root root', and their vectors, for a root (f, k) with fewer columns than rows."""
    values, vectors = np.linalg.eigh(matrix_root.T @ matrix_root)
    nonzero = values > MAX_ZERO_EIGENVALUE
    return values[nonzero], matrix_root @ (vectors[:, nonzero] / np.sqrt(values[nonzero]))
