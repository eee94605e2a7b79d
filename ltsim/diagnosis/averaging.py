"""Bayesian model average of the target coordinates over the explanations that the recording does not exclude.

Each explanation shifts the adjusted coordinates; sizes are shrunk by their prior, and explanations are weighted by
their probability, "no effect" included (Hoeting et al. 1999, Statistical Science 14). The curve of an empirical law is
an approximation, so evidence between laws is tempered by its discrepancy. The covariance includes the variance between
explanations.

The shift s of the targets by empirical laws is applied as far as the risk allows. Without it, coordinates err by s and
by an independent error e; applying t s changes the sum of squares by t^2 s's - 2 t (s's + s'e), a normal variable.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.refit import Refit
from ltsim.adjustment.unmodelled import air_covariance
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
from ltsim.diagnosis.shapes import shape_nodes
from ltsim.geometry.rigid import remove_rigid_motion
from ltsim.physics.effects.effect import NoiseEffect
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.variance import VarianceFunction

MAX_ERROR_INCREASE = 0.05
"""Permitted relative increase of the coordinate error when the shift of a law is subtracted."""
P_ERROR_INCREASE_EXCEEDED = 0.03
"""Probability with which the increase of the coordinate error may exceed `MAX_ERROR_INCREASE`."""
MIN_AVERAGED_PROBABILITY = 0.003
"""Smallest probability of an averaged explanation (cost)."""


def average_over_explanations(
    searcher: Searcher, model: Model, rankings: Sequence[Ranking], fitted: Refit
) -> tuple[AveragedTargets, Floats]:
    """Average over the alternative explanations of each member of a refitted model.

    Returns
    -------
    Targets
        Coordinates, those of the refit to second order.
    (n, 3) float
        Difference of the expected change of the readings from that of the refit [m, rad, rad].
    """
    refitted = [replace(h, effect=effect) for h, effect in zip(model.members, fitted.effects, strict=True)]
    space, linear = searcher.space, first_order_change(searcher, searcher.model_of(refitted))
    points, change = fitted.adjustment.state.target_points + space.target_shifts(linear), -linear
    by_laws, open_ = np.zeros_like(points), [np.zeros((0, *points.shape))]
    for i, ranking in enumerate(rankings):
        others = searcher.model_without(model, i)
        weights, changes = model_weights(searcher, others, model.members[i], ranking, 1.0 + model.discrepancy_penalty)
        shifts = np.stack([-space.target_shifts(row) for row in changes])
        mean = np.einsum("k,kti->ti", weights, shifts)
        points += mean
        change += weights @ changes
        by_laws += mean if not model.members[i].is_catalogued else 0.0
        open_.append(np.sqrt(weights)[:, None, None] * (shifts - mean))
    deviations = np.concatenate(open_)
    residual_shift = (1.0 - _safe_fraction_of_change(fitted.adjustment, by_laws, deviations)) * by_laws
    spread = np.concatenate([deviations, residual_shift[None]])
    adjustment = fitted.adjustment
    covariance = adjustment.target_covariance + air_covariance(adjustment, adjustment.problem.unknowns.target_columns)
    covariance = covariance + np.einsum("kti,ktj->tij", spread, spread)
    return AveragedTargets(points - residual_shift, covariance, spread), space.unwhiten(change)


def _safe_fraction_of_change(adjustment: Adjustment, change: Floats, deviations: Floats) -> float:
    """Largest fraction of a change (T, 3) [m] that hardly increases target errors.

    Explanations deviate by (k, T, 3) [m].
    """
    problem, points = adjustment.problem, np.nan_to_num(adjustment.state.target_points)
    shift = remove_rigid_motion(
        np.nan_to_num(change).reshape(-1, 1), points - points.mean(axis=0), problem.free_motions
    )[:, 0]
    along = np.zeros(adjustment.solution.system.design.shape[1])
    along[problem.unknowns.target_columns.ravel()] = shift
    disagreements = np.nan_to_num(deviations).reshape(len(deviations), len(shift)) @ shift
    spread = float(
        along @ adjustment.factorised_normals.covariance_columns(along[:, None])[:, 0] + disagreements @ disagreements
    )
    noise = float(np.nansum(np.einsum("tii->t", adjustment.target_covariance)) + np.nansum(deviations**2))
    return safe_fraction(float(shift @ shift), spread, noise)


def safe_fraction(size: float, spread: float, noise: float) -> float:
    """Largest fraction t of a shift s for which t^2 s's - 2 t (s's + s'e) is small.

    It is below ((1 + `MAX_ERROR_INCREASE`)^2 - 1) (s's + e'e), with e'e at its expectation, except with probability
    `P_ERROR_INCREASE_EXCEEDED`.

    Parameters
    ----------
    size, spread, noise : float
        s's, the variance of s'e, the expectation of e'e.
    """
    if size == 0.0:
        return 1.0
    linear_term = -float(ndtri(P_ERROR_INCREASE_EXCEEDED)) * np.sqrt(spread) - size
    allowed_increase = ((1.0 + MAX_ERROR_INCREASE) ** 2 - 1.0) * (size + noise)
    return min(1.0, float(np.sqrt(linear_term**2 + size * allowed_increase) - linear_term) / size)


def model_weights(
    searcher: Searcher, other_effects: Model, selected: Hypothesis, ranking: Ranking, temperature: float
) -> tuple[Floats, Floats]:
    """Weights (k,) of explanations, the chosen one first, and the whitened change (k, m) of the readings by each.

    Log evidences are divided by `temperature`. Changes of the noise, like no effect, do not change readings.
    """
    none, *rest_of = normalised_probabilities(
        np.array([0.0, *(h.log_evidence for h in ranking.entries)]) / temperature
    ).tolist()
    probable = [(h, p) for h, p in zip(ranking.entries, rest_of, strict=True) if p > MIN_AVERAGED_PROBABILITY]
    entries = [(h, p) for h, p in probable if not _is_noise_hypothesis(h)]
    entries = [(h, p) for h, p in entries[:MAX_AVERAGED_HYPOTHESES] if h.key != selected.key]
    none += sum(p for h, p in zip(ranking.entries, rest_of, strict=True) if _is_noise_hypothesis(h))
    p_rest = max(1.0 - none - sum(p for _, p in entries), 0.0)
    instances = _instances_at_probable_shapes(searcher, other_effects, selected)
    changes = [expected_change(searcher, other_effects, h) for h, _ in (*instances, *entries)]
    changes.append(np.zeros_like(changes[0]))
    weights = np.array([*(p_rest * p for _, p in instances), *(p for _, p in entries), none])
    return weights / weights.sum(), np.array(changes)


def _is_noise_hypothesis(hypothesis: Hypothesis) -> bool:
    """True for a change of the noise."""
    return isinstance(hypothesis.effect, NoiseEffect | VarianceFunction)


def _instances_at_probable_shapes(
    searcher: Searcher, other_effects: Model, selected: Hypothesis
) -> list[tuple[Hypothesis, float]]:
    """Instances of an explanation at its most probable shapes, with their probabilities."""
    shapes = (
        []
        if isinstance(selected.effect, EmpiricalLaw)
        else shape_nodes(searcher.evidence_calculator, selected.effect, other_effects, {}, within_plausible=True)
    )
    if not shapes:
        return [(selected, 1.0)]
    weights = normalised_probabilities(np.array([node.log_weight for node in shapes]))
    ranked = sorted(zip(shapes, weights, strict=True), key=lambda pair: -pair[1])[:MAX_AVERAGED_HYPOTHESES]
    return [(replace(selected, effect=node.effect), float(p)) for node, p in ranked if p > MIN_AVERAGED_PROBABILITY]


def first_order_change(searcher: Searcher, model: Model) -> Floats:
    """First-order change (m,) of the whitened readings by all members of a refitted model."""
    if not model.members:
        return np.zeros(searcher.space.n_rows)
    mean = wide_prior_posterior(*model.gram_and_scores, np.concatenate([h.plausible_sizes for h in model.members]))[0]
    change: Floats = np.hstack([searcher.space.whitened_signature(h.effect) for h in model.members]) @ mean
    return change


def expected_change(searcher: Searcher, other_effects: Model, hypothesis: Hypothesis) -> Floats:
    """Posterior mean (m,) of the change of the whitened readings by an explanation, given the other members."""
    moments = searcher.evidence_calculator.gram_and_score([hypothesis.effect], other_effects)[0]
    change: Floats = (
        searcher.space.whitened_signature(hypothesis.effect)
        @ coefficient_posterior(*moments, hypothesis.plausible_sizes)[0]
    )
    return change
