"""Steps of a diagnosis: preprocess, detect, select a model, refit, report."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import ceil

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.identification import CauseSelection, cause_tests, identify_causes
from ltsim.adjustment.refit import Refit
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.adjustment.structure import raise_for_singular_network
from ltsim.calibration.evidence import log_sum_exp
from ltsim.calibration.prior_information import EarlierCalibrations
from ltsim.core.arrays import Floats
from ltsim.core.errors import RecordError
from ltsim.core.limits import DIAGNOSED_POINTINGS
from ltsim.diagnosis.averaging import averaged
from ltsim.diagnosis.catalogue_signatures import CatalogueSignatures
from ltsim.diagnosis.detect import Detection, detect
from ltsim.diagnosis.detectability import DetectabilityReport, detectability_report
from ltsim.diagnosis.diagnosis import Diagnosis, DiagnosisArrays, Targets
from ltsim.diagnosis.evidence import restricted
from ltsim.diagnosis.findings import Explained, among, noise_finding
from ltsim.diagnosis.findings_from_tests import instrument_finding
from ltsim.diagnosis.held_out import HeldOut, held_out as held_out_errors
from ltsim.diagnosis.hypotheses import Model, likeliest
from ltsim.diagnosis.instruments import Contradiction, HistoryExpectation, contradictions, instrument_entries
from ltsim.diagnosis.noise import NoiseHypothesis, most_likely
from ltsim.diagnosis.null_ensemble import TRIALS
from ltsim.diagnosis.preprocessing import adapted_baseline, agreeing
from ltsim.diagnosis.schema import BeforeAfter, DetectableEntry, Finding, GlobalTest, Misfit
from ltsim.diagnosis.search import MOST_MEMBERS
from ltsim.diagnosis.selection_state import SelectionState
from ltsim.diagnosis.words import LIKELY, summarise
from ltsim.physics.effects.noise_level import NoiseLevel
from ltsim.physics.effects.signature import CandidateEffect
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.responses import VARIED_CONSTANTS, constants_of_slot
from ltsim.physics.model.construction import declared_construction
from ltsim.recordings.recording import Recording
from ltsim.recordings.result_file import SourceEntry
from ltsim.solve.threads import single_threaded

MOST_ROUNDS = 3
"""Largest number of alternations between variance and mean hypotheses."""
LEAST_LEVEL = 1e-3
"""Smallest false-alarm rate; a p-value of 1 / (n + 1) needs n simulated recordings."""
MIN_REMAINING_OFFSET = 0.5
"""Smallest fraction of its offset that a contradicting constant must retain with the selected effects in the model to
be reported.
"""
MOST_REPORTED = 5
"""Largest number of reported findings, blunders and constants first."""
LEAST_GAIN = 2.0
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
        False-alarm rate of the whole search, `LEAST_LEVEL` at least.
    history : EarlierCalibrations, optional
        Earlier calibrations that each constant of the instruments is compared with.
    held_out : bool, optional
        Whether the search is repeated without each fold of the readings, which are then predicted: five more searches
        if the model is not empty. None: in networks with up to `null_ensemble.MOST_UNKNOWNS` unknowns.

    Returns
    -------
    Diagnosis
        Verdict, findings in the order of their strength, fit before and after, undetectable effects.

    Raises
    ------
    RecordError
        When the history is of other instruments or another construction, or the level is none.
    """
    if not LEAST_LEVEL <= level < 1.0:
        raise RecordError(f"the level is {level:g}; expected a false-alarm rate from {LEAST_LEVEL:g} to 1")
    recording.require_at_most(DIAGNOSED_POINTINGS, "a diagnosis")
    construction = declared_construction(recording)
    compared = (
        contradictions if history is None else HistoryExpectation.of(history, recording, construction).contradictions
    )
    selection = identify_causes(recording, construction)
    if selection is None:
        baseline, mistaken = adjust(recording, construction), list[Finding]()
        use = baseline.problem.used_readings
    else:
        baseline, use, mistaken = adapted_baseline(recording, construction, selection)
    trials = max(TRIALS, ceil(1.0 / level))
    case = SelectionState(baseline, use, seed, trials, ordinary=history is None)
    beginning, detection, model, fitted = _searched(case, level, compared)
    if selection is not None and model.members:
        restored = agreeing(fitted.adjustment, np.isfinite(recording.readings) & ~use)
        if restored.any():  # the effects of the model explain them
            del case, beginning, detection, model, fitted  # their memory is for the second search
            baseline, use, mistaken = adapted_baseline(recording, construction, selection, restored=restored)
            case = SelectionState(baseline, use, seed, trials, ordinary=history is None)
            beginning, detection, model, fitted = _searched(case, level, compared)
    mismatch = detection.p_value < level
    settled = fitted.adjustment if fitted.adjustment.solution.has_converged else baseline
    contradicting = _contradicting_constants(case, model, settled, compared)
    odd = [instrument_finding(c) for c in contradicting if not _varies(c.parameter.name, model.effects)][:MOST_MEMBERS]
    explained = Explained(case, detection, model, fitted, bool(mistaken or odd or _beyond_level(case.noise)))
    repeated = not case.searcher.large if held_out is None else held_out
    errors = HeldOut() if case.searcher.large and not repeated else _held_out(explained, LEAST_GAIN, repeated)
    detectability = detectability_report(*beginning)
    source = SourceEntry.from_recording(recording)
    return _report(source, explained, detectability, [*mistaken, *odd], settled, errors, selection, mismatch=mismatch)


