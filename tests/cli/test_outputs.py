"""Every place that a verb writes to is looked at before the verb begins."""

from __future__ import annotations

import os
import re
from inspect import signature
from pathlib import Path
from typing import Any

import pytest
import typer

from ltsim.cli.main import COMMANDS, command_function, run
from ltsim.cli.options import _output_option_checks, typer_command

INPUTS = {
    "after", "against", "cad", "calibration", "control", "file", "frame", "history", "nominal", "place", "plan",
    "prior", "recording", "scenario", "second", "source", "sources",
}  # fmt: skip
"""Paths that verbs read; `nominal` is written by `simulate`."""


def command(verb: str) -> Any:
    """The verb as the parser knows it."""
    made = typer.Typer(add_completion=False)
    made.command(verb)(typer_command(command_function(verb)))
    return typer.main.get_command(made)


def outputs_of(verb: str) -> dict[str, str]:
    """Spelling of the options and arguments of a verb that are marked as outputs, by name."""
    return {
        name: flag
        for name, flag, _ in _output_option_checks(
            [*signature(typer_command(command_function(verb))).parameters.values()]
        )
    }


def inputs_of(verb: str) -> list[str]:
    """Names of the options and arguments of a verb that are paths and not marked as outputs."""
    parameters = signature(typer_command(command_function(verb))).parameters
    paths = {p.name for p in command(verb).params if re.search("FILE|DIR|REC|IN$|OUT$|SCENARIO", p.metavar or "")}
    paths |= {name for name, parameter in parameters.items() if "Path" in str(parameter.annotation)}
    return sorted(paths - outputs_of(verb).keys())


OUTPUTS = [(verb, name, flag) for verb in COMMANDS for name, flag in outputs_of(verb).items()]


@pytest.mark.parametrize("verb", COMMANDS)
def test_every_path_is_marked_as_an_output_or_listed_as_an_input(verb: str) -> None:
    assert {*inputs_of(verb)} <= INPUTS


def arguments_of(verb: str, name: str, place: Path) -> list[str]:
    """The verb with an output at a place, its inputs missing."""
    words = [verb]
    for parameter in command(verb).params:
        value = str(place) if parameter.name == name else "no-such-input"
        if parameter.name == name or parameter.required:
            words += [value] if parameter.param_type_name == "argument" else [parameter.opts[0], value]
    return words


def parent_is_a_file(folder: Path) -> Path:
    (folder / "file").write_text("mine")
    return folder / "file" / "below" / "place"


def no_folder_can_be_made(folder: Path) -> Path:
    if not Path("/proc/self").exists():
        pytest.skip("there is no folder at hand that nobody can write to")
    return Path("/proc/self/nothing/place")


def name_is_too_long(folder: Path) -> Path:
    return folder / "new" / ("x" * 300) / "place"


def link_leads_nowhere(folder: Path) -> Path:
    (folder / "link").symlink_to(folder / "nowhere" / "deep")
    return folder / "link" / "place"


def link_goes_in_circles(folder: Path) -> Path:
    (folder / "one").symlink_to(folder / "two")
    (folder / "two").symlink_to(folder / "one")
    return folder / "one"


FAULTS = (parent_is_a_file, no_folder_can_be_made, name_is_too_long, link_leads_nowhere, link_goes_in_circles)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
@pytest.mark.parametrize(("verb", "name", "flag"), OUTPUTS)
def test_a_place_that_cannot_be_written_is_refused_before_the_inputs_are_read(
    verb: str, name: str, flag: str, fault: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    place = fault(tmp_path)
    before = sorted(map(str, tmp_path.rglob("*")))
    assert run(arguments_of(verb, name, place)) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(f"error: {place}")
    assert captured.err.count("\n") == 1
    assert sorted(map(str, tmp_path.rglob("*"))) == before


@pytest.mark.parametrize(("verb", "name", "flag"), OUTPUTS)
def test_a_file_is_no_folder_and_a_folder_no_file(
    verb: str, name: str, flag: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder" / "report.html").mkdir(parents=True)
    (tmp_path / "file").write_text("mine")
    messages = []
    for place in ("folder", "file")[verb == "examples" :]:  # which goes beside what is there
        forced = ["--force"] if "force" in {p.name for p in command(verb).params} else []
        assert run([*arguments_of(verb, name, Path(place)), *forced]) == 2
        messages.append(capsys.readouterr().err)
    assert [line for line in messages if "expected a f" in line or "Not a directory" in line]
    assert (tmp_path / "file").read_text() == "mine"


def test_two_outputs_at_the_same_place_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = str(tmp_path / "one")
    assert run(["simulate", "paper-workshop", "--out", place, "--truth", place]) == 2
    assert "--out and --truth both name" in capsys.readouterr().err
    for verb, option, name in (("simulate", "--truth", "setup.toml"), ("recover", "--junit", "trials.csv")):
        assert run([verb, "paper-workshop", "--out", place, option, f"{place}/{name}"]) == 2
        assert "a result of --out could overwrite" in capsys.readouterr().err
    assert not os.path.lexists(place)
    assert run(["simulate", "paper-workshop", "--out", place, "--truth", f"{place}/truth.json", "-q"]) == 0


@pytest.mark.parametrize("force", [[], ["--force"]])
def test_nothing_is_written_through_a_link_that_leaves_the_folder(
    force: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    outside = tmp_path / "outside.csv"
    outside.write_text("mine")
    (tmp_path / "out").mkdir()
    for name, verb in (("setup.toml", "simulate"), ("recovery.json", "recover")):
        (tmp_path / "out" / name).symlink_to(outside)
        assert run([verb, "paper-workshop", "--out", str(tmp_path / "out"), *force]) == 2
        assert "is a link out of the folder" in capsys.readouterr().err
    (tmp_path / "truth.json").symlink_to("/etc/hostname")
    wanted = ["--out", str(tmp_path / "new"), "--truth", str(tmp_path / "truth.json"), *force]
    assert run(["simulate", "paper-workshop", *wanted]) == 2
    assert "is a link out of the folder" in capsys.readouterr().err
    assert outside.read_text() == "mine"
    assert not (tmp_path / "new").exists()
