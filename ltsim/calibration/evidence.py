"""Information of the readings of calibrations, score tests of changes, determined combinations, and log evidences."""

import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from ltsim.adjustment.remedies.undetermined import MAX_UNINFORMATIVE_GAIN
from ltsim.adjustment.significance import MIN_SIGNIFICANT_SIGMAS
from ltsim.calibration.combinations import DeterminedEntry
from ltsim.calibration.schema import HarmonicEntry
from ltsim.core import probability
from ltsim.core.arrays import Floats
from ltsim.core.units import DEGREE
from ltsim.physics.effects.linear_effect import Parameter

MAX_COMBINED_TO_UNCORRELATED_SIGMA_RATIO = 0.25
"""Largest ratio of the standard deviation of a reported combination of parameters to its value for uncorrelated
estimates of the parameters. A reported combination is thus determined at least four times better than its parameters
suggest."""
MAX_TRUNCATED_TO_FULL_SIGMA_RATIO = 1.2
"""Limit of the factor by which the standard deviation of a combination of parameters increases if the parameters with
the smallest coefficients are omitted. They are omitted only if the factor is smaller."""
MIN_RELATIVE_REFERENCE_COEFFICIENT = 0.5
"""Smallest coefficient, relative to the largest one of a combination, of the reference parameter, which gets the
coefficient 1. The first such parameter in the order of the model is used, for example the vertical index rather than
a harmonic of the circle."""
RELATIVE_EFFECT_SIZES = np.array(list(probability.PRIOR_BY_RELATIVE_EFFECT_SIZE))
"""Sizes of an effect, relative to its plausible size, over which the evidence is averaged."""
LOG_PRIOR_OF_EFFECT_SIZES = np.log(np.array(list(probability.PRIOR_BY_RELATIVE_EFFECT_SIZE.values())))
"""Logarithms of the prior probabilities of the sizes in `RELATIVE_EFFECT_SIZES`."""
MAX_ENTRIES_FOR_SINGLE_LOG_SUM_EXP_CALL = 100
"""Largest number of array entries in a single NumPy call of log-sum-exp. For larger arrays several vectorised calls are
faster."""
_COSINE_NAME_PATTERN = re.compile(r"^(?P<front>.+[-_])cos(?P<order>\d?)$")
"""Regular expression of the names of cosine parameters, such as ``azimuth-eccentricity-cos`` and ``J1.eY_cos2``
(order 2)."""


@dataclass(frozen=True)
class LikelihoodInformation:
    """Information of the readings of a calibration, without its prior, in units of prior standard deviations."""

    posterior_covariance: Floats
    """Covariance of the estimates, shape (parameters, parameters)."""
    information_matrix: Floats
    """Information matrix of the readings (posterior minus prior precision), shape (parameters, parameters).

    Combinations whose prior variance the readings hardly reduce (gain below `MAX_UNINFORMATIVE_GAIN`) have zero
    information.
    """
    information_vector: Floats
    """Product of the information matrix and the estimate from the readings alone, shape (parameters,)."""


def likelihood_information(
    estimates: Floats, covariance: Floats, prior_sigma: Floats, unit: Floats
) -> LikelihoodInformation:
    """Information of the readings, from estimates that were computed with a prior of mean zero.

    `estimates`, `prior_sigma` and `unit` have the shape (parameters,) [SI], `covariance` the shape (parameters,
    parameters). The result is in multiples of `unit`.
    """
    prior = prior_sigma / unit
    remaining = covariance / np.outer(unit, unit)
    shares, vectors = linalg.eigh(remaining / np.outer(prior, prior))
    informative = 1.0 - shares > MAX_UNINFORMATIVE_GAIN
    inverse = np.where(informative, 1.0 / np.where(informative, shares, 1.0), 0.0)
    basis = vectors / prior[:, None]
    information = (basis * np.where(informative, inverse - 1.0, 0.0)) @ basis.T
    information_vector = (basis * inverse) @ basis.T @ (estimates / unit)
    return LikelihoodInformation(0.5 * (remaining + remaining.T), information, information_vector)


def change_score_and_information(information: Floats, score: Floats, prior_covariance: Floats) -> tuple[Floats, Floats]:
    """Score vector and information matrix of a change of single parameters, for score tests.

    The null hypothesis is that all parameters changed at random with the covariance `prior_covariance` (parameters,
    parameters). `score` (parameters,) is the information vector minus the information matrix `information` (parameters,
    parameters) times the expected parameters. The result is a vector s (parameters,) and a matrix M (parameters,
    parameters). The quotient s[k] / M[k, k] estimates a change of parameter number k alone, with the variance 1 / M[k,
    k].
    """
    keeps = np.linalg.inv(np.eye(len(score)) + information @ prior_covariance)
    return keeps @ score, keeps @ information


