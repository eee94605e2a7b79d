"""Error on observations that the fit did not see, by leaving out and predicting: exact, without refitting.

With H the hat matrix and F a fold, the prediction error of the fold is (I - H_FF)^-1 r_F and its covariance
(I - H_FF)^-1, in whitened units; the normalised square is r_F' (I - H_FF)^-1 r_F. It is 1 per reading where model and
noise hold.
"""

from __future__ import annotations

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.arrays import Ints

PREDICTED = 1e-6
"""Directions with less redundancy than this are not predicted by the rest of the network at all."""


def held_out_rms(space: ResidualSpace, only: Ints | None = None) -> float:
    """Normalised root mean square error of all that a station measured of a target, predicted from the rest.

    Parameters
    ----------
    space : ResidualSpace
    only : (k,) int, optional
        Pairs of station and target (as in `pairs`) that are left out in turn; default all of them.
    """
    pair = pairs(space)
    order = np.argsort(pair, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(pair[order])) + 1) if len(order) else []
    groups = [rows for rows in groups if only is None or pair[rows[0]] in only]
    square, count = 0.0, 0
    for rows, (values, vectors) in zip(groups, space.projection.spectra(groups), strict=True):
        own = space.residual[rows]
        along = (vectors.T @ own) ** 2
        seen = values < 1.0 - PREDICTED
        # What lies across all eigenvectors has redundancy one.
        square += float(own @ own - along.sum() + np.sum(along[seen] / (1.0 - values[seen])))
        count += len(rows) - int(np.sum(~seen))
    return float(np.sqrt(square / count)) if count else float("nan")


def pairs(space: ResidualSpace) -> Ints:
    """A number (r,) for the station and target of each used reading, the first rows of the space."""
    s = space.sightings
    return (s.station * len(s.target_names) + s.target)[np.nonzero(space.use)[0]]
