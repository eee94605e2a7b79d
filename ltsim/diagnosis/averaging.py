"""Bayesian model average of the target coordinates over the explanations that the recording does not exclude.

An explanation is one possible cause of the residuals: an effect, a law, or no effect. Each explanation shifts the
adjusted coordinates. The prior shrinks the size of the explanation, and the weight of the explanation in the average is
its probability (Hoeting et al. 1999, Statistical Science 14). The curve of an empirical law is an approximation. Log
evidences are therefore divided by a temperature above 1. The covariance includes the variance between explanations.

Only a fraction t of the shift s of the targets by empirical laws is applied, because the laws may be wrong. Without the
shift, the error of the coordinates is s plus an independent error e. Subtracting t s changes the sum of squared errors
by t^2 s's - 2 t (s's + s'e), which is a normal variable.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.coordinate_uncertainty import covariance_due_to_air
from ltsim.adjustment.refit import Refit
from ltsim.core.arrays import Floats
from ltsim.diagnosis.diagnosis import AveragedTargets
from ltsim.diagnosis.evidence import (
    MAX_AVERAGED_HYPOTHESES,
    coefficient_posterior,
    normalised_probabilities,
    wide_prior_posterior,
)
from ltsim.diagnosis.hypotheses import Hypothesis, Model, Ranking
from ltsim.diagnosis.search import Searcher
from ltsim.diagnosis.shape_constants import shape_constants_nodes
from ltsim.geometry.rigid import remove_rigid_motion
from ltsim.physics.effects.effect import NoiseEffect
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.variance import VarianceFunction

MAX_RELATIVE_COORDINATE_ERROR_INCREASE = 0.05
"""Relative increase of the coordinate error by the correction for a law that is exceeded with a probability of at most
`MAX_PROBABILITY_OF_LARGER_ERROR_INCREASE`."""
MAX_PROBABILITY_OF_LARGER_ERROR_INCREASE = 0.03
"""Largest permitted probability that the relative increase of the coordinate error exceeds
`MAX_RELATIVE_COORDINATE_ERROR_INCREASE`."""
MIN_PROBABILITY_OF_AVERAGED_EXPLANATION = 0.003
"""Smallest probability of an explanation in the average. Less probable explanations are left out, to limit the
computing time."""


def average_over_explanations(
    searcher: Searcher, model: Model, rankings_of_alternatives: Sequence[Ranking], refit: Refit
) -> tuple[AveragedTargets, Floats]:
    """Target coordinates and change of the readings, averaged over the explanations for each effect in a model.

    `rankings_of_alternatives` contain the alternatives to each effect in the model, and `refit` is the nonlinear
    adjustment with the model.

    Returns
    -------
    AveragedTargets
        Coordinates and covariance of the refit, corrected by the average over the explanations.
    (n, 3) float
        Averaged change of the three readings of n pointings, minus their change by the refit [m, rad, rad].
    """
    refitted = [replace(h, effect=effect) for h, effect in zip(model.hypotheses, refit.effects, strict=True)]
    space, linear = searcher.space, first_order_reading_change(searcher, searcher.model_with(refitted))
    points, change = refit.adjustment.state.target_points + space.target_shifts(linear), -linear
    shift_by_laws, weighted_deviations = np.zeros_like(points), [np.zeros((0, *points.shape))]
    for i, ranking in enumerate(rankings_of_alternatives):
        others = searcher.model_without(model, i)
        weights, changes = alternative_probabilities_and_reading_changes(
            searcher, others, model.hypotheses[i], ranking, 1.0 + model.discrepancy_penalty
        )
        shifts = np.stack([-space.target_shifts(row) for row in changes])
        mean = np.einsum("k,kti->ti", weights, shifts)
        points += mean
        change += weights @ changes
        shift_by_laws += mean if not model.hypotheses[i].is_catalogued else 0.0
        weighted_deviations.append(np.sqrt(weights)[:, None, None] * (shifts - mean))
    deviations = np.concatenate(weighted_deviations)
    residual_shift = (
        1.0 - _max_subtracted_fraction_of_target_shifts(refit.adjustment, shift_by_laws, deviations)
    ) * shift_by_laws
    spread = np.concatenate([deviations, residual_shift[None]])
    adjustment = refit.adjustment
    covariance = adjustment.target_covariance + covariance_due_to_air(
        adjustment, adjustment.problem.unknowns.target_columns
    )
    covariance = covariance + np.einsum("kti,ktj->tij", spread, spread)
    return AveragedTargets(points - residual_shift, covariance, spread), space.unwhiten(change)


def _max_subtracted_fraction_of_target_shifts(
    adjustment: Adjustment, target_shifts: Floats, explanation_deviations: Floats
) -> float:
    """Largest fraction of a shift of the targets whose subtraction is likely to increase their errors only slightly.

    `target_shifts` (T, 3) [m] are the shifts of T targets, and `explanation_deviations` (k, T, 3) [m] are the weighted
    differences of the shifts by k explanations from their mean.
    """
    problem, points = adjustment.problem, np.nan_to_num(adjustment.state.target_points)
    shift = remove_rigid_motion(
        np.nan_to_num(target_shifts).reshape(-1, 1), points - points.mean(axis=0), problem.free_motions
    )[:, 0]
    shift_vector = np.zeros(adjustment.solution.system.design.shape[1])
    shift_vector[problem.unknowns.target_columns.ravel()] = shift
    deviations_along_shift = (
        np.nan_to_num(explanation_deviations).reshape(len(explanation_deviations), len(shift)) @ shift
    )
    spread = float(
        shift_vector @ adjustment.factorised_normals.multiply_by_covariance(shift_vector[:, None])[:, 0]
        + deviations_along_shift @ deviations_along_shift
    )
    noise = float(np.nansum(np.einsum("tii->t", adjustment.target_covariance)) + np.nansum(explanation_deviations**2))
    return max_subtracted_shift_fraction(float(shift @ shift), spread, noise)


def max_subtracted_shift_fraction(
    shift_sum_of_squares: float, variance_of_cross_product: float, expected_sum_of_squared_errors: float
) -> float:
    """Largest fraction t of a shift s of coordinates whose subtraction is likely to increase errors only slightly.

    The error of the coordinates without the subtraction is s + e, with an error e that is independent of s. The
    subtraction of t s changes the sum of squared errors by t^2 s's - 2 t (s's + s'e). This change is below ((1 +
    `MAX_RELATIVE_COORDINATE_ERROR_INCREASE`)^2 - 1) (s's + E[e'e]), except with the probability
    `MAX_PROBABILITY_OF_LARGER_ERROR_INCREASE`.

    Parameters
    ----------
    shift_sum_of_squares : float
        Sum of squares s's of the shift.
    variance_of_cross_product : float
        Variance of s'e.
    expected_sum_of_squared_errors : float
        Expectation E[e'e] of the sum of squares of the error e that is independent of the shift.
    """
    if shift_sum_of_squares == 0.0:
        return 1.0
    linear_term = (
        -float(ndtri(MAX_PROBABILITY_OF_LARGER_ERROR_INCREASE)) * np.sqrt(variance_of_cross_product)
        - shift_sum_of_squares
    )
    allowed_increase = ((1.0 + MAX_RELATIVE_COORDINATE_ERROR_INCREASE) ** 2 - 1.0) * (
        shift_sum_of_squares + expected_sum_of_squared_errors
    )
    return min(
        1.0,
        float(np.sqrt(linear_term**2 + shift_sum_of_squares * allowed_increase) - linear_term) / shift_sum_of_squares,
    )


def alternative_probabilities_and_reading_changes(
    searcher: Searcher, reduced_model: Model, selected_hypothesis: Hypothesis, ranking: Ranking, temperature: float
) -> tuple[Floats, Floats]:
    """Probabilities (k,) of k alternatives to a selected effect, and changes (k, m) of m whitened readings by each.

    The first alternative is the effect `selected_hypothesis` itself, the last one is no effect. The probabilities of
    changes of the noise are added to the last one, because they do not change readings either. `reduced_model` is the
    model without the selected effect. Log evidences are divided by `temperature`.
    """
    none, *rest_of = normalised_probabilities(
        np.array([ranking.log_evidence_of_no_cause, *(h.log_evidence for h in ranking.hypotheses)]) / temperature
    ).tolist()
    probable = [
        (h, p) for h, p in zip(ranking.hypotheses, rest_of, strict=True) if p > MIN_PROBABILITY_OF_AVERAGED_EXPLANATION
    ]
    other_models = [(h, p) for h, p in probable if not _is_noise_hypothesis(h)]
    other_models = [(h, p) for h, p in other_models[:MAX_AVERAGED_HYPOTHESES] if h.key != selected_hypothesis.key]
    none += sum(p for h, p in zip(ranking.hypotheses, rest_of, strict=True) if _is_noise_hypothesis(h))
    p_rest = max(1.0 - none - sum(p for _, p in other_models), 0.0)
    instances = _hypotheses_at_probable_shapes(searcher, reduced_model, selected_hypothesis)
    reading_changes = [expected_reading_change(searcher, reduced_model, h) for h, _ in (*instances, *other_models)]
    reading_changes.append(np.zeros_like(reading_changes[0]))
    weights = np.array([*(p_rest * p for _, p in instances), *(p for _, p in other_models), none])
    return weights / weights.sum(), np.array(reading_changes)


def _is_noise_hypothesis(hypothesis: Hypothesis) -> bool:
    """True for a hypothesis that is a change of the noise, which shifts no reading."""
    return isinstance(hypothesis.effect, NoiseEffect | VarianceFunction)


def _hypotheses_at_probable_shapes(
    searcher: Searcher, reduced_model: Model, selected_hypothesis: Hypothesis
) -> list[tuple[Hypothesis, float]]:
    """Copies of a hypothesis with the most probable values of its shape constants, and the probability of each copy.

    Shape constants are constants of an effect on which the readings depend nonlinearly, such as a period or a time
    constant. `reduced_model` is the model without the hypothesis; its effects are taken into account.
    """
    shapes = (
        []
        if isinstance(selected_hypothesis.effect, EmpiricalLaw)
        else shape_constants_nodes(
            searcher.evidence_calculator, selected_hypothesis.effect, reduced_model, {}, uses_search_prior=True
        )
    )
    if not shapes:
        return [(selected_hypothesis, 1.0)]
    weights = normalised_probabilities(np.array([node.log_weight for node in shapes]))
    ranked = sorted(zip(shapes, weights, strict=True), key=lambda pair: -pair[1])[:MAX_AVERAGED_HYPOTHESES]
    return [
        (replace(selected_hypothesis, effect=node.effect), float(p))
        for node, p in ranked
        if p > MIN_PROBABILITY_OF_AVERAGED_EXPLANATION
    ]


def first_order_reading_change(searcher: Searcher, model: Model) -> Floats:
    """Linear approximation of the change (m,) of m whitened readings by all effects in a refitted model."""
    if not model.hypotheses:
        return np.zeros(searcher.space.n_equations)
    coefficient_means = wide_prior_posterior(
        *model.gram_and_score, np.concatenate([h.plausible_sizes for h in model.hypotheses])
    )[0]
    change: Floats = np.hstack([searcher.space.whitened_design(h.effect) for h in model.hypotheses]) @ coefficient_means
    return change


def expected_reading_change(searcher: Searcher, reduced_model: Model, hypothesis: Hypothesis) -> Floats:
    """Posterior mean (m,) of the change of m whitened readings by a hypothesis, given the effects of another model."""
    moments = searcher.evidence_calculator.grams_and_scores([hypothesis.effect], reduced_model)[0]
    change: Floats = (
        searcher.space.whitened_design(hypothesis.effect)
        @ coefficient_posterior(*moments, hypothesis.plausible_sizes)[0]
    )
    return change
