"""Orientations of the horizontal circle within an occupation, from the readings alone.

A surveyor may set the circle anew before each round. In a file that does not number rounds, repeated pointings show it:
from one row on, the directions to all targets differ from the earlier ones by one angle, at equal distances.
"""

import math

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.geometry.polar import wrap_angle

MIN_ZEROED_ROTATION = 0.02
"""Smallest rotation [rad] that counts as a circle that was set anew; a disturbed tripod turns by less."""
MAX_DIRECTION_DIFFERENCE = 1e-3
"""Largest difference [rad] of directions, and of elevations, to one target in one orientation."""
MAX_DISTANCE_DIFFERENCE_M = 0.02
"""Largest difference [m] of the distances to one target from one occupation."""
MIN_AGREEING_TARGETS = 3
"""Number of repeated targets that must agree about a rotation."""
MAX_CONTRADICTORY_FRACTION = 0.1
"""Largest fraction of the repeated pointings of an occupation that may contradict its orientations: gross errors."""
MAX_ROWS_AHEAD = 100
"""Number of rows after a rotation in which these targets must be repeated."""


def circle_orientations(occupation: Ints, sight: Ints, readings: Floats) -> Ints | None:
    """Number (n,) of the orientation of each row within its occupation; None if no circle was set anew.

    `sight` (n,) numbers the pointings from one occupation to one target on one face, `readings` are (n, 3) [m, rad]. An
    occupation whose rows cannot all be assigned has one orientation.
    """
    _, first_row, code = np.unique(sight, return_index=True, return_inverse=True)
    change = readings - readings[first_row[code]]
    rotation = wrap_angle(change[:, 1])
    is_moved = (np.abs(change[:, 0]) > MAX_DISTANCE_DIFFERENCE_M) | (np.abs(change[:, 2]) > MAX_DIRECTION_DIFFERENCE)
    rotation[is_moved | (first_row[code] == np.arange(len(sight)))] = np.nan  # new targets, and those that moved
    turned_setups = np.unique(occupation[np.abs(rotation) > MIN_ZEROED_ROTATION])
    orientation = np.zeros(len(occupation), dtype=np.int64)
    for number in turned_setups.tolist():
        rows = np.flatnonzero(occupation == number)
        local = np.searchsorted(rows, first_row[code[rows]])
        orientation[rows] = _orientations_of_occupation(local.tolist(), rotation[rows].tolist())
    return orientation if orientation.any() else None


def zeroed_circle_note(n_orientations: int, n_occupations: int) -> str:
    """Note on occupations whose circle was set anew."""
    return (
        f"the circle was set anew between repeated pointings: {n_orientations} orientations at {n_occupations} "
        "occupations are separate set-ups at the same positions"
    )


def _orientations_of_occupation(first_row: list[int], rotation: list[float]) -> list[int]:
    """Orientation of each row of one occupation; zeros if too many rows contradict them.

    `first_row` is the row of the first pointing to the same target, `rotation` the difference [rad] between both
    directions, NaN for a first pointing.
    """
    rotations, numbers = [0.0], list[int]()
    n_repeated = n_contradictory = 0
    for row, first in enumerate(first_row):
        total = math.nan if first == row else rotation[row] + rotations[numbers[first]]
        if not math.isnan(total):
            n_repeated += 1
            if not _is_equal_direction(total, rotations[-1]):
                if abs(_wrap(total - rotations[-1])) > MIN_ZEROED_ROTATION and _is_confirmed(
                    row, first_row, rotation, total, rotations, numbers
                ):
                    rotations.append(total)
                else:
                    n_contradictory += 1
        numbers.append(len(rotations) - 1)
    return numbers if n_contradictory <= MAX_CONTRADICTORY_FRACTION * n_repeated else [0] * len(numbers)


def _is_confirmed(
    row: int, first_row: list[int], rotation: list[float], total: float, rotations: list[float], numbers: list[int]
) -> bool:
    """True if the next repeated targets agree about a rotation."""
    agreeing = {first_row[row]}
    for later in range(row + 1, min(row + MAX_ROWS_AHEAD, len(first_row))):
        first = first_row[later]
        if first >= row or first in agreeing or math.isnan(rotation[later]):
            continue
        if not _is_equal_direction(rotation[later] + rotations[numbers[first]], total):
            return False
        agreeing.add(first)
        if len(agreeing) == MIN_AGREEING_TARGETS:
            return True
    return False


def _is_equal_direction(angle: float, other_angle: float) -> bool:
    return abs(_wrap(angle - other_angle)) < MAX_DIRECTION_DIFFERENCE


def _wrap(angle: float) -> float:
    return math.remainder(angle, math.tau)
