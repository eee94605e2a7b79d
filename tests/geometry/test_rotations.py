from __future__ import annotations

import numpy as np
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays

from ltsim.core.arrays import Floats
from ltsim.geometry.rigid import cross_matrix, matrix_from_rotation_vector, quaternion_from_matrix, rotation_about_z

IDENTITY = np.broadcast_to(np.eye(3), (4, 3, 3))
vectors = arrays(np.float64, (4, 3), elements=st.floats(-3, 3))


@given(vectors, vectors)
def test_cross_matrix_times_vector_is_the_cross_product(a: Floats, b: Floats) -> None:
    product = np.einsum("nij,nj->ni", cross_matrix(a), b)
    np.testing.assert_allclose(product, np.cross(a, b), atol=1e-14)


@given(vectors)
def test_rotations_keep_lengths_handedness_and_their_axis(vector: Floats) -> None:
    turn = matrix_from_rotation_vector(vector)
    np.testing.assert_allclose(turn @ np.swapaxes(turn, 1, 2), IDENTITY, atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(turn), 1.0, atol=1e-14)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", turn, vector), vector, atol=1e-13)


@given(vectors)
def test_the_opposite_vector_turns_back(vector: Floats) -> None:
    there_and_back = matrix_from_rotation_vector(-vector) @ matrix_from_rotation_vector(vector)
    np.testing.assert_allclose(there_and_back, IDENTITY, atol=1e-14)


@given(arrays(np.float64, 3, elements=st.floats(-1e-5, 1e-5)))
def test_a_small_rotation_is_the_cross_matrix(vector: Floats) -> None:
    np.testing.assert_allclose(matrix_from_rotation_vector(vector), np.eye(3) + cross_matrix(vector), atol=1e-9)


@given(st.floats(-7, 7))
def test_about_z_is_counter_clockwise_from_above(angle: float) -> None:
    np.testing.assert_allclose(
        rotation_about_z(angle), matrix_from_rotation_vector(np.array([0.0, 0.0, angle])), atol=1e-14
    )
    np.testing.assert_allclose(rotation_about_z(angle) @ [1.0, 0.0, 0.0], [np.cos(angle), np.sin(angle), 0.0])


@given(arrays(np.float64, 3, elements=st.floats(-3, 3)))
def test_quaternion_is_of_unit_length_and_describes_the_rotation(vector: Floats) -> None:
    matrix = matrix_from_rotation_vector(vector)
    x, y, z, w = quaternion_from_matrix(matrix)
    axis, length = np.array([x, y, z]), np.linalg.norm([x, y, z, w])
    rebuilt = (2 * w * w - 1) * np.eye(3) + 2 * np.outer(axis, axis) + 2 * w * cross_matrix(axis)
    np.testing.assert_allclose(length, 1.0, atol=1e-14)
    np.testing.assert_allclose(rebuilt, matrix, atol=1e-14)
