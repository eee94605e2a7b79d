"""Rotation matrices (3 x 3) in batches; small rotations as rotation vectors."""

import numpy as np

from ltsim.core.arrays import Floats

VERTICAL = np.array([0.0, 0.0, 1.0])
"""Unit vector of the vertical in the network frame."""


def cross_matrix(vectors: Floats) -> Floats:
    """Matrices (..., 3, 3) with ``cross_matrix(v) @ w = v x w`` for vectors (..., 3)."""
    x, y, z = (vectors[..., k] for k in range(3))
    matrix = np.zeros((*vectors.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -z, y, -x
    matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1] = z, -y, x
    return matrix


def perpendicular_vectors(vectors: Floats) -> tuple[Floats, Floats]:
    """Two unit vectors (n, 3) that are perpendicular to each of the given unit vectors (n, 3) and to each other."""
    helper = np.where(np.abs(vectors[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first_perpendicular = np.cross(vectors, helper)
    first_perpendicular /= np.linalg.norm(first_perpendicular, axis=1, keepdims=True)
    return first_perpendicular, np.cross(vectors, first_perpendicular)


def from_rotation_vector(vectors: Floats) -> Floats:
    """Rotation matrices (..., 3, 3) from rotation vectors (..., 3) [rad]."""
    from scipy.spatial.transform import Rotation  # slow to load

    return Rotation.from_rotvec(vectors).as_matrix()


def rotation_about_z(angle: float) -> Floats:
    """Rotation by `angle` [rad] about the z axis, counter-clockwise seen from above."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def quaternion_from_matrix(matrix: Floats) -> Floats:
    """Unit quaternion (4,) in the order x, y, z, w of a rotation matrix (3, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(matrix).as_quat()


def smallest_rotation(start_axis: Floats, goal_axis: Floats) -> Floats:
    """Rotation matrix (3, 3) of the smallest rotation that turns the unit vector `start_axis` into `goal_axis`."""
    rotation_axis, cosine = np.cross(start_axis, goal_axis), float(start_axis @ goal_axis)
    sine = float(np.linalg.norm(rotation_axis))
    if sine < 1e-12 and cosine > 0:
        return np.eye(3)
    if sine < 1e-12:
        rotation_axis = np.cross(start_axis, np.eye(3)[np.argmin(np.abs(start_axis))])
    return from_rotation_vector(rotation_axis / np.linalg.norm(rotation_axis) * np.arctan2(sine, cosine))
