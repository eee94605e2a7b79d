"""Designs of least squares: dense where they are small, sparse otherwise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import scipy.sparse as sp

from ltsim.arrays import Floats, Ints

DENSE = 600_000
"""Designs with fewer entries are dense: sparse bookkeeping would cost more than the zeros."""

Design: TypeAlias = Floats | sp.csr_array


class Pattern:
    """Where the entries of a design are, whatever their values.

    Parameters
    ----------
    columns : sequence of (r, w) int
        For each kind of row, in the order of the design, the column of each of its w entries; entries of the same
        column are added.
    size : int
        Number of columns of the design.
    """

    def __init__(self, columns: Sequence[Ints], size: int) -> None:
        widths = np.repeat([kind.shape[1] for kind in columns], [len(kind) for kind in columns])
        indices = np.concatenate([kind.ravel() for kind in columns])
        self._shape = len(widths), size
        self._is_dense = len(widths) * size <= DENSE
        if self._is_dense:
            self._places = np.repeat(size * np.arange(len(widths)), widths) + indices
        else:
            pointers = np.concatenate([[0], np.cumsum(widths)])
            kind = np.int32 if pointers[-1] < 2**31 else np.int64
            self._indices, self._pointers = indices.astype(kind), pointers.astype(kind)

    def filled(self, values: Sequence[Floats]) -> Design:
        """The design (m, size) with these values, shaped like the columns."""
        entries = np.concatenate([kind.ravel() for kind in values])
        if self._is_dense:
            return np.bincount(self._places, entries, self._shape[0] * self._shape[1]).reshape(self._shape)
        design = sp.csr_array((entries, self._indices, self._pointers), shape=self._shape, copy=True)
        design.eliminate_zeros()  # what acts on one station or target is zero in most rows
        return design


def as_dense(design: Design) -> Floats:
    """A design, or rows of one, as a dense array."""
    return design if isinstance(design, np.ndarray) else design.toarray()


def column_scale(design: Design) -> Floats:
    """One over the norm of each column; 1 for an empty column."""
    if isinstance(design, np.ndarray):
        squares = np.einsum("mu,mu->u", design, design)
    else:
        squares = np.bincount(design.indices, design.data**2, design.shape[1])
    return 1.0 / np.sqrt(np.where(squares > 0, squares, 1.0))


def scaled(rows: sp.csr_array, scale: Floats) -> sp.csr_array:
    """Rows with every column times its scale."""
    return sp.csr_array((rows.data * scale[rows.indices], rows.indices, rows.indptr), rows.shape)
