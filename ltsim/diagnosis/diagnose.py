"""Steps of a diagnosis: preprocess, detect, select a model, refit, report."""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.identification import identify_causes
from ltsim.adjustment.refit import Refit
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.adjustment.significance import SINGLE_TEST_LEVEL
from ltsim.adjustment.structure import raise_for_singular_network
from ltsim.calibration.evidence import log_sum_exp
from ltsim.calibration.prior_information import EarlierCalibrationPrior
from ltsim.core.errors import RecordError
from ltsim.core.limits import MAX_DIAGNOSED_POINTINGS
from ltsim.diagnosis.assembly import assemble_diagnosis
from ltsim.diagnosis.catalogue_designs import CatalogueDesigns
from ltsim.diagnosis.detect import detect
from ltsim.diagnosis.detectability import detectability_report
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.diagnosis.evidence import N_REFINED
from ltsim.diagnosis.findings import ExplainedRecording
from ltsim.diagnosis.findings_from_tests import instrument_finding
from ltsim.diagnosis.held_out import HeldOutErrors, cross_validated_errors
from ltsim.diagnosis.hypotheses import Hypothesis, Model, most_probable_name, name_probabilities
from ltsim.diagnosis.instruments import (
    ConstantContradiction,
    ContradictingConstants,
    HistoryExpectation,
    find_contradictions,
)
from ltsim.diagnosis.noise import NoiseHypothesis, most_likely_sizes
from ltsim.diagnosis.preprocessing import adapted_baseline, identified_effects, is_consistent_when_omitted
from ltsim.diagnosis.prior import MAX_MODEL_MEMBERS
from ltsim.diagnosis.schema import Finding
from ltsim.diagnosis.selection_state import SelectionState
from ltsim.physics.effects.linear_effect import CandidateEffect
from ltsim.physics.effects.noise_level import NoiseLevel
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.responses import VARIED_CONSTANTS_BY_RESPONSE, constant_names_of_slot
from ltsim.physics.model.construction import declared_construction
from ltsim.recordings.recording import Recording
from ltsim.recordings.result_file import SourceEntry
from ltsim.solve.threads import single_threaded

MAX_NOISE_CHANGES = 3
"""Largest number of changes of the noise that are added to a model, each alternating with a selection of effects."""
MIN_REMAINING_OFFSET = 0.5
"""Smallest ratio of the difference of a constant from its reference with the selected effects in the model to that
without them. With a smaller ratio the effects explain the difference, and it is not reported."""
MIN_EFFECT_LOG_EVIDENCE = 2.0
"""Smallest log evidence of an additional effect. It represents a geometric prior on the number of effects, with prior
odds of e^-2 (1 to 7) for each additional effect."""


