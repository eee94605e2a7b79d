"""Answer of a diagnosis for its first screen, and the meaning of the parameters of a finding."""

from collections.abc import Sequence

from ltsim.core.errors import ModelError
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.diagnosis.schema import Finding
from ltsim.diagnosis.sentences import (
    MIN_PROBABILITY_OF_PROBABLE_CAUSE,
    finding_title,
    percent_text,
    place_text,
)
from ltsim.physics.effects import find_effect, parameter_text
from ltsim.reports.formatting import capitalised_sentence, count_text

MAX_CAUSES_IN_ANSWER = 2
"""Largest number of findings in the answer; with verdict and next action it then has at most four sentences."""


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
