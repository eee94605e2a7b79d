"""Links among the outputs of all verbs: nothing outside of the output folder is written, removed or truncated."""

from __future__ import annotations

import os
import shutil
from inspect import signature
from pathlib import Path
from typing import Any

import pytest

from ltsim.cli.main import COMMANDS, command_function, run
from ltsim.cli.options import _output_option_checks, typer_command
from ltsim.cli.output_checks import COMPARED_FILE_OUTPUT, NEW_FILE_OUTPUT
from ltsim.recordings import write
from ltsim.simulation.scenario import load_scenario
from ltsim.simulation.simulator import simulate
from tests.cli.slips import ACCEPTANCE, BENCH, CAMPAIGN, PLAN, SCENARIO, TASKS
from tests.cli.test_outputs import command

LONG_WORDS = {
    ("campaign", "out"): "campaign campaign.toml --out out",
    ("demo", "out"): "demo --out out",
    ("diagnose", "out"): "diagnose rec --no-held-out --out out",
    ("history", "out"): "history cal earlier --out out",
    ("plan", "out"): "plan plan.toml --jobs 1 --out out",
    ("report", "folder"): "report out",
    ("calibrate", "out"): "calibrate rec --out out",
    ("uncertainty", "out"): "uncertainty tasks.toml --out out",
    ("accept", "out"): "accept acceptance.toml --out out",
    ("adjust", "out"): "adjust rec --out out",
    ("check", "out"): "check rec --out out",
    ("compare", "out"): "compare rec rec --out out",
}
WORDS = {
    ("bench", "out"): "bench bench.csv --out out",
    ("convert", "destination"): "convert rec out",
    ("correct", "out"): "correct rec --calibration cal --out out",
    ("evaluate", "out"): "evaluate rec --out out",
    ("examples", "folder"): "examples out",
    ("inject", "out"): "inject rec beam-tilt --out out",
    ("recover", "out"): "recover scenario.toml --trials 2 --out out",
    ("simulate", "out"): "simulate paper-workshop --out out",
    ("verify", "out"): "verify rec --nominal nominal.csv --calibration cal --out out",
}
"""Verb with an output folder, by verb and name of the output."""
SERVED = {("view", "out")}
"""Outputs that a server writes, with its own test."""
EVERY_VERB = [
    *((words, ()) for words in WORDS.values()),
    *((words, pytest.mark.long) for words in LONG_WORDS.values()),
]
PARAMETERS = [pytest.param(words, marks=marks, id=words.split()[0]) for words, marks in EVERY_VERB]


def folder_outputs() -> set[tuple[str, str]]:
    """Verb and name of each output that is a folder."""
    return {
        (verb, name)
        for verb in COMMANDS
        for name, _, output in _output_option_checks(
            [*signature(typer_command(command_function(verb))).parameters.values()]
        )
        if output not in (COMPARED_FILE_OUTPUT, NEW_FILE_OUTPUT)
    }


def test_every_output_folder_of_every_verb_is_tried() -> None:
    assert {*WORDS, *LONG_WORDS} | SERVED == folder_outputs()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    samples = {"plan": PLAN, "campaign": CAMPAIGN, "tasks": TASKS, "acceptance": ACCEPTANCE, "scenario": SCENARIO}
    for name, text in samples.items():
        (folder / f"{name}.toml").write_text(text)
    (folder / "bench.csv").write_text(BENCH)
    whole, _ = simulate(load_scenario("paper-workshop"), 1)
    write(whole, folder / "rec")
    assert run(["calibrate", str(folder / "rec"), "--out", str(folder / "cal"), "-q"]) == 0
    earlier = ["--without", "beam-tilt", "--out", str(folder / "earlier"), "-q"]
    assert run(["calibrate", str(folder / "rec"), *earlier]) == 0
    rows = [",".join(row.split(",")[:4]) for row in (folder / "cal" / "targets.csv").read_text().splitlines()[1:11]]
    (folder / "nominal.csv").write_text("target,x_mm,y_mm,z_mm\n" + "\n".join(rows) + "\n")
    return folder


def contents(folder: Path) -> dict[str, bytes | None]:
    """Contents of the files below a folder; None for what is no file."""
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in sorted(folder.rglob("*"))}


def forced(words: str, *, resumes: bool = False) -> str:
    """The verb with permission to replace files, or to continue where it can."""
    options = {p.name for p in command(words.split()[0]).params}
    return f"{words} {'--resume' if resumes and 'resume' in options else '--force'}"


@pytest.mark.timeout(900)
@pytest.mark.parametrize("words", PARAMETERS)
def test_nothing_outside_of_an_output_folder_changes(
    words: str, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    """Each file and folder in turn is a link, with and without --force; then all files have a second name outside."""
    work, outside, whole = tmp_path / "work", tmp_path / "outside", tmp_path / "whole"
    shutil.copytree(made, work)
    monkeypatch.chdir(work)
    out = work / "out"
    if words.startswith("report"):
        shutil.copytree(work / "cal", out)
    assert run([*words.split(), "-q"]) in (0, 1)
    shutil.copytree(out, whole)
    entries = [p for p in sorted(whole.rglob("*")) if len(p.relative_to(whole).parts) <= 2]
    if words.startswith("demo"):  # the others are refused when they are written, after a minute
        entries = [p for p in entries if p.parent == whole or p.name == "recording"]
    elif words.startswith("report"):
        entries = [whole / "report.html"]

    def tried(arguments: list[str]) -> int:
        before = contents(outside)
        capsys.readouterr()
        status = run([*arguments, "-q"])
        error_text = capsys.readouterr().err
        assert status in (0, 1, 2) and error_text.count("error: ") == (status == 2) and "Traceback" not in error_text, (
            error_text
        )
        assert contents(outside) == before, (arguments, error_text)
        return status

    for entry in entries:
        same = outside / entry.relative_to(whole)
        for target in (same, outside / "nothing", outside, Path(entry.name)):
            for arguments in dict.fromkeys((words, forced(words), forced(words, resumes=True))):
                shutil.rmtree(out)
                shutil.rmtree(outside, ignore_errors=True)
                shutil.copytree(whole, out)
                shutil.copytree(whole, outside)
                place = out / entry.relative_to(whole)
                shutil.rmtree(place) if place.is_dir() else place.unlink()
                place.symlink_to(target)
                tried(arguments.split())
    for resumes in (False, True):
        shutil.rmtree(out)
        shutil.rmtree(outside)
        shutil.copytree(whole, outside)
        shutil.copytree(
            whole, out, copy_function=lambda path, copy: os.link(outside / Path(path).relative_to(whole), copy)
        )
        for path in out.rglob("*.parquet"):
            if resumes:
                path.unlink()  # computed anew, and its digest appended
        tried(forced(words, resumes=resumes).split())
