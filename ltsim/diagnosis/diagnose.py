"""Steps of a diagnosis: preprocess, detect, select a model, refit, report."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.identification import identify_causes
from ltsim.adjustment.refit import Refit
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.adjustment.significance import SINGLE_LEVEL
from ltsim.adjustment.structure import raise_for_singular_network
from ltsim.calibration.evidence import log_sum_exp
from ltsim.calibration.prior_information import EarlierCalibrations
from ltsim.core.errors import RecordError
from ltsim.core.limits import MAX_DIAGNOSED_POINTINGS
from ltsim.diagnosis.assembly import assemble_diagnosis
from ltsim.diagnosis.catalogue_signatures import CatalogueSignatures
from ltsim.diagnosis.detect import detect
from ltsim.diagnosis.detectability import detectability_report
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.diagnosis.evidence import log_restricted_likelihood_ratio
from ltsim.diagnosis.findings import ExplainedRecording
from ltsim.diagnosis.findings_from_tests import instrument_finding
from ltsim.diagnosis.held_out import HeldOutErrors, cross_validated_errors
from ltsim.diagnosis.hypotheses import Model, most_probable_name, name_probabilities
from ltsim.diagnosis.instruments import (
    ConstantContradiction,
    ContradictingConstants,
    HistoryExpectation,
    find_contradictions,
)
from ltsim.diagnosis.noise import NoiseHypothesis, most_likely_sizes
from ltsim.diagnosis.preprocessing import adapted_baseline, is_consistent_when_omitted
from ltsim.diagnosis.prior import MAX_MODEL_MEMBERS
from ltsim.diagnosis.schema import Finding
from ltsim.diagnosis.selection_state import SelectionState
from ltsim.physics.effects.noise_level import NoiseLevel
from ltsim.physics.effects.signature import CandidateEffect
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.responses import VARIED_CONSTANTS, constants_of_slot
from ltsim.physics.model.construction import declared_construction
from ltsim.recordings.recording import Recording
from ltsim.recordings.result_file import SourceEntry
from ltsim.solve.threads import single_threaded

MAX_NOISE_CHANGES = 3
"""Largest number of changes of the noise that are added to a model, each alternating with a search of mean effects."""
MIN_REMAINING_OFFSET = 0.5
"""Smallest fraction of its offset that a contradicting constant must retain with the selected effects in the model to
be reported.
"""
MIN_EFFECT_LOG_EVIDENCE = 2.0
"""Smallest log evidence of an additional effect: a geometric prior on the number of effects, with prior odds of e^-2 (1
to 7) for each additional one.
"""


@raise_for_singular_network
@single_threaded
def diagnose(
    recording: Recording,
    *,
    seed: int = 0,
    level: float = 0.05,
    history: EarlierCalibrations | None = None,
    held_out: bool | None = False,
) -> Diagnosis:
    """Diagnose a recording.

    Parameters
    ----------
    recording : Recording
    seed : int
        Root seed of the simulated null distribution.
    level : float
        False-alarm rate of the whole search, `SINGLE_LEVEL` at least.
    history : EarlierCalibrations, optional
        Earlier calibrations that each constant of the instruments is compared with.
    held_out : bool, optional
        True for a search without each fold of the readings, which are then predicted: five more searches if the model
        is not empty. None: in networks with up to `null_ensemble.MAX_DENSE_UNKNOWNS` unknowns.

    Returns
    -------
    Diagnosis
        Verdict, findings in the order of their strength, fit before and after, undetectable effects.

    Raises
    ------
    RecordError
        When the history is of other instruments or another construction, or the level is none.
    """
    if not SINGLE_LEVEL <= level < 1.0:
        raise RecordError(f"the level is {level:g}; expected a false-alarm rate from {SINGLE_LEVEL:g} to 1")
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
        use = baseline.problem.used_readings
    else:
        baseline, use, mistaken = adapted_baseline(recording, construction, selection)
    case = SelectionState(baseline, use, seed, level, tests_ordinary_constants=history is None)
    detection = detect(case.searcher, case.noise_bank)
    mismatch = detection.p_value < level
    beginning, model, fitted = _search_recording(case, comparison, mismatch=mismatch)
    if selection is not None and model.members:
        restored = is_consistent_when_omitted(fitted.adjustment, np.isfinite(recording.readings) & ~use)
        if restored.any():  # the effects of the model explain them
            del case, beginning, model, fitted  # their memory is for the second search
            baseline, use, mistaken = adapted_baseline(recording, construction, selection, is_restored=restored)
            case = SelectionState(baseline, use, seed, None, tests_ordinary_constants=history is None)
            beginning, model, fitted = _search_recording(case, comparison, mismatch=mismatch)
    final_adjustment = fitted.adjustment if fitted.adjustment.solution.has_converged else baseline
    contradicting = _contradicting_constants(case, model, final_adjustment, comparison)
    constant_findings = [
        instrument_finding(c) for c in contradicting if not _varies_constant(c.parameter.name, model.effects)
    ][:MAX_MODEL_MEMBERS]
    model_fit = ExplainedRecording(
        case, detection, model, fitted, bool(mistaken or constant_findings or _has_more_than_noise_level(case.noise))
    )
    repeats_search = not case.searcher.is_large_network if held_out is None else held_out
    errors = (
        HeldOutErrors()
        if case.searcher.is_large_network and not repeats_search
        else _held_out_errors(model_fit, MIN_EFFECT_LOG_EVIDENCE, repeats_search)
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
    """True if an effect varies this constant of an instrument, which then has no single value."""
    laws = (VARIED_CONSTANTS.get(e.response.name, ()) for e in effects if isinstance(e, EmpiricalLaw))
    drifts = (constants_of_slot(getattr(e, "slot", "")) for e in effects)
    parameters = ([p.name for p in e.parameters] for e in effects)
    return any(constant in varied for varied in (*laws, *drifts, *parameters))


ConstantComparison = Callable[[Adjustment, float], ContradictingConstants]
"""Function from an adjustment and a smallest log evidence to the constants that contradict their reference."""


def _search_recording(
    case: SelectionState, comparison: ConstantComparison, *, mismatch: bool
) -> tuple[tuple[ResidualSpace, CatalogueSignatures], Model, Refit]:
    """Space and hypotheses of the initial network, the model (empty without a `mismatch`), and its refit."""
    beginning = case.space, case.searcher.catalogue_signatures
    model = _select_model(case, MIN_EFFECT_LOG_EVIDENCE, comparison) if mismatch else case.empty_model
    return beginning, *_refit_model(case, model)


def _contradicting_constants(
    case: SelectionState, model: Model, final_adjustment: Adjustment, comparison: ConstantComparison
) -> tuple[ConstantContradiction, ...]:
    """Constants that contradict their reference with nearly equal offsets with and without the model."""
    with_model = comparison(final_adjustment, MIN_EFFECT_LOG_EVIDENCE).contradictions
    if not model.members:
        return with_model
    contradictions = comparison(case.space.adjustment, MIN_EFFECT_LOG_EVIDENCE).contradictions
    size = {
        (contradiction.instruments, contradiction.parameter.name): abs(contradiction.difference)
        for contradiction in contradictions
    }
    return tuple(
        c
        for c in with_model
        if abs(c.difference) > MIN_REMAINING_OFFSET * size.get((c.instruments, c.parameter.name), np.inf)
    )


def _select_model(case: SelectionState, threshold: float, comparison: ConstantComparison) -> Model:
    """Selected model: changed constants, mean shifts and changes of the noise, until the evidence does not increase.

    The kind with the larger evidence is selected first: a law selected with a wrong noise level absorbs noise, and
    noise estimated before a law absorbs the law; the same is true for constants.
    """
    noise = case.ranked_noise(case.empty_model)[0][0]
    shifts = case.searcher.lower_bound_model(threshold, noise).score
    if noise >= shifts:
        _variance_only(case, threshold, max(shifts, case.searcher.ranking(case.empty_model).log_evidence_total))
        model = _mean_and_variance(case, threshold)
    else:
        model = case.searcher.select_model(threshold, requires_member=True)
    contradicting = comparison(case.space.adjustment, MIN_EFFECT_LOG_EVIDENCE)
    constants = contradicting.contradictions
    if constants and contradicting.joint_evidence - model.score > (len(constants) - len(model.members)) * threshold:
        case.release_priors(constants)
        model = case.searcher.select_model(threshold, requires_member=False)
    return _alternate_mean_and_variance(case, model, threshold)


def _variance_only(case: SelectionState, threshold: float, shifts: float) -> None:
    """Forward selection of changes of the noise; the first is always selected, since the global test has failed.

    The log evidence of mean `shifts` counts among the alternatives to the first one.
    """
    for further in range(MAX_NOISE_CHANGES):
        ranked = case.ranked_noise(case.empty_model)
        if further and ranked[0][0] < threshold:
            break
        case.add_noise(
            most_likely_sizes(case.space, case.space.sigma, _most_probable_noise(ranked, 0.0 if further else shifts))
        )
        case.set_adjustment(case.estimate_variance_components(()))


def _mean_and_variance(case: SelectionState, threshold: float) -> Model:
    """Model of mean shifts in addition to a change of the noise, if they increase the evidence; else the empty model.

    Noise estimated alone hides a shift: it is estimated again with the best shifts, and both together are
    compared with noise alone by their restricted likelihood.
    """
    alone, sigma, adjusted = list(case.noise), case.reading_sigmas, case.space.adjustment
    case.prune_variance_components(case.searcher.select_model(threshold, requires_member=True).effects)
    model, space = case.searcher.select_model(threshold, requires_member=False), case.space
    factor = (sigma / case.reading_sigmas)[space.used_readings] ** 2
    squares, share = (rows[: len(factor)] for rows in (space.residuals**2, space.redundancy))
    if model.members and model.score - log_restricted_likelihood_ratio(squares, share, factor).sum() > threshold:
        return model
    case.noise, case.reading_sigmas = alone, sigma
    case.set_adjustment(adjusted)
    return case.empty_model


def _alternate_mean_and_variance(case: SelectionState, model: Model, threshold: float) -> Model:
    """Alternation between variance and mean hypotheses.

    Each noise hypothesis is tried added to the model, or replacing one member or all, until the evidence stops
    increasing.
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


