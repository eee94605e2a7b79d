"""Vertical index (5): zero of the elevation circle, with the vertical tilt of the beam.

Delta_elevation = f phi_0: every target appears on a cone; flips with the face.
Like: elevation-eccentricity cosine and head-sag (0.96 / 0), beam-offset vertical (0.89 / 0.95).
Separate by: two faces; in one face the group cannot be resolved (136 urad).
Valid: up to 100 urad; moves with the warm-up (index-drift).
Source: Muralikrishnan et al. 2009 (x3, x4m); physics.md 2.2, entry 5.
Status: validated against the exact chain in first order, and against the D-H columns of physics.md 2.4.
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
    parameters = (Parameter("vertical-index", "urad", "zero of the elevation encoder", 3 * ARCSECOND, "angle"),)
    terms = (Term("elevation"),)
