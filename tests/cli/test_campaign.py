from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from ltsim.cli.main import run
from ltsim.recordings.settings import read_toml

FILE = """
format = "ltsim-campaign/1"
title = "two noise levels"
trials = 300
trials_per_shard = 256
verified_trials_per_shard = 1

[grid]
"instrument.noise_factor" = [1.0, 2.0]
"""


@pytest.mark.long
def test_campaign_answers_in_tables_and_writes_a_summary(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "noise.toml"
    file.write_text(FILE)
    assert run(["campaign", str(file)]) == 0
    output = capsys.readouterr().out
    assert "\nnoise factor   method" in output and "share removed" in output
    with (tmp_path / "noise" / "summary.csv").open(newline="") as stream:
        lines = list(csv.DictReader(stream))
    share = [float(line["mean"]) for line in lines if line["column"] == "share_removed"]
    assert [line["noise_factor"] for line in lines if line["column"] == "share_removed"] == ["1", "2"]
    assert len(share) == 2 and 0.5 < share[1] < share[0] < 1.0
    assert run(["campaign", str(file)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert run(["campaign", str(file), "--resume", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert [end["trials"] for end in answer["solver_comparisons"]] == [300, 300]


def test_disagreement_with_the_full_solver_is_exit_status_1(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "noise.toml"
    file.write_text(FILE)
    monkeypatch.setattr("ltsim.campaigns.trial_calibrators.BatchCalibrator.largest_solver_difference", lambda *_: 0.01)
    assert run(["campaign", str(file), "--quiet"]) == 1


def test_the_campaign_file_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, read_files = tmp_path / "noise.toml", []
    file.write_text(FILE.replace("trials = 300", "trials = 2").replace("[1.0, 2.0]", "[1.0]"))

    def read_and_count(path: Path, kind: str) -> dict[str, Any]:
        read_files.append(path)
        return read_toml(path, kind)

    monkeypatch.setattr("ltsim.campaigns.spec.read_toml", read_and_count)
    assert run(["campaign", str(file), "--quiet"]) == 0
    assert read_files == [file]


def test_a_wrong_campaign_file_is_exit_status_two(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "wrong.toml"
    file.write_text('format = "ltsim-campaign/2"\n')
    assert run(["campaign", str(file)]) == 2
    assert "ltsim-campaign/1" in capsys.readouterr().err
    assert run(["campaign", str(tmp_path / "missing.toml")]) == 2


@pytest.mark.long
def test_the_example_can_be_printed_and_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["campaign", "--show"]) == 0
    file = tmp_path / "example.toml"
    file.write_text(capsys.readouterr().out.replace("trials = 10000", "trials = 64"))
    assert run(["campaign", str(file)]) == 0
    output = capsys.readouterr().out
    assert any(line.split()[:2] == ["0.5", "paper"] for line in output.splitlines())
    assert run(["campaign"]) == 2
