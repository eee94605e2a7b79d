"""Projector onto the residual space of a least-squares adjustment, for arbitrary vectors of observations.

With the whitened design matrix A and N = A' A, the hat matrix is H = A N^-1 A' and the projector P = I - H. Small
systems use an orthonormal basis of the columns of A. Large systems use the factorised normal equations, so that cost
and memory are proportional to the number of non-zero entries of A.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TypeAlias

import numpy as np
import scipy.sparse as sp

from ltsim.core.arrays import Floats, Ints
from ltsim.solve.design import DesignMatrix, inverse_column_norms, to_dense
from ltsim.solve.elimination import BlockSystem, FactorisedNormals

MAX_DESIGN_ENTRIES_FOR_BASIS = 2_000_000
"""Limit of the number of entries of a design matrix. Below it, the projector onto the residual space (complement of the
column space) uses an orthonormal basis of the columns. Above it, the factorised normal equations are faster: a
diagnosis of 1,200 pointings, whose design matrix has 4 million entries, takes 34 to 53 s and 540 MB with a basis, and
28 to 36 s and 330 MB with the normal equations."""
MAX_OVERLAP_WITHOUT_REPROJECTION = 1e-10
"""Limit of the inner product of a unit vector, projected onto the residual space (complement of the column space), and
a unit column of the design matrix. The product is zero except for rounding errors; if it is larger than the limit, the
vector is projected again."""
MAX_STORED_BLOCK_ROWS = 150
"""Largest number of rows and columns of a diagonal block of the projection matrix that is computed and stored. A stored
block saves time if many vectors that are non-zero on the same rows only are projected.
"""
MAX_STORED_BLOCK_ENTRIES = 3_000_000
"""Largest total number of entries of the stored blocks of the projection matrix, 24 MB."""
MAX_EIGENVALUE_COUNTED_AS_ZERO = 1e-12
"""Largest eigenvalue of a submatrix of the hat matrix that counts as zero. All its eigenvalues are between 0 and 1."""


@dataclass(frozen=True)
class BasisResidualProjector:
    """Projector onto the residual space, from an orthonormal basis of the column space of the design matrix.

    The residual space is the orthogonal complement of the column space.
    """

    basis: Floats
    """Orthonormal basis (m, u) of the column space of the design matrix, which has m rows and u columns."""

    @classmethod
    def from_design(cls, design: DesignMatrix) -> BasisResidualProjector:
        """Projector onto the residual space of a whitened design matrix (m, u) with m rows and u columns.

        The residual space is the orthogonal complement of the columns of the design matrix.
        """
        return cls(np.linalg.qr(to_dense(design) * inverse_column_norms(design))[0])

    def project(self, vectors: Floats) -> Floats:
        """Projections (m, q) onto the residual space of q `vectors` of m observations (m, q).

        The residual space is the orthogonal complement of the columns of the design matrix.
        """
        return vectors - self.basis @ (self.basis.T @ vectors)

    def gram_matrices(self, columns: Floats, group_boundaries: Ints, row_selection: Ints | slice) -> list[Floats]:
        """Gram matrices (k, k) of groups of k vectors: inner products of their projections onto the residual space.

        The q vectors have the entries `columns` (r, q) on the r rows `row_selection`, and zeros on all other rows.
        Group i has the columns from entry i of `group_boundaries` to before entry i + 1. The residual space is the
        orthogonal complement of the columns of the design matrix.
        """
        full_grams, explained_grams = (
            _group_gram_matrices(columns, group_boundaries),
            _group_gram_matrices(self.basis[row_selection].T @ columns, group_boundaries),
        )
        return [whole - lost for whole, lost in zip(full_grams, explained_grams, strict=True)]

    def leverage(self) -> Floats:
        """Diagonal (m,) of the hat matrix A N^-1 A' of the design matrix A with m rows, where N = A' A."""
        return np.einsum("mu,mu->m", self.basis, self.basis)

    def hat_matrix_spectra(self, row_groups: Sequence[Ints]) -> Iterator[tuple[Floats, Floats]]:
        """Non-zero eigenvalues (k,), eigenvectors (f, k) of submatrices (f, f) of the hat matrix, for groups of rows.

        A group has the f row indices of one entry of `row_groups`. The other f - k eigenvalues are zero.
        """
        for rows in row_groups:
            part = self.basis[rows]
            yield _spectrum_from_root(part) if len(rows) > part.shape[1] else np.linalg.eigh(part @ part.T)

    def with_removed_columns(self, columns: Floats) -> BasisResidualProjector:
        """Projector that also removes components along e orthonormal vectors `columns` (m, e) of the residual space.

        The residual space is the orthogonal complement of the columns of the design matrix.
        """
        return BasisResidualProjector(np.hstack([self.basis, columns]))


@dataclass(frozen=True)
class FactorResidualProjector:
    """Projector onto the residual space, from the factorised normal equations of a sparse design.

    The residual space is the orthogonal complement of the columns of the design matrix.
    """

    design: sp.csr_array
    """Whitened sparse design matrix (m, u) with m rows and u columns."""
    factor: FactorisedNormals
    """Factorised normal equations of the design."""
    removed_columns: Floats
    """Matrix (m, e) of e orthonormal vectors along which the projector removes components too."""
    _transposed_design: sp.csr_array = field(repr=False)
    """Transposed `design`, stored by rows for fast products."""
    _inverse_column_norms: Floats = field(repr=False)
    """Reciprocal norms (u,) of the u columns of `design`."""
    _stored_blocks: dict[bytes, Floats] = field(default_factory=dict, repr=False)
    """Stored submatrices (r, r) of the projector for sets of r rows, by the bytes of the row indices."""

    @classmethod
    def from_design(cls, design: DesignMatrix, normal_equations: FactorisedNormals) -> FactorResidualProjector:
        """Projector onto the residual space of a whitened design matrix (m, u) with factorised normal equations.

        The residual space is the orthogonal complement of the columns of the design matrix.
        """
        design = sp.csr_array(design)
        return cls(
            design,
            normal_equations,
            np.zeros((design.shape[0], 0)),
            sp.csr_array(design.T),
            inverse_column_norms(design),
        )

    def project(self, vectors: Floats) -> Floats:
        """Projections (m, q) onto the residual space of q `vectors` of m observations (m, q).

        The residual space is the orthogonal complement of the columns of the design matrix.
        """
        return self._projected_sparse_vectors(vectors, slice(None))

    def gram_matrices(self, columns: Floats, group_boundaries: Ints, row_selection: Ints | slice) -> list[Floats]:
        """Gram matrices (k, k) of groups of k projected vectors, as `BasisResidualProjector.gram_matrices`.

        For at most `MAX_STORED_BLOCK_ROWS` rows the submatrix of the projector on these rows is stored and used.
        """
        block = self._cached_projector_block(row_selection)
        if block is None:
            return _group_gram_matrices(self._projected_sparse_vectors(columns, row_selection), group_boundaries)
        projected = block @ columns
        limits = pairwise(group_boundaries.tolist())
        return [columns[:, low:high].T @ projected[:, low:high] for low, high in limits]

    def _cached_projector_block(self, row_selection: Ints | slice) -> Floats | None:
        """Submatrix (r, r) of the projector on r rows, computed once; None for over `MAX_STORED_BLOCK_ROWS` rows."""
        if isinstance(row_selection, slice) or not 0 < len(row_selection) <= MAX_STORED_BLOCK_ROWS:
            return None
        key = row_selection.tobytes()
        block = self._stored_blocks.get(key)
        if block is None:
            (hat,) = self._hat_matrix_blocks([row_selection])
            block = np.eye(len(hat)) - 0.5 * (hat + hat.T)
            if sum(other.size for other in self._stored_blocks.values()) + block.size <= MAX_STORED_BLOCK_ENTRIES:
                self._stored_blocks[key] = block
        return block

    def _projected_sparse_vectors(self, columns: Floats, rows: Ints | slice) -> Floats:
        """Projections (m, q) onto the residual space of q vectors, with entries `columns` (r, q) on r `rows`, else 0.

        If rounding errors exceed `MAX_OVERLAP_WITHOUT_REPROJECTION`, the result is projected again. The residual space
        is the orthogonal complement of the columns of the design matrix.
        """
        design_products = (
            self._transposed_design if len(columns) == len(self.removed_columns) else self.design[rows].T
        ) @ columns
        residual: Floats = self.design @ -self.factor.multiply_by_covariance(design_products)
        residual[rows] += columns
        again = self._transposed_design @ residual
        if np.any(
            np.abs(again) * self._inverse_column_norms[:, None]
            > MAX_OVERLAP_WITHOUT_REPROJECTION * np.linalg.norm(columns, axis=0)
        ):
            residual -= self.design @ self.factor.multiply_by_covariance(again)
        if self.removed_columns.shape[1]:
            residual -= self.removed_columns @ (self.removed_columns.T @ residual)
        return residual

    def leverage(self) -> Floats:
        """Diagonal (m,) of the hat matrix, including the part of the removed columns.

        The projector also removes components along the removed columns (orthonormal vectors).
        """
        return self.factor.leverage() + np.einsum("me,me->m", self.removed_columns, self.removed_columns)

    def hat_matrix_spectra(self, row_groups: Sequence[Ints]) -> Iterator[tuple[Floats, Floats]]:
        """Non-zero eigenvalues (k,), eigenvectors (f, k) of submatrices (f, f) of the hat matrix, for groups of rows.

        A group has the f row indices of one entry of `row_groups`. The other f - k eigenvalues are zero.
        """
        n_rows = [len(rows) for rows in row_groups]
        if not any(n_rows) or max(n_rows) > self.design.shape[1] // 2:
            yield from (self._spectrum_from_covariance(rows) for rows in row_groups)
            return
        for hat in self._hat_matrix_blocks(row_groups):
            yield np.linalg.eigh(hat)

    def _hat_matrix_blocks(self, row_groups: Sequence[Ints]) -> Iterator[Floats]:
        """Submatrices (f, f) of the hat matrix, with the part of the removed columns, for each group of f rows.

        The cost depends on the number of unknowns in these rows, not on the number of all unknowns. The projector also
        removes components along the removed columns (orthonormal vectors).
        """
        edges = np.cumsum([0, *(len(rows) for rows in row_groups)])
        hats = self.factor.covariances_of_functions(self.design[np.concatenate(row_groups)], edges)
        for rows, hat in zip(row_groups, hats, strict=True):
            yield hat + self.removed_columns[rows] @ self.removed_columns[rows].T

    def _spectrum_from_covariance(self, row_indices: Ints) -> tuple[Floats, Floats]:
        """Non-zero eigenvalues (k,) and eigenvectors (f, k) of the submatrix of the hat matrix on f rows `row_indices`.

        They are computed from the covariance of the unknowns in these rows, a smaller matrix if there are many rows.
        """
        part = self.design[row_indices]
        touched = np.unique(part.indices)
        group_edges = np.array([0, len(touched)])
        ends = np.arange(len(touched) + 1)
        units = sp.csr_array((1.0 / self._inverse_column_norms[touched], touched, ends), (len(touched), part.shape[1]))
        covariance = next(self.factor.covariances_of_functions(units, group_edges))
        values, vectors = np.linalg.eigh(covariance)
        root = (
            part[:, touched].toarray()
            * self._inverse_column_norms[touched]
            @ (vectors * np.sqrt(np.maximum(values, 0.0)))
        )
        root = np.hstack([root, self.removed_columns[row_indices]])
        return _spectrum_from_root(root) if len(row_indices) > root.shape[1] else np.linalg.eigh(root @ root.T)

    def with_removed_columns(self, columns: Floats) -> FactorResidualProjector:
        """Projector that also removes components along e orthonormal vectors `columns` (m, e) of the residual space.

        The residual space is the orthogonal complement of the columns of the design matrix.
        """
        return replace(self, removed_columns=np.hstack([self.removed_columns, columns]), _stored_blocks={})


ResidualProjector: TypeAlias = BasisResidualProjector | FactorResidualProjector
"""Projector onto the residual space (complement of the column space), with an orthonormal basis or with factorised
normal equations."""


def make_residual_projector(block_system: BlockSystem, normal_equations: FactorisedNormals | None) -> ResidualProjector:
    """Projector onto the residual space (complement of the column space) of a linear system.

    It uses an orthonormal basis if the system is small or `normal_equations` is None; otherwise the factorised normal
    equations `normal_equations`.
    """
    rows, columns = block_system.design.shape
    if normal_equations is None or rows * columns <= MAX_DESIGN_ENTRIES_FOR_BASIS:
        return BasisResidualProjector.from_design(block_system.design)
    return FactorResidualProjector.from_design(block_system.design, normal_equations)


def _group_gram_matrices(columns: Floats, group_boundaries: Ints) -> list[Floats]:
    """Gram matrices (k, k) of groups of k columns; group i has the columns from boundary i to before boundary i + 1."""
    column_groups = (columns[:, low:high] for low, high in pairwise(group_boundaries.tolist()))
    return [part.T @ part for part in column_groups]


def _spectrum_from_root(matrix_root: Floats) -> tuple[Floats, Floats]:
    """Non-zero eigenvalues (e,) and eigenvectors (f, e) of R R', for a matrix R (f, k) with fewer columns than rows."""
    values, vectors = np.linalg.eigh(matrix_root.T @ matrix_root)
    nonzero = values > MAX_EIGENVALUE_COUNTED_AS_ZERO
    return values[nonzero], matrix_root @ (vectors[:, nonzero] / np.sqrt(values[nonzero]))
