"""`ltsim examples`: every file is whole, reads as what it is, and runs with the command beside it."""

from __future__ import annotations

import json
import shlex
import tomllib
from pathlib import Path

import pytest

import ltsim as lt
from ltsim.acceptance.spec import load_acceptance
from ltsim.campaigns.spec import load_campaign
from ltsim.cli.examples import COMMAND_BY_EXAMPLE_FILE, example_file_content
from ltsim.cli.main import run
from ltsim.core.errors import InputError
from ltsim.measurands.spec import load_tasks
from ltsim.planning.loading import load_plan


def test_all_files_are_written_and_read_as_what_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "mine"
    assert run(["examples", str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["files"] == sorted(
        COMMAND_BY_EXAMPLE_FILE, key=list(COMMAND_BY_EXAMPLE_FILE).index
    )
    assert {path.name for path in folder.iterdir()} == set(COMMAND_BY_EXAMPLE_FILE)
    survey = lt.read(folder / "survey.csv")
    assert len(survey) > 20
    plan, scenario = load_plan(folder / "machine-plan.toml")
    assert len(plan.listed_points) == len(scenario.targets) == 12
    assert load_campaign(folder / "campaign.toml", None)[0].trials > 1
    assert [task.name for task in load_tasks(folder / "uncertainty.toml").task] == ["length", "floor"]
    assert load_acceptance(folder / "acceptance.toml")
    assert len(lt.scenario(folder / "workshop.toml").stations) == 5
    assert run(["examples", str(folder), "-q"]) == 0
    (folder / "hall.csv").write_text("mine")
    assert run(["examples", str(folder)]) == 2 and "--force" in capsys.readouterr().err
    assert run(["examples", str(folder), "--force"]) == 0


@pytest.mark.long
@pytest.mark.parametrize("name", ["hall.csv", "uncertainty.toml", "acceptance.toml", "workshop.toml"])
def test_the_command_of_an_example_file_runs_unchanged(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["examples", ".", "--quiet"]) == 0
    command = COMMAND_BY_EXAMPLE_FILE[name] or "ltsim calibrate survey.csv --frame hall.csv --out calibrated"
    assert run([*shlex.split(command)[1:], "--quiet"]) in (0, 1)
    assert list(Path(command.split("--out ")[1].split()[0]).iterdir())


@pytest.mark.parametrize(("verb", "name"), [("uncertainty", "uncertainty.toml"), ("accept", "acceptance.toml")])
def test_templates_are_printed(verb: str, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([verb, "--show"]) == 0
    printed = capsys.readouterr().out
    assert printed == example_file_content(name) and tomllib.loads(printed)["format"]
    assert run([verb]) == 2
    assert f"ltsim {verb} --show prints a template" in capsys.readouterr().err


def test_a_campaign_in_python_takes_a_backend(tmp_path: Path) -> None:
    small = {"scenario": "paper-workshop", "trials": 2, "methods": [{"name": "network"}]}
    with pytest.raises(InputError, match="backend is slurm, expected local or dask"):
        lt.campaign(small, out=tmp_path / "out", backend="slurm")
    with pytest.raises(InputError, match="nowhere"):
        lt.campaign(small, out=tmp_path / "out", backend="dask", scheduler=str(tmp_path / "nowhere.json"))
