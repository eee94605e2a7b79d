"""Likelihood information, score tests of changes, determined combinations, and log evidence averaged over sizes."""

import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from ltsim.adjustment.remedies.undetermined import MAX_UNINFORMATIVE_GAIN
from ltsim.calibration.combinations import DeterminedEntry
from ltsim.calibration.schema import HarmonicEntry
from ltsim.core import probability
from ltsim.core.arrays import Floats
from ltsim.core.units import DEGREE
from ltsim.physics.effects.signature import Parameter

MAX_SIGMA_RATIO_COMBINATION = 0.25
"""Largest ratio of the standard deviation of a combination to the one that independent members would give, at which the
combination is reported: the recording determines it four times better than its members."""
MAX_TRUNCATION_SIGMA_RATIO = 1.2
"""Largest ratio of the standard deviation of a shortened combination to that of the complete eigenvector; the smallest
members are omitted as long as the ratio permits."""
MIN_LEADING_WEIGHT = 0.9
"""A combination is scaled to its first member whose weight exceeds this share of the largest."""
MIN_AMPLITUDE_FOR_PHASE = 2.0
"""Smallest amplitude, in its standard deviations, of a harmonic whose phase is reported."""
EVIDENCE_SIZES = np.array(list(probability.SIZE_PRIOR))
"""Sizes of an effect, relative to a plausible one, over which the evidence is averaged."""
LOG_SIZE_PRIOR = np.log(np.array(list(probability.SIZE_PRIOR.values())))
"""Logarithms of the prior probabilities of the sizes t relative to a plausible one."""
MAX_SINGLE_CALL_ENTRIES = 100
"""Arrays of up to this many values are summed by one library call, larger ones by several vectorised calls."""
# 'azimuth-eccentricity-cos', and 'J1.eY_cos2' with an order behind.
_COSINE_SUFFIX = re.compile(r"^(?P<front>.+[-_])cos(?P<order>\d?)$")


@dataclass(frozen=True)
class LikelihoodInformation:
    """Information of a calibration's readings without its prior, in units of common prior sigmas."""

    posterior_covariance: Floats
    """Covariance of the estimates, (p, p)."""
    information: Floats
    """Inverse covariance minus that of the prior, (p, p); 0 for combinations below `MAX_UNINFORMATIVE_GAIN`."""
    information_vector: Floats
    """Product of `information` and the estimate from the readings alone, (p,)."""


def likelihood_information(
    estimates: Floats, covariance: Floats, prior_sigma: Floats, unit: Floats
) -> LikelihoodInformation:
    """Likelihood information of estimates (p,) with covariance (p, p) and priors (p,) about 0, in units (p,) [SI]."""
    prior = prior_sigma / unit
    remaining = covariance / np.outer(unit, unit)
    shares, vectors = linalg.eigh(remaining / np.outer(prior, prior))
    informative = 1.0 - shares > MAX_UNINFORMATIVE_GAIN
    inverse = np.where(informative, 1.0 / np.where(informative, shares, 1.0), 0.0)
    basis = vectors / prior[:, None]
    information = (basis * np.where(informative, inverse - 1.0, 0.0)) @ basis.T
    information_vector = (basis * inverse) @ basis.T @ (estimates / unit)
    return LikelihoodInformation(0.5 * (remaining + remaining.T), information, information_vector)


def score_test(information: Floats, score: Floats, prior_covariance: Floats) -> tuple[Floats, Floats]:
    """Score (p,) and information (p, p) of a change of each parameter in addition to a prior `prior_covariance` (p, p).

    `score` is `information_vector` less `information` times the expected parameters; score / weight[k, k] estimates
    a change of parameter k alone, with the variance 1 / weight[k, k].
    """
    keeps = np.linalg.inv(np.eye(len(score)) + information @ prior_covariance)
    return keeps @ score, keeps @ information


def log_marginal_likelihood(likelihood: LikelihoodInformation, mean: Floats, prior_covariance: Floats) -> float:
    """Log of the likelihood exp(b'x - x'N x / 2) averaged over x ~ N(`mean` (p,), `prior_covariance` (p, p))."""
    information, vector = likelihood.information, likelihood.information_vector
    score = vector - information @ mean
    keeps = np.eye(len(score)) + information @ prior_covariance
    gain = score @ prior_covariance @ np.linalg.solve(keeps, score)
    return float(vector @ mean + 0.5 * (gain - mean @ information @ mean - np.linalg.slogdet(keeps)[1]))


def forward_select(scores: Callable[[Collection[int]], Floats], min_score: float) -> dict[int, Floats]:
    """Forward selection with exchange: selected changes, and the `scores` (h,) given the others when each was selected.

    A change is added while one scores more than `min_score`; after each addition every earlier one is replaced by the
    best change given the others.
    """
    odds_by_index: dict[int, Floats] = {}
    while (values := scores(odds_by_index)).max(initial=-np.inf) > min_score:
        odds_by_index[int(np.argmax(values))] = values
        for previous in list(odds_by_index)[:-1]:
            values = scores([k for k in odds_by_index if k != previous])
            del odds_by_index[previous]
            odds_by_index[int(np.argmax(values))] = values
    return odds_by_index


