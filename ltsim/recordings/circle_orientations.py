"""Orientations of the horizontal circle while an instrument occupies a point, from the readings alone.

A surveyor may set the circle anew before each round. In a file that does not number rounds, repeated pointings show it:
from one row on, the directions to all targets differ from the earlier ones by the same angle, and distances are equal.
"""

import math

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.geometry.polar import wrap_angle

MIN_CIRCLE_RESET_ROTATION = 0.02
"""Rotation [rad] of all directions above which the circle counts as rotated. A disturbed tripod rotates by less."""
MAX_DIRECTION_DIFFERENCE = 1e-3
"""Difference [rad] of two directions, or two elevations, to one target below which they count as equal."""
MAX_DISTANCE_DIFFERENCE_M = 0.02
"""Difference [m] of two distances to one target above which the target counts as moved."""
MIN_AGREEING_TARGETS = 3
"""Number of repeated targets whose directions must change by the same rotation before the circle counts as rotated."""
MAX_CONTRADICTORY_FRACTION = 0.1
"""Largest fraction of the repeated pointings of an occupation that may contradict its orientations, as outliers.

Above this fraction all pointings of the occupation keep a single orientation.
"""
MAX_CONFIRMATION_ROWS = 100
"""Number of rows after a rotation within which `MIN_AGREEING_TARGETS` targets must be measured again to confirm it."""


def circle_orientations(occupation: Ints, sight_number: Ints, readings: Floats) -> Ints | None:
    """Number (n,) of the orientation of the horizontal circle in each of n rows, counted within its occupation.

    The result is None if no circle was rotated within an occupation. `occupation` (n,) is the number of the occupation
    in each row. `sight_number` (n,) is equal for all pointings from one occupation to one target on one face.
    `readings` (n, 3) are distance, azimuth and elevation [m, rad, rad]. An occupation with too many contradictory rows
    (`MAX_CONTRADICTORY_FRACTION`) counts as one orientation.
    """
    _, first_row_of_sight, code = np.unique(sight_number, return_index=True, return_inverse=True)
    change = readings - readings[first_row_of_sight[code]]
    rotations_from_first = wrap_angle(change[:, 1])
    is_moved = (np.abs(change[:, 0]) > MAX_DISTANCE_DIFFERENCE_M) | (np.abs(change[:, 2]) > MAX_DIRECTION_DIFFERENCE)
    rotations_from_first[is_moved | (first_row_of_sight[code] == np.arange(len(sight_number)))] = (
        np.nan
    )  # new targets, and those that moved
    turned_setups = np.unique(occupation[np.abs(rotations_from_first) > MIN_CIRCLE_RESET_ROTATION])
    orientation = np.zeros(len(occupation), dtype=np.int64)
    for number in turned_setups.tolist():
        rows = np.flatnonzero(occupation == number)
        local = np.searchsorted(rows, first_row_of_sight[code[rows]])
        orientation[rows] = _orientations_of_occupation(local.tolist(), rotations_from_first[rows].tolist())
    return orientation if orientation.any() else None


def circle_rotation_note(n_orientations: int, n_occupations: int) -> str:
    """Note to the user that the circle was rotated: `n_orientations` orientations at `n_occupations` occupations."""
    return (
        f"the horizontal circle was rotated between repeated pointings: {n_orientations} orientations at "
        f"{n_occupations} occupations are separate set-ups at the same positions"
    )


def _orientations_of_occupation(first_row_of_same_target: list[int], rotations_from_first: list[float]) -> list[int]:
    """Number of the orientation of the circle in each row of one occupation.

    All numbers are 0 if too many rows contradict the orientations. `first_row_of_same_target` holds, for each row, the
    row of the first pointing to the same target. `rotations_from_first` is the direction in a row minus the direction
    in that first row [rad], NaN for a first pointing.
    """
    rotations, orientations = [0.0], list[int]()
    n_repeated = n_contradictory = 0
    for row, first in enumerate(first_row_of_same_target):
        circle_rotation = math.nan if first == row else rotations_from_first[row] + rotations[orientations[first]]
        if not math.isnan(circle_rotation):
            n_repeated += 1
            if not _is_equal_direction(circle_rotation, rotations[-1]):
                if abs(
                    _wrap_scalar_angle(circle_rotation - rotations[-1])
                ) > MIN_CIRCLE_RESET_ROTATION and _is_confirmed(
                    row, first_row_of_same_target, rotations_from_first, circle_rotation, rotations, orientations
                ):
                    rotations.append(circle_rotation)
                else:
                    n_contradictory += 1
        orientations.append(len(rotations) - 1)
    return orientations if n_contradictory <= MAX_CONTRADICTORY_FRACTION * n_repeated else [0] * len(orientations)


def _is_confirmed(
    row: int,
    first_row_of_same_target: list[int],
    rotations_from_first: list[float],
    circle_rotation: float,
    rotations: list[float],
    orientations: list[int],
) -> bool:
    """True if the next repeated targets confirm that the circle was rotated by `circle_rotation` [rad] at `row`.

    `rotations` holds the rotation [rad] of each earlier orientation, `orientations` the number of the orientation of
    each earlier row.
    """
    agreeing = {first_row_of_same_target[row]}
    for later in range(row + 1, min(row + MAX_CONFIRMATION_ROWS, len(first_row_of_same_target))):
        first = first_row_of_same_target[later]
        if first >= row or first in agreeing or math.isnan(rotations_from_first[later]):
            continue
        if not _is_equal_direction(rotations_from_first[later] + rotations[orientations[first]], circle_rotation):
            return False
        agreeing.add(first)
        if len(agreeing) == MIN_AGREEING_TARGETS:
            return True
    return False


def _is_equal_direction(angle: float, other_angle: float) -> bool:
    return abs(_wrap_scalar_angle(angle - other_angle)) < MAX_DIRECTION_DIFFERENCE


def _wrap_scalar_angle(angle: float) -> float:
    """Angle [rad] plus the multiple of a full circle with which it lies between -pi and pi."""
    return math.remainder(angle, math.tau)
