"""Transit offset (2): the transit axis does not cut the standing axis.

Delta_d = f tau cos(phi), Delta_phi = -f tau sin(phi) / d: the only geometric term with a two-face difference
in range. Source: Muralikrishnan et al. 2009 (x2); physics.md 2.2, entry 2. Validated: first order against the
exact chain, and against the D-H columns of physics.md 2.4.
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
        Parameter(
            "transit-offset", "um", "transit axis in front of the standing axis", 20 * MICROMETRE, "offset"
        ),
    )
    terms = (Term("transit-offset"),)