def log_marginal_likelihood(
    likelihood_information: LikelihoodInformation, mean: Floats, prior_covariance: Floats
) -> float:
    """Log marginal likelihood of a calibration for parameters with a normal prior, up to a constant.

    The likelihood exp(b'x - x'N x / 2), with the information matrix N and the information vector b, is averaged over x
    ~ N(`mean`, `prior_covariance`).
    """
    information, vector = likelihood_information.information_matrix, likelihood_information.information_vector
    score = vector - information @ mean
    keeps = np.eye(len(score)) + information @ prior_covariance
    gain = score @ prior_covariance @ np.linalg.solve(keeps, score)
    return float(vector @ mean + 0.5 * (gain - mean @ information @ mean - np.linalg.slogdet(keeps)[1]))


def forward_select(score_function: Callable[[Collection[int]], Floats], min_score: float) -> dict[int, Floats]:
    """Index of each parameter change that forward selection chose, with the scores of all changes at that step.

    `score_function` returns the score of each candidate change, given the indices of the changes selected so far. The
    change with the largest score is added while this score exceeds `min_score`. After each addition, every earlier
    change is exchanged for the change with the largest score given the other selected changes.
    """
    odds_by_index: dict[int, Floats] = {}
    while (values := score_function(odds_by_index)).max(initial=-np.inf) > min_score:
        odds_by_index[int(np.argmax(values))] = values
        for previous in list(odds_by_index)[:-1]:
            values = score_function([k for k in odds_by_index if k != previous])
            del odds_by_index[previous]
            odds_by_index[int(np.argmax(values))] = values
    return odds_by_index


def estimates_with_plausible_priors(
    parameters: Sequence[Parameter], estimates: Floats, covariance: Floats, prior_sigma: Floats
) -> tuple[Floats, Floats]:
    """Estimates and covariance [SI] if the prior standard deviation of each parameter is its plausible size.

    A tighter prior would conceal combinations that the readings determine. `estimates` and `prior_sigma` have the shape
    (parameters,), `covariance` (parameters, parameters).
    """
    free_indices = np.flatnonzero(np.diag(covariance) > 0)
    unit, block = np.array([p.prior_sigma for p in parameters])[free_indices], np.ix_(free_indices, free_indices)
    if np.array_equal(unit, prior_sigma[free_indices]):
        return estimates, covariance
    likelihood = likelihood_information(estimates[free_indices], covariance[block], prior_sigma[free_indices], unit)
    posterior_covariance, estimates, covariance = (
        np.linalg.inv(likelihood.information_matrix + np.eye(len(free_indices))),
        estimates.copy(),
        covariance.copy(),
    )
    estimates[free_indices], covariance[block] = (
        unit * (posterior_covariance @ likelihood.information_vector),
        posterior_covariance * np.outer(unit, unit),
    )
    return estimates, covariance


def determined_combinations(
    parameters: Sequence[Parameter], estimates: Floats, covariance: Floats
) -> list[DeterminedEntry]:
    """Combinations of parameters that the readings determine far better than the parameters themselves.

    With readings in a single face, for example, the vertical index and two eccentricities of the circle are determined
    to 12 urad each, and their sum to 0.3 urad. A combination is an eigenvector of the covariance of parameters with the
    same unit. Its reference parameter has the coefficient 1. `estimates` (parameters,) and `covariance` (parameters,
    parameters) are in SI units.
    """
    combination_entries = []
    for unit in dict.fromkeys(p.unit for p in parameters):
        at = np.array([i for i, p in enumerate(parameters) if p.unit == unit])
        block, factor = covariance[np.ix_(at, at)], parameters[at[0]].si_per_display_unit
        alone = np.sqrt(np.diag(block))
        variances, vectors = np.linalg.eigh(block)
        for variance, vector in zip(variances, vectors.T, strict=True):
            vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
            for count in range(1, len(at) + 1):
                members = np.sort(np.argsort(-np.abs(vector) * alone)[:count])
                weights = vector[members]
                sigma = float(np.sqrt(weights @ block[np.ix_(members, members)] @ weights))
                if sigma <= MAX_TRUNCATED_TO_FULL_SIGMA_RATIO * np.sqrt(max(variance, 0.0)):
                    break
            if count < 2 or sigma > MAX_COMBINED_TO_UNCORRELATED_SIGMA_RATIO * float(
                np.linalg.norm(weights * alone[members])
            ):
                continue
            first = int(np.flatnonzero(np.abs(weights) > MIN_RELATIVE_REFERENCE_COEFFICIENT * np.abs(weights).max())[0])
            order, unit_of_first = [first, *np.delete(np.arange(count), first)], weights[first] * factor
            combination = {parameters[at[members[i]]].name: float(weights[i] / weights[first]) for i in order}
            value, sigma = float(weights @ estimates[at[members]]) / unit_of_first, sigma / abs(unit_of_first)
            combination_entries.append(DeterminedEntry(combination=combination, value=value, sigma=sigma, unit=unit))
    return combination_entries


