"""Combinations of instrument parameters that a recording determines far better than each of them.

On a single face, say, the vertical index and two eccentricities of the circle are known to 12 urad each, and their
weighted sum to 0.3 urad: a person who asks whether something changed asks the combination.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ltsim.arrays import Floats
from ltsim.calibrate.schema import DeterminedEntry
from ltsim.effects.signature import Parameter

DETERMINED = 0.25
"""A combination is told where its deviation is at most this share of what it would be were its members independent."""
PART = 0.2
"""Weight, over the largest, from which a parameter belongs to a combination."""


def determined(parameters: Sequence[Parameter], values: Floats, covariance: Floats) -> list[DeterminedEntry]:
    """Combinations of parameters of one unit: eigenvectors of their covariance that join several of them.

    Parameters
    ----------
    parameters : sequence of Parameter
        Of one instrument.
    values : (p,) float [SI]
    covariance : (p, p) float [SI]
    """
    found = []
    for unit in dict.fromkeys(p.unit for p in parameters):
        at = np.array([i for i, p in enumerate(parameters) if p.unit == unit])
        own, factor = covariance[np.ix_(at, at)], parameters[at[0]].factor
        for variance, vector in zip(*np.linalg.eigh(own), strict=True):
            members = np.flatnonzero(np.abs(vector) > PART * np.abs(vector).max())
            apart = float(np.sqrt(vector[members] ** 2 @ np.diag(own)[members]))
            sigma = float(np.sqrt(max(variance, 0.0)))
            if len(members) < 2 or sigma > DETERMINED * apart:
                continue
            vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
            weights = {parameters[at[i]].name: float(vector[i]) for i in members}
            value = float(vector @ values[at]) / factor
            found.append(DeterminedEntry(combination=weights, value=value, sigma=sigma / factor, unit=unit))
    return found