def _varies(constant: str, effects: Sequence[CandidateEffect]) -> bool:
    """True if an effect varies this constant of an instrument, which then has no single value."""
    laws = (VARIED_CONSTANTS.get(e.response.name, ()) for e in effects if isinstance(e, EmpiricalLaw))
    drifts = (constants_of_slot(getattr(e, "slot", "")) for e in effects)
    parameters = ([p.name for p in e.parameters] for e in effects)
    return any(constant in varied for varied in (*laws, *drifts, *parameters))


Compared = Callable[[Adjustment, float], list[Contradiction]]
"""Function from an adjustment and a smallest log evidence to the constants that contradict their reference."""


def _searched(
    case: SelectionState, level: float, compared: Compared
) -> tuple[tuple[ResidualSpace, CatalogueSignatures], Detection, Model, Refit]:
    """Space and hypotheses of the initial network, its detection result, the selected model if rejected, its refit."""
    beginning = case.space, case.searcher.cards
    detection = detect(case.searcher, case.bank)
    model = _select_model(case, LEAST_GAIN, compared) if detection.p_value < level else case.empty
    return beginning, detection, *_refitted(case, model)


def _contradicting_constants(
    case: SelectionState, model: Model, settled: Adjustment, compared: Compared
) -> list[Contradiction]:
    """Constants that contradict their reference with nearly equal offsets with and without the model."""
    with_model = compared(settled, LEAST_GAIN)
    if not model.members:
        return with_model
    alone = compared(case.space.adjustment, LEAST_GAIN)
    size = {
        (contradiction.instruments, contradiction.parameter.name): abs(contradiction.difference)
        for contradiction in alone
    }
    return [
        c
        for c in with_model
        if abs(c.difference) > MIN_REMAINING_OFFSET * size.get((c.instruments, c.parameter.name), np.inf)
    ]


def _select_model(case: SelectionState, threshold: float, compared: Compared) -> Model:
    """Selected model: changed constants, mean shifts and changes of the noise, until the evidence does not increase.

    The kind with the larger evidence is selected first: a law selected with a wrong noise level absorbs noise, and
    noise estimated before a law absorbs the law; the same is true for constants.
    """
    noise = case.noises(case.empty)[0][0]
    shifts = case.searcher.lower_bound(threshold, noise).score
    if noise >= shifts:
        _variance_only(case, threshold, max(shifts, case.searcher.rank(case.empty).total))
        model = _mean_and_variance(case, threshold)
    else:
        model = case.searcher.search(threshold, something=True)
    contradicting = compared(case.space.adjustment, LEAST_GAIN)
    if contradicting and sum(contradiction.evidence for contradiction in contradicting) > model.score:
        case.release_priors(contradicting)
        model = case.searcher.search(threshold, something=False)
    return _alternate_mean_and_variance(case, model, threshold)


