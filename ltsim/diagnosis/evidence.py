"""Log marginal likelihoods of the hypotheses of a diagnosis.

In the residual space (whitened residuals r, projector P off all that the ordinary adjustment estimates) a hypothesis
with signature g and coefficients b ~ N(0, t^2 L), L the squares of plausible sizes, has, relative to the model
without it, the log marginal likelihood ratio
    log B = sum_j [ z_j^2 t^2 / (1 + t^2 d_j) - log(1 + t^2 d_j) ] / 2,
with d_j the eigenvalues of L^1/2 g' P g L^1/2 and z_j the scores L^1/2 g' r along its eigenvectors. It is averaged over
sizes t. Places, shapes and scales are averaged as well, which penalises hypotheses with many of them. Changes of the
noise are averaged over a grid of sizes and enter by their restricted likelihood.

References
----------
MacKay, Information theory, inference and learning algorithms (2003), chapter 28 (evidence and Occam factors);
Rasmussen and Williams, Gaussian processes for machine learning (2006), section 5.4.
"""

from collections.abc import Iterator

import numpy as np
from scipy.special import log_ndtr

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.evidence import (
    EVIDENCE_SIZES,
    LOG_SIZE_PRIOR,
    log_evidence,
    log_evidence_by_size,
    log_sum_exp,
    size_weights_and_constants,
)
from ltsim.core.arrays import Bools, Floats, Ints, Singles, batches
from ltsim.core.rounding import MAX_SOLUTION_ROUNDING_ERROR
from ltsim.physics.effects.outlier import OBSERVABLE_COLUMN, Outlier
from ltsim.physics.effects.signature import CandidateEffect
from ltsim.recordings.recording import OBSERVABLES


