"""Robust fits of shifts to the residuals of their own readings, with the network unchanged, in batches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import AT_ONCE, Bools, Floats

STEPS = 6
"""Number of reweightings in the fit of a shift."""
TRIMMED = 2
"""Largest number of fits to the readings that are no outliers with the shift."""
DEPENDENT = 1e-13
"""Eigenvalue, relative to the largest, of the normal matrix of unit columns up to which they count as linearly
dependent.
"""


@dataclass(frozen=True)
class LocalShift:
    """Design of a shift on its readings: unit columns (m, r), their lengths (r,), residuals (m,)."""

    unit: Floats
    size: Floats
    residual: Floats
    out: Bools
    """Flags of the outliers among the readings, (m,)."""
    columns: Bools
    """Flags (q,) of the r parameters of the shift that act on these readings."""

    @classmethod
    def of(cls, design: Floats, residual: Floats, out: Bools) -> LocalShift:
        """Design of a shift from its whitened design (n, 3, q), whitened residuals (n, 3) and outlier flags (n, 3)."""
        whole = design.reshape(-1, design.shape[2])
        acts = whole.any(axis=1)
        size = np.linalg.norm(whole[acts], axis=0)
        columns = size > 0.0
        unit = whole[acts][:, columns] / size[columns]
        return cls(unit, size[columns], residual.ravel()[acts], out.ravel()[acts], columns)

    @property
    def is_fitted(self) -> bool:
        """True if an outlier is among the readings, and a parameter acts on them."""
        return bool(self.out.any() and self.columns.any())


def fitted_shifts(shifts: Sequence[LocalShift], price: float) -> list[tuple[float, Floats]]:
    """Decrease of the robust negative log likelihood, and parameters (q,), of each shift.

    Each reading contributes at most `price`.
    """
    fits: dict[int, tuple[float, Floats]] = {}
    for batch in _batches(shifts):
        count, rank = len(shifts[batch[-1]].residual), len(shifts[batch[0]].size)
        unit, residual = np.zeros((len(batch), count, rank)), np.zeros((len(batch), count))
        out, valid = np.zeros((2, len(batch), count), dtype=bool)
        for k, shift in enumerate(shifts[i] for i in batch):
            rows = slice(len(shift.residual))
            unit[k, rows], residual[k, rows], out[k, rows], valid[k, rows] = shift.unit, shift.residual, shift.out, True
        amount = _robust_amounts(unit, residual, out, valid, price)
        cost, rest = (np.minimum(0.5 * e**2, price).sum(axis=1) for e in (residual, residual - _times(unit, amount)))
        for i, fall, values in zip(batch, (cost - rest).tolist(), amount, strict=True):
            parameters = np.zeros(len(shifts[i].columns))
            parameters[shifts[i].columns] = values / shifts[i].size
            fits[i] = fall, parameters
    return [fits[i] for i in range(len(shifts))]


def _batches(shifts: Sequence[LocalShift]) -> Iterator[list[int]]:
    """Indices of shifts with equal numbers of columns, ordered by length, with at most `AT_ONCE` entries."""
    batch: list[int] = []
    for i in sorted(range(len(shifts)), key=lambda i: shifts[i].unit.shape[::-1]):
        if batch and (
            len(shifts[i].size) != len(shifts[batch[0]].size) or (len(batch) + 1) * shifts[i].unit.size > AT_ONCE
        ):
            yield batch
            batch = []
        batch.append(i)
    if batch:
        yield batch


def _robust_amounts(unit: Floats, residual: Floats, out: Bools, valid: Bools, price: float) -> Floats:
    """Robust parameters (h, r) of unit columns (h, m, r) for residuals (h, m).

    They start at the outliers (h, m) of `valid` rows. For one column the start is the median of the ratios, for several
    a least-squares solution reweighted to least absolute deviations.
    """
    if unit.shape[2] == 1:
        column = unit[:, :, 0]
        amount = _medians(residual / np.where(column != 0.0, column, 1.0), out)[:, None]
    else:
        amount = _least_squares(unit, residual, out.astype(np.float64))
        for _ in range(STEPS):
            miss = np.abs(residual - _times(unit, amount))
            scale = np.maximum(1.5 * _medians(miss, valid), 1.0)
            amount = _least_squares(unit, residual, valid / np.sqrt(np.maximum(miss / scale[:, None], 1.0)))
    for _ in range(TRIMMED):
        fits = valid & (0.5 * (residual - _times(unit, amount)) ** 2 < price)
        enough = fits.sum(axis=1) > unit.shape[2]
        amount = np.where(enough[:, None], _least_squares(unit, residual, fits.astype(np.float64)), amount)
    return amount


def _times(unit: Floats, amount: Floats) -> Floats:
    """Changes (h, m) of the readings by parameters (h, r) of columns (h, m, r)."""
    return np.asarray((unit @ amount[:, :, None])[:, :, 0])


def _medians(values: Floats, chosen: Bools) -> Floats:
    """Medians (h,) of the selected values (h, m), at least one in each row."""
    ordered, count = np.sort(np.where(chosen, values, np.inf), axis=1), chosen.sum(axis=1)
    rows = np.arange(len(values))
    return np.asarray(0.5 * (ordered[rows, (count - 1) // 2] + ordered[rows, count // 2]))


def _least_squares(unit: Floats, residual: Floats, weight: Floats) -> Floats:
    """Least-squares parameters (h, r) with weights (h, m); the minimum-norm solution for dependent columns."""
    weighted = unit * weight[:, :, None]
    normal = np.swapaxes(weighted, 1, 2) @ weighted
    right = np.swapaxes(weighted, 1, 2) @ (residual * weight)[:, :, None]
    value, vector = np.linalg.eigh(normal)
    is_used = value > DEPENDENT * value[:, -1:]
    along = (np.swapaxes(vector, 1, 2) @ right)[:, :, 0]
    return np.asarray((vector @ (np.where(is_used, along, 0.0) / np.where(is_used, value, 1.0))[:, :, None])[:, :, 0])
