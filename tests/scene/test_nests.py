"""Places for nests on CAD: on the surface, outside, apart, and only where the surface carries one."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.core.arrays import Floats
from ltsim.scene.meshes import (
    box_triangles,
    candidate_nest_positions,
    cylinder_triangles,
    join_obstacles,
    wall_triangles,
)

SIZE = np.array([2.5, 1.5, 2.2])


@pytest.mark.parametrize(
    "triangles", [box_triangles(SIZE), box_triangles(SIZE)[:, ::-1]], ids=["wound out", "wound in"]
)
def test_places_on_a_box_lie_outside_on_its_faces_at_a_distance(triangles: Floats) -> None:
    places = candidate_nest_positions(triangles, 0.04, 0.4)
    beyond = np.maximum(np.abs(places - [0, 0, SIZE[2] / 2]) - SIZE / 2, 0)
    assert np.linalg.norm(beyond, axis=1) == pytest.approx(0.04)
    assert places[:, 2].min() > 0.02
    gap = np.linalg.norm(places[:, None] - places[None], axis=2)
    assert gap[np.triu_indices(len(places), 1)].min() >= 0.4
    sides = {(int(axis), bool(places[i, axis] > 0)) for i, axis in enumerate(beyond.argmax(axis=1))}
    assert sides == {(0, True), (0, False), (1, True), (1, False), (2, True)}
    within = np.abs(places - [0, 0, SIZE[2] / 2]) < SIZE / 2 - 0.024
    assert np.all(within.sum(axis=1) == 2), "a foot does not reach over an edge"
    assert np.array_equal(places, candidate_nest_positions(triangles, 0.04, 0.4))


def test_a_thin_pole_carries_no_nest_and_a_wide_pole_does() -> None:
    assert not len(candidate_nest_positions(cylinder_triangles(0.04, 0.05), 0.04, 0.2))
    places = candidate_nest_positions(cylinder_triangles(1.0, 2.0), 0.04, 0.3)
    assert len(places) > 10
    assert np.hypot(*places[places[:, 2] < 1.9, :2].T) == pytest.approx(0.54, abs=2e-3)


def test_walls_hold_nests_inside_the_room_and_not_in_what_stands_there() -> None:
    size = np.array([12.0, 8.0, 5.0])
    cupboard = join_obstacles([box_triangles(np.array([3.0, 3.0, 3.0]))])
    places = candidate_nest_positions(wall_triangles(size), 0.04, 0.5, cupboard, is_closed=False)
    assert np.all((places > 0) & (places < size))
    assert np.minimum(places, size - places)[:, :2].min(axis=1) == pytest.approx(0.04)
    assert not cupboard.is_inside_body(places).any()
    assert len(candidate_nest_positions(wall_triangles(size), 0.04, 0.5, is_closed=False)) > len(places)
