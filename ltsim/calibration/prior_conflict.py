"""Contradictions between the readings and the prior of a parameter."""

from collections.abc import Collection

import numpy as np
from scipy import special

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.prior import FREED, ParameterPrior
from ltsim.adjustment.reliability import FEW
from ltsim.adjustment.remedies.undetermined import UNINFORMATIVE, Direction
from ltsim.adjustment.significance import FAMILY_LEVEL, SINGLE_LEVEL
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.evidence import forward_select, likelihood_information, log_evidence, score_test
from ltsim.core.arrays import Bools, Floats
from ltsim.core.notation import with_sigma
from ltsim.core.probability import P_CONSTANT

NOISE_FREE = 0.1
"""Value of sigma0 below which readings count as free of noise, such as in a simulation without noise."""
UNEXPLAINED = 2.0
"""Value of sigma0 from which no prior is widened, because the readings contradict each other and not only the prior."""
MOST_FREED = 0.25
"""Fraction of contradicting parameters of an instrument above which no prior is widened: the prior is then wrong as a
whole, which `shrinkage` treats by its scale.
"""
CORRECTED = "its declared correction, which leaves"
"""Text for the prior of an instrument that the set-up declares corrected."""
MOST_SENTENCES = 3
MOST_TERMS = 6
"""Largest number of sentences, and of terms of a combination, in a report."""


def sigma0_of_readings(adjustment: Adjustment) -> float:
    """Square root of chi-square over the degrees of freedom, without the contribution of the parameters' prior."""
    gap = adjustment.problem.prior.residual(adjustment.state.instrument_parameters)
    return float(np.sqrt(max(adjustment.chi2 - float(gap @ gap), 0.0) / max(adjustment.dof, 1)))


def noise_overstated(adjustment: Adjustment) -> bool:
    """True if readings scatter less than declared, so that the declared noise is too large."""
    testable = adjustment.dof >= FEW and sigma0_of_readings(adjustment) > NOISE_FREE
    return testable and bool(special.chdtr(adjustment.dof, adjustment.chi2) < SINGLE_LEVEL)


def prior_rejected(adjustment: Adjustment, prior: ParameterPrior) -> Bools:
    """Mask (I, p) of parameters whose `prior` the readings contradict, of one instrument or of all in common.

    Forward selection with exchange (`forward_select`), selected parameters having a wide prior. The prior of the
    adjustment may be wider than `prior`.
    """
    rejected, scale = np.zeros(prior.mean.shape, dtype=bool), max(1.0, adjustment.sigma0)
    if prior.correlated or not np.isfinite(prior.sigma).all() or not scale < UNEXPLAINED:
        return rejected
    free, size = np.flatnonzero(~prior.held.ravel()), prior.mean.shape[1]
    unit, used_sigma = prior.sigma.ravel()[free], adjustment.problem.prior.sigma.ravel()[free]
    gap = (adjustment.state.instrument_parameters - prior.mean).ravel()[free]
    likelihood = likelihood_information(gap, adjustment.constants_covariance[np.ix_(free, free)], used_sigma, unit)
    common = np.tile(np.eye(size), len(rejected))[~prior.held.any(axis=0) & (len(rejected) > 1)]
    ways = np.concatenate([np.eye(rejected.size)[free], common])[:, free]

    def beyond(others: Collection[int]) -> Floats:
        """Log odds (h,) of each change given others, to 0.1 so that of equivalent changes the first is selected."""
        given = FREED * ways[list(others)]
        score, weight = score_test(
            likelihood.information, likelihood.information_vector, np.eye(len(free)) + given.T @ given
        )
        strength = np.einsum("hi,ij,hj->h", ways, weight, ways)
        informative = (strength > UNINFORMATIVE) & ~np.isin(np.arange(len(ways)), list(others))
        estimate = ways @ score / np.where(informative, strength, np.inf)
        odds = np.round(log_odds(estimate * np.sqrt(np.abs(strength)) / scale, strength, len(ways)), 1)
        return np.where(informative & (np.abs(estimate) < FREED), odds, -np.inf)

    chosen = [k for k, odds in forward_select(beyond, 0.0).items() if odds[k] > 0.0]
    rejected.flat[free] = ways[chosen].any(axis=0)
    return rejected & (rejected.sum(axis=1, keepdims=True) <= MOST_FREED * size)


