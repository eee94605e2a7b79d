"""Eccentricity of the elevation encoder (7), one lobe a turn.

E_V = C1 cos(phi_raw) + D1 sin(phi_raw): the sine part flips with the face, the cosine part does not.
Source: Muralikrishnan et al. 2009 (x7); physics.md 2.2, entry 7. Validated: first order against the exact
chain, and against the D-H columns of physics.md 2.4.
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
        Parameter(
            "elevation-eccentricity-cos", "urad", "cosine of the raw elevation", 3 * ARCSECOND, "angle"
        ),
        Parameter("elevation-eccentricity-sin", "urad", "sine of the raw elevation", 3 * ARCSECOND, "angle"),
    )
    terms = (
        Term("elevation", lambda raw: np.cos(raw[:, 2])),
        Term("elevation", lambda raw: np.sin(raw[:, 2])),
    )
