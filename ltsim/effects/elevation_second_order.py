"""Two-lobe error of the elevation circle (8).

C2 cos(2 x) + D2 sin(2 x) of the raw elevation x: Delta_elevation = f C2 cos(2 el) + D2 sin(2 el).
Like: D2: elevation-eccentricity sine (0.93, one face), air-layer (0.59), vertical mesh-expansion (0.50).
Separate by: two faces (C2); more elevations.
Valid: up to 10 urad.
Source: Muralikrishnan et al. 2009 (x10a, x10b); physics.md 2.2, entry 8.
Status: validated against the exact chain in first order, and against the D-H columns of physics.md 2.4.
"""

from __future__ import annotations

import numpy as np

from ltsim.effects.effect import Parameter, SlotEffect, Stage, Term
from ltsim.units import ARCSECOND


class ElevationSecondOrder(SlotEffect):
    """Two-lobe error of the elevation circle."""

    name = "elevation-second-order"
    number = 8
    stage = Stage.ENCODERS
    observables = ("elevation",)
    parameters = (
        Parameter("elevation-second-order-cos", "urad", "cosine of twice the raw elevation", 3 * ARCSECOND, "angle"),
        Parameter("elevation-second-order-sin", "urad", "sine of twice the raw elevation", 3 * ARCSECOND, "angle"),
    )
    terms = (
        Term("elevation", lambda raw: np.cos(2 * raw[:, 2])),
        Term("elevation", lambda raw: np.sin(2 * raw[:, 2])),
    )
