"""Symbolic links at the places of all outputs: nothing outside of the folder that a user names is written."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from ltsim.cli.main import run
from tests.cli.test_outputs import OUTPUTS, arguments_of, command


def outside_of(folder: Path) -> Path:
    """Folder with a file and a pipe."""
    outside = folder / "outside"
    outside.mkdir()
    (outside / "file").write_text("mine")
    os.mkfifo(outside / "pipe")
    return outside


def contents(folder: Path) -> dict[str, str]:
    """Texts of the files below a folder; "" for what is no file."""
    return {str(p.relative_to(folder)): p.read_text() if p.is_file() else "" for p in sorted(folder.rglob("*"))}


@pytest.mark.parametrize("target", ["file", "nothing", "pipe", "hop"])
@pytest.mark.parametrize(("verb", "name", "flag"), OUTPUTS)
def test_no_output_is_written_through_a_link(
    verb: str, name: str, flag: str, target: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    """A place that is a link out of its folder is refused with --force, too."""
    outside = outside_of(tmp_path)
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    Path("hop").symlink_to(outside / "file")
    place = Path("place")
    place.symlink_to("hop" if target == "hop" else outside / target)
    reader = os.open(outside / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    before = contents(outside)
    forced = ["--force"] if "force" in {p.name for p in command(verb).params} else []
    assert run([*arguments_of(verb, name, place), *forced]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("error: ") == 1
    assert os.read(reader, 100) == b""
    os.close(reader)
    assert contents(outside) == before
    assert place.is_symlink()
