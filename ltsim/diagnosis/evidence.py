"""Log marginal likelihoods (evidence) of the hypotheses of a diagnosis.

Let r be the whitened residuals, and P the projector onto the residual space, which removes all that the ordinary
adjustment estimates. A hypothesis has a design matrix g and coefficients b ~ N(0, t^2 L) with a size factor t; the
diagonal matrix L contains the squares of the plausible sizes. Its log marginal likelihood ratio relative to the model
without it is log B = sum_j [ z_j^2 t^2 / (1 + t^2 d_j) - log(1 + t^2 d_j) ] / 2. Here d_j are the eigenvalues of L^1/2
g' P g L^1/2, and z_j the scores L^1/2 g' r along its eigenvectors. The ratio is averaged over the size factors t. It is
also averaged over places (stations and targets), shape parameters and length scales, which penalises hypotheses with
many of them. Noise hypotheses enter by their restricted likelihood, averaged over a grid of sizes.

Sizes of arrays below: m observation equations, h hypotheses, k coefficients, trials (simulated recordings).

References
----------
MacKay, Information theory, inference and learning algorithms (2003), chapter 28 (evidence and Occam factors);
Rasmussen and Williams, Gaussian processes for machine learning (2006), section 5.4.
"""

from collections.abc import Iterator

import numpy as np
from scipy.special import log_ndtr

from ltsim.adjustment import Adjustment
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.evidence import (
    LOG_PRIOR_OF_EFFECT_SIZES,
    RELATIVE_EFFECT_SIZES,
    log_evidence,
    log_evidence_by_size,
    log_sum_exp,
    score_weights_and_constants_by_size,
)
from ltsim.core.arrays import Bools, Floats, Floats32, Ints, batches
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE
from ltsim.physics.effects.linear_effect import CandidateEffect
from ltsim.physics.effects.outlier import READING_COLUMN_BY_OBSERVABLE, Outlier
from ltsim.recordings.recording import OBSERVABLES
from ltsim.solve.design import to_dense


