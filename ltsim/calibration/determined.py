"""Combinations of instrument parameters that a recording determines far better than each of them.

On a single face, say, the vertical index and two eccentricities of the circle are known to 12 urad each, and their
weighted sum to 0.3 urad: a person who asks whether something changed asks the combination.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ltsim.arrays import Floats
from ltsim.calibration.schema import DeterminedEntry
from ltsim.effects.signature import Parameter

DETERMINED = 0.25
"""A combination is told where its deviation is at most this share of what it would be were its members independent."""
WHOLE = 1.2
"""Members are told until they leave so many times the deviation that all parameters together have."""


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
        alone = np.sqrt(np.diag(own))
        variances, vectors = np.linalg.eigh(own)
        for variance, vector in zip(variances, vectors.T, strict=True):
            vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
            for count in range(1, len(at) + 1):
                members = np.sort(np.argsort(-np.abs(vector) * alone)[:count])
                weights = vector[members]
                sigma = float(np.sqrt(weights @ own[np.ix_(members, members)] @ weights))
                if sigma <= WHOLE * np.sqrt(max(variance, 0.0)):
                    break
            if count < 2 or sigma > DETERMINED * float(np.linalg.norm(weights * alone[members])):
                continue
            told = {parameters[at[i]].name: float(w) for i, w in zip(members, weights, strict=True)}
            value = float(weights @ values[at[members]]) / factor
            found.append(DeterminedEntry(combination=told, value=value, sigma=sigma / factor, unit=unit))
    return found
