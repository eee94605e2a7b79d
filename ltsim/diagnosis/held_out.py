"""Error on readings that neither the fit nor the search has seen: the whole search is repeated without each fold.

Pointings are dealt into five folds. Without a fold's readings the adjustment predicts them with the error
e = P_FF^-1 r_F of covariance P_FF^-1, in whitened units, P the projector of the whole network and r its residuals.
Effects, places, shapes and sizes are then searched in the rest alone, and what is found there is taken out of all
readings before the fold is predicted again. Both errors are measured by e' P_FF e, the covariance of the plain
prediction: 1 per reading where model and noise hold. A spurious finding does not predict what its search has not seen.

Leaving readings out is estimating an error of its own for each of them: the residual space without a fold is that of
the network extended by the unit columns of its readings. Only the weights of the readings, changes of the noise among
them, are those of the whole recording.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Floats, Ints
from ltsim.core.randomness import stream
from ltsim.diagnosis.evidence import wide_posterior
from ltsim.diagnosis.search import Searcher

FOLDS = 5
PREDICTED = 1e-6
"""Directions with less redundancy than this are not predicted by the rest of the network at all."""


class HeldOut(NamedTuple):
    """Root mean square errors in standard deviations: of the plain adjustment, and with what is found without a fold.

    None where nothing was left out, or nothing can be predicted; `after` too where no search was made.
    """

    before: float | None = None
    after: float | None = None


def held_out(space: ResidualSpace, seed: int, searcher: Searcher | None = None, threshold: float = 0.0) -> HeldOut:
    """Errors on readings that are left out and predicted.

    Parameters
    ----------
    space : ResidualSpace
        Its whitening is the yardstick.
    seed : int
        Of the folds.
    searcher : Searcher, optional
        Of the same readings, perhaps otherwise weighted; without one nothing is searched.
    threshold : float
        Log evidence of a second and further finding.
    """
    before, after, count = 0.0, 0.0, 0
    groups = folds(space, seed)
    for rows, (values, vectors) in zip(groups, space.projection.spectra(groups), strict=True):
        before += _square(space.residual[rows], values, vectors)
        count += len(rows) - int(np.sum(values >= 1.0 - PREDICTED))
        if searcher is not None:
            fold_search = searcher.without_rows(rows)
            remaining = space.residual - space.project(_shift(space, fold_search, threshold))
            after += _square(remaining[rows], values, vectors)
    if not count:
        return HeldOut()
    return HeldOut(float(np.sqrt(before / count)), None if searcher is None else float(np.sqrt(after / count)))


def folds(space: ResidualSpace, seed: int) -> list[Ints]:
    """Rows of the used readings of each fold of whole pointings; folds are drawn."""
    pointing = np.nonzero(space.use)[0]
    dealt = stream(seed, "diagnose", "folds").permutation(len(space.use)) % FOLDS
    groups = (np.flatnonzero(dealt[pointing] == fold) for fold in range(FOLDS))
    return [rows for rows in groups if len(rows)]


def _square(residual: Floats, values: Floats, vectors: Floats) -> float:
    """R' (1 - H)^-1 r on a fold, by the spectrum of H there; what lies across all eigenvectors has redundancy one."""
    along = (vectors.T @ residual) ** 2
    predicted = values < 1.0 - PREDICTED
    return float(residual @ residual - along.sum() + np.sum(along[predicted] / (1.0 - values[predicted])))


def _shift(space: ResidualSpace, searcher: Searcher, threshold: float) -> Floats:
    """Change (m,) of all whitened readings by what a search finds."""
    model = searcher.search(threshold, something=True)
    if not model.members:
        return np.zeros(space.size)
    mean = wide_posterior(*model.products, np.concatenate([h.spread for h in model.members]))[0]
    signatures: Sequence[Floats] = [space.signature(effect) for effect in model.effects]
    return np.hstack(signatures) @ mean
