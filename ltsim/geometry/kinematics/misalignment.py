"""Geometric-misalignment model of a tracker whose source is in the rotating head.

Source: Muralikrishnan et al., J. Res. NIST 114 (2009) 21-35, the model family of ASME B89.4.19; written here
in the exact form (not the first-order one), from the base outwards:

    p = Rz(azimuth_t) { [tau, 0, 0] + Rx(kappa) [ Ry(-elevation_t) ( [0, b_y, b_z] + range_t * u ) ] }
    u = (cos c, sin c, 0)

Signs: every slot is a correction, added to the raw reading or to the nominal zero (truth - reading). Raw face-2
readings are used unchanged; the signs of the two faces follow from the geometry.
"""

from ltsim.geometry.kinematics.chain import KinematicChain, ReadingAmount, RotationStep, TranslationStep

MISALIGNMENT_CHAIN: KinematicChain = (
    # Bearing of the standing axis, as functions of the azimuth: tilt and radial run-out in the base frame.
    TranslationStep(0, "standing-radial-x"),
    TranslationStep(1, "standing-radial-y"),
    TranslationStep(2, "standing-axial"),
    RotationStep(0, "standing-tilt-x"),
    RotationStep(1, "standing-tilt-y"),
    RotationStep(2, "azimuth", ReadingAmount(1)),
    TranslationStep(0, "transit-offset"),
    RotationStep(0, "transit-tilt"),
    RotationStep(1, "elevation", ReadingAmount(2), sign=-1.0),
    TranslationStep(1, "beam-lateral"),
    TranslationStep(2, "beam-vertical"),
    RotationStep(2, "beam-tilt"),
    TranslationStep(0, "range", ReadingAmount(0)),
)
