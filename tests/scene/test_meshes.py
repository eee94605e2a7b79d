from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from ltsim.core.errors import InputError
from ltsim.scene.cad import read_cad_file
from ltsim.scene.meshes import (
    INSIDE_TEST_RAY_DIRECTION,
    N_CYLINDER_SIDES,
    Obstacles,
    box_triangles,
    count_ray_hits,
    cylinder_triangles,
    join_obstacles,
    nearest_points_on_triangles,
    rotate_and_shift_triangles,
)

CUBE = join_obstacles([rotate_and_shift_triangles(box_triangles(np.ones(3)), np.array([2.0, 0.0, 0.0]), 0.0)])


def blocked(start: tuple[float, float, float], end: tuple[float, float, float]) -> bool:
    return bool(CUBE.is_blocked(np.array([start]), np.array([end]))[0])


def test_a_box_hides_what_is_behind_it_only() -> None:
    assert blocked((0, 0, 0.5), (4, 0, 0.5))
    assert not blocked((0, 0, 0.5), (1.4, 0, 0.5))
    assert not blocked((0, 0, 1.5), (4, 0, 1.5))
    assert blocked((2, 0, 0.5), (4, 0, 0.5))


def test_a_reflector_on_the_surface_is_visible_from_its_side() -> None:
    assert not blocked((0, 0, 0.5), (1.5, 0, 0.5))
    assert blocked((4, 0, 0.5), (1.5, 0, 0.5))


@pytest.mark.parametrize("gap", [1e-3, 1e-5, 1e-7])
def test_grazing_rays_are_decided_in_double_precision(gap: float) -> None:
    """Embree's single precision cannot tell 0.1 um at 1 m from 0; the second cast does."""
    assert not blocked((0, 0.2, 1.0 + gap), (4, 0.2, 1.0 + gap))
    assert blocked((0, 0.2, 1.0 - gap), (4, 0.2, 1.0 - gap))
    assert not blocked((0, 0.5 + gap, 0.3), (4, 0.5 + gap, 0.3))
    assert blocked((0, 0.5 - gap, 0.3), (4, 0.5 - gap, 0.3))


def test_embree_and_double_precision_agree_on_a_curved_body() -> None:
    body = Obstacles(np.array(trimesh.creation.icosphere(subdivisions=3).triangles))
    rng = np.random.default_rng(2)
    start, end = rng.uniform(-3, 3, (3000, 3)), rng.uniform(-3, 3, (3000, 3))
    start *= np.maximum(1.01 / np.linalg.norm(start, axis=1), 1.0)[:, None]
    end *= np.maximum(1.01 / np.linalg.norm(end, axis=1), 1.0)[:, None]
    length = np.linalg.norm(end - start, axis=1)
    native = count_ray_hits(body.triangles, start, (end - start) / length[:, None], length) > 0
    assert 100 < native.sum() < 2900
    np.testing.assert_array_equal(body.is_blocked(start, end), native)
    places, up = start / 2.0, np.broadcast_to(INSIDE_TEST_RAY_DIRECTION, start.shape)
    slowly = count_ray_hits(body.triangles, places, up, np.full(len(places), np.inf)) % 2 == 1
    assert 100 < slowly.sum() < 2900
    np.testing.assert_array_equal(body.is_inside_body(places), slowly)


def test_bodies_and_their_nearest_points_are_those_of_trimesh() -> None:
    """In the same order, too: places of nests are drawn by it."""
    size, radius = np.array([1.0, 2.0, 3.0]), 0.5 / np.cos(np.pi / N_CYLINDER_SIDES)
    peer = trimesh.creation.cylinder(radius=radius, height=2.0, sections=N_CYLINDER_SIDES)
    for triangles, theirs in (
        (box_triangles(size), trimesh.creation.box(extents=size)),
        (cylinder_triangles(1.0, 2.0), peer),
    ):
        np.testing.assert_allclose(triangles, theirs.triangles - [0.0, 0.0, theirs.bounds[0, 2]], atol=1e-12)
        for point in np.random.default_rng(4).uniform(-3, 3, (50, 3)):
            expected = trimesh.triangles.closest_point(triangles, np.tile(point, (len(triangles), 1)))
            np.testing.assert_allclose(nearest_points_on_triangles(triangles, point), expected, atol=1e-9)


