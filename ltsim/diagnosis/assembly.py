"""Assembly of the result of a diagnosis from findings of the selected model, of tests, and on changed noise levels."""

from collections.abc import Sequence

import numpy as np

from ltsim.adjustment import Adjustment
from ltsim.adjustment.identification import CauseSelection, cause_tests
from ltsim.adjustment.refit import Refit
from ltsim.adjustment.significance import MIN_SIGNIFICANT_SIGMAS
from ltsim.core.arrays import Floats
from ltsim.core.notation import number_text, with_sigma
from ltsim.diagnosis.averaging import average_over_explanations
from ltsim.diagnosis.cross_validation import HeldOutErrors
from ltsim.diagnosis.detectability import DetectabilityReport
from ltsim.diagnosis.diagnosis import AveragedTargets, Diagnosis, DiagnosisArrays
from ltsim.diagnosis.findings import SelectedModelFit
from ltsim.diagnosis.global_test import GlobalTestResult
from ltsim.diagnosis.instruments import instrument_entries
from ltsim.diagnosis.noise_hypothesis import NoiseHypothesis
from ltsim.diagnosis.schema import (
    DetectableEntry,
    Finding,
    FindingEvidence,
    GlobalTest,
    Misfit,
    MisfitBeforeAfter,
    ParameterEstimate,
)
from ltsim.diagnosis.scopes import effect_scope
from ltsim.diagnosis.sentences import (
    MIN_PROBABILITY_OF_PROBABLE_CAUSE,
    catalogue_effect_sentence,
    diagnosis_summary,
    unknown_noise_sentence,
)
from ltsim.physics.laws.text_form import covariate_value_text, region_text
from ltsim.physics.laws.variance import CentringVariance, VarianceFunction
from ltsim.recordings.recording import OBSERVABLES
from ltsim.recordings.result_file import ResultSource
from ltsim.recordings.specification import noise_origin
from ltsim.scene.sightings import Sightings

MAX_REPORTED_NOISE_SIZES = 12
"""Largest number of targets, set-ups or readings whose changed noise level a finding reports separately."""


def assemble_diagnosis(
    recording_entry: ResultSource,
    model_fit: SelectedModelFit,
    detectability: DetectabilityReport,
    test_findings: Sequence[Finding],
    final_adjustment: Adjustment,
    held_out_errors: HeldOutErrors,
    cause_selection: CauseSelection | None,
    *,
    is_mismatch: bool,
) -> Diagnosis:
    """Diagnosis from the selected model after its nonlinear refit, and from the findings of tests.

    `recording_entry` identifies the recording, and `detectability` has the smallest detectable sizes of effects.
    `test_findings` are findings that need no search, such as blunders. `final_adjustment` is the adjustment with the
    selected model, or without this model if the adjustment with it did not converge. `held_out_errors` are prediction
    errors of held-out readings. `cause_selection` has the simple causes that the adjustment identified before the
    search for effects, None without them. `is_mismatch` is True if the global test rejects the agreement of readings
    and model.
    """
    state, model, global_test = model_fit.selection_state, model_fit.model, model_fit.global_test
    baseline, adjusted = state.baseline_adjustment, model_fit.refit.adjustment
    shift_findings = [
        model_fit.finding_of_effect(i)
        for i, hypothesis in enumerate(model.hypotheses)
        if hypothesis.effect_key not in model_fit.unreported_effect_keys
    ]
    has_clock = state.recording.has_clock
    noise_findings = [
        _noise_finding(change, baseline.sightings, global_test, has_clock=has_clock)
        for change in state.selected_noise_hypotheses
    ]
    findings = _reported_findings(test_findings, shift_findings, noise_findings)
    before = after = Misfit(chi2=baseline.chi2, dof=baseline.dof, held_out_rms=held_out_errors.rms_without_model)
    if model.hypotheses or state.selected_noise_hypotheses:
        dof = baseline.dof - model.projected_basis.shape[1]
        after = Misfit(chi2=adjusted.chi2, dof=dof, held_out_rms=held_out_errors.rms_with_model)
    verdict = "mismatch" if is_mismatch or test_findings else "consistent"
    detectable, undetectable = detectability
    return Diagnosis.from_arrays(
        DiagnosisArrays(
            *_averaged_targets_and_reading_change(model_fit, shift_findings, noise_findings),
            state.expected_variance_factors(model.effects),
            baseline,
            adjusted,
        ),
        recording=recording_entry,
        verdict=verdict,
        summary=diagnosis_summary(
            verdict,
            findings,
            global_test.p_value,
            before,
            after,
            noise_origin=noise_origin(state.recording.notes),
            n_withheld=len(model_fit.unreported_effect_keys),
            is_contradicted=held_out_errors.log_odds_of_model < 0.0,
        ),
        global_test=GlobalTest(
            statistic=baseline.chi2,
            dof=baseline.dof,
            p_value=global_test.chi2_p_value,
            search_p_value=global_test.p_value,
        ),
        findings=tuple(findings),
        fit=MisfitBeforeAfter(before=before, after=after),
        undetectable=undetectable,
        detectable=tuple(map(DetectableEntry.from_minimal_size, detectable)),
        instruments=instrument_entries(final_adjustment),
        tests=() if cause_selection is None else cause_tests(cause_selection),
    )