def with_plausible_priors(
    parameters: Sequence[Parameter], estimates: Floats, covariance: Floats, prior_sigma: Floats
) -> tuple[Floats, Floats]:
    """Estimates (p,) and covariance (p, p) [SI] under priors of plausible size, as tight ones conceal combinations."""
    free_indices = np.flatnonzero(np.diag(covariance) > 0)
    unit, block = np.array([p.prior_sigma for p in parameters])[free_indices], np.ix_(free_indices, free_indices)
    if np.array_equal(unit, prior_sigma[free_indices]):
        return estimates, covariance
    likelihood = likelihood_information(estimates[free_indices], covariance[block], prior_sigma[free_indices], unit)
    posterior_covariance, estimates, covariance = (
        np.linalg.inv(likelihood.information + np.eye(len(free_indices))),
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
    """Combinations determined far better than each of their members, from values (p,) and covariance (p, p) [SI].

    In a single face, for example, the vertical index and two eccentricities of the circle are determined to 12 urad
    each and their sum to 0.3 urad. Combinations have one unit: eigenvectors of the covariance that join several
    parameters, scaled to the first of them.
    """
    entries = []
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
                if sigma <= MAX_TRUNCATION_SIGMA_RATIO * np.sqrt(max(variance, 0.0)):
                    break
            if count < 2 or sigma > MAX_SIGMA_RATIO_COMBINATION * float(np.linalg.norm(weights * alone[members])):
                continue
            first = int(np.flatnonzero(np.abs(weights) > MIN_LEADING_WEIGHT * np.abs(weights).max())[0])
            order, unit_of_first = [first, *np.delete(np.arange(count), first)], weights[first] * factor
            combination = {parameters[at[members[i]]].name: float(weights[i] / weights[first]) for i in order}
            value, sigma = float(weights @ estimates[at[members]]) / unit_of_first, sigma / abs(unit_of_first)
            entries.append(DeterminedEntry(combination=combination, value=value, sigma=sigma, unit=unit))
    return entries


def amplitude_and_phase(coefficients: Floats, covariance: Floats) -> tuple[float, float, float | None, float | None]:
    """Amplitude, phase [rad] and their sigmas from cosine and sine coefficients (2,) with covariance (2, 2).

    a cos x + b sin x = A cos(x - phase), to first order in the covariance. Without a defined phase the sigma is the
    square root of half the trace, an average over directions.
    """
    amplitude = float(np.hypot(*coefficients))
    if amplitude > 0:
        along = coefficients / amplitude
        sigma = float(np.sqrt(along @ covariance @ along))
        if amplitude > MIN_AMPLITUDE_FOR_PHASE * sigma:
            across = np.array([-along[1], along[0]])
            phase_sigma = float(np.sqrt(across @ covariance @ across)) / amplitude
            return amplitude, sigma, float(np.arctan2(coefficients[1], coefficients[0])), phase_sigma
    return amplitude, float(np.sqrt(0.5 * np.trace(covariance))), None, None


def cosine_sine_pairs(names: Sequence[str]) -> Iterator[tuple[str, int, int]]:
    """Harmonics among parameters: name, index of the cosine, index of the sine."""
    for i, name in enumerate(names):
        match = _COSINE_SUFFIX.match(name)
        if match:
            sine = f"{match['front']}sin{match['order']}"
            if sine in names:
                yield match["front"].rstrip("-_") + match["order"], i, list(names).index(sine)


def harmonic_entries(parameters: Sequence[Parameter], estimates: Floats, covariance: Floats) -> list[HarmonicEntry]:
    """Amplitude and phase of every pair of a cosine and a sine coefficient; values (p,), covariance (p, p) [SI]."""
    entries = []
    for name, *at in cosine_sine_pairs([p.name for p in parameters]):
        parameter = parameters[at[0]]
        amplitude, sigma, phase, spread = amplitude_and_phase(estimates[at], covariance[np.ix_(at, at)])
        entries.append(
            HarmonicEntry(
                name=name,
                amplitude=amplitude / parameter.si_per_display_unit,
                sigma=sigma / parameter.si_per_display_unit,
                unit=parameter.unit,
                phase_deg=None if phase is None else phase / DEGREE,
                sigma_phase_deg=None if spread is None else spread / DEGREE,
            )
        )
    return entries


def log_sum_exp(logarithms: Floats, axis: int = 0) -> Floats:
    """Log of the sum of exp(values) along an axis; minus infinity for none."""
    total: Floats
    if logarithms.size <= MAX_SINGLE_CALL_ENTRIES:
        total = np.logaddexp.reduce(logarithms, axis=axis)
        return total
    top = np.nan_to_num(logarithms.max(axis=axis, keepdims=True), neginf=0.0)
    with np.errstate(divide="ignore"):
        total = np.log(np.exp(logarithms - top).sum(axis=axis)) + top.squeeze(axis)
    return total


def size_weights_and_constants(
    information_strength: Floats, sizes: Floats = EVIDENCE_SIZES, log_weights: Floats = LOG_SIZE_PRIOR
) -> tuple[Floats, Floats]:
    """Weights (..., k, sizes) of squared scores and constants (..., sizes) of the log evidence at each size."""
    scale = 1.0 + sizes**2 * np.asarray(information_strength)[..., None]
    return 0.5 * sizes**2 / scale, log_weights - 0.5 * np.log(scale).sum(axis=-2)


def log_evidence_by_size(squared_scores: Floats, weights_and_constants: tuple[Floats, Floats]) -> Floats:
    """The weighted log marginal likelihood ratio (..., sizes) of squared scores (..., k) for each size."""
    logs: Floats = (squared_scores[..., None, :] @ weights_and_constants[0])[..., 0, :] + weights_and_constants[1]
    return logs


def log_evidence(squared_scores: Floats, information_strength: Floats) -> Floats:
    """Log marginal likelihood ratio (...), averaged over sizes.

    Parameters
    ----------
    squared_scores : (..., k) float
        Squared scores z_j^2 along the eigenvectors.
    information_strength : (..., k) float
        Eigenvalues d_j.
    """
    return log_sum_exp(log_evidence_by_size(squared_scores, size_weights_and_constants(information_strength)), axis=-1)
