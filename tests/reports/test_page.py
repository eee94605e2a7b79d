"""The page: the answer first, nothing from outside, names escaped, one sentence for broken input."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.request import urlopen
from xml.etree.ElementTree import fromstring

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment.fieldcheck.check import check
from ltsim.adjustment.identification.cause_tests import CausePlace, CauseTest
from ltsim.calibration.files import write_calibration
from ltsim.calibration.network import adjust, calibrate_network
from ltsim.cli.main import run
from ltsim.core.errors import LtsimError, RecordError
from ltsim.physics.effects import effect_title
from ltsim.recordings import write
from ltsim.recordings.result_file import write_result
from ltsim.reports.document_model import Document
from ltsim.reports.page import document_of_folder, page_html
from ltsim.reports.sections.network import target_uncertainty_sentence
from ltsim.reports.verbs import report
from tests.reports import samples

PLACES = ("diagnosis", ".")
MARKUP = '<img src=x onerror="alert(1)">&amp;'


class Reader(HTMLParser):
    """Collects what a browser would load, and the text in order."""

    def __init__(self) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.tags: list[str] = []
        self.handlers: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attrs:
            if name in ("src", "href", "action", "data", "poster", "srcset"):
                self.loads.append(value or "")
            if name.startswith("on"):
                self.handlers.append(name)

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def parsed(html: str) -> Reader:
    reader = Reader()
    reader.feed(html)
    return reader


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    top = tmp_path_factory.mktemp("demo")
    samples.calibration_folder(top)
    shutil.rmtree(top / "recording")
    samples.diagnosis_folder(top)
    return top


@pytest.fixture(scope="module")
def contents(folder: Path) -> dict[str, Document]:
    return {name: document_of_folder(folder / name) for name in PLACES}


@pytest.mark.parametrize("name", PLACES)
def test_page_loads_nothing_from_outside(name: str, contents: dict[str, Document]) -> None:
    reader = parsed(page_html(contents[name]))
    assert reader.loads
    assert [load for load in reader.loads if not load.startswith(("data:", "#"))] == []
    assert reader.handlers == []
    assert "img" in reader.tags


def test_answer_stands_first(contents: dict[str, Document]) -> None:
    content = contents["diagnosis"]
    cause = "Cause: settling of a station at station S3"
    assert cause in content.summary
    text = " ".join(" ".join(parsed(page_html(content)).text).split())
    details = "Station S3 leans by 12 ± 2 µrad with a time constant of 9 ± 2 min after set-up."
    assert text.index(cause) < text.index(details)


def test_calibration_says_what_changed(contents: dict[str, Document]) -> None:
    content = next(s for s in contents["."].sections if s.kind.startswith("Calibration"))
    assert "calibrated from 5 stations" in content.summary
    assert "readings agree with the model" in content.summary
    assert "% better than before" in content.summary and "correction of" not in content.summary
    assert content.assessment == "good"
    titles = [block.title for block in content.blocks]
    assert {"Instrument parameters", "Targets"} <= set(titles)
    every = [block.title for section in contents["."].sections for block in section.blocks]
    assert every.count("Residuals over covariates") == 1  # in the diagnosis, which explains them


def test_demo_tells_everything_once(contents: dict[str, Document]) -> None:
    content = contents["."]
    assert [section.kind for section in content.sections] == ["Diagnosis", "Calibration", "Recording"]
    scenes = [block for section in content.sections for block in section.blocks if block.kind == "scene"]
    assert len(scenes) == 1  # one recording, one view
    assert "Cause: settling of a station at station S3" in content.summary
    assert content.title == "Diagnosis: test network"  # what it is, not the folder's name


def test_a_recording_that_lies_in_two_folders_is_reported_once(tmp_path: Path) -> None:
    """As `ltsim convert` leaves one, and `ltsim diagnose` another beside its result."""
    samples.calibration_folder(tmp_path)
    shutil.copytree(tmp_path / "recording", tmp_path / "calibration" / "recording")
    shutil.move(tmp_path / "recording", tmp_path / "converted")
    blocks = [block for section in document_of_folder(tmp_path).sections for block in section.blocks]
    titles = [block.title for block in blocks]
    assert titles.count("The hall in 3D") == titles.count("Floor plan") == titles.count("Residuals by station") == 1
    pictures = [block for block in blocks if block.kind == "picture"]
    for picture in pictures:
        assert not {'"', "\n"} & set(picture.data_uri)  # safe between quotation marks
        with urlopen(picture.data_uri) as stream:
            assert fromstring(stream.read()).tag.endswith("svg")


def test_signature_shows_the_finding(contents: dict[str, Document]) -> None:
    titles = [block.title for block in contents["diagnosis"].sections[0].blocks]
    assert {"Effect of finding 1", "Finding 1 in figures", "Misfit without and with the findings"} <= set(titles)


def test_a_swap_is_shown_as_who_stands_for_whom_and_says_what_to_do(tmp_path: Path) -> None:
    target = samples.diagnosis_folder(tmp_path)
    shutil.copy(target / "residuals.csv", target / "residuals_before.csv")  # written with the names put right
    content = json.loads((target / "diagnosis.json").read_text())
    first, second = samples.recording().targets[:2]
    where = {"observables": [], "stations": ["S3"], "targets": [first, second], "covariates": []}
    content["findings"][0] |= {"effect": "target-swap", "where": where, "separate_by": ""}
    (target / "diagnosis.json").write_text(json.dumps(content))
    shown = document_of_folder(target)
    titles = [block.title for block in shown.sections[0].blocks]
    assert "Place of finding 1" in titles and "Effect of finding 1" not in titles
    assert shown.next_actions[0].startswith(f"Exchange the names {first}, {second} at S3")


def test_report_of_a_folder_without_recording_still_tells(folder: Path, tmp_path: Path) -> None:
    alone = shutil.copytree(folder / "calibration", tmp_path / "alone")
    titles = [block.title for block in document_of_folder(alone).sections[0].blocks]
    assert {"Floor plan", "The hall in 3D", "Residuals by station"} <= set(titles)


@pytest.mark.parametrize(("p", "shown"), [(0.0, "< 1e-6"), (0.03, "0.06"), (None, "–")])
def test_a_p_value_of_nothing_is_shown_as_small_and_none_as_a_dash(p: float | None, shown: str, tmp_path: Path) -> None:
    target = samples.diagnosis_folder(tmp_path)
    content = json.loads((target / "diagnosis.json").read_text())
    content["global_test"]["p_value"] = p
    (target / "diagnosis.json").write_text(json.dumps(content))
    facts = {fact.name: fact.value for section in document_of_folder(target).sections for fact in section.key_figures}
    assert facts["global test, two-sided p"] == shown


def test_names_are_escaped_everywhere(tmp_path: Path) -> None:
    made = samples.recording()
    setup = made.setup.model_copy(update={"title": MARKUP})
    write(made.replace(setup=setup), tmp_path / "recording")
    target = samples.diagnosis_folder(tmp_path / "other")
    broken = json.loads((target / "diagnosis.json").read_text())
    broken["summary"] = broken["findings"][0]["effect"] = broken["findings"][0]["separate_by"] = MARKUP
    broken["findings"][0]["where"]["stations"] = [MARKUP]
    (target / "diagnosis.json").write_text(json.dumps(broken))
    for place in (tmp_path / "recording", target):
        html = report(place).read_text()
        reader = parsed(html)
        assert reader.handlers == []
        assert "x" not in reader.loads
        assert "<img src=x" not in html
        assert any(MARKUP.replace("&amp;", "&") in text or MARKUP in text for text in reader.text)


def test_page_is_the_same_twice(folder: Path, contents: dict[str, Document]) -> None:
    page = report(folder / "diagnosis")
    assert page.read_text() == page_html(contents["diagnosis"])
    page.unlink()


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("diagnosis.json", "{", "not JSON"),
        ("diagnosis.json", '{"format": "ltsim-diagnosis/9"}', "ltsim-diagnosis/1"),
        ("diagnosis.json", '{"format": "ltsim-diagnosis/1"}', "verdict"),
        ("calibration.json", '{"format": "ltsim-calibration/1"}', "construction"),
        ("calibration.json", "[1]", "no JSON object"),
        ("observations.csv", "station,target\n", "observations.csv"),
    ],
)
def test_broken_input_gets_a_sentence_and_no_page(name: str, text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(RecordError, match=words):
        report(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == [name]


def test_nothing_to_report_is_reported(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match="contains no results"):
        report(tmp_path)
    with pytest.raises(RecordError, match="does not exist"):
        report(tmp_path / "missing")


def test_campaign_tells_improvement_and_coverage(tmp_path: Path) -> None:
    content = document_of_folder(samples.campaign_folder(tmp_path / "campaign"))
    assert content.summary.startswith(
        "Over 60 trials for each of 2 combinations of factor levels (noise factor), calibration reduces"
    )
    titles = [block.title for block in content.sections[0].blocks]
    assert {"Disagreement in distances, reduction", "Convergence of the trials", "z-scores of the parameters"} <= set(
        titles
    )
    assert any(title.startswith("Coverage: network") for title in titles)
    html = page_html(content)
    assert "Seed 11." in html
    assert parsed(html).handlers == []


def test_a_sweep_reads_without_its_maker(tmp_path: Path) -> None:
    """Short names with units, lines over a factor, where it is best, and the paper's figures in sentences."""
    section = document_of_folder(samples.sweep_folder(tmp_path / "sweep")).sections[0]
    assert "for each of 27 combinations of factor levels (targets, angle noise and repeats)," in section.summary
    assert (
        "The error of the targets is smallest with" in section.summary
        and "(targets 24, angle noise 0.2 arcsec, repeats 4)" in section.summary
    )
    pictures = {block.title: block for block in section.blocks if block.kind == "picture"}
    words = pictures["Disagreement in distances, reduction"].caption
    assert "The published value 40.1 is dashed" in words and "90 % of the trials" in words
    assert "Error of the targets" in pictures
    tables = {block.title: block for block in section.blocks if block.kind == "table"}
    varied = tables["What was varied"].rows
    assert varied[1][:2] == ["angle noise [arcsec]", "0.2, 0.4, 0.8"]
    assert varied[2][2:] == [
        "work.repeats",
        "Number of rounds at each station; each round points once at every target in each face.",
    ]
    ends = tables["Convergence of the trials"]
    assert list(ends.header[:4]) == ["targets", "angle noise [arcsec]", "repeats", "method"]
    assert len({tuple(row[:3]) for row in ends.rows}) == 27


