"""Vertical index (5): zero of the elevation encoder, and the vertical part of the beam's tilt.

Delta_phi = f phi_0. Source: Muralikrishnan et al. 2009 (x3, x4m); physics.md 2.2, entry 5. Validated: first
order against the exact chain, and against the D-H columns of physics.md 2.4.
"""

from __future__ import annotations

from ltsim.effects.effect import Parameter, SlotEffect, Stage, Term
from ltsim.units import ARCSECOND


class VerticalIndex(SlotEffect):
    """Constant added to the raw elevation."""

    name = "vertical-index"
    number = 5
    stage = Stage.ENCODERS
    observables = ("elevation",)
    parameters = (
        Parameter("vertical-index", "urad", "zero of the elevation encoder", 3 * ARCSECOND, "angle"),
    )
    terms = (Term("elevation"),)
