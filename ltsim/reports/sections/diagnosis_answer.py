"""Answer of a diagnosis for its first screen, next actions, and the evidence and parameters of a finding in words."""

from collections.abc import Sequence

from ltsim.adjustment.identification.cause_selection import INFINITE_GAIN_SUBSTITUTE
from ltsim.adjustment.identification.cause_tests import CauseTest
from ltsim.adjustment.identification.recommendations import recommendation_for_cause
from ltsim.core.errors import ModelError
from ltsim.core.notation import number_text
from ltsim.core.probability import p_value_text
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.diagnosis.recommendations import inspection_action
from ltsim.diagnosis.schema import Finding, FindingScope
from ltsim.diagnosis.sentences import (
    MIN_PROBABILITY_OF_PROBABLE_CAUSE,
    effect_title_in_sentence,
    finding_title,
    percent_text,
    place_text,
)
from ltsim.physics.effects import find_effect, parameter_text
from ltsim.physics.effects.noise_level import NoiseLevel
from ltsim.physics.effects.target_moved import TargetMoved, moved_coordinates_sentence
from ltsim.reports.formatting import capitalised_sentence, count_text, names_text

MAX_CAUSES_IN_ANSWER = 2
"""Largest number of findings in the answer; with verdict and next action it then has at most four sentences."""
MIN_ADVISED_ALTERNATIVE_PROBABILITY = 0.05
"""Smallest probability of an alternative cause that leads to the advice of a measurement to exclude it; by convention 5
%."""
MAX_ACTIONS_BEFORE_USE = 2
"""Largest number of next actions in addition to the use of the coordinates."""
PLACE_COVARIATE = "place"
"""Covariate of effects that differ between stations or targets, which the text of a scope names anyway."""
IMPROBABLE_FINDINGS_ACTION = (
    "No cause is probable: look for single wrong pointings and for repeats that share errors, and measure again."
)
"""Sentence on the next action if readings and model disagree, but every cause is improbable."""


def diagnosis_answer(content: Diagnosis, next_actions: Sequence[str]) -> str:
    """Answer of a diagnosis in a few short sentences: verdict, places and causes with probabilities, next action.

    Without findings the answer is the summary of the diagnosis. `next_actions` are the next actions of the diagnosis,
    the most urgent first.
    """
    if not content.findings:
        return capitalised_sentence(content.summary)
    sentences = [f"The readings contradict the model: {count_text(len(content.findings), 'finding')}."]
    is_single = len(content.findings) == 1
    for finding_number, finding in enumerate(content.findings[:MAX_CAUSES_IN_ANSWER], start=1):
        is_probable = finding.evidence.probability >= MIN_PROBABILITY_OF_PROBABLE_CAUSE
        subject = "Cause" if is_probable else "Possible cause"
        number_text = "" if is_single else f" {finding_number}"
        probability = percent_text(finding.evidence.probability)
        sentences.append(
            f"{subject}{number_text}: {finding_title(finding)} {place_text(finding.where)} (probability {probability})."
        )
    further = len(content.findings) - MAX_CAUSES_IN_ANSWER
    sentences += [f"{count_text(further, 'further finding')} below."] if further > 0 else []
    sentences += [f"What to do{'' if is_single else ' first'}: {next_actions[0]}"] if next_actions else []
    return " ".join(sentences)


def next_actions_after_diagnosis(content: Diagnosis) -> list[str]:
    """Next actions: a measurement that separates alternative causes, parts to inspect, coordinates to use.

    If no finding is probable, for example because held-out readings contradict the findings, the actions neither name a
    part to inspect nor recommend the coordinates.
    """
    if not content.findings:
        return [IMPROBABLE_FINDINGS_ACTION] if content.verdict == "mismatch" else []
    probable = [finding for finding in content.findings if _is_in_coordinates(finding)]
    if not probable:
        return [IMPROBABLE_FINDINGS_ACTION, f"Do not rely on the coordinates yet: {targets_note(content)}"]
    actions: list[str] = []
    for finding in content.findings:  # in their order, so that the actions begin with those of the first finding
        is_ambiguous = finding.separate_by and _has_probable_alternative(finding)
        actions += [capitalised_sentence(finding.separate_by)] if is_ambiguous else []
        simple_cause = _simple_cause(finding, content.tests)
        actions.append(inspection_action(finding) if simple_cause is None else recommendation_for_cause(simple_cause))
    use_sentence = "Use the coordinates in targets.csv, which account for the findings."
    moved_targets = [
        name for finding in probable if finding.effect == TargetMoved.name for name in finding.where.targets
    ]
    use_sentence += f" {moved_coordinates_sentence(moved_targets)}" if moved_targets else ""
    return [*list(dict.fromkeys(actions))[:MAX_ACTIONS_BEFORE_USE], use_sentence]