def test_damaged_campaign_is_refused(tmp_path: Path) -> None:
    folder = samples.campaign_folder(tmp_path / "campaign")
    shard = next(folder.glob("rows/*/*.parquet"))
    shard.write_bytes(shard.read_bytes()[:200])
    with pytest.raises(LtsimError, match="shard"):
        report(folder)
    assert not (folder / "report.html").exists()


def test_plan_shows_where_the_tripod_goes(tmp_path: Path) -> None:
    content = document_of_folder(samples.plan_folder(tmp_path / "plan"))
    blocks = {block.title: block for block in content.sections[0].blocks}
    table = blocks["Positions of the tripod"]
    assert table.kind == "table"
    assert [row[0] for row in table.rows] == ["S1", "S2", "S3", "S4", "S5"]
    wanted = {"Floor plan", "The hall in 3D", "Time against quality: instrument", "Reasons for this plan"}
    assert wanted <= set(blocks)
    assert "Seed 5." in page_html(content)


def test_history_says_whether_the_instrument_has_changed(tmp_path: Path) -> None:
    content = document_of_folder(samples.history_folder(tmp_path / "history"))
    assert content.summary.startswith("Over 3 calibrations from jan to sep the instrument has changed since the first")
    assert content.assessment == "bad"
    blocks = {block.title: block for block in content.sections[0].blocks}
    assert {
        "Course of the parameters",
        "Parameters",
        "Changes between calibrations",
        "Fits of the calibrations",
    } == set(blocks)
    changes = blocks["Changes between calibrations"]
    assert changes.kind == "table"
    assert [row[:2] for row in changes.rows] == [["jan", "may"], ["may", "sep"], ["jan", "sep"]]
    assert changes.marked_rows == {1, 2}
    reader = parsed(page_html(content))
    assert reader.handlers == []
    assert any(load.startswith("data:image/svg") for load in reader.loads)


