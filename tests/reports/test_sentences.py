"""Sentences for people name an effect by its title and a parameter in words; a key is for files and commands."""

from __future__ import annotations

import copy
import json
import re
from pathlib import Path

import pytest

from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.diagnosis.schema import Equivalent, Finding, FindingEvidence, FindingScope, Misfit, ParameterEstimate
from ltsim.diagnosis.words import catalogue_sentence, diagnosis_summary
from ltsim.physics.effects import BASELINE_EFFECTS, CATALOGUE
from ltsim.reports.document import ReportContext, Section
from ltsim.reports.sections.diagnosis import diagnosis_section
from tests.reports import samples

KINDS = list(CATALOGUE)


NAMES = {kind.name for kind in KINDS} | {p.name for effect in BASELINE_EFFECTS for p in effect.parameters}
KEYS = re.compile(r"\b(" + "|".join(key for key in sorted({*NAMES, "tilt-x"}) if "-" in key) + r")\b")
"""Keys of effects and parameters; one without a hyphen is a word."""


def finding(name: str, other: str) -> Finding:
    where, rows = (
        FindingScope(stations=("S3",)),
        (ParameterEstimate(name="azimuth-eccentricity-sin", value=12.1, sigma=1.8, unit="urad"),),
    )
    return Finding(
        effect=name,
        known=True,
        where=where,
        parameters=rows,
        evidence=FindingEvidence(chi2_drop=90.0, parameters=1, p_value=1e-4, probability=0.8),
        sentence=catalogue_sentence(name, where, rows, 0.8),
        equivalents=(Equivalent(effect=other, probability=0.2),),
    )


@pytest.mark.parametrize(("kind", "other"), list(zip(KINDS, KINDS[1:] + KINDS[:1], strict=True)))
def test_the_answer_names_causes_by_their_titles(kind: type, other: type) -> None:
    answer = diagnosis_summary(
        "mismatch", [finding(kind.name, other.name)], 0.01, Misfit(chi2=9.0, dof=3), Misfit(chi2=3.0, dof=2)
    )
    assert "cannot exclude" in answer
    assert not KEYS.search(answer), answer


def prose(section: Section) -> list[str]:
    """Everything on a section that a person reads: answer, actions, notes, captions, cells."""
    return [
        section.terminal_text(),
        *section.next_actions,
        *(getattr(block, "caption", "") for block in section.blocks),
    ]


def test_the_page_of_a_diagnosis_names_causes_by_their_titles(tmp_path: Path) -> None:
    content = copy.deepcopy(samples.DIAGNOSIS)
    found = finding("station-bump", "index-drift").model_dump(mode="json", by_alias=True)
    content["findings"].append(found)
    section = diagnosis_section(Diagnosis.model_validate_json(json.dumps(content)), ReportContext(folder=tmp_path))
    texts = " ".join(prose(section))
    assert "bumped" in texts and "drift of the vertical index" in texts
    assert not KEYS.search(texts), KEYS.findall(texts)
