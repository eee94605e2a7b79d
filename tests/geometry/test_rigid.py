"""Rigid motions, and which points hold a station."""

import numpy as np
import pytest

from ltsim.core.randomness import random_stream
from ltsim.geometry.rigid import determines_pose, matrix_from_rotation_vector, rigid_motion_jacobian


def test_rigid_motion_is_the_first_order_of_a_turn_and_a_shift() -> None:
    rng = random_stream(0, "rigid")
    points, centre, shift = rng.normal(0, 5, (7, 3)), rng.normal(0, 5, 3), rng.normal(0, 1, 3)
    turn = 1e-6 * rng.standard_normal(3)
    moved = (points - centre) @ matrix_from_rotation_vector(turn).T + centre + shift
    predicted = (rigid_motion_jacobian(points, centre) @ np.r_[shift, turn]).reshape(-1, 3)
    assert moved - points == pytest.approx(predicted, abs=1e-10)
    assert rigid_motion_jacobian(points) == pytest.approx(rigid_motion_jacobian(points + centre, centre))


POINTS = np.array([[0, 0, 0], [0, 0, 2], [0, 0, 5], [3, 0, 1], [1e-9, 0, 3], [0.01, 0, 4]], dtype=float) + 1e3
IS_DETERMINED = {
    (): (False, False),
    (0, 3): (False, True),
    (0, 1): (False, False),  # above one another
    (0, 1, 2): (False, False),
    (0, 1, 4): (False, False),  # off the line by a nanometre
    (0, 1, 5): (True, True),
    (0, 1, 3): (True, True),
}


@pytest.mark.parametrize("which", IS_DETERMINED)
@pytest.mark.parametrize("up", [np.array([0.0, 0.0, 1.0]), np.array([0.6, 0.0, 0.8])])
def test_three_targets_off_a_line_determine_a_station_and_two_a_levelled_station(which: tuple[int, ...], up) -> None:
    is_visible = np.zeros((2, 6), dtype=bool)
    is_visible[:, list(which)] = True
    turn = matrix_from_rotation_vector(np.arctan2(up[0], up[2]) * np.array([0.0, 1.0, 0.0]))
    held = determines_pose(POINTS @ turn.T, is_visible, np.array([[np.nan] * 3, up]))
    assert tuple(held) == IS_DETERMINED[which]
