"""Cross-validated prediction error: the whole search is repeated without each fold of the readings.

Pointings are divided at random into five folds. Without a fold's readings the adjustment predicts them with the error e
= P_FF^-1 r_F of covariance P_FF^-1, in whitened units, P the projector of the whole network and r its residuals.
Effects, places, shapes and sizes are then estimated from the rest alone, and their model is subtracted from all
readings before the fold is predicted again. Both errors are measured by e' P_FF e, the covariance of the plain
prediction: 1 per reading where model and noise hold. A spurious finding does not predict held-out readings.

Excluding readings is equivalent to estimating a separate error for each of them: the residual space without a fold is
that of the network extended by the unit columns of its readings. Only the weights of the readings, changes of the noise
among them, are those of the whole recording.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Floats, Ints
from ltsim.core.randomness import stream
from ltsim.core.rounding import MAX_SOLUTION_ROUNDING_ERROR
from ltsim.diagnosis.evidence import wide_prior_posterior
from ltsim.diagnosis.search import Searcher

N_FOLDS = 5
"""Number of folds, usual in cross-validation: each search has 80 % of the readings."""


class HeldOutErrors(NamedTuple):
    """Root mean square errors in standard deviations: of the adjustment alone, and with the model of a fold.

    Both are None if nothing can be predicted; `after` also without a search.
    """

    before: float | None = None
    after: float | None = None


def cross_validated_errors(
    space: ResidualSpace, seed: int, searcher: Searcher | None = None, threshold: float = 0.0
) -> HeldOutErrors:
    """Prediction errors on held-out readings.

    Parameters
    ----------
    space : ResidualSpace
        Residual space, whose whitening defines the unit of the errors.
    seed : int
        Seed of the random folds.
    searcher : Searcher, optional
        Search on the same readings; without one only `before` is given.
    threshold : float
        Log evidence of a second and further finding.
    """
    before, after, count = 0.0, 0.0, 0
    groups = fold_rows(space, seed)
    for rows, (values, vectors) in zip(groups, space.projector.hat_matrix_spectra(groups), strict=True):
        before += _quadratic_form_on_fold(space.residuals[rows], values, vectors)
        count += len(rows) - int(np.sum(values >= 1.0 - MAX_SOLUTION_ROUNDING_ERROR))
        if searcher is not None:
            fold_search = searcher.without_rows(rows)
            remaining = space.residuals - space.project(_selected_model_shift(space, fold_search, threshold))
            after += _quadratic_form_on_fold(remaining[rows], values, vectors)
    if not count:
        return HeldOutErrors()
    return HeldOutErrors(float(np.sqrt(before / count)), None if searcher is None else float(np.sqrt(after / count)))


def fold_rows(space: ResidualSpace, seed: int) -> list[Ints]:
    """Rows of the used readings of each fold of complete pointings, drawn at random."""
    pointing = np.nonzero(space.used_readings)[0]
    dealt = stream(seed, "diagnose", "folds").permutation(len(space.used_readings)) % N_FOLDS
    groups = (np.flatnonzero(dealt[pointing] == fold) for fold in range(N_FOLDS))
    return [rows for rows in groups if len(rows)]


def _quadratic_form_on_fold(residual: Floats, values: Floats, vectors: Floats) -> float:
    """Quadratic form r' (1 - H)^-1 r on a fold, from the eigenvalues of H there.

    The complement of the eigenvectors has redundancy one.
    """
    along = (vectors.T @ residual) ** 2
    is_predicted = values < 1.0 - MAX_SOLUTION_ROUNDING_ERROR
    return float(residual @ residual - along.sum() + np.sum(along[is_predicted] / (1.0 - values[is_predicted])))


def _selected_model_shift(space: ResidualSpace, searcher: Searcher, threshold: float) -> Floats:
    """Shift (m,) of all whitened readings by the model that a search selects."""
    model = searcher.select_model(threshold, requires_member=True)
    if not model.members:
        return np.zeros(space.n_rows)
    mean = wide_prior_posterior(*model.gram_and_scores, np.concatenate([h.plausible_sizes for h in model.members]))[0]
    signatures: Sequence[Floats] = [space.whitened_signature(effect) for effect in model.effects]
    return np.hstack(signatures) @ mean