@raise_for_singular_network
@single_threaded
def diagnose(
    recording: Recording,
    *,
    seed: int = 0,
    level: float = 0.05,
    history: EarlierCalibrationPrior | None = None,
    held_out: bool | None = False,
) -> Diagnosis:
    """Diagnosis of a recording: its agreement with the model, and otherwise the probable causes.

    Parameters
    ----------
    recording : Recording
    seed : int
        Root of the random draws of simulated recordings.
    level : float
        False-alarm rate of the whole search, at least `SINGLE_TEST_LEVEL`.
    history : EarlierCalibrationPrior, optional
        Earlier calibrations with which each constant of the instruments is compared.
    held_out : bool, optional
        True for 5-fold cross-validation. The search is repeated without each fold of the readings, which is then
        predicted; this takes five more searches if the model is not empty. If the model predicts the folds worse than
        no effect, its effects are stated as improbable. None for cross-validation only in networks
        with up to `calibration.shrinkage.MAX_DENSE_UNKNOWNS` unknowns.

    Returns
    -------
    Diagnosis
        Verdict, findings in the order of their strength, fit before and after, undetectable effects.

    Raises
    ------
        RecordError When the history is of other instruments or of another geometric error model, or `level` is not a
        false-alarm rate.
    """
    if not SINGLE_TEST_LEVEL <= level < 1.0:
        raise RecordError(f"the level is {level:g}; expected a false-alarm rate from {SINGLE_TEST_LEVEL:g} to 1")
    recording.require_at_most(MAX_DIAGNOSED_POINTINGS, "a diagnosis")
    construction = declared_construction(recording)
    comparison = (
        find_contradictions
        if history is None
        else HistoryExpectation.from_calibrations(history, recording, construction).find_contradictions
    )
    selection = identify_causes(recording, construction)
    if selection is None:
        baseline, mistaken = adjust(recording, construction), list[Finding]()
        use = baseline.problem.is_used_reading
    else:
        baseline, use, mistaken = adapted_baseline(recording, construction, selection)
    start_effects = () if selection is None else identified_effects(selection)
    case = SelectionState(
        baseline, use, seed, level, tests_ordinary_constants=history is None, identified_effects=start_effects
    )
    detection = detect(case.searcher, case.noise_bank)
    mismatch = detection.p_value < level
    beginning, model, fitted = _search_recording(case, comparison, mismatch=mismatch)
    if selection is not None and model.members:
        restored = is_consistent_when_omitted(fitted.adjustment, np.isfinite(recording.readings) & ~use)
        if restored.any():  # the effects of the model explain them
            del case, beginning, model, fitted  # their memory is for the second search
            baseline, use, mistaken = adapted_baseline(recording, construction, selection, is_restored=restored)
            case = SelectionState(
                baseline, use, seed, None, tests_ordinary_constants=history is None, identified_effects=start_effects
            )
            beginning, model, fitted = _search_recording(case, comparison, mismatch=mismatch)
    final_adjustment = fitted.adjustment if fitted.adjustment.solution.has_converged else baseline
    contradicting = _contradicting_constants(case, model, final_adjustment, comparison)
    constant_findings = [
        instrument_finding(c) for c in contradicting if not _varies_constant(c.parameter.name, model.effects)
    ][:MAX_MODEL_MEMBERS]
    repeats_search = not case.searcher.is_large_network if held_out is None else held_out
    errors = (
        HeldOutErrors()
        if case.searcher.is_large_network and not repeats_search
        else _held_out_errors(case, model, MIN_EFFECT_LOG_EVIDENCE, repeats_search)
    )
    model_fit = ExplainedRecording(
        case,
        detection,
        model,
        fitted,
        has_test_findings=bool(mistaken or constant_findings or _has_more_than_noise_level(case.noise)),
        held_out_log_odds=errors.log_odds_of_model,
    )
    detectability = detectability_report(*beginning)
    source = SourceEntry.from_recording(recording)
    return assemble_diagnosis(
        source,
        model_fit,
        detectability,
        [*mistaken, *constant_findings],
        final_adjustment,
        errors,
        selection,
        mismatch=mismatch,
    )


def _varies_constant(constant: str, effects: Sequence[CandidateEffect]) -> bool:
    """True if one of the effects varies the constant with the name `constant`, which then has no single value."""
    laws = (VARIED_CONSTANTS_BY_RESPONSE.get(e.response.name, ()) for e in effects if isinstance(e, EmpiricalLaw))
    drifts = (constant_names_of_slot(getattr(e, "slot", "")) for e in effects)
    parameters = ([p.name for p in e.parameters] for e in effects)
    return any(constant in varied for varied in (*laws, *drifts, *parameters))


ConstantComparison = Callable[[Adjustment, float], ContradictingConstants]
"""Function that returns the constants of instruments that contradict their reference.

Its arguments are an adjustment, and the smallest log evidence of a contradiction.
"""


def _search_recording(
    case: SelectionState, comparison: ConstantComparison, *, mismatch: bool
) -> tuple[tuple[ResidualSpace, CatalogueDesigns], Model, Refit]:
    """Residual space and catalogue design matrices before the search, the selected model, and its nonlinear refit.

    The model is empty without a `mismatch`.
    """
    beginning = case.space, case.searcher.catalogue_designs
    model = _select_model(case, MIN_EFFECT_LOG_EVIDENCE, comparison) if mismatch else case.empty_model
    return beginning, *_refit_model(case, model)


def _contradicting_constants(
    case: SelectionState, model: Model, final_adjustment: Adjustment, comparison: ConstantComparison
) -> tuple[ConstantContradiction, ...]:
    """Constants that contradict their reference with the model as well as without it.

    The difference from the reference is at least `MIN_REMAINING_OFFSET` times that without the model.
    """
    with_model = comparison(final_adjustment, MIN_EFFECT_LOG_EVIDENCE).contradictions
    if not model.members:
        return with_model
    contradictions = comparison(case.space.adjustment, MIN_EFFECT_LOG_EVIDENCE).contradictions
    difference_by_constant = {
        (contradiction.instruments, contradiction.parameter.name): abs(contradiction.difference)
        for contradiction in contradictions
    }
    return tuple(
        c
        for c in with_model
        if abs(c.difference)
        > MIN_REMAINING_OFFSET * difference_by_constant.get((c.instruments, c.parameter.name), np.inf)
    )