def amplitude_and_phase(coefficients: Floats, covariance: Floats) -> tuple[float, float, float | None, float | None]:
    """Amplitude, phase [rad] and their standard deviations, from a cosine and a sine coefficient.

    The order is amplitude, its standard deviation, phase, its standard deviation: a cos x + b sin x = A cos(x - phase).
    Standard deviations are propagated to first order from the covariance (2, 2). If the amplitude is not significant,
    the phase and its standard deviation are None, and the standard deviation of the amplitude is the rms over all
    phases: the square root of half the trace of `covariance`.
    """
    amplitude = float(np.hypot(*coefficients))
    if amplitude > 0:
        along = coefficients / amplitude
        sigma = float(np.sqrt(along @ covariance @ along))
        if amplitude > MIN_SIGNIFICANT_SIGMAS * sigma:
            across = np.array([-along[1], along[0]])
            phase_sigma = float(np.sqrt(across @ covariance @ across)) / amplitude
            return amplitude, sigma, float(np.arctan2(coefficients[1], coefficients[0])), phase_sigma
    return amplitude, float(np.sqrt(0.5 * np.trace(covariance))), None, None


def cosine_sine_pairs(names: Sequence[str]) -> Iterator[tuple[str, int, int]]:
    """Pairs of a cosine and a sine parameter: name of the harmonic, index of the cosine, index of the sine."""
    for i, name in enumerate(names):
        match = _COSINE_NAME_PATTERN.match(name)
        if match:
            sine = f"{match['front']}sin{match['order']}"
            if sine in names:
                yield match["front"].rstrip("-_") + match["order"], i, list(names).index(sine)


def harmonic_entries(parameters: Sequence[Parameter], estimates: Floats, covariance: Floats) -> list[HarmonicEntry]:
    """Amplitude and phase of each pair of a cosine and a sine parameter, from estimates and covariance in SI units."""
    harmonic_list = []
    for name, *at in cosine_sine_pairs([p.name for p in parameters]):
        parameter = parameters[at[0]]
        amplitude, sigma, phase, spread = amplitude_and_phase(estimates[at], covariance[np.ix_(at, at)])
        harmonic_list.append(
            HarmonicEntry(
                name=name,
                amplitude=amplitude / parameter.si_per_display_unit,
                sigma=sigma / parameter.si_per_display_unit,
                unit=parameter.unit,
                phase_deg=None if phase is None else phase / DEGREE,
                sigma_phase_deg=None if spread is None else spread / DEGREE,
            )
        )
    return harmonic_list


def log_sum_exp(logarithms: Floats, axis: int = 0) -> Floats:
    """Logarithm of the sum of the exponentials along an axis; minus infinity for an empty axis."""
    total: Floats
    if logarithms.size <= MAX_ENTRIES_FOR_SINGLE_LOG_SUM_EXP_CALL:
        total = np.logaddexp.reduce(logarithms, axis=axis)
        return total
    top = np.nan_to_num(logarithms.max(axis=axis, keepdims=True), neginf=0.0)
    with np.errstate(divide="ignore"):
        total = np.log(np.exp(logarithms - top).sum(axis=axis)) + top.squeeze(axis)
    return total


def score_weights_and_constants_by_size(
    information_strength: Floats,
    sizes: Floats = RELATIVE_EFFECT_SIZES,
    log_size_prior: Floats = LOG_PRIOR_OF_EFFECT_SIZES,
) -> tuple[Floats, Floats]:
    """Weights of the squared scores and additive constants in the log evidence of an effect, at each of its `sizes`.

    `information_strength` (..., components) is the information on each independent component of the effect.
    `log_size_prior` (sizes,) are the log prior probabilities of the sizes. The weights have the shape (..., components,
    sizes), the constants (..., sizes).
    """
    scale = 1.0 + sizes**2 * np.asarray(information_strength)[..., None]
    return 0.5 * sizes**2 / scale, log_size_prior - 0.5 * np.log(scale).sum(axis=-2)


def log_evidence_by_size(squared_scores: Floats, weights_and_constants: tuple[Floats, Floats]) -> Floats:
    """Log evidence of an effect at each of its sizes, including the log prior probability of the size, (..., sizes).

    `squared_scores` has the shape (..., components); `weights_and_constants` is the result of
    `score_weights_and_constants_by_size`.
    """
    log_evidences: Floats = (squared_scores[..., None, :] @ weights_and_constants[0])[
        ..., 0, :
    ] + weights_and_constants[1]
    return log_evidences


def log_evidence(squared_scores: Floats, information_strength: Floats) -> Floats:
    """Log Bayes factor of an effect against its absence, averaged over the sizes of the effect, shape (...).

    Parameters
    ----------
    squared_scores : (..., components) float
        Squared scores of the independent components of the effect.
    information_strength : (..., components) float
        Information on each component, in units of its plausible variance.
    """
    return log_sum_exp(
        log_evidence_by_size(squared_scores, score_weights_and_constants_by_size(information_strength)), axis=-1
    )
