"""Range scale (16, 17): frequency of the laser, or one refractive index of air for all.

Delta_d = s d, the same on both faces.
Like: gauge-scale and every uniform change of the mesh, exactly: without a known length it is the network's scale.
Separate by: thermometers and a barometer; a second, long length standard.
Valid: up to 100 ppm.
Source: physics.md 2.2, entries 16 and 17.
Status: validated against the exact chain in first order, and against the D-H columns of physics.md 2.4.
"""

from __future__ import annotations

from ltsim.effects.effect import Parameter, SlotEffect, Stage, Term
from ltsim.units import PPM


class RangeScale(SlotEffect):
    """Factor on every range, less one."""

    name = "range-scale"
    number = 16
    stage = Stage.RANGE
    observables = ("distance",)
    parameters = (Parameter("range-scale", "ppm", "share missing from every range", 2 * PPM, "range_scale"),)
    terms = (Term("range", lambda raw: raw[:, 0]),)
