"""Standard output and standard error may be closed, full, without a reader, or lack a letter: no work is lost."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from ltsim.cli.main import COMMANDS, run
from ltsim.recordings import write
from ltsim.simulation.scenario import load_scenario
from ltsim.simulation.simulator import simulate
from tests.families import family

START = "from ltsim.cli.main import main; main()"
CLOSED = {">&-": 0, "<&- >&- 2>&-": 0, "| true": 0, "2>/dev/full": 0, "2>&-": 0, ">&- 2>&-": 0, "2>&1 | true": 0}
"""What is done to the streams, and the status of a verb that has something to say all the same."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    whole, _ = simulate(load_scenario("paper-workshop"), 1)
    few = whole.select((whole.station < 3) & (whole.target < 10))
    write(few, folder / "rec")
    names = ("\u0141\u00f3d\u017a", "\u03b1", "\u6e2c", *few.targets[3:])
    write(few.replace(targets=names), folder / "named")
    return folder


def shell(folder: Path, words: str, streams: str, **surroundings: str) -> subprocess.CompletedProcess[bytes]:
    """A verb in a shell with something done to its streams."""
    if "/dev/full" in streams and not Path("/dev/full").exists():
        pytest.skip("there is no full disk at hand")
    command = f"set -o pipefail; {sys.executable} -c '{START}' {words} {streams}"
    given = {**os.environ, **surroundings}
    return subprocess.run(["bash", "-c", command], cwd=folder, capture_output=True, check=False, env=given)


@pytest.mark.parametrize("streams", family(CLOSED, 4))
def test_a_verb_does_its_work_whatever_the_streams_are(streams: str, inputs: Path, tmp_path: Path) -> None:
    out = tmp_path / "net"
    done = shell(inputs, f"adjust rec --out {out}", streams)
    assert done.returncode == CLOSED[streams]
    assert b"Traceback" not in done.stderr and b"Exception" not in done.stderr
    assert sorted(p.name for p in out.iterdir()) == [
        "calibration.json",
        "residuals.csv",
        "targets.covariance.csv",
        "targets.csv",
    ]


@pytest.mark.long
@pytest.mark.parametrize("streams", CLOSED)
@pytest.mark.parametrize("verb", COMMANDS)
def test_no_verb_has_a_fault_whatever_the_streams_are(verb: str, streams: str, inputs: Path) -> None:
    for words in (f"{verb} --help", f"{verb} no-such-file", f"{verb} --no-such-option"):
        done = shell(inputs, words, streams)
        assert done.returncode in (0, 2)
        assert b"Traceback" not in done.stderr and b"Exception" not in done.stderr


def test_json_without_a_standard_output_is_refused_before_the_work(inputs: Path) -> None:
    done = shell(inputs, "adjust no-such-file --json", ">&-")
    assert done.returncode == 2
    assert done.stderr.startswith(b"error: --json prints to standard output, which is closed")


@pytest.mark.parametrize(
    ("encoding", "verbs"), family([("cp1252", ["adjust"]), ("ascii", ["adjust", "diagnose --no-held-out"])])
)
def test_names_that_a_terminal_cannot_print_are_escaped(encoding: str, verbs: list[str], inputs: Path) -> None:
    done = shell(inputs, "check named --json && ltsim() { :; }", "", PYTHONIOENCODING=encoding)
    assert done.returncode in (0, 1)
    for words in (*(f"{verb} named" for verb in verbs), "adjust \u0141"):
        done = shell(inputs, words, "", PYTHONIOENCODING=encoding)
        assert done.returncode == (2 if words.endswith("\u0141") else 0)
        assert b"Traceback" not in done.stderr
    assert b"\\u0141" in done.stderr


def test_warnings_do_not_reach_the_user(inputs: Path) -> None:
    code = (
        "import warnings; from ltsim.cli import effects, terminal; from ltsim.cli.main import run\n"
        "import numpy as np\n"
        "terminal.prepare_streams()\n"
        "warning = lambda *_: np.float64(1.0) / np.zeros(1) and warnings.warn('for developers') or ''\n"
        "effects._effect_list_line = warning\n"
        "run(['effects'])"
    )
    asked = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert asked.stderr == ""
    shown = subprocess.run([sys.executable, "-W", "default", "-c", code], capture_output=True, text=True, check=True)
    assert "divide by zero" in shown.stderr


def test_a_run_inside_a_program_keeps_its_warnings(capsys: pytest.CaptureFixture[str]) -> None:
    """`run` is called by tests and programs: only the installed command decides for the whole process."""
    before = warnings.filters[:]
    assert run(["effects", "-q"]) == 0
    assert warnings.filters == before
