"""Selection of the model of a recording: effects, noise hypotheses, and changed instrument constants."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ltsim.adjustment import Adjustment
from ltsim.calibration.evidence import log_sum_exp
from ltsim.diagnosis.evidence import N_EXACTLY_EVALUATED_HYPOTHESES
from ltsim.diagnosis.hypotheses import EffectModel, Hypothesis, most_probable_name, probability_and_equivalents
from ltsim.diagnosis.instruments import ContradictingInstrumentConstants
from ltsim.diagnosis.noise_hypothesis import NoiseHypothesis
from ltsim.diagnosis.prior import MAX_MODEL_EFFECTS, MIN_EFFECT_LOG_EVIDENCE
from ltsim.diagnosis.selection_state import SelectionState

MAX_NOISE_HYPOTHESES = 3
"""Largest number of hypotheses of changed noise that are added to a model; after each of them the effects are selected
again."""
InstrumentConstantComparisonFunction = Callable[[Adjustment], ContradictingInstrumentConstants]
"""Function of an adjustment whose result are the instrument constants that contradict their reference."""


def select_noise_and_effects(
    state: SelectionState, compare_with_reference: InstrumentConstantComparisonFunction
) -> tuple[SelectionState, EffectModel]:
    """State of the model selection with the selected hypotheses of changed noise, and model of effects.

    The state also contains the changed instrument constants. The kind of hypothesis with the largest evidence is
    selected first. The selection ends when the evidence increases by less than `MIN_EFFECT_LOG_EVIDENCE`. The order
    matters: an empirical law (error as a function of covariates) that is selected with a wrong noise level absorbs
    noise, and noise that is estimated before a law absorbs the law. Noise is therefore estimated together with the
    effects among the simple causes of the network (such as moved targets). `compare_with_reference` returns the
    instrument constants that contradict their reference in an adjustment.
    """
    noise = state.ranked_noise_hypotheses(state.empty_model)[0][0]
    shifts = state.searcher.model_by_forward_steps(noise).penalised_log_evidence
    if noise >= shifts:
        identified = state.searcher.catalogue_designs.hypotheses_of_effects(
            state.effects_of_uncorrected_causes[: MAX_MODEL_EFFECTS - 1]
        )
        start_model = state.searcher.model_with(identified)
        rival = max(
            shifts - start_model.penalised_log_evidence,
            state.searcher.ranking(start_model).total_log_evidence,
        )
        state, model = _select_effects_given_noise(_select_noise_hypotheses(state, rival, identified), identified)
    else:
        model = state.searcher.select_effects(requires_effect=True)
    contradicting_constants = compare_with_reference(state.residual_space.adjustment)
    constants = contradicting_constants.contradictions
    if (
        constants
        and contradicting_constants.log_evidence_of_all_contradictions - model.penalised_log_evidence
        > (len(constants) - len(model.hypotheses)) * MIN_EFFECT_LOG_EVIDENCE
    ):
        state = state.with_widened_priors(constants)
        model = state.searcher.select_effects(requires_effect=False)
    return _alternate_noise_and_effects(state, model)


def _select_noise_hypotheses(
    state: SelectionState,
    log_evidence_of_effects: float,
    start_hypotheses: Sequence[Hypothesis],
) -> SelectionState:
    """State of the model selection after a forward selection of hypotheses of changed noise.

    The noise is estimated with the effects of `start_hypotheses` in the model. The first noise hypothesis is always
    selected, because the global test has failed. Its alternatives include the effects, with the log evidence
    `log_evidence_of_effects`. Each further noise hypothesis must increase the log evidence by
    `MIN_EFFECT_LOG_EVIDENCE`.
    """
    effects = [hypothesis.effect for hypothesis in start_hypotheses]
    for further in range(MAX_NOISE_HYPOTHESES):
        ranked = state.ranked_noise_hypotheses(EffectModel.from_residual_space(start_hypotheses, state.residual_space))
        if further and ranked[0][0] < MIN_EFFECT_LOG_EVIDENCE:
            break
        most_probable = _most_probable_noise_hypothesis(ranked, 0.0 if further else log_evidence_of_effects)
        state = state.with_noise_hypothesis(most_probable, effects)
    return state


def _select_effects_given_noise(
    state: SelectionState, start_hypotheses: Sequence[Hypothesis]
) -> tuple[SelectionState, EffectModel]:
    """State of the model selection, and model, after effects are selected in addition to changed noise levels.

    If the changed noise levels suffice, the state is unchanged and the model has no effects. The search begins with the
    hypotheses `start_hypotheses` in the model. Noise that is estimated without an effect includes this effect. The
    noise is therefore estimated again with each of the hypotheses with the largest evidence. The most probable of them,
    with its noise, is compared with the noise alone by their evidence.
    """
    searcher = state.searcher
    model = searcher.select_effects(requires_effect=True, start_hypotheses=start_hypotheses)
    leading = searcher.ranking(searcher.empty_model).most_probable_of_each_kind()[:N_EXACTLY_EVALUATED_HYPOTHESES]
    candidates = [model.hypotheses, *((h,) for h in leading)]
    best = max(candidates[:1] if searcher.is_large_network else candidates, key=state.log_evidence_with_effects)
    with_effects = state.with_pruned_noise([h.effect for h in best])
    model = with_effects.searcher.select_effects(requires_effect=False, start_hypotheses=best)
    is_supported = (
        with_effects.log_evidence_of_noise + model.penalised_log_evidence
        > state.log_evidence_of_noise + MIN_EFFECT_LOG_EVIDENCE
    )
    return (with_effects, model) if model.hypotheses and is_supported else (state, state.empty_model)


def _alternate_noise_and_effects(state: SelectionState, model: EffectModel) -> tuple[SelectionState, EffectModel]:
    """State of the model selection, and model, after alternating selections of changed noise and of effects.

    Both selections alternate while the evidence increases. Each noise hypothesis is tried in addition to `model`, in
    place of one of the effects in the model, and in place of all effects.
    """
    for _ in range(MAX_NOISE_HYPOTHESES):
        searcher, hypotheses = state.searcher, model.hypotheses
        bases = [model, *(searcher.model_without(model, i) for i in range(len(hypotheses)))]
        bases += [searcher.empty_model] if len(hypotheses) > 1 else []
        ranked = [state.ranked_noise_hypotheses(base) for base in bases]
        least = MIN_EFFECT_LOG_EVIDENCE + model.discrepancy_penalty
        rest = [
            min(searcher.ranking(model).total_log_evidence, least),
            *(searcher.ranking(base).total_log_evidence for base in bases[1:]),
        ]
        lost = [
            0.0,
            *rest[1 : len(hypotheses) + 1],
            *(model.penalised_log_evidence - base.penalised_log_evidence for base in bases[len(hypotheses) + 1 :]),
        ]
        gains = [noise[0][0] - less for noise, less in zip(ranked, lost, strict=True)]
        most = int(np.argmax(gains))
        if gains[most] < (least if not most and (state.selected_noise_hypotheses or hypotheses) else 0.0):
            break
        likeliest_noise = _most_probable_noise_hypothesis(ranked[most], rest[most])
        state = state.with_noise_hypothesis(likeliest_noise, bases[most].effects)
        model = state.searcher.select_effects(requires_effect=False)
    return state, model


def _most_probable_noise_hypothesis(
    ranked_noise_hypotheses: Sequence[tuple[float, NoiseHypothesis]], log_evidence_of_effects: float
) -> NoiseHypothesis:
    """Most probable hypothesis of changed noise, with its probability among all hypotheses.

    `ranked_noise_hypotheses` are pairs of a log evidence and a noise hypothesis. `log_evidence_of_effects` is the log
    of the summed evidence of all other hypotheses.
    """
    log_evidences = np.array([value for value, _ in ranked_noise_hypotheses])
    weights = np.exp(log_evidences - log_sum_exp(np.array([0.0, log_evidence_of_effects, *log_evidences])))
    p_by_name: dict[str, float] = {}
    for (_, entry), weight in zip(ranked_noise_hypotheses, weights.tolist(), strict=True):
        p_by_name[entry.effect.name] = min(p_by_name.get(entry.effect.name, 0.0) + weight, 1.0)
    name = most_probable_name(p_by_name)
    value, best = next(entry for entry in ranked_noise_hypotheses if entry[1].effect.name == name)
    probability, rivals = probability_and_equivalents(p_by_name, name)
    return replace(best, log_evidence=value, probability=probability, equivalents=rivals)
