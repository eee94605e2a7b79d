"""Sentences for people name an effect by its title and a parameter in words; a key is for files and commands."""

from __future__ import annotations

import copy
import json
import re
from pathlib import Path

import pytest

from ltsim.adjustment.identification.cause_selection import INFINITE_GAIN_SUBSTITUTE
from ltsim.adjustment.identification.cause_tests import CausePlace, CauseTest
from ltsim.campaigns.results import CampaignResults, PairedDifference
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.diagnosis.recommendations import inspection_action
from ltsim.diagnosis.schema import EquivalentEffect, Finding, FindingEvidence, FindingScope, Misfit, ParameterEstimate
from ltsim.diagnosis.sentences import catalogue_effect_sentence, diagnosis_summary
from ltsim.physics.effects import CATALOGUE, ORDINARY_CALIBRATION_EFFECTS
from ltsim.reports.document_model import Section, SectionContext
from ltsim.reports.sections.campaign import campaign_section
from ltsim.reports.sections.diagnosis import diagnosis_section
from ltsim.reports.sections.diagnosis_answer import evidence_lines, next_actions_after_diagnosis
from ltsim.reports.sections.method_comparison import MethodComparison
from tests.reports import samples

KINDS = list(CATALOGUE)


NAMES = {kind.name for kind in KINDS} | {p.name for effect in ORDINARY_CALIBRATION_EFFECTS for p in effect.parameters}
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
        sentence=catalogue_effect_sentence(name, where, rows, 0.8),
        equivalents=(EquivalentEffect(effect=other, probability=0.2),),
    )


@pytest.mark.parametrize(("kind", "other"), list(zip(KINDS, KINDS[1:] + KINDS[:1], strict=True)))
def test_the_answer_names_causes_by_their_titles(kind: type, other: type) -> None:
    answer = diagnosis_summary(
        "mismatch", [finding(kind.name, other.name)], 0.01, Misfit(chi2=9.0, dof=3), Misfit(chi2=3.0, dof=2)
    )
    assert "cannot exclude" in answer
    assert not KEYS.search(answer), answer


@pytest.mark.parametrize(
    ("before", "after", "sentence"),
    [
        (1.5, 1.4, "The findings improve the prediction of readings that the fit has not used: its error falls from "
         "1.50 to 1.40 times the noise (rms; noise alone gives 1)."),
        (1.5, 1.0, "improve the prediction of readings that the fit has not used: its error falls from 1.50 to 1.00 "
         "times the noise (rms; noise alone gives 1)."),
        (1.0, 1.1, "worsen the prediction of readings that the fit has not used: its error rises from 1.00 to 1.10"),
        (1.001, 1.002, "do not change the prediction of readings that the fit has not used: its error is 1.00 times"),
    ],
)  # fmt: skip
def test_the_answer_says_whether_the_findings_improve_predictions(before: float, after: float, sentence: str) -> None:
    """`within 1.40 times the noise with the findings, and within 1.50 without` read like a failure."""
    misfits = Misfit(chi2=9.0, dof=3, held_out_rms=before), Misfit(chi2=3.0, dof=2, held_out_rms=after)
    assert sentence in diagnosis_summary("mismatch", [finding("range-step", "range-drift")], 0.01, *misfits)


def test_cards_of_corrected_readings_name_the_corrected_finding(tmp_path: Path) -> None:
    content = copy.deepcopy(samples.DIAGNOSIS)
    moved = finding("target-moved", "nest-lift").model_copy(update={"is_corrected_before_search": True})
    context = SectionContext(folder=tmp_path)
    for findings, labels in (
        ([], ["findings", "global test, two-sided p", "chi2 per degree of freedom"]),
        ([moved], ["findings", "global test after the correction of finding 2, two-sided p",
                   "chi2 per degree of freedom after the correction of finding 2"]),
    ):  # fmt: skip
        result = Diagnosis.model_validate_json(json.dumps(content))
        result = result.model_copy(update={"findings": (*result.findings, *findings)})
        assert [fact.name for fact in diagnosis_section(result, context).key_figures] == labels


def test_the_evidence_of_an_effect_in_every_adjustment_is_not_called_a_failed_fit(tmp_path: Path) -> None:
    content = copy.deepcopy(samples.DIAGNOSIS)
    content["findings"][0]["evidence"]["chi2_drop"] = 2.0 * INFINITE_GAIN_SUBSTITUTE
    section = diagnosis_section(Diagnosis.model_validate_json(json.dumps(content)), SectionContext(folder=tmp_path))
    text = section.terminal_text()
    assert "its fall was not computed, because every compared adjustment contains this effect" in text