def _reported_findings(
    test_findings: Sequence[Finding], shift_findings: Sequence[Finding], noise_findings: Sequence[Finding]
) -> list[Finding]:
    """Findings of a diagnosis: probable errors of readings, then all others, each by decreasing drop of chi-square.

    They are findings of tests (such as blunders), of effects that shift readings, and on changed noise levels.
    Improbable findings on the noise are reported only if there is no other finding. As in `select_causes`, errors of
    readings come before the noise, because noise may be the remainder of an error.
    """
    probable_noise = [
        finding for finding in noise_findings if finding.evidence.p_real >= MIN_PROBABILITY_OF_PROBABLE_CAUSE
    ]
    errors = [*test_findings, *shift_findings]
    probable_errors = [f for f in errors if f.evidence.p_real >= MIN_PROBABILITY_OF_PROBABLE_CAUSE]
    others = [finding for finding in errors if finding not in probable_errors]
    groups = probable_errors, [*others, *probable_noise] if errors or probable_noise else noise_findings
    return [f for group in groups for f in sorted(group, key=lambda finding: -finding.evidence.chi2_drop)]


def _averaged_targets_and_reading_change(
    model_fit: SelectedModelFit, shift_findings: Sequence[Finding], noise_findings: Sequence[Finding]
) -> tuple[AveragedTargets, Floats]:
    """Target coordinates and changes (n, 3) of the readings of n pointings, averaged over the possible causes.

    The change of the readings by the nonlinear refit is subtracted from the averaged change. `shift_findings` are
    findings of effects that shift readings, `noise_findings` those on the noise. If no cause is more probable than not,
    the coordinates are those of the ordinary adjustment. The unit of the change is [m, rad, rad].
    """
    state = model_fit.selection_state
    targets, change = average_over_explanations(
        state.searcher, model_fit.model, model_fit.rankings_of_alternatives, model_fit.refit
    )
    if not any(
        finding.evidence.p_real >= MIN_PROBABILITY_OF_PROBABLE_CAUSE for finding in (*shift_findings, *noise_findings)
    ):
        targets, _ = average_over_explanations(
            state.searcher, state.empty_model, (), Refit(state.baseline_adjustment, (), ())
        )
    return targets, change


def _noise_finding(
    hypothesis: NoiseHypothesis, sightings: Sightings, global_test: GlobalTestResult, *, has_clock: bool = True
) -> Finding:
    """Finding on a selected hypothesis of changed noise, limited to observables whose noise differs significantly.

    `global_test` has the p-value of the finding. `has_clock` is True if the recording has times, so that intervals of
    time are texts of times and not of rows.
    """
    effect = hypothesis.effect
    scope = effect_scope(effect, _observables_with_changed_noise(hypothesis, sightings))
    size_estimates = zip(effect.parameters, hypothesis.sizes, hypothesis.size_sigmas, strict=True)
    estimates = [ParameterEstimate.from_si(*estimate) for estimate in size_estimates if np.isfinite(estimate[2])]
    sentence, further_values = "", dict[str, object]()
    if isinstance(effect, VarianceFunction):
        further_values = {"formula": effect.text, "carrier": effect.response_text, "driver": effect.regressor_text}
        most = ""
        if effect.group_kind:
            estimates = sorted(estimates, key=lambda e: -e.value)[:MAX_REPORTED_NOISE_SIZES]
            sure = [e for e in estimates if e.value > MIN_SIGNIFICANT_SIGMAS * e.sigma] or estimates
            worst = {e.name.partition(" at ")[2]: number_text(np.sqrt(1.0 + e.value), 2) for e in reversed(sure)}
            names = [f"{name} ({times})" for name, times in reversed(worst.items())][:2]
            most = f", most at {' and '.join(names)}, as a factor on the declared standard deviation"
        if effect.covariate_band:
            ends = [covariate_value_text(effect.covariates[0], x, has_clock=has_clock) for x in effect.covariate_band]
            most = f", from {', '.join(f'{low} to {high}' for low, high in zip(ends[::2], ends[1::2], strict=True))}"
        if effect.region is not None:
            most += f", {region_text(effect.region)}"
            estimates += [
                ParameterEstimate(name=f"centre-{axis}", value=value, sigma=effect.region.width, unit="m")
                for axis, value in zip(effect.region.bounded_axes, effect.region.centre, strict=True)
            ]
        sentence = unknown_noise_sentence(scope, effect.text + most)
        if isinstance(effect, CentringVariance):
            sentence = effect.sentence(with_sigma(estimates[0].value, estimates[0].sigma, estimates[0].unit))
    return Finding(
        effect=effect.name,
        known=not isinstance(effect, VarianceFunction),
        where=scope,
        parameters=tuple(estimates),
        evidence=FindingEvidence(
            chi2_drop=hypothesis.chi2_drop,
            parameters=len(estimates),
            p_value=global_test.p_value_of(hypothesis.log_evidence),
            probability=hypothesis.probability,
        ),
        sentence=sentence or catalogue_effect_sentence(effect.name, scope, estimates, hypothesis.probability),
        equivalents=hypothesis.equivalents,
    ).with_values(**{name: value for name, value in further_values.items() if value})


def _observables_with_changed_noise(hypothesis: NoiseHypothesis, sightings: Sightings) -> tuple[str, ...]:
    """Names of the observables whose noise is significantly larger than declared.

    If the largest change of the noise is a decrease, the observables with significantly smaller noise are returned.
    """
    plausible_sizes = hypothesis.effect.plausible_sizes
    sizes_in_units = np.array(hypothesis.sizes) / plausible_sizes
    signed_sizes = (
        sizes_in_units * np.sign(sizes_in_units[np.argmax(np.abs(sizes_in_units))])
        > MIN_SIGNIFICANT_SIGMAS * np.array(hypothesis.size_sigmas) / plausible_sizes
    )
    unit_variance = np.ones((len(sightings), len(OBSERVABLES)))
    is_changed = (
        hypothesis.effect.variance(sightings, unit_variance, np.where(signed_sizes, plausible_sizes, 0.0))
        != unit_variance
    ).any(axis=0)
    return tuple(name for name, act in zip(OBSERVABLES, is_changed, strict=True) if act)
