"""Geometric-misalignment model of a tracker whose source is in the rotating head.

Source: Muralikrishnan et al., J. Res. NIST 114 (2009) 21-35, the model family of ASME B89.4.19; written here
in the exact form (not the first-order one), from the base outwards:

    p = Rz(azimuth_t) { [tau, 0, 0] + Rx(kappa) [ Ry(-elevation_t) ( [0, b_y, b_z] + range_t * u ) ] }
    u = (cos c, sin c, 0)

Signs: every slot is a correction, added to the raw reading or to the nominal zero (truth - reading). Raw face-2
readings are used unchanged; the signs of the two faces follow from the geometry.
"""

from ltsim.geometry.kinematics.chain import Chain, Reading, Shift, Turn

MISALIGNMENT: Chain = (
    # Bearing of the standing axis, as functions of the azimuth: tilt and radial run-out in the base frame.
    Shift(0, "standing-radial-x"),
    Shift(1, "standing-radial-y"),
    Shift(2, "standing-axial"),
    Turn(0, "standing-tilt-x"),
    Turn(1, "standing-tilt-y"),
    Turn(2, "azimuth", Reading(1)),
    Shift(0, "transit-offset"),
    Turn(0, "transit-tilt"),
    Turn(1, "elevation", Reading(2), sign=-1.0),
    Shift(1, "beam-lateral"),
    Shift(2, "beam-vertical"),
    Turn(2, "beam-tilt"),
    Shift(0, "range", Reading(0)),
)
