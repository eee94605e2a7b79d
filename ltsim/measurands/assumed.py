"""Assumptions of a comparison of two epochs: motions that a free network leaves open, names that are exchanged."""

from collections.abc import Sequence

import numpy as np
import scipy.linalg

from ltsim.core.arrays import Floats, Ints
from ltsim.core.notation import listing
from ltsim.geometry.rigid import rigid_motion
from ltsim.measurands.comparison import Gap
from ltsim.recordings.coordinates import Coordinates

SINGULAR = 1e-7
"""Eigenvalue of correlations over the largest below which a covariance has a rank defect; files round to 1e-9."""
PLACE_TAKEN = 0.1
"""Share of the distance between two points within which each lies at the place of the other if names are exchanged."""
OPEN_MOTIONS = {3: (0, 1, 2), 4: (0, 1, 2, 5), 6: tuple(range(6))}
"""Rigid motions (shifts along x, y, z, turns about them) that a datum in space holds, by the rank defect."""


def open_motions(epoch: Coordinates) -> Floats:
    """Rigid motions (6, f) that the covariance of an epoch leaves open, by its rank defect.

    Inner constraints over all points make a covariance without variance along the motions themselves; a datum of some
    of them has the same defect in other directions, and the usual motions are taken.
    """
    scale = np.sqrt(np.diag(epoch.covariance))
    values = np.linalg.eigvalsh(epoch.covariance / np.outer(scale, scale))
    defect = int((values < SINGULAR * values[-1]).sum())
    if not defect:
        return np.zeros((6, 0))
    middle = epoch.points.mean(axis=0)
    motions = rigid_motion(epoch.points, middle).reshape(len(epoch.points), 3, 6)[:, epoch.along].reshape(len(scale), 6)
    moving = np.flatnonzero(np.linalg.norm(motions, axis=0) > 0)
    basis, triangle = np.linalg.qr(motions[:, moving])
    variance, directions = np.linalg.eigh(basis.T @ epoch.covariance @ basis)
    still = directions[:, variance < SINGULAR * scale.max() ** 2]
    free_motions = np.zeros((6, still.shape[1]))
    free_motions[moving] = scipy.linalg.solve_triangular(triangle, still)
    if still.shape[1] != defect:
        usual = np.array(OPEN_MOTIONS.get(defect, range(6)) if len(epoch.axes) == len("xyz") else range(6))
        free_motions = np.eye(6)[:, usual[np.isin(usual, moving)]]
    free_motions[:3] += np.cross(middle, free_motions[3:].T).T  # turns about the middle as turns about the origin
    return free_motions


def exchanged(gap: Gap, moved: Sequence[int]) -> Ints | None:
    """Number of the point whose name each common point has in the second epoch; None if no names are exchanged.

    Each of the `moved` points stands where another of them stood in the first epoch, far from its own place.
    """
    if len(moved) < 2:
        return None
    before = gap.places[moved][:, gap.axes]
    after = before + gap.gap.reshape(gap.count, -1)[moved]
    gaps = np.linalg.norm(after[:, None] - before[None], axis=2)
    nearest, distance = np.argmin(gaps, axis=1), np.diag(gaps)
    taken = (nearest != np.arange(len(moved))) & (gaps.min(axis=1) < PLACE_TAKEN * distance)
    places = {moved[i]: moved[nearest[i]] for i in np.flatnonzero(taken).tolist()}
    if not places or set(places) != set(places.values()):
        return None
    order = np.arange(gap.count)
    order[list(places.values())] = list(places)
    return order


def exchange_note(names: Sequence[str], order: Ints) -> str:
    """The sentence on names that are exchanged in the second epoch."""
    changed = np.flatnonzero(order != np.arange(len(order)))
    names_changed = listing([names[i] for i in changed.tolist()], len(changed))
    return f"the names {names_changed} are exchanged in the second epoch: these points are compared by their places"


def datum_note(count: int) -> str:
    """The sentence on covariances that leave motions open."""
    return (
        f"the covariances leave {count} motions of the whole network open (free networks): the second epoch is aligned "
        "with the first along them"
    )
