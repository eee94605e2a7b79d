from ltsim.core.units import ARCSECOND
from ltsim.physics.effects.circles import cos_sin_parameters, cos_sin_terms
from ltsim.physics.effects.effect import ChainErrorEffect, LightPathStage


class AzimuthEccentricity(ChainErrorEffect):
    """Eccentricity of the azimuth circle: the circle rotates off its centre, one period per turn.

    The correction (true value minus reading) is Delta_azimuth = A1 cos(x) + B1 sin(x), with the raw azimuth x and the
    parameters A1 and B1. The amplitude is the eccentricity divided by the radius of the circle. The error changes its
    sign with the face.

    Size: 10 um on a radius of 50 mm are 200 urad before the manufacturer's correction; with it under 0.5 urad in a good
    tracker, 5 to 10 urad in a bad one.
    Similar to: bearing-wobble, radial run-out of order 2 (correlation 0.92 in one face, 0 in two).
    Separate by: two faces; another yaw at each station, without which the error depends on the direction in the hall.
    Validity: first order of one read head; two opposite heads cancel it to second order.
    Source: Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (parameters x6x, x6y);
    Muralikrishnan et al. 2010, J. Res. NIST 115, 291-301, doi:10.6028/jres.115.022.
    Validation: validated against the exact kinematic chain in first order, and against the columns of the
    Denavit-Hartenberg chain.
    """

    name = "azimuth-eccentricity"
    light_path_stage = LightPathStage.ENCODERS
    observables = ("azimuth",)
    parameters = cos_sin_parameters("azimuth-eccentricity", "the raw azimuth", 3 * ARCSECOND, "angle")
    terms = cos_sin_terms("azimuth", 1)
