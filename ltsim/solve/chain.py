"""Cholesky factor of a block tridiagonal matrix with a dense border, and submatrices of its inverse.

Stations along a tunnel or around a ring are coupled to their neighbours only. Ordered by reverse Cuthill-McKee, their
normal matrix is block tridiagonal (a chain of blocks). A dense border contains the unknowns that all stations share,
such as instrument parameters. The cost of the factor, and of submatrices of the inverse on neighbouring blocks, is
proportional to the length of the chain and not to its cube. A matrix without such an order is treated as one block, by
dense algebra.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.csgraph import reverse_cuthill_mckee

from ltsim.core.arrays import Floats, Ints

MAX_SINGLE_BLOCK_COLUMNS = 240
"""Largest number of columns of a matrix that is treated as one block, because an ordering would cost more than it
saves."""
MIN_BORDER_TO_MEDIAN_COLUMN_ENTRIES = 2.0
"""Limit of the number of non-zero entries of a column, divided by the median over all columns. Above it, the column
belongs to the border of a chain of blocks (columns coupled with many blocks). Columns of stations differ little: in a
ring of 210 set-ups by four trackers they have 0.8 to 1.2 times the median, and the instrument parameters, each of which
acts on the set-ups of one tracker, 4.7 times."""
MIN_BLOCK_COLUMNS = 48
"""Smallest number of columns of a block of a chain, in which each block is coupled with its neighbours only. With
smaller blocks function calls cost more than arithmetic."""

INVERSE_COLUMNS_PER_BATCH = 512
"""Number of columns of a complete inverse that are computed at a time, to limit the memory for temporary matrices."""


def chain_order_and_block_limits(matrix: sp.csr_array) -> tuple[Ints, Ints]:
    """Order (K,) in which K columns of a symmetric matrix form a chain of b blocks and a border, and limits (b + 2,).

    Each block of the chain is coupled only with its neighbours and with the border. In this order block i has the
    positions from limit i to before limit i + 1. The border is last.
    """
    n_unknowns = matrix.shape[0]
    single_block = np.arange(n_unknowns), np.array([0, n_unknowns, n_unknowns])
    if n_unknowns <= MAX_SINGLE_BLOCK_COLUMNS:
        return single_block
    n_entries = np.diff(matrix.indptr)
    shared = n_entries > MIN_BORDER_TO_MEDIAN_COLUMN_ENTRIES * np.median(n_entries)
    inner_indices = np.flatnonzero(~shared)
    if len(inner_indices) <= MAX_SINGLE_BLOCK_COLUMNS:
        return single_block
    part = sp.csr_array(matrix[inner_indices][:, inner_indices])
    order = reverse_cuthill_mckee(part, symmetric_mode=True)
    place = np.argsort(order)
    row_indices = np.repeat(place, np.diff(part.indptr))
    width = max(int(np.max(np.abs(row_indices - place[part.indices]), initial=0)), MIN_BLOCK_COLUMNS)
    if 3 * (width + n_unknowns - len(inner_indices)) >= n_unknowns:
        return single_block
    edges = np.append(np.arange(0, len(inner_indices) - width + 1, width), [len(inner_indices), n_unknowns])
    return np.concatenate([inner_indices[order], np.flatnonzero(shared)]), edges


@dataclass(frozen=True)
class InverseSubmatrix:
    """Submatrix of the inverse of a block tridiagonal matrix, on two neighbouring blocks and the border (w columns)."""

    positions_of_columns: Ints
    """Position in the submatrix of each of the K columns of the whole matrix, (K,); -1 for columns outside the
    submatrix."""
    inverse: Floats
    """Submatrix (w, w) of the inverse matrix, for w of its columns."""


class BlockChainFactor:
    """Cholesky factor of a positive definite sparse matrix, ordered as a chain of blocks and a dense border.

    Each block is coupled only with its neighbours and with the border. Raises LinAlgError if the matrix is not positive
    definite.

    Parameters
    ----------
    matrix : (K, K) sparse
        Symmetric matrix of K columns.

    Attributes
    ----------
    block_of_column : (K,) int
        Index of the block of each column, from 0; for columns of the border the number of blocks.
    """

    def __init__(self, matrix: sp.csr_array) -> None:
        self._column_order, self._block_limits = chain_order_and_block_limits(matrix)
        self.block_of_column = np.searchsorted(self._block_limits[1:-1], np.argsort(self._column_order), side="right")
        ordered, inner = sp.csc_array(matrix[self._column_order][:, self._column_order]), self._block_limits[-2]
        border_matrix = ordered[inner:, inner:].toarray()
        self._diagonal_factors: list[Floats] = []
        self._off_diagonal_factors: list[Floats] = []
        next_block_update = np.zeros_like(border_matrix)
        for i in range(len(self._block_limits) - 2):
            low, high, far = self._limits_of_block_and_next(i)
            block_size, columns = high - low, ordered[:, low:high]
            panel = np.concatenate([columns[low:far].toarray(), columns[inner:].toarray()])
            if i:
                panel[:block_size] -= next_block_update[:block_size, :block_size]
                panel[far - low :] -= next_block_update[block_size:, :block_size]
            block_factor = scipy.linalg.cholesky(panel[:block_size], lower=True, check_finite=False)
            coupling_factor = scipy.linalg.solve_triangular(
                block_factor, panel[block_size:].T, lower=True, check_finite=False
            ).T
            next_block_update = coupling_factor @ coupling_factor.T
            border_matrix -= next_block_update[far - high :, far - high :]
            self._diagonal_factors.append(block_factor)
            self._off_diagonal_factors.append(coupling_factor)
        self._border_factor = (
            scipy.linalg.cholesky(border_matrix, lower=True, check_finite=False)
            if len(border_matrix)
            else border_matrix
        )

    @property
    def n_blocks(self) -> int:
        """Number of blocks of the chain (each coupled with its neighbours only), without the border."""
        return len(self._diagonal_factors)

    @property
    def smallest_pivot(self) -> float:
        """Smallest pivot of the Cholesky factorisation: smallest squared diagonal entry of the factor."""
        return float(
            min(np.diag(root).min(initial=1.0) ** 2 for root in (*self._diagonal_factors, self._border_factor))
        )

    def solve(self, right_hand_sides: Floats) -> Floats:
        """Solutions (K, c) of linear systems with the factorised matrix of K columns, for c right-hand sides (K, c)."""
        x = right_hand_sides[self._column_order]
        border = self._block_limits[-2]
        for i, (root, after) in enumerate(zip(self._diagonal_factors, self._off_diagonal_factors, strict=True)):
            low, high, far = self._limits_of_block_and_next(i)
            x[low:high] = scipy.linalg.solve_triangular(root, x[low:high], lower=True, check_finite=False)
            carried = after @ x[low:high]
            x[high:far] -= carried[: far - high]
            x[border:] -= carried[far - high :]
        if border < len(x):
            x[border:] = scipy.linalg.cho_solve((self._border_factor, True), x[border:], check_finite=False)
        for i in reversed(range(len(self._diagonal_factors))):
            low, high, far = self._limits_of_block_and_next(i)
            later = np.concatenate([x[high:far], x[border:]])
            mine = x[low:high] - self._off_diagonal_factors[i].T @ later
            x[low:high] = scipy.linalg.solve_triangular(
                self._diagonal_factors[i], mine, lower=True, trans=1, check_finite=False
            )
        solved = np.zeros_like(x)
        solved[self._column_order] = x
        return solved

    def inverse(self) -> Floats:
        """Complete inverse (K, K) of the factorised matrix of K columns."""
        if self.n_blocks == 1:
            return self.inverse_submatrices_by_block[0].inverse
        n_unknowns = len(self._column_order)
        column_slices = [
            slice(i, i + INVERSE_COLUMNS_PER_BATCH) for i in range(0, n_unknowns, INVERSE_COLUMNS_PER_BATCH)
        ]
        inverse = np.empty((n_unknowns, n_unknowns))
        for part in column_slices:
            inverse[:, part] = self.solve(np.eye(n_unknowns, len(range(n_unknowns)[part]), -part.start))
        for part in column_slices:
            symmetric = 0.5 * (inverse[part] + inverse[:, part].T)
            inverse[part], inverse[:, part] = symmetric, symmetric.T
        return inverse

    @cached_property
    def inverse_submatrices_by_block(self) -> list[InverseSubmatrix]:
        """Submatrices of the inverse, one per block of the chain: on the block, the next block and the border.

        References
        ----------
        Takahashi, Fagan, Chin, Formation of a sparse bus impedance matrix (PICA 1973), here with blocks for entries.
        """
        border, size = self._block_limits[-2], len(self._column_order)
        later_inverse = inverse_from_cholesky(self._border_factor)
        windows = []
        for i in reversed(range(len(self._diagonal_factors))):
            low, high, far = self._limits_of_block_and_next(i)
            width = high - low
            whole = np.zeros((width + len(later_inverse), width + len(later_inverse)))
            whole[:width, :width] = inverse_from_cholesky(self._diagonal_factors[i])
            if len(later_inverse):
                reach = scipy.linalg.solve_triangular(
                    self._diagonal_factors[i], self._off_diagonal_factors[i].T, lower=True, trans=1, check_finite=False
                ).T
                across = later_inverse @ reach
                whole[width:, width:], whole[width:, :width], whole[:width, width:] = later_inverse, -across, -across.T
                whole[:width, :width] += reach.T @ across
            place = np.full(size, -1)
            place[np.concatenate([self._column_order[low:far], self._column_order[border:]])] = np.arange(len(whole))
            windows.append(InverseSubmatrix(place, whole))
            stay = np.concatenate([np.arange(width), np.arange(width + far - high, len(whole))])
            later_inverse = whole[np.ix_(stay, stay)]
        return windows[::-1]

    def _limits_of_block_and_next(self, block_index: int) -> tuple[int, int, int]:
        """First position of a block, end of the block, and end of the next block, in the column order of the chain."""
        last_block = len(self._block_limits) - 2
        return (
            int(self._block_limits[block_index]),
            int(self._block_limits[block_index + 1]),
            int(self._block_limits[min(block_index + 2, last_block)]),
        )


def inverse_from_cholesky(lower_factor: Floats) -> Floats:
    """Inverse (k, k) of a symmetric matrix (k, k), from its lower Cholesky factor (k, k)."""
    if not len(lower_factor):
        return lower_factor
    lower, _ = scipy.linalg.lapack.dpotri(lower_factor, lower=1)
    return np.tril(lower) + np.tril(lower, -1).T
