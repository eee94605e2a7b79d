"""Model of a tracker with a beam-steering mirror: fixed source, mirror that turns at half the rate of the beam.

The beam leaves the base upward along the standing axis and meets a plane mirror that turns with the head about the
transit axis. With V the zenith angle of the target the mirror's normal points V/2 below the horizon, and the
target is the image of a point straight up the beam:

    p = T F T^-1 C' B (0, 0, range),   F = diag(-1, 1, 1)
    T = Rz(azimuth) Dx(e) Rx(i) Ry(V/2) Dx(f) Rz(c)               base to mirror, its normal along x
    C' = Rz(azimuth) Dx(forward) Dy(left) Rz(azimuth)^-1          the cover plate's offset, which turns with the head
    B = Dx(O_x) Dy(O_y) Rx(I_x) Ry(I_y)                           the beam in the base

with e the transit offset, i the transit tilt, f the mirror offset, c the mirror tilt. A reflection F before a turn or a
shift is the reflected turn or shift before F, and F leaves the origin, where the target sits, as it is: so F moves
through T^-1, C' and B to the end and vanishes. Turns about x and shifts along y and z stay, turns about y and z and
shifts along x change their sign. The result is a chain of turns and shifts like any other, in which each motion of the
mirror occurs twice.

Source: Loser and Kyle 1998, Alignment and field check procedures for the Leica laser tracker LTD 500, Boeing Large
Scale Optical Metrology Seminar (the parameters); Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35,
doi:10.6028/jres.114.003. Written here in the exact form; signs as in `kinematics.misalignment`.
"""

import math

from ltsim.geometry.kinematics.chain import KinematicChain, ReadingAmount, RotationStep, TranslationStep

ZENITH_ROTATION = -0.5 * math.pi
"""Rotation [rad] of the mirror's normal between the zenith and the horizontal, added to the elevation."""
HALF_ANGLE_SIGN = -0.5
"""Ratio of the mirror's rotation to the elevation: one half, because the reflected beam turns twice as far as the
mirror. It is negative because elevation is counted upwards and a positive turn about y is downwards."""

STEERING_MIRROR_CHAIN: KinematicChain = (
    # To the mirror: T.
    RotationStep(2, "azimuth", ReadingAmount(1)),
    TranslationStep(0, "transit-offset"),
    RotationStep(0, "transit-tilt"),
    RotationStep(1, "elevation", ReadingAmount(2, ZENITH_ROTATION), sign=HALF_ANGLE_SIGN),
    TranslationStep(0, "mirror-offset"),
    RotationStep(2, "mirror-tilt"),
    # Its image: T^-1 reflected.
    RotationStep(2, "mirror-tilt"),
    TranslationStep(0, "mirror-offset"),
    RotationStep(1, "elevation", ReadingAmount(2, ZENITH_ROTATION), sign=HALF_ANGLE_SIGN),
    RotationStep(0, "transit-tilt", sign=-1.0),
    TranslationStep(0, "transit-offset"),
    TranslationStep(0, "cover-forward", sign=-1.0),
    TranslationStep(1, "cover-left"),
    RotationStep(2, "azimuth", ReadingAmount(1)),
    # The beam in the base, reflected.
    TranslationStep(0, "beam-x", sign=-1.0),
    TranslationStep(1, "beam-y"),
    RotationStep(0, "beam-tilt-x"),
    RotationStep(1, "beam-tilt-y", sign=-1.0),
    TranslationStep(2, "range", ReadingAmount(0)),
)