def test_a_point_of_a_hollow_cylinder_is_on_its_triangles_that_lie_off_it() -> None:
    """Inside of a tube of 24 flat sides, the true bore lies up to 13 mm behind them."""
    tube = Obstacles(np.array(trimesh.creation.annulus(r_min=1.5, r_max=2.0, height=10.0, sections=24).triangles))
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    bore = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    middle, on, deep = np.zeros_like(bore), tube.moved_to_surface(1.5 * bore), tube.moved_to_surface(1.6 * bore)
    assert not tube.is_blocked(middle, on).any()
    assert tube.is_blocked(3.0 * bore, on).all()
    np.testing.assert_allclose(on, 1.5 * bore, atol=0.0131)
    np.testing.assert_array_equal(deep, 1.6 * bore)
    assert tube.is_blocked(middle, deep).all()


def test_no_station_stands_inside_or_with_its_tripod_through_something() -> None:
    heads = np.array([[2.0, 0.0, 0.5], [2.0, 0.0, 1.8], [2.0, 0.6, 1.8], [0.0, 0.0, 1.8]])
    assert CUBE.is_setup_inside_body(heads).tolist() == [True, True, False, False]


def test_turned_and_moved() -> None:
    turned = join_obstacles(
        [rotate_and_shift_triangles(box_triangles(np.array([4.0, 0.2, 2.0])), np.array([1.0, 1.0, 0.0]), np.pi / 2)]
    )
    assert turned.is_blocked(np.array([[0.0, 2.5, 1.0]]), np.array([[2.0, 2.5, 1.0]])).all()
    assert not turned.is_blocked(np.array([[1.5, -3.0, 1.0]]), np.array([[1.5, 4.0, 1.0]])).any()


def test_the_same_hall_is_built_once() -> None:
    """Its rays take 600 bytes a triangle, and every step of a plan asks for it."""
    column, table = box_triangles(np.array([0.3, 0.3, 3.0])), box_triangles(np.array([2.0, 1.0, 0.8]))
    hall = join_obstacles([column, table])
    assert join_obstacles([column.copy(), table]) is hall
    assert join_obstacles([column, table], body_names=("column", "table")) is not hall
    assert len(join_obstacles([column]).triangles) == len(column)
    with pytest.raises(ValueError, match="read-only"):
        hall.triangles[0] = 0.0


def test_nothing_blocks_nothing() -> None:
    empty = join_obstacles([])
    assert not empty.is_blocked(np.zeros((2, 3)), np.ones((2, 3))).any()
    assert not empty.is_setup_inside_body(np.zeros((2, 3))).any()


@pytest.mark.parametrize("suffix", ["stl", "obj", "glb", "ply"])
def test_cad_files_give_the_same_triangles(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"part.{suffix}"
    trimesh.creation.box(extents=(1000, 2000, 500)).export(path)
    triangles = read_cad_file(path, "mm", "z").triangles
    assert triangles.shape == (12, 3, 3)
    np.testing.assert_allclose(np.ptp(triangles.reshape(-1, 3), axis=0), [1.0, 2.0, 0.5], atol=1e-7)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("part.stl", b"", "part.stl"),
        ("part.glb", b"glTF but cut", "is not a complete glb file"),
        ("part.ply", b"no header at all", "is not a complete ply file"),
        ("part.obj", b"v 0 0 0\nv 1 0 0\n", "part.obj"),
    ],
)
def test_damaged_files_are_refused_in_a_sentence(name: str, content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        read_cad_file(path, "mm", "z")
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gone\.stl: the file cannot be read"):
        read_cad_file(tmp_path / "gone.stl", "mm")