def test_the_first_screen_of_a_diagnosis_is_short_and_the_details_follow(tmp_path: Path) -> None:
    folder = samples.diagnosis_folder(tmp_path)
    document, content = document_of_folder(folder), json.loads((folder / "diagnosis.json").read_text())
    assert len(document.summary) < 400
    assert document.summary.startswith("The readings contradict the model: ")
    assert "ause: " in document.summary and "probability" in document.summary
    assert document.summary.endswith(f"What to do: {document.next_actions[0]}")
    details = next(block for section in document.sections for block in section.blocks if block.title == "Details")
    assert content["summary"][1:] in details.text


def test_coordinates_of_a_moved_target_are_reported_as_before_its_motion(tmp_path: Path) -> None:
    target = samples.diagnosis_folder(tmp_path)
    content = json.loads((target / "diagnosis.json").read_text())
    where = {"observables": [], "stations": [], "targets": ["T05"], "covariates": []}
    content["findings"] = [content["findings"][0] | {"effect": "target-moved", "where": where, "separate_by": ""}]
    (target / "diagnosis.json").write_text(json.dumps(content))
    *_, use = document_of_folder(target).next_actions
    assert use.endswith(" The coordinates of T05 refer to the time before the motion.")


def test_next_measurement_stands_first(tmp_path: Path) -> None:
    content = document_of_folder(samples.next_folder(tmp_path / "next"))
    proposals = json.loads((tmp_path / "next" / "next.json").read_text())["proposals"]
    assert content.summary.startswith(f"Measure next: {proposals[0]['action']} (")
    table = next(block for block in content.sections[0].blocks if block.kind == "table")
    assert [row[0] for row in table.rows] == [p["action"] for p in proposals]
    assert all(f"{p['remaining_sigma_fraction']:.2f}" == row[2] for p, row in zip(proposals, table.rows, strict=True))


