"""Transit tilt (4), the trunnion-axis tilt.

Delta_theta = -f kappa tan(phi), first order; exact as Rx(kappa) in the chain.
Source: Muralikrishnan et al. 2009 (x5); physics.md 2.2, entry 4. Validated: first order against the exact
chain, and against the D-H columns of physics.md 2.4.
"""

from __future__ import annotations

from ltsim.effects.effect import Parameter, SlotEffect, Stage, Term
from ltsim.units import ARCSECOND


class TransitTilt(SlotEffect):
    """Tilt of the transit axis about the forward direction."""

    name = "transit-tilt"
    number = 4
    stage = Stage.AXES
    observables = ("azimuth",)
    parameters = (
        Parameter(
            "transit-tilt", "urad", "transit axis not square to the standing axis", 3 * ARCSECOND, "angle"
        ),
    )
    terms = (Term("transit-tilt"),)