def _most_probable_noise(ranked: Sequence[tuple[float, NoiseHypothesis]], p_other: float) -> NoiseHypothesis:
    """Most probable change of the noise with its probability among all hypotheses.

    `p_other` is the log sum of the others.
    """
    values = np.array([value for value, _ in ranked])
    weights = np.exp(values - log_sum_exp(np.array([0.0, p_other, *values])))
    p_by_name: dict[str, float] = {}
    for (_, entry), weight in zip(ranked, weights.tolist(), strict=True):
        p_by_name[entry.effect.name] = min(p_by_name.get(entry.effect.name, 0.0) + weight, 1.0)
    name = most_probable_name(p_by_name)
    value, best = next(entry for entry in ranked if entry[1].effect.name == name)
    probability, rivals = name_probabilities(p_by_name, name)
    return replace(best, evidence=value, probability=probability, equivalents=rivals)


def _refit_model(case: SelectionState, model: Model) -> tuple[Model, Refit]:
    """Nonlinear refit of the model, without members that it no longer supports.

    The search is linear: the second-order part of a large effect can look like a further effect.
    """
    fitted = case.refit(model.effects, case.reading_sigmas)
    while len(model.members) > 1:
        rest = [case.searcher.model_without(model, i) for i in range(len(model.members))]
        without = [case.refit(reduced.effects, case.reading_sigmas) for reduced in rest]
        gains = [
            log_support(model, reduced, refitted.adjustment.chi2 - fitted.adjustment.chi2)
            for reduced, refitted in zip(rest, without, strict=True)
        ]
        least = int(np.argmin(gains))
        if gains[least] >= 0.0:
            break
        model, fitted = rest[least], without[least]
    return model, fitted