def test_next_measurement_says_what_it_decides(tmp_path: Path) -> None:
    content = document_of_folder(samples.next_folder(tmp_path / "next", between=("range-step", "station-weather")))
    best = json.loads((tmp_path / "next" / "next.json").read_text())["proposals"][0]
    pair = [effect_title(name) for name in ("range-step", "station-weather")]
    begin = [best["action"]] if best["separated_effects"] else pair
    assert all(words.lower() in content.summary.lower() for words in begin)
    assert "Separation of the alternatives" in [block.title for block in content.sections[0].blocks]


def test_damaged_history_and_proposals_are_refused(tmp_path: Path) -> None:
    (tmp_path / "history.json").write_text('{"format": "ltsim-history/1", "calibrations": []}')
    with pytest.raises(RecordError, match="calibrations"):
        report(tmp_path)
    (tmp_path / "history.json").unlink()
    (tmp_path / "next.json").write_text('{"format": "ltsim-next/1", "proposals": []}')
    with pytest.raises(RecordError, match="proposals"):
        report(tmp_path)
    assert not (tmp_path / "report.html").exists()


def test_calibration_reports_rejected_readings_and_estimated_noise(tmp_path: Path) -> None:
    made = samples.recording()
    readings = made.readings.copy()
    readings[20, 0] += 3e-4
    calibration = calibrate_network(
        made.with_readings(readings), recommend_measurements=False, robust=True, noise_from_data=True
    )
    write_calibration(calibration, tmp_path / "cal")
    content = document_of_folder(tmp_path / "cal")
    assert "the noise was estimated from the same readings" in content.summary
    assert "1 reading did not fit and were left out" not in content.summary
    assert "1 reading did not fit and was left out" in content.summary
    blocks = {block.title: block for block in content.sections[0].blocks}
    noise, gone = blocks["Noise estimated from the readings"], blocks["Outlying readings"]
    assert noise.kind == gone.kind == "table"
    assert [row[0] for row in noise.rows] == ["distance", "azimuth", "elevation"]
    assert [row[-1] for row in gone.rows] == ["yes"]
    plain = calibrate_network(made.with_readings(readings), recommend_measurements=False)
    write_calibration(plain, tmp_path / "plain")
    note = next(b for b in document_of_folder(tmp_path / "plain").sections[0].blocks if b.title == "Verdict")
    assert note.kind == "note"
    assert note.text.startswith("One reading is an outlier. Trust the ")


