"""Range offset (15): zero of the range, from the bird bath or the ADM.

Delta_d = rho_0. Source: Muralikrishnan et al. 2009 (x8); physics.md 2.2, entry 15. Validated: first order
against the exact chain, and against the D-H columns of physics.md 2.4.
"""

from __future__ import annotations

from ltsim.effects.effect import Parameter, SlotEffect, Stage, Term
from ltsim.units import MICROMETRE


class RangeOffset(SlotEffect):
    """Constant added to every range."""

    name = "range-offset"
    number = 15
    stage = Stage.RANGE
    observables = ("distance",)
    parameters = (
        Parameter("range-offset", "um", "constant missing from every range", 10 * MICROMETRE, "range_offset"),
    )
    terms = (Term("range"),)
