"""Linear least-squares step in which most unknowns are eliminated block by block.

Unknowns are either *eliminated* (E blocks of three columns, such as the coordinates of a target) or *retained* (the K
other columns). No row of the design matrix has entries in two eliminated blocks. The part of the normal equations for
the eliminated unknowns is therefore block diagonal and inverted block by block. A system of size K remains, the Schur
complement. The cost is linear in the number of blocks.

Columns are scaled to unit norm before any factorisation, so that decisions on rank do not depend on units.

`DenseElimination` is for small systems and `SparseElimination` for large ones. They compute the solution, the leverage,
and submatrices of the inverse normal matrix. Their results are in units of the scaled columns.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import NetworkError
from ltsim.core.parallel import single_threaded
from ltsim.solve.chain import BlockChainFactor, inverse_from_cholesky
from ltsim.solve.design import (
    DESIGN_RANK_TOLERANCE,
    MIN_RELIABLE_PIVOT,
    DesignMatrix,
    gram_matrix,
    inverse_column_norms,
    iterate_row_batches,
    scale_columns,
    scale_to_unit_diagonal,
)
from ltsim.solve.row_groups import dense_row_groups


class DenseElimination:
    """Factorised normal equations of a small system, with dense matrices.

    The design matrix (m, K + 3 E) has K retained columns, then E eliminated blocks of three columns. `damping` is added
    to the diagonal of the normal matrix. Raises LinAlgError if the damped normal matrix is not positive definite.
    """

    def __init__(self, design: Floats, n_retained: int, damping: float) -> None:
        self._design, self._n_retained = design, n_retained
        normal = design.T @ design
        normal, self.column_scales = scale_to_unit_diagonal(normal, np.diag(normal))
        normal.flat[:: len(normal) + 1] += damping
        self._cholesky_factor, failed = scipy.linalg.lapack.dpotrf(normal.T, lower=1)
        if failed:
            raise np.linalg.LinAlgError

    @property
    def smallest_pivot(self) -> float:
        """Smallest pivot of the Cholesky factorisation of the normal matrix, scaled to unit diagonal."""
        return float(np.diag(self._cholesky_factor).min(initial=1.0) ** 2)

    def solve(self, right_hand_sides: Floats) -> Floats:
        """Solutions of the normal equations of K + 3 E unknowns (K retained) for c right-hand sides (K + 3 E, c)."""
        return scipy.linalg.lapack.dpotrs(self._cholesky_factor, right_hand_sides, lower=1)[0]

    @cached_property
    def _inverse_normal_matrix(self) -> Floats:
        """Inverse (K + 3 E, K + 3 E) of the normal matrix, in units of the scaled columns."""
        return inverse_from_cholesky(self._cholesky_factor)

    @property
    def retained_inverse(self) -> Floats:
        """Part (K, K) of the inverse normal matrix for the K retained unknowns."""
        return self._inverse_normal_matrix[: self._n_retained, : self._n_retained]

    def inverse_submatrices(self, columns: Ints) -> Floats:
        """Parts (c, k, k) of the inverse normal matrix for c sets of k retained unknowns, indices `columns` (c, k)."""
        return self._inverse_normal_matrix[columns[:, :, None], columns[:, None, :]]

    @cached_property
    def inverse_blocks_and_leverage(self) -> tuple[Floats, Floats]:
        """Parts (E, 3, 3) of the inverse normal matrix for E eliminated blocks of three unknowns; leverages (m,)."""
        block_indices = np.arange(self._n_retained, len(self._cholesky_factor)).reshape(-1, 3)
        scaled_rows = (self._design * self.column_scales).T
        whitened = scipy.linalg.solve_triangular(self._cholesky_factor, scaled_rows, lower=True, check_finite=False)
        return self.inverse_submatrices(block_indices), np.einsum("um,um->m", whitened, whitened)

    def covariances_of_functions(self, function_rows: sp.csr_array, group_boundaries: Ints) -> Iterator[Floats]:
        """Covariances R N^-1 R' of linear functions of the unknowns, for each group R of consecutive functions.

        Each row of `function_rows` (q, K + 3 E) has the coefficients of a function, N is the normal matrix. Group i has
        the rows from entry i of `group_boundaries` to before entry i + 1.
        """
        for low, high in pairwise(group_boundaries.tolist()):
            group = function_rows[low:high].toarray() * self.column_scales
            yield group @ self.solve(group.T)


class SparseElimination:
    """Factorised normal equations of a large, sparse system; its arguments are those of `DenseElimination`.

    The columns are K retained ones, then E blocks of three. The Schur complement is a chain of blocks if possible.
    """

    def __init__(self, design: sp.csr_array, n_retained: int, damping: float) -> None:
        self.column_scales = inverse_column_norms(design)
        self._design, self._n_retained = design, n_retained
        normal = gram_matrix(iterate_row_batches(design, self.column_scales), design.shape[1])
        n_blocks = (normal.shape[0] - n_retained) // 3
        blocks = _diagonal_blocks(normal[n_retained:, n_retained:], n_blocks) + damping * np.eye(3)
        self._block_inverses, self._smallest_block_pivot = block_inverses_and_smallest_pivot(blocks)
        across = normal[:n_retained, n_retained:]
        self._elimination_coefficients = sp.csc_array(across @ _block_diagonal(self._block_inverses))
        schur = normal[:n_retained, :n_retained] - self._elimination_coefficients @ across.T
        if damping:
            schur = schur + damping * sp.eye_array(n_retained)
        self._schur_factor = BlockChainFactor(sp.csr_array(schur))

    @property
    def smallest_pivot(self) -> float:
        """Smallest pivot of the Cholesky factorisations of eliminated blocks (unknowns) and of the Schur complement."""
        return min(self._smallest_block_pivot, self._schur_factor.smallest_pivot)

    def solve(self, right_hand_sides: Floats) -> Floats:
        """Solutions of the normal equations of K + 3 E unknowns (K retained) for c right-hand sides (K + 3 E, c)."""
        front, back = right_hand_sides[: self._n_retained], right_hand_sides[self._n_retained :]
        reduced = self._schur_factor.solve(front - self._elimination_coefficients @ back)
        blocks = back.reshape(len(back) // 3, 3, right_hand_sides.shape[1])  # of no columns too
        return np.concatenate(
            [reduced, (self._block_inverses @ blocks).reshape(back.shape) - self._elimination_coefficients.T @ reduced]
        )

    @cached_property
    def retained_inverse(self) -> Floats:
        """Part (K, K) of the inverse normal matrix for the K retained unknowns."""
        return self._schur_factor.inverse()

    def inverse_submatrices(self, columns: Ints) -> Floats:
        """Parts (c, k, k) of the inverse normal matrix for c sets of k retained unknowns, indices `columns` (c, k)."""
        inverses = np.full((*columns.shape, columns.shape[1]), np.nan)
        lowest = self._first_chain_block(columns, axis=1)
        for i in np.unique(lowest):
            mine, window = np.flatnonzero(lowest == i), self._schur_factor.inverse_submatrices_by_block[i]
            places = window.positions_of_columns[columns[mine]]
            inverses[mine] = window.inverse[places[:, :, None], places[:, None, :]]
            inverses[mine[np.any(places < 0, axis=1)]] = np.nan
        if np.isnan(inverses).any():
            return self.retained_inverse[columns[:, :, None], columns[:, None, :]]
        return inverses

    def _first_chain_block(self, columns: Ints, axis: int) -> Ints:
        """First block of the Schur complement's chain with a column of each set; sets of `columns` are along `axis`."""
        return np.asarray(
            self._schur_factor.block_of_column[columns].min(axis=axis, initial=self._schur_factor.n_blocks - 1)
        )

    @cached_property
    def inverse_blocks_and_leverage(self) -> tuple[Floats, Floats]:
        """Parts (E, 3, 3) of the inverse normal matrix for E eliminated blocks of three unknowns, and leverages (m,).

        Rows with entries in the same eliminated block are processed together, because all columns that this block
        couples are in one `InverseSubmatrix`. Rows without entries in eliminated blocks are processed singly.
        """
        blocks, leverage = self._block_inverses.copy(), np.zeros(self._design.shape[0])
        order, edges, back = _rows_sorted_by_block(self._design, self._n_retained, len(blocks))
        scale, carries = (
            self.column_scales[self._n_retained :].reshape(-1, 3),
            sp.csr_array(self._elimination_coefficients.T),
        )
        front = scale_columns(sp.csr_array(self._design[order][:, : self._n_retained]), self.column_scales)
        block_edges = 3 * np.minimum(np.arange(len(edges)), len(blocks))
        groups = dense_row_groups([front, carries], [edges, block_edges])
        for g, (columns, (reduced, carry)) in enumerate(groups):
            mine = order[edges[g] : edges[g + 1]]
            if g < len(blocks):
                behind = back[mine] * scale[g]
                leverage[mine] = np.sum((behind @ self._block_inverses[g]) * behind, axis=1)
                reduced = reduced - behind @ carry
            window = self._schur_factor.inverse_submatrices_by_block[int(self._first_chain_block(columns, axis=0))]
            at = window.positions_of_columns[columns]
            inverse = window.inverse[at[:, None], at]
            leverage[mine] += np.sum((reduced @ inverse) * reduced, axis=1)
            if g < len(blocks):
                blocks[g] += carry @ inverse @ carry.T
        return blocks, leverage

    def covariances_of_functions(self, function_rows: sp.csr_array, group_boundaries: Ints) -> Iterator[Floats]:
        """Covariances R N^-1 R' of groups R of functions, limited by `group_boundaries`; N is the normal matrix."""
        function_rows = scale_columns(function_rows, self.column_scales)
        back = sp.csr_array(function_rows[:, self._n_retained :])
        reduced = sp.csr_array(function_rows[:, : self._n_retained] - back @ self._elimination_coefficients.T)
        reduced_rows = sp.csr_array(back @ _block_diagonal(self._block_inverses))
        if not len(group_boundaries) > 1:
            return
        inverse = self.retained_inverse
        for low, high in pairwise(group_boundaries.tolist()):
            front, columns = dense_rows(reduced, low, high)
            form = front @ inverse[columns[:, None], columns] @ front.T
            carry, columns = dense_rows(reduced_rows, low, high)
            form += carry @ dense_rows(back, low, high, columns)[0].T
            yield form


