"""Type aliases of arrays, and checks of array arguments."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ltsim.core.errors import ModelError

Floats = NDArray[np.float64]
"""Array of double-precision numbers."""
Floats32 = NDArray[np.float32]
"""Array of single-precision numbers."""
Ints = NDArray[np.int64]
"""Array of 64-bit integers."""
Bools = NDArray[np.bool_]
"""Array of booleans."""
MAX_TEMPORARY_ENTRIES = 2_000_000
"""Largest number of entries (8 bytes each) of a temporary array. Larger arrays are computed in batches, so that the
memory does not grow with the recording. Smaller batches would need more function calls and thus more time."""
MAX_MATRIX_ENTRIES = 100_000_000
"""Largest number of entries of a matrix in memory, 0.8 GB. A method that would need a larger matrix raises an error."""


def batches(n_items: int, n_entries_per_item: int) -> Iterator[slice]:
    """Slices that divide `n_items` items into batches of at most `MAX_TEMPORARY_ENTRIES` array entries.

    A batch contains at least one item.
    """
    step = max(1, MAX_TEMPORARY_ENTRIES // max(n_entries_per_item, 1))
    return (slice(first, min(first + step, n_items)) for first in range(0, n_items, step))


def stack_columns(*columns: Floats) -> Floats:
    """Array (rows, columns, ...) that joins arrays of shape (rows, ...) along a new second axis.

    The function is three times as fast as `np.stack` for a hundred rows.
    """
    array = np.empty((len(columns[0]), len(columns), *columns[0].shape[1:]))
    for k, column in enumerate(columns):
        array[:, k] = column
    return array


def stack_and_release(row_arrays: list[Floats32]) -> Floats32:
    """Array (arrays, ...) from a list of arrays of equal shape, which become its rows.

    Each array is removed from the list once it is copied, so that all data are never in memory twice.
    """
    array = np.empty((len(row_arrays), *row_arrays[0].shape), dtype=np.float32)
    while row_arrays:
        last = row_arrays.pop()
        array[len(row_arrays)] = last
    return array


def median(values: Floats) -> float:
    """Median of all entries of the non-empty array `values`; NaN if an entry is NaN.

    The function is ten times as fast as `np.median` for a hundred entries.
    """
    sorted_values = np.sort(values, axis=None)
    middle_index = len(sorted_values) // 2
    return (
        float(0.5 * (sorted_values[-1 - middle_index] + sorted_values[middle_index]))
        if sorted_values[-1] == sorted_values[-1]
        else float("nan")
    )


def group_rows(keys: Ints, rows: Ints) -> Iterator[tuple[int, Ints]]:
    """Pairs of a key and the indices of the rows that have this key, in ascending order of the keys.

    `keys` (rows,) holds the key of each row of a table. Only the rows with the indices `rows` (selected rows,) are
    grouped.
    """
    order = rows[np.argsort(keys[rows], kind="stable")]
    values, first = np.unique(keys[order], return_index=True)
    for key, group in zip(values, np.split(order, first[1:]), strict=False):
        yield int(key), group


def as_finite_floats(values: ArrayLike, shape: tuple[int, ...], argument_name: str) -> Floats:
    """Float array with the entries of `values` and the shape `shape`, in which -1 stands for any length.

    ModelError, which names the argument, is raised if the shape differs or a value is not finite.
    """
    array = np.asarray(values, dtype=np.float64)
    has_shape = array.ndim == len(shape) and all(
        want in (-1, have) for want, have in zip(shape, array.shape, strict=True)
    )
    if not has_shape:
        raise ModelError(f"{argument_name} has shape {array.shape}, expected {shape} (-1: any length)")
    if not np.all(np.isfinite(array)):
        raise ModelError(f"{argument_name} contains a value that is not finite")
    return array
