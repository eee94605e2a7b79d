"""Cross-validated prediction error: the whole search is repeated without each fold of the readings.

Pointings are divided at random into five folds. Let P be the projector of the whole network onto the residual space, r
its whitened residuals, and F a fold. An adjustment without the readings of the fold predicts them with the error e =
P_FF^-1 r_F, whose covariance is P_FF^-1. Then effects with their places, shape parameters and sizes are estimated
without the fold. Their changes are subtracted from all readings, and the fold is predicted again. Both predictions have
the normalised squared error e' P_FF e. Its expectation is 1 per reading if the model and the noise are correct. A false
finding does not predict held-out readings. Half of the decrease of the normalised squared error is the gain of log
score by the model; a negative gain is evidence against the model.

To exclude readings is equivalent to estimating a separate error for each of them. The residual space without a fold is
therefore that of a design matrix with additional unit columns, one for each reading of the fold. The weights of the
readings alone, which the noise hypotheses affect, are those of the whole recording.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.adjustment.significance import MIN_SIGNIFICANT_SIGMAS
from ltsim.core.arrays import Floats, Ints
from ltsim.core.randomness import random_stream
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE
from ltsim.diagnosis.evidence import wide_prior_posterior
from ltsim.diagnosis.search import Searcher

N_CROSS_VALIDATION_FOLDS = 5
"""Number of folds of the cross-validation, a usual value; each search for effects uses 80 % of the readings."""


class HeldOutErrors(NamedTuple):
    """Root mean square errors of predicted held-out readings, in standard deviations of the prediction."""

    rms_without_model: float | None = None
    """Rms error of held-out readings predicted by the ordinary adjustment; None if no reading can be predicted."""
    rms_with_model: float | None = None
    """Rms error of held-out readings predicted with the effects that were selected without these readings; None if no
    effects are searched for, or if no reading can be predicted."""
    log_score_gain: float = 0.0
    """Increase of the log score (log density) of the held-out readings by the selected effects; 0 if no effects are
    searched for."""
    log_score_gain_sigma: float = 0.0
    """Standard error of `log_score_gain`, from its scatter between the pointings (Vehtari, Gelman and Gabry 2017,
    Statistics and Computing 27, 1413)."""

    @property
    def log_odds_of_model(self) -> float:
        """Log odds of the selected effects against no effect; negative if held-out readings contradict them, else 0.

        It is the log score gain plus `MIN_SIGNIFICANT_SIGMAS` standard errors if this sum is negative (pseudo-Bayes
        factor; Geisser and Eddy 1979, J. Am. Stat. Assoc. 74, 153). An effect at one target or set-up, which few other
        readings predict, has a gain near zero, which is no contradiction.
        """
        return min(0.0, self.log_score_gain + MIN_SIGNIFICANT_SIGMAS * self.log_score_gain_sigma)


def cross_validated_errors(space: ResidualSpace, seed: int, searcher: Searcher | None = None) -> HeldOutErrors:
    """Prediction errors of held-out readings by 5-fold cross-validation.

    Parameters
    ----------
    space : ResidualSpace
        Whitened equations, projected off the unknowns (residual space), of the adjustment; its standard deviations of
        the readings are the unit of the errors.
    seed : int
        Seed of the random folds.
    searcher : Searcher, optional
        Search for effects in the same readings. Without a search, `rms_with_model` of the result is None.
    """
    before, after, count = np.zeros(len(space.sightings)), np.zeros(len(space.sightings)), 0
    groups, pointing = random_fold_row_indices(space, seed), np.nonzero(space.is_used_reading)[0]
    for rows, (values, vectors) in zip(groups, space.projector.hat_matrix_spectra(groups), strict=True):
        np.add.at(
            before, pointing[rows], _normalised_errors_on_fold(space.whitened_residuals[rows], values, vectors) ** 2
        )
        count += len(rows) - int(np.sum(values >= 1.0 - NORMAL_EQUATIONS_TOLERANCE))
        if searcher is not None:
            fold_search = searcher.without_rows(rows)
            remaining = space.whitened_residuals - space.project(_reading_shift_by_selected_model(space, fold_search))
            np.add.at(after, pointing[rows], _normalised_errors_on_fold(remaining[rows], values, vectors) ** 2)
    if not count:
        return HeldOutErrors()
    rms_before = float(np.sqrt(before.sum() / count))
    if searcher is None:
        return HeldOutErrors(rms_before)
    gains = 0.5 * (before - after)[np.unique(pointing)]  # for normal readings with the covariance of the prediction
    sigma = float(np.sqrt(len(gains)) * gains.std())
    return HeldOutErrors(rms_before, float(np.sqrt(after.sum() / count)), float(gains.sum()), sigma)


def random_fold_row_indices(space: ResidualSpace, seed: int) -> list[Ints]:
    """Indices of the used readings in each random fold; pointings from one set-up to one target share a fold."""
    pointing, sightings = np.nonzero(space.is_used_reading)[0], space.sightings
    pair = np.unique(np.stack([sightings.station, sightings.target]), axis=1, return_inverse=True)[1]
    fold_of_pair = (
        random_stream(seed, "diagnose", "folds").permutation(int(pair.max(initial=-1)) + 1) % N_CROSS_VALIDATION_FOLDS
    )
    row_folds = (np.flatnonzero(fold_of_pair[pair][pointing] == fold) for fold in range(N_CROSS_VALIDATION_FOLDS))
    return [rows for rows in row_folds if len(rows)]


def _normalised_errors_on_fold(residual: Floats, eigenvalues: Floats, eigenvectors: Floats) -> Floats:
    """Normalised prediction errors (f,) of the f readings of a fold: (1 - H)^-1/2 r.

    Here r are the whitened residuals `residual` (f,), and H is the submatrix of the hat matrix for these readings, with
    e nonzero `eigenvalues` (e,) and `eigenvectors` (f, e). Combinations of readings that the other folds do not predict
    are left out.
    """
    along = eigenvectors.T @ residual
    is_predicted = eigenvalues < 1.0 - NORMAL_EQUATIONS_TOLERANCE
    factors = np.where(is_predicted, 1.0 / np.sqrt(np.where(is_predicted, 1.0 - eigenvalues, 1.0)), 0.0)
    errors: Floats = residual + eigenvectors @ ((factors - 1.0) * along)
    return errors


def _reading_shift_by_selected_model(space: ResidualSpace, searcher: Searcher) -> Floats:
    """Change (m,) of m whitened observations by the effects that `searcher` selects; 0 for others."""
    model = searcher.select_effects(requires_effect=True)
    if not model.hypotheses:
        return np.zeros(space.n_equations)
    coefficient_means = wide_prior_posterior(
        *model.gram_and_score, np.concatenate([h.plausible_sizes for h in model.hypotheses])
    )[0]
    designs: Sequence[Floats] = [space.whitened_design(effect) for effect in model.effects]
    return np.hstack(designs) @ coefficient_means
