"""No verb replaces what it did not make: one rule, and --force."""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path

import pytest

from ltsim.cli.main import run
from ltsim.cli.output_checks import PAGE_GENERATOR_TAG
from ltsim.recordings.files import write_text, write_texts


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording, its network adjusted, its calibration."""
    folder = tmp_path_factory.mktemp("made")
    rec = str(folder / "rec")
    assert run(["simulate", "paper-workshop", "--out", rec, "-q"]) == 0
    assert run(["adjust", rec, "--out", str(folder / "net"), "-q"]) == 0
    assert run(["calibrate", rec, "--out", str(folder / "cal"), "-q"]) == 0
    return folder


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one sentence with which a command refuses, before it has computed anything."""
    capsys.readouterr()
    assert run(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert "--force" in captured.err
    return captured.err


def test_a_recording_is_never_replaced_by_itself(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rec, cal = str(made / "rec"), str(made / "cal")
    before = {p.name: p.read_bytes() for p in (made / "rec").iterdir()}
    other = ["simulate", "paper-workshop", "--seed", "1", "--out", rec]
    assert "observations.csv, setup.toml with another content" in refused(other, capsys)
    refused(["correct", rec, "--calibration", cal, "--out", rec, "-q"], capsys)
    refused(["convert", rec, rec], capsys)
    assert run(["simulate", "paper-workshop", "--out", rec, "--force", "-q"]) == 0
    assert {p.name: p.read_bytes() for p in (made / "rec").iterdir()} == before


@pytest.mark.parametrize(
    "verb",
    [
        ["convert", "REC", "OUT/copy"],
        ["convert", "REC", "OUT/copy.txt", "--to", "polar-text"],
        ["simulate", "paper-workshop", "--out", "OUT/rec", "--truth", "OUT/truth.json"],
        ["inject", "REC", "range-step:S3", "--out", "OUT/rec", "--truth", "OUT/injected.json"],
        ["correct", "REC", "--calibration", "CAL", "--out", "OUT/rec"],
        ["examples", "OUT"],
    ],
    ids=lambda verb: " ".join(verb[:3]),
)
def test_a_repeated_command_overwrites_its_unmodified_output(
    verb: list[str], made: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """And nothing of it is replaced after one of its files was changed."""
    named = {"REC": str(made / "rec"), "CAL": str(made / "cal")}
    arguments = [named.get(word, word.replace("OUT", str(tmp_path / "out"))) for word in verb]
    assert run([*arguments, "-q"]) == 0
    files = {p: p.read_bytes() for p in (tmp_path / "out").rglob("*") if p.is_file()}
    assert run([*arguments, "-q"]) == 0
    assert {p: p.read_bytes() for p in (tmp_path / "out").rglob("*") if p.is_file()} == files
    for changed in files:
        changed.write_bytes(files[changed] + b"\n")
        capsys.readouterr()
        assert run([*arguments, "-q"]) == 2
        error_text = capsys.readouterr().err
        assert error_text.count("\n") == 1 and "with another content" in error_text and "--force" in error_text
        assert changed.read_bytes() == files[changed] + b"\n"
        changed.write_bytes(files[changed])


def test_a_result_of_the_same_verb_is_made_again(
    made: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    rec, net = str(made / "rec"), str(made / "net")
    assert run(["adjust", rec, "--out", net, "-q"]) == 0
    assert "calibration.json" in refused(["calibrate", rec, "--out", net], capsys)
    assert "targets.csv" in refused(["diagnose", rec, "--out", net], capsys)
    changed = tmp_path / "net"
    write_texts(changed, {p.name: p.read_bytes() for p in (made / "net").iterdir()})
    (changed / "targets.csv").write_text("edited by hand\n")
    refused(["adjust", rec, "--out", str(changed)], capsys)
    assert (changed / "targets.csv").read_text() == "edited by hand\n"
    assert run(["adjust", rec, "--out", str(changed), "--force", "-q"]) == 0


@pytest.mark.parametrize(
    ("verb", "name"),
    [
        (["calibrate", "REC"], "calibration.json"),
        (["adjust", "REC"], "residuals.csv"),
        (["diagnose", "REC"], "recording/setup.toml"),
        (["evaluate", "REC"], "criteria.json"),
        (["history", "REC", "REC"], "history.svg"),
        (["recover", "paper-workshop"], "trials.csv"),
        (["plan", "paper-workshop"], "floor.png"),
        (["plan", "--after", "REC"], "next.csv"),
        (["simulate", "paper-workshop"], "setup.toml"),
        (["demo"], "anything"),
        (["campaign", "FILE"], "summary.csv"),
    ],
)
def test_a_file_that_is_there_stops_every_verb(
    verb: list[str], name: str, made: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "few.toml").write_text('format = "ltsim-campaign/1"\ntrials = 2\n')
    file = tmp_path / "out" / name
    file.parent.mkdir(parents=True)
    file.write_text("mine")
    named = {"REC": str(made / "rec"), "FILE": str(tmp_path / "few.toml")}
    arguments = [named.get(word, word) for word in verb]
    refused([*arguments, "--out", str(tmp_path / "out")], capsys)
    assert [p.read_text() for p in (tmp_path / "out").rglob("*") if p.is_file()] == ["mine"]


@pytest.mark.long
def test_files_that_are_named_replace_none(made: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    mine = tmp_path / "mine.html"
    mine.write_text("mine")
    rec = str(made / "rec")
    for arguments in (
        ["view", "paper-workshop", "--html", str(mine)],
        ["convert", rec, str(mine), "--to", "polar-text"],
        ["simulate", "paper-workshop", "--out", str(tmp_path / "rec"), "--truth", str(mine)],
    ):
        refused(arguments, capsys)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.html"]
    page = made / "cal" / "report.html"
    page.write_text("mine")
    refused(["report", str(made / "cal")], capsys)
    page.write_text(f"<head>{PAGE_GENERATOR_TAG}")
    assert run(["report", str(made / "cal"), "-q"]) == 0
    assert run(["report", str(made / "cal"), "-q"]) == 0


def test_a_recording_is_corrected_once(made: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    cal, once, twice = str(made / "cal"), str(tmp_path / "once"), str(tmp_path / "twice")
    assert run(["correct", str(made / "rec"), "--calibration", cal, "--out", once, "-q"]) == 0
    assert run(["correct", once, "--calibration", cal, "--out", twice]) == 2
    assert "the readings corrected" in capsys.readouterr().err
    assert not Path(twice).exists()
    assert run(["correct", once, "--calibration", cal, "--out", twice, "--force", "-q"]) == 0


def test_a_link_stays_and_a_pipe_is_written_to(made: Path, tmp_path: Path) -> None:
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    write_text(tmp_path / "link.txt", "new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real.txt").read_text() == "new"
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    write_text(tmp_path / "pipe", "through")
    assert os.read(reader, 100) == b"through"
    os.close(reader)
    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode)
    assert run(["view", "paper-workshop", "--png", "/dev/null", "-q"]) == 0
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)


def test_a_result_without_digests_is_not_recognised(
    made: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """A calibration that a person wrote is not replaced."""
    hand = {"format": "ltsim-calibration/1", "construction": "misalignment", "parameters": []}
    (tmp_path / "calibration.json").write_text(json.dumps(hand))
    refused(["calibrate", str(made / "rec"), "--out", str(tmp_path)], capsys)


@pytest.mark.parametrize(
    "verb",
    [
        ["adjust", "REC"],
        ["calibrate", "REC"],
        ["check", "REC"],
        ["evaluate", "REC"],
        ["correct", "REC", "--calibration", "CAL"],
        ["simulate", "paper-workshop"],
        ["recover", "paper-workshop"],
    ],
)
def test_somebodys_folder_is_not_written_into(
    verb: list[str], made: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """A file of another name stops a verb too; hidden files and folders do not make a folder somebody's."""
    (tmp_path / "thesis.txt").write_text("mine")
    (tmp_path / "data.json").write_text("[1, 2]")
    arguments = [{"REC": str(made / "rec"), "CAL": str(made / "cal")}.get(word, word) for word in verb]
    message = refused([*arguments, "--out", str(tmp_path)], capsys)
    assert "data.json, thesis.txt, which ltsim did not create" in message
    assert sorted(p.name for p in tmp_path.iterdir()) == ["data.json", "thesis.txt"]


def test_a_folder_of_ltsim_takes_other_verbs_results(
    made: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    rec, out = str(made / "rec"), str(tmp_path)
    (tmp_path / ".DS_Store").write_bytes(b"\0")
    (tmp_path / "photographs").mkdir()
    assert run(["calibrate", rec, "--out", out, "-q"]) == 0
    assert run(["evaluate", rec, "--out", out, "-q"]) == 0
    assert run(["report", out, "-q"]) == 0
    assert run(["check", rec, "--out", out, "-q"]) in (0, 1)
    (tmp_path / "thesis.txt").write_text("mine")
    refused(["evaluate", rec, "--out", out], capsys)
    assert run(["evaluate", rec, "--out", out, "--force", "-q"]) == 0
    assert (tmp_path / "thesis.txt").read_text() == "mine"


def test_only_the_changed_file_is_named(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["adjust", str(made / "rec"), "--out", str(tmp_path)]
    assert run([*command, "-q"]) == 0
    targets = tmp_path / "targets.csv"
    targets.write_text(targets.read_text() + "x")
    message = refused(command, capsys)
    assert "targets.csv, which was changed" in message
    assert "calibration.json" not in message
    message = refused(["calibrate", str(made / "rec"), "--out", str(tmp_path)], capsys)
    assert "calibration.json, which this command did not write" in message
    assert "targets.csv" not in message and "which was changed" not in message
