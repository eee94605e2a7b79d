"""Beam offset (1): the beam passes beside the point where the axes meet.

D_t = f b_y and D_v = f b_z: constant lengths, so the angles fall as 1/d; flips with the face.
Like: detector-offset, exactly; beam-tilt (0.46 / 0.95), vertical-index (0.89 / 0.95): only the range tells them apart.
Separate by: two faces; targets at 1 to 1.5 m and at 8 m.
Valid: source in the rotating head; up to 0.1 mm.
Source: Muralikrishnan et al. 2009 (x1t, x1m); physics.md 2.2, entry 1.
Status: validated against the exact chain in first order, and against the D-H columns of physics.md 2.4.
"""

from __future__ import annotations

from ltsim.effects.effect import Parameter, SlotEffect, Stage, Term
from ltsim.units import MICROMETRE


class BeamOffset(SlotEffect):
    """Lateral and vertical offset of the beam from the rotation centre."""

    name = "beam-offset"
    number = 1
    stage = Stage.OPTICS
    observables = ("azimuth", "elevation")
    parameters = (
        Parameter(
            "beam-offset-lateral",
            "um",
            "beam left of the centre, along the transit axis",
            20 * MICROMETRE,
            "offset",
        ),
        Parameter("beam-offset-vertical", "um", "beam above the centre", 20 * MICROMETRE, "offset"),
    )
    terms = (
        Term("beam-lateral"),
        Term("beam-vertical"),
    )
