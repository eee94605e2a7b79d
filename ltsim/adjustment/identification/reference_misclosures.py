"""Misclosures of excluded reference values, with their standard deviations from all other observations."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ltsim.adjustment.identification.fit import NetworkFit
from ltsim.adjustment.identification.hypothesis import CauseHypothesis, ReferenceOmission
from ltsim.adjustment.identification.model_changes import apply_corrections_and_omissions
from ltsim.adjustment.reference_tests import ERROR_UNIT_BY_REFERENCE_KIND, length_sigma
from ltsim.adjustment.reference_values import common_scale_reference, reference_values
from ltsim.core.arrays import Floats
from ltsim.core.rounding import SQRT_MACHINE_EPSILON
from ltsim.core.units import MILLIMETRE
from ltsim.physics.model.measurement import with_spherical_earth_plumb_lines
from ltsim.solve.design import to_dense
from ltsim.solve.elimination import SingularSystemError
from ltsim.solve.gauss_newton import solution_for_plan


def misclosure_estimate(fit: NetworkFit, hypothesis: CauseHypothesis) -> dict[str, Any]:
    """Entries `estimate`, `sigma`, `unit` for the length of the misclosure of an excluded reference value.

    `sigma` is None if other observations do not predict the value.
    """
    assert isinstance(hypothesis.model_change, ReferenceOmission)
    value = hypothesis.model_change.reference_value
    unit, factor = ERROR_UNIT_BY_REFERENCE_KIND.get(value.kind, ("mm", MILLIMETRE))
    misclosure, sigma = fit.misclosure_of(value), None
    if (error_and_covariance := reference_error_and_covariance(fit, hypothesis)) is not None:
        misclosure, covariance = error_and_covariance
        sigma = length_sigma(misclosure, covariance) / factor
    size = float(np.linalg.norm(misclosure))
    return {"estimate": size / factor, "sigma": sigma or None, "unit": unit}


def reference_error_and_covariance(fit: NetworkFit, hypothesis: CauseHypothesis) -> tuple[Floats, Floats] | None:
    """Errors (q,) [SI] of q components of an excluded reference value, and covariance (q, q); None if not predicted.

    The error is the misclosure. If reference lengths have a common error, it is the misclosure of the length without
    that part of the common error which the other lengths show.

    The exclusion of a value is equivalent to its inclusion together with parameters for the errors of its components.
    The covariance is therefore the inverse of D' (I - H) D, where D are the derivatives of the whitened residuals with
    respect to these errors, and H is the hat matrix of the network with the value. It contains the uncertainty of the
    prediction by all other observations, the declared uncertainty of the value itself, and their correlation (common
    errors of reference lengths). It is 0 for components without a prediction.

    Source: Teunissen, Testing theory (2006), estimation of model errors in the adaptation step.
    """
    assert isinstance(hypothesis.model_change, ReferenceOmission)
    value, state = hypothesis.model_change.reference_value, fit.state
    other_hypotheses = [h for h in fit.hypotheses if h is not hypothesis]
    recording = apply_corrections_and_omissions(fit.fit_input.recording, other_hypotheses)
    recording = with_spherical_earth_plumb_lines(recording, state.station_positions)
    problem = fit.problem.with_model(replace(fit.problem.model, recording=recording))
    values = (*reference_values(problem, state), *common_scale_reference(problem, state))
    rows = next((v for v in values if (v.kind, v.name) == (value.kind, value.name)), None)
    if rows is None:
        return None
    try:
        solution = solution_for_plan(problem, state)
    except SingularSystemError:
        return None
    assert solution.factor is not None
    error_design = rows.design_columns
    normal_columns = to_dense(solution.system.design[rows.equation_indices]).T @ error_design
    response = solution.factor.multiply_by_covariance(normal_columns)
    norms = np.linalg.norm(error_design, axis=0)
    scale = np.where(norms > SQRT_MACHINE_EPSILON * norms.max(), norms, np.inf)
    redundancy = (error_design.T @ error_design - normal_columns.T @ response) / np.outer(scale, scale)
    inverse = np.linalg.pinv(redundancy, rcond=SQRT_MACHINE_EPSILON, hermitian=True) / np.outer(scale, scale)
    if value.kind != "length":
        return fit.misclosure_of(value), np.asarray(inverse)
    residuals, design = solution.system.whitened_residuals, solution.system.design
    products = error_design.T @ residuals[rows.equation_indices] - response.T @ (design.T @ residuals)
    return np.asarray(inverse @ products), np.asarray(inverse)
