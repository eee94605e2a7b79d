"""Amplitude and phase of a harmonic from its cosine and sine coefficients, with uncertainty.

a cos x + b sin x = A cos(x - phase): A = hypot(a, b), phase = atan2(b, a). The coefficients are what is estimated;
the phase is not defined at zero amplitude, which is why it is given only when A exceeds two of its sigmas.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Floats
from ltsim.calibration.calibration import Calibration
from ltsim.effects.effect import Parameter

DEFINED = 2.0
"""Least amplitude, in its sigmas, at which a phase is given."""

# 'azimuth-eccentricity-cos', and 'J1.eY_cos2' with an order behind.
_COSINE = re.compile(r"^(?P<front>.+[-_])cos(?P<order>\d?)$")


@dataclass(frozen=True)
class Harmonic:
    """One harmonic in SI; `phase` and `phase_sigma` [rad] are None where the phase is not defined."""

    name: str
    instrument: str
    parameter: Parameter
    amplitude: float
    sigma: float
    phase: float | None
    phase_sigma: float | None


def amplitude_and_phase(coefficients: Floats, covariance: Floats) -> tuple[float, float, float | None, float | None]:
    """Amplitude, its sigma, phase [rad] and its sigma of cosine and sine coefficients (2,).

    To first order in the covariance (2, 2). Without a defined phase the sigma is that of a coefficient along no
    particular direction, the root of half the trace.
    """
    amplitude = float(np.hypot(*coefficients))
    if amplitude > 0:
        along = coefficients / amplitude
        sigma = float(np.sqrt(along @ covariance @ along))
        if amplitude > DEFINED * sigma:
            across = np.array([-along[1], along[0]])
            phase_sigma = float(np.sqrt(across @ covariance @ across)) / amplitude
            return amplitude, sigma, float(np.arctan2(coefficients[1], coefficients[0])), phase_sigma
    return amplitude, float(np.sqrt(0.5 * np.trace(covariance))), None, None


def cosine_and_sine(names: Sequence[str]) -> Iterator[tuple[str, int, int]]:
    """Each harmonic among parameters: its name, the places of its cosine and its sine."""
    for i, name in enumerate(names):
        found = _COSINE.match(name)
        if found:
            sine = f"{found['front']}sin{found['order']}"
            if sine in names:
                yield found["front"].rstrip("-_") + found["order"], i, list(names).index(sine)


def harmonics(calibration: Calibration) -> list[Harmonic]:
    """All harmonics of a calibration: every pair of a cosine and a sine coefficient."""
    found = []
    size = calibration.construction.size
    for number, instrument in enumerate(calibration.instruments):
        for name, i, j in cosine_and_sine(calibration.construction.names):
            at = np.array([i, j]) + number * size
            values = calibration.values.ravel()[at]
            covariance = calibration.covariance[np.ix_(at, at)]
            shown = calibration.construction.parameters[i]
            found.append(Harmonic(name, instrument, shown, *amplitude_and_phase(values, covariance)))
    return found
