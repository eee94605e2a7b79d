"""Kinematic chains: models of a tracker as a sequence of elementary motions, without linearisation.

A chain is a list of motions from the base outwards: a rotation about z by the azimuth, a translation along x by the
transit offset, and so on. The target is at the origin of the last frame. An instrument error (in m or rad) is added to
the nominal length or angle of a motion. The motion's `error_key` is the key of this error in the mapping `errors`.

Derivatives of the measured point are exact too. With respect to the error of a translation, the derivative is the unit
vector of the axis in the base frame. With respect to the error of a rotation, it is the cross product of the axis and
the vector from the axis to the target. There are three designs of a tracker: `MISALIGNMENT_CHAIN`,
`STEERING_MIRROR_CHAIN` and `DH_CHAIN` (Sensors 2021, 21, 7479).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import QUARTER_TURN

MotionAmountFunction = Callable[[Floats], Floats]
"""Function from n raw readings of range, azimuth and elevation, (n, 3), to the nominal angle [rad] or length [m] of an
elementary motion, (n,)."""


@dataclass(frozen=True)
class MotionStep:
    """Step of a kinematic chain along or about a coordinate axis, by a nominal amount plus an error.

    The amount is an angle [rad] for a rotation and a length [m] for a translation.
    """

    axis: int
    """Coordinate axis of the motion: 0 x, 1 y, 2 z."""
    error_key: str = ""
    """Key of the motion's error in the mapping `errors`; empty for a motion without error."""
    motion_amount_function: MotionAmountFunction | None = None
    """Nominal amount [rad or m] as a function of the raw readings; None for a nominal amount of zero."""
    amount_factor: float = 1.0
    """Factor by which nominal amount plus error is multiplied: +1, -1, or a ratio such as `MIRROR_ROTATION_RATIO`."""


class RotationStep(MotionStep):
    """Step of a kinematic chain: rotation by `amount_factor` times the sum of a nominal angle and an error [rad]."""


class TranslationStep(MotionStep):
    """Step of a kinematic chain: translation by `amount_factor` times the sum of a nominal length and an error [m]."""


ElementaryMotion = RotationStep | TranslationStep
"""Elementary motion of a kinematic chain: rotation about a coordinate axis, or translation along it."""
KinematicChain = tuple[ElementaryMotion, ...]
"""Kinematic chain: elementary motions from the base of the tracker to the target."""


@dataclass(frozen=True)
class ConstantMotionAmount:
    """Function for an elementary motion whose nominal angle [rad] or length [m] is the same for all readings."""

    value: float
    """Nominal angle [rad] or length [m] of the motion."""

    def __call__(self, raw_readings: Floats) -> Floats:
        """Array (n,) of the constant angle [rad] or length [m], for n raw readings `raw_readings` (n, 3)."""
        return np.full(len(raw_readings), self.value)


@dataclass(frozen=True)
class MotionAmountFromReading:
    """Function for an elementary motion whose nominal angle or length is a raw reading plus a fixed offset."""

    reading_index: int
    """Index of the reading: 0 range, 1 azimuth, 2 elevation."""
    offset: float = 0.0
    """Offset [m or rad] that is added to the reading."""

    def __call__(self, raw_readings: Floats) -> Floats:
        """Selected reading plus `offset`, (n,) [m or rad], from n raw readings of range, azimuth, elevation, (n, 3)."""
        return raw_readings[:, self.reading_index] + self.offset


def _motion_amount(
    elementary_motion: ElementaryMotion, raw_readings: Floats, errors: Mapping[str, Floats]
) -> Floats | None:
    """Angle [rad] or length [m] of a motion, nominal plus error times `amount_factor`, for n raw readings (n, 3).

    The result is an array (n,) or one number; None for a motion with neither a nominal amount nor an error. `errors`
    contains the instrument errors by `error_key`.
    """
    motion_amount = (
        None
        if elementary_motion.motion_amount_function is None
        else elementary_motion.motion_amount_function(raw_readings)
    )
    error = errors.get(elementary_motion.error_key)
    if error is not None:
        motion_amount = error if motion_amount is None else motion_amount + error
    return None if motion_amount is None else elementary_motion.amount_factor * motion_amount


