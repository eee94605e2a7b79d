from ltsim.core.units import ARCSECOND
from ltsim.physics.effects.circles import cos_sin_parameters, cos_sin_terms
from ltsim.physics.effects.effect import ChainErrorEffect, LightPathStage


class ElevationEccentricity(ChainErrorEffect):
    """Eccentricity of the elevation circle: the circle rotates off its centre, one period per turn.

    The correction (true value minus reading) of the raw elevation x is C1 cos(x) + D1 sin(x). Reduced to face 1 it is
    Delta_elevation = C1 cos(el) + f D1 sin(el) at the elevation el, with f = +1 in face 1 and -1 in face 2. The part
    with C1 is largest for horizontal lines of sight and the same in both faces. The part with D1 has opposite signs at
    ceiling and floor, and changes its sign with the face.

    Size: with the manufacturer's correction under 0.5 urad in a good tracker, 5 to 10 urad in a bad one.
    Similar to: C1: head-sag exactly for upright trackers, vertical-index (correlation 0.96 in one face, 0 in two); D1:
    elevation-second-order sine (0.93, 0).
    Separate by: two faces (D1); a tracker that lies on its side, which distinguishes C1 from sag.
    Validity: first order of one read head.
    Source: Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (parameter x7).
    Validation: validated against the exact kinematic chain in first order, and against the columns of the
    Denavit-Hartenberg chain.
    """

    name = "elevation-eccentricity"
    light_path_stage = LightPathStage.ENCODERS
    observables = ("elevation",)
    parameters = cos_sin_parameters("elevation-eccentricity", "the raw elevation", 3 * ARCSECOND, "angle")
    terms = cos_sin_terms("elevation", 1)
