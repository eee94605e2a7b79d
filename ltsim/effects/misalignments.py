"""Errors of the head's geometry that a maker's model corrects: offsets and tilts of beam and axes."""

from ltsim.effects.effect import Parameter, SlotEffect, Stage, Term
from ltsim.units import ARCSECOND, MICROMETRE


class BeamOffset(SlotEffect):
    """Beam offset: the beam passes beside the point where the axes meet.

    D_t = f b_y and D_v = f b_z: constant lengths across the beam, so the angles fall as 1/d, strongest on the nearest
    targets; both flip with the face.

    Size: under 3 um in a good tracker, 20 to 100 um after a transport.
    Like: detector-offset, exactly; beam-tilt (0.46 / 0.95) and vertical-index (0.89 / 0.95), which only the range tells
    apart.
    Separate by: two faces; targets at 1 to 1.5 m and at 8 m.
    Valid: source in the rotating head; up to 0.1 mm.
    Source: Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (x1t, x1m).
    Status: validated against the exact chain in first order, and against the columns of the D-H chain.
    """

    name = "beam-offset"
    stage = Stage.OPTICS
    observables = ("azimuth", "elevation")
    parameters = (
        Parameter(
            "beam-offset-lateral",
            "um",
            "beam left of the centre, along the transit axis",
            20 * MICROMETRE,
            "offset",
        ),
        Parameter("beam-offset-vertical", "um", "beam above the centre", 20 * MICROMETRE, "offset"),
    )
    terms = (
        Term("beam-lateral"),
        Term("beam-vertical"),
    )


class TransitOffset(SlotEffect):
    """Transit offset: the transit axis passes beside the standing axis.

    Delta_d = f tau cos(el), Delta_elevation = -f tau sin(el) / d, tau positive forward: the only geometric term that
    makes the two faces read different ranges, by 2 tau cos(el).

    Size: under 3 um in a good tracker, 20 to 50 um in a bad one.
    Like: range-offset (0.83 / 0).
    Separate by: two faces, at once: what shows from 67 um on in one face shows from 0.8 um on in two.
    Valid: source in the rotating head; up to 0.1 mm.
    Source: Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (x2).
    Status: validated against the exact chain in first order, and against the columns of the D-H chain.
    """

    name = "transit-offset"
    stage = Stage.AXES
    observables = ("distance", "elevation")
    parameters = (
        Parameter("transit-offset", "um", "transit axis in front of the standing axis", 20 * MICROMETRE, "offset"),
    )
    terms = (Term("transit-offset"),)


class BeamTilt(SlotEffect):
    """Beam tilt: the beam is not square to the transit axis (horizontal collimation).

    Delta_azimuth = f c / cos(el), a lateral shift f c d proportional to the range; no dependence on the azimuth,
    steepest for targets high above or below; flips with the face.

    Size: under 1 urad in a good tracker, 10 to 50 urad in a bad one.
    Like: bearing-wobble of the transit axis (0.98 / 0.82), transit-tilt (0.55 / 0), beam-offset (0.46 / 0.95). In one
    face poses and targets absorb 99 % of it.
    Separate by: two faces; steep and level targets.
    Valid: source in the rotating head; up to 100 urad.
    Source: Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (x4t); Deumlich and Staiger
    2002, Instrumentenkunde der Vermessungstechnik (collimation of a theodolite).
    Status: validated against the exact chain in first order, and against the columns of the D-H chain.
    """

    name = "beam-tilt"
    stage = Stage.OPTICS
    observables = ("azimuth",)
    parameters = (
        Parameter("beam-tilt", "urad", "beam turned left, not square to the transit axis", 3 * ARCSECOND, "angle"),
    )
    terms = (Term("beam-tilt"),)


class TransitTilt(SlotEffect):
    """Transit tilt: the transit axis is not square to the standing axis.

    Delta_azimuth = -f kappa tan(el), a lateral shift -f kappa d sin(el): ceiling and floor go to opposite sides,
    nothing happens at the height of the head; flips with the face.

    Size: under 1 urad in a good tracker, 5 to 20 urad in a bad one.
    Like: azimuth-drift where points are taken level by level (0.67 / 0), bearing-wobble of order 1 exactly.
    Separate by: two faces; a mixed order of the targets.
    Valid: source in the rotating head; up to 100 urad.
    Source: Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (x5); Deumlich and Staiger
    2002, Instrumentenkunde der Vermessungstechnik (trunnion axis of a theodolite).
    Status: validated against the exact chain in first order, and against the columns of the D-H chain.
    """

    name = "transit-tilt"
    stage = Stage.AXES
    observables = ("azimuth",)
    parameters = (
        Parameter("transit-tilt", "urad", "transit axis not square to the standing axis", 3 * ARCSECOND, "angle"),
    )
    terms = (Term("transit-tilt"),)


class VerticalIndex(SlotEffect):
    """Vertical index: the zero of the elevation circle is off, or the beam tilts upward.

    Delta_elevation = f phi_0: every target appears on a cone, and what poses leave of it is a bowl over azimuth and
    elevation; flips with the face.

    Size: under 1 urad in a good tracker, 10 to 50 urad in a bad one; it moves with the warm-up (index-drift).
    Like: elevation-eccentricity cosine and head-sag (0.96 / 0), beam-offset vertical (0.89 / 0.95).
    Separate by: two faces; in one face the group cannot be resolved below 136 urad, in two faces from 2 urad on.
    Valid: up to 100 urad.
    Source: Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (x3, x4m).
    Status: validated against the exact chain in first order, and against the columns of the D-H chain.
    """

    name = "vertical-index"
    stage = Stage.ENCODERS
    observables = ("elevation",)
    parameters = (Parameter("vertical-index", "urad", "zero of the elevation encoder", 3 * ARCSECOND, "angle"),)
    terms = (Term("elevation"),)
