"""Kinematic chains: a tracker as a sequence of elementary motions, exact, with exact derivatives.

A chain is a list of motions from the base outwards: a turn about z by the azimuth, a shift along x by the transit
offset, and so on. The target sits at the origin of the last frame. An instrument error is added to the nominal amount
of a motion. The motion's `slot` is the key of this error in the mapping `errors`. The derivative of the point with
respect to the error of a translation is the direction of its axis in the base frame. For a rotation it is the cross
product of the axis and the vector from the axis to the target.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltsim.core.arrays import Floats

NominalFunction = Callable[[Floats], Floats]
"""Function from raw readings (n, 3) to the nominal angle [rad] or length [m] (n,) of a motion."""


@dataclass(frozen=True)
class RotationStep:
    """Rotation by the angle ``nominal(raw) + error[slot]`` [rad] about a coordinate axis (0, 1, 2)."""

    axis: int
    """Index of the coordinate axis."""
    slot: str = ""
    """Name of the slot for its error; empty for none."""
    nominal: NominalFunction | None = None
    """Nominal angle as a function of the readings; None for zero."""
    sign: float = 1.0
    """Sign of the angle."""


@dataclass(frozen=True)
class TranslationStep:
    """Translation by the length ``nominal(raw) + error[slot]`` [m] along a coordinate axis (0, 1, 2)."""

    axis: int
    """Index of the coordinate axis."""
    slot: str = ""
    """Name of the slot for its error; empty for none."""
    nominal: NominalFunction | None = None
    """Nominal length as a function of the readings; None for zero."""
    sign: float = 1.0
    """Sign of the length."""


ElementaryMotion = RotationStep | TranslationStep
KinematicChain = tuple[ElementaryMotion, ...]
"""Kinematic chain: elementary motions from the base outwards."""


@dataclass(frozen=True)
class ConstantAmount:
    """Nominal amount of a motion that does not depend on the readings."""

    value: float

    def __call__(self, raw_readings: Floats) -> Floats:
        """The constant amount (n,) for raw readings (n, 3)."""
        return np.full(len(raw_readings), self.value)


@dataclass(frozen=True)
class ReadingAmount:
    """Nominal amount of a motion that is a raw reading (0 range, 1 azimuth, 2 elevation) plus `offset`."""

    column: int
    offset: float = 0.0

    def __call__(self, raw_readings: Floats) -> Floats:
        """The selected reading plus `offset`, (n,), of raw readings (n, 3)."""
        return raw_readings[:, self.column] + self.offset


def _motion_amount(
    elementary_motion: ElementaryMotion, raw_readings: Floats, errors: Mapping[str, Floats]
) -> Floats | None:
    """Signed angle [rad] or length [m] of a motion, nominal amount plus error, (n,) or a number; None for no motion."""
    amount = None if elementary_motion.nominal is None else elementary_motion.nominal(raw_readings)
    error = errors.get(elementary_motion.slot)
    if error is not None:
        amount = error if amount is None else amount + error
    return None if amount is None else elementary_motion.sign * amount


def _rotate(axis: int, angle: Floats, *vectors: Floats) -> None:
    """Rotation in place of vectors (..., n, 3) about a coordinate axis by angles (n,)."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    c, s = np.cos(angle), np.sin(angle)
    for v in vectors:
        v[..., i], v[..., j] = c * v[..., i] - s * v[..., j], s * v[..., i] + c * v[..., j]


def point_of_readings(chain: KinematicChain, raw_readings: Floats, errors: Mapping[str, Floats]) -> Floats:
    """Point (n, 3) [m] of raw readings (n, 3).

    `errors` has the error of each slot [rad or m], as an array (n,) or one number. A missing slot has no error.
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


def point_and_derivatives(
    chain: KinematicChain, raw_readings: Floats, errors: Mapping[str, Floats], error_slots: set[str]
) -> tuple[Floats, dict[str, Floats]]:
    """Point (n, 3) [m] of raw readings (n, 3), and its derivative (n, 3) with respect to the error of each slot.

    The dictionary of derivatives has one entry for each slot in `error_slots` that the chain contains. The computation
    starts at the target and applies the motions towards the base. Point and derivatives are vectors of
    the current frame: a rotation turns all of them, a translation moves the point alone.
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
            _rotate(motion.axis, amount, p, derivative_buffer[:count])
        if motion.slot not in error_slots:
            continue
        if motion.slot not in derivatives:
            derivatives[motion.slot] = derivative_buffer[count]
            count += 1
        derivative = derivatives[motion.slot]
        if isinstance(motion, TranslationStep):
            derivative[:, motion.axis] += motion.sign
        else:
            i, j = (motion.axis + 1) % 3, (motion.axis + 2) % 3
            derivative[:, i] -= motion.sign * p[:, j]
            derivative[:, j] += motion.sign * p[:, i]
    return p, derivatives