def test_a_predicted_acceptance_test_is_not_called_passed(tmp_path: Path) -> None:
    specification = {"format": "ltsim-acceptance/1", "standard": "asme-b89.4.19-2006", "instrument": "leica-at500"}
    (tmp_path / "my.toml").write_text("\n".join(f'{key} = "{value}"' for key, value in specification.items()))
    assert run(["accept", str(tmp_path / "my.toml"), "--out", str(tmp_path / "out"), "-q"]) == 0
    shown = document_of_folder(tmp_path / "out")
    assert shown.headline == "The tracker is likely to pass all tests." and "probability of" in shown.summary
    assert dict(shown.header_lines)["instrument"] == "Leica Absolute Tracker AT500"


def test_a_check_has_its_tests_in_a_table(tmp_path: Path) -> None:
    write_result(tmp_path, check(samples.recording()))
    (section,) = document_of_folder(tmp_path).sections
    (table,) = (block for block in section.blocks if block.kind == "table")
    assert list(table.header)[:3] == ["station", "test", "result"]
    assert len(table.rows) == int(section.key_figures[0].value)
    assert (
        section.title.startswith("Check in the field: ")
        and section.summary.startswith("Go: ")
        and not section.next_actions
    )


@pytest.mark.parametrize(
    ("kind", "action"),
    [
        ("network", "Run ltsim diagnose to locate the disagreement of the stations."),
        ("reference", "Check the reference values at T08 in their source, and correct the wrong one."),
    ],
)
def test_the_action_after_a_failed_check_belongs_to_the_failed_test(kind: str, action: str, tmp_path: Path) -> None:
    content = check(samples.recording())
    failed = content.items[0].model_copy(update={"passed": False, "kind": kind, "targets": ("T08",)})
    content = content.model_copy(update={"passed": False, "items": (failed, *content.items[1:])})
    (tmp_path / "check.json").write_text(content.text())
    (section,) = document_of_folder(tmp_path).sections
    assert section.next_actions == [action]


def test_the_page_of_a_diagnosis_needs_no_3d(folder: Path, tmp_path: Path) -> None:
    """It opens in a few seconds and takes 200 MB; what draws 3D takes 300 more."""
    alone = shutil.copytree(folder / "diagnosis", tmp_path / "diagnosis")
    write(samples.recording(), alone / "recording")
    code = f"import sys, ltsim as lt; lt.report({str(alone)!r}); print('pyvista' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
    assert "Floor plan" in {block.title for section in document_of_folder(alone).sections for block in section.blocks}


