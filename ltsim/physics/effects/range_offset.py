from ltsim.core.units import MICROMETRE
from ltsim.physics.effects.effect import ChainErrorEffect, ChainErrorTerm, LightPathStage, Parameter


class RangeOffset(ChainErrorEffect):
    """Range zero error: the bird-bath distance or the offset of the absolute distance meter is wrong.

    The correction (true value minus reading) is Delta_d = rho_0: all ranges have the same error, in both faces.

    Size: a current absolute meter 2.5 um, 5 um at most; a bad one 20 to 50 um.
    Similar to: transit-offset (correlation 0.83 in one face, 0 in two), the axial part of smr-centring exactly.
    Stations and targets absorb 99.6 % of the effect, so that it is detected from 73 um on in one face, from 13 um on in
    two.
    Separate by: a length measured from outside in line with its ends, and from a station between them; the difference
    is twice the zero error.
    Validity: one mode of distance measurement; absolute distance meter and interferometer have separate zeros.
    Source: Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (parameter x8, bird-bath
    error); Rüeger 1996, Electronic Distance Measurement (length in line).
    Validation: validated against the exact kinematic chain in first order, and against the columns of the
    Denavit-Hartenberg chain.
    """

    name = "range-offset"
    base_rate = 2.0
    light_path_stage = LightPathStage.RANGE
    observables = ("distance",)
    parameters = (
        Parameter("range-offset", "um", "length by which every range is too short", 10 * MICROMETRE, "range_offset"),
    )
    terms = (ChainErrorTerm("range"),)
