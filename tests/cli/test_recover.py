"""`ltsim recover` passes where the model holds and fails, naming the culprit, where it does not."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import pytest

from ltsim.cli.main import run
from ltsim.simulation.builtin import builtin_text

WOBBLE = """
[[effects]]
name = "bearing-wobble"
draw = true
"""


def test_passes_on_the_paper_workshop(capsys, tmp_path: Path) -> None:
    assert run(["recover", "paper-workshop-re-aimed", "--trials", "20", "--out", str(tmp_path), "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["passed"]
    assert content["trials"] == content["trials_with_result"] == 20
    assert json.loads((tmp_path / "recovery.json").read_text()) == content
    rows = (tmp_path / "trials.csv").read_text().splitlines()
    assert len(rows) == 1 + 20 * 16
    assert rows[0] == "trial,parameter,unit,truth,estimate,sigma,z,ltsim_estimate"


@pytest.mark.long
def test_fails_with_status_1_when_the_model_lacks_something(capsys, tmp_path: Path) -> None:
    file = tmp_path / "wobbly.toml"
    file.write_text(builtin_text("paper-workshop-two-face") + WOBBLE)
    assert run(["recover", str(file), "--trials", "20"]) == 1
    printed = capsys.readouterr()
    assert "chi-square fails: chi2/dof of all trials" in printed.err
    assert "recovered within" not in printed.out


def test_junit_names_every_check_and_what_failed(capsys, tmp_path: Path) -> None:
    file, junit = tmp_path / "wobbly.toml", tmp_path / "reports" / "junit.xml"
    file.write_text(builtin_text("paper-workshop-two-face") + WOBBLE)
    assert run(["recover", str(file), "--trials", "12", "--junit", str(junit), "--errors", "drawn", "-q"]) == 1
    suite = ElementTree.parse(junit).getroot()
    assert suite.tag == "testsuite"
    assert int(suite.attrib["tests"]) == len(suite)
    failed = [case for case in suite if case.find("failure") is not None]
    assert all(float(case.find("properties/property[@name='value']").attrib["value"]) < 1e6 for case in suite)
    assert float(suite.attrib["time"]) > 0
    assert int(suite.attrib["failures"]) == len(failed) > 0
    assert "recover.chi-square" in {case.attrib["classname"] for case in failed}
    assert run(["recover", "paper-workshop-re-aimed", "-n", "2", "--junit", str(junit), "-q"]) == 0
    junit.write_text(junit.read_text().replace("recover.", "own."))
    assert run(["recover", "paper-workshop-re-aimed", "-n", "2", "--junit", str(junit)]) == 2
    assert "junit.xml" in capsys.readouterr().err


def test_a_junit_file_that_cannot_be_written_is_reported_before_any_trial(capsys, monkeypatch) -> None:
    monkeypatch.setattr("ltsim.recover", lambda *_, **__: pytest.fail("trials were run"))
    assert run(["recover", "paper-workshop-re-aimed", "-n", "2", "--junit", "/proc/nowhere.xml"]) == 2
    assert "nowhere.xml: the path cannot be written" in capsys.readouterr().err


def test_a_construction_that_does_not_fit_the_scenario(capsys, tmp_path: Path) -> None:
    assert run(["recover", "paper-workshop-re-aimed", "--construction", "dh", "--trials", "2"]) == 2
    assert "recover with the same construction" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.parametrize("jobs", ["2"])
def test_the_same_for_any_number_of_workers(jobs: str, capsys, tmp_path: Path) -> None:
    for count, place in (("1", "one"), (jobs, "more")):
        run(["recover", "paper-workshop-re-aimed", "-n", "6", "--jobs", count, "--out", str(tmp_path / place), "-q"])
    first_file, more = (tmp_path / place / "trials.csv" for place in ("one", "more"))
    assert first_file.read_bytes() == more.read_bytes()
