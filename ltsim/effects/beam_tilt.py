"""Beam tilt (3), the horizontal collimation error.

Delta_theta = f c / cos(phi); exact u = (cos c, sin c, 0) in the chain.
Source: Muralikrishnan et al. 2009 (x4t); physics.md 2.2, entry 3. Validated: first order against the exact
chain, and against the D-H columns of physics.md 2.4.
"""

from __future__ import annotations

from ltsim.effects.effect import Parameter, SlotEffect, Stage, Term
from ltsim.units import ARCSECOND


class BeamTilt(SlotEffect):
    """Lateral tilt of the beam against the plane square to the transit axis."""

    name = "beam-tilt"
    number = 3
    stage = Stage.OPTICS
    observables = ("azimuth",)
    parameters = (
        Parameter(
            "beam-tilt", "urad", "beam turned left, not square to the transit axis", 3 * ARCSECOND, "angle"
        ),
    )
    terms = (Term("beam-tilt"),)
