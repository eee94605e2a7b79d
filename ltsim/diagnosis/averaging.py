"""Bayesian model average of the target coordinates over all explanations that the recording does not exclude.

An explanation is one possible cause of the residuals: a catalogue effect, an empirical law, or no effect. Each
explanation shifts the adjusted coordinates. Its prior shrinks its size. Its weight in the average is its probability
(Hoeting et al. 1999, Statistical Science 14). The curve of an empirical law is an approximation. Log evidences are
therefore divided by a temperature above 1, and the explanations with the observables of the law are estimated together,
as parts of one change. The covariance of the coordinates includes the variance between explanations.

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
from ltsim.core.arrays import MAX_TEMPORARY_ENTRIES, Floats
from ltsim.diagnosis.diagnosis import AveragedTargets
from ltsim.diagnosis.evidence import (
    MAX_AVERAGED_HYPOTHESES,
    coefficient_posterior,
    most_probable_size_factor,
    normalised_probabilities,
    wide_prior_posterior,
)
from ltsim.diagnosis.hypotheses import EffectModel, Hypothesis, HypothesisRanking
from ltsim.diagnosis.search import Searcher
from ltsim.diagnosis.shape_parameters import shape_parameter_nodes
from ltsim.geometry.rigid import remove_rigid_motion
from ltsim.physics.effects.effect import NoiseEffect
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.variance import VarianceFunction

MAX_RELATIVE_COORDINATE_ERROR_INCREASE = 0.05
"""Relative increase of the coordinate error that a correction for an empirical law (error as a function of covariates)
may cause. A larger increase is permitted only with the probability `MAX_PROBABILITY_OF_LARGER_ERROR_INCREASE`."""
MAX_PROBABILITY_OF_LARGER_ERROR_INCREASE = 0.03
"""Largest permitted probability that a correction for an empirical law (error as a function of covariates) increases
the coordinate error by more than the fraction `MAX_RELATIVE_COORDINATE_ERROR_INCREASE`."""
MIN_PROBABILITY_OF_AVERAGED_EXPLANATION = 0.003
"""Smallest probability of an explanation (possible cause of the residuals) in the averaged coordinates. Less probable
explanations are left out to limit the computing time."""


def average_over_explanations(
    searcher: Searcher, model: EffectModel, rankings_of_alternatives: Sequence[HypothesisRanking], refit: Refit
) -> tuple[AveragedTargets, Floats]:
    """Target coordinates and changes of the readings, averaged over the possible causes of each effect in a model.

    Parameters
    ----------
    searcher : Searcher
        Search that evaluates the possible causes.
    model : EffectModel
        Selected effects.
    rankings_of_alternatives : sequence of HypothesisRanking
        Alternatives to each effect in the model, with their probabilities.
    refit : Refit
        Nonlinear adjustment with the effects in the model.

    Returns
    -------
    AveragedTargets
        Coordinates and covariance of the refit, corrected by the average over the possible causes.
    (n, 3) float
        Averaged change of the three readings of n pointings, minus their change by the refit [m, rad, rad].
    """
    refitted = [replace(h, effect=effect) for h, effect in zip(model.hypotheses, refit.effects, strict=True)]
    space, linear = searcher.residual_space, first_order_reading_change(searcher, searcher.model_with(refitted))
    state, n_targets = refit.adjustment.state, len(refit.adjustment.state.target_points)
    points = np.concatenate([state.target_points, state.station_positions]) + space.point_shifts(linear)
    change = -linear
    shift_by_laws, weighted_deviations = np.zeros_like(points), [np.zeros((0, *points.shape))]
    for i, ranking in enumerate(rankings_of_alternatives):
        others = searcher.model_without(model, i)
        weights, changes = alternative_probabilities_and_reading_changes(
            searcher, others, model.hypotheses[i], ranking, 1.0 + model.discrepancy_penalty
        )
        shifts = np.stack([-space.point_shifts(row) for row in changes])
        mean_change = (
            weights @ changes
            if model.hypotheses[i].is_catalogued
            else (1.0 - weights[-1])
            * reading_change_by_combined_hypotheses(
                searcher, others, model.hypotheses[i], ranking, 1.0 + model.discrepancy_penalty
            )
        )
        mean = -space.point_shifts(mean_change)
        points += mean
        change += mean_change
        shift_by_laws += mean if not model.hypotheses[i].is_catalogued else 0.0
        weighted_deviations.append(np.sqrt(weights)[:, None, None] * (shifts - mean))
    deviations = np.concatenate(weighted_deviations)
    residual_shift = (
        1.0
        - _max_subtracted_fraction_of_target_shifts(
            refit.adjustment, shift_by_laws[:n_targets], deviations[:, :n_targets]
        )
    ) * shift_by_laws
    spread = np.concatenate([deviations, residual_shift[None]])
    adjustment = refit.adjustment
    covariance = adjustment.target_covariances + covariance_due_to_air(
        adjustment, adjustment.problem.unknowns.target_columns
    )
    of_targets, points = spread[:, :n_targets], points - residual_shift
    covariance = covariance + np.einsum("kti,ktj->tij", of_targets, of_targets)
    averaged = AveragedTargets(points[:n_targets], covariance, of_targets, points[n_targets:], spread[:, n_targets:])
    return averaged, space.unwhiten(change)


def _max_subtracted_fraction_of_target_shifts(
    adjustment: Adjustment, target_shifts: Floats, weighted_deviations_by_explanation: Floats
) -> float:
    """Largest fraction of a shift of the targets that can be subtracted with a small risk of larger coordinate errors.

    `target_shifts` (T, 3) [m] are the shifts of T targets. `weighted_deviations_by_explanation` (k, T, 3) [m] are the
    differences of the shifts by each of k possible causes from their mean, multiplied by the square root of the
    probability of the cause.
    """
    problem, points = adjustment.problem, np.nan_to_num(adjustment.state.target_points)
    shift = remove_rigid_motion(
        np.nan_to_num(target_shifts).reshape(-1, 1), points - points.mean(axis=0), problem.free_motions
    )[:, 0]
    shift_vector = np.zeros(adjustment.solution.system.design.shape[1])
    shift_vector[problem.unknowns.target_columns.ravel()] = shift
    deviations_along_shift = (
        np.nan_to_num(weighted_deviations_by_explanation).reshape(len(weighted_deviations_by_explanation), len(shift))
        @ shift
    )
    spread = float(
        shift_vector @ adjustment.factorised_normals.multiply_by_covariance(shift_vector[:, None])[:, 0]
        + deviations_along_shift @ deviations_along_shift
    )
    noise = float(
        np.nansum(np.einsum("tii->t", adjustment.target_covariances)) + np.nansum(weighted_deviations_by_explanation**2)
    )
    return max_subtracted_shift_fraction(float(shift @ shift), spread, noise)


def max_subtracted_shift_fraction(
    shift_sum_of_squares: float, variance_of_cross_product: float, expected_sum_of_squared_errors: float
) -> float:
    """Largest fraction t of a shift s of coordinates that can be subtracted with a small risk of larger errors.

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
    searcher: Searcher,
    reduced_model: EffectModel,
    selected_hypothesis: Hypothesis,
    ranking: HypothesisRanking,
    temperature: float,
) -> tuple[Floats, Floats]:
    """Probabilities (k,) of k possible causes, and the change (k, m) of m whitened readings by each cause.

    The first cause is the effect `selected_hypothesis`, the last one is no effect. Hypotheses of changed noise shift no
    reading, so that their probabilities are added to that of no effect. `reduced_model` is the model without the
    selected effect, and `ranking` contains its alternatives. Log evidences are divided by `temperature`; a value above
    1 makes the probabilities more equal.
    """
    none, *rest_of = normalised_probabilities(
        np.array([ranking.log_evidence_of_no_cause, *(h.log_evidence for h in ranking.hypotheses)]) / temperature
    ).tolist()
    probable = [
        (h, p) for h, p in zip(ranking.hypotheses, rest_of, strict=True) if p > MIN_PROBABILITY_OF_AVERAGED_EXPLANATION
    ]
    other_models = [(h, p) for h, p in probable if not _is_noise_hypothesis(h)]
    other_models = [
        (h, p) for h, p in other_models[:MAX_AVERAGED_HYPOTHESES] if h.effect_key != selected_hypothesis.effect_key
    ]
    none += sum(p for h, p in zip(ranking.hypotheses, rest_of, strict=True) if _is_noise_hypothesis(h))
    p_rest = max(1.0 - none - sum(p for _, p in other_models), 0.0)
    instances = _hypotheses_at_probable_shapes(searcher, reduced_model, selected_hypothesis)
    reading_changes = [expected_reading_change(searcher, reduced_model, h) for h, _ in (*instances, *other_models)]
    reading_changes.append(np.zeros_like(reading_changes[0]))
    weights = np.array([*(p_rest * p for _, p in instances), *(p for _, p in other_models), none])
    return weights / weights.sum(), np.array(reading_changes)