def _select_model(case: SelectionState, threshold: float, comparison: ConstantComparison) -> Model:
    """Selected model of effects, after a selection of changes of the noise and of changed constants.

    `case` is updated with the changes of the noise and the constants. The kind of hypothesis with the largest evidence
    is selected first, and the selection ends when the evidence does not increase. The order matters, because a law that
    is selected with a wrong noise level absorbs noise, and noise that is estimated before a law absorbs the law. Noise
    is therefore estimated with the effects in the model that the simple causes of the network contain.
    """
    noise = case.ranked_noise(case.empty_model)[0][0]
    shifts = case.searcher.lower_bound_model(threshold, noise).score
    if noise >= shifts:
        identified = case.searcher.catalogue_designs.hypotheses_of(case.identified_effects[: MAX_MODEL_MEMBERS - 1])
        start = case.searcher.model_of(identified)
        rival = max(shifts - start.score, case.searcher.ranking(start).log_evidence_total)
        _select_noise(case, threshold, rival, identified)
        model = _select_effects_given_noise(case, threshold, identified)
    else:
        model = case.searcher.select_model(threshold, requires_member=True)
    contradicting = comparison(case.space.adjustment, MIN_EFFECT_LOG_EVIDENCE)
    constants = contradicting.contradictions
    if constants and contradicting.joint_evidence - model.score > (len(constants) - len(model.members)) * threshold:
        case.release_priors(constants)
        model = case.searcher.select_model(threshold, requires_member=False)
    return _alternate_noise_and_effects(case, model, threshold)


def _select_noise(
    case: SelectionState, threshold: float, log_evidence_of_effects: float, start: Sequence[Hypothesis]
) -> None:
    """Forward selection of changes of the noise, with the effects of `start` in the model, which are added to `case`.

    The first change is always selected, because the global test has failed. Effects with the log evidence
    `log_evidence_of_effects` count among its alternatives. Each further change must increase the log evidence by
    `threshold`.
    """
    effects = [hypothesis.effect for hypothesis in start]
    for further in range(MAX_NOISE_CHANGES):
        ranked = case.ranked_noise(Model.from_space(start, case.space))
        if further and ranked[0][0] < threshold:
            break
        most_probable = _most_probable_noise(ranked, 0.0 if further else log_evidence_of_effects)
        case.add_noise(most_likely_sizes(case.space.with_effects(effects), case.space.sigma, most_probable))
        case.set_adjustment(case.estimate_variance_components(effects))


def _select_effects_given_noise(case: SelectionState, threshold: float, start: Sequence[Hypothesis]) -> Model:
    """Model of effects in addition to the selected changes of the noise; the empty model if these suffice.

    The search begins with the hypotheses `start` in the model. Noise that is estimated without an effect includes it.
    The noise is therefore estimated again with each of the best hypotheses, and the best of these together with its
    noise is compared with the noise alone by their evidence.
    """
    alone, searcher = copy(case), case.searcher
    model = searcher.select_model(threshold, requires_member=True, start=start)
    leading = searcher.ranking(searcher.empty_model).best_of_each_kind()[:N_REFINED]
    candidates = [model.members, *((h,) for h in leading)]
    best = max(candidates[:1] if searcher.is_large_network else candidates, key=case.log_evidence_with)
    case.prune_variance_components([h.effect for h in best])
    model = case.searcher.select_model(threshold, requires_member=False, start=best)
    if model.members and case.log_evidence_of_noise + model.score > alone.log_evidence_of_noise + threshold:
        return model
    case.replace_by(alone)
    return case.empty_model


