from ltsim.core.units import ARCSECOND
from ltsim.physics.effects.effect import LightPathStage, Parameter, SlotEffect, SlotTerm


class VerticalIndex(SlotEffect):
    """Vertical index error: the zero of the elevation circle is wrong, or the beam tilts upward.

    Delta_elevation = f phi_0: every target appears on a cone, and what poses leave of it is a bowl over azimuth and
    elevation; flips with the face.

    Size: under 1 urad in a good tracker, 10 to 50 urad in a bad one; it moves with the warm-up (index-drift).
    Like: elevation-eccentricity cosine and head-sag (0.96 / 0), beam-offset vertical (0.89 / 0.95).
    Separate by: two faces; in one face the group cannot be resolved below 136 urad, in two faces from 2 urad on.
    Valid: up to 100 urad.
    Source: Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (x3, x4m).
    Status: validated against the exact chain in first order, and against the columns of the D-H chain.
    """

    name = "vertical-index"
    stage = LightPathStage.ENCODERS
    observables = ("elevation",)
    parameters = (Parameter("vertical-index", "urad", "zero of the elevation encoder", 3 * ARCSECOND, "angle"),)
    terms = (SlotTerm("elevation"),)
