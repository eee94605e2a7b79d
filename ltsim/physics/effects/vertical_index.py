from ltsim.core.units import ARCSECOND
from ltsim.physics.effects.effect import ChainErrorEffect, ChainErrorTerm, LightPathStage, Parameter


class VerticalIndex(ChainErrorEffect):
    """Vertical index error: the zero of the elevation circle is wrong, or the beam tilts upward.

    The correction (true value minus reading) is Delta_elevation = f phi_0, with the index error phi_0 and f = +1 in
    face 1 and -1 in face 2. The error is the same for all targets in one face, and changes its sign with the face.
    Poses and targets absorb a part of it; the residuals are a smooth function of azimuth and elevation.

    Size: under 1 urad in a good tracker, 10 to 50 urad in a bad one; it changes during the warm-up (index-drift).
    Similar to: elevation-eccentricity cosine and head-sag (correlation 0.96 in one face, 0 in two), beam-offset
    vertical (0.89, 0.95).
    Separate by: two faces; the effect is distinguished from these from 136 urad on in one face, from 2 urad on in two.
    Validity: up to 100 urad.
    Source: Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (parameters x3, x4m).
    Validation: validated against the exact kinematic chain in first order, and against the columns of the
    Denavit-Hartenberg chain.
    """

    name = "vertical-index"
    light_path_stage = LightPathStage.ENCODERS
    observables = ("elevation",)
    parameters = (
        Parameter("vertical-index", "urad", "error of the zero of the elevation encoder", 3 * ARCSECOND, "angle"),
    )
    terms = (ChainErrorTerm("elevation"),)
