"""Transit offset (2): the transit axis passes beside the standing axis.

Delta_d = f tau cos(el), Delta_elevation = -f tau sin(el) / d: the only geometric term with a two-face range difference.
Like: range-offset (0.83 / 0).
Separate by: two faces, at once.
Valid: source in the rotating head; up to 0.1 mm.
Source: Muralikrishnan et al. 2009 (x2); physics.md 2.2, entry 2.
Status: validated against the exact chain in first order, and against the D-H columns of physics.md 2.4.
"""

from __future__ import annotations

from ltsim.effects.effect import Parameter, SlotEffect, Stage, Term
from ltsim.units import MICROMETRE


class TransitOffset(SlotEffect):
    """Distance between transit axis and standing axis, positive forward."""

    name = "transit-offset"
    number = 2
    stage = Stage.AXES
    observables = ("distance", "elevation")
    parameters = (
        Parameter("transit-offset", "um", "transit axis in front of the standing axis", 20 * MICROMETRE, "offset"),
    )
    terms = (Term("transit-offset"),)
