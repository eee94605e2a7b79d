"""Adjusted trials of a batch, and their convergence."""

from collections.abc import Mapping
from dataclasses import dataclass

from ltsim.core.arrays import Bools, Floats

MAX_DISTANCE_TO_OPTIMUM = 5e-5
"""Largest distance to the optimum of a trial that counts as converged: the norm over all unknowns, in units of their
standard deviations. A trial above it is solved again by the full solver.
"""


@dataclass(frozen=True)
class BatchFit:
    """Adjusted trials: B trials, T targets, I instruments with p parameters each, q parameters of effects."""

    target_increments: Floats
    """Adjusted minus nominal coordinates of the targets, (T, 3, B) [m]."""
    instrument_values: Floats
    """Instrument parameters, (I, p, B) [SI]."""
    effect_values: Floats
    """Parameters of the additional effects, (q, B) [SI]."""
    incidence_parameters: Mapping[str, Floats]
    """Parameters of the range error over incidence (effect `smr-incidence`, 14 parameters) of each reflector, by its
    name, (14, B) [SI].
    """
    chi2: Floats
    """Chi-square of each trial, (B,)."""
    distance_to_optimum: Floats
    """Estimated distance to the optimum after the last step, (B,): the norm over all unknowns, in units of their
    standard deviations.
    """

    @property
    def has_converged(self) -> Bools:
        """Flags (B,) of the converged trials; NaN counts as not converged."""
        return self.distance_to_optimum < MAX_DISTANCE_TO_OPTIMUM
