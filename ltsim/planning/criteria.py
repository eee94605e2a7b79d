"""Criteria of a design, for one covariance or for many at once. All are standard deviations: smaller is better.

A covariance (..., p, p) is in units of the prior sigmas, so that micrometres and microradians can be averaged; one
means that the readings told nothing. The letters of the literature are ordered alike: a D-optimal design (largest
determinant of the information) has the smallest value here, and so on. The A criterion is that of the covariance;
the trace of the information matrix is another thing, and no measure of precision.

References
----------
Atkinson, Donev, Tobias, Optimum Experimental Designs, with SAS (2007), chapter 10.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from ltsim.arrays import Floats

CriterionName = Literal["D", "A", "E"]


def d_criterion(covariance: Floats) -> Floats:
    """Geometric mean (...) of the standard deviations along the principal combinations: det^(1 / 2p).

    The volume of the confidence ellipsoid is proportional to its p-th power.
    """
    _, logarithm = np.linalg.slogdet(covariance)
    return np.exp(0.5 * logarithm / covariance.shape[-1])


def a_criterion(covariance: Floats) -> Floats:
    """Root mean square (...) of the parameters' standard deviations: the expected size of an error."""
    return np.sqrt(np.trace(covariance, axis1=-2, axis2=-1) / covariance.shape[-1])


def e_criterion(covariance: Floats) -> Floats:
    """Standard deviation (...) of the worst-determined combination of unit length."""
    return np.sqrt(np.linalg.eigvalsh(covariance)[..., -1])


def g_criterion(covariance: Floats, regressors: Floats) -> Floats:
    """Largest standard deviation (...) of a prediction.

    Parameters
    ----------
    covariance : (..., p, p) float
    regressors : (m, p) float
        Each row predicts one quantity from the parameters: for an instrument, the correction of a reading
        somewhere in the working volume, as a displacement [m].
    """
    spread = np.einsum("mi,...ij,mj->...m", regressors, covariance, regressors, optimize=True)
    return np.sqrt(spread.max(axis=-1))


def i_criterion(covariance: Floats, regressors: Floats) -> Floats:
    """Root mean square standard deviation (...) of the predictions in `regressors` (m, p)."""
    moment = regressors.T @ regressors / len(regressors)
    return np.sqrt(np.einsum("...ij,ji->...", covariance, moment))


CRITERIA: dict[CriterionName, Callable[[Floats], Floats]] = {
    "D": d_criterion,
    "A": a_criterion,
    "E": e_criterion,
}
