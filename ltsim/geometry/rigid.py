"""Rigid motions of points, and which points hold them."""

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.geometry.rotations import cross_matrix

ON_A_LINE = 1e-6
"""Points that leave a line by less than this share of their extent lie on it."""


def rigid_motion(points: Floats, centre: Floats | None = None) -> Floats:
    """Displacement (3 k, 6) of points (k, 3) by unit translations and unit rotations about `centre`, or the origin."""
    turn = -cross_matrix(points if centre is None else points - centre)
    return np.concatenate([np.broadcast_to(np.eye(3), turn.shape), turn], axis=2).reshape(-1, 6)


def less_rigid(displacement: Floats, points: Floats, free: Floats | None = None) -> Floats:
    """Displacements (3 k, c) of points (k, 3) less what a shift and a turn of all of them makes of each column.

    Of the six motions only those along the columns of `free` (6, f) are taken out, where these are given.
    """
    motion = rigid_motion(points)
    basis = np.linalg.qr(motion if free is None else motion @ free)[0]
    return displacement - basis @ (basis.T @ displacement)


def pose_design(by_target: Floats, arm: Floats) -> Floats:
    """Derivative (n, 3, 6) of readings by translation and rotation of their station, network frame.

    Parameters
    ----------
    by_target : (n, 3, 3) float
        Derivative by the target.
    arm : (n, 3) float, [m]
        From the station to the target.
    """
    return np.concatenate([-by_target, by_target @ cross_matrix(arm)], axis=2)


def holds_pose(points: Floats, sighted: Bools, vertical: Floats | None = None, *, flat: float = ON_A_LINE) -> Bools:
    """Flags (...): the targets that each station sees hold its six motions, as geometry alone decides.

    Three targets off one line do; a levelled station needs two that are not above one another.

    Parameters
    ----------
    points : (T, 3) float, [m]
    seen : (..., T) bool
        Targets that each station measures whole.
    vertical : (..., 3) float, optional
        Unit vector of the plumb line that a level holds at each station, NaN without a level.
    flat : float
        Share of their extent by which targets on a line may be off it.
    """
    count = np.maximum(sighted.sum(axis=-1), 1)
    centre = (sighted @ points) / count[..., None]
    arms = (points - centre[..., None, :]) * sighted[..., None]
    scatter = np.swapaxes(arms, -1, -2) @ arms
    spread = np.linalg.eigvalsh(scatter)
    held: Bools = spread[..., 1] > flat**2 * spread[..., 2]
    if vertical is not None:
        extent = spread.sum(axis=-1)
        across = extent - np.einsum("...i,...ij,...j->...", vertical, scatter, vertical)
        held |= across > flat**2 * extent
    return held
