"""kill -9 while a verb writes: nothing half written has a name, and the same command works again."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from ltsim.cli.main import run
from ltsim.recordings import write
from ltsim.simulation.scenario import load_scenario
from ltsim.simulation.simulator import simulate

KILLED = """
import os, signal, sys
from ltsim.core import storage
from ltsim.cli.main import main

left, real = int(sys.argv.pop(1)), os.replace

def replace(*arguments):
    global left
    if not left:
        os.kill(os.getpid(), signal.SIGKILL)
    left -= 1
    real(*arguments)

storage.os.replace = replace
main()
"""
"""A verb that is killed before it gives its nth file a name."""
PLAN = """format = "ltsim-plan/1"
points = "points.csv"
[workshop]
size_mm = [6000, 4000, 3000]
[stations]
count = 2
[search]
starts = 1
grid_mm = 1500
"""
POINTS = "name,x_mm,y_mm,z_mm\n" + "".join(
    f"P{k},{1000 + 900 * (k % 5)},{1000 + 700 * (k // 2)},{500 + 300 * (k % 4)}\n" for k in range(7)
)
VERBS = {
    "convert": ["convert", "rec", "out"],
    "convert to a file": ["convert", "rec", "out/rec.txt", "--to", "polar-text"],
    "adjust": ["adjust", "rec", "--out", "out"],
    "diagnose": ["diagnose", "rec", "--no-held-out", "--out", "out"],
    "plan": ["plan", "hall.toml", "--jobs", "1", "--out", "out"],
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    whole, _ = simulate(load_scenario("paper-workshop"), 1)
    write(whole.select((whole.station < 3) & (whole.target < 10)), folder / "rec")
    (folder / "hall.toml").write_text(PLAN)
    (folder / "points.csv").write_text(POINTS)
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    """What a folder holds under names that are not hidden."""
    files = (p for p in folder.rglob("*") if p.is_file() and not p.name.startswith("."))
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in files}


@pytest.mark.parametrize("verb", [v if v == "plan" else pytest.param(v, marks=pytest.mark.long) for v in VERBS])
def test_a_verb_that_is_killed_while_it_writes_works_again(
    verb: str, inputs: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(inputs)

    def told(out: str) -> list[str]:
        return [re.sub("^out", str(tmp_path / out), word) for word in VERBS[verb]] + ["--quiet"]

    assert run(told("whole")) == 0
    whole = contents(tmp_path / "whole")
    for named in range(min(2, len(whole))):
        out = tmp_path / f"killed{named}"
        done = subprocess.run([sys.executable, "-c", KILLED, str(named), *told(out.name)], check=False)
        assert done.returncode == -signal.SIGKILL
        after = contents(out)
        assert len(after) <= named
        assert all(whole[name] == content for name, content in after.items())
        assert run(told(out.name)) == 0
        assert contents(out) == whole
        assert not [path for path in out.rglob("*") if path.name.startswith(".")]
