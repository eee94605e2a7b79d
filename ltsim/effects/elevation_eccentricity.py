"""Eccentricity of the elevation circle (7): one lobe.

C1 cos(x) + D1 sin(x) of the raw elevation x: Delta_elevation = C1 cos(el) + f D1 sin(el) in front-face terms.
Like: C1: head-sag exactly, vertical-index (0.96 / 0); D1: elevation-second-order sine (0.93 / 0).
Separate by: D1 by two faces; C1 from sag only with the tracker on its side.
Valid: first order of one read head.
Source: Muralikrishnan et al. 2009 (x7); physics.md 2.2, entry 7.
Status: validated against the exact chain in first order, and against the D-H columns of physics.md 2.4.
"""

from __future__ import annotations

import numpy as np

from ltsim.effects.effect import Parameter, SlotEffect, Stage, Term
from ltsim.units import ARCSECOND


class ElevationEccentricity(SlotEffect):
    """One-lobe error of the elevation circle."""

    name = "elevation-eccentricity"
    number = 7
    stage = Stage.ENCODERS
    observables = ("elevation",)
    parameters = (
        Parameter("elevation-eccentricity-cos", "urad", "cosine of the raw elevation", 3 * ARCSECOND, "angle"),
        Parameter("elevation-eccentricity-sin", "urad", "sine of the raw elevation", 3 * ARCSECOND, "angle"),
    )
    terms = (
        Term("elevation", lambda raw: np.cos(raw[:, 2])),
        Term("elevation", lambda raw: np.sin(raw[:, 2])),
    )
