"""Rotations, rigid motions of point sets, tests if points determine a pose, and closed-form alignment of points."""

from functools import lru_cache
from itertools import combinations

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.core.errors import NetworkError


def cross_matrix(vectors: Floats) -> Floats:
    """Skew-symmetric matrices (..., 3, 3) of vectors (..., 3), such that ``cross_matrix(v) @ w = v x w``."""
    x, y, z = (vectors[..., k] for k in range(3))
    matrix = np.zeros((*vectors.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -z, y, -x
    matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1] = z, -y, x
    return matrix


def perpendicular_vectors(vectors: Floats) -> tuple[Floats, Floats]:
    """Two arrays (n, 3) of unit vectors that are perpendicular to n unit vectors (n, 3) and to each other."""
    helper = np.where(np.abs(vectors[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first_perpendicular = np.cross(vectors, helper)
    first_perpendicular /= np.linalg.norm(first_perpendicular, axis=1, keepdims=True)
    return first_perpendicular, np.cross(vectors, first_perpendicular)


def matrix_from_rotation_vector(vectors: Floats) -> Floats:
    """Rotation matrices (..., 3, 3) from rotation vectors (..., 3) [rad]."""
    from scipy.spatial.transform import Rotation  # slow to load

    return Rotation.from_rotvec(vectors).as_matrix()


def rotation_about_z(angle: float) -> Floats:
    """Rotation matrix (3, 3) for a rotation by `angle` [rad] about the z axis, counter-clockwise seen from above."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def quaternion_from_matrix(matrix: Floats) -> Floats:
    """Unit quaternion (4,) in the order x, y, z, w of a rotation matrix (3, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(matrix).as_quat()


MIN_SINE_BETWEEN_DIRECTIONS = 1e-12
"""Smallest sine of the angle between two unit vectors that do not count as parallel or opposite."""


def smallest_rotation(start_axis: Floats, goal_axis: Floats) -> Floats:
    """Rotation matrix (3, 3) with the smallest angle that rotates the unit vector `start_axis` to `goal_axis`."""
    axis, cosine = np.cross(start_axis, goal_axis), float(start_axis @ goal_axis)
    squared_sine = float(axis @ axis)
    if squared_sine < MIN_SINE_BETWEEN_DIRECTIONS**2:
        if cosine > 0:
            return np.eye(3)
        axis = np.cross(start_axis, np.eye(3)[np.argmin(np.abs(start_axis))])
        return 2.0 * np.outer(axis, axis) / (axis @ axis) - np.eye(3)
    factor = 1.0 / (1.0 + cosine) if cosine > 0 else (1.0 - cosine) / squared_sine  # both are the same
    return cosine * np.eye(3) + cross_matrix(axis) + factor * np.outer(axis, axis)


VERTICAL = np.array([0.0, 0.0, 1.0])
"""Unit vector of the vertical in the network frame."""
MAX_COLLINEAR_RATIO = 1e-6
"""Limit of the extent of points across their best-fit line, divided by their extent along it. Points with a smaller
ratio count as collinear; they do not determine a rotation about their line."""
MIN_POINTS_FOR_POSE = 3
"""Smallest number of points, not on one line, that determine a pose or rigid motion (six parameters)."""


def rigid_motion_jacobian(points: Floats, centre: Floats | None = None) -> Floats:
    """Derivatives (3 k, 6) of the coordinates of k points (k, 3) [m] with respect to a small common rigid motion.

    The columns are translations along x, y, z, and rotations about these axes through `centre` (3,) [m], by default
    the origin.
    """
    turn = -cross_matrix(points if centre is None else points - centre)
    return np.concatenate([np.broadcast_to(np.eye(3), turn.shape), turn], axis=2).reshape(-1, 6)


def remove_rigid_motion(displacement: Floats, points: Floats, free_motions: Floats | None = None) -> Floats:
    """Displacements (3 k, c) of k points (k, 3) [m] in c cases, minus the best-fitting rigid motion of each case.

    The fit is by least squares. If `free_motions` (6, f) is given, only combinations of its f columns are removed. Each
    column is a rigid motion: three translations and three rotations.
    """
    motion = rigid_motion_jacobian(points)
    basis = np.linalg.qr(motion if free_motions is None else motion @ free_motions)[0]
    return displacement - basis @ (basis.T @ displacement)


def pose_jacobian(point_derivatives: Floats, sight_vectors: Floats) -> Floats:
    """Derivatives (n, 3, 6) of the readings of n pointings with respect to translation and rotation of their station.

    Translation and rotation vector are those of the network frame.

    Parameters
    ----------
    point_derivatives : (n, 3, 3) float
        Derivatives of the readings with respect to the coordinates of the target in the network frame.
    sight_vectors : (n, 3) float, [m]
        Vectors from the station to the targets.
    """
    return np.concatenate([-point_derivatives, point_derivatives @ cross_matrix(sight_vectors)], axis=2)


def determines_pose(
    points: Floats,
    is_sighted: Bools,
    plumb_direction: Floats | None = None,
    *,
    min_relative_width: float = MAX_COLLINEAR_RATIO,
) -> Bools:
    """Flags (...) of stations, True if the positions of the measured targets determine the pose (six parameters).

    Three targets that are not collinear are sufficient. A levelled station needs two that are not on one vertical.

    Parameters
    ----------
    points : (T, 3) float, [m]
        Coordinates of the T targets.
    is_sighted : (..., T) bool
        Targets that each station measures with range and both angles.
    plumb_direction : (..., 3) float, optional
        Unit vector of the plumb line that a level defines at each station, NaN without a level.
    min_relative_width : float
        Ratio of the extent of the targets across their best-fit line to the extent along it, up to which they count as
        collinear.
    """
    n_sighted = np.maximum(is_sighted.sum(axis=-1), 1)
    centre = (is_sighted @ points) / n_sighted[..., None]
    centred_points = (points - centre[..., None, :]) * is_sighted[..., None]
    scatter = np.swapaxes(centred_points, -1, -2) @ centred_points
    spread = np.linalg.eigvalsh(scatter)
    is_determined: Bools = spread[..., 1] > min_relative_width**2 * spread[..., 2]
    if plumb_direction is not None:
        extent = spread.sum(axis=-1)
        across = extent - np.einsum("...i,...ij,...j->...", plumb_direction, scatter, plumb_direction)
        is_determined |= across > min_relative_width**2 * extent
    return is_determined


MAX_REWEIGHTING_PASSES = 8
"""Largest number of reweighted least-squares fits in `align_sets_robustly`."""
MAX_LARGEST_TO_MEDIAN_DISTANCE_RATIO = 8.0
"""Limit of the ratio of the largest to the median distance between aligned points and their goals. Below it no point is
an outlier, and the reweighting ends."""
MAX_OUTLIER_FREE_MISFIT = 1e-4
"""Limit of the mean distance [m] between points and their goals after a least-squares alignment. Above it an outlier
may have distorted the alignment, and `align_sets_robustly` also starts from triples of points. 0.1 mm is sufficient for
start values of an adjustment."""
MAX_POINTS_FOR_ALL_TRIPLES = 6
"""Largest number of points for a robust alignment that starts from every triple of points, not only from some."""
N_RANDOM_TRIPLES = 30
"""Number of random triples of points from which a robust alignment of many points starts. Of 30 triples at least one
contains no outlier with a probability of 98 %, if half of the points are outliers; if a third are, the probability is
99.999 %."""


def align_rigidly(points: Floats, goal_points: Floats, weights: Floats | None = None) -> tuple[Floats, Floats]:
    """Rotation (3, 3) and translation (3,) [m] that move n `points` (n, 3) onto `goal_points` by least squares.

    The fit is ``goal_points ~ points @ rotation.T + translation``. `weights` (n,) are non-negative weights of the
    points, by default equal. Raises NetworkError for fewer than three points, or for points on one line.
    """
    return align_with_scale(points, goal_points, weights)[:2]


def align_with_scale(
    points: Floats, goal_points: Floats, weights: Floats | None = None, *, estimates_scale: bool = False
) -> tuple[Floats, Floats, Floats]:
    """Rotation (..., 3, 3), shift (..., 3) [m] and scale (...) that move points onto their goals by least squares.

    The fit is ``goal_points ~ scale * points @ rotation.T + shift``. The leading dimensions `...` count independent
    sets of points.

    Parameters
    ----------
    points : (..., n, 3) float, [m]
        The n points to move, at least three that are not on one line.
    goal_points : (..., n, 3) float, [m]
        Points onto which they are moved, in the same order.
    weights : (n,) float, optional
        Non-negative weights of the points, by default equal.
    estimates_scale : bool
        True to estimate the scale; otherwise the scale is 1.

    Raises
    ------
    NetworkError
        When fewer than three points are given or they lie on one line.

    References
    ----------
    Kabsch, Acta Cryst. A32 (1976) 922; Umeyama, IEEE Trans. PAMI 13 (1991) 376. Proper rotation enforced by the sign of
    the determinant.
    """
    weight = np.ones(points.shape[-2]) if weights is None else weights
    if np.count_nonzero(weight) < 3:
        raise NetworkError("the alignment of two point sets needs at least three common points")
    rotation, shift, scale, is_determined = _weighted_alignment(
        points, goal_points, weight, estimates_scale=estimates_scale
    )
    if not is_determined.all():
        raise NetworkError("the alignment of two point sets needs three common points that are not on one line")
    return rotation, shift, scale


def _weighted_alignment(
    points: Floats, goal_points: Floats, weight: Floats, *, estimates_scale: bool = False
) -> tuple[Floats, Floats, Floats, Bools]:
    """Rotation (..., 3, 3), shift (..., 3) [m], scale (...) of an alignment, and True (...) if the points determine it.

    `points` (..., n, 3) [m] are aligned with `goal_points` (..., n, 3) [m] by least squares with the weights `weight`
    (n,) or (..., n). Points on one line do not determine the rotation.
    """
    weight = weight / weight.sum(axis=-1, keepdims=True)
    centre, goal_centre = ((weight[..., None, :] @ of)[..., 0, :] for of in (points, goal_points))
    centred_points = points - centre[..., None, :]
    moment = np.swapaxes(weight[..., None] * (goal_points - goal_centre[..., None, :]), -1, -2) @ centred_points
    u, spread, vt = np.linalg.svd(moment)
    reflection_signs = np.ones_like(spread)
    reflection_signs[..., 2] = np.sign(np.linalg.det(u @ vt))
    rotation = (u * reflection_signs[..., None, :]) @ vt
    scale = np.ones(moment.shape[:-2])
    if estimates_scale:
        extent = np.sum(weight[..., None] * centred_points**2, axis=(-2, -1))
        scale = np.sum(spread * reflection_signs, axis=-1) / extent
    shift = goal_centre - scale[..., None] * np.einsum("...ij,...j->...i", rotation, centre)
    return rotation, shift, scale, np.asarray(spread[..., 1] > 1e-9 * spread[..., 0])


def align_robustly(points: Floats, goal_points: Floats) -> tuple[Floats, Floats]:
    """Rotation (3, 3) and translation (3,) [m] that move n points (n, 3) onto their goals despite a few outliers.

    The method is that of `align_sets_robustly`. Raises NetworkError for fewer than three points, or for points on one
    line.
    """
    if len(points) < 4:
        return align_rigidly(points, goal_points)
    rotation, shift, is_determined = align_sets_robustly(points[None], goal_points[None])
    if not is_determined[0]:
        raise NetworkError("the alignment of two point sets needs three common points that are not on one line")
    return rotation[0], shift[0]


def align_sets_robustly(points: Floats, goal_points: Floats) -> tuple[Floats, Floats, Bools]:
    """Rotations (b, 3, 3), shifts (b, 3) [m] that move b sets of points onto their goals, and flags (b,) of success.

    Each alignment minimises the sum of the distances between moved points and goals by iterative reweighting. With
    outliers this sum has several local minima. Reweighting therefore starts at the best of several alignments, by least
    squares of all points and of triples of points: the one with the smallest sum of the logarithms of all distances.

    Parameters
    ----------
    points, goal_points : (b, n, 3) float, [m]
        The n points of each set, at least four, and their goals. The flag of a set on one line is False.
    """
    size = points.shape[1]
    rotation, shift, _, is_determined = _weighted_alignment(points, goal_points, np.ones(size))
    distances = _alignment_residual_distances(points, goal_points, (rotation, shift))
    triples = _point_triples(size)
    for k in np.flatnonzero(is_determined & (distances.mean(axis=1) > MAX_OUTLIER_FREE_MISFIT)).tolist():
        rotations, shifts, _, is_unique = _weighted_alignment(points[k][triples], goal_points[k][triples], np.ones(3))
        sums = _sum_of_log_distances(_alignment_residual_distances(points[k], goal_points[k], (rotations, shifts)))
        sums[~is_unique] = np.inf
        best = int(np.argmin(sums))
        if sums[best] < _sum_of_log_distances(distances[k]):
            rotation[k], shift[k] = rotations[best], shifts[best]
    active = np.flatnonzero(is_determined)
    for _ in range(MAX_REWEIGHTING_PASSES):
        if not len(active):
            break
        here, there = points[active], goal_points[active]
        distances = _alignment_residual_distances(here, there, (rotation[active], shift[active]))
        ascending = np.sort(distances, axis=1)
        floor = np.maximum(1e-5, 0.25 * (ascending[:, (size - 1) // 2] + ascending[:, size // 2]))
        rotation[active], shift[active], _, is_determined[active] = _weighted_alignment(
            here, there, 1.0 / np.maximum(distances, floor[:, None])
        )
        ends = (ascending[:, -1] < MAX_LARGEST_TO_MEDIAN_DISTANCE_RATIO * floor) | ~is_determined[active]
        active = active[~ends]
    return rotation, shift, is_determined


def largest_alignment_distance(points: Floats, goal_points: Floats) -> float:
    """Largest distance [m] between n points (n, 3) [m], aligned by least squares, and their goals (n, 3) [m].

    Raises NetworkError for fewer than three points, or for points on one line.
    """
    return float(_alignment_residual_distances(points, goal_points, align_rigidly(points, goal_points)).max())


def _alignment_residual_distances(points: Floats, goal_points: Floats, rigid_motion: tuple[Floats, Floats]) -> Floats:
    """Distances (..., n) [m] between n points (..., n, 3), moved by a rigid motion, and their goals (..., n, 3).

    `rigid_motion` is a pair: rotations (..., 3, 3) and shifts (..., 3) [m].
    """
    rotation, shift = rigid_motion
    moved = points @ np.swapaxes(rotation, -1, -2) + shift[..., None, :]
    return np.asarray(np.linalg.norm(moved - goal_points, axis=-1))


def _sum_of_log_distances(distances: Floats) -> Floats:
    """Sum (...) of the logarithms of n distances (..., n) [m], each at least `MAX_OUTLIER_FREE_MISFIT`.

    An alignment with a few large and many small distances has a smaller sum than one with all distances of medium size.
    """
    return np.asarray(np.log(np.maximum(distances, MAX_OUTLIER_FREE_MISFIT)).sum(axis=-1))


@lru_cache(maxsize=256)
def _point_triples(n_points: int) -> list[list[int]]:
    """Triples of point indices: all triples of at most `MAX_POINTS_FOR_ALL_TRIPLES` points, otherwise a random sample.

    The sample depends on the number of points only, so that results are reproducible.
    """
    every = list(combinations(range(n_points), 3)) if n_points <= MAX_POINTS_FOR_ALL_TRIPLES else []
    if every:
        return [list(triple) for triple in every]
    draw = np.random.default_rng(n_points)
    return [draw.choice(n_points, 3, replace=False).tolist() for _ in range(N_RANDOM_TRIPLES)]
