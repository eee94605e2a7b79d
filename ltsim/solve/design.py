"""Design matrices of least squares (dense if small, otherwise sparse), and tests for undetermined unknowns.

Fixed tolerances decide which unknowns are undetermined. The failure of a Cholesky factorisation is no criterion,
because rounding errors of its pivots grow with the number of unknowns in an undetermined combination. If a pivot is
small, the weakest direction is computed: the unit vector v of unknowns for which the norm of A v is smallest, where A
is the design matrix. The unknowns along v are undetermined if the squared norm is at most `DESIGN_RANK_TOLERANCE`.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import TypeAlias

import numpy as np
import scipy.sparse as sp

from ltsim.core.arrays import Bools, Floats, Ints, median

MAX_DENSE_ENTRIES = 600_000
"""Largest number of entries of a design matrix that is stored as a dense array; a larger matrix is stored as sparse."""

DESIGN_ROWS_PER_BATCH = 30_000
"""Number of rows of a sparse design matrix that are processed at a time, to limit the memory."""
DESIGN_ENTRIES_PER_BATCH = 1_000_000
"""Number of entries of a sparse design matrix that are processed at a time, to limit the memory."""

DesignMatrix: TypeAlias = Floats | sp.csr_array
"""Design matrix: a dense array, or a sparse matrix in row format."""


class SparsityPattern:
    """Sparsity pattern of a design matrix: row and column indices of its entries, independent of their values.

    Parameters
    ----------
    columns : sequence of (r, w) int
        Column indices of the w entries in each of r rows. There is one array for each group of consecutive rows with
        equal w, in the order of the rows. Entries of a row with the same column index are added.
    n_columns : int
        Number of columns of the design.
    """

    def __init__(self, columns: Sequence[Ints], n_columns: int) -> None:
        widths = np.repeat([kind.shape[1] for kind in columns], [len(kind) for kind in columns])
        pointers = np.concatenate([[0], np.cumsum(widths)])
        small = np.int32 if pointers[-1] < 2**31 else np.int64
        indices = np.empty(int(pointers[-1]), dtype=small)
        np.concatenate([kind.ravel() for kind in columns], out=indices, casting="same_kind")
        self._shape, self._n_entries = (len(widths), n_columns), len(indices)
        self._is_dense = len(widths) * n_columns <= MAX_DENSE_ENTRIES
        if self._is_dense:
            self._flat_positions = np.repeat(n_columns * np.arange(len(widths)), widths) + indices.astype(np.int64)
        else:
            self._column_indices, self._row_pointers = indices, pointers.astype(small)

    def make_design_matrix(self, design_entries: Iterable[Floats]) -> DesignMatrix:
        """Design matrix (m, n_columns) with this sparsity pattern, from the values of its entries.

        `design_entries` is one array (r, w) per group of r rows, in the order of the column indices of the group.
        """
        entries, end = np.empty(self._n_entries), 0
        for kind in design_entries:
            begin, end = end, end + kind.size
            entries[begin:end] = kind.ravel()
        if self._is_dense:
            return np.bincount(self._flat_positions, entries, self._shape[0] * self._shape[1]).reshape(self._shape)
        nonzero = entries != 0.0  # parameters of one station or target have zeros in most rows
        before = np.zeros(len(entries) + 1, dtype=self._row_pointers.dtype)
        np.cumsum(nonzero, out=before[1:])
        pointers = before[self._row_pointers]
        return sp.csr_array((entries[nonzero], self._column_indices[nonzero], pointers), shape=self._shape)


def to_dense(design: DesignMatrix) -> Floats:
    """Design matrix, dense or sparse, as a dense array."""
    return design if isinstance(design, np.ndarray) else design.toarray()


def inverse_column_norms(design: DesignMatrix) -> Floats:
    """Reciprocal Euclidean norms (u,) of the u columns of a design matrix (m, u); 1 for a column of zeros."""
    if isinstance(design, np.ndarray):
        squares = np.einsum("mu,mu->u", design, design)
    else:
        squares = np.zeros(design.shape[1])
        for first in range(0, len(design.data), DESIGN_ENTRIES_PER_BATCH):
            piece = slice(first, first + DESIGN_ENTRIES_PER_BATCH)
            squares += np.bincount(design.indices[piece], design.data[piece] ** 2, design.shape[1])
    return 1.0 / np.sqrt(np.where(squares > 0, squares, 1.0))


def scale_columns(matrix_rows: sp.csr_array, column_factors: Floats) -> sp.csr_array:
    """Sparse matrix (m, u) whose columns are those of `matrix_rows` (m, u), multiplied by `column_factors` (u,)."""
    return sp.csr_array(
        (matrix_rows.data * column_factors[matrix_rows.indices], matrix_rows.indices, matrix_rows.indptr),
        matrix_rows.shape,
    )


def iterate_row_batches(design: sp.csr_array, column_factors: Floats) -> Iterator[sp.csr_array]:
    """Batches of rows of a sparse design matrix (m, u) with its columns multiplied by `column_factors` (u,)."""
    for first in range(0, design.shape[0], DESIGN_ROWS_PER_BATCH):
        yield scale_columns(design[first : first + DESIGN_ROWS_PER_BATCH], column_factors)


def gram_matrix(row_batches: Iterable[sp.csr_array], n_columns: int) -> sp.csr_array:
    """Normal matrix A' A (n_columns, n_columns) of a sparse design matrix A, from batches of the rows of A."""
    gram = sp.csr_array((n_columns, n_columns))
    for part in row_batches:
        gram = gram + sp.csr_array(part.T @ part)
    return sp.csr_array(gram)


