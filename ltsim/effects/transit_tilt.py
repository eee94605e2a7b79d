"""Transit tilt (4): the transit axis is not square to the standing axis.

Delta_azimuth = -f kappa tan(el): ceiling and floor shift to opposite sides; flips with the face.
Like: azimuth-drift where points are taken level by level (0.67 / 0), wobble of order 1 exactly.
Separate by: two faces; a mixed order of the targets.
Valid: source in the rotating head; up to 100 urad.
Source: Muralikrishnan et al. 2009 (x5); physics.md 2.2, entry 4.
Status: validated against the exact chain in first order, and against the D-H columns of physics.md 2.4.
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
        Parameter("transit-tilt", "urad", "transit axis not square to the standing axis", 3 * ARCSECOND, "angle"),
    )
    terms = (Term("transit-tilt"),)