def disagreement(calibration: Calibration) -> tuple[str, ...]:
    """Sentences on the parameters that contradict their prior most, or else on the contradicting combination.

    Parameters with a widened prior are reported as such. Parameters and combinations share one prior probability.
    """
    if not calibration.values.size or calibration.adjustment is None:
        return ()
    prior, freed = calibration.adjustment.problem.prior, calibration.arrays.prior_rejected
    rows, size = list(zip(calibration.names, calibration.parameters, strict=True)), freed.shape[1]
    scale, lengths = max(1.0, calibration.adjustment.sigma0), len(calibration.adjustment.problem.gauge)
    instruments = map(calibration.adjustment.recording.setup.instrument_named, calibration.instruments)
    references = [CORRECTED if instrument.corrected else "its declared prior of" for instrument in instruments]
    sentences = []
    for k in np.flatnonzero(freed).tolist():
        name, p = rows[k]
        sentences.append(
            f"{name} is {with_sigma(p.value, p.sigma, p.unit)} from the readings, which contradicts "
            f"{references[k // size]} {p.prior_sigma:.3g} {p.unit}: the estimate follows the readings"
        )
        if lengths and calibration.construction.parameters[k % size].prior_kind == "range_scale":
            sentences[-1] += " and the reference lengths: check their temperature and expansion coefficient"
    # The prior is an observation like any other: its residual has its variance less that of the estimate (Baarda).
    gain = np.where(calibration.held | freed, 0.0, 1.0 - (calibration.sigma / calibration.prior_sigma) ** 2).ravel()
    deviation = ((calibration.values - prior.mean) / calibration.prior_sigma).ravel()
    w = _normalised(deviation, gain) / scale
    odds = log_odds(w, gain, freed.size + size * (len(freed) > 1))
    worst = [int(k) for k in np.argsort(-odds) if odds[k] > 0.0]
    if not worst:
        return (*sentences, *_of_combinations(calibration, prior, scale))
    for k in worst[:MOST_SENTENCES]:
        name, p = rows[k]
        sentences.append(
            f"{name}: the readings contradict its prior of {p.prior_sigma:.3g} {p.unit} "
            f"(w = {w[k]:.1f}, estimate {p.value:.3g}); if it may be larger, set it in [instrument.prior.parameters]"
        )
    if len(worst) > MOST_SENTENCES:
        sentences.append(f"{len(worst) - MOST_SENTENCES} more parameters contradict their prior")
    return tuple(sentences)


def log_odds(z: Floats, weight: Floats, count: int) -> Floats:
    """Log posterior odds (h,) that each of `count` constants is wrong, from normalised changes z (h,).

    `weight` (h,) is the information on each constant in prior variances. They are averaged over sizes as in a
    diagnosis, so that a constant with little information needs a larger z.
    """
    weight = np.maximum(weight, 0.0)
    return log_evidence((z**2 * weight)[:, None], weight[:, None]) + np.log(P_CONSTANT / count)


def _normalised(deviation: Floats, gain: Floats) -> Floats:
    """Deviations (k,) from the prior, in prior sigmas, divided by their standard deviation; 0 without information."""
    return np.where(gain > UNINFORMATIVE, deviation / np.sqrt(np.maximum(gain, UNINFORMATIVE)), 0.0)


def _of_combinations(calibration: Calibration, prior: ParameterPrior, scale: float) -> tuple[str, ...]:
    """Sentence on the combination that contradicts the prior most; combinations are independent in prior sigmas."""
    size = calibration.construction.n_parameters
    for i in range(len(calibration.instruments)):
        at = np.flatnonzero(~calibration.held[i])
        root = prior.roots[i][np.ix_(at, at)]
        covariance = calibration.covariance[np.ix_(i * size + at, i * size + at)]
        remaining, vectors = np.linalg.eigh(root @ covariance @ root.T)
        gain = np.clip(1.0 - remaining, 0.0, 1.0)
        deviation = vectors.T @ root @ (calibration.values[i] - prior.mean[i])[at]
        w = _normalised(deviation, gain) / scale
        k = int(np.argmax(np.abs(w)))
        if abs(w[k]) > -special.ndtri(FAMILY_LEVEL / (4 * max(int(np.count_nonzero(w)), 1))):
            combination = Direction(vectors[:, k], float(gain[k])).coefficients(
                [calibration.names[i * size + j] for j in at]
            )
            terms = " ".join(f"{value:+.2f} {name}" for name, value in list(combination.items())[:MOST_TERMS])
            return (f"the readings contradict the prior of a combination (w = {w[k]:.1f}): {terms}",)
    return ()
