"""Estimation of the sizes of a noise hypothesis by restricted likelihood.

Sizes of arrays below: m observation equations, n pointings, k variance parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.special import expit

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.adjustment.significance import MAX_CHANCE_SIGMAS
from ltsim.calibration.evidence import log_sum_exp
from ltsim.core.arrays import Floats
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE
from ltsim.diagnosis.evidence import log_restricted_likelihood_ratio, normalised_probabilities
from ltsim.diagnosis.noise_centring import with_estimated_centring
from ltsim.diagnosis.noise_groups import (
    COARSE_GROUP_VARIANCE_FACTORS,
    GROUP_VARIANCE_FACTORS,
    HEAVY_TAIL_VARIANCE_FACTORS,
    NOISY_GROUP_FRACTIONS,
)
from ltsim.diagnosis.noise_hypothesis import NoiseHypothesis
from ltsim.diagnosis.repeats import added_variance_of_means, normalised_sum_matrix_of_repeats, redundancy_of_means
from ltsim.physics.effects.linear_effect import CandidateNoiseEffect
from ltsim.physics.laws.variance import CentringVariance

N_VARIANCE_GRID_VALUES = 7
"""Number of points of each grid for the sum over the posterior distribution of a variance parameter."""
N_VARIANCE_GRID_ZOOMS = 9
"""Number of successively narrower grids for the sum over the posterior distribution of a variance parameter. The sum
over a normal density is accurate for spacings of up to 1.5 standard deviations."""


def reml_gain_function(
    space: ResidualSpace, sigma: Floats, effect: CandidateNoiseEffect, residual: Floats, redundancy: Floats
) -> Callable[[Floats], Floats]:
    """Function from the values (k,) of k variance parameters to the gain (k,) of log likelihood by each parameter.

    The residual space is the space of whitened observations without the part that the unknowns absorb. The likelihood
    is the restricted likelihood. Each reading depends on at most one parameter. The effect changes the standard
    deviations `sigma` (n, 3) of n pointings, while the m residuals (m,) are whitened by the standard deviations of the
    residual space.
    """
    faces, used, scale = getattr(effect, "shared_error_repetition", ""), space.is_used_reading, effect.plausible_sizes
    means = normalised_sum_matrix_of_repeats(space, faces) if faces else None
    share = redundancy[: int(used.sum())] if means is None else redundancy_of_means(means, redundancy)
    squares = residual[: len(share)] ** 2 if means is None else (means @ residual) ** 2

    def variance_factors_at(values: Floats) -> Floats:
        """Variance factors (m,) of m observation equations at the values (k,) of the variance parameters."""
        factor = (effect.variance(space.sightings, sigma, values) / space.reading_sigmas**2)[used]
        return factor if means is None else 1.0 + added_variance_of_means(means, factor - 1.0)

    parameter = np.argmax(
        [variance_factors_at(unit) != variance_factors_at(0.0 * scale) for unit in np.diag(scale)], axis=0
    )

    def reml_gain_at(values: Floats) -> Floats:
        """Gain (k,) of restricted log likelihood by each of k variance parameters at the values (k,)."""
        factor = variance_factors_at(values)
        with np.errstate(invalid="ignore", divide="ignore"):
            each = np.where(factor > 0.0, log_restricted_likelihood_ratio(squares, share, factor), -np.inf)
        return np.asarray(np.bincount(parameter, each, minlength=len(scale)), dtype=np.float64)

    return reml_gain_at


def _log_likelihood_ratios_of_groups(
    reml_gain: Callable[[Floats], Floats], n_groups: int, variance_factors: Floats
) -> Floats:
    """Log restricted likelihood ratios (f, k) of k groups of readings, with f variance factors against declared noise.

    `reml_gain` is a function: the gain (k,) of restricted log likelihood by each of k changes of variance factors.
    """
    base_gain = reml_gain(np.zeros(n_groups))
    return np.stack([reml_gain(np.full(n_groups, factor - 1.0)) - base_gain for factor in variance_factors])


def _log_likelihood_by_fraction(log_ratios: Floats) -> Floats:
    """Log likelihood (q,) of each of the q fractions of noisy groups in `NOISY_GROUP_FRACTIONS`.

    `log_ratios` (f, k) are the log likelihood ratios of k groups of readings for f variance factors, which have equal
    prior probabilities for a noisy group.
    """
    noisy = log_sum_exp(log_ratios) - np.log(len(log_ratios))
    return np.stack([np.logaddexp(np.log1p(-q), np.log(q) + noisy).sum() for q in NOISY_GROUP_FRACTIONS])


def _with_occam_factor(hypothesis: NoiseHypothesis, log_ratios: Floats) -> NoiseHypothesis:
    """Copy of a hypothesis of separate noise of k groups of readings, with its Occam factor.

    The Occam factor is the evidence divided by the largest likelihood. `log_ratios` (f, k) are the log likelihood
    ratios of the groups for f variance factors.
    """
    log_evidence = log_sum_exp(_log_likelihood_by_fraction(log_ratios)) - np.log(len(NOISY_GROUP_FRACTIONS))
    return replace(hypothesis, log_occam_factor=float(log_evidence) - 0.5 * hypothesis.chi2_drop)


def _heavy_tail_with_variances(hypothesis: NoiseHypothesis, reml_gain: Callable[[Floats], Floats]) -> NoiseHypothesis:
    """Hypothesis of a heavy tail with an estimated variance of each reading, the inverse of its expected weight.

    Let p be the probability that a reading is in the tail, where its variance is multiplied by a factor f. Its expected
    weight is (1 - p) + p E[1 / f], as in the EM algorithm for scale mixtures (Little 1988, Applied Statistics 37, 23).
    The fraction of readings in the tail is the fraction with the largest likelihood. `reml_gain` is the function from
    variance parameters to the gain of restricted log likelihood by each of them.
    """
    n_readings = len(hypothesis.effect.parameters)
    log_ratios = _log_likelihood_ratios_of_groups(reml_gain, n_readings, HEAVY_TAIL_VARIANCE_FACTORS)
    q = float(NOISY_GROUP_FRACTIONS[int(np.argmax(_log_likelihood_by_fraction(log_ratios)))])
    inside = expit(log_sum_exp(log_ratios) - np.log(len(log_ratios)) + np.log(q / (1.0 - q)))
    weight = (
        1.0
        - inside
        + inside * (normalised_probabilities(log_ratios) / HEAVY_TAIL_VARIANCE_FACTORS[:, None]).sum(axis=0)
    )
    values = 1.0 / weight - 1.0
    drop, sigma = (
        2.0 * float((reml_gain(values) - reml_gain(np.zeros(n_readings))).sum()),
        np.sqrt(2.0) * (1.0 + values),  # standard deviation of the variance of a single reading
    )
    estimated = replace(hypothesis, sizes=tuple(values.tolist()), chi2_drop=drop, size_sigmas=tuple(sigma.tolist()))
    return _with_occam_factor(estimated, log_ratios)


def with_estimated_sizes(space: ResidualSpace, nominal_sigma: Floats, hypothesis: NoiseHypothesis) -> NoiseHypothesis:
    """Copy of a hypothesis with estimated sizes, their standard deviations, and its `chi2_drop`.

    The hypothesis changes the standard deviations `nominal_sigma` (n, 3) of the readings of n pointings. The estimates
    are posterior means and standard deviations with a log-uniform prior of the variance factor, because the likelihood
    of a variance is skew. The posteriors of several sizes are independent, because each reading depends on one size
    only. A size on which no reading depends is 0 with an infinite standard deviation.
    """
    effect, scale = hypothesis.effect, hypothesis.effect.plausible_sizes
    if isinstance(effect, CentringVariance):
        return with_estimated_centring(space, hypothesis)
    reml_gain = reml_gain_function(space, nominal_sigma, effect, space.whitened_residuals, space.redundancy)
    if getattr(effect, "group_kind", "") == "reading":
        return _heavy_tail_with_variances(hypothesis, reml_gain)
    least = np.full(len(scale), np.log1p(effect.min_relative_size))
    most = np.full(len(scale), np.log1p(GROUP_VARIANCE_FACTORS.max()))
    least_step = float(np.log(GROUP_VARIANCE_FACTORS[1] / GROUP_VARIANCE_FACTORS[0]))
    for _ in range(N_VARIANCE_GRID_ZOOMS):  # noise may be larger than the factors over which evidence is averaged
        rise = reml_gain(scale * np.expm1(most + least_step)) - reml_gain(scale * np.expm1(most))
        is_larger = rise > NORMAL_EQUATIONS_TOLERANCE
        if not is_larger.any():
            break
        most = np.where(is_larger, 2.0 * most, most)
    low, high = least, most
    for _ in range(N_VARIANCE_GRID_ZOOMS):
        points = np.linspace(low, high, N_VARIANCE_GRID_VALUES)
        sizes = scale * np.expm1(points)
        ratio = np.array([reml_gain(size) for size in sizes])
        weight, felt = normalised_probabilities(ratio), np.ptp(ratio, axis=0) > 0.0
        mean = np.sum(weight * points, axis=0)
        spread = np.sqrt(np.sum(weight * (points - mean) ** 2, axis=0))
        spread = np.maximum(spread, 0.4 * (high - low) / (N_VARIANCE_GRID_VALUES - 1))
        low, high = (
            np.maximum(least, mean - MAX_CHANCE_SIGMAS * spread),
            np.minimum(most, mean + MAX_CHANCE_SIGMAS * spread),
        )
    values = np.where(felt, np.sum(weight * sizes, axis=0), 0.0)
    sigma = np.where(felt, np.sqrt(np.sum(weight * (sizes - values) ** 2, axis=0)), np.inf)
    gain = reml_gain(values) - reml_gain(0.0 * scale)
    if getattr(effect, "group_kind", ""):  # most groups have no added variance: weight by its probability
        values = values * expit(gain + np.log(NOISY_GROUP_FRACTIONS.min() / (1.0 - NOISY_GROUP_FRACTIONS.min())))
        gain = reml_gain(values) - reml_gain(0.0 * scale)
    drop = 2.0 * float(gain.sum())
    estimated = replace(hypothesis, sizes=tuple(values.tolist()), chi2_drop=drop, size_sigmas=tuple(sigma.tolist()))
    if not getattr(effect, "group_kind", ""):
        return estimated
    return _with_occam_factor(
        estimated, _log_likelihood_ratios_of_groups(reml_gain, len(scale), COARSE_GROUP_VARIANCE_FACTORS)
    )
