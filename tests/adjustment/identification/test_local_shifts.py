"""Shifts fitted in batches: each as a least-squares fit of its own."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.adjustment.identification.local_shifts import (
    N_REWEIGHTINGS_OF_SHIFT_FIT,
    N_TRIMMED_FITS,
    LocalShiftProblem,
    fit_local_shifts,
)
from ltsim.core.arrays import MAX_TEMPORARY_ENTRIES
from ltsim.core.randomness import random_stream

PRICE = 8.0


def shift_of(rng: np.random.Generator, columns: int, dependent: bool = False) -> LocalShiftProblem:
    """A shift of some pointings, of which a part is outlying by it, and that does not act on the last of them."""
    count = int(rng.integers(4, 30))
    design = rng.standard_normal((count, 3, columns))
    design[-1], design[:, 1, 1:] = 0.0, 0.0
    if dependent:
        design[:, :, -1] = 2.0 * design[:, :, 0]
    residual = design @ (20.0 * rng.standard_normal(columns)) + rng.standard_normal((count, 3))
    residual[: count // 2] = rng.standard_normal((count // 2, 3))
    return LocalShiftProblem.from_design(design, residual, np.abs(residual) > 4.0)


def single(shift: LocalShiftProblem) -> tuple[float, np.ndarray]:
    """The same fit, alone and by the singular values of its design."""

    def fitted(weight: np.ndarray) -> np.ndarray:
        chosen = weight > 0.0
        design, right = unit[chosen] * weight[chosen, None], residual[chosen] * weight[chosen]
        return np.linalg.lstsq(design, right, rcond=1e-7)[0]

    unit, residual = shift.unit_columns, shift.whitened_residuals
    if unit.shape[1] == 1:
        amount = np.array([np.median(residual[shift.is_outlier] / unit[shift.is_outlier, 0])])
    else:
        amount = fitted(shift.is_outlier * 1.0)
        for _ in range(N_REWEIGHTINGS_OF_SHIFT_FIT):
            miss = np.abs(residual - unit @ amount)
            amount = fitted(1.0 / np.sqrt(np.maximum(miss / max(1.5 * float(np.median(miss)), 1.0), 1.0)))
    for _ in range(N_TRIMMED_FITS):
        fits = 0.5 * (residual - unit @ amount) ** 2 < PRICE
        amount = fitted(fits * 1.0) if fits.sum() > len(amount) else amount
    cost = [np.minimum(0.5 * e**2, PRICE).sum() for e in (residual, residual - unit @ amount)]
    parameters = np.zeros(len(shift.is_acting_parameter))
    parameters[shift.is_acting_parameter] = amount / shift.column_lengths
    return float(cost[0] - cost[1]), parameters


@pytest.mark.parametrize("seed", range(3))
def test_each_shift_of_a_batch_is_fitted_as_alone(seed: int) -> None:
    rng = random_stream(seed, "local shifts")
    shifts = [shift_of(rng, columns, dependent) for columns in (1, 3, 6) for dependent in (False, columns > 1)] * 3
    shifts += [shift_of(rng, columns) for columns in (6, 1, 3, 2)]
    for shift, (saved, parameters) in zip(shifts, fit_local_shifts(shifts, PRICE), strict=True):
        alone, expected = single(shift)
        assert saved == pytest.approx(alone, rel=1e-6)
        np.testing.assert_allclose(parameters, expected, rtol=1e-5, atol=1e-8)


def test_shifts_of_many_readings_are_fitted_in_several_batches() -> None:
    rng = random_stream(4, "local shifts")
    design = rng.standard_normal((MAX_TEMPORARY_ENTRIES // 6, 3, 2))
    residual = design @ [30.0, -10.0]
    large = [
        LocalShiftProblem.from_design(design * scale, residual, np.abs(residual) > 4.0) for scale in (1.0, 2.0, 4.0)
    ]
    for scale, (_, parameters) in zip((1.0, 2.0, 4.0), fit_local_shifts(large, PRICE), strict=True):
        np.testing.assert_allclose(parameters * scale, [30.0, -10.0])
