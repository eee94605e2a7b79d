from ltsim.core.units import ARCSECOND
from ltsim.physics.effects.effect import ChainErrorEffect, ChainErrorTerm, LightPathStage, Parameter


class BeamTilt(ChainErrorEffect):
    """Beam tilt: the beam is not perpendicular to the transit axis (horizontal collimation error).

    The correction (true value minus reading) is Delta_azimuth = f c / cos(el). Here el is the elevation, c the tilt of
    the beam, and f is +1 in face 1 and -1 in face 2. The correction is a lateral shift f c d proportional to the range
    d. The error does not depend on the azimuth, is largest for steep lines of sight, and changes its sign with the
    face.

    Size: under 1 urad in a good tracker, 10 to 50 urad in a bad one.
    Similar to: bearing-wobble of the transit axis (correlation 0.98 in one face, 0.82 in two), transit-tilt (0.55, 0),
    beam-offset (0.46, 0.95). In one face poses and targets absorb 99 % of it.
    Separate by: two faces; steep and level targets.
    Validity: source in the rotating head; up to 100 urad.
    Source: Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (parameter x4t); Deumlich and
    Staiger 2002, Instrumentenkunde der Vermessungstechnik (collimation of a theodolite).
    Validation: validated against the exact kinematic chain in first order, and against the columns of the
    Denavit-Hartenberg chain.
    """

    name = "beam-tilt"
    light_path_stage = LightPathStage.OPTICS
    observables = ("azimuth",)
    parameters = (
        Parameter(
            "beam-tilt",
            "urad",
            "tilt of the beam to the left, from the perpendicular to the transit axis",
            3 * ARCSECOND,
            "angle",
        ),
    )
    terms = (ChainErrorTerm("beam-tilt"),)
