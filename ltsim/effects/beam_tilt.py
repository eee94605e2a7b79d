"""Beam tilt (3): the beam is not square to the transit axis (horizontal collimation).

Delta_azimuth = f c / cos(el): a lateral shift proportional to the range; flips with the face.
Like: bearing-wobble of the transit axis (0.98 / 0.82), transit-tilt (0.55 / 0), beam-offset.
Separate by: two faces; steep and level targets.
Valid: source in the rotating head; up to 100 urad.
Source: Muralikrishnan et al. 2009 (x4t); physics.md 2.2, entry 3.
Status: validated against the exact chain in first order, and against the D-H columns of physics.md 2.4.
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
        Parameter("beam-tilt", "urad", "beam turned left, not square to the transit axis", 3 * ARCSECOND, "angle"),
    )
    terms = (Term("beam-tilt"),)
