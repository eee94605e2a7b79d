import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICROMETRE
from ltsim.physics.effects.effect import ChainErrorEffect, ChainErrorTerm, LightPathStage, Parameter


def constant_half_basis(readings: Floats) -> Floats:
    """Values (n,) of a constant error per unit of its parameter at n raw `readings` (n, 3): 0.5 for each.

    The factor 0.5 holds because the beam shifts by half the shift of the return spot on the detector.
    """
    return np.full(len(readings), 0.5)


class DetectorOffset(ChainErrorEffect):
    """Null offset of the tracking detector: the return spot is held off centre, and the beam misses the vertex.

    The corrections (true value minus reading) are lengths across the beam: D_t = f eps_y / 2 to the left and D_v = f
    eps_z / 2 upward. Here (eps_y, eps_z) is the offset of the return spot, and f is +1 in face 1 and -1 in face 2. The
    effect equals a beam offset of half the size.

    Size: under 1 um in a good tracker, 5 to 20 um in a bad one.
    Similar to: beam-offset, exactly.
    Separate by: another reflector (coating, size, dirt) or a log of the returned power, which do not change a beam
    offset.
    Validity: one kind of reflector, a constant offset.
    Source: general knowledge. The factor one half follows because a retroreflector returns the beam mirrored at its
    vertex.
    Validation: validated against the beam offset.
    """

    name = "detector-offset"
    light_path_stage = LightPathStage.OPTICS
    observables = ("azimuth", "elevation")
    covariates = ("distance",)
    parameters = (
        Parameter("detector-offset-lateral", "um", "offset of the return spot along the transit axis", 20 * MICROMETRE),
        Parameter(
            "detector-offset-vertical", "um", "offset of the return spot across the transit axis", 20 * MICROMETRE
        ),
    )
    terms = (
        ChainErrorTerm("beam-lateral", constant_half_basis),
        ChainErrorTerm("beam-vertical", constant_half_basis),
    )
