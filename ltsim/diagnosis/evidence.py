"""The one evidence of a diagnosis: log marginal likelihoods.

In the residual space (whitened residuals r, projector P off all that the ordinary adjustment estimates) a hypothesis
with signature g and coefficients b ~ N(0, t^2 L), L the squares of plausible sizes, has the marginal likelihood ratio
against none
    log B = sum_j [ z_j^2 t^2 / (1 + t^2 d_j) - log(1 + t^2 d_j) ] / 2,
d_j the eigenvalues of L^1/2 g' P g L^1/2 and z_j the scores L^1/2 g' r along its eigenvectors. It is averaged over
sizes t, because nobody knows how strong an effect is. Places, shapes and scales are averaged as well: whoever tries
more of them pays for it. Changes of the noise are averaged over a grid of sizes and enter by their restricted
likelihood.

References
----------
MacKay, Information theory, inference and learning algorithms (2003), chapter 28 (evidence and Occam factors);
Rasmussen and Williams, Gaussian processes for machine learning (2006), section 5.4.
"""

from collections.abc import Iterator

import numpy as np
from scipy.special import log_ndtr

from ltsim.calibration.evidence import LOG_WEIGHTS, SIZES, by_size, forms_of, log_evidence, log_sum_exp
from ltsim.core.arrays import Bools, Floats, Ints, Singles
from ltsim.physics.effects.signature import Tunable
from ltsim.recordings.recording import OBSERVABLES

TIE, SCREENED_TIE = 1e-6, 1e-4
"""[log evidence] Values that differ by less are equal: double precision, and single, round differently by the order of
a sum, which a matrix library chooses by the processor. A choice between them must not follow the rounding.
"""


