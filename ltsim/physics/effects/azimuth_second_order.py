from ltsim.core.units import ARCSECOND
from ltsim.physics.effects.circles import cos_sin_parameters, cos_sin_terms
from ltsim.physics.effects.effect import ChainErrorEffect, LightPathStage


class AzimuthSecondOrder(ChainErrorEffect):
    """Second-order error of the azimuth circle: the scale is stretched and compressed twice per turn.

    The correction (true value minus reading) is Delta_azimuth = A2 cos(2 x) + B2 sin(2 x), with the raw azimuth x and
    the parameters A2 and B2. The error is the same in both faces, so that two-face tests do not detect it. Measured
    horizontal lengths vary with the azimuth, with a period of half a turn.

    Size: under 0.5 urad in a good tracker; 65 um in a length of 7.75 m at 7 m, about 5.5 urad, in older ones.
    Similar to: bearing-wobble, radial run-out of order 3 (correlation 0.80 in one face, 0 in two).
    Separate by: one length measured at many azimuths; another yaw at each station.
    Validity: up to 10 urad.
    Source: Muralikrishnan et al. 2010, J. Res. NIST 115, 291-301, doi:10.6028/jres.115.022 (sizes and method);
    Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (parameters x9a, x9b).
    Validation: validated against the exact kinematic chain in first order, and against the columns of the
    Denavit-Hartenberg chain.
    """

    name = "azimuth-second-order"
    light_path_stage = LightPathStage.ENCODERS
    observables = ("azimuth",)
    parameters = cos_sin_parameters("azimuth-second-order", "twice the raw azimuth", 3 * ARCSECOND, "angle")
    terms = cos_sin_terms("azimuth", 2)