def log_support(model: Model, reduced: Model, chi2_drop: float) -> float:
    """Log evidence of a model relative to a reduced one, with the chi-square decrease of the nonlinear refits.

    The linear evidence has the Occam factors and priors; its decrease of chi-square is replaced by `chi2_drop`.
    """
    linear = float(reduced.residual @ reduced.residual - model.residual @ model.residual)
    return model.score - reduced.score + 0.5 * (chi2_drop - linear)


def _has_more_than_noise_level(noise: Sequence[NoiseHypothesis]) -> bool:
    """True if a change of the noise other than its overall level was selected."""
    return any(not isinstance(change.effect, NoiseLevel) for change in noise)


def _held_out_errors(model_fit: ExplainedRecording, threshold: float, repeats_search: bool) -> HeldOutErrors:
    """Errors of held-out readings, relative to the larger of the declared and the estimated noise.

    `after` is given if the search is `repeats_search`, or the model shifts no reading.
    """
    case, nominal = model_fit.state, model_fit.state.recording.sigma()
    space, seed = case.searcher.space, case.seed
    if (case.reading_sigmas < nominal).any():
        space = ResidualSpace.from_adjustment(case.refit((), np.maximum(case.reading_sigmas, nominal)).adjustment)
    if not model_fit.model.members:
        before = cross_validated_errors(space, seed).before
        return HeldOutErrors(before, before)
    return (
        cross_validated_errors(space, seed, case.searcher, threshold)
        if repeats_search
        else cross_validated_errors(space, seed)
    )


__all__ = ["diagnose"]