def _variance_only(case: SelectionState, threshold: float, shifts: float) -> None:
    """Forward selection of changes of the noise; the first is always selected, since the global test has failed.

    The log evidence of mean `shifts` counts among the alternatives to the first one.
    """
    for further in range(MOST_ROUNDS):
        ranked = case.noises(case.empty)
        if further and ranked[0][0] < threshold:
            break
        case.add_noise(most_likely(case.space, case.space.sigma, _with_probability(ranked, 0.0 if further else shifts)))
        case.set_adjustment(case.estimate_variance_components(()))


def _mean_and_variance(case: SelectionState, threshold: float) -> Model:
    """Model of mean shifts in addition to a change of the noise, if they increase the evidence; else the empty model.

    Noise estimated alone hides a shift: it is estimated again with the best shifts, and both together are
    compared with noise alone by their restricted likelihood.
    """
    alone, sigma, adjusted = list(case.noise), case.sigma, case.space.adjustment
    case.prune_variance_components(case.searcher.search(threshold, something=True).effects)
    model, space = case.searcher.search(threshold, something=False), case.space
    factor = (sigma / case.sigma)[space.used_readings] ** 2
    squares, share = (rows[: len(factor)] for rows in (space.residuals**2, space.redundancy))
    if model.members and model.score - restricted(squares, share, factor).sum() > threshold:
        return model
    case.noise, case.sigma = alone, sigma
    case.set_adjustment(adjusted)
    return case.empty


def _alternate_mean_and_variance(case: SelectionState, model: Model, threshold: float) -> Model:
    """Alternation between variance and mean hypotheses.

    Each noise hypothesis is tried added to the model, or replacing one member or all, until the evidence stops
    increasing.
    """
    for _ in range(MOST_ROUNDS):
        searcher, members = case.searcher, model.members
        bases = [model, *(searcher.without(model, i) for i in range(len(members)))]
        bases += [searcher.empty] if len(members) > 1 else []
        ranked = [case.noises(base) for base in bases]
        least = threshold + model.discrepancy_penalty
        rest = [min(searcher.rank(model).total, least), *(searcher.rank(base).total for base in bases[1:])]
        lost = [0.0, *rest[1 : len(members) + 1], *(model.score - base.score for base in bases[len(members) + 1 :])]
        gains = [noise[0][0] - less for noise, less in zip(ranked, lost, strict=True)]
        most = int(np.argmax(gains))
        if gains[most] < (least if not most and (case.noise or members) else 0.0):
            break
        likeliest_noise = _with_probability(ranked[most], rest[most])
        space = case.space.with_effects(bases[most].effects)
        case.add_noise(most_likely(space, case.space.sigma, likeliest_noise))
        case.set_adjustment(case.estimate_variance_components(bases[most].effects))
        model = case.searcher.search(threshold, something=False)
    return model


def _with_probability(ranked: Sequence[tuple[float, NoiseHypothesis]], rest: float) -> NoiseHypothesis:
    """Most probable change of the noise with its probability among all hypotheses.

    `rest` is the log sum of the others.
    """
    values = np.array([value for value, _ in ranked])
    weights = np.exp(values - log_sum_exp(np.array([0.0, rest, *values])))
    named: dict[str, float] = {}
    for (_, entry), weight in zip(ranked, weights.tolist(), strict=True):
        named[entry.effect.name] = min(named.get(entry.effect.name, 0.0) + weight, 1.0)
    name = likeliest(named)
    value, best = next(entry for entry in ranked if entry[1].effect.name == name)
    probability, rivals = among(named, name)
    return replace(best, evidence=value, probability=probability, equivalents=rivals)


def _refitted(case: SelectionState, model: Model) -> tuple[Model, Refit]:
    """Nonlinear refit of the model, without members that it no longer supports.

    The search is linear: the second-order part of a large effect can look like a further effect.
    """
    fitted = case.refit(model.effects, case.sigma)
    while len(model.members) > 1:
        rest = [case.searcher.without(model, i) for i in range(len(model.members))]
        without = [case.refit(reduced.effects, case.sigma) for reduced in rest]
        gains = [
            log_support(model, reduced, refitted.adjustment.chi2 - fitted.adjustment.chi2)
            for reduced, refitted in zip(rest, without, strict=True)
        ]
        least = int(np.argmin(gains))
        if gains[least] >= 0.0:
            break
        model, fitted = rest[least], without[least]
    return model, fitted