def _rotate_in_place(axis: int, angle: Floats, *vectors: Floats) -> None:
    """Rotation in place of arrays of vectors (..., n, 3) about a coordinate axis (0 x, 1 y, 2 z), by angles (n,)."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    c, s = np.cos(angle), np.sin(angle)
    for v in vectors:
        v[..., i], v[..., j] = c * v[..., i] - s * v[..., j], s * v[..., i] + c * v[..., j]


def points_from_raw_readings(chain: KinematicChain, raw_readings: Floats, errors: Mapping[str, Floats]) -> Floats:
    """Points (n, 3) [m] in the base frame of a kinematic chain, from n raw readings (n, 3) [m, rad, rad].

    `errors` contains the error [rad or m] of each motion by its `error_key`, as an array (n,) or one number. A motion
    whose key is missing has no error.
    """
    p: list[Any] = [0.0, 0.0, 0.0]  # one contiguous array per coordinate
    for motion in reversed(chain):
        amount = _motion_amount(motion, raw_readings, errors)
        if amount is None:
            continue
        if isinstance(motion, TranslationStep):
            p[motion.axis] = p[motion.axis] + amount
            continue
        i, j = (motion.axis + 1) % 3, (motion.axis + 2) % 3
        c, s = np.cos(amount), np.sin(amount)
        p[i], p[j] = c * p[i] - s * p[j], s * p[i] + c * p[j]
    points = np.empty((len(raw_readings), 3))
    points[:, 0], points[:, 1], points[:, 2] = p
    return points


def points_and_error_derivatives(
    chain: KinematicChain, raw_readings: Floats, errors: Mapping[str, Floats], error_keys: set[str]
) -> tuple[Floats, dict[str, Floats]]:
    """Points (n, 3) [m] of n raw readings (n, 3), and their derivatives (n, 3) by each instrument error, by its key.

    `errors` contains the error [rad or m] of each motion by its `error_key`. Derivatives are computed for those of
    the keys `error_keys` that the chain contains. The computation starts at the target and applies the motions towards
    the base: a rotation turns point and derivatives, a translation moves the point alone.
    """
    p = np.zeros((len(raw_readings), 3))
    derivative_buffer, count = np.zeros((len(chain), len(raw_readings), 3)), 0
    derivatives: dict[str, Floats] = {}
    for motion in reversed(chain):
        amount = _motion_amount(motion, raw_readings, errors)
        if isinstance(motion, TranslationStep):
            if amount is not None:
                p[:, motion.axis] += amount
        elif amount is not None:
            _rotate_in_place(motion.axis, amount, p, derivative_buffer[:count])
        if motion.error_key not in error_keys:
            continue
        if motion.error_key not in derivatives:
            derivatives[motion.error_key] = derivative_buffer[count]
            count += 1
        derivative = derivatives[motion.error_key]
        if isinstance(motion, TranslationStep):
            derivative[:, motion.axis] += motion.amount_factor
        else:
            i, j = (motion.axis + 1) % 3, (motion.axis + 2) % 3
            derivative[:, i] -= motion.amount_factor * p[:, j]
            derivative[:, j] += motion.amount_factor * p[:, i]
    return p, derivatives


MISALIGNMENT_CHAIN: KinematicChain = (
    # Bearing of the standing axis, as functions of the azimuth: tilt and radial run-out in the base frame.
    TranslationStep(0, "standing-radial-x"),
    TranslationStep(1, "standing-radial-y"),
    TranslationStep(2, "standing-axial"),
    RotationStep(0, "standing-tilt-x"),
    RotationStep(1, "standing-tilt-y"),
    RotationStep(2, "azimuth", MotionAmountFromReading(1)),
    TranslationStep(0, "transit-offset"),
    RotationStep(0, "transit-tilt"),
    RotationStep(1, "elevation", MotionAmountFromReading(2), amount_factor=-1.0),
    TranslationStep(1, "beam-lateral"),
    TranslationStep(2, "beam-vertical"),
    RotationStep(2, "beam-tilt"),
    TranslationStep(0, "range", MotionAmountFromReading(0)),
)
"""Kinematic chain of the geometric-misalignment model: a tracker whose source is in the rotating head.

Source: Muralikrishnan et al., J. Res. NIST 114 (2009) 21-35, the model family of ASME B89.4.19; written here
in the exact form (not the first-order one), from the base outwards:

    p = Rz(azimuth_t) { [tau, 0, 0] + Rx(kappa) [ Ry(-elevation_t) ( [0, b_y, b_z] + range_t * u ) ] }
    u = (cos c, sin c, 0)

