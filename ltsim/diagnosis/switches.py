"""Switches: empirical laws that act only at some times, or only in some intervals of a covariate, with a constant size.

Given edges divide the covariate into spans. A search toggles intervals of neighbouring spans, from on to off or from
off to on, while the evidence increases. Let H be the Gram matrix of the spans, o their states (0 or 1), and d = 1 - 2 o
on the toggled interval. The Gram matrix after toggling is o'Ho + 2 o'Hd + d'Hd. Its sums over intervals are differences
of cumulative sums. Sizes of arrays below: S spans, w coefficients.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ltsim.calibration.evidence import log_sum_exp
from ltsim.core.arrays import Bools, Floats
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE
from ltsim.diagnosis.evidence import index_of_most_evidence, log_evidence_of_coefficients
from ltsim.diagnosis.evidence_calculator import EvidenceCalculator
from ltsim.diagnosis.hypotheses import EffectModel, Hypothesis
from ltsim.physics.laws.catalogue_names import equivalent_effect_name
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.regressor_library import MIN_EFFECTIVE_TARGETS_IN_REGION, wave_regressors
from ltsim.physics.laws.regressors import Regressor, scalar_regressor
from ltsim.scene.sightings import Sightings

MIN_SWITCH_EDGES_BY_REGION_DEPENDENCE = {True: 1, False: 2}
"""Smallest number of times, within set-ups, when a switched empirical law (error as a function of covariates) turns on
or off: for a law with a region of the hall (True), and for other laws (False). A single step without a region is an
effect of the catalogue, or a sum of steps."""
MIN_TARGET_SWITCH_EDGES = 3
"""Smallest number of times when a switched empirical law (error as a function of covariates) of one target turns on or
off. With one or two such times the law equals a catalogue effect, such as a target that moved."""
MAX_PIECES_OF_LAW = 10
"""Largest number of steps and ramps of an empirical law (error as a function of covariates), and of intervals of the
covariate in which a law is switched on or off."""
N_TOGGLED_INTERVALS_AFTER_MAXIMUM = 3
"""Number of further intervals of the covariate that a stepwise search switches on or off after the last increase of the
evidence, before the search stops."""

MIN_SWITCHED_MEAN_SQUARE_RATIO = 1e-3
"""Smallest mean square of a function of a covariate that is switched on and off, divided by its mean square if it is
always on. At this limit an empirical law acts on about one pointing in a thousand."""


class SpanGramAndScore(NamedTuple):
    """Gram matrix and score of an empirical law with separate coefficients in each of S spans of its covariate.

    An empirical law describes an error as a function of covariates.
    """

    gram: Floats
    """Gram matrix (S, w, S, w) of the design columns, projected onto the residual space, for w coefficients in each of
    S spans (intervals) of a covariate."""
    score: Floats
    """Products (S, w) of the design columns with the residuals, for w coefficients in each of S spans (intervals) of a
    covariate."""
    mean_square_contributions: Floats
    """Contribution (S,) of each of S spans (intervals of a covariate) to the mean square of the regressor (function of
    the covariate)."""


def n_tried_waves_of_same_covariate(law: EmpiricalLaw, sightings: Sightings) -> int:
    """Number of waves of the same covariate that a diagnosis tried, if an empirical law has a wave; otherwise 1.

    An empirical law describes an error as a function of covariates. A switch is on in some intervals of a covariate,
    and off in the others. The law with the most probable wave represents any switch. The prior of the switch is
    therefore the prior of the law multiplied by the number of waves.
    """
    swing = law.switchable_factor
    if swing is None or swing.kind != "wave":
        return 1
    return sum(wave.covariates == swing.covariates for wave in wave_regressors(sightings))


def switched_forms(
    calculator: EvidenceCalculator,
    law: EmpiricalLaw,
    log_prior: float,
    conditioning_model: EffectModel,
    *,
    refines_region: bool = True,
) -> list[Hypothesis]:
    """Copies of an empirical law that act only in some spans of its covariate; empty if the law cannot be switched.

    An empirical law describes an error as a function of covariates. `log_prior` is the log prior probability of a copy.
    The effects of `conditioning_model` are estimated in addition. If the law has a region of the hall, a local search
    fits the region before the times, unless `refines_region` is false.
    """
    sightings = calculator.residual_space.sightings
    edges = law.candidate_switch_steps(sightings)
    if len(edges) < N_TOGGLED_INTERVALS_AFTER_MAXIMUM:
        return []
    if law.depends_on_permanent_region and refines_region:
        law = calculator.refine_locally([law], conditioning_model)[0][0]
    always_on = scalar_regressor(edges[0].covariates[0], "step", -np.inf)
    spans = _span_gram_and_score(calculator, law, [always_on, *edges], conditioning_model)
    plausible_sizes = law.with_switch([always_on]).plausible_sizes
    on, value, toggled = _best_span_states(spans, plausible_sizes)
    chosen = [edges[i] for i in np.flatnonzero(np.diff(on.astype(int)))]
    starts_on = bool(on[0]) and law.depends_on_permanent_region  # otherwise on and off are equivalent
    if not _is_identifiable_switch(law, chosen, sightings):
        return []
    refined, mean = calculator.refine_locally(
        [law.with_switch([always_on, *chosen] if starts_on else chosen)], conditioning_model
    )[0]
    price = float(np.log(len(edges) * (len(edges) + 1) / 2)) * toggled
    form = Hypothesis(refined, log_prior - price, max(value, mean - price) + log_prior, equivalent_effect_name(refined))
    return [form, *_forms_with_formula_as_second_factor(calculator, form, conditioning_model)]


def _forms_with_formula_as_second_factor(
    calculator: EvidenceCalculator, form: Hypothesis, conditioning_model: EffectModel
) -> list[Hypothesis]:
    """List of an empirical law with a switch in which a formula replaces the curve in the other factor of the law.

    An empirical law describes an error as a function of covariates. The list is empty if `form`, the law, has no curve.
    The effects of `conditioning_model` are estimated in addition. A switch is on in some intervals of a covariate, and
    off in the others.
    """
    law = form.effect
    assert isinstance(law, EmpiricalLaw)
    formulas = (
        law.candidate_formulas(calculator.residual_space.sightings)
        if any(f.kind == "smooth" for f in law.regressor.factors)
        else []
    )
    if not formulas:
        return []
    best_formula = formulas[index_of_most_evidence(calculator.log_evidence(formulas, conditioning_model))]
    refined, value = calculator.refine_locally([best_formula], conditioning_model)[0]
    log_prior = form.log_prior - float(np.log(len(formulas)))
    return [Hypothesis(refined, log_prior, value + log_prior, equivalent_effect_name(refined))]


def _span_gram_and_score(
    calculator: EvidenceCalculator,
    law: EmpiricalLaw,
    step_regressors: Sequence[Regressor],
    conditioning_model: EffectModel,
) -> SpanGramAndScore:
    """Gram matrix and score of an empirical law with separate coefficients in each interval of its covariate.

    An empirical law describes an error as a function of covariates. The intervals extend from each of the steps
    `step_regressors` to the next. The effects of `conditioning_model` are estimated in addition.
    """
    sightings, count = calculator.residual_space.sightings, len(step_regressors)
    x = sightings.covariate_values[step_regressors[0].covariates[0]]
    after = x[:, None] > [step.constant for step in step_regressors]
    gram, score = calculator.grams_and_scores([law.with_sum_of_steps(step_regressors)], conditioning_model)[0]
    n_components = len(law.response.component_names)
    columns = np.repeat(np.sqrt(after.mean(axis=0)), len(score) // (n_components * count))  # steps have an rms of one
    shape = n_components, count, len(columns) // count
    scale = np.tile(columns, n_components)
    gram = (gram * np.outer(scale, scale)).reshape(*shape, *shape).transpose(1, 0, 2, 4, 3, 5)
    score = (score * scale).reshape(shape).transpose(1, 0, 2).reshape(count, -1)
    gram = gram.reshape(count, score.shape[1], count, score.shape[1])
    weight = law.columns(sightings)[:, 0] ** 2 if law.depends_on_permanent_region else np.ones(len(x))
    beyond = (weight[:, None] * after).mean(axis=0)
    gram = _span_differences(np.moveaxis(_span_differences(gram), 2, 0))
    return SpanGramAndScore(np.moveaxis(gram, 0, 2), _span_differences(score), _span_differences(beyond))


def _span_differences(step_values: Floats) -> Floats:
    """Values (S, ...) of S intervals of a covariate: value at the step that begins each, minus that at the next."""
    return step_values - np.concatenate([step_values[1:], np.zeros_like(step_values[:1])])


def _best_span_states(spans: SpanGramAndScore, plausible_sizes: Floats) -> tuple[Bools, float, int]:
    """States (S,), on or off, of S intervals of a covariate with the largest evidence, and two numbers.

    The numbers are the log evidence and the number of intervals that were switched on or off one after another. Each of
    these intervals reduces the log evidence by the log of the number of all intervals.
    """
    count, n_components = spans.score.shape
    first, last = np.triu_indices(count + 1, 1)
    price = float(np.log(len(first)))
    state = best = np.zeros(count, dtype=bool)
    value, taken, turn = -np.inf, 0, 0
    while turn < min(taken + N_TOGGLED_INTERVALS_AFTER_MAXIMUM, MAX_PIECES_OF_LAW):
        turn += 1
        sign = 1.0 - 2.0 * state
        within = sign[:, None, None, None] * spans.gram * sign[:, None]
        block = np.zeros((count + 1, n_components, count + 1, n_components))
        block[1:, :, 1:, :] = within.cumsum(axis=0).cumsum(axis=2)
        across = _cumulative_sums(np.einsum("s,swtv->twv", state, spans.gram) * sign[:, None, None])
        added = block[last, :, last] + block[first, :, first] - block[first, :, last] - block[last, :, first]
        mixed = across[last] - across[first]
        whole = np.einsum("s,swtv,t->wv", state, spans.gram, state)
        grams = whole + added + mixed + np.swapaxes(mixed, 1, 2)
        scores = _cumulative_sums(sign[:, None] * spans.score)
        squares = _cumulative_sums(sign * spans.mean_square_contributions)
        square = state @ spans.mean_square_contributions + squares[last] - squares[first]
        size = np.sqrt(np.maximum(square, MIN_SWITCHED_MEAN_SQUARE_RATIO))
        scored = (state @ spans.score + scores[last] - scores[first]) / size[:, None]
        values = log_evidence_of_coefficients(
            grams / size[:, None, None] ** 2, scored, np.broadcast_to(plausible_sizes, scored.shape)
        )
        intervals = (np.arange(count) >= first[:, None]) & (np.arange(count) < last[:, None])
        states = state ^ intervals
        values[square < MIN_SWITCHED_MEAN_SQUARE_RATIO] = -np.inf
        state = states[index_of_most_evidence(values)]
        total = float(log_sum_exp(values)) - turn * price
        if total > value + NORMAL_EQUATIONS_TOLERANCE:
            best, value, taken = state, total, turn
    return best, value, taken


def _cumulative_sums(step_values: Floats) -> Floats:
    """Cumulative sums (S + 1, ...) of S values (S, ...), the first of which is zero."""
    return np.concatenate([np.zeros_like(step_values[:1]), step_values.cumsum(axis=0)])


def _is_identifiable_switch(law: EmpiricalLaw, edge_regressors: Sequence[Regressor], sightings: Sightings) -> bool:
    """True if a switch has enough edges, at which it turns on or off, that the poses of set-ups do not absorb.

    `edge_regressors` are the steps at the edges, and `law` is the law (error as a function of covariates) with the
    switch.
    """
    least = (
        MIN_TARGET_SWITCH_EDGES
        if len(law.targets) == 1
        else MIN_SWITCH_EDGES_BY_REGION_DEPENDENCE[law.depends_on_permanent_region]
    )
    if edge_regressors and edge_regressors[0].covariates != ("time",):
        return len(edge_regressors) >= least and _switches_targets(law, edge_regressors, sightings)
    if len(law.targets) == 1:
        return len(edge_regressors) >= least
    return sum(_is_within_set_up(edge.constant, sightings) for edge in edge_regressors) >= least


def _switches_targets(law: EmpiricalLaw, edge_regressors: Sequence[Regressor], sightings: Sightings) -> bool:
    """True if a switched empirical law (function of covariates) is on for several targets and off for several targets.

    Otherwise the cause is an error of a single target. `edge_regressors` are the steps at the edges of the switch.
    """
    on = law.with_switch(edge_regressors).columns(sightings)[:, 0] != 0.0
    counts = [len(np.unique(sightings.target[acts])) for acts in (on, ~on)]
    return min(counts) > MIN_EFFECTIVE_TARGETS_IN_REGION


def _is_within_set_up(time: float, sightings: Sightings) -> bool:
    """True if any set-up has pointings before and after a time [s]; poses absorb changes between set-ups."""
    stays = (sightings.time[sightings.station == station] for station in np.unique(sightings.station))
    return any(stay.min() < time < stay.max() for stay in stays)
