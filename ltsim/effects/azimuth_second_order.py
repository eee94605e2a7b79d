"""Two-lobe error of the azimuth circle (8).

Delta_azimuth = A2 cos(2 x) + B2 sin(2 x) of the raw azimuth x: the same on both faces.
Like: radial run-out of order 3 (0.80, one face).
Separate by: one length at many azimuths; another yaw at each station. Two-face tests see nothing.
Valid: old instruments up to 6 urad.
Source: Muralikrishnan et al. 2009 (x9a, x9b) and 2010; physics.md 2.2, entry 8.
Status: validated against the exact chain in first order, and against the D-H columns of physics.md 2.4.
"""

from __future__ import annotations

import numpy as np

from ltsim.effects.effect import Parameter, SlotEffect, Stage, Term
from ltsim.units import ARCSECOND


class AzimuthSecondOrder(SlotEffect):
    """Two-lobe error of the azimuth circle."""

    name = "azimuth-second-order"
    number = 8
    stage = Stage.ENCODERS
    observables = ("azimuth",)
    parameters = (
        Parameter("azimuth-second-order-cos", "urad", "cosine of twice the raw azimuth", 3 * ARCSECOND, "angle"),
        Parameter("azimuth-second-order-sin", "urad", "sine of twice the raw azimuth", 3 * ARCSECOND, "angle"),
    )
    terms = (
        Term("azimuth", lambda raw: np.cos(2 * raw[:, 1])),
        Term("azimuth", lambda raw: np.sin(2 * raw[:, 1])),
    )