def best_of(values: Floats) -> int:
    """Index of the largest value; of equal ones, as along a plateau, that in their middle."""
    best = np.flatnonzero(values >= np.max(values) - TIE)
    return int(best[(len(best) - 1) // 2])


def ranked(values: Floats, tie: float = TIE) -> Ints:
    """Indices by falling value; values that are equal to their neighbours within `tie` in their given order."""
    falling = np.nan_to_num(-values)
    order = np.argsort(falling, kind="stable")
    group = np.cumsum(np.diff(falling[order]) > tie)
    return order[np.lexsort((order, np.append(0, group)[: len(order)]))]


def shares(logs: Floats) -> Floats:
    """Probabilities (k,) of what has such logarithms."""
    found: Floats = np.exp(logs - log_sum_exp(logs))
    return found


AT_ONCE = 500_000
"""Simulated scores whose evidence is computed at once: memory of some tens of MB."""


def simulated_evidence(scores: Floats, strength: Floats) -> Floats:
    """`log_evidence` (h, trials) of scores (h, k, trials) of simulated residuals, in single precision."""
    parts = [_summed(logs, 1) for logs in _simulated(scores, strength, np.zeros(len(scores)))]
    found: Floats = np.concatenate(parts).astype(np.float64)
    return found


def simulated_total(scores: Singles, strength: Floats, log_prior: Floats) -> Floats:
    """Log of the sum (trials,) over all hypotheses, each with its prior (h,)."""
    flat = scores.reshape(-1, *scores.shape[-2:]), strength.reshape(-1, scores.shape[-2])
    parts = [_summed(logs, (0, 1)) for logs in _simulated(*flat, log_prior)]
    return log_sum_exp(np.stack(parts).astype(np.float64))


def _simulated(scores: Floats | Singles, strength: Floats, log_prior: Floats) -> Iterator[Singles]:
    """Log evidence with priors (h, sizes, trials), of some hypotheses at a time."""
    step = max(1, AT_ONCE * len(scores) // max(scores.size, 1))
    for i in range(0, len(scores), step):
        weights, constants = forms_of(strength[i : i + step])
        constants += log_prior[i : i + step, None]
        logs = np.swapaxes(weights, -1, -2).astype(np.float32) @ np.square(scores[i : i + step], dtype=np.float32)
        logs += constants[..., None].astype(np.float32)
        yield logs


def _summed(logs: Singles, axis: int | tuple[int, ...]) -> Singles:
    """Log of the sum of exp(logs) along axes; overwrites them."""
    top = logs.max(axis=axis, keepdims=True)
    np.exp(np.subtract(logs, top, out=logs), out=logs)
    found: Singles = np.log(logs.sum(axis=axis)) + top.squeeze(axis)
    return found


def restricted(squares: Floats, share: Floats, factor: Floats) -> Floats:
    """Log restricted likelihood ratio of variances `factor` times as large, in its diagonal form, reading by reading.

    By squares of whitened residuals and the redundancies of the readings, or by sums of both over readings alike.
    """
    ratio: Floats = 0.5 * (squares * (1.0 - 1.0 / factor) - share * np.log(factor))
    return ratio


def log_means(values: Floats, groups: Ints, count: int) -> Floats:
    """Log of the mean of exp(values) of each of `count` groups, none of them empty; (k,) or (k, trials) values."""
    order = np.argsort(groups, kind="stable")
    starts = np.searchsorted(groups[order], np.arange(count))
    top = np.maximum.reduceat(values[order], starts, axis=0)
    total = np.add.reduceat(np.exp(values[order] - top[groups[order]]), starts, axis=0)
    size = np.bincount(groups, minlength=count).reshape(-1, *([1] * (values.ndim - 1)))
    means: Floats = top + np.log(total / size)
    return means


def evidence_with(gram: Floats, score: Floats, spread: Floats) -> Floats:
    """Log evidence (...) of coefficients with prior N(0, t^2 spread^2), averaged over sizes.

    Parameters
    ----------
    gram, score, spread : (..., k, k), (..., k), (..., k) float
    """
    strength, turn = _along_eigenvectors(gram, spread)
    return log_evidence((np.swapaxes(turn, -1, -2) @ score[..., None])[..., 0] ** 2, strength)


def posterior(
    gram: Floats, score: Floats, spread: Floats, sizes: Floats = SIZES, log_weights: Floats = LOG_WEIGHTS
) -> tuple[Floats, Floats, float]:
    """Mean (k,), covariance (k, k) and log evidence of coefficients with prior N(0, t^2 spread^2), averaged over t."""
    strength, turn = _along_eigenvectors(gram, spread)
    z = turn.T @ score
    logs = by_size(z**2, forms_of(strength, sizes, log_weights))
    weight = shares(logs)
    variances = sizes[:, None] ** 2 / (1.0 + sizes[:, None] ** 2 * strength)
    means = variances * z
    mean = weight @ means
    apart = means - mean
    inner = np.diag(weight @ variances) + (weight[:, None] * apart).T @ apart
    return turn @ mean, turn @ inner @ turn.T, float(log_sum_exp(logs))


def _along_eigenvectors(gram: Floats, spread: Floats) -> tuple[Floats, Floats]:
    """Eigenvalues (..., k) of Gram matrices in units of plausible sizes, and what turns scores along their vectors."""
    strength, vectors = np.linalg.eigh(gram * spread[..., :, None] * spread[..., None, :])
    return np.maximum(strength, 0.0), spread[..., None] * vectors


WIDE = 30.0
"""Plausible sizes to which what is told of a finding is held: what the readings hardly determine stays uncertain."""


def wide_posterior(gram: Floats, score: Floats, spread: Floats) -> tuple[Floats, Floats, float]:
    """Mean (k,), covariance (k, k) and log evidence of coefficients that are held to `WIDE` plausible sizes alone."""
    return posterior(gram, score, spread, np.array([WIDE]), np.zeros(1))


def sign_weight(mean: float, sigma: float) -> float:
    """Log factor on the evidence of what is never negative: twice the posterior chance of a positive size."""
    return float(np.log(2.0) + log_ndtr(mean / max(sigma, 1e-300)))


def evidence_of(effect: Tunable, gram: Floats, score: Floats) -> float:
    """Log marginal likelihood ratio of an effect from its Gram matrix (k, k) and score (k,), sizes averaged."""
    spread = effect.spread
    if not any(p.positive for p in effect.parameters):
        return float(evidence_with(gram, score, spread))
    mean, covariance, total = posterior(gram, score, spread)
    for p, m, v in zip(effect.parameters, mean, np.diag(covariance), strict=True):
        total += sign_weight(float(m), float(np.sqrt(v))) if p.positive else 0.0
    return total


COARSEST = 1e4
"""Times a tracker's errors that any instrument's are: millimetres for tenths of a micrometre."""


def times_to_noise(strength: Floats) -> float:
    """Times a plausible size that reaches the noise, one at least: nobody models what no reading feels.

    By what that size does to each pointing (n,), in units of the noise: the median of those that it touches counts.
    """
    touched = strength[strength > 0]
    return 1.0 / float(np.clip(np.median(touched), 1.0 / COARSEST, 1.0)) if len(touched) else 1.0


DONE, SEEN = 0.01, 0.1
"""Shares of the squares of what an effect does to the readings, and of what an adjustment leaves of that, from which it
is said to act on an observable: what one observable is given, an adjustment hands on to others."""


def shown_in(use: Bools, done: Floats, left: Floats) -> tuple[str, ...]:
    """The observables on which an effect acts and in which it shows; empty where it does in all.

    By what it does to the readings in `use` (n, 3), and what is left of that: both (r,), whitened.
    """
    seen = (_share(use, done) >= DONE) & (_share(use, left) >= SEEN)
    return () if seen.all() else tuple(name for name, one in zip(OBSERVABLES, seen.tolist(), strict=True) if one)


def _share(use: Bools, shift: Floats) -> Floats:
    """Share (3,) of the squares of a shift (r,) in each observable."""
    kind = np.nonzero(use)[1]
    squares = np.bincount(kind, shift**2, minlength=len(OBSERVABLES))
    found: Floats = squares / max(float(squares.sum()), 1e-300)
    return found