Here p is the point, azimuth_t, elevation_t and range_t are the readings plus their errors, tau is the transit offset,
kappa the transit tilt, b_y and b_z are the lateral and vertical beam offsets, and c is the beam tilt. Motions of the
bearing of the standing axis (keys `standing-...`) come before these terms and are omitted in the formula.

Signs: every error is a correction (true value minus reading), added to the raw reading or to the nominal zero. Raw
face-2 readings are used unchanged; the signs of the two faces result from the geometry.
"""

ELEVATION_TO_ZENITH_OFFSET = -0.5 * math.pi
"""Offset [rad] between elevation and negative zenith angle: elevation + offset = -(zenith angle)."""
MIRROR_ROTATION_RATIO = -0.5
"""Ratio of the rotation of a beam-steering mirror to the elevation. Its size is one half, because the reflected beam
turns twice as far as the mirror. It is negative, because a positive rotation about y lowers the beam."""

STEERING_MIRROR_CHAIN: KinematicChain = (
    # To the mirror: T.
    RotationStep(2, "azimuth", MotionAmountFromReading(1)),
    TranslationStep(0, "transit-offset"),
    RotationStep(0, "transit-tilt"),
    RotationStep(
        1, "elevation", MotionAmountFromReading(2, ELEVATION_TO_ZENITH_OFFSET), amount_factor=MIRROR_ROTATION_RATIO
    ),
    TranslationStep(0, "mirror-offset"),
    RotationStep(2, "mirror-tilt"),
    # Its image: T^-1 reflected.
    RotationStep(2, "mirror-tilt"),
    TranslationStep(0, "mirror-offset"),
    RotationStep(
        1, "elevation", MotionAmountFromReading(2, ELEVATION_TO_ZENITH_OFFSET), amount_factor=MIRROR_ROTATION_RATIO
    ),
    RotationStep(0, "transit-tilt", amount_factor=-1.0),
    TranslationStep(0, "transit-offset"),
    TranslationStep(0, "cover-forward", amount_factor=-1.0),
    TranslationStep(1, "cover-left"),
    RotationStep(2, "azimuth", MotionAmountFromReading(1)),
    # The beam in the base, reflected.
    TranslationStep(0, "beam-x", amount_factor=-1.0),
    TranslationStep(1, "beam-y"),
    RotationStep(0, "beam-tilt-x"),
    RotationStep(1, "beam-tilt-y", amount_factor=-1.0),
    TranslationStep(2, "range", MotionAmountFromReading(0)),
)
"""Kinematic chain of a tracker with a fixed laser and a beam-steering mirror, which turns half as far as the beam.

The beam leaves the base upwards along the standing axis. The plane mirror turns with the head about the standing axis,
and about the transit axis. For a target at zenith angle V the normal of the mirror points V/2 below the horizon. The
target, at p, is the mirror image of the point at the measured range on the undeflected beam:

    p = T F T^-1 C' B (0, 0, range),   F = diag(-1, 1, 1)
    T = Rz(azimuth) Dx(e) Rx(i) Ry(V/2) Dx(f) Rz(c)               base to mirror, its normal along x
    C' = Rz(azimuth) Dx(forward) Dy(left) Rz(azimuth)^-1          offset by the cover plate, which turns with the head
    B = Dx(O_x) Dy(O_y) Rx(I_x) Ry(I_y)                           the beam in the base

Here e is the transit offset, i the transit tilt, f the mirror offset and c the mirror tilt. O_x and O_y are the offset
of the beam in the base, I_x and I_y its tilts. Rx, Ry and Rz are rotations about the axes, Dx and Dy translations along
them. The reflection F is eliminated, because it can exchange its place with a rotation or translation: rotations about
y and z and translations along x then change their sign, all others stay. At the end of the chain, F leaves the origin,
where the target is, unchanged. The result is a chain of rotations and translations, in which each motion of the mirror
occurs twice.

