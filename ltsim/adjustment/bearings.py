"""Places determined by directions without distances: the point where beams intersect, and the plan that they form."""

from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Floats, Ints

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


@dataclass(frozen=True)
class Lines:
    """Horizontal lengths [m] (k,) between the places `start` and `end` (k,), whoever read them."""

    start: Ints
    end: Ints
    length: Floats


def plan_of(
    setup: Ints, start: Ints, end: Ints, turn: Floats, control: Floats, lines: Lines
) -> tuple[Floats, Floats, bool] | None:
    """Places (P, 2) in plan and yaws (S,) [rad] that directions and lengths tell, and whether they are in frame.

    With two known places or more they are put between these, otherwise the first set-up looks along x. None where they
    tell no shape, or where directions alone meet fewer than two known places: nothing then tells the scale.

    Parameters
    ----------
    setup, start, end : (n,) int
        Upright set-up of each direction, the place where it stands, and that to which it points.
    turn : (n,) float, [rad]
        Reading of the circle.
    control : (P, 2) float, [m]
        NaN where a place is not known.
    lines : Lines
        Lengths count along lines whose direction is read from one of their ends.
    """
    yaw = _yaws(setup, start, end, turn)
    rows = np.isfinite(yaw[setup])
    bearing = (yaw[setup] + turn)[rows]
    used, at = np.unique(np.concatenate([start[rows], end[rows]]), return_inverse=True)
    first, second = at.reshape(2, -1)
    along, length = _lengths_along(lines, start[rows], end[rows])
    has_control = np.isfinite(control[used]).all(axis=1)
    if has_control.sum() < 2 and not len(along):
        return None
    shape = _shape(first, second, bearing, along, length, len(used))
    if shape is None:
        return None
    places, is_in_frame = np.full(control.shape, np.nan), bool(has_control.sum() > 1)
    turned = 1.0 + 0.0j
    if is_in_frame:
        basis = np.stack([shape, np.ones(len(shape))], axis=1)
        fitted = np.linalg.lstsq(basis[has_control], control[used][has_control] @ [1.0, 1j], rcond=None)[0]
        shape, turned = basis @ fitted, fitted[0]
    places[used] = np.stack([shape.real, shape.imag], axis=1)
    return places, yaw + float(np.angle(turned)), is_in_frame


def _lengths_along(lines: Lines, start: Ints, end: Ints) -> tuple[Ints, Floats]:
    """Directions (k,) whose line has a length read from one of its ends, and that length (k,)."""
    lengths: dict[tuple[int, int], float] = {}
    for start_place, end_place, length in zip(
        lines.start.tolist(), lines.end.tolist(), lines.length.tolist(), strict=True
    ):
        lengths.setdefault((start_place, end_place), length)
        lengths.setdefault((end_place, start_place), length)
    pairs = list(zip(start.tolist(), end.tolist(), strict=True))
    along = np.flatnonzero([pair in lengths for pair in pairs])
    return along, np.array([lengths[pairs[i]] for i in along])


def loose_lines(setup: Ints, start: Ints, end: Ints, turn: Floats, lines: Lines) -> list[tuple[int, int]]:
    """Lines between places, by their ends, whose length nothing tells where all set-ups are oriented.

    Empty where the plan holds, or is loose in more than one way. Parameters as of `plan_of`.
    """
    yaw = _yaws(setup, start, end, turn)
    rows = np.isfinite(yaw[setup])
    used, at = np.unique(np.concatenate([start[rows], end[rows]]), return_inverse=True)
    first, second = at.reshape(2, -1)
    along, _ = _lengths_along(lines, start[rows], end[rows])
    _, size, right = np.linalg.svd(_design(first, second, (yaw[setup] + turn)[rows], along, len(used)))
    if not len(along) or not rows.all() or size[-1] >= LOOSE * size[0] or size[-2] < LOOSE * size[0]:
        return []
    motion = np.concatenate([np.zeros((1, 2)), right[-1].reshape(-1, 2)])
    moves = np.linalg.norm(motion[second] - motion[first], axis=1)
    loose = np.flatnonzero(moves > LOOSE * moves.max())
    ends = {
        (min(pair), max(pair)) for pair in zip(used[first[loose]].tolist(), used[second[loose]].tolist(), strict=True)
    }
    return sorted(ends)


def _design(first: Ints, second: Ints, bearing: Floats, along: Ints, count: int) -> Floats:
    """Equations of places but the first, x and y in turn: across each bearing, along some, and none to fill up."""
    design = np.zeros((len(bearing) + len(along), count, 2))
    across = np.stack([-np.sin(bearing), np.cos(bearing)], axis=1)
    ahead = np.stack([np.cos(bearing), np.sin(bearing)], axis=1)[along]
    every, behind = np.arange(len(bearing)), len(bearing) + np.arange(len(along))
    np.add.at(design, (every, second), across)
    np.add.at(design, (every, first), -across)
    np.add.at(design, (behind, second[along]), ahead)
    np.add.at(design, (behind, first[along]), -ahead)
    free = 2 * (count - 1)
    return np.concatenate([design[:, 1:].reshape(-1, free), np.zeros((free, free))])  # a row for each column at least


def _shape(
    first: Ints, second: Ints, bearing: Floats, along: Ints, length: Floats, count: int
) -> np.ndarray[tuple[int], np.dtype[np.complex128]] | None:
    """Places (count,) in plan as complex numbers, the first at 0; None where some can move.

    Every direction is a linear equation across its bearing, and one along it where its line has a length; without any
    length the scale is arbitrary.
    """
    design = _design(first, second, bearing, along, count)
    right = np.zeros(len(design))
    right[len(bearing) : len(bearing) + len(along)] = length
    u, size, rows = np.linalg.svd(design, full_matrices=False)
    if size[-1 if len(along) else -2] < LOOSE * size[0]:
        return None
    plan = rows.T @ ((u.T @ right) / size) if len(along) else rows[-1]
    shape = np.concatenate([[0.0], plan.reshape(-1, 2) @ [1.0, 1j]])
    forward = np.real((shape[second] - shape[first]) * np.exp(-1j * bearing))
    return np.asarray(shape if np.sum(np.sign(forward)) > 0.0 else -shape)


def _yaws(setup: Ints, start: Ints, end: Ints, turn: Floats) -> Floats:
    """Yaws (S,) [rad] of set-ups that lines seen from both ends, or twice, join to the first; NaN for the others."""
    yaw = np.full(setup.max() + 1, np.nan)
    yaw[setup[0]] = 0.0
    bearings: dict[tuple[int, int], float] = {}
    lines = list(zip(setup.tolist(), start.tolist(), end.tolist(), turn.tolist(), strict=True))
    before = -1
    while before < (before := len(bearings)):
        for s, start_place, end_place, turned in lines:
            if np.isnan(yaw[s]) and (start_place, end_place) in bearings:
                yaw[s] = bearings[start_place, end_place] - turned
            if np.isfinite(yaw[s]):
                bearings.setdefault((start_place, end_place), yaw[s] + turned)
                bearings.setdefault((end_place, start_place), yaw[s] + turned + np.pi)
    return yaw
