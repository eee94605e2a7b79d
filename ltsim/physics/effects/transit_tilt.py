from ltsim.core.units import ARCSECOND
from ltsim.physics.effects.effect import ChainErrorEffect, ChainErrorTerm, LightPathStage, Parameter


class TransitTilt(ChainErrorEffect):
    """Transit tilt: the transit axis is not perpendicular to the standing axis.

    The correction (true value minus reading) is Delta_azimuth = -f kappa tan(el) at the elevation el. Here kappa is the
    tilt of the transit axis, and f is +1 in face 1 and -1 in face 2. The correction is a lateral shift -f kappa d
    sin(el) at the range d. The error has opposite signs at ceiling and floor, is zero at the height of the head, and
    changes its sign with the face.

    Size: under 1 urad in a good tracker, 5 to 20 urad in a bad one.
    Similar to: azimuth-drift (correlation 0.67 in one face, 0 in two) if targets are measured in the order of their
    heights; bearing-wobble of order 1 exactly.
    Separate by: two faces; a mixed order of the targets.
    Validity: source in the rotating head; up to 100 urad.
    Source: Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (parameter x5); Deumlich and
    Staiger 2002, Instrumentenkunde der Vermessungstechnik (trunnion axis of a theodolite).
    Validation: validated against the exact kinematic chain in first order, and against the columns of the
    Denavit-Hartenberg chain.
    """

    name = "transit-tilt"
    light_path_stage = LightPathStage.AXES
    observables = ("azimuth",)
    parameters = (
        Parameter(
            "transit-tilt",
            "urad",
            "tilt of the transit axis from the perpendicular to the standing axis",
            3 * ARCSECOND,
            "angle",
        ),
    )
    terms = (ChainErrorTerm("transit-tilt"),)
