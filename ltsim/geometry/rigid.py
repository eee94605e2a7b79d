"""Rigid motions of point sets, and the number of points that determine them."""

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.geometry.rotations import cross_matrix

MAX_COLLINEAR_RATIO = 1e-6
"""Largest distance of points from a common line, as a fraction of their extent. Up to it the points count as collinear,
and they do not determine a rotation about the line."""
MIN_RIGID_POINTS = 3
"""Smallest number of points that determine a rigid motion."""


def rigid_motion_design(points: Floats, centre: Floats | None = None) -> Floats:
    """Displacement (3 k, 6) of points (k, 3) by unit translations and by unit rotations about `centre` (3,).

    Without `centre` the rotations are about the origin.
    """
    turn = -cross_matrix(points if centre is None else points - centre)
    return np.concatenate([np.broadcast_to(np.eye(3), turn.shape), turn], axis=2).reshape(-1, 6)


def remove_rigid_motion(displacement: Floats, points: Floats, free_motions: Floats | None = None) -> Floats:
    """Displacements (3 k, c) of k points in c cases, with the best-fitting rigid motion of each case removed.

    If `free_motions` (6, f) is given, only combinations of its f columns are removed; each column is a rigid motion
    with three translations and three rotations.
    """
    motion = rigid_motion_design(points)
    basis = np.linalg.qr(motion if free_motions is None else motion @ free_motions)[0]
    return displacement - basis @ (basis.T @ displacement)


def pose_design(point_derivatives: Floats, sight_vectors: Floats) -> Floats:
    """Derivative (n, 3, 6) of n pointings' readings with respect to translation and rotation of their station.

    Translations and rotations are in the network frame.

    Parameters
    ----------
    point_derivatives : (n, 3, 3) float
        Derivative of the readings with respect to the target's coordinates.
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
    """Flags (...) of stations whose pose (six parameters) is determined by the geometry of the targets they measure.

    Three targets that are not collinear are sufficient. A levelled station needs two that are not on one vertical.

    Parameters
    ----------
    points : (T, 3) float, [m]
    is_sighted : (..., T) bool
        Targets that each station measures with range and both angles.
    plumb_direction : (..., 3) float, optional
        Unit vector of the plumb line that a level defines at each station, NaN without a level.
    min_relative_width : float
        Distance of targets from a common line, as a fraction of their extent, up to which they count as collinear.
    """
    count = np.maximum(is_sighted.sum(axis=-1), 1)
    centre = (is_sighted @ points) / count[..., None]
    centred_points = (points - centre[..., None, :]) * is_sighted[..., None]
    scatter = np.swapaxes(centred_points, -1, -2) @ centred_points
    spread = np.linalg.eigvalsh(scatter)
    is_determined: Bools = spread[..., 1] > min_relative_width**2 * spread[..., 2]
    if plumb_direction is not None:
        extent = spread.sum(axis=-1)
        across = extent - np.einsum("...i,...ij,...j->...", plumb_direction, scatter, plumb_direction)
        is_determined |= across > min_relative_width**2 * extent
    return is_determined
