"""Ratio of the components of a law: the same function of the regressor in all of them, with different sizes.

A stand that sinks moves along one line, and what differs between set-ups often differs in size alone. With a ratio u
(unit vector) of the w components and coefficients c, a law has k + w - 1 constants in place of w k. The evidence of
the coefficients is exact at the best ratio; over ratios it is integrated by Laplace's approximation with a uniform
prior on the half sphere (MacKay 2003, Information Theory, Inference, and Learning Algorithms, ch. 27).
"""

import numpy as np
from scipy.special import gammaln

from ltsim.core.arrays import Floats
from ltsim.core.rounding import MAX_ROUNDING_ERROR
from ltsim.diagnosis.evidence import coefficient_posterior, log_evidence_of_coefficients
from ltsim.solve.gauss_newton import MAX_ITERATIONS

RATIO_DECIMALS = 4
"""Number of decimals of a ratio, so that a law is equal to the one that is read from its text form."""


def best_ratio(gram: Floats, score: Floats, spread: Floats, components: int) -> tuple[tuple[float, ...], float, float]:
    """Best ratio (w,) of the components of a law, the log evidence with that ratio, and the log share of such ratios.

    The sum of both is the log evidence with the ratio integrated.

    Parameters
    ----------
    gram, score : (w k, w k), (w k,) float
        Products of the projected signature with itself and with the residual, component after component.
    spread : (w k,) float
        Prior standard deviations, equal in all components.
    """
    k = len(score) // components
    products, scores = gram.reshape(components, k, components, k), score.reshape(components, k)
    common_spread = spread[:k] * np.sqrt(components)
    coefficients = coefficient_posterior(gram, score, spread)[0].reshape(components, k)
    ratio = np.linalg.svd(coefficients / spread[:k], full_matrices=False)[0][:, 0]
    for _ in range(MAX_ITERATIONS):
        mean = coefficient_posterior(np.einsum("i,iajb,j->ab", ratio, products, ratio), ratio @ scores, common_spread)[
            0
        ]
        normal = np.einsum("a,iajb,b->ij", mean, products, mean)
        step = np.linalg.lstsq(normal, scores @ mean, rcond=1e-9)[0]
        if not step.any():
            break
        previous, ratio = ratio, step / np.linalg.norm(step)
        if np.abs(ratio - previous).max() < MAX_ROUNDING_ERROR:
            break
    ratio = np.round(ratio * np.sign(ratio[np.argmax(np.abs(ratio))]), RATIO_DECIMALS)
    inner = np.einsum("i,iajb,j->ab", ratio, products, ratio)
    mean = coefficient_posterior(inner, ratio @ scores, common_spread)[0]
    cross = np.einsum("a,iajb,j->ib", mean, products, ratio)
    curvature = np.einsum("a,iajb,b->ij", mean, products, mean)
    curvature -= cross @ np.linalg.solve(inner + np.diag(common_spread**-2.0), cross.T)
    evidence = float(log_evidence_of_coefficients(inner, ratio @ scores, common_spread))
    return tuple(ratio.tolist()), evidence, _log_share_of_ratios(curvature, ratio)


def _log_share_of_ratios(curvature: Floats, ratio: Floats) -> float:
    """Log of the share of the half sphere that the readings leave to a ratio, at most 0.

    The `curvature` (w, w) is that of the log evidence at the ratio (w,).
    """
    count = len(ratio)
    tangent = np.linalg.svd(ratio[None])[2][1:]
    strength = np.maximum(np.linalg.eigvalsh(tangent @ curvature @ tangent.T), 1e-12)
    log_area = 0.5 * count * np.log(np.pi) - gammaln(0.5 * count)  # of the half sphere in `count` dimensions
    return float(min(0.5 * np.sum(np.log(2.0 * np.pi / strength)) - log_area, 0.0))