def log_support(model: Model, reduced: Model, drop: float) -> float:
    """Log evidence of a model relative to a reduced one, with the chi-square decrease of the nonlinear refits.

    The linear evidence has the Occam factors and priors; its decrease of chi-square is replaced by `drop`.
    """
    linear = float(reduced.residual @ reduced.residual - model.residual @ model.residual)
    return model.score - reduced.score + 0.5 * (drop - linear)


def _beyond_level(noise: Sequence[NoiseHypothesis]) -> bool:
    """True if a change of the noise other than its overall level was selected."""
    return any(not isinstance(change.effect, NoiseLevel) for change in noise)


def _report(
    source: SourceEntry,
    explained: Explained,
    detectability: DetectabilityReport,
    certain: Sequence[Finding],
    settled: Adjustment,
    errors: HeldOut,
    selection: CauseSelection | None,
    *,
    mismatch: bool,
) -> Diagnosis:
    """Diagnosis from the explained model, and from findings of tests (`certain`), which need no search."""
    case, model, detection = explained.case, explained.model, explained.detection
    baseline, adjusted = case.baseline, explained.refit.adjustment
    shifts = [explained.finding(i) for i, finding in enumerate(model.members) if finding.key not in explained.withheld]
    clock = case.recording.has_clock
    noises = [noise_finding(finding, baseline.sightings, detection, clock=clock) for finding in case.noise]
    sure = [finding for finding in (*shifts, *noises) if finding.evidence.chance >= LIKELY]
    alone = not certain and all(finding.effect == NoiseLevel.name for finding in sure)
    likely = (sure + [finding for finding in shifts if finding not in sure] or noises) if alone else sure
    likely = sorted(likely, key=lambda finding: -finding.evidence.chi2_drop)
    room = max(MOST_REPORTED - len(certain), 0)
    findings = sorted([*certain, *likely[:room]], key=lambda finding: -finding.evidence.chi2_drop)
    before = after = Misfit(chi2=baseline.chi2, dof=baseline.dof, held_out_rms=errors.before)
    if model.members or case.noise:
        dof = baseline.dof - model.basis.shape[1]
        after = Misfit(chi2=adjusted.chi2, dof=dof, held_out_rms=errors.after)
    verdict = "mismatch" if mismatch or certain else "consistent"
    detectable, undetectable = detectability
    return Diagnosis.of(
        DiagnosisArrays(*_averaged(explained, shifts, noises), baseline, adjusted),
        recording=source,
        verdict=verdict,
        summary=summarise(
            verdict, findings, detection.p_value, before, after, withheld=len(explained.withheld) + len(likely[room:])
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
        detectable=tuple(map(DetectableEntry.of, detectable)),
        instruments=instrument_entries(settled),
        tests=() if selection is None else cause_tests(selection),
    )


def _averaged(explained: Explained, shifts: Sequence[Finding], noises: Sequence[Finding]) -> tuple[Targets, Floats]:
    """Targets and difference of the change of the readings (n, 3), averaged over explanations.

    The targets are those of the calibration if no cause is more probable than not.
    """
    case = explained.case
    targets, change = averaged(case.searcher, explained.model, explained.rankings, explained.refit)
    if not any(finding.evidence.chance >= LIKELY for finding in (*shifts, *noises)):
        targets, _ = averaged(case.searcher, case.empty, (), Refit(case.baseline, (), ()))
    return targets, change


def _held_out(explained: Explained, threshold: float, repeated: bool) -> HeldOut:
    """Errors of held-out readings, relative to the larger of the declared and the estimated noise.

    `after` is given if the search is `repeated`, or the model shifts no reading.
    """
    case, nominal = explained.case, explained.case.recording.sigma()
    space, seed = case.searcher.space, case.seed
    if (case.sigma < nominal).any():
        space = ResidualSpace.from_adjustment(case.refit((), np.maximum(case.sigma, nominal)).adjustment)
    if not explained.model.members:
        before = held_out_errors(space, seed).before
        return HeldOut(before, before)
    return held_out_errors(space, seed, case.searcher, threshold) if repeated else held_out_errors(space, seed)


__all__ = ["diagnose"]
