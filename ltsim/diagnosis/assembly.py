"""Assembly of the result of a diagnosis from the selected model and the findings of tests."""

from collections.abc import Sequence

from ltsim.adjustment import Adjustment
from ltsim.adjustment.identification import CauseSelection, cause_tests
from ltsim.adjustment.refit import Refit
from ltsim.core.arrays import Floats
from ltsim.diagnosis.averaging import average_over_explanations
from ltsim.diagnosis.detectability import DetectabilityReport
from ltsim.diagnosis.diagnosis import AveragedTargets, Diagnosis, DiagnosisArrays
from ltsim.diagnosis.findings import ExplainedRecording, noise_finding
from ltsim.diagnosis.held_out import HeldOutErrors
from ltsim.diagnosis.instruments import instrument_entries
from ltsim.diagnosis.schema import BeforeAfter, DetectableEntry, Finding, GlobalTest, Misfit
from ltsim.diagnosis.words import MIN_PROBABLE, diagnosis_summary
from ltsim.physics.effects.noise_level import NoiseLevel
from ltsim.recordings.result_file import SourceEntry


def assemble_diagnosis(
    source: SourceEntry,
    model_fit: ExplainedRecording,
    detectability: DetectabilityReport,
    certain_findings: Sequence[Finding],
    final_adjustment: Adjustment,
    errors: HeldOutErrors,
    selection: CauseSelection | None,
    *,
    mismatch: bool,
) -> Diagnosis:
    """Diagnosis from the selected model after its refit, and from the findings of tests.

    `certain_findings` are those of tests, which need no search. `final_adjustment` is the adjustment with the model, or
    without it if that did not converge. `errors` are prediction errors of held-out readings, and `selection` contains
    the simple causes of the adjustment before the search.
    """
    case, model, detection = model_fit.state, model_fit.model, model_fit.detection
    baseline, adjusted = case.baseline, model_fit.refit.adjustment
    shifts = [
        model_fit.finding(i) for i, finding in enumerate(model.members) if finding.key not in model_fit.withheld_keys
    ]
    has_clock = case.recording.has_clock
    noises = [noise_finding(finding, baseline.sightings, detection, has_clock=has_clock) for finding in case.noise]
    certain = [finding for finding in (*shifts, *noises) if finding.evidence.p_real >= MIN_PROBABLE]
    is_noise_only = not certain_findings and all(finding.effect == NoiseLevel.name for finding in certain)
    likely_findings = (
        (certain + [finding for finding in shifts if finding not in certain] or noises) if is_noise_only else certain
    )
    findings = sorted([*certain_findings, *likely_findings], key=lambda finding: -finding.evidence.chi2_drop)
    before = after = Misfit(chi2=baseline.chi2, dof=baseline.dof, held_out_rms=errors.before)
    if model.members or case.noise:
        dof = baseline.dof - model.basis.shape[1]
        after = Misfit(chi2=adjusted.chi2, dof=dof, held_out_rms=errors.after)
    verdict = "mismatch" if mismatch or certain_findings else "consistent"
    detectable, undetectable = detectability
    return Diagnosis.from_arrays(
        DiagnosisArrays(
            *_averaged_targets_and_change(model_fit, shifts, noises),
            case.expected_variance_factors(model.effects),
            baseline,
            adjusted,
        ),
        recording=source,
        verdict=verdict,
        summary=diagnosis_summary(
            verdict,
            findings,
            detection.p_value,
            before,
            after,
            n_withheld=len(model_fit.withheld_keys),
            is_contradicted=errors.log_odds_of_model < 0.0,
        ),
        global_test=GlobalTest(
            statistic=baseline.chi2,
            dof=baseline.dof,
            p_value=detection.chi2_p_value,
            search_p_value=detection.p_value,
        ),
        findings=tuple(findings),
        fit=BeforeAfter(before=before, after=after),
        undetectable=undetectable,
        detectable=tuple(map(DetectableEntry.from_minimal_size, detectable)),
        instruments=instrument_entries(final_adjustment),
        tests=() if selection is None else cause_tests(selection),
    )


def _averaged_targets_and_change(
    model_fit: ExplainedRecording, shifts: Sequence[Finding], noises: Sequence[Finding]
) -> tuple[AveragedTargets, Floats]:
    """Targets, and the change (n, 3) of the readings minus that of the refit, both averaged over explanations.

    If no cause is more probable than not, the targets are those of the ordinary adjustment.
    """
    case = model_fit.state
    targets, change = average_over_explanations(case.searcher, model_fit.model, model_fit.rankings, model_fit.refit)
    if not any(finding.evidence.p_real >= MIN_PROBABLE for finding in (*shifts, *noises)):
        targets, _ = average_over_explanations(case.searcher, case.empty_model, (), Refit(case.baseline, (), ()))
    return targets, change