def test_targets_without_a_height_are_reported_in_plan() -> None:
    sigmas, open_ = [1e-6, 2e-6, 2e-6], [3e-3, 4e-3, np.nan]
    assert target_uncertainty_sentence(np.array([sigmas, sigmas])) == (
        "Expanded uncertainty of a target in space: U = 6.0 um (k = 2), 6.0 um for the worst."
    )
    sentence = target_uncertainty_sentence(np.array([sigmas, open_, open_]))
    assert sentence == "Expanded uncertainty of a target in plan: U = 10000 um (k = 2), 10000 um for the worst."
    assert not target_uncertainty_sentence(np.full((2, 3), np.nan))


def test_the_agreement_after_a_correction_is_not_that_of_the_calibration_alone(tmp_path: Path) -> None:
    """A scale error of 20 ppm at a set-up causes most of the disagreement; its correction is stated with it."""
    recording, _ = lt.simulate("paper-workshop", seed=7)
    readings = recording.readings.copy()
    readings[recording.station == 2, 0] *= 1.0 + 20e-6
    write_calibration(lt.calibrate(recording.with_readings(readings)), tmp_path)
    summary = document_of_folder(tmp_path).summary
    assert "better than before" in summary and "), by the calibration and the correction of 1 error." in summary


def test_criteria_say_that_the_readings_contain_a_corrected_error(tmp_path: Path) -> None:
    recording, _ = lt.simulate("paper-workshop", seed=7)
    readings = recording.readings.copy()
    readings[recording.station == 2, 0] += 0.011
    for name, made in (("wrong", recording.with_readings(readings)), ("right", recording)):
        write_calibration(lt.adjust(made), tmp_path / name)
        (section,) = document_of_folder(tmp_path / name).sections
        (note,) = (getattr(block, "note", "") for block in section.blocks if block.title == "Criteria")
        assert ("from which it is computed, contain the errors that the model corrects" in note) == (name == "wrong")


def test_a_calibration_with_a_corrected_error_is_not_called_consistent(tmp_path: Path) -> None:
    content = adjust(samples.recording()).model_copy(update={"fit_with_constants": None})
    content = content.model_copy(update={"fit": content.fit.model_copy(update={"p_value": 0.4})})
    where = CausePlace(stations=("S2",))
    fault = CauseTest(kind="constant-offset", acts_on="distance", where=where, statistic=99.0, dof=1, sigma=0.1)
    for tests, headline in (((), "is consistent."), ((fault,), "after the correction of an error.")):
        write_calibration(content.model_copy(update={"tests": tests}), tmp_path / str(len(tests)))
        shown = document_of_folder(tmp_path / str(len(tests)))
        assert shown.headline.endswith(headline)
        assert ("The model corrects 1 error at S2, with 1 degree of freedom." in shown.summary) == bool(tests)
    assert shown.assessment == "caution"
    assert shown.next_actions[0] == "Check the SMR and the distance constant at S2; correct the wrong one."


def test_a_rejected_calibration_sends_to_the_coordinates_of_the_diagnosis(tmp_path: Path) -> None:
    """The first action after a misfit was to look for a scatter that the fit did not support."""
    content = adjust(samples.recording()).model_copy(update={"fit_with_constants": None, "noise_estimated": False})
    content = content.model_copy(update={"fit": content.fit.model_copy(update={"p_value": 1e-9})})
    fault = CauseTest(kind="centring", acts_on="position", where=CausePlace(stations=("S2",)), statistic=99.0, dof=1)
    diagnose = "Run ltsim diagnose to locate the disagreement of readings and model, and use its coordinates."
    for is_in_model, place in ((True, 1), (False, 0)):
        tests = (fault.model_copy(update={"is_in_model": is_in_model}),)
        write_calibration(content.model_copy(update={"tests": tests}), tmp_path / str(place))
        assert document_of_folder(tmp_path / str(place)).next_actions.index(diagnose) == place
