"""The workflow to copy is YAML that runs, with fewer trials than it asks for."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import yaml

from ltsim.cli.main import run


def test_the_workflow_runs_a_check_that_passes(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    workflow = yaml.safe_load((root / "docs" / "how-to" / "recovery.yml").read_text(encoding="utf-8"))
    (job,) = workflow["jobs"].values()
    commands = [step["run"] for step in job["steps"] if step.get("run", "").startswith("ltsim ")]
    artifacts = [step["with"]["path"] for step in job["steps"] if "upload-artifact" in step.get("uses", "")]
    assert len(commands) == len(artifacts) == 1
    monkeypatch.chdir(tmp_path)
    few = re.sub(r"--trials \d+", "--trials 8", re.sub(r"--jobs \d+", "--jobs 1", commands[0]))
    assert run(shlex.split(few)[1:]) == 0
    folder, junit = artifacts[0].split()
    assert (tmp_path / folder / "recovery.json").exists() and (tmp_path / junit).exists()
