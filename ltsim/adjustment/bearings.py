"""What beams say of places where no distance does: the point in which they meet, and the plan that they make up."""

import numpy as np

from ltsim.arrays import Floats, Ints

PARALLEL = 1e-5
"""Mean squared sine below which beams do not meet in a point."""
LOOSE = 1e-6
"""Share of the largest singular value below which a plan can change its shape."""


def meeting_point(origin: Floats, beam: Floats) -> Floats | None:
    """The point (3,) nearest to k beams from `origin` (k, 3) along unit vectors; None where they are parallel."""
    across = np.eye(3) - beam[:, :, None] * beam[:, None, :]
    normal = across.sum(axis=0)
    if np.linalg.eigvalsh(normal)[0] < PARALLEL * len(beam):
        return None
    return np.linalg.solve(normal, np.einsum("kij,kj->i", across, origin))


def plan_of(setup: Ints, start: Ints, end: Ints, turn: Floats, known: Floats) -> tuple[Floats, Floats] | None:
    """Places (P, 2) in plan and yaws (S,) [rad] that directions alone tell, put between known places; NaN without.

    None where they tell no shape, or fewer than two known places are of it.

    Parameters
    ----------
    setup, start, end : (n,) int
        Upright set-up of each direction, the place where it stands, and that to which it points.
    turn : (n,) float, [rad]
        Reading of the circle.
    known : (P, 2) float, [m]
        NaN where a place is not known.
    """
    yaw = _yaws(setup, start, end, turn)
    rows = np.isfinite(yaw[setup])
    used, at = np.unique(np.concatenate([start[rows], end[rows]]), return_inverse=True)
    told = np.isfinite(known[used]).all(axis=1)
    if told.sum() < 2:
        return None
    first, second = at.reshape(2, -1)
    bearing = (yaw[setup] + turn)[rows]
    across = np.stack([-np.sin(bearing), np.cos(bearing)], axis=1)
    design = np.zeros((len(bearing), len(used), 2))
    design[np.arange(len(bearing)), second] = across
    design[np.arange(len(bearing)), first] -= across
    free = 2 * (len(used) - 1)
    padded = np.concatenate([design[:, 1:].reshape(-1, free), np.zeros((free, free))])  # a row for each column at least
    _, size, right = np.linalg.svd(padded, full_matrices=False)
    if size[-2] < LOOSE * size[0]:
        return None
    shape = np.concatenate([[0.0], right[-1].reshape(-1, 2) @ [1.0, 1j]])
    ahead = np.real((shape[second] - shape[first]) * np.exp(-1j * bearing))
    shape *= 1.0 if np.sum(np.sign(ahead)) > 0.0 else -1.0
    basis = np.stack([shape, np.ones(len(shape))], axis=1)
    fitted = np.linalg.lstsq(basis[told], known[used][told] @ [1.0, 1j], rcond=None)[0]
    places = np.full(known.shape, np.nan)
    places[used] = np.stack([(basis @ fitted).real, (basis @ fitted).imag], axis=1)
    return places, yaw + float(np.angle(fitted[0]))


def _yaws(setup: Ints, start: Ints, end: Ints, turn: Floats) -> Floats:
    """Yaws (S,) [rad] of set-ups that lines seen from both ends, or twice, join to the first; NaN for the others."""
    yaw = np.full(setup.max() + 1, np.nan)
    yaw[setup[0]] = 0.0
    bearings: dict[tuple[int, int], float] = {}
    lines = list(zip(setup.tolist(), start.tolist(), end.tolist(), turn.tolist(), strict=True))
    before = -1
    while before < (before := len(bearings)):
        for s, one, other, turned in lines:
            if np.isnan(yaw[s]) and (one, other) in bearings:
                yaw[s] = bearings[one, other] - turned
            if np.isfinite(yaw[s]):
                bearings.setdefault((one, other), yaw[s] + turned)
                bearings.setdefault((other, one), yaw[s] + turned + np.pi)
    return yaw
