"""Beam offset (1): the beam passes beside the point where the axes meet.

D_t = f b_y and D_v = f b_z: constant lengths, so the angles fall as 1/d; flips with the face.
Source: Muralikrishnan et al. 2009 (x1t, x1m); physics.md 2.2, entry 1. Validated: first order against the
exact chain, and against the D-H columns of physics.md 2.4.
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