def index_of_best(values: Floats) -> int:
    """Index of the largest value; the middle one if several are equal, as on a plateau."""
    ties = np.flatnonzero(values >= np.max(values) - MAX_SOLUTION_ROUNDING_ERROR)
    return int(ties[(len(ties) - 1) // 2])


def ranked_indices(values: Floats, tie: float = MAX_SOLUTION_ROUNDING_ERROR) -> Ints:
    """Indices in the order of decreasing values; values equal within `tie` keep their order."""
    falling = np.nan_to_num(-values)
    order = np.argsort(falling, kind="stable")
    group = np.cumsum(np.diff(falling[order]) > tie)
    return order[np.lexsort((order, np.append(0, group)[: len(order)]))]


def normalised_probabilities(logs: Floats) -> Floats:
    """Probabilities (k,) from unnormalised log probabilities (k,)."""
    probabilities: Floats = np.exp(logs - log_sum_exp(logs))
    return probabilities


def simulated_log_evidence(scores: Floats, strength: Floats) -> Floats:
    """`log_evidence` (h, trials) of scores (h, k, trials) of simulated residuals, in single precision."""
    parts = [
        _log_sum_exp_in_place(logs, 1) for logs in _simulated_log_evidence(scores, strength, np.zeros(len(scores)))
    ]
    evidence: Floats = np.concatenate(parts).astype(np.float64)
    return evidence


def simulated_log_total(scores: Singles, strength: Floats, log_prior: Floats) -> Floats:
    """Log of the sum (trials,) over all hypotheses, each with its prior (h,)."""
    flattened = scores.reshape(-1, *scores.shape[-2:]), strength.reshape(-1, scores.shape[-2])
    parts = [_log_sum_exp_in_place(logs, (0, 1)) for logs in _simulated_log_evidence(*flattened, log_prior)]
    return log_sum_exp(np.stack(parts).astype(np.float64))


def _simulated_log_evidence(scores: Floats | Singles, strength: Floats, log_prior: Floats) -> Iterator[Singles]:
    """Log evidence with priors, (h, sizes, trials), in batches of hypotheses."""
    for part in batches(len(scores), scores.size // max(len(scores), 1)):
        weights, constants = size_weights_and_constants(strength[part])
        constants += log_prior[part, None]
        logs = np.swapaxes(weights, -1, -2).astype(np.float32) @ np.square(scores[part], dtype=np.float32)
        logs += constants[..., None].astype(np.float32)
        yield logs


def _log_sum_exp_in_place(logs: Singles, axis: int | tuple[int, ...]) -> Singles:
    """Log of the sum of exp(logs) along axes; `logs` is overwritten."""
    top = logs.max(axis=axis, keepdims=True)
    np.exp(np.subtract(logs, top, out=logs), out=logs)
    total: Singles = np.log(logs.sum(axis=axis)) + top.squeeze(axis)
    return total


def log_restricted_likelihood_ratio(squares: Floats, redundancy: Floats, factor: Floats) -> Floats:
    """Log restricted likelihood ratio of variances `factor` times as large, in its diagonal form, reading by reading.

    `squares` are those of whitened residuals, `redundancy` the redundancies; or sums of both over readings of equal
    factor.
    """
    ratio: Floats = 0.5 * (squares * (1.0 - 1.0 / factor) - redundancy * np.log(factor))
    return ratio


def log_evidence_of_wrong_readings(
    space: ResidualSpace, residual: Floats, redundancy: Floats, log_prior: float
) -> float:
    """Log evidence of several wrong readings, each with an error of its own.

    Readings whose own log evidence is positive are taken as wrong, whatever the others are.

    Parameters
    ----------
    residual, redundancy : (m,) float
        Whitened residuals and redundancies given a model.
    log_prior : float
        Log prior of a wrong reading, all readings together.
    """
    sizes = np.concatenate([Outlier(observable=name).size_scales for name in OBSERVABLE_COLUMN])
    scale = (sizes / space.sigma)[space.used_readings]
    score, strength = residual[: len(scale)] * scale, np.maximum(redundancy[: len(scale)], 0.0) * scale**2
    values = log_evidence((score**2)[:, None], strength[:, None]) + log_prior - np.log(len(scale))
    return float(np.maximum(values, 0.0).sum())


def log_means_by_group(values: Floats, groups: Ints, n_groups: int) -> Floats:
    """Log of the mean of exp(values) in each of `n_groups` non-empty groups, for values (k,) or (k, trials)."""
    order = np.argsort(groups, kind="stable")
    starts = np.searchsorted(groups[order], np.arange(n_groups))
    top = np.maximum.reduceat(values[order], starts, axis=0)
    total = np.add.reduceat(np.exp(values[order] - top[groups[order]]), starts, axis=0)
    size = np.bincount(groups, minlength=n_groups).reshape(-1, *([1] * (values.ndim - 1)))
    means: Floats = top + np.log(total / size)
    return means


def log_evidence_of_coefficients(gram: Floats, score: Floats, spread: Floats) -> Floats:
    """Log evidence (...) of coefficients with prior N(0, t^2 spread^2), averaged over sizes.

    Parameters
    ----------
    gram, score, spread : (..., k, k), (..., k), (..., k) float
    """
    strength, turn = _eigen_decomposition(gram, spread)
    return log_evidence((np.swapaxes(turn, -1, -2) @ score[..., None])[..., 0] ** 2, strength)


def coefficient_posterior(
    gram: Floats, score: Floats, spread: Floats, sizes: Floats = EVIDENCE_SIZES, log_weights: Floats = LOG_SIZE_PRIOR
) -> tuple[Floats, Floats, float]:
    """Mean (k,), covariance (k, k) and log evidence of coefficients with prior N(0, t^2 spread^2), averaged over t."""
    strength, turn = _eigen_decomposition(gram, spread)
    z = turn.T @ score
    logs = log_evidence_by_size(z**2, size_weights_and_constants(strength, sizes, log_weights))
    weight = normalised_probabilities(logs)
    variances = sizes[:, None] ** 2 / (1.0 + sizes[:, None] ** 2 * strength)
    means = variances * z
    mean = weight @ means
    deviations = means - mean
    inner = np.diag(weight @ variances) + (weight[:, None] * deviations).T @ deviations
    return turn @ mean, turn @ inner @ turn.T, float(log_sum_exp(logs))


def _eigen_decomposition(gram: Floats, spread: Floats) -> tuple[Floats, Floats]:
    """Eigenvalues (..., k) of Gram matrices in plausible sizes, and the matrix that transforms scores to them."""
    strength, vectors = np.linalg.eigh(gram * spread[..., :, None] * spread[..., None, :])
    return np.maximum(strength, 0.0), spread[..., None] * vectors


MAX_AVERAGED_HYPOTHESES = 12
"""Largest number of hypotheses, the most probable first, over which an estimate is averaged (processor time)."""
N_REFINED = 7
"""Number of hypotheses of a kind (families of effects, of noise, and laws, also at each place), the best ones of an
approximation, that are evaluated without it (processor time).
"""
MAX_REFINED_DEFICIT = 10.0
"""Largest deficit of approximate log evidence of a hypothesis that is evaluated again without approximation: a local
optimum of a family, or a product of a law and a second factor.
"""
WIDE_PRIOR_SIZES = 30.0
"""Prior standard deviation of reported sizes, in plausible sizes: it hardly shrinks them, but keeps undetermined
combinations finite.
"""


def wide_prior_posterior(gram: Floats, score: Floats, spread: Floats) -> tuple[Floats, Floats, float]:
    """Mean (k,), covariance (k, k) and log evidence of coefficients with a prior of `WIDE_PRIOR_SIZES`."""
    return coefficient_posterior(gram, score, spread, np.array([WIDE_PRIOR_SIZES]), np.zeros(1))


def log_sign_weight(mean: float, sigma: float) -> float:
    """Log factor on the evidence of a nonnegative parameter: twice the posterior probability of a positive size."""
    return float(np.log(2.0) + log_ndtr(mean / max(sigma, 1e-300)))


def log_evidence_of_effect(effect: CandidateEffect, gram: Floats, score: Floats) -> float:
    """Log marginal likelihood ratio of an effect from its Gram matrix (k, k) and score (k,), sizes averaged."""
    spread = effect.size_scales
    if not any(p.is_positive for p in effect.parameters):
        return float(log_evidence_of_coefficients(gram, score, spread))
    mean, covariance, total = coefficient_posterior(gram, score, spread)
    for p, m, v in zip(effect.parameters, mean, np.diag(covariance), strict=True):
        total += log_sign_weight(float(m), float(np.sqrt(v))) if p.is_positive else 0.0
    return total


MAX_SIZE_FACTOR = 1e4
"""Largest factor on the plausible size of a tracker: millimetres in place of tenths of a micrometre."""


def noise_level_factor(strength: Floats) -> float:
    """Factor (>= 1) that raises a plausible size to the noise level; smaller effects are undetectable.

    `strength` (n,) is the effect of a plausible size on each pointing over the noise; its median over the affected
    pointings becomes 1.
    """
    positive = np.sort(strength[strength > 0])
    if not len(positive):
        return 1.0
    median = 0.5 * float(positive[(len(positive) - 1) // 2] + positive[len(positive) // 2])
    return 1.0 / min(max(median, 1.0 / MAX_SIZE_FACTOR), 1.0)


MIN_ACTIVE_FRACTION = 0.01
"""Smallest fraction of the squared signature of an observable on which an effect is reported to act."""
MIN_PROJECTED_ACTIVE_FRACTION = 0.1
"""Smallest fraction of the squared projected signature of such an observable: the adjustment spreads a shift of one
observable over the others."""


def active_observables(acts_on: Bools, shift: Floats, projected_shift: Floats) -> tuple[str, ...]:
    """Observables on which an effect acts; empty for all.

    `shift` (r,) is its whitened shift of the readings in `acts_on` (n, 3), `projected_shift` (r,) the projection of
    that.
    """
    active = (_observable_fractions(acts_on, shift) >= MIN_ACTIVE_FRACTION) & (
        _observable_fractions(acts_on, projected_shift) >= MIN_PROJECTED_ACTIVE_FRACTION
    )
    return () if active.all() else tuple(name for name, acts in zip(OBSERVABLES, active.tolist(), strict=True) if acts)


def _observable_fractions(acts_on: Bools, shift: Floats) -> Floats:
    """Fraction (3,) of the squares of a shift (r,) in each observable."""
    kind = np.nonzero(acts_on)[1]
    squares = np.bincount(kind, shift**2, minlength=len(OBSERVABLES))
    fraction: Floats = squares / max(float(squares.sum()), 1e-300)
    return fraction


DISCREPANCY_RATIOS = np.geomspace(0.05, 1.0, 9)
"""Grid of the differences of an unmodelled cause from the best hypothesis, relative to the change by the hypothesis:
log-uniform from hardly visible to 1, a difference as large as the change.
"""


def log_bayes_factor_discrepancy(space: ResidualSpace, shift: Floats, residual: Floats, redundancy: Floats) -> float:
    """Log Bayes factor of an unmodelled cause that resembles a hypothesis, relative to the hypothesis itself.

    Such a cause differs from the hypothesis by a random shift of each reading of standard deviation delta times the rms
    shift in its observable, delta log-uniform over `DISCREPANCY_RATIOS`. The residuals support or contradict that added
    variance through the restricted likelihood; for a weak effect the factor is near 1.

    Parameters
    ----------
    shift : (m,) float
        Whitened shift of the readings by the hypothesis.
    residual, redundancy : (m,) float
        Whitened residuals with the hypothesis modelled, and their redundancy numbers.
    """
    kind = np.nonzero(space.used_readings)[1]
    rows = np.flatnonzero(shift[: len(kind)])
    kind, square, share = kind[rows], residual[rows] ** 2, redundancy[rows]
    count = np.maximum(np.bincount(kind, minlength=3), 1)
    size = (np.bincount(kind, shift[rows] ** 2, minlength=3) / count)[kind]
    variance = 1.0 + DISCREPANCY_RATIOS[:, None] ** 2 * size
    logs = log_restricted_likelihood_ratio(square, share, variance).sum(axis=1)
    return float(log_sum_exp(logs) - np.log(len(DISCREPANCY_RATIOS)))