def index_of_most_evidence(log_evidences: Floats) -> int:
    """Index of the largest log evidence; the middle index if several values are equal, as on a plateau."""
    ties = np.flatnonzero(log_evidences >= np.max(log_evidences) - NORMAL_EQUATIONS_TOLERANCE)
    return int(ties[(len(ties) - 1) // 2])


def indices_by_evidence(log_evidences: Floats, tie_tolerance: float = NORMAL_EQUATIONS_TOLERANCE) -> Ints:
    """Indices in the order of decreasing log evidence; values that differ by up to `tie_tolerance` keep their order."""
    falling = np.nan_to_num(-log_evidences)
    order = np.argsort(falling, kind="stable")
    group = np.cumsum(np.diff(falling[order]) > tie_tolerance)
    return order[np.lexsort((order, np.append(0, group)[: len(order)]))]


def normalised_probabilities(log_probabilities: Floats) -> Floats:
    """Probabilities (k,) that add up to one, from k unnormalised log probabilities."""
    probabilities: Floats = np.exp(log_probabilities - log_sum_exp(log_probabilities))
    return probabilities


def simulated_log_evidence(scores: Floats, eigenvalues: Floats) -> Floats:
    """Log evidence (h, trials) of h hypotheses for each simulated recording (trial), computed in single precision.

    `scores` (h, k, trials) are the products of k design columns, in units of plausible sizes, with the residuals, along
    the eigenvectors of the Gram matrix of these columns. `eigenvalues` (h, k) are the eigenvalues of this matrix.
    """
    log_evidence_parts = [
        _log_sum_exp_in_place(logs, 1)
        for logs in _simulated_log_evidence_batches(scores, eigenvalues, np.zeros(len(scores)))
    ]
    evidence: Floats = np.concatenate(log_evidence_parts).astype(np.float64)
    return evidence


def simulated_log_total_evidence(scores: Floats32, eigenvalues: Floats, log_prior: Floats) -> Floats:
    """Log (trials,) of the summed evidence of h hypotheses for each simulated recording (trial).

    `log_prior` (h,) are the log prior probabilities of the hypotheses; `scores` (h, k, trials) are products of k design
    columns with residuals, along the eigenvectors of their Gram matrix, whose `eigenvalues` are (h, k).
    """
    flattened = scores.reshape(-1, *scores.shape[-2:]), eigenvalues.reshape(-1, scores.shape[-2])
    log_total_parts = [
        _log_sum_exp_in_place(logs, (0, 1)) for logs in _simulated_log_evidence_batches(*flattened, log_prior)
    ]
    return log_sum_exp(np.stack(log_total_parts).astype(np.float64))


def _simulated_log_evidence_batches(
    scores: Floats | Floats32, eigenvalues: Floats, log_prior: Floats
) -> Iterator[Floats32]:
    """Iterator over batches of h hypotheses: log evidence with priors, (h, size factors, simulated recordings).

    `log_prior` (h,) are the log prior probabilities; `scores` (h, k, trials) are products of k design columns with
    residuals, along the eigenvectors of their Gram matrix, whose `eigenvalues` are (h, k).
    """
    for part in batches(len(scores), scores.size // max(len(scores), 1)):
        weights, constants = score_weights_and_constants_by_size(eigenvalues[part])
        constants += log_prior[part, None]
        logs = np.swapaxes(weights, -1, -2).astype(np.float32) @ np.square(scores[part], dtype=np.float32)
        logs += constants[..., None].astype(np.float32)
        yield logs


def _log_sum_exp_in_place(log_values: Floats32, axis: int | tuple[int, ...]) -> Floats32:
    """Log of the sum of exp(log_values) along `axis`; the array `log_values` is overwritten."""
    top = log_values.max(axis=axis, keepdims=True)
    np.exp(np.subtract(log_values, top, out=log_values), out=log_values)
    log_total: Floats32 = np.log(log_values.sum(axis=axis)) + top.squeeze(axis)
    return log_total


def log_restricted_likelihood_ratio(squared_residuals: Floats, redundancy: Floats, variance_factor: Floats) -> Floats:
    """Log restricted likelihood ratio of each reading for a variance of `variance_factor` times the declared one.

    The readings are treated as independent (diagonal form). `squared_residuals` are squares of whitened residuals, and
    `redundancy` the redundancy numbers of the readings. Both may be sums over readings with the same factor.
    """
    ratio: Floats = 0.5 * (squared_residuals * (1.0 - 1.0 / variance_factor) - redundancy * np.log(variance_factor))
    return ratio


def log_restricted_likelihood(adjustment: Adjustment) -> float:
    """Log restricted likelihood of an adjustment, up to a constant that does not depend on its variances.

    It is exact for the linearised model. Displacements by centring errors are random effects, so that the determinant
    of their prior covariance contributes.
    """
    solution, problem = adjustment.solution, adjustment.problem
    normal_matrix = solution.system.design.T @ solution.system.design
    _, log_determinant = np.linalg.slogdet(to_dense(normal_matrix))
    log_sigmas = float(np.log(problem.reading_sigmas[problem.is_used_reading]).sum())
    for errors in problem.model.centring_errors:
        log_sigmas += len(errors.parameters) * float(np.log(errors.displacement_sigma))
    return -0.5 * (solution.sum_of_squares + float(log_determinant)) - log_sigmas


def log_evidence_of_wrong_readings(
    space: ResidualSpace, residual: Floats, model_basis: Floats, log_prior: float
) -> float:
    """Log evidence of the hypothesis that several readings are wrong, each with a separate error.

    Readings with a positive log evidence count as wrong. The first `N_EXACTLY_EVALUATED_HYPOTHESES` are selected one
    after another, each given the others, because one wrong reading also changes the residuals of other readings. The
    log evidences of all further readings are added as if they were independent, up to the whole chi-square.

    Parameters
    ----------
    space : ResidualSpace
        Whitened equations of the adjustment, projected off its unknowns (residual space).
    residual : (m,) float
        Whitened residuals of m observation equations, given the effects of a model.
    model_basis : (m, e) float
        Orthonormal basis of the changes of the whitened residuals by these effects.
    log_prior : float
        Log prior probability that any reading is wrong. It is divided equally among all readings.
    """
    outliers = [Outlier(observable=name) for name in READING_COLUMN_BY_OBSERVABLE]
    sizes = np.concatenate([outlier.plausible_sizes for outlier in outliers])
    scale = (sizes / space.reading_sigmas)[space.is_used_reading]
    redundancy, total = space.redundancy - np.sum(model_basis**2, axis=1), 0.0
    for n_wrong in range(N_EXACTLY_EVALUATED_HYPOTHESES + 1):
        score, eigenvalues = residual[: len(scale)] * scale, np.maximum(redundancy[: len(scale)], 0.0) * scale**2
        log_evidences = log_evidence((score**2)[:, None], eigenvalues[:, None]) + log_prior - np.log(len(scale))
        log_evidences[redundancy[: len(scale)] <= NORMAL_EQUATIONS_TOLERANCE] = -np.inf  # other readings do not test it
        most = int(np.argmax(log_evidences))
        if log_evidences[most] <= 0.0:
            break
        if n_wrong == N_EXACTLY_EVALUATED_HYPOTHESES:
            is_wrong = log_evidences > 0.0
            half_drops = 0.5 * residual[: len(scale)][is_wrong] ** 2 / redundancy[: len(scale)][is_wrong]
            excess = max(float(half_drops.sum()) - 0.5 * float(residual @ residual), 0.0)
            return total + max(float(log_evidences[is_wrong].sum()) - excess, 0.0)
        total += float(log_evidences[most])
        unit = np.zeros(space.n_equations)
        unit[most] = 1.0
        column = space.project(unit[:, None])[:, 0]
        column -= model_basis @ (model_basis.T @ column)
        column /= np.sqrt(column[most])
        residual = residual - column * (column @ residual)
        redundancy, model_basis = redundancy - column**2, np.column_stack([model_basis, column])
    return total


def log_mean_exp_by_group(values: Floats, group_indices: Ints, n_groups: int) -> Floats:
    """Log of the mean of exp(values) over each of `n_groups` groups, none of which is empty.

    `group_indices` (h,) are the groups of h values, `values` (h,), or `values` (h, trials) with a column for each
    simulated recording.
    """
    order = np.argsort(group_indices, kind="stable")
    starts = np.searchsorted(group_indices[order], np.arange(n_groups))
    top = np.maximum.reduceat(values[order], starts, axis=0)
    group_sums = np.add.reduceat(np.exp(values[order] - top[group_indices[order]]), starts, axis=0)
    group_sizes = np.bincount(group_indices, minlength=n_groups).reshape(-1, *([1] * (values.ndim - 1)))
    means: Floats = top + np.log(group_sums / group_sizes)
    return means


def log_evidence_of_coefficients(gram: Floats, score: Floats, plausible_sizes: Floats) -> Floats:
    """Log evidence (...) of k coefficients with the prior N(0, (t size)^2), averaged over size factors t.

    Parameters
    ----------
    gram : (..., k, k) float
        Gram matrix of the design matrix, projected off the unknowns.
    score : (..., k) float
        Product of the transposed projected design matrix with the residuals.
    plausible_sizes : (..., k) float
        Plausible sizes of the coefficients.
    """
    eigenvalues, eigenvectors = _scaled_eigen_decomposition(gram, plausible_sizes)
    return log_evidence((np.swapaxes(eigenvectors, -1, -2) @ score[..., None])[..., 0] ** 2, eigenvalues)


def coefficient_posterior(
    gram: Floats,
    score: Floats,
    plausible_sizes: Floats,
    size_factors: Floats = RELATIVE_EFFECT_SIZES,
    log_size_prior: Floats = LOG_PRIOR_OF_EFFECT_SIZES,
) -> tuple[Floats, Floats, float]:
    """Posterior mean (k,), covariance (k, k) and log evidence of k coefficients, averaged over size factors t.

    The prior of a coefficient is N(0, (t size)^2) with its plausible size. The factors t are `size_factors`, and
    `log_size_prior` are the logs of their prior weights. `gram` (k, k) is the Gram matrix of the design columns, and
    `score` (k,) their products with the residuals.
    """
    eigenvalues, eigenvectors = _scaled_eigen_decomposition(gram, plausible_sizes)
    z = eigenvectors.T @ score
    log_evidences = log_evidence_by_size(
        z**2, score_weights_and_constants_by_size(eigenvalues, size_factors, log_size_prior)
    )
    weight = normalised_probabilities(log_evidences)
    variances = size_factors[:, None] ** 2 / (1.0 + size_factors[:, None] ** 2 * eigenvalues)
    means = variances * z
    averaged_mean = weight @ means
    deviations = means - averaged_mean
    inner_covariance = np.diag(weight @ variances) + (weight[:, None] * deviations).T @ deviations
    return (
        eigenvectors @ averaged_mean,
        eigenvectors @ inner_covariance @ eigenvectors.T,
        float(log_sum_exp(log_evidences)),
    )


def most_probable_size_factor(gram: Floats, score: Floats, plausible_sizes: Floats) -> float:
    """Factor t of `RELATIVE_EFFECT_SIZES` with the largest posterior probability, for k coefficients.

    The prior of a coefficient is N(0, (t size)^2). `gram` (k, k) is the Gram matrix of the design columns, and `score`
    (k,) their products with the residuals.
    """
    eigenvalues, eigenvectors = _scaled_eigen_decomposition(gram, plausible_sizes)
    log_evidences = log_evidence_by_size(
        (eigenvectors.T @ score) ** 2, score_weights_and_constants_by_size(eigenvalues)
    )
    return float(RELATIVE_EFFECT_SIZES[index_of_most_evidence(log_evidences)])


def _scaled_eigen_decomposition(gram: Floats, plausible_sizes: Floats) -> tuple[Floats, Floats]:
    """Eigenvalues (..., k) of Gram matrices scaled by plausible sizes, and scaled eigenvectors (..., k, k).

    The product of the transposed eigenvectors with a score is the score along each eigenvector.
    """
    eigenvalues, vectors = np.linalg.eigh(gram * plausible_sizes[..., :, None] * plausible_sizes[..., None, :])
    return np.maximum(eigenvalues, 0.0), plausible_sizes[..., None] * vectors


MAX_AVERAGED_HYPOTHESES = 12
"""Number of hypotheses in the average of an estimate: the most probable ones. It limits the computing time."""
N_EXACTLY_EVALUATED_HYPOTHESES = 7
"""Number of hypotheses of each kind (catalogue effects, hypotheses of other noise than declared, and empirical laws,
which describe errors as functions of covariates) whose evidence is computed without approximation, to limit the
computing time. They are those with the largest approximate log evidence. The approximate evaluation returns the same
number of laws for each combination of stations and targets."""
MAX_LOG_EVIDENCE_DEFICIT_FOR_EXACT_EVALUATION = 10.0
"""Largest deficit of a hypothesis in approximate log evidence, relative to the best one, for an exact evaluation. It
applies to local optima of a catalogue effect (over stations, targets and shape parameters), and to products of an
empirical law (error as a function of covariates) and a second factor."""
WIDE_PRIOR_SIGMA_FACTOR = 30.0
"""Prior standard deviation of reported sizes, divided by their plausible sizes. Such a wide prior hardly shrinks the
estimates, but keeps undetermined combinations finite."""


def wide_prior_posterior(gram: Floats, score: Floats, plausible_sizes: Floats) -> tuple[Floats, Floats, float]:
    """Posterior mean (k,), covariance (k, k) and log evidence of k coefficients with a wide prior.

    The prior standard deviation is `WIDE_PRIOR_SIGMA_FACTOR` times the plausible size. `gram` (k, k) is the Gram matrix
    of the design columns, projected onto the residual space, and `score` (k,) their products with the residuals.
    """
    return coefficient_posterior(gram, score, plausible_sizes, np.array([WIDE_PRIOR_SIGMA_FACTOR]), np.zeros(1))


def log_positivity_factor(posterior_mean: float, sigma: float) -> float:
    """Log of the factor on the evidence of a parameter that cannot be negative.

    The factor is twice the posterior probability of a positive value, for a normal posterior with the mean
    `posterior_mean` and the standard deviation `sigma`.
    """
    return float(np.log(2.0) + log_ndtr(posterior_mean / max(sigma, 1e-300)))


def log_evidence_of_effect(effect: CandidateEffect, gram: Floats, score: Floats) -> float:
    """Log Bayes factor of an effect with k coefficients against no effect, averaged over the sizes of the effect.

    `gram` (k, k) is the Gram matrix of its design columns, projected onto the residual space, and `score` (k,) their
    products with the residuals.
    """
    plausible_sizes = effect.plausible_sizes
    if not any(p.is_nonnegative for p in effect.parameters):
        return float(log_evidence_of_coefficients(gram, score, plausible_sizes))
    mean, covariance, total = coefficient_posterior(gram, score, plausible_sizes)
    for p, m, v in zip(effect.parameters, mean, np.diag(covariance), strict=True):
        total += log_positivity_factor(float(m), float(np.sqrt(v))) if p.is_nonnegative else 0.0
    return total


MAX_SIZE_FACTOR_TO_NOISE_LEVEL = 1e4
"""Largest factor by which the plausible size of an error of a tracker is raised, as from a tenth of a micrometre to a
millimetre."""


def size_factor_to_noise_level(effects_in_sigmas: Floats) -> float:
    """Factor, at least 1, that raises the plausible size of an effect to the noise, below which it is not detectable.

    `effects_in_sigmas` (n,) is the change of each of n pointings by the effect with its plausible size, divided by the
    noise. After multiplication by the factor, its median over the affected pointings is at least 1.
    """
    positive = np.sort(effects_in_sigmas[effects_in_sigmas > 0])
    if not len(positive):
        return 1.0
    median = 0.5 * float(positive[(len(positive) - 1) // 2] + positive[len(positive) // 2])
    return 1.0 / min(max(median, 1.0 / MAX_SIZE_FACTOR_TO_NOISE_LEVEL), 1.0)


MIN_SQUARED_SHIFT_FRACTION_OF_OBSERVABLE = 0.01
"""Smallest share of an observable in the squared shift of all readings by an effect. With a smaller share the effect is
not reported to act on this observable."""
MIN_SQUARED_PROJECTED_SHIFT_FRACTION_OF_OBSERVABLE = 0.1
"""Smallest share of an observable in the squared shift of all residuals by an effect. With a smaller share the effect
is not reported to act on this observable. It is larger than `MIN_SQUARED_SHIFT_FRACTION_OF_OBSERVABLE`, because the
adjustment spreads a shift of one observable over the other observables."""


def observables_changed_by_effect(is_used_reading: Bools, shift: Floats, projected_shift: Floats) -> tuple[str, ...]:
    """Names of the observables on which an effect acts; empty if it acts on all.

    `is_used_reading` (n, 3) flags the r used readings of n pointings. `shift` (r,) is the whitened shift of these
    readings by the effect, and `projected_shift` (r,) the part of it that appears in the residuals.
    """
    active = (
        _squared_shift_fraction_by_observable(is_used_reading, shift) >= MIN_SQUARED_SHIFT_FRACTION_OF_OBSERVABLE
    ) & (
        _squared_shift_fraction_by_observable(is_used_reading, projected_shift)
        >= MIN_SQUARED_PROJECTED_SHIFT_FRACTION_OF_OBSERVABLE
    )
    return () if active.all() else tuple(name for name, acts in zip(OBSERVABLES, active.tolist(), strict=True) if acts)


def _squared_shift_fraction_by_observable(is_used_reading: Bools, shift: Floats) -> Floats:
    """Share (3,) of each of the three observables in the squared `shift` (r,) of r readings.

    `is_used_reading` (n, 3) flags these readings among those of n pointings.
    """
    kind = np.nonzero(is_used_reading)[1]
    squares = np.bincount(kind, shift**2, minlength=len(OBSERVABLES))
    fraction: Floats = squares / max(float(squares.sum()), 1e-300)
    return fraction


RELATIVE_DISCREPANCY_GRID = np.geomspace(0.05, 1.0, 9)
"""Grid of relative differences between the changes of readings by an unmodelled cause and by the hypothesis that it
resembles. The grid is log-uniform from 0.05, a hardly visible difference, to 1, a difference as large as the change."""


def log_bayes_factor_of_discrepancy(space: ResidualSpace, shift: Floats, residual: Floats, redundancy: Floats) -> float:
    """Log Bayes factor of an unmodelled cause that resembles a hypothesis, relative to the hypothesis itself.

    Such a cause differs from the hypothesis by a random shift of each reading. The standard deviation of this shift is
    delta times the rms shift by the hypothesis in the observable, with delta log-uniform over
    `RELATIVE_DISCREPANCY_GRID`. The restricted likelihood of the added variance shows whether the residuals support the
    unmodelled cause. For a weak effect the Bayes factor is near 1.

    Parameters
    ----------
    space : ResidualSpace
        Whitened equations of the adjustment, projected off its unknowns (residual space).
    shift : (m,) float
        Whitened shift of m observation equations by the hypothesis.
    residual, redundancy : (m,) float
        Whitened residuals with the hypothesis modelled, and their redundancy numbers.
    """
    kind = np.nonzero(space.is_used_reading)[1]
    rows = np.flatnonzero(shift[: len(kind)])
    kind, square, share = kind[rows], residual[rows] ** 2, redundancy[rows]
    n_by_kind = np.maximum(np.bincount(kind, minlength=3), 1)
    mean_squares = (np.bincount(kind, shift[rows] ** 2, minlength=3) / n_by_kind)[kind]
    variance = 1.0 + RELATIVE_DISCREPANCY_GRID[:, None] ** 2 * mean_squares
    log_likelihood_ratios = log_restricted_likelihood_ratio(square, share, variance).sum(axis=1)
    return float(log_sum_exp(log_likelihood_ratios) - np.log(len(RELATIVE_DISCREPANCY_GRID)))