def _simple_cause(finding: Finding, tests: Sequence[CauseTest]) -> CauseTest | None:
    """Simple cause, by the tests of the adjustment, of a law outside the catalogue with the same place and observable.

    The result is None without such a cause.
    """
    if finding.is_catalogued or finding.concerns_reference_value:
        return None
    scope = finding.where.observables, finding.where.stations, finding.where.targets
    same_scope = (t for t in tests if t.is_fault and ((t.acts_on,), t.where.stations, t.where.targets) == scope)
    return next(same_scope, None)


def targets_note(content: Diagnosis) -> str:
    """Sentence on the model of the coordinates in `targets.csv`: with or without the findings of a diagnosis."""
    if content.findings and not any(map(_is_in_coordinates, content.findings)):
        return "targets.csv contains the coordinates of the adjustment without the findings."
    return "Adjusted with the findings in the model."


def _is_in_coordinates(finding: Finding) -> bool:
    """True if the coordinates of a diagnosis account for a finding: corrected before the search, or probable."""
    return finding.is_corrected_before_search or finding.evidence.p_real >= MIN_PROBABILITY_OF_PROBABLE_CAUSE


def _has_probable_alternative(finding: Finding) -> bool:
    """True if another effect may explain the finding and is probable enough to advise a measurement to exclude it."""
    return any(
        e.effect != "unknown" and e.probability >= MIN_ADVISED_ALTERNATIVE_PROBABILITY for e in finding.equivalents
    )


def finding_scope_text(scope: FindingScope) -> str:
    """Text of the observables, instruments, stations and targets on which a finding acts, and of its covariates."""
    place_texts = [
        f"{word}{'s' if is_countable and len(names) > 1 else ''} {names_text(list(names))}"
        for word, names, is_countable in (
            ("in", scope.observables, False),
            ("of instrument", scope.instruments, True),
            ("at station", scope.stations, True),
            ("at target", scope.targets, True),
            ("along", [name for name in scope.covariates if name != PLACE_COVARIATE], False),
        )
        if names
    ]
    return ", ".join(place_texts) or "everywhere"


def evidence_lines(finding: Finding, tests: Sequence[CauseTest]) -> list[str]:
    """Lines on the evidence of a finding: place, simple cause, misfit without it, p-value, probability, alternatives.

    `tests` are the tests of simple causes of the diagnosis.
    """
    evidence, others = finding.evidence, finding.equivalents
    simple_cause = _simple_cause(finding, tests)
    p_text = p_value_text(evidence.p_value)
    p_name = "p of its test" if finding.is_corrected_before_search else "p, corrected for the search"
    return [
        f"where: {finding_scope_text(finding.where)}",
        *([] if simple_cause is None else [f"simple cause: {simple_cause.sentence}"]),
        _misfit_text(finding, tests),
        *([] if evidence.p_value is None else [f"{p_name}: {p_text}"]),
        f"probability: {percent_text(evidence.probability)}",
        *(f"alternative: {effect_title_in_sentence(e.effect)}, {100 * e.probability:.2g} %" for e in others),
    ]


def _misfit_text(finding: Finding, tests: Sequence[CauseTest]) -> str:
    """Text on the change of the misfit by a finding: fall of chi-square, or gain of log evidence or log likelihood.

    A changed noise is compared by the log likelihood. Exchanged names, wrong units and centring errors, whose test
    among `tests` has no p-value, are compared by the log evidence of robust fits.
    """
    gain = finding.evidence.chi2_drop
    if gain >= INFINITE_GAIN_SUBSTITUTE:
        return "chi2: its fall was not computed, because every compared adjustment contains this effect"
    if any(test.sentence == finding.sentence and test.p_value is None for test in tests):
        return (
            f"log evidence of robust fits: {number_text(0.5 * gain)} larger with this cause (a robust fit limits the "
            "weight of large residuals)"
        )
    if finding.effect == NoiseLevel.name or finding.carrier == "noise":
        return f"log likelihood: {number_text(0.5 * gain)} larger with this noise"
    return f"chi2 falls by {number_text(gain)} for {count_text(finding.evidence.parameters, 'parameter')}"


def parameter_meanings_note(finding: Finding) -> str:
    """Note on what a positive value of each parameter of a finding means; empty if no parameter has such a meaning.

    This is the case for an effect that only a formula describes, such as ``azimuth ~ time``.
    """
    if not finding.is_catalogued:
        return ""
    try:
        parameters = find_effect(finding.effect).parameters
    except ModelError:  # an effect of another package, which is not installed here
        return ""
    names = {p.name for p in finding.parameters}
    meanings = [f"{parameter_text(p.name)}: {p.description}" for p in parameters if p.name in names]
    return f"Meaning of positive values: {'; '.join(meanings)}." if meanings else ""
