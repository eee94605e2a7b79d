from ltsim.core.units import MICROMETRE
from ltsim.physics.effects.effect import ChainErrorEffect, ChainErrorTerm, LightPathStage, Parameter


class BeamOffset(ChainErrorEffect):
    """Beam offset: the beam does not pass through the intersection of the axes.

    The corrections (true value minus reading) are constant lengths across the beam: D_t = f b_y to the left and D_v = f
    b_z upward. Here (b_y, b_z) is the offset of the beam, and f is +1 in face 1 and -1 in face 2. The corrections of
    the angles are therefore proportional to 1/d at the range d, largest for the nearest targets. All change their sign
    with the face.

    Size: under 3 um in a good tracker, 20 to 100 um after a transport.
    Similar to: detector-offset, exactly; beam-tilt (correlation 0.46 in one face, 0.95 in two) and vertical-index
    (0.89, 0.95), which differ from it only in their dependence on the range.
    Separate by: two faces; targets at 1 to 1.5 m and at 8 m.
    Validity: source in the rotating head; up to 0.1 mm.
    Source: Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (parameters x1t, x1m).
    Validation: validated against the exact kinematic chain in first order, and against the columns of the
    Denavit-Hartenberg chain.
    """

    name = "beam-offset"
    light_path_stage = LightPathStage.OPTICS
    observables = ("azimuth", "elevation")
    parameters = (
        Parameter(
            "beam-offset-lateral",
            "um",
            "offset of the beam to the left, along the transit axis",
            20 * MICROMETRE,
            "offset",
        ),
        Parameter("beam-offset-vertical", "um", "offset of the beam upward", 20 * MICROMETRE, "offset"),
    )
    terms = (ChainErrorTerm("beam-lateral"), ChainErrorTerm("beam-vertical"))
