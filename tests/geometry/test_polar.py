from __future__ import annotations

import numpy as np
from hypothesis import given, strategies as st

from ltsim.core.arrays import Floats, Ints
from ltsim.geometry.polar import (
    beam_frame_axes,
    from_polar,
    polar_jacobian,
    swap_front_and_raw,
    to_polar,
    wrap_angle,
)

pointings = st.tuples(st.floats(0.5, 40), st.floats(-3.14, 3.14), st.floats(-1.5, 1.5), st.sampled_from([1, 2]))
many = st.lists(pointings, min_size=1, max_size=6)


def split(rows: list[tuple[float, float, float, int]]) -> tuple[Floats, Ints]:
    table = np.array(rows, dtype=np.float64)
    return table[:, :3], table[:, 3].astype(np.int64)


@given(many)
def test_polar_and_cartesian_are_inverse(rows: list[tuple[float, float, float, int]]) -> None:
    polar, _ = split(rows)
    np.testing.assert_allclose(to_polar(from_polar(polar)), polar, atol=1e-13)


@given(many)
def test_both_faces_see_the_same_point(rows: list[tuple[float, float, float, int]]) -> None:
    polar, face = split(rows)
    raw = swap_front_and_raw(polar, face)
    np.testing.assert_allclose(from_polar(raw), from_polar(polar), atol=1e-12)
    np.testing.assert_allclose(swap_front_and_raw(raw, face), polar, atol=1e-13)


def test_the_back_face_turns_half_round_and_over() -> None:
    raw = swap_front_and_raw(np.array([[5.0, 0.5, 0.2]]), np.array([2]))
    np.testing.assert_allclose(raw, [[5.0, 0.5 - np.pi, np.pi - 0.2]])


def test_the_axes_are_where_the_frame_puts_them() -> None:
    forward, lateral, up = np.eye(3)
    np.testing.assert_allclose(
        to_polar(np.array([forward, lateral, up])), [[1, 0, 0], [1, np.pi / 2, 0], [1, 0, np.pi / 2]]
    )


@given(st.floats(-50, 50))
def test_wrap_keeps_the_direction(angle: float) -> None:
    wrapped = wrap_angle(np.array([angle]))[0]
    assert -np.pi < wrapped <= np.pi
    np.testing.assert_allclose([np.cos(wrapped), np.sin(wrapped)], [np.cos(angle), np.sin(angle)], atol=1e-13)


@given(many)
def test_beam_lateral_and_up_are_a_right_handed_frame(rows: list[tuple[float, float, float, int]]) -> None:
    polar, _ = split(rows)
    beam, lateral, up = beam_frame_axes(polar[:, 1], polar[:, 2])
    np.testing.assert_allclose(beam * polar[:, :1], from_polar(polar), atol=1e-12)
    np.testing.assert_allclose(np.cross(beam, lateral), up, atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(lateral, axis=1), 1.0, atol=1e-14)


@given(many)
def test_derivative_of_the_readings_by_the_point(rows: list[tuple[float, float, float, int]]) -> None:
    polar, face = split(rows)
    points, step = from_polar(polar), 1e-6 * np.cos(polar[:, 2]) * polar[:, 0]
    numeric = np.empty((len(polar), 3, 3))
    for axis in range(3):
        move = step[:, None] * np.eye(3)[axis]
        change = swap_front_and_raw(to_polar(points + move), face) - swap_front_and_raw(to_polar(points - move), face)
        change[:, 1] = wrap_angle(change[:, 1])
        numeric[:, :, axis] = change / (2 * step[:, None])
    analytic = polar_jacobian(polar, face)
    scale = np.max(np.abs(analytic), axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(numeric / scale, analytic / scale, atol=1e-7)