def test_the_answer_numbers_several_causes_and_names_no_formula_for_a_reference_value(tmp_path: Path) -> None:
    """A wrong control point was a `formula`, and a test without a p-value had an empty line."""
    content = copy.deepcopy(samples.DIAGNOSIS)
    wrong = copy.deepcopy(content["findings"][0])
    wrong |= {"effect": "unknown", "known": False, "formula": "", "carrier": "reference coordinates"}
    wrong |= {"sentence": "The control point P10 is wrong by 2.0 mm.", "parameters": []}
    wrong["where"] = {"observables": [], "stations": [], "targets": ["P10"], "covariates": ["place"]}
    wrong["evidence"] |= {"p_value": None, "probability": 0.001}
    content["findings"] = [content["findings"][0], wrong]
    section = diagnosis_section(Diagnosis.model_validate_json(json.dumps(content)), SectionContext(folder=tmp_path))
    assert "Cause 1: " in section.summary or "Possible cause 1: " in section.summary
    assert "ause 2: an error of the reference coordinates at target P10 (probability < 1 %)." in section.summary
    assert f"What to do first: {section.next_actions[0]}" in section.summary
    evidence = next(block for block in section.blocks if block.title == "Evidence of finding 2")
    assert "where: at target P10" in evidence.lines
    assert not any(line.startswith("p, ") for line in evidence.lines)
    assert "Proposed formula" not in section.terminal_text()


def test_a_wrong_reflector_constant_has_the_action_of_its_cause() -> None:
    assert inspection_action(finding("reflector-constant", "range-step")) == (
        "Check the SMR and the distance constant at S3; correct the wrong one."
    )
    assert inspection_action(finding("station-settling", "range-step")) == (
        "Let the tripod of S3 settle, and measure this set-up again."
    )
    assert inspection_action(finding("turbulence", "range-step")).startswith("Inspect S3 for the cause: ")


def test_findings_that_held_out_readings_contradict_are_not_used(tmp_path: Path) -> None:
    """The page recommended the coordinates `which account for the findings`, which did not contain them."""
    content = copy.deepcopy(samples.DIAGNOSIS)
    content["findings"][0]["evidence"] |= {"probability": 0.01, "p_same_scope": 0.02}
    improbable = Diagnosis.model_validate_json(json.dumps(content))
    first, second = next_actions_after_diagnosis(improbable)
    assert first.startswith("No cause is probable: look for single wrong pointings")
    assert second.startswith("Do not rely on the coordinates yet: targets.csv contains the coordinates of the ")
    section = diagnosis_section(improbable, SectionContext(folder=tmp_path))
    assert f"What to do: {first}" in section.summary
    assert "account for the findings" not in section.terminal_text()
    corrected = improbable.findings[0].model_copy(update={"is_corrected_before_search": True})
    used = improbable.model_copy(update={"findings": (corrected,)})
    assert next_actions_after_diagnosis(used)[-1].startswith("Use the coordinates in targets.csv, which account for")
    without = improbable.model_copy(update={"findings": ()})
    assert next_actions_after_diagnosis(without.model_copy(update={"verdict": "mismatch"})) == [first]
    assert next_actions_after_diagnosis(without.model_copy(update={"verdict": "consistent"})) == []


def test_evidence_without_a_fall_of_chi_square_is_not_called_so() -> None:
    """An exchange of names 3 m apart had `chi2 falls by 509`, which was twice a gain of log evidence."""
    exchange = finding("target-swap", "outlier").model_copy(update={"sentence": "P1 and P2 were exchanged."})
    place = CausePlace(stations=("S3",), targets=("P1", "P2"))
    test = CauseTest(kind="names", acts_on="position", where=place, statistic=90.0, dof=1, sentence=exchange.sentence)
    assert any(line.startswith("log evidence of robust fits: 45.0 larger") for line in evidence_lines(exchange, [test]))
    measured = test.model_copy(update={"p_value": 1e-9})
    assert "chi2 falls by 90.0 for 1 parameter" in evidence_lines(exchange, [measured])
    noise = finding("noise-level", "outlier")
    assert "log likelihood: 45.0 larger with this noise" in evidence_lines(noise, [])
    corrected = exchange.model_copy(update={"is_corrected_before_search": True})
    assert "p of its test: 0.0001" in evidence_lines(corrected, [measured])
    assert "p, corrected for the search: 0.0001" in evidence_lines(exchange, [measured])


