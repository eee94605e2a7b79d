"""Range zero (15): bird-bath distance, offset of the absolute distance meter.

Delta_d = rho_0, the same on both faces.
Like: transit-offset (0.83 / 0), the axial part of smr-centring exactly; 99.6 % is absorbed by stations and targets.
Separate by: a length in line, from outside and from between its ends.
Valid: one mode of distance measurement; absolute and interferometric have zeros of their own.
Source: physics.md 2.2 (x8), entry 15.
Status: validated against the exact chain in first order, and against the D-H columns of physics.md 2.4.
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
