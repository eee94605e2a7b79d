"""What a system determines: decided here by stated tolerances, never by whether a factorisation happens to fail.

Columns have unit length, so no unit of measurement enters. A direction is undetermined where a unit vector along it
moves the rows by no more than rounding: its image is looked at itself, because the pivots of a factorisation carry
rounding errors that grow with the length of the null vector, and a factorisation of the same matrix fails on one
processor and not on another. It can fail only far below the tolerances, so its failure is never a second opinion.
"""

from __future__ import annotations

import numpy as np

from ltsim.arrays import Bools, Floats

DOUBTFUL = 1e-8
"""Pivots of unit columns below this may be rounding: then the weakest direction is looked at itself."""
RANK = 1e-14
"""Squared length of the image of a unit vector under unit columns, at or below which it is undetermined.

Fifty times the rounding of a Cholesky factorisation; a chain of 2,000 set-ups bends by 1e-13."""
FORMED = 1e-12
"""The same for a normal matrix that eliminations left, whose design is not at hand: its eigenvalues carry 1e-15."""

POINT = 1e-10
"""Least over largest eigenvalue of a point's normal matrix, below which a direction of the point is open: it is known
100,000 times worse than the others."""


def unit_diagonal(matrices: Floats, size: Floats) -> tuple[Floats, Floats]:
    """Symmetric matrices (..., k, k) scaled by the columns' squared lengths `size` (..., k), and the scale (..., k)."""
    scale = 1.0 / np.sqrt(np.where(size > 0.0, size, 1.0))
    scaled: Floats = matrices * scale[..., :, None] * scale[..., None, :]
    return scaled, scale


def cholesky_where_determined(matrices: Floats) -> tuple[Floats, Bools]:
    """Lower factors (b, k, k) of normal matrices of unit columns, and which of these (b,) leave no direction open.

    A factor is NaN where one is open. Only matrices with a doubtful pivot pay for their eigenvalues.
    """
    roots = np.full_like(matrices, np.nan)
    try:
        roots = np.asarray(np.linalg.cholesky(matrices), dtype=np.float64)
        doubtful = ~(np.einsum("bii->bi", roots).min(axis=1, initial=1.0) ** 2 > DOUBTFUL)
    except np.linalg.LinAlgError:
        doubtful = np.ones(len(matrices), dtype=bool)
    if doubtful.any():
        known = np.linalg.eigvalsh(matrices[doubtful])[:, 0] > FORMED
        found = np.full_like(matrices[doubtful], np.nan)
        found[known] = np.linalg.cholesky(matrices[doubtful][known])
        roots[doubtful] = found
    determined: Bools = ~np.isnan(roots[:, -1, -1])
    return roots, determined