def reading_change_by_combined_hypotheses(
    searcher: Searcher,
    reduced_model: EffectModel,
    selected_hypothesis: Hypothesis,
    ranking: HypothesisRanking,
    temperature: float,
) -> Floats:
    """Posterior mean (m,) of the change of m whitened readings by an empirical law with an uncertain function.

    An empirical law describes an error as a function of covariates. The true function of the covariates is hardly ever
    one of the hypotheses; it is near several of them. The prior of the change is therefore one normal distribution. Its
    covariance is the mean of the covariances of the hypotheses that change the same observables as
    `selected_hypothesis`, weighted by their probabilities. This is the covariance of the mixture of their priors. Log
    evidences are divided by `temperature`; a value above 1 makes the probabilities more equal. `reduced_model` is the
    model without the selected hypothesis, and `ranking` contains its alternatives. The number of combined hypotheses is
    limited to those with a probability above `MIN_PROBABILITY_OF_AVERAGED_EXPLANATION`, and by the memory for their
    design matrices.
    """
    space, basis = searcher.residual_space, reduced_model.projected_basis
    observables = set(selected_hypothesis.effect.observables)
    similar = [
        h
        for h in ranking.hypotheses
        if not _is_noise_hypothesis(h)
        and set(h.effect.observables) == observables
        and h.effect_key != selected_hypothesis.effect_key
    ]
    log_evidence = next(
        (h.log_evidence for h in ranking.hypotheses if h.effect_key == selected_hypothesis.effect_key),
        ranking.hypotheses[0].log_evidence,
    )
    probabilities = normalised_probabilities(np.array([log_evidence, *(h.log_evidence for h in similar)]) / temperature)
    combined = [
        (h.effect, float(p))
        for h, p in zip((selected_hypothesis, *similar), probabilities, strict=True)
        if p > MIN_PROBABILITY_OF_AVERAGED_EXPLANATION or h is selected_hypothesis
    ]
    ends = np.cumsum([len(effect.parameters) for effect, _ in combined]) * space.n_equations
    combined = combined[: max(int(np.searchsorted(ends, MAX_TEMPORARY_ENTRIES, side="right")), 1)]
    effects = [effect for effect, _ in combined]
    spreads = [
        np.sqrt(p) * effect.plausible_sizes * most_probable_size_factor(*moments, effect.plausible_sizes)
        for (effect, p), moments in zip(
            combined, searcher.evidence_calculator.grams_and_scores(effects, reduced_model), strict=True
        )
    ]
    design = np.hstack([space.whitened_design(effect) for effect in effects])
    projected = space.project(design)
    projected -= basis @ (basis.T @ projected)
    gram, score = projected.T @ projected, projected.T @ reduced_model.residual
    change: Floats = design @ coefficient_posterior(gram, score, np.concatenate(spreads))[0]
    return change