def _rows_sorted_by_block(design: sp.csr_array, n_retained: int, n_blocks: int) -> tuple[Ints, Ints, Floats]:
    """Row indices (m,) sorted by eliminated block, limits of the groups of rows with one block, and entries (m, 3).

    The entries are those of each of the m rows in the three columns of its block. Rows without entries in an eliminated
    block are last in the order, each as one group.
    """
    rows, behind = np.repeat(np.arange(design.shape[0]), np.diff(design.indptr)), design.indices >= n_retained
    block, back = np.full(design.shape[0], -1), np.zeros((design.shape[0], 3))
    block[rows[behind]] = (design.indices[behind] - n_retained) // 3
    alone = np.flatnonzero(block < 0)
    block[alone] = n_blocks + np.arange(len(alone))
    np.add.at(back, (rows[behind], (design.indices[behind] - n_retained) % 3), design.data[behind])
    order = np.argsort(block, kind="stable")
    return order, np.searchsorted(block[order], np.arange(n_blocks + len(alone) + 1)), back


def dense_rows(matrix: sp.csr_array, first_row: int, end_row: int, columns: Ints | None = None) -> tuple[Floats, Ints]:
    """Dense array (r, k) of r rows of a sparse matrix, `first_row` to before `end_row`, and column indices (k,).

    By default the array has those columns that contain entries in these rows. If sorted column indices `columns` (k,)
    are given, it has these columns, and entries in other columns are ignored.
    """
    begin, end = matrix.indptr[first_row], matrix.indptr[end_row]
    indices = matrix.indices[begin:end]
    row, data = (
        np.repeat(np.arange(end_row - first_row), np.diff(matrix.indptr[first_row : end_row + 1])),
        matrix.data[begin:end],
    )
    if columns is None:
        columns = np.unique(indices)
    at, width = np.searchsorted(columns, indices), len(columns) + 1  # the last column collects ignored entries
    at[np.append(columns, -1)[at] != indices] = width - 1
    dense: Floats = np.asarray(np.bincount(row * width + at, data, (end_row - first_row) * width), dtype=np.float64)
    return dense.reshape(end_row - first_row, width)[:, :-1], columns


