"""Robust fits of many shifts of readings at once, each to the residuals of those readings that it changes.

A shift adds parameters to the model, such as the displacement of a target or an offset of the distances of a set-up. In
these fits all other unknowns of the network keep their values.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import MAX_TEMPORARY_ENTRIES, Bools, Floats
from ltsim.solve.design import NORMAL_RANK_TOLERANCE

N_REWEIGHTINGS_OF_SHIFT_FIT = 6
"""Number of iterations of reweighted least squares in the local fit of a shift of readings."""
N_TRIMMED_FITS = 2
"""Number of final least-squares fits of a shift, each to the readings that are no outliers of the previous fit."""


@dataclass(frozen=True)
class LocalShiftProblem:
    """Whitened least-squares problem of one shift: design matrix and residuals of the m readings that it changes."""

    unit_columns: Floats
    """Design columns (m, r) of the r parameters that change some of the m readings, scaled to unit length."""
    column_lengths: Floats
    """Lengths (r,) of the r design columns before scaling."""
    whitened_residuals: Floats
    """Whitened residuals (m,) of the m readings in the network without the shift."""
    is_outlier: Bools
    """Flags (m,), True for those of the m readings that are outliers of the network fit without the shift."""
    is_acting_parameter: Bools
    """Flags (q,), True for those r of the q parameters of the shift that change at least one of the m readings."""

    @classmethod
    def from_design(cls, design: Floats, residuals: Floats, is_outlier: Bools) -> LocalShiftProblem:
        """Problem of a shift with q parameters, from arrays over the three readings of n pointings.

        The arrays are the whitened design (n, 3, q), the whitened residuals (n, 3) and the outlier flags (n, 3).
        Readings that the shift does not change are omitted.
        """
        design_matrix = design.reshape(-1, design.shape[2])
        is_changed = design_matrix.any(axis=1)
        column_norms = np.linalg.norm(design_matrix[is_changed], axis=0)
        columns = column_norms > 0.0
        unit = design_matrix[is_changed][:, columns] / column_norms[columns]
        return cls(unit, column_norms[columns], residuals.ravel()[is_changed], is_outlier.ravel()[is_changed], columns)

    @property
    def has_outliers_and_parameters(self) -> bool:
        """True if at least one reading is an outlier, and at least one parameter of the shift changes readings."""
        return bool(self.is_outlier.any() and self.is_acting_parameter.any())


def fit_local_shifts(shifts: Sequence[LocalShiftProblem], outlier_cost: float) -> list[tuple[float, Floats]]:
    """Gain of log likelihood by each shift, and robust estimate (q,) of its q parameters.

    Each reading contributes at most `outlier_cost` to the negative log likelihood, so that outliers have little
    influence.
    """
    fits: dict[int, tuple[float, Floats]] = {}
    for batch in _shift_batches(shifts):
        count, rank = len(shifts[batch[-1]].whitened_residuals), len(shifts[batch[0]].column_lengths)
        unit, residual = np.zeros((len(batch), count, rank)), np.zeros((len(batch), count))
        out, valid = np.zeros((2, len(batch), count), dtype=bool)
        for k, shift in enumerate(shifts[i] for i in batch):
            rows = slice(len(shift.whitened_residuals))
            unit[k, rows], residual[k, rows], out[k, rows], valid[k, rows] = (
                shift.unit_columns,
                shift.whitened_residuals,
                shift.is_outlier,
                True,
            )
        amount = _robust_parameters(unit, residual, out, valid, outlier_cost)
        cost, rest = (
            np.minimum(0.5 * e**2, outlier_cost).sum(axis=1)
            for e in (residual, residual - _reading_changes(unit, amount))
        )
        for i, fall, values in zip(batch, (cost - rest).tolist(), amount, strict=True):
            parameters = np.zeros(len(shifts[i].is_acting_parameter))
            parameters[shifts[i].is_acting_parameter] = values / shifts[i].column_lengths
            fits[i] = fall, parameters
    return [fits[i] for i in range(len(shifts))]


def _shift_batches(shifts: Sequence[LocalShiftProblem]) -> Iterator[list[int]]:
    """Indices of shifts that are fitted together, in groups with equal numbers of parameters.

    Within a group the shifts with fewer readings come first. The design matrices of a group together have at most
    `MAX_TEMPORARY_ENTRIES` entries.
    """
    batch: list[int] = []
    for i in sorted(range(len(shifts)), key=lambda i: shifts[i].unit_columns.shape[::-1]):
        if batch and (
            len(shifts[i].column_lengths) != len(shifts[batch[0]].column_lengths)
            or (len(batch) + 1) * shifts[i].unit_columns.size > MAX_TEMPORARY_ENTRIES
        ):
            yield batch
            batch = []
        batch.append(i)
    if batch:
        yield batch


def _robust_parameters(
    unit_columns: Floats, residual: Floats, is_outlier: Bools, is_used: Bools, outlier_cost: float
) -> Floats:
    """Robust estimates (h, r) of the r parameters of h shifts with m readings each.

    `unit_columns` (h, m, r) are the design matrices, `residual` (h, m) the residuals, `is_outlier` (h, m) flags
    outliers. `is_used` (h, m) is False for padding of shifts with fewer readings. A single parameter starts at the
    median of residual divided by design over the outliers, several parameters at a fit of least absolute deviations.
    Each reading contributes at most `outlier_cost` to the negative log likelihood.
    """
    if unit_columns.shape[2] == 1:
        column = unit_columns[:, :, 0]
        amount = _masked_row_medians(residual / np.where(column != 0.0, column, 1.0), is_outlier)[:, None]
    else:
        amount = _least_squares(unit_columns, residual, is_outlier.astype(np.float64))
        for _ in range(N_REWEIGHTINGS_OF_SHIFT_FIT):
            miss = np.abs(residual - _reading_changes(unit_columns, amount))
            scale = np.maximum(1.5 * _masked_row_medians(miss, is_used), 1.0)
            amount = _least_squares(unit_columns, residual, is_used / np.sqrt(np.maximum(miss / scale[:, None], 1.0)))
    for _ in range(N_TRIMMED_FITS):
        fits = is_used & (0.5 * (residual - _reading_changes(unit_columns, amount)) ** 2 < outlier_cost)
        enough = fits.sum(axis=1) > unit_columns.shape[2]
        amount = np.where(enough[:, None], _least_squares(unit_columns, residual, fits.astype(np.float64)), amount)
    return amount


def _reading_changes(unit_columns: Floats, parameters: Floats) -> Floats:
    """Whitened changes (h, m) of m readings by h shifts, from `parameters` (h, r), `unit_columns` (h, m, r)."""
    return np.asarray((unit_columns @ parameters[:, :, None])[:, :, 0])


def _masked_row_medians(row_values: Floats, mask: Bools) -> Floats:
    """Medians (h,) of the rows of `row_values` (h, m), over the values that `mask` (h, m) selects."""
    ordered, count = np.sort(np.where(mask, row_values, np.inf), axis=1), mask.sum(axis=1)
    row_indices = np.arange(len(row_values))
    return np.asarray(0.5 * (ordered[row_indices, (count - 1) // 2] + ordered[row_indices, count // 2]))


def _least_squares(unit_columns: Floats, residual: Floats, weight: Floats) -> Floats:
    """Least-squares estimates (h, r) of the r parameters of h shifts with m readings each.

    `unit_columns` (h, m, r) are the design matrices, `residual` (h, m) the residuals; `weight` (h, m) multiplies both.
    The solution has minimum norm if columns are linearly dependent.
    """
    weighted_columns = unit_columns * weight[:, :, None]
    normal = np.swapaxes(weighted_columns, 1, 2) @ weighted_columns
    right_side = np.swapaxes(weighted_columns, 1, 2) @ (residual * weight)[:, :, None]
    value, vector = np.linalg.eigh(normal)
    is_used = value > NORMAL_RANK_TOLERANCE * value[:, -1:]
    along = (np.swapaxes(vector, 1, 2) @ right_side)[:, :, 0]
    return np.asarray((vector @ (np.where(is_used, along, 0.0) / np.where(is_used, value, 1.0))[:, :, None])[:, :, 0])
