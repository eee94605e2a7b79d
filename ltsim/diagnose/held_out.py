"""Error on observations that the fit did not see, by leaving out and predicting: exact, without refitting.

With H the hat matrix and F a fold, the prediction error of the fold is (I - H_FF)^-1 r_F and its covariance
(I - H_FF)^-1, in whitened units; the normalised square is r_F' (I - H_FF)^-1 r_F. It is 1 per reading where model and
noise hold.
"""

from __future__ import annotations

import numpy as np

from ltsim.adjust.residual_space import ResidualSpace
from ltsim.arrays import Ints

PREDICTED = 1e-6
"""Directions with less redundancy than this are not predicted by the rest of the network at all."""
MOST = 300
"""Pointings of a fold: large enough that a fit feels their loss, small enough to be left out at once."""


def held_out_rms(space: ResidualSpace, folds: Ints) -> float:
    """Normalised root mean square error of readings predicted from the other folds.

    Parameters
    ----------
    space : ResidualSpace
    folds : (r,) int
        Fold of each used reading (the first rows of the space); -1 is never left out.
    """
    groups = _members(folds)
    square, count = 0.0, 0
    for rows, (values, vectors) in zip(groups, space.projection.spectra(groups), strict=True):
        own = space.residual[rows]
        along = (vectors.T @ own) ** 2
        seen = values < 1.0 - PREDICTED
        # What lies across all eigenvectors has redundancy one.
        square += float(own @ own - along.sum() + np.sum(along[seen] / (1.0 - values[seen])))
        count += len(rows) - int(np.sum(~seen))
    return float(np.sqrt(square / count)) if count else float("nan")


def _members(folds: Ints) -> list[Ints]:
    """Rows of each fold."""
    order = np.argsort(folds, kind="stable")
    order = order[folds[order] >= 0]
    return np.split(order, np.flatnonzero(np.diff(folds[order])) + 1) if len(order) else []


def pointing_folds(space: ResidualSpace, least: int = 10) -> Ints:
    """Folds that leave out whole pointings, dealt round robin over the station-target pairs.

    At least ten folds; more where they would be larger than `MOST`.
    """
    sightings = space.sightings
    count = max(least, -(-len(sightings) // MOST))
    pair = sightings.station * len(sightings.target_names) + sightings.target
    order = np.lexsort((sightings.time, pair))
    fold = np.empty(len(sightings), dtype=np.int64)
    fold[order] = np.arange(len(order)) % count
    return _by_reading(space, fold)


def pair_folds(space: ResidualSpace) -> Ints:
    """Folds that leave out everything one station measured of one target."""
    sightings = space.sightings
    pair = sightings.station * len(sightings.target_names) + sightings.target
    return _by_reading(space, np.unique(pair, return_inverse=True)[1])


def station_target_folds(space: ResidualSpace, parts: int = 4) -> Ints:
    """Folds that leave out a quarter of the targets at one station at a time: the pose is held by the others."""
    sightings = space.sightings
    fold = sightings.station * parts + sightings.target % parts
    return _by_reading(space, fold)


def _by_reading(space: ResidualSpace, fold: Ints) -> Ints:
    used = space.use
    by_reading: Ints = np.broadcast_to(fold[:, None], used.shape)[used].astype(np.int64)
    return by_reading
