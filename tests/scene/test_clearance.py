"""Bodies stay outside the cylinder of a stand, between the floor and its instrument."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.core.arrays import Floats
from ltsim.scene.clearance import StandClearance
from ltsim.scene.meshes import Obstacles, box_triangles, cylinder_triangles, join_obstacles, rotate_and_shift_triangles


def box(lengths: list[float], centre: list[float], yaw: float = 0.0) -> Floats:
    triangles = box_triangles(np.array(lengths))
    low = triangles[:, :, 2].min()
    return rotate_and_shift_triangles(triangles, np.array(centre) - [0.0, 0.0, low + 0.5 * lengths[2]], yaw)


MACHINE = join_obstacles([box([2.0, 1.0, 1.8], [0.0, 0.0, 0.9])], body_names=["machine"])


@pytest.mark.parametrize(
    ("x", "y", "has_room"),
    [(1.005, 0.0, False), (1.399, 0.0, False), (1.401, 0.0, True), (1.28, 0.78, False), (1.29, 0.79, True)],
)
def test_distance_from_a_machine_is_horizontal_and_round_at_its_corner(x: float, y: float, has_room: bool) -> None:
    clearance = StandClearance(MACHINE, 0.4)
    assert clearance.has_room(np.array([[x, y, 1.5], [x, y, 2.5]])).tolist() == [has_room, has_room]
    distance, name = clearance.nearest_body(np.array([x, y, 1.5]))
    expected = np.hypot(max(x - 1.0, 0.0), max(y - 0.5, 0.0))
    assert (distance, name) == ((np.inf, "") if has_room else (pytest.approx(expected), "machine"))


def test_bodies_above_the_instrument_and_the_floor_itself_do_not_matter() -> None:
    gallery, floor = box([4.0, 4.0, 0.2], [0.0, 0.0, 2.5]), box([9.0, 9.0, 0.1], [0.0, 0.0, -0.05])
    clearance = StandClearance(join_obstacles([gallery, floor]), 0.4)
    heads = np.array([[0.0, 0.0, 1.5], [0.0, 0.0, 2.45], [2.1, 0.0, 2.3], [2.1, 0.0, 3.0], [2.5, 0.0, 3.0]])
    assert clearance.has_room(heads).tolist() == [True, False, True, False, True]


def test_no_radius_no_triangles_and_no_stands() -> None:
    inside = np.array([[1.005, 0.0, 1.5]])
    assert StandClearance(MACHINE, 0.0).has_room(inside).all()
    assert StandClearance(Obstacles(np.zeros((0, 3, 3))), 0.4).has_room(inside).all()
    assert StandClearance(MACHINE, 0.4).has_room(np.zeros((0, 3))).shape == (0,)


def test_distances_are_those_of_sampled_points_of_all_triangles() -> None:
    shapes = [
        box([1.0, 2.0, 2.0], [0.0, 0.0, 1.0], 0.3),
        box([0.2, 3.0, 0.1], [2.0, 0.0, 0.8], 0.1),
        rotate_and_shift_triangles(cylinder_triangles(0.1, 1.2), np.array([3.0, 3.0, 0.0]), 0.0),
        np.array([[[-3.0, -3.0, 0.2], [-1.0, -3.5, 2.9], [-2.0, -1.0, 2.0]]]),
    ]
    body, rng = join_obstacles(shapes), np.random.default_rng(1)
    clearance = StandClearance(body, 0.4)
    heads = np.column_stack([rng.uniform(-4.0, 4.0, (300, 2)), rng.uniform(0.3, 3.0, 300)])
    weights = rng.dirichlet(np.ones(3), 3000)
    samples = np.einsum("kc,tcx->tkx", weights, body.triangles).reshape(-1, 3)
    bodies = np.array([clearance.nearest_body(head)[0] for head in heads])
    assert np.isfinite(bodies).sum() > 30
    np.testing.assert_array_equal(clearance.has_room(heads), ~np.isfinite(bodies))
    for head, distance in zip(heads, bodies, strict=True):
        below = samples[(samples[:, 2] > 0.0) & (samples[:, 2] < head[2]), :2]
        sampled = np.linalg.norm(below - head[:2], axis=1).min(initial=9.0)
        assert min(distance, 0.4) == pytest.approx(min(sampled, 0.4), abs=0.03)
