"""Orientations of an instrument's horizontal circle at one survey mark, detected from repeated pointings.

A surveyor may rotate the circle before each round. In a file without numbers of rounds, repeated pointings show this:
from a certain row on, the directions to all targets differ from the earlier ones by the same angle, and distances do
not change.
"""

import math

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.geometry.polar import wrap_angle

MIN_DETECTED_CIRCLE_ROTATION = 0.02
"""Limit of the common rotation [rad] of all directions. If it is exceeded, the user has rotated the horizontal circle;
a disturbed tripod rotates by less."""
MAX_REPEATED_DIRECTION_DIFFERENCE = 1e-3
"""Largest difference [rad] between two directions to one target that count as equal; also used for two elevations."""
MAX_REPEATED_DISTANCE_DIFFERENCE_M = 0.02
"""Limit of the difference [m] of two distances to one target. If it is exceeded, the target has moved between the two
pointings."""
MIN_TARGETS_SHOWING_CIRCLE_ROTATION = 3
"""Number of repeatedly measured targets whose directions must change by the same angle to show that the circle was
rotated."""
MAX_CONTRADICTORY_POINTING_FRACTION = 0.1
"""Largest fraction of repeated pointings that may contradict the detected orientations, as outliers.

If the fraction is larger, all pointings of the occupation are assigned to one orientation.
"""
MAX_ROWS_CONFIRMING_CIRCLE_ROTATION = 100
"""Number of rows after a suspected rotation of the circle in which `MIN_TARGETS_SHOWING_CIRCLE_ROTATION` targets must
confirm it."""


def circle_orientation_numbers(occupation: Ints, sight_number: Ints, readings: Floats) -> Ints | None:
    """Number (n,) of the orientation of the horizontal circle in each of n rows, from 0 in each occupation.

    The arguments are the number of the occupation in each row (n,), the number of the sight (n,), and the readings (n,
    3): distance, azimuth and elevation [m, rad, rad]. Rows have equal sight numbers if they have the same occupation,
    target and face. The result is None if no circle was rotated during an occupation. An occupation in which too many
    rows contradict each other (`MAX_CONTRADICTORY_POINTING_FRACTION`) has one orientation.
    """
    _, first_row_of_sight, code = np.unique(sight_number, return_index=True, return_inverse=True)
    change = readings - readings[first_row_of_sight[code]]
    rotations_from_first = wrap_angle(change[:, 1])
    is_moved = (np.abs(change[:, 0]) > MAX_REPEATED_DISTANCE_DIFFERENCE_M) | (
        np.abs(change[:, 2]) > MAX_REPEATED_DIRECTION_DIFFERENCE
    )
    rotations_from_first[is_moved | (first_row_of_sight[code] == np.arange(len(sight_number)))] = (
        np.nan
    )  # new targets, and those that moved
    turned_setups = np.unique(occupation[np.abs(rotations_from_first) > MIN_DETECTED_CIRCLE_ROTATION])
    orientation = np.zeros(len(occupation), dtype=np.int64)
    for number in turned_setups.tolist():
        rows = np.flatnonzero(occupation == number)
        local = np.searchsorted(rows, first_row_of_sight[code[rows]])
        orientation[rows] = _orientations_of_occupation(local.tolist(), rotations_from_first[rows].tolist())
    return orientation if orientation.any() else None


def circle_rotation_note(n_orientations: int, n_occupations: int) -> str:
    """Note for the user that horizontal circles were rotated, with the numbers of orientations and of occupations."""
    return (
        f"the horizontal circle was rotated between repeated pointings: the {n_orientations} orientations at "
        f"{n_occupations} occupations are treated as separate set-ups with the same positions"
    )


def _orientations_of_occupation(first_row_of_same_target: list[int], rotations_from_first: list[float]) -> list[int]:
    """Number of the circle's orientation in each row of one occupation, from 0.

    `first_row_of_same_target` is, for each row, the row of the first pointing to its target. `rotations_from_first` is
    the direction in each row minus the direction in that first row [rad], NaN in the first row itself. If too many rows
    contradict the detected orientations, all results are 0.
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
                ) > MIN_DETECTED_CIRCLE_ROTATION and _is_circle_rotation_confirmed(
                    row, first_row_of_same_target, rotations_from_first, circle_rotation, rotations, orientations
                ):
                    rotations.append(circle_rotation)
                else:
                    n_contradictory += 1
        orientations.append(len(rotations) - 1)
    return (
        orientations if n_contradictory <= MAX_CONTRADICTORY_POINTING_FRACTION * n_repeated else [0] * len(orientations)
    )


def _is_circle_rotation_confirmed(
    row: int,
    first_row_of_same_target: list[int],
    rotations_from_first: list[float],
    circle_rotation: float,
    rotations: list[float],
    orientations: list[int],
) -> bool:
    """True if targets measured after `row` confirm that the circle was rotated by `circle_rotation` [rad] at this row.

    `first_row_of_same_target` is, for each row of the occupation, the row of the first pointing to the same target.
    `rotations_from_first` is, for each row, the direction minus the direction in that first row [rad], NaN in the first
    row itself. `rotations` is the rotation [rad] of each orientation of the circle detected so far, `orientations` the
    number of the orientation in each earlier row.
    """
    agreeing = {first_row_of_same_target[row]}
    for later in range(row + 1, min(row + MAX_ROWS_CONFIRMING_CIRCLE_ROTATION, len(first_row_of_same_target))):
        first = first_row_of_same_target[later]
        if first >= row or first in agreeing or math.isnan(rotations_from_first[later]):
            continue
        if not _is_equal_direction(rotations_from_first[later] + rotations[orientations[first]], circle_rotation):
            return False
        agreeing.add(first)
        if len(agreeing) == MIN_TARGETS_SHOWING_CIRCLE_ROTATION:
            return True
    return False


def _is_equal_direction(angle: float, other_angle: float) -> bool:
    """True if two directions [rad] differ by less than `MAX_REPEATED_DIRECTION_DIFFERENCE`, apart from full circles."""
    return abs(_wrap_scalar_angle(angle - other_angle)) < MAX_REPEATED_DIRECTION_DIFFERENCE


def _wrap_scalar_angle(angle: float) -> float:
    """Angle [rad] between -pi and pi that is equal to `angle` except for full circles."""
    return math.remainder(angle, math.tau)
