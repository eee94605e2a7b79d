"""Adjusted trials of a batch, and their convergence."""

from collections.abc import Mapping
from dataclasses import dataclass

from ltsim.core.arrays import Bools, Floats

MAX_DISTANCE_TO_OPTIMUM = 5e-5
"""Largest distance to the optimum of a converged trial, in standard deviations (all unknowns together)."""


@dataclass(frozen=True)
class BatchFit:
    """Adjusted trials of a batch; the last index is the trial."""

    target_increments: Floats
    """Adjusted minus nominal targets, (T, 3, B) [m]."""
    instrument_values: Floats
    """Instrument parameters, (I, p, B) [SI]."""
    effect_values: Floats
    """Parameters of additional effects, (q, B) [SI]."""
    incidence_parameters: Mapping[str, Floats]
    """Parameters (14, B) [SI] of `smr-incidence` of each reflector, by name."""
    chi2: Floats
    """Chi-square of each trial, (B,)."""
    distance_to_optimum: Floats
    """Distance to the optimum after the last step, in standard deviations, (B,)."""

    @property
    def has_converged(self) -> Bools:
        """Flags (B,) of the converged trials; NaN counts as not converged."""
        return self.distance_to_optimum < MAX_DISTANCE_TO_OPTIMUM
