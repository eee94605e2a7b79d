"""Tests whether the readings contradict the prior of an instrument parameter."""

from collections.abc import Collection

import numpy as np
from scipy import special

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.prior import WIDENED_PRIOR_SIGMA_FACTOR, ParameterPrior
from ltsim.adjustment.remedies.undetermined import MAX_UNINFORMATIVE_GAIN, ParameterCombination
from ltsim.adjustment.significance import FAMILY_WISE_LEVEL, MIN_DOF_FOR_ESTIMATED_NOISE, SINGLE_TEST_LEVEL
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.evidence import (
    change_score_and_information,
    forward_select,
    likelihood_information,
    log_evidence,
)
from ltsim.core.arrays import Bools, Floats
from ltsim.core.notation import MAX_LISTED_ITEMS, MAX_LISTED_SENTENCES, with_sigma
from ltsim.core.probability import PRIOR_OF_WRONG_INSTRUMENT_CONSTANT

MAX_NOISE_FREE_SIGMA0 = 0.1
"""Sigma0 (root of chi-square per degree of freedom) below which readings count as simulated without noise."""
MAX_SIGMA0_FOR_WIDENING = 2.0
"""Largest sigma0 at which a contradicted prior is widened. Above it the readings contradict each other, not only the
prior."""
MAX_WIDENED_PRIOR_FRACTION = 0.25
"""Largest fraction of an instrument's parameters whose contradicted priors are widened one by one. If more priors
are contradicted, the scale of all priors is wrong; `shrinkage` then estimates this scale."""
CORRECTED_INSTRUMENT_PHRASE = "its declared correction, which leaves errors of"
"""Phrase in sentences in place of `its prior`, for an instrument that `setup.toml` declares corrected."""


def sigma0_of_readings(adjustment: Adjustment) -> float:
    """Square root of chi-square per degree of freedom, without the contribution of the prior to chi-square."""
    gap = adjustment.problem.prior.whitened_residuals(adjustment.state.instrument_parameters)
    return float(np.sqrt(max(adjustment.chi2 - float(gap @ gap), 0.0) / max(adjustment.dof, 1)))


def informative_parameter_mask(adjustment: Adjustment) -> Bools:
    """Mask (parameters,) of those free parameters of all instruments about which the readings have information."""
    prior, columns = adjustment.problem.prior, adjustment.problem.unknowns.instrument_columns.ravel()
    remaining = np.diag(adjustment.retained_covariance)[columns] / prior.sigma.ravel() ** 2
    return np.asarray(~prior.is_fixed.ravel() & (remaining < 1.0 - MAX_UNINFORMATIVE_GAIN))


def is_noise_overstated(adjustment: Adjustment) -> bool:
    """True if the residuals are significantly smaller than declared, so that the declared noise is too large."""
    testable = adjustment.dof >= MIN_DOF_FOR_ESTIMATED_NOISE and sigma0_of_readings(adjustment) > MAX_NOISE_FREE_SIGMA0
    return testable and bool(special.chdtr(adjustment.dof, adjustment.chi2) < SINGLE_TEST_LEVEL)


def contradicted_prior_mask(adjustment: Adjustment, prior: ParameterPrior) -> Bools:
    """Mask (instruments, parameters) of the parameters whose prior the readings contradict.

    A tested contradiction is a change of one parameter of one instrument, or of the same parameter of all instruments.
    The parameters are selected by `forward_select`; a selected parameter has a wide prior while the other parameters
    are tested. `prior` is the declared prior; the prior of the adjustment may already be wider.
    """
    rejected, scale = np.zeros(prior.mean.shape, dtype=bool), max(1.0, adjustment.sigma0)
    if prior.has_correlations or not np.isfinite(prior.sigma).all() or not scale < MAX_SIGMA0_FOR_WIDENING:
        return rejected
    free, size = np.flatnonzero(~prior.is_fixed.ravel()), prior.mean.shape[1]
    unit, used_sigma = prior.sigma.ravel()[free], adjustment.problem.prior.sigma.ravel()[free]
    gap = (adjustment.state.instrument_parameters - prior.mean).ravel()[free]
    likelihood = likelihood_information(
        gap, adjustment.covariance_of_all_instruments[np.ix_(free, free)], used_sigma, unit
    )
    common_changes = np.tile(np.eye(size), len(rejected))[~prior.is_fixed.any(axis=0) & (len(rejected) > 1)]
    directions = np.concatenate([np.eye(rejected.size)[free], common_changes])[:, free]

    def log_odds_given(selected_changes: Collection[int]) -> Floats:
        """Log odds of each candidate contradiction given the selected contradictions, rounded to 0.1.

        Because of the rounding, the first of several candidates that the readings do not distinguish is selected.
        """
        given_changes = WIDENED_PRIOR_SIGMA_FACTOR * directions[list(selected_changes)]
        score, weight = change_score_and_information(
            likelihood.information_matrix,
            likelihood.information_vector,
            np.eye(len(free)) + given_changes.T @ given_changes,
        )
        strength = np.einsum("hi,ij,hj->h", directions, weight, directions)
        informative = (strength > MAX_UNINFORMATIVE_GAIN) & ~np.isin(np.arange(len(directions)), list(selected_changes))
        estimate = directions @ score / np.where(informative, strength, np.inf)
        odds = np.round(
            log_odds_of_changed_constants(estimate * np.sqrt(np.abs(strength)) / scale, strength, len(directions)), 1
        )
        return np.where(informative & (np.abs(estimate) < WIDENED_PRIOR_SIGMA_FACTOR), odds, -np.inf)

    indices = [k for k, odds in forward_select(log_odds_given, 0.0).items() if odds[k] > 0.0]
    rejected.flat[free] = directions[indices].any(axis=0)
    return rejected & (rejected.sum(axis=1, keepdims=True) <= MAX_WIDENED_PRIOR_FRACTION * size)