def block_inverses_and_smallest_pivot(blocks: Floats) -> tuple[Floats, float]:
    """Inverses (E, 3, 3) of E symmetric blocks (E, 3, 3), and the smallest pivot of their Cholesky factorisations.

    Raises LinAlgError if a block is not positive definite.
    """
    if not len(blocks):
        return blocks, 1.0
    root = np.linalg.cholesky(blocks)
    inverse_root = np.linalg.inv(root)
    inverse: Floats = np.swapaxes(inverse_root, 1, 2) @ inverse_root
    return inverse, float(np.einsum("eii->ei", root).min() ** 2)


def _diagonal_blocks(matrix: sp.csr_array, n_blocks: int) -> Floats:
    """Dense diagonal blocks (E, 3, 3) of a sparse matrix (3 E, 3 E) with E blocks on its diagonal."""
    nonzero_entries = matrix.tocoo()
    blocks = np.zeros((n_blocks, 3, 3))
    np.add.at(
        blocks, (nonzero_entries.row // 3, nonzero_entries.row % 3, nonzero_entries.col % 3), nonzero_entries.data
    )
    return blocks


def _block_diagonal(blocks: Floats) -> sp.csr_array:
    """Sparse matrix (3 E, 3 E) with E blocks (E, 3, 3) on its diagonal."""
    n_blocks = len(blocks)
    if not n_blocks:
        return sp.csr_array((0, 0))
    block_indices = np.arange(n_blocks)
    return sp.csr_array(
        sp.bsr_array((blocks, block_indices, np.arange(n_blocks + 1)), shape=(3 * n_blocks, 3 * n_blocks))
    )


UNDETERMINED_MESSAGE = (
    "the observations do not determine all unknowns; let stations share more targets, and check the declared noise"
)
"""Error message for a least-squares system with undetermined unknowns."""


@dataclass(frozen=True)
class BlockSystem:
    """Whitened linear least-squares problem of m observations: minimise |design @ step - whitened_residuals|^2."""

    design: DesignMatrix
    """Whitened design matrix (m, K + 3 E): K columns of retained unknowns, then E blocks of three columns of eliminated
    unknowns."""
    whitened_residuals: Floats
    """Observed minus predicted values of m observations, divided by their standard deviations, (m,)."""
    n_retained: int
    """Number K of unknowns that are not eliminated, the size of the Schur complement."""

    @property
    def sum_of_squares(self) -> float:
        """Sum of squared whitened residuals."""
        return float(self.whitened_residuals @ self.whitened_residuals)


class SingularSystemError(NetworkError):
    """Error for a least-squares system that leaves a combination of unknowns undetermined (`DESIGN_RANK_TOLERANCE`)."""


class FactorisedNormals:
    """Factorised normal equations of a `BlockSystem`, with Levenberg-Marquardt damping.

    Raises SingularSystemError if observations and damping leave a combination of unknowns undetermined.

    Parameters
    ----------
    block_system : BlockSystem
    damping : float
        Levenberg-Marquardt damping, added to the unit diagonal of the scaled normal matrix.
    """

    @single_threaded
    def __init__(self, block_system: BlockSystem, damping: float = 0.0) -> None:
        self._system, self._damping, design = block_system, damping, block_system.design
        self._elimination: DenseElimination | SparseElimination
        try:
            if isinstance(design, np.ndarray):
                self._elimination = DenseElimination(design, block_system.n_retained, damping)
            else:
                self._elimination = SparseElimination(design, block_system.n_retained, damping)
        except np.linalg.LinAlgError as error:
            raise SingularSystemError(UNDETERMINED_MESSAGE) from error
        self._column_scales = self._elimination.column_scales
        if (
            self._elimination.smallest_pivot < MIN_RELIABLE_PIVOT
            and damping + self._weakest_direction_squared_length() <= DESIGN_RANK_TOLERANCE
        ):
            raise SingularSystemError(UNDETERMINED_MESSAGE)

    def __reduce__(self) -> tuple[type[FactorisedNormals], tuple[BlockSystem, float]]:
        """Constructor and its arguments for pickling: the linear system, which is smaller than its factor."""
        return FactorisedNormals, (self._system, self._damping)

    def _weakest_direction_squared_length(self) -> float:
        """Smallest squared norm of A v over all unit vectors v, for the design matrix A with columns of unit norm.

        The minimising v is computed by inverse iteration. The squared norm is accurate even if it is near zero.
        """
        vector = np.cos(np.arange(len(self._column_scales), dtype=np.float64))[:, None]
        for _ in range(3):
            vector = self._elimination.solve(vector / np.linalg.norm(vector))
        image = self._system.design @ (self._column_scales * vector[:, 0] / np.linalg.norm(vector))
        return float(image @ image)

    def step(self, residual: Floats | None = None) -> Floats:
        """Damped change (K + 3 E,) of the unknowns that fits whitened residuals (m,); None for those of the system."""
        right_side = self._system.design.T @ (self._system.whitened_residuals if residual is None else residual)
        return self.multiply_by_covariance(right_side[:, None])[:, 0]

    @single_threaded
    def retained_covariance(self) -> Floats:
        """Covariance matrix (K, K) of the K retained unknowns."""
        scale = self._column_scales[: self._system.n_retained]
        covariance: Floats = np.outer(scale, scale)
        covariance *= self._elimination.retained_inverse
        return covariance

    @single_threaded
    def covariance_submatrices(self, columns: Ints) -> Floats:
        """Covariances (c, k, k) of c sets of k retained unknowns; `columns` (c, k) are indices in the design matrix.

        The computation is fast if the unknowns of each set occur together in an observation equation.
        """
        scale = self._column_scales[columns]
        return self._elimination.inverse_submatrices(columns) * scale[:, :, None] * scale[:, None, :]

    @single_threaded
    def eliminated_covariances(self) -> Floats:
        """Covariance matrices (E, 3, 3) of the three unknowns of each of E eliminated blocks."""
        scale = self._column_scales[self._system.n_retained :].reshape(-1, 3)
        return self._elimination.inverse_blocks_and_leverage[0] * scale[:, :, None] * scale[:, None, :]

    @single_threaded
    def multiply_by_covariance(self, vectors: Floats) -> Floats:
        """Product (K + 3 E, c) of the covariance matrix of all K + 3 E unknowns and c `vectors` (K + 3 E, c)."""
        return self._column_scales[:, None] * self._elimination.solve(self._column_scales[:, None] * vectors)

    @property
    def smallest_pivot(self) -> float:
        """Smallest pivot of the Cholesky factorisation of the normal matrix, scaled to unit diagonal."""
        return self._elimination.smallest_pivot

    def covariances_of_functions(self, function_rows: sp.csr_array, group_boundaries: Ints) -> Iterator[Floats]:
        """Covariance matrices R N^-1 R' of linear functions of the unknowns, for each group R of consecutive functions.

        `function_rows` (q, K + 3 E) are the coefficients of q functions of K retained and 3 E eliminated unknowns, N is
        the normal matrix. Group i has the rows from entry i of `group_boundaries` to before entry i + 1.
        """
        return self._elimination.covariances_of_functions(function_rows, group_boundaries)

    @single_threaded
    def leverage(self) -> Floats:
        """Leverages (m,) of m observations: derivative of each fitted value with respect to its observation.

        The redundancy number of an observation is one minus its leverage.
        """
        return self._elimination.inverse_blocks_and_leverage[1]
