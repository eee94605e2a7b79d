"""Result of the network adjustment of a batch of trials, and convergence of each trial."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Bools, Floats

MAX_DISTANCE_TO_OPTIMUM = 5e-5
"""Largest distance to the optimum at which a trial counts as converged. The distance is the norm of the remaining step,
with each unknown divided by its standard deviation. A trial with a larger distance is calibrated again by
`lt.calibrate`."""


@dataclass(frozen=True)
class BatchFit:
    """Adjusted networks of a batch of trials; the last axis of each array is the trial."""

    target_increments: Floats
    """Adjusted minus nominal coordinates of the targets, (targets, 3, trials) [m]."""
    instrument_values: Floats
    """Estimated instrument parameters, (instruments, parameters, trials) [SI]."""
    effect_values: Floats
    """Estimated parameters of the effects in addition to the instrument parameters, (effect parameters, trials) [SI].
    """
    incidence_parameters: Mapping[str, Floats]
    """Estimated parameters (14, trials) [SI] of the effect `smr-incidence` (range error by incidence angle), by name of
    the reflector."""
    chi2: Floats
    """Chi-square of the adjustment of each trial, (trials,)."""
    distance_to_optimum: Floats
    """Estimated distance to the optimum after the last step, (trials,). It is the norm of the remaining step, with each
    unknown divided by its standard deviation."""

    @property
    def has_converged(self) -> Bools:
        """Mask (trials,) of the converged trials; a distance of NaN counts as not converged."""
        return self.distance_to_optimum < MAX_DISTANCE_TO_OPTIMUM


def multiply_by_trial(matrix: Floats, columns: Floats) -> Floats:
    """Product (rows, trials) of `matrix` with the column of each trial in `columns` (terms, trials).

    All trials share a matrix (rows, terms); a matrix of shape (trials, rows, terms) differs between trials.
    """
    if matrix.ndim == 2:
        return matrix @ columns
    return np.matmul(matrix, columns.T[:, :, None])[:, :, 0].T
