"""Two-lobe error of the elevation encoder (8).

A2 cos(2 x) + B2 sin(2 x) of the raw elevation x.
Source: Muralikrishnan et al. 2009 (x10a, x10b); physics.md 2.2, entry 8. Validated: first order against the
exact chain, and against the D-H columns of physics.md 2.4.
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
        Parameter(
            "elevation-second-order-cos", "urad", "cosine of twice the raw elevation", 3 * ARCSECOND, "angle"
        ),
        Parameter(
            "elevation-second-order-sin", "urad", "sine of twice the raw elevation", 3 * ARCSECOND, "angle"
        ),
    )
    terms = (
        Term("elevation", lambda raw: np.cos(2 * raw[:, 2])),
        Term("elevation", lambda raw: np.sin(2 * raw[:, 2])),
    )