def test_a_law_with_the_scope_of_a_simple_cause_has_its_sentence_and_action() -> None:
    """`check` advised to look at the clamping of S3, and `diagnose` to inspect S3 for a change of the azimuth."""
    scope = FindingScope(observables=("azimuth",), stations=("S3",), targets=(), instruments=(), covariates=("time",))
    law = {"effect": "unknown", "is_catalogued": False, "where": scope, "carrier": "azimuth"}
    step = finding("outlier", "window").model_copy(update=law)
    sentence = "The horizontal circle of S3 was turned by 12.3 arcsec."
    turned = CauseTest(
        kind="orientation", acts_on="azimuth", where=CausePlace(stations=("S3",)), statistic=9e3, dof=1,
        sentence=sentence,
    )  # fmt: skip
    content = Diagnosis.model_validate_json(json.dumps(samples.DIAGNOSIS)).model_copy(update={"findings": (step,)})
    action = "Check the clamping of the tracker at S3, and measure this set-up again."
    assert next_actions_after_diagnosis(content.model_copy(update={"tests": (turned,)}))[0] == action
    assert f"simple cause: {sentence}" in evidence_lines(step, [turned])
    elsewhere = turned.model_copy(update={"where": CausePlace(stations=("S4",))})
    assert next_actions_after_diagnosis(content.model_copy(update={"tests": (elsewhere,)}))[0].startswith("Inspect S3")
    assert not any(line.startswith("simple cause") for line in evidence_lines(step, [elsewhere]))


def prose(section: Section) -> list[str]:
    """Everything on a section that a person reads: answer, actions, notes, captions, cells."""
    return [
        section.terminal_text(),
        *section.next_actions,
        *(getattr(block, "caption", "") for block in section.blocks),
    ]


def test_the_page_of_a_diagnosis_names_causes_by_their_titles(tmp_path: Path) -> None:
    content = copy.deepcopy(samples.DIAGNOSIS)
    finding_content = finding("station-bump", "index-drift").model_dump(mode="json", by_alias=True)
    content["findings"].append(finding_content)
    section = diagnosis_section(Diagnosis.model_validate_json(json.dumps(content)), SectionContext(folder=tmp_path))
    texts = " ".join(prose(section))
    assert "bumped" in texts and "drift of the vertical index" in texts
    assert not KEYS.search(texts), KEYS.findall(texts)


def difference(size: float) -> PairedDifference:
    return PairedDifference({}, "plain", "network", "target_error_um", "um", 200, size, size - 2.0, size + 2.0)


@pytest.mark.parametrize(
    ("sizes", "text"),
    [
        ((5.0,), "smaller than with plain by 5.00 um"),
        ((1.0,), "not significantly different from that with plain"),
        ((5.0, 9.0), "smaller than with plain in all 2 combinations of factor levels (by 5.00 to 9.00 um)"),
        (
            (5.0, 9.0, -3.0, 1.0),
            "smaller than with plain in 2 of 4 combinations of factor levels (by 5.00 to 9.00 um), larger than with "
            "plain in 1 of 4 combinations of factor levels (by 3.00 um), not significantly different from that with "
            "plain in 1 of 4",
        ),
    ],
)
def test_the_comparison_of_methods_counts_and_sizes_each_sign(sizes: tuple[float, ...], text: str) -> None:
    """No setting with a larger error is counted as a smaller one, and no difference is negative."""
    entries = [difference(size) for size in sizes]
    comparison = MethodComparison("target_error_um", "network", ("",) * len(sizes), {"plain": entries})
    assert comparison.sentence().startswith(
        f"With the same random draws, the error of the targets with network is {text} (paired"
    )


def test_coverage_is_separate_where_the_noise_differs_from_the_declared_noise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One pass over the z-scores of the rows gives the key figures, the figures and the table."""
    passes, scores = [], CampaignResults.iterate_z_score_summaries
    monkeypatch.setattr(CampaignResults, "iterate_z_score_summaries", lambda r: passes.append(r) or scores(r))
    section = campaign_section(samples.campaign_folder(tmp_path / "campaign"))
    n_rows = sum(comparison.trials for comparison in CampaignResults(tmp_path / "campaign").solver_comparisons())
    assert [f.value for f in section.key_figures if f.name == "calibrations"] == [str(n_rows)]
    tiles = [fact.name for fact in section.key_figures if fact.name.startswith("coverage")]
    assert [name.partition(";")[0] for name in tiles] == [
        "coverage of 95 % intervals", "coverage of 95 % intervals with noise factor 2 (not declared)"
    ]  # fmt: skip
    assert all(name.partition("; ")[2].split(" ")[1].startswith("intervals") for name in tiles)
    assert len(passes) == 1 and "z-scores of the parameters" in [block.title for block in section.blocks]
    values = [fact.value for fact in section.key_figures if fact.name in tiles]
    assert all(re.fullmatch(r"\d+\.\d %", value) for value in values), values


def test_the_three_most_urgent_actions_are_shown() -> None:
    """On a terminal as at the head of a page, each once."""
    section = Section(
        "Adjustment", "Adjustment", "It fails.", next_actions=["first", "second", "first", "third", "last"]
    )
    assert section.terminal_text().endswith("What to do next:\n- first\n- second\n- third")
