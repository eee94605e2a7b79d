"""Log evidence of errors of unknown size, and prior probabilities of their kinds.

A shift of readings with p components has a prior that is uniform in its direction and in the logarithm of its size
(Jeffreys), over `SHIFT_SIZE_DECADES` decades. With w the length of the estimate in its standard deviations, Laplace's
method gives the logarithm of the marginal likelihood ratio (Bayes factor) against no shift,

    log B = w^2 / 2 - p log w + (p / 2) log(2 pi) - log S_p - log R.

S_p is the surface of the unit sphere in p dimensions, R the logarithm of the ratio of the largest size to the smallest.

References
----------
Kass and Raftery, Bayes factors, J. Am. Stat. Assoc. 90 (1995) 773; Jeffreys, Theory of probability (1961), 3.1.
"""

from collections.abc import Sequence

import numpy as np
from scipy import special

from ltsim.core.arrays import Bools, Floats
from ltsim.solve.gauss_newton import MAX_ITERATIONS

SHIFT_SIZE_DECADES = 6.0
"""Width, in decades, of the prior distribution of the size of a shift of readings: 10 um to 10 m are possible."""
LOG_OF_LOG_SIZE_PRIOR_WIDTH = float(np.log(SHIFT_SIZE_DECADES * np.log(10.0)))
"""Term log R of the log evidence of a shift of readings. R is the width of the prior of the natural logarithm of its
size."""


def log_occam_factor_of_shift(normalised_size: Floats | float, rank: int) -> Floats:
    """Logarithms (at most 0) of the Occam factors of shifts of readings with `rank` components.

    `normalised_size` is the length of each estimated shift, in standard deviations of the estimate; the result has its
    shape.
    """
    size = np.maximum(np.asarray(normalised_size, dtype=np.float64), np.sqrt(rank))
    log_surface = np.log(2.0) + 0.5 * rank * np.log(np.pi) - special.gammaln(0.5 * rank)
    return np.minimum(
        0.5 * rank * np.log(2.0 * np.pi) - log_surface - LOG_OF_LOG_SIZE_PRIOR_WIDTH - rank * np.log(size), 0.0
    )


NOISE_FACTOR_HALF_WIDTH_DECADES = 2.0
"""Half-width, in decades, of the prior distribution of a factor on the declared noise: factors of 0.01 to 100."""


def log_occam_factor_of_variance(redundancy: Floats | float) -> Floats:
    """Logarithm (at most 0) of the Occam factor of a variance factor, estimated from residuals with `redundancy`."""
    width = np.sqrt(np.pi / np.maximum(np.asarray(redundancy, dtype=np.float64), 1.0))
    return np.minimum(np.log(width / (2.0 * NOISE_FACTOR_HALF_WIDTH_DECADES * np.log(10.0))), 0.0)


def estimate_noise_factors_of_groups(sum_of_squares: Floats, redundancy: Floats) -> tuple[Floats, Floats]:
    """Factors (g,) on the noise of g groups of readings, and the gains (g,) of log likelihood by these factors.

    The estimates are those of restricted maximum likelihood. A gain is relative to the declared noise. The arguments
    are the weighted sums of squared residuals (g,) and the redundancies (g,) of the groups.
    """
    is_sufficient = np.asarray(redundancy) > 1.0
    ratio = np.where(is_sufficient, sum_of_squares / np.where(is_sufficient, redundancy, 1.0), 1.0)
    ratio = np.maximum(
        ratio, 10.0 ** (-2.0 * NOISE_FACTOR_HALF_WIDTH_DECADES)
    )  # the noise of exact readings cannot be estimated
    gain = 0.5 * (sum_of_squares - redundancy) - 0.5 * redundancy * np.log(ratio)
    return np.sqrt(ratio), np.where(is_sufficient, gain, 0.0)


RELATIVE_NOISE_FACTOR_TOLERANCE = 0.01
"""Relative change of noise factors at which their iteration ends. The relative standard deviation of a factor is larger
than this limit if it is estimated from fewer than 5,000 readings."""


def estimate_noise_factors(squared_residuals: Floats, redundancy: Floats, reading_masks: Sequence[Bools]) -> Floats:
    """Factors (n, 3) on the standard deviations of the readings of n pointings, as products of one factor per mask.

    Each of the `reading_masks` (n, 3) flags the readings of one factor. Factors of overlapping masks are estimated in
    turn, each with the other factors fixed, until they no longer change. `squared_residuals` (n, 3) are the squared
    residuals in units of the declared variance, `redundancy` (n, 3) the redundancy numbers; both are 0 for readings
    that are not in use.
    """
    log_factors, factors = np.zeros(len(reading_masks)), np.ones(squared_residuals.shape)
    for _ in range(MAX_ITERATIONS):
        before = log_factors.copy()
        for i, mask in enumerate(reading_masks):
            others = np.where(mask, factors * np.exp(-log_factors[i]), factors)
            sums = np.array([np.sum((squared_residuals / others**2)[mask]), np.sum(redundancy[mask])])
            (factor,), _ = estimate_noise_factors_of_groups(sums[:1], sums[1:])
            log_factors[i] = np.log(factor)
            factors = np.where(mask, others * factor, others)
        if not np.abs(log_factors - before).max() > RELATIVE_NOISE_FACTOR_TOLERANCE:
            break
    return factors


def log_occam_factor_of_centring(covariance: Floats, sigma: float) -> float:
    """Logarithm of the Occam factor of centring errors: q displacement components with the prior N(0, `sigma`^2) [m].

    `covariance` (q, q) [m^2] is their posterior covariance. The Occam factor of the displacements is the square root of
    the ratio of posterior to prior determinant; a second factor is due to the estimation of `sigma`.
    """
    relative = np.linalg.eigvalsh(covariance) / sigma**2
    determined = float(np.sum(np.maximum(1.0 - relative, 0.0)))
    determinant = float(np.sum(np.log(np.clip(relative, 1e-300, 1.0))))
    return 0.5 * determinant + float(log_occam_factor_of_variance(determined))


PRIOR_PROBABILITY_BY_CAUSE_KIND = {
    "outlier": 0.2,
    "constant-offset": 0.15,
    "constant-step": 0.03,
    "constant-drift": 0.03,
    "scale-error": 0.05,
    "target-moved": 0.1,
    "station-bump": 0.1,
    "station-drift": 0.03,
    "station-settling": 0.02,
    "orientation": 0.04,
    "reflector-radius": 0.01,
    "reflector-seating": 0.03,
    "reference-value": 0.07,
    "reference-scale": 0.03,
    "names": 0.05,
    "unit": 0.05,
    "height": 0.05,
    "noise-level": 0.05,
    "centring": 0.02,
}
"""Prior probability of each kind of cause, given that a network contains an error. All stations, targets or readings
where the kind is possible share this probability equally.
"""


LOG_PRIOR_ODDS_OF_CENTRING = -30.0
"""Logarithm of the prior odds of centring errors against other causes of a misfit.

Centring errors are selected only if their log evidence exceeds that of other causes by 30. Displacements of many
targets fit any smooth unmodelled error, so that only about a tenth of their gain of log evidence is real. If the noise
of all readings is larger than declared, which indicates an unmodelled error, other hypotheses need the same gain.
"""


def log_prior_of_kind(kind: str, n_places: int) -> float:
    """Logarithm of the prior probability of a kind of cause at one of the `n_places` stations, targets or readings."""
    return float(np.log(PRIOR_PROBABILITY_BY_CAUSE_KIND[kind] / max(n_places, 1)))