def _is_noise_hypothesis(hypothesis: Hypothesis) -> bool:
    """True for a hypothesis that changes the noise level and shifts no reading."""
    return isinstance(hypothesis.effect, NoiseEffect | VarianceFunction)


def _hypotheses_at_probable_shapes(
    searcher: Searcher, reduced_model: EffectModel, selected_hypothesis: Hypothesis
) -> list[tuple[Hypothesis, float]]:
    """Copies of a hypothesis with its most probable shape parameters, and the probability of each copy.

    Shape parameters enter the readings nonlinearly (period, time constant, onset time). `reduced_model` is the model
    without the hypothesis; its effects are estimated together with the hypothesis.
    """
    shapes = (
        []
        if isinstance(selected_hypothesis.effect, EmpiricalLaw)
        else shape_parameter_nodes(
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


def first_order_reading_change(searcher: Searcher, model: EffectModel) -> Floats:
    """Linear approximation of the change (m,) of m whitened readings by all effects in a refitted model."""
    if not model.hypotheses:
        return np.zeros(searcher.residual_space.n_equations)
    coefficient_means = wide_prior_posterior(
        *model.gram_and_score, np.concatenate([h.plausible_sizes for h in model.hypotheses])
    )[0]
    change: Floats = (
        np.hstack([searcher.residual_space.whitened_design(h.effect) for h in model.hypotheses]) @ coefficient_means
    )
    return change


def expected_reading_change(searcher: Searcher, reduced_model: EffectModel, hypothesis: Hypothesis) -> Floats:
    """Posterior mean (m,) of the change of m whitened readings by a hypothesis, given effects of `reduced_model`."""
    moments = searcher.evidence_calculator.grams_and_scores([hypothesis.effect], reduced_model)[0]
    change: Floats = (
        searcher.residual_space.whitened_design(hypothesis.effect)
        @ coefficient_posterior(*moments, hypothesis.plausible_sizes)[0]
    )
    return change
