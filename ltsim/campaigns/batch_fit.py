"""Result of the network adjustment of a batch of trials, and convergence of each trial."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Bools, Floats

MAX_DISTANCE_TO_OPTIMUM = 5e-5
"""Largest distance to the optimum at which a trial counts as converged: norm of the remaining step, with each unknown
divided by its standard deviation. A trial with a larger distance is solved again by the full solver.
"""


@dataclass(frozen=True)
class BatchFit:
    """Adjusted networks of a batch of trials; the last index of each array is the trial."""

    target_increments: Floats
    """Adjusted minus nominal coordinates of the targets, (targets, 3, trials) [m]."""
    instrument_values: Floats
    """Estimated instrument parameters, (instruments, parameters, trials) [SI]."""
    effect_values: Floats
    """Estimated parameters of the additional effects, (effect parameters, trials) [SI]."""
    incidence_parameters: Mapping[str, Floats]
    """Estimated parameters, (14, trials) [SI], of each reflector's range error as a function of the incidence angle
    (effect `smr-incidence`), by name of the reflector."""
    chi2: Floats
    """Chi-square of each trial, (trials,)."""
    distance_to_optimum: Floats
    """Estimated distance to the optimum after the last step, (trials,): norm of the remaining step, with each unknown
    divided by its standard deviation."""

    @property
    def has_converged(self) -> Bools:
        """Mask (trials,) of the converged trials; a distance of NaN counts as not converged."""
        return self.distance_to_optimum < MAX_DISTANCE_TO_OPTIMUM


def multiply_by_trial(matrix: Floats, columns: Floats) -> Floats:
    """Product (rows, trials) of one matrix for all trials, or of one per trial, with `columns` (terms, trials)."""
    if matrix.ndim == 2:
        return matrix @ columns
    return np.matmul(matrix, columns.T[:, :, None])[:, :, 0].T
