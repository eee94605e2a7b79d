"""The paper's Denavit-Hartenberg chain (Sensors 2021, 21, 7479, eq. 1 to 8) with all its error functions.

    0T3 = A1 E_Rot1 A2 E_Rot2 A3 E_Trans,   A = Tz(d) Rz(theta) Tx(a) Rx(alpha)
    E_Rot   = T(dX, dY, dZ) Rx(eX) Ry(eY) Rz(eZ)                        (eq. 2; theta_RZ there is our eZ)
    E_Trans = T(dX, dY, dZ) (I + [e]_x)                                   (eq. 5)

In the printed form E follows the complete A: frame 1 has y along the standing axis and z along the transit axis, so the
azimuth encoder's error is J1.eY and the elevation encoder's J2.eY; the paper's words "axial" and "radial" do not fit
these frames. E_Trans is last and acts on a point, so that its rotation has no effect; it is included so that the 78
coefficients of the paper are complete.

Of the 78 coefficients 64 have an effect on a point: J2.eZ turns about the beam (5), T.eX, T.eY and T.eZ turn the point
about itself (9). Of these, 53 differ even where stations and targets are known; the others repeat them: J1.dZ_c =
J2.dY_c = T.dX_0 (lateral beam offset), J2.dX_c = T.dY_0 (vertical beam offset), J2.dZ_c = T.dZ_0 (range zero), J2.eX_c
= T.dX_1 (beam tilt), J1.eZ_c = J2.eY_c = T.dY_1 (vertical index), J1.eX_c and J2.eX_sin (transit tilt), J1.eY_c and
J2.eX_cos (azimuth index), J1.dX_c with J2.dZ_cos and J2.dX_sin (transit offset), J1.dY_c with J2.dZ_sin and J2.dX_cos
(height of the transit axis). The pose of each station takes 6 more (height, yaw, one pair of first harmonics each of
place and tilt), which leaves 47; the range scale T.dZ_1 is the scale of the network where no length is known, which
leaves 46. `tests/physics/model/test_dh_count.py` counts them.

The paper's azimuth is zero on +Y. The chain starts with a fixed quarter turn, so that both constructions use
one instrument frame (azimuth zero on +X); the harmonics are functions of the reading and do not change.
"""

from ltsim.core.units import QUARTER_TURN
from ltsim.geometry.kinematics.chain import (
    ConstantAmount,
    ElementaryMotion,
    KinematicChain,
    ReadingAmount,
    RotationStep,
    TranslationStep,
)


def joint_error_motions(joint_name: str) -> tuple[ElementaryMotion, ...]:
    """Error matrix E_Rot of a joint as six elementary motions, for joint J1 with slots ``J1.dX`` to ``J1.eZ``."""
    shifts = tuple(TranslationStep(i, f"{joint_name}.d{axis}") for i, axis in enumerate("XYZ"))
    turns = tuple(RotationStep(i, f"{joint_name}.e{axis}") for i, axis in enumerate("XYZ"))
    return shifts + turns


DH_CHAIN: KinematicChain = (
    RotationStep(2, nominal=ConstantAmount(-QUARTER_TURN)),
    RotationStep(2, nominal=ReadingAmount(1, -QUARTER_TURN)),  # A1 of Table 1: theta - 90, alpha -90
    RotationStep(0, nominal=ConstantAmount(-QUARTER_TURN)),
    *joint_error_motions("J1"),
    RotationStep(2, nominal=ReadingAmount(2, -QUARTER_TURN)),  # A2: phi - 90, alpha +90
    RotationStep(0, nominal=ConstantAmount(QUARTER_TURN)),
    *joint_error_motions("J2"),
    TranslationStep(2, nominal=ReadingAmount(0)),  # A3: d, theta -90
    RotationStep(2, nominal=ConstantAmount(-QUARTER_TURN)),
    *joint_error_motions("T"),
)
