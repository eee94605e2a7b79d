"""kill -9 while a verb writes: nothing half written has a name, and the same command works again."""

from __future__ import annotations

import contextlib
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from ltsim.cli.main import run
from ltsim.core.randomness import random_stream
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
grid_step_mm = 1500
"""
POINTS = "name,x_mm,y_mm,z_mm\n" + "".join(
    f"P{k},{1000 + 900 * (k % 5)},{1000 + 700 * (k // 2)},{500 + 300 * (k % 4)}\n" for k in range(7)
)
VERBS = {
    "convert": ["convert", "rec", "out"],
    "convert to a file": ["convert", "rec", "out/rec.txt", "--to", "polar-text"],
    "adjust": ["adjust", "rec", "--out", "out"],
    "calibrate": ["calibrate", "rec", "--out", "out"],
    "diagnose": ["diagnose", "rec", "--no-held-out", "--out", "out"],
    "plan": ["plan", "hall.toml", "--jobs", "1", "--out", "out"],
    "report": ["report", "out"],
}
N_KILLS = 6
"""Number of random moments at which a verb is killed."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    whole, _ = simulate(load_scenario("paper-workshop"), 1)
    write(whole.select((whole.station < 3) & (whole.target < 10)), folder / "rec")
    (folder / "hall.toml").write_text(PLAN)
    (folder / "points.csv").write_text(POINTS)
    assert run(["calibrate", str(folder / "rec"), "--out", str(folder / "calibration"), "--quiet"]) == 0
    return folder


LONG_BASE64 = re.compile(rb"[A-Za-z0-9+/=]{1000,}")
"""The scene of a page, a compressed archive with the time of its files."""


def contents(folder: Path) -> dict[str, bytes]:
    """What a folder holds under names that are not hidden, without the scene of a page."""
    files = (p for p in folder.rglob("*") if p.is_file() and not p.name.startswith("."))
    return {p.relative_to(folder).as_posix(): LONG_BASE64.sub(b"", p.read_bytes()) for p in files}


def prepared(verb: str, inputs: Path, out: Path) -> Path:
    """Folder to which a verb writes: it is missing, or for a report it holds the results of a calibration."""
    if verb == "report":
        shutil.copytree(inputs / "calibration", out)
    return out


def words(verb: str, out: Path) -> list[str]:
    return [re.sub("^out", str(out), word) for word in VERBS[verb]] + ["--quiet"]


def require_whole_files(out: Path, whole: dict[str, bytes], before: dict[str, bytes]) -> int:
    """Number of files that are new in a folder; each is as a verb writes it, and no other has changed."""
    after = contents(out)
    assert all(content == before.get(name, whole.get(name)) for name, content in after.items())
    assert before.keys() <= after.keys()
    return len(after) - len(before)


def require_same_result(verb: str, out: Path, whole: dict[str, bytes]) -> None:
    """The same command after the kill writes the same files and leaves no others."""
    assert run(words(verb, out)) == 0
    assert contents(out) == whole
    assert not [path for path in out.rglob("*") if path.name.startswith(".")]


@pytest.mark.parametrize("verb", [v if v == "convert" else pytest.param(v, marks=pytest.mark.long) for v in VERBS])
def test_a_verb_that_is_killed_while_it_writes_works_again(
    verb: str, inputs: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(inputs)
    assert run(words(verb, prepared(verb, inputs, tmp_path / "whole" / "out"))) == 0
    whole = contents(tmp_path / "whole" / "out")
    before = contents(prepared(verb, inputs, tmp_path / "before" / "out"))
    for named in range(min(2, len(whole) - len(before))):
        out = prepared(verb, inputs, tmp_path / f"killed{named}" / "out")
        done = subprocess.run([sys.executable, "-c", KILLED, str(named), *words(verb, out)], check=False)
        assert done.returncode == -signal.SIGKILL
        assert require_whole_files(out, whole, before) <= named
        require_same_result(verb, out, whole)


@pytest.mark.long
@pytest.mark.parametrize("verb", ["report", "calibrate"])
def test_a_verb_that_is_killed_at_any_moment_works_again(
    verb: str, inputs: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(inputs)
    start = [sys.executable, "-c", "from ltsim.cli.main import main; main()"]
    begun = time.monotonic()
    subprocess.run([*start, *words(verb, prepared(verb, inputs, tmp_path / "whole" / "out"))], check=True)
    duration = time.monotonic() - begun
    whole = contents(tmp_path / "whole" / "out")
    before = contents(prepared(verb, inputs, tmp_path / "before" / "out"))
    moments = duration * np.append(random_stream(7, "moments of a kill").uniform(0.3, 1.0, N_KILLS - 2), [0.9, 0.97])
    for i, moment in enumerate(moments.tolist()):
        out = prepared(verb, inputs, tmp_path / f"killed{i}" / "out")
        with subprocess.Popen([*start, *words(verb, out)]) as process:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(moment)
            process.kill()
        require_whole_files(out, whole, before)
        require_same_result(verb, out, whole)
