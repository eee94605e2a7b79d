from ltsim.core.units import ARCSECOND
from ltsim.physics.effects.circles import cos_sin_parameters, cos_sin_terms
from ltsim.physics.effects.effect import ChainErrorEffect, LightPathStage


class ElevationSecondOrder(ChainErrorEffect):
    """Second-order error of the elevation circle: the scale is stretched and compressed twice per turn.

    The correction (true value minus reading) of the raw elevation x is C2 cos(2 x) + D2 sin(2 x). Reduced to face 1 it
    is Delta_elevation = f C2 cos(2 el) + D2 sin(2 el) at the elevation el, with f = +1 in face 1 and -1 in face 2. The
    cosine changes its sign with the face, the sine does not.

    Size: under 0.5 urad in a good tracker, up to 6 urad in an old one.
    Similar to: D2: elevation-eccentricity sine (correlation 0.93 in one face, 0 in two), air-layer (0.59), vertical
    mesh-expansion (0.50).
    Separate by: two faces (C2); more elevations.
    Validity: up to 10 urad.
    Source: Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (parameters x10a, x10b).
    Validation: validated against the exact kinematic chain in first order, and against the columns of the
    Denavit-Hartenberg chain.
    """

    name = "elevation-second-order"
    light_path_stage = LightPathStage.ENCODERS
    observables = ("elevation",)
    parameters = cos_sin_parameters("elevation-second-order", "twice the raw elevation", 3 * ARCSECOND, "angle")
    terms = cos_sin_terms("elevation", 2)
