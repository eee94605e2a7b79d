"""Committed results come from a commit that exists, from a clean tree, and are small; the driver sees to it."""

from __future__ import annotations

import json
import subprocess
from importlib import import_module
from pathlib import Path

import pytest

import experiments.__main__ as driver
from experiments import common

MOST_BYTES = 3_000_000


def git(root: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def history(root: Path) -> Path:
    """The checkout, where its history is there."""
    if git(root, "rev-parse", "--is-shallow-repository").stdout.strip() != "false":
        pytest.skip("no checkout with its history: commits cannot be looked up")
    return root


def committed(root: Path) -> list[Path]:
    return [root / name for name in git(root, "ls-files", "results").stdout.splitlines()]


def test_every_result_says_where_it_comes_from(history: Path) -> None:
    for file in committed(history):
        over = [folder for folder in file.parents if history / "results" in folder.parents]
        assert any(any(folder.glob("manifest*.json")) for folder in over), file


def test_every_result_comes_from_a_commit_that_exists_and_a_clean_tree(history: Path) -> None:
    wrong = []
    for file in (f for f in committed(history) if f.name.startswith("manifest")):
        content = json.loads(file.read_text(encoding="utf-8"))
        made = git(history, "merge-base", "--is-ancestor", str(content.get("commit")), "HEAD").returncode == 0
        if not made or content.get("uncommitted_changes") is not False or not content["command"]:
            wrong.append(f"{file.relative_to(history)}: {content.get('commit')}")
    assert not wrong, "\n".join(wrong)


def test_every_figure_is_listed_with_what_it_shows(history: Path) -> None:
    listed = (history / "experiments" / "README.md").read_text(encoding="utf-8")
    assert [f.name for f in committed(history) if f.suffix in (".svg", ".png") and f.name not in listed] == []


def test_results_are_small(history: Path) -> None:
    assert sum(f.stat().st_size for f in committed(history) if f.is_file()) < MOST_BYTES


def test_committed_results_are_refused_where_sources_are_not_committed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(common, "uncommitted_changes", lambda: " M ltsim/core/units.py")
    with pytest.raises(SystemExit, match=r"units\.py.*--out"):
        driver.run_experiment("07", [], 2, 1, None)
    with pytest.raises(SystemExit, match="--out"):
        driver.run_all(common.RESULTS, 1)
    common.require_committed_sources(Path("/elsewhere/results"))


@pytest.mark.long
def test_all_goes_on_where_it_was_broken_off(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line of all.toml runs, another lacks its recordings; the second time nothing runs."""
    runs = (
        '[[run]]\nwords = ["07"]\ntrials = 2\nminutes = 1\n[[run]]\nwords = ["11"]\nminutes = 2\nneeds = "not/there"\n'
    )
    (tmp_path / "all.toml").write_text(runs)
    monkeypatch.setattr(driver, "LIST", tmp_path / "all.toml")
    monkeypatch.setattr(driver, "MARKS", tmp_path / "marks")
    driver.run_all(tmp_path / "out", 1)
    first = capsys.readouterr().out
    assert "07, about 1 min: took" in first and "11, about 2 min: skipped" in first
    assert json.loads(next((tmp_path / "out").glob("07_*/manifest.json")).read_text())["trials"] == 2
    driver.run_all(tmp_path / "out", 1)
    assert "07, about 1 min: skipped" in capsys.readouterr().out


@pytest.mark.parametrize("name", [folder.name for folder in driver.FOLDERS.values()])
def test_every_experiment_can_be_started(name: str) -> None:
    """Its module is there and fits the package as it is: what it imports exists."""
    assert callable(import_module(f"experiments.{name}.run").run)


def test_the_list_of_all_names_every_experiment_but_the_examination() -> None:
    listed = {line["words"][0] for line in driver.lines_of_all()}
    assert listed == set(driver.FOLDERS) - {"20"}
