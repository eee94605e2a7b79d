"""What leaves the command line when something goes wrong that is not the input's fault, and signs of life."""

from __future__ import annotations

import csv
import io
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from ltsim.cli import effects, terminal
from ltsim.cli.main import run
from ltsim.cli.terminal import Terminal
from ltsim.recordings import read, write
from ltsim.recordings.coordinates import read_coordinates
from ltsim.recordings.files import is_number
from ltsim.recordings.setup import Setup
from ltsim.simulation.scenario import load_scenario
from ltsim.simulation.simulator import simulate

START = "from ltsim.cli.main import main; main()"


def test_an_internal_error_has_a_separate_exit_status(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise IndexError("nobody expects this")

    monkeypatch.setattr(effects, "_effect_list_line", broken)
    assert run(["effects"]) == 70
    error_text = capsys.readouterr().err
    assert "Traceback" in error_text and "nobody expects this" in error_text
    assert error_text.splitlines()[-1].startswith("error: internal error of ltsim (IndexError)")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no full disk at hand")
def test_a_full_disk_on_standard_output_is_a_sentence() -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-c", START, "effects"], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.returncode == 2
    assert done.stderr == "error: the output cannot be written (No space left on device)\n"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["campaign", "few.toml", "--jobs", "1000000"], "256"),
        (["recover", "paper-workshop", "--jobs", "1000000"], "--jobs"),
        (["plan", "fine.toml", "--json"], "a grid of 0.001 mm"),
        (["plan", "wide.toml", "--json"], "no place on the floor sees T01"),
    ],
)
def test_sizes_that_no_machine_holds_are_a_sentence(
    arguments: list[str],
    words: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("fine.toml").write_text('format = "ltsim-plan/1"\n[search]\ngrid_step_mm = 0.001\n')
    assert run(["simulate", "paper-workshop", "--show"]) == 0
    scenario = capsys.readouterr().out.replace("size_mm = [6000, 6000, 6000]", "size_mm = [1e9, 1e9, 6000]")
    Path("wide.toml").write_text(scenario)
    assert run(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert words in captured.err


def test_an_interrupted_campaign_reports_the_finished_shards(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    from ltsim.campaigns import campaign

    real = campaign.n_rows_of_shard

    def stop(*arguments: object) -> int:
        if list((tmp_path / "few").glob("rows/*/*.parquet")):
            raise KeyboardInterrupt
        return real(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(campaign, "n_rows_of_shard", stop)
    (tmp_path / "few.toml").write_text('format = "ltsim-campaign/1"\ntrials = 8\ntrials_per_shard = 4\n')
    assert run(["campaign", str(tmp_path / "few.toml")]) == 130
    error_text = capsys.readouterr().err
    remaining = f"1 files with results of finished trials remain in {tmp_path / 'few'}"
    assert error_text == f"interrupted; {remaining}; continue with --resume\n"


def test_a_pipe_gets_a_sign_of_life(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(terminal, "FIRST_PROGRESS_DELAY_S", 0.01)
    for quiet in (False, True):
        stream = io.StringIO()
        monkeypatch.setattr(sys, "stderr", stream)
        with Terminal(quiet).show_progress("trials", 200) as advance:
            advance(7)
            deadline = time.monotonic() + 60
            while "7 of 200" not in stream.getvalue() and not quiet and time.monotonic() < deadline:
                time.sleep(0.005)
        lines = stream.getvalue().splitlines()
        assert lines == [] if quiet else lines[-1].startswith("trials: 7 of 200 (")


def test_a_reader_that_has_gone_is_no_failed_check(tmp_path: Path) -> None:
    assert run(["simulate", "paper-workshop", "--out", str(tmp_path / "rec"), "-q"]) == 0
    for verb in ("effects", f"adjust {tmp_path / 'rec'}"):
        command = f"set -o pipefail; {sys.executable} -c '{START}' {verb} | head -1"
        done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, "")


def test_an_interruption_is_reported(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(effects, "_effect_list_line", stop)
    assert run(["effects"]) == 130
    assert capsys.readouterr().err == "interrupted; no partial file remains\n"


INTERRUPTED_IMPORT = """
import builtins, os, signal
real = builtins.__import__

def interrupted(name, *arguments, **keywords):
    if name == "typer":
        os.kill(os.getpid(), signal.SIGINT)
    return real(name, *arguments, **keywords)

builtins.__import__ = interrupted
from ltsim.__main__ import main
main()
"""


def test_an_interruption_while_modules_are_imported_prints_nothing() -> None:
    done = subprocess.run([sys.executable, "-c", INTERRUPTED_IMPORT], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


def test_hostile_names_are_text_on_the_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    hostile = "\x1b]0;title\x07\u202eevil"
    assert run(["simulate", "paper-workshop", "--out", hostile]) == 0
    assert run(["adjust", hostile + "x"]) == 2
    captured = capsys.readouterr()
    assert not {c for c in captured.out + captured.err if not c.isprintable()} - {"\n"}


def test_a_recording_without_redundancy_has_a_diagnosis_in_json(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    whole, _ = simulate(load_scenario("paper-workshop"), 1)
    write(whole.select((whole.station == 0) & (whole.target < 8)), tmp_path / "once")
    assert run(["diagnose", str(tmp_path / "once"), "--out", str(tmp_path / "found"), "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["fit"]["before"]["dof"] == 0
    assert content["global_test"]["p_value"] in (None, 1.0)
    assert run(["report", str(tmp_path / "found"), "-q"]) == 0


def test_a_report_goes_on_past_a_folder_that_cannot_be_read(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert run(["simulate", "paper-workshop", "--out", str(tmp_path / "good"), "-q"]) == 0
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "calibration.json").write_text("{")
    assert run(["report", str(tmp_path)]) == 0
    captured = capsys.readouterr()
    assert captured.err.startswith(f"{tmp_path / 'bad' / 'calibration.json'}: the file is not JSON")
    page = (tmp_path / "report.html").read_text()
    assert "is not JSON" in page and "140 pointings" in page


FORMULAS = ("=", "+", "-", "@")


def formulas(folder: Path) -> list[str]:
    """Cells of all CSV files below a folder that a spreadsheet takes for formulas."""
    rows = [row for file in sorted(folder.rglob("*.csv")) for row in csv.reader(file.read_text().splitlines())]
    return [cell for row in rows for cell in row if cell.startswith(FORMULAS) and not is_number(cell)]


def test_names_that_begin_as_formulas_are_no_formulas_in_any_table_and_are_read_back(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    whole, _ = simulate(load_scenario("paper-workshop"), 1)
    targets = ("=A1", "+1", "-x", "@y", "'=z", "a,b", "#8", *whole.targets[7:])
    stations = ("=S1", "+S2", "-S3", "@S4", *whole.stations[4:])
    count = np.arange(len(whole), dtype=np.float64)
    given = whole.replace(
        targets=targets,
        stations=stations,
        setup=Setup(),
        covariates={"=count": count},
        labels={"@note": ("=1+1",) * len(whole)},
    )
    write(given, tmp_path / "rec")
    again = read(tmp_path / "rec")
    assert {*again.targets} == {*targets} and {*again.stations} == {*stations}
    assert {*again.covariates} == {"=count"} and again.labels == {"@note": ("=1+1",) * len(whole)}
    assert run(["adjust", "rec", "--out", "adjusted", "-q"]) == 0
    assert {*read_coordinates(tmp_path / "adjusted" / "targets.csv").names} == {*targets}  # none is a comment
    assert run(["compare", "adjusted/targets.csv", "adjusted/targets.csv", "-q", "--out", "compared"]) == 0
    assert len(list(tmp_path.rglob("*.csv"))) > 3
    assert formulas(tmp_path) == []
