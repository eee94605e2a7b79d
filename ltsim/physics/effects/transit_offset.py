from ltsim.core.units import MICROMETRE
from ltsim.physics.effects.effect import ChainErrorEffect, ChainErrorTerm, LightPathStage, Parameter


class TransitOffset(ChainErrorEffect):
    """Transit offset: the transit axis does not intersect the standing axis.

    The corrections (true value minus reading) are Delta_d = f tau cos(el) and Delta_elevation = -f tau sin(el) / d at
    the elevation el and the range d. Here tau is the offset of the transit axis, positive forward, and f is +1 in face
    1 and -1 in face 2. The transit offset is the only geometric error with different ranges in the two faces; they
    differ by 2 tau cos(el).

    Size: under 3 um in a good tracker, 20 to 50 um in a bad one.
    Similar to: range-offset (correlation 0.83 in one face, 0 in two).
    Separate by: two faces; the effect is detected from 67 um on in one face, from 0.8 um on in two faces.
    Validity: source in the rotating head; up to 0.1 mm.
    Source: Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (parameter x2).
    Validation: validated against the exact kinematic chain in first order, and against the columns of the
    Denavit-Hartenberg chain.
    """

    name = "transit-offset"
    light_path_stage = LightPathStage.AXES
    observables = ("distance", "elevation")
    parameters = (
        Parameter(
            "transit-offset",
            "um",
            "distance of the transit axis in front of the standing axis",
            20 * MICROMETRE,
            "offset",
        ),
    )
    terms = (ChainErrorTerm("transit-offset"),)
