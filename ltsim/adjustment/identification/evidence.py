"""Log evidence of hypotheses of unknown size, and their prior odds.

A shift of p components has a prior that is uniform in the logarithm of its size, over `SHIFT_SIZE_DECADES` decades, and
in its direction (Jeffreys). In units of the standard deviations of its estimate, of length w, the marginal likelihood
ratio
against no shift is, by Laplace's method,

    log B = w^2 / 2 - p log w + (p / 2) log(2 pi) - log S_p - log R,

S_p the surface of the unit sphere in p dimensions and R the logarithm of the ratio of the largest size to the smallest.

References
----------
Kass and Raftery, Bayes factors, J. Am. Stat. Assoc. 90 (1995) 773; Jeffreys, Theory of probability (1961), 3.1.
"""

import numpy as np
from scipy import special

from ltsim.core.arrays import Floats

SHIFT_SIZE_DECADES = 6.0
"""Decades between the smallest and the largest size of a shift in its prior: 10 um and 10 m."""
LOG_SIZE_PRIOR_WIDTH = float(np.log(SHIFT_SIZE_DECADES * np.log(10.0)))
"""Log of the width, in natural logarithms of the size, of the log-uniform prior of a shift."""


def log_occam_factor_of_shift(normalised_size: Floats | float, rank: int) -> Floats:
    """Log of the Occam factor (at most 0) of shifts of `rank` components; sizes in standard deviations."""
    size = np.maximum(np.asarray(normalised_size, dtype=np.float64), np.sqrt(rank))
    log_surface = np.log(2.0) + 0.5 * rank * np.log(np.pi) - special.gammaln(0.5 * rank)
    return np.minimum(0.5 * rank * np.log(2.0 * np.pi) - log_surface - LOG_SIZE_PRIOR_WIDTH - rank * np.log(size), 0.0)


FACTOR_DECADES = 2.0
"""Decades of the prior of the ratio of the noise to the declared noise, in both directions."""


def log_occam_factor_of_variance(redundancy: Floats | float) -> Floats:
    """Log of the Occam factor of a variance factor that is determined with the given redundancy."""
    width = np.sqrt(np.pi / np.maximum(np.asarray(redundancy, dtype=np.float64), 1.0))
    return np.minimum(np.log(width / (2.0 * FACTOR_DECADES * np.log(10.0))), 0.0)


def estimate_variance_factor(sum_of_squares: Floats, redundancy: Floats) -> tuple[Floats, Floats]:
    """Restricted maximum likelihood estimate of a common factor on standard deviations, and its log likelihood ratio.

    The arguments are weighted sums of squares and redundancies of groups of readings (g,).
    """
    is_sufficient = np.asarray(redundancy) > 1.0
    ratio = np.where(is_sufficient, sum_of_squares / np.where(is_sufficient, redundancy, 1.0), 1.0)
    ratio = np.maximum(ratio, 10.0 ** (-2.0 * FACTOR_DECADES))  # exact readings have no noise to be estimated
    gain = 0.5 * (sum_of_squares - redundancy) - 0.5 * redundancy * np.log(ratio)
    return np.sqrt(ratio), np.where(is_sufficient, gain, 0.0)


def log_occam_factor_of_centring(covariance: Floats, sigma: float) -> float:
    """Log of the Occam factor of centring errors with prior N(0, sigma^2) and a posterior covariance (q, q) [m^2].

    The determinant of the posterior covariance relative to the prior one is that of the change of the readings'
    covariance in the residual space.
    """
    relative = np.linalg.eigvalsh(covariance) / sigma**2
    determined = float(np.sum(np.maximum(1.0 - relative, 0.0)))
    determinant = float(np.sum(np.log(np.clip(relative, 1e-300, 1.0))))
    return 0.5 * determinant + float(log_occam_factor_of_variance(determined))


PRIOR_FRACTION_BY_KIND = {
    "outlier": 0.2,
    "constant-offset": 0.15,
    "constant-step": 0.03,
    "constant-drift": 0.03,
    "scale-error": 0.05,
    "target-moved": 0.1,
    "station-bump": 0.1,
    "station-drift": 0.05,
    "orientation": 0.04,
    "reflector-radius": 0.01,
    "reference-value": 0.07,
    "reference-scale": 0.03,
    "names": 0.05,
    "unit": 0.05,
    "height": 0.05,
    "noise-level": 0.05,
    "centring": 0.02,
}
"""Fraction of the prior probability of all causes that each kind has; its places share it equally."""


LOG_ODDS_OF_CENTRING = -30.0
"""Log odds of centring errors, in addition to their prior fraction: the margin by which they must exceed other causes.

Displacements of many targets fit any smooth misfit of the model, of which about a tenth of the gain is real; the margin
is that of other hypotheses in a network with a misfit (`selection.MIN_LOG_EVIDENCE_GAIN_WITH_MISFIT`).
"""


def log_prior_of(kind: str, n_places: int) -> float:
    """Log prior of a cause of the given kind at one of the given number of places."""
    return float(np.log(PRIOR_FRACTION_BY_KIND[kind] / max(n_places, 1)))
