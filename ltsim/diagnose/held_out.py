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


def pair_folds(space: ResidualSpace) -> Ints:
    """Folds (r,) that leave out everything one station measured of one target."""
    s, used = space.sightings, space.use
    pair = np.unique(s.station * len(s.target_names) + s.target, return_inverse=True)[1]
    by_reading: Ints = np.broadcast_to(pair[:, None], used.shape)[used].astype(np.int64)
    return by_reading
