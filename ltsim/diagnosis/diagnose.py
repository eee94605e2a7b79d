"""Steps of a diagnosis: preprocessing, global test, selection of a model, refit, report.

Decisions in their order, each with its function, its module and its criterion:

1. Simple causes of the network (`identify_causes`, `adjustment.identification.selection`): evidence of nonlinear
   adjustments with and without each cause.
2. Blunders among these causes are corrected or rejected (`preprocessing.adjustment_without_blunders`).
3. Global test (`global_test.run_global_test`): evidence of all hypotheses together, against that of simulated
   recordings. The search goes on if its p-value is below the level.
4. Noise hypotheses or effects first (`model_selection.select_noise_and_effects`): those with more log evidence.
5. Effects (`search.Searcher.select_effects`): forward, backward and exchange steps. A further effect increases the log
   evidence by `MIN_EFFECT_LOG_EVIDENCE` or more.
6. Instrument constants that contradict their reference (`instruments`), instead of effects: the larger joint log
   evidence.
7. Noise hypotheses (`SelectionState.with_noise_hypothesis`) and effects in turns, while the log evidence increases.
8. Effects that the nonlinear refit does not support are removed (`_refit_and_prune`): log Bayes factor below zero.
9. Rejected readings that the model explains are used again, and steps 4 to 8 are repeated with them.
10. Declared points that define the axes are tested with the model (`preprocessing.axes_point_findings`).
11. Effects of the model with too small a probability are not reported
    (`findings.SelectedModelFit.unreported_effect_keys`); `assembly.assemble_diagnosis` makes the result.

The modules `hypotheses` (hypothesis, model, ranking) and `selection_state` (adjustment, noise and search of one step)
contain the objects that all steps exchange.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.identification import CauseSelection, identify_causes
from ltsim.adjustment.refit import Refit
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.adjustment.structure import raise_for_singular_network
from ltsim.calibration.prior_information import EarlierCalibrationPrior
from ltsim.core.arrays import Bools
from ltsim.core.limits import MAX_DIAGNOSED_POINTINGS, MAX_DIAGNOSED_TARGETS
from ltsim.core.parallel import single_threaded
from ltsim.diagnosis.assembly import assemble_diagnosis
from ltsim.diagnosis.cross_validation import HeldOutErrors, cross_validated_errors
from ltsim.diagnosis.detectability import detectability_report
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.diagnosis.findings import SelectedModelFit
from ltsim.diagnosis.findings_from_tests import contradicting_instrument_constant_finding
from ltsim.diagnosis.global_test import run_global_test
from ltsim.diagnosis.hypotheses import EffectModel
from ltsim.diagnosis.instruments import (
    ExpectationFromEarlierCalibrations,
    InstrumentConstantContradiction,
    find_contradicting_instrument_constants,
)
from ltsim.diagnosis.model_selection import InstrumentConstantComparisonFunction, select_noise_and_effects
from ltsim.diagnosis.noise_hypothesis import NoiseHypothesis
from ltsim.diagnosis.preprocessing import (
    adjustment_without_blunders,
    axes_point_findings,
    effects_of_uncorrected_causes,
    revised_error_mask,
)
from ltsim.diagnosis.prior import MAX_MODEL_EFFECTS
from ltsim.diagnosis.schema import Finding
from ltsim.diagnosis.selection_state import SelectionState
from ltsim.physics.effects.linear_effect import CandidateEffect
from ltsim.physics.effects.noise_level import NoiseLevel
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.responses import INSTRUMENT_CONSTANTS_BY_RESPONSE, instrument_constants_of_chain_error
from ltsim.physics.model.construction import GeometricErrorModel, declared_construction
from ltsim.recordings.recording import Recording
from ltsim.recordings.result_file import ResultSource

MIN_UNEXPLAINED_INSTRUMENT_CONSTANT_DIFFERENCE_RATIO = 0.5
"""Limit of the difference of an instrument constant from its reference with the selected effects in the model, divided
by the difference without them. Only a larger ratio is reported: below the limit the effects explain the difference."""


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
    """Diagnosis of a recording: agreement with the model, or otherwise the probable causes of the misfit.

    Parameters
    ----------
    recording : Recording
    seed : int
        Seed of the random draws of simulated recordings.
    level : float
        False-alarm rate of the whole search, at least `SINGLE_TEST_LEVEL`.
    history : EarlierCalibrationPrior, optional
        Earlier calibrations with which each constant of the instruments is compared.
    held_out : bool, optional
        True for 5-fold cross-validation: the search is repeated without each fold of the readings, and the selected
        model predicts the fold. This takes five more searches if the model is not empty. If the model predicts the
        folds worse than no effect, its effects are reported as improbable. None, which `lt.diagnose` and the command
        line pass by default, for cross-validation only in networks with up to
        `calibration.shrinkage.MAX_DENSE_UNKNOWNS` unknowns.

    Returns
    -------
    Diagnosis
        Verdict, findings (errors of readings before changed noise), misfit without and with the findings, and
        undetectable effects.

    Raises
    ------
    RecordError
        When the history is of other instruments or of another geometric error model.
    """
    recording.require_at_most(MAX_DIAGNOSED_POINTINGS, MAX_DIAGNOSED_TARGETS, "a diagnosis")
    construction = declared_construction(recording)
    compare_with_reference = (
        find_contradicting_instrument_constants
        if history is None
        else ExpectationFromEarlierCalibrations.from_calibrations(
            history, recording, construction
        ).find_contradicting_instrument_constants
    )
    selection = identify_causes(recording, construction)
    start_state = partial(
        _state_without_blunders, recording, construction, selection, seed=seed, tests_ordinary_constants=history is None
    )
    state, blunder_findings = start_state(level=level)
    global_test = run_global_test(state.searcher, state.noise_hypotheses)
    is_mismatch = global_test.p_value < level
    initial_space, initial_designs = state.residual_space, state.searcher.catalogue_designs
    state, model, refit = _search_and_refit(state, compare_with_reference, is_mismatch=is_mismatch)
    if selection is not None:
        error_mask = np.isfinite(recording.readings) & ~state.is_used_reading
        revised_mask = revised_error_mask(selection.fit, refit.adjustment, error_mask)
        if not np.array_equal(revised_mask, error_mask):  # with the effects of the model, other readings are wrong
            del state, initial_space, initial_designs, model, refit  # their memory is for the second search
            state, blunder_findings = start_state(level=None, error_mask=revised_mask)
            initial_space, initial_designs = state.residual_space, state.searcher.catalogue_designs
            state, model, refit = _search_and_refit(state, compare_with_reference, is_mismatch=is_mismatch)
    final_adjustment = refit.adjustment if refit.adjustment.solution.has_converged else state.baseline_adjustment
    blunder_findings += axes_point_findings(final_adjustment, recording)
    contradictions = _contradicting_constants_unexplained_by_model(
        state, model, final_adjustment, compare_with_reference
    )
    constant_findings = [
        contradicting_instrument_constant_finding(c)
        for c in contradictions
        if not _has_effect_varying_constant(c.parameter.name, model.effects)
    ][:MAX_MODEL_EFFECTS]
    repeats_search = not state.searcher.is_large_network if held_out is None else held_out
    errors = (
        HeldOutErrors()
        if state.searcher.is_large_network and not repeats_search
        else _held_out_errors(state, model, repeats_search=repeats_search)
    )
    model_fit = SelectedModelFit(
        state,
        global_test,
        model,
        refit,
        has_test_findings=bool(
            blunder_findings or constant_findings or _has_specific_noise_hypothesis(state.selected_noise_hypotheses)
        ),
        held_out_log_odds=errors.log_odds_of_model,
    )
    detectability = detectability_report(initial_space, initial_designs)
    recording_entry = ResultSource.from_recording(recording)
    return assemble_diagnosis(
        recording_entry,
        model_fit,
        detectability,
        [*blunder_findings, *constant_findings],
        final_adjustment,
        errors,
        selection,
        is_mismatch=is_mismatch,
    )


def _state_without_blunders(
    recording: Recording,
    construction: GeometricErrorModel,
    selection: CauseSelection | None,
    *,
    seed: int,
    tests_ordinary_constants: bool,
    level: float | None,
    error_mask: Bools | None = None,
) -> tuple[SelectionState, list[Finding]]:
    """State of the model selection before the search for effects, without blunders, and findings on the blunders.

    `construction` is the geometric error model of the instruments, and `seed` the seed of simulated recordings.
    `selection` contains the simple causes of the network, blunders among them. With a `level` (false-alarm rate) the
    search has a p-value. With `tests_ordinary_constants` the search also tests changes of the instrument constants of
    the ordinary calibration. `error_mask` (n, 3) flags the readings of n pointings that are not used, by default
    the single errors.
    """
    if selection is None:
        baseline, blunder_findings = adjust(recording, construction), list[Finding]()
        use = baseline.problem.is_used_reading
    else:
        baseline, use, blunder_findings = adjustment_without_blunders(
            recording, construction, selection, error_mask=error_mask
        )
    state = SelectionState.from_adjustment(
        baseline,
        use,
        seed,
        level,
        tests_ordinary_constants=tests_ordinary_constants,
        effects_of_uncorrected_causes=() if selection is None else effects_of_uncorrected_causes(selection),
    )
    return state, blunder_findings


def _has_effect_varying_constant(constant_name: str, effects: Sequence[CandidateEffect]) -> bool:
    """True if one of `effects` lets the instrument constant named `constant_name` vary during the recording."""
    laws = (INSTRUMENT_CONSTANTS_BY_RESPONSE.get(e.response.name, ()) for e in effects if isinstance(e, EmpiricalLaw))
    drifts = (instrument_constants_of_chain_error(getattr(e, "chain_error_key", "")) for e in effects)
    parameters = ([p.name for p in e.parameters] for e in effects)
    return any(constant_name in varied for varied in (*laws, *drifts, *parameters))


def _search_and_refit(
    state: SelectionState, compare_with_reference: InstrumentConstantComparisonFunction, *, is_mismatch: bool
) -> tuple[SelectionState, EffectModel, Refit]:
    """State of the model selection after the search for effects, selected model, and nonlinear refit of this model.

    If `is_mismatch` is False, readings and ordinary model agree: no search is needed, and the model has no effects.
    `compare_with_reference` returns the instrument constants that contradict their reference in an adjustment.
    """
    state, model = (
        select_noise_and_effects(state, compare_with_reference) if is_mismatch else (state, state.empty_model)
    )
    return state, *_refit_and_prune(state, model)


def _contradicting_constants_unexplained_by_model(
    state: SelectionState,
    model: EffectModel,
    final_adjustment: Adjustment,
    compare_with_reference: InstrumentConstantComparisonFunction,
) -> tuple[InstrumentConstantContradiction, ...]:
    """Instrument constants that contradict their reference with the selected effects in the model, and without them.

    Their difference from the reference with the effects is at least
    `MIN_UNEXPLAINED_INSTRUMENT_CONSTANT_DIFFERENCE_RATIO` times the difference without the effects.
    `compare_with_reference` returns the contradictions in an adjustment.
    """
    with_model = compare_with_reference(final_adjustment).contradictions
    if not model.hypotheses:
        return with_model
    contradictions = compare_with_reference(state.residual_space.adjustment).contradictions
    difference_by_constant = {
        (contradiction.instruments, contradiction.parameter.name): abs(contradiction.difference_from_reference)
        for contradiction in contradictions
    }
    return tuple(
        c
        for c in with_model
        if abs(c.difference_from_reference)
        > MIN_UNEXPLAINED_INSTRUMENT_CONSTANT_DIFFERENCE_RATIO
        * difference_by_constant.get((c.instruments, c.parameter.name), np.inf)
    )


def _refit_and_prune(state: SelectionState, model: EffectModel) -> tuple[EffectModel, Refit]:
    """Model without the effects that its nonlinear refit does not support, and the refit of this model.

    The search for effects is linear. The second-order part of a large effect can therefore look like a further effect.
    """
    refit = state.refit(model.effects, state.reading_sigmas)
    while len(model.hypotheses) > 1:
        rest = [state.searcher.model_without(model, i) for i in range(len(model.hypotheses))]
        refits_without_effect = [state.refit(reduced.effects, state.reading_sigmas) for reduced in rest]
        gains = [
            log_bayes_factor_of_refits(model, reduced, refitted.adjustment.chi2 - refit.adjustment.chi2)
            for reduced, refitted in zip(rest, refits_without_effect, strict=True)
        ]
        least = int(np.argmin(gains))
        if gains[least] >= 0.0:
            break
        model, refit = rest[least], refits_without_effect[least]
    return model, refit


def log_bayes_factor_of_refits(model: EffectModel, reduced_model: EffectModel, chi2_drop: float) -> float:
    """Log Bayes factor of a model against a model with fewer effects, from their nonlinear refits.

    It is the difference of the log evidences of the linear models. The decrease of chi-square between the nonlinear
    refits, `chi2_drop`, replaces that between the linear models.
    """
    linear = float(reduced_model.residual @ reduced_model.residual - model.residual @ model.residual)
    return model.penalised_log_evidence - reduced_model.penalised_log_evidence + 0.5 * (chi2_drop - linear)


def _has_specific_noise_hypothesis(selected_noise_hypotheses: Sequence[NoiseHypothesis]) -> bool:
    """True if any selected noise hypothesis is more specific than a noise level of the whole recording."""
    return any(not isinstance(change.effect, NoiseLevel) for change in selected_noise_hypotheses)


def _held_out_errors(state: SelectionState, model: EffectModel, *, repeats_search: bool) -> HeldOutErrors:
    """Prediction errors of held-out readings, divided by the larger of the declared and the estimated noise.

    The error with a model is computed only if `repeats_search`, by a search for effects without each fold. If `model`
    has no effects, both errors are equal.
    """
    nominal = state.recording.reading_sigmas()
    space, seed = state.searcher.residual_space, state.seed
    if (state.reading_sigmas < nominal).any():
        space = ResidualSpace.from_adjustment(state.refit((), np.maximum(state.reading_sigmas, nominal)).adjustment)
    if not model.hypotheses:
        before = cross_validated_errors(space, seed).rms_without_model
        return HeldOutErrors(before, before)
    return (
        cross_validated_errors(space, seed, state.searcher) if repeats_search else cross_validated_errors(space, seed)
    )


__all__ = ["diagnose"]
