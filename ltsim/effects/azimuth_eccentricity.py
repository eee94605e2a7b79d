"""Eccentricity of the azimuth circle (6): one lobe a turn.

Delta_azimuth = A1 cos(x) + B1 sin(x) of the raw azimuth x; odd, so it flips with the face.
Like: radial run-out of order 2 (0.92 / 0).
Separate by: two faces; another yaw at each station.
Valid: first order of one read head; two opposite heads cancel it to second order.
Source: Muralikrishnan et al. 2009 (x6x, x6y); physics.md 2.2, entry 6.
Status: validated against the exact chain in first order, and against the D-H columns of physics.md 2.4.
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