def weight_rows(design: DesignMatrix, weight: Floats) -> DesignMatrix:
    """Design matrix (m, u) whose rows are those of `design` (m, u), multiplied by `weight` (m,)."""
    if isinstance(design, np.ndarray):
        return np.asarray(design * weight[:, None])
    entry_weights = np.repeat(weight, np.diff(design.indptr))
    entry_weights *= design.data
    return sp.csr_array((entry_weights, design.indices, design.indptr), design.shape)


MIN_RELIABLE_PIVOT = 1e-8
"""Smallest pivot of a normal matrix with unit diagonal that is certainly no rounding error. Below it, the combination
of unknowns that changes the observations least is tested separately (`DESIGN_RANK_TOLERANCE`)."""
DESIGN_RANK_TOLERANCE = 1e-14
"""Limit of the squared norm of A v, where A is the design matrix with columns of unit norm and v a unit vector. Below
it, the combination v of unknowns counts as undetermined. The limit is fifty times the rounding error of a Cholesky
factorisation. For a chain of 2,000 set-ups, whose unknowns are all determined, the smallest squared norm is 1e-13.

The tolerance is fifty times the rounding error of a Cholesky factorisation. For a chain of 2,000 set-ups, whose
unknowns are all determined, the smallest squared norm is 1e-13."""
NORMAL_RANK_TOLERANCE = 1e-12
"""Limit of an eigenvalue of a normal matrix with unit diagonal. Below it, the combination of unknowns along the
eigenvector counts as undetermined. Rounding errors of the eigenvalues are about 1e-15."""

POINT_RANK_TOLERANCE = 1e-10
"""Limit of the ratio of the smallest to the largest eigenvalue of the normal matrix (3, 3) of a point. Below it, the
position of the point counts as undetermined in one direction: the standard deviation there is more than 100,000 times
the smallest one."""


def scale_to_unit_diagonal(symmetric_matrices: Floats, diagonals: Floats) -> tuple[Floats, Floats]:
    """Symmetric matrices (..., k, k) scaled to unit diagonal, and the scale factors (..., k) of rows and columns.

    `diagonals` (..., k) are the diagonals of the matrices. A scale factor is the reciprocal square root of a diagonal
    entry, or 1 for an entry of zero.
    """
    scale = 1.0 / np.sqrt(np.where(diagonals > 0.0, diagonals, 1.0))
    scaled: Floats = symmetric_matrices * scale[..., :, None] * scale[..., None, :]
    return scaled, scale


def cholesky_where_determined(normal_matrices: Floats) -> tuple[Floats, Bools]:
    """Lower Cholesky factors (b, k, k) of b normal matrices with unit diagonal, and flags (b,), True for regular ones.

    Factors of singular matrices are NaN. Matrices with a pivot below `MIN_RELIABLE_PIVOT` count as regular or singular
    by their eigenvalues.
    """
    try:
        roots: Floats = np.asarray(np.linalg.cholesky(normal_matrices), dtype=np.float64)
        doubtful = ~(np.einsum("bii->bi", roots).min(axis=1, initial=1.0) ** 2 > MIN_RELIABLE_PIVOT)
    except np.linalg.LinAlgError:
        roots, doubtful = np.full_like(normal_matrices, np.nan), np.ones(len(normal_matrices), dtype=bool)
    if doubtful.any():
        definite = np.linalg.eigvalsh(normal_matrices[doubtful])[:, 0] > NORMAL_RANK_TOLERANCE
        factors = np.full_like(normal_matrices[doubtful], np.nan)
        factors[definite] = np.linalg.cholesky(normal_matrices[doubtful][definite])
        roots[doubtful] = factors
    determined: Bools = ~np.isnan(roots[:, -1, -1])
    return roots, determined


MEDIAN_OF_ABSOLUTE_NORMAL = 0.6744897501960817
"""Median of |x| for a standard normal variable x."""


def robust_sigma(residuals: Floats) -> float:
    """Robust estimate of the standard deviation of `residuals`, from their median absolute value; 0 if empty."""
    return median(np.abs(residuals)) / MEDIAN_OF_ABSOLUTE_NORMAL if len(residuals) else 0.0