def prior_conflict_sentences(calibration: Calibration) -> tuple[str, ...]:
    """Sentences on the parameters that contradict their prior most, or else on a contradicting combination.

    Parameters whose prior was widened because of the contradiction are also reported. Parameters and combinations share
    one prior probability of a contradiction.
    """
    if not calibration.estimates.size or calibration.adjustment is None:
        return ()
    prior, freed = calibration.adjustment.problem.prior, calibration.arrays.is_prior_rejected
    rows, size = list(zip(calibration.instrument_parameter_names, calibration.parameters, strict=True)), freed.shape[1]
    scale, lengths = max(1.0, calibration.adjustment.sigma0), len(calibration.adjustment.problem.gauge_rows)
    instruments = map(calibration.adjustment.recording.setup.instrument_named, calibration.instruments)
    references = [
        CORRECTED_INSTRUMENT_PHRASE if instrument.corrected else "its declared prior of" for instrument in instruments
    ]
    sentences = []
    for k in np.flatnonzero(freed).tolist():
        name, p = rows[k]
        sentences.append(
            f"{name}: the readings give {with_sigma(p.value, p.sigma, p.unit)}, which contradicts "
            f"{references[k // size]} {p.prior_sigma:.3g} {p.unit}: the readings determine the estimate"
        )
        if lengths and calibration.construction.parameters[k % size].specified_quantity == "range_scale":
            sentences[-1] += " and the reference lengths: check their temperature and expansion coefficient"
    # The prior is an observation like any other: its residual has its variance less that of the estimate (Baarda).
    gain = np.where(calibration.is_fixed | freed, 0.0, 1.0 - (calibration.sigma / calibration.prior_sigma) ** 2).ravel()
    deviation = ((calibration.estimates - prior.mean) / calibration.prior_sigma).ravel()
    w = _normalised_deviations(deviation, gain) / scale
    odds = log_odds_of_changed_constants(w, gain, freed.size + size * (len(freed) > 1))
    contradictions = [int(k) for k in np.argsort(-odds) if odds[k] > 0.0]
    if not contradictions:
        return (*sentences, *_combination_sentences(calibration, prior, scale))
    for k in contradictions[:MAX_LISTED_SENTENCES]:
        name, p = rows[k]
        sentences.append(
            f"{name}: the readings contradict its prior of {p.prior_sigma:.3g} {p.unit} "
            f"(w = {w[k]:.1f}, estimate {p.value:.3g}); if such a value is plausible, declare a larger sigma in "
            "[instrument.prior.parameters]"
        )
    if len(contradictions) > MAX_LISTED_SENTENCES:
        sentences.append(f"{len(contradictions) - MAX_LISTED_SENTENCES} further parameters contradict their prior")
    return tuple(sentences)


def log_odds_of_changed_constants(normalised_changes: Floats, information: Floats, n_constants: int) -> Floats:
    """Log posterior odds that each of several instrument constants changed, shape (candidates,).

    `normalised_changes` (candidates,) are the changes divided by their standard deviations, `information` (candidates,)
    is the information on each constant, in inverse prior variances. One change is expected among `n_constants`
    constants with a fixed probability. The evidence is averaged over sizes, so that a constant with little information
    needs a larger change.
    """
    information = np.maximum(information, 0.0)
    return log_evidence((normalised_changes**2 * information)[:, None], information[:, None]) + np.log(
        PRIOR_OF_WRONG_INSTRUMENT_CONSTANT / n_constants
    )


def _normalised_deviations(deviation: Floats, information_gain: Floats) -> Floats:
    """Deviations of estimates from the prior mean, divided by their standard deviations; 0 without information."""
    return np.where(
        information_gain > MAX_UNINFORMATIVE_GAIN,
        deviation / np.sqrt(np.maximum(information_gain, MAX_UNINFORMATIVE_GAIN)),
        0.0,
    )


def _combination_sentences(calibration: Calibration, prior: ParameterPrior, scale: float) -> tuple[str, ...]:
    """Sentence on the combination of parameters that contradicts the prior most; empty without a contradiction.

    `scale` multiplies the standard deviations. The tested combinations are independent: eigenvectors of the covariance
    in prior standard deviations.
    """
    n_parameters = calibration.construction.n_parameters
    for i in range(len(calibration.instruments)):
        free_parameters = np.flatnonzero(~calibration.is_fixed[i])
        prior_whitening = prior.whitening_matrices[i][np.ix_(free_parameters, free_parameters)]
        covariance = calibration.covariance[
            np.ix_(i * n_parameters + free_parameters, i * n_parameters + free_parameters)
        ]
        remaining_variances, vectors = np.linalg.eigh(prior_whitening @ covariance @ prior_whitening.T)
        gain = np.clip(1.0 - remaining_variances, 0.0, 1.0)
        deviation = vectors.T @ prior_whitening @ (calibration.estimates[i] - prior.mean[i])[free_parameters]
        w = _normalised_deviations(deviation, gain) / scale
        k = int(np.argmax(np.abs(w)))
        if abs(w[k]) > -special.ndtri(FAMILY_WISE_LEVEL / (4 * max(int(np.count_nonzero(w)), 1))):
            combination = ParameterCombination(vectors[:, k], float(gain[k])).coefficients(
                [calibration.instrument_parameter_names[i * n_parameters + j] for j in free_parameters]
            )
            terms = " ".join(f"{value:+.2f} {name}" for name, value in list(combination.items())[:MAX_LISTED_ITEMS])
            return (f"the readings contradict the prior of a combination (w = {w[k]:.1f}): {terms}",)
    return ()