def _alternate_noise_and_effects(case: SelectionState, model: Model, threshold: float) -> Model:
    """Model after alternating selections of changes of the noise and of effects, while the evidence increases.

    Each change of the noise is tried in addition to `model`, in place of one effect in the model, and in place of all
    of them.
    """
    for _ in range(MAX_NOISE_CHANGES):
        searcher, members = case.searcher, model.members
        bases = [model, *(searcher.model_without(model, i) for i in range(len(members)))]
        bases += [searcher.empty_model] if len(members) > 1 else []
        ranked = [case.ranked_noise(base) for base in bases]
        least = threshold + model.discrepancy_penalty
        rest = [
            min(searcher.ranking(model).log_evidence_total, least),
            *(searcher.ranking(base).log_evidence_total for base in bases[1:]),
        ]
        lost = [0.0, *rest[1 : len(members) + 1], *(model.score - base.score for base in bases[len(members) + 1 :])]
        gains = [noise[0][0] - less for noise, less in zip(ranked, lost, strict=True)]
        most = int(np.argmax(gains))
        if gains[most] < (least if not most and (case.noise or members) else 0.0):
            break
        likeliest_noise = _most_probable_noise(ranked[most], rest[most])
        space = case.space.with_effects(bases[most].effects)
        case.add_noise(most_likely_sizes(space, case.space.sigma, likeliest_noise))
        case.set_adjustment(case.estimate_variance_components(bases[most].effects))
        model = case.searcher.select_model(threshold, requires_member=False)
    return model


def _most_probable_noise(
    ranked: Sequence[tuple[float, NoiseHypothesis]], log_evidence_of_effects: float
) -> NoiseHypothesis:
    """Most probable change of the noise, with its probability among all hypotheses.

    `ranked` are pairs of log evidence and a change of the noise. `log_evidence_of_effects` is the log of the summed
    evidence of all other hypotheses.
    """
    log_evidences = np.array([value for value, _ in ranked])
    weights = np.exp(log_evidences - log_sum_exp(np.array([0.0, log_evidence_of_effects, *log_evidences])))
    p_by_name: dict[str, float] = {}
    for (_, entry), weight in zip(ranked, weights.tolist(), strict=True):
        p_by_name[entry.effect.name] = min(p_by_name.get(entry.effect.name, 0.0) + weight, 1.0)
    name = most_probable_name(p_by_name)
    value, best = next(entry for entry in ranked if entry[1].effect.name == name)
    probability, rivals = name_probabilities(p_by_name, name)
    return replace(best, evidence=value, probability=probability, equivalents=rivals)


def _refit_model(case: SelectionState, model: Model) -> tuple[Model, Refit]:
    """Model without effects that its nonlinear refit does not support, and this refit.

    The search is linear, so that the second-order part of a large effect can look like a further effect.
    """
    fitted = case.refit(model.effects, case.reading_sigmas)
    while len(model.members) > 1:
        rest = [case.searcher.model_without(model, i) for i in range(len(model.members))]
        without = [case.refit(reduced.effects, case.reading_sigmas) for reduced in rest]
        gains = [
            log_bayes_factor_of_refits(model, reduced, refitted.adjustment.chi2 - fitted.adjustment.chi2)
            for reduced, refitted in zip(rest, without, strict=True)
        ]
        least = int(np.argmin(gains))
        if gains[least] >= 0.0:
            break
        model, fitted = rest[least], without[least]
    return model, fitted


def log_bayes_factor_of_refits(model: Model, reduced_model: Model, chi2_drop: float) -> float:
    """Log Bayes factor of a model against a model with fewer effects, from their nonlinear refits.

    It is the difference of the log evidences of the linear models, in which `chi2_drop` (the difference of chi-square
    between the nonlinear refits) replaces the difference of the linear models.
    """
    linear = float(reduced_model.residual @ reduced_model.residual - model.residual @ model.residual)
    return model.score - reduced_model.score + 0.5 * (chi2_drop - linear)


def _has_more_than_noise_level(noise: Sequence[NoiseHypothesis]) -> bool:
    """True if one of the changes of the noise is not a change of the noise level of the recording."""
    return any(not isinstance(change.effect, NoiseLevel) for change in noise)


def _held_out_errors(case: SelectionState, model: Model, threshold: float, repeats_search: bool) -> HeldOutErrors:
    """Prediction errors of held-out readings, divided by the larger of the declared and the estimated noise.

    The error with the model is known if `repeats_search`, and for an empty model, with which the errors are equal.
    """
    nominal = case.recording.sigma()
    space, seed = case.searcher.space, case.seed
    if (case.reading_sigmas < nominal).any():
        space = ResidualSpace.from_adjustment(case.refit((), np.maximum(case.reading_sigmas, nominal)).adjustment)
    if not model.members:
        before = cross_validated_errors(space, seed).before
        return HeldOutErrors(before, before)
    return (
        cross_validated_errors(space, seed, case.searcher, threshold)
        if repeats_search
        else cross_validated_errors(space, seed)
    )


__all__ = ["diagnose"]