Source: Loser and Kyle 1998, Alignment and field check procedures for the Leica laser tracker LTD 500, Boeing Large
Scale Optical Metrology Seminar (the parameters); Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35,
doi:10.6028/jres.114.003. Written here in the exact form; signs as in `MISALIGNMENT_CHAIN`.
"""


def error_motions_of_kinematic_joint(joint_name: str) -> tuple[ElementaryMotion, ...]:
    """Error motions of a kinematic joint of `DH_CHAIN`: three translations along and three rotations about x, y, z.

    The keys of their errors begin with the name of the kinematic joint: ``J1.dX`` to ``J1.eZ`` for the azimuth axis J1.
    """
    shifts = tuple(TranslationStep(i, f"{joint_name}.d{axis}") for i, axis in enumerate("XYZ"))
    turns = tuple(RotationStep(i, f"{joint_name}.e{axis}") for i, axis in enumerate("XYZ"))
    return shifts + turns


DH_CHAIN: KinematicChain = (
    RotationStep(2, motion_amount_function=ConstantMotionAmount(-QUARTER_TURN)),
    RotationStep(
        2, motion_amount_function=MotionAmountFromReading(1, -QUARTER_TURN)
    ),  # A1 of Table 1: theta - 90, alpha -90
    RotationStep(0, motion_amount_function=ConstantMotionAmount(-QUARTER_TURN)),
    *error_motions_of_kinematic_joint("J1"),
    RotationStep(2, motion_amount_function=MotionAmountFromReading(2, -QUARTER_TURN)),  # A2: phi - 90, alpha +90
    RotationStep(0, motion_amount_function=ConstantMotionAmount(QUARTER_TURN)),
    *error_motions_of_kinematic_joint("J2"),
    TranslationStep(2, motion_amount_function=MotionAmountFromReading(0)),  # A3: d, theta -90
    RotationStep(2, motion_amount_function=ConstantMotionAmount(-QUARTER_TURN)),
    *error_motions_of_kinematic_joint("T"),
)
"""The paper's Denavit-Hartenberg chain (Sensors 2021, 21, 7479, eq. 1 to 8) with all its error functions.

    0T3 = A1 E_Rot1 A2 E_Rot2 A3 E_Trans,   A = Tz(d) Rz(theta) Tx(a) Rx(alpha)
    E_Rot   = T(dX, dY, dZ) Rx(eX) Ry(eY) Rz(eZ)                        (eq. 2, with theta_RZ for eZ)
    E_Trans = T(dX, dY, dZ) (I + [e]_x)                                   (eq. 5)

0T3 is the transformation from the frame of the beam to the base. A_i is the transformation of kinematic joint i with
the Denavit-Hartenberg parameters d, theta, a and alpha. T are translations along and R rotations about the axes, [e]_x
is the cross-product matrix of (eX, eY, eZ). In the paper E comes after A: frame 1 has y along the standing axis and z
along the transit axis, so the azimuth encoder's error is J1.eY and the elevation encoder's J2.eY; the paper's words
"axial" and "radial" do not fit these frames. E_Trans is last and acts on a point, so that its rotation has no effect;
it is included so that the 78 coefficients of the paper are complete.

A coefficient is named by the kinematic joint (J1 azimuth, J2 elevation, T range), the error motion (translation d along
or rotation e about an axis of the frame after the joint) and the term of its error function: c, sin, cos, sin2 and cos2
for the constant and the first two harmonics of the joint's angle; 0, 1 and 2 for powers of the range.

Of the 78 coefficients 64 have an effect on a point: J2.eZ turns about the beam (5), T.eX, T.eY and T.eZ turn the point
about itself (9). Of the 64, 53 have distinct effects if stations and targets are known; the others repeat them:
J1.dZ_c = J2.dY_c = T.dX_0 (lateral beam offset), J2.dX_c = T.dY_0 (vertical beam offset), J2.dZ_c = T.dZ_0 (range
zero), J2.eX_c = T.dX_1 (beam tilt), J1.eZ_c = J2.eY_c = T.dY_1 (vertical index), J1.eX_c and J2.eX_sin (transit tilt),
J1.eY_c and J2.eX_cos (azimuth index), J1.dX_c with J2.dZ_cos and J2.dX_sin (transit offset), J1.dY_c with J2.dZ_sin and
J2.dX_cos (height of the transit axis). The pose of each station takes 6 more (height, yaw, one pair of first harmonics
each of position and tilt), which leaves 47; the range scale T.dZ_1 is the scale of the network if no length is known,
which leaves 46. `tests/physics/model/test_dh_count.py` counts them.

The paper's azimuth is zero on +Y. The chain starts with a fixed quarter turn, so that all chains use
one instrument frame (azimuth zero on +X); the harmonics are functions of the reading and do not change.
"""
