"""Dense submatrices of groups of rows of sparse matrices, each on the columns in which the group has entries.

Groups are processed in batches, because a group alone has too few entries for efficient array operations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
import scipy.sparse as sp

from ltsim.core.arrays import Floats, Ints, batches


def dense_row_groups(
    matrices: Sequence[sp.csr_array], group_boundaries: Sequence[Ints]
) -> Iterator[tuple[Ints, list[Floats]]]:
    """Column indices (k,) of each group of rows, and dense arrays (r, k) of the r rows of the group, one per matrix.

    Group i has the rows from entry i to before entry i + 1 of `group_boundaries`, which are separate (groups + 1,) for
    each of the `matrices` (., u) with u columns. The k columns are those with entries of the group in any matrix.
    """
    n_columns = matrices[0].shape[1]
    for part in batches(len(group_boundaries[0]) - 1, n_columns):
        limits = [boundaries[part.start : part.stop + 1] for boundaries in group_boundaries]
        entries = [_group_entries(matrix, of_rows) for matrix, of_rows in zip(matrices, limits, strict=True)]
        has_entries = np.zeros((part.stop - part.start, n_columns), dtype=bool)
        for group_of_row, row, column, _ in entries:
            has_entries[group_of_row[row], column] = True
        positions = np.cumsum(has_entries, axis=1, dtype=np.int64) - 1
        widths = has_entries.sum(axis=1)
        flat_arrays: list[tuple[Floats, Ints]] = []
        for group_of_row, row, column, values in entries:
            starts = np.append(0, np.cumsum(widths[group_of_row]))
            sums = np.bincount(starts[row] + positions[group_of_row[row], column], values, int(starts[-1]))
            flat_arrays.append((np.asarray(sums, dtype=np.float64), starts))
        columns, edges = np.nonzero(has_entries)[1], np.append(0, np.cumsum(widths)).tolist()
        for g, (begin, end) in enumerate(pairwise(edges)):
            arrays = []
            for (flat, starts), of_rows in zip(flat_arrays, limits, strict=True):
                low, high = int(of_rows[g] - of_rows[0]), int(of_rows[g + 1] - of_rows[0])
                arrays.append(flat[starts[low] : starts[high]].reshape(high - low, end - begin))
            yield columns[begin:end], arrays


def _group_entries(matrix: sp.csr_array, row_limits: Ints) -> tuple[Ints, Ints, Ints, Floats]:
    """Group (r,) of each of r rows of a sparse matrix, and row, column and value (e,) of each of the e entries in them.

    Group i has the rows of `matrix` from entry i to before entry i + 1 of `row_limits`. Rows are counted from the first
    of them.
    """
    first, last = int(row_limits[0]), int(row_limits[-1])
    pointers = matrix.indptr[first : last + 1]
    begin, end = int(pointers[0]), int(pointers[-1])
    row = np.repeat(np.arange(last - first), np.diff(pointers))
    group_of_row = np.repeat(np.arange(len(row_limits) - 1), np.diff(row_limits))
    return group_of_row, row, matrix.indices[begin:end], matrix.data[begin:end]
