"""Fixed ratio of the components of an empirical law: all components follow the same function, in different sizes.

For example, a stand that sinks moves along one line, and an error often differs between set-ups only in its size. Let w
be the number of components, each with k coefficients. With a ratio u (unit vector) of the components and coefficients c
that they share, a law has k + w - 1 unknowns in place of w k. The evidence of the coefficients is exact at the ratio
with the largest evidence. It is integrated over all ratios by Laplace's approximation with a uniform prior on the half
sphere (MacKay 2003, Information Theory, Inference, and Learning Algorithms, ch. 27).
"""

import numpy as np
from scipy.special import gammaln

from ltsim.core.arrays import Floats
from ltsim.core.rounding import SQRT_MACHINE_EPSILON
from ltsim.diagnosis.evidence import coefficient_posterior, log_evidence_of_coefficients
from ltsim.solve.gauss_newton import MAX_ITERATIONS

LAW_COMPONENT_RATIO_DECIMALS = 4
"""Number of decimals of the rounded ratio (unit vector) of the components of an empirical law (error as a function of
covariates). The law is then equal to the law that is read from its text form."""


def best_component_ratio(
    gram: Floats, score: Floats, plausible_sizes: Floats, n_components: int
) -> tuple[tuple[float, ...], float, float]:
    """Most probable ratio (w,) (unit vector) of the w components of an empirical law, and two logarithms.

    The first logarithm is the log evidence at this ratio. The second is the log of the fraction of all ratios that the
    readings permit. Their sum is the log evidence integrated over all ratios.

    Parameters
    ----------
    gram : (w k, w k) float
        Products of the projected design columns with each other, for w components with k coefficients each.
    score : (w k,) float
        Products of the projected design columns with the residuals.
    plausible_sizes : (w k,) float
        Plausible sizes of the coefficients, equal in all components.
    n_components : int
        Number w of components.
    """
    k = len(score) // n_components
    products, scores = gram.reshape(n_components, k, n_components, k), score.reshape(n_components, k)
    common_spread = plausible_sizes[:k] * np.sqrt(n_components)
    coefficients = coefficient_posterior(gram, score, plausible_sizes)[0].reshape(n_components, k)
    ratio = np.linalg.svd(coefficients / plausible_sizes[:k], full_matrices=False)[0][:, 0]
    for _ in range(MAX_ITERATIONS):
        coefficient_means = coefficient_posterior(
            np.einsum("i,iajb,j->ab", ratio, products, ratio), ratio @ scores, common_spread
        )[0]
        normal = np.einsum("a,iajb,b->ij", coefficient_means, products, coefficient_means)
        step = np.linalg.lstsq(normal, scores @ coefficient_means, rcond=1e-9)[0]
        if not step.any():
            break
        previous, ratio = ratio, step / np.linalg.norm(step)
        if np.abs(ratio - previous).max() < SQRT_MACHINE_EPSILON:
            break
    ratio = np.round(ratio * np.sign(ratio[np.argmax(np.abs(ratio))]), LAW_COMPONENT_RATIO_DECIMALS)
    component_gram = np.einsum("i,iajb,j->ab", ratio, products, ratio)
    coefficient_means = coefficient_posterior(component_gram, ratio @ scores, common_spread)[0]
    cross = np.einsum("a,iajb,j->ib", coefficient_means, products, ratio)
    log_evidence_curvature = np.einsum("a,iajb,b->ij", coefficient_means, products, coefficient_means)
    log_evidence_curvature -= cross @ np.linalg.solve(component_gram + np.diag(common_spread**-2.0), cross.T)
    evidence = float(log_evidence_of_coefficients(component_gram, ratio @ scores, common_spread))
    return tuple(ratio.tolist()), evidence, _log_fraction_of_permitted_ratios(log_evidence_curvature, ratio)


def _log_fraction_of_permitted_ratios(log_evidence_curvature: Floats, ratio: Floats) -> float:
    """Log, at most 0, of the fraction of all component ratios (points of a half sphere) that the readings permit.

    `log_evidence_curvature` (w, w) is the curvature of the log evidence at its maximum, which is the `ratio` (w,) of
    the w components.
    """
    n_components = len(ratio)
    tangent = np.linalg.svd(ratio[None])[2][1:]
    eigenvalues = np.maximum(np.linalg.eigvalsh(tangent @ log_evidence_curvature @ tangent.T), 1e-12)
    log_area = 0.5 * n_components * np.log(np.pi) - gammaln(
        0.5 * n_components
    )  # area of the half sphere in `n_components` dimensions
    return float(min(0.5 * np.sum(np.log(2.0 * np.pi / eigenvalues)) - log_area, 0.0))
