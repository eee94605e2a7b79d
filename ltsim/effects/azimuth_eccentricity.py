"""Eccentricity of the azimuth encoder (6), one lobe a turn.

Delta_theta = A1 cos(theta_raw) + B1 sin(theta_raw).
Source: Muralikrishnan et al. 2009 (x6); physics.md 2.2, entry 6. Validated: first order against the exact
chain, and against the D-H columns of physics.md 2.4.
"""

from __future__ import annotations

import numpy as np

from ltsim.effects.effect import Parameter, SlotEffect, Stage, Term
from ltsim.units import ARCSECOND


class AzimuthEccentricity(SlotEffect):
    """One-lobe error of the azimuth circle."""

    name = "azimuth-eccentricity"
    number = 6
    stage = Stage.ENCODERS
    observables = ("azimuth",)
    parameters = (
        Parameter("azimuth-eccentricity-cos", "urad", "cosine of the raw azimuth", 3 * ARCSECOND, "angle"),
        Parameter("azimuth-eccentricity-sin", "urad", "sine of the raw azimuth", 3 * ARCSECOND, "angle"),
    )
    terms = (
        Term("azimuth", lambda raw: np.cos(raw[:, 1])),
        Term("azimuth", lambda raw: np.sin(raw[:, 1])),
    )
