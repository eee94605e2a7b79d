"""Inputs that are no files: pipes, devices and links are refused with one sentence, and no verb waits for them."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from ltsim.cli.main import COMMANDS, run
from tests.cli.slips import ACCEPTANCE, BENCH, CAMPAIGN, PLAN, POINTS, SCENARIO, TASKS
from tests.cli.test_outputs import inputs_of

WORDS = {
    ("simulate", "scenario"): "simulate {} --out made",
    ("check", "source"): "check {}",
    ("check", "control"): "check rec --control {}",
    ("adjust", "source"): "adjust {}",
    ("adjust", "control"): "adjust rec --control {}",
    ("adjust", "frame"): "adjust rec --frame {}",
    ("calibrate", "source"): "calibrate {}",
    ("calibrate", "prior"): "calibrate rec --prior {}",
    ("calibrate", "control"): "calibrate rec --control {}",
    ("calibrate", "frame"): "calibrate rec --frame {}",
    ("correct", "source"): "correct {} --calibration cal --out made",
    ("correct", "calibration"): "correct rec --calibration {} --out made",
    ("correct", "control"): "correct rec --calibration cal --out made --control {}",
    ("correct", "frame"): "correct rec --calibration cal --out made --frame {}",
    ("evaluate", "source"): "evaluate {}",
    ("evaluate", "calibration"): "evaluate rec --calibration {}",
    ("verify", "source"): "verify {} --nominal nominal.csv --calibration cal",
    ("verify", "nominal"): "verify rec --nominal {} --calibration cal",
    ("verify", "calibration"): "verify rec --nominal nominal.csv --calibration {}",
    ("recover", "scenario"): "recover {} --trials 2",
    ("campaign", "file"): "campaign {} --out made",
    ("compare", "source"): "compare {} rec",
    ("compare", "second"): "compare rec {}",
    ("convert", "source"): "convert {} made",
    ("convert", "control"): "convert rec made --control {}",
    ("convert", "frame"): "convert rec made --frame {}",
    ("inject", "source"): "inject {} beam-tilt --out made",
    ("inject", "control"): "inject rec beam-tilt --out made --control {}",
    ("inject", "frame"): "inject rec beam-tilt --out made --frame {}",
    ("diagnose", "source"): "diagnose {}",
    ("diagnose", "history"): "diagnose rec --history {}",
    ("diagnose", "control"): "diagnose rec --control {}",
    ("diagnose", "frame"): "diagnose rec --frame {}",
    ("history", "sources"): "history cal {}",
    ("plan", "source"): "plan {} --jobs 1",
    ("plan", "after"): "plan --after {}",
    ("report", "recording"): "report cal --recording {}",
    ("uncertainty", "file"): "uncertainty {}",
    ("uncertainty", "source"): "uncertainty tasks.toml --source {}",
    ("uncertainty", "against"): "uncertainty tasks.toml --against {}",
    ("accept", "file"): "accept {}",
    ("bench", "file"): "bench {}",
    ("view", "place"): "view {} --html made.html",
    ("view", "plan"): "view --plan {}",
    ("view", "cad"): "view paper-workshop --cad {} --html made.html",
    ("view", "control"): "view rec --control {} --html made.html",
    ("view", "frame"): "view rec --frame {} --html made.html",
}
"""Verb with its other inputs, by verb and name of an input; `{}` is the input."""
INSIDE = {
    "check rec": ("rec/observations.csv", "rec/setup.toml"),
    "evaluate rec --calibration cal": ("cal/calibration.json", "rec/setup.toml"),
    "correct rec --calibration cal --out made": ("cal/calibration.json",),
    "verify rec --nominal nominal.csv --calibration cal": ("nominal.csv", "cal/calibration.json"),
    "convert tables made": ("tables/A.csv", "tables/setup.toml"),
    "compare rec rec": ("rec/observations.csv",),
    "campaign campaign.toml --out few --resume": ("few/manifest.json", "few/rows.sha256", "few/.lock"),
    "plan hall.toml": ("body.stl", "points.csv"),
    "simulate scenario.toml --out made": ("body.stl",),
    "report cal": ("cal/calibration.json", "cal/residuals.csv", "cal/targets.csv"),
}
"""Files that a verb reads in a folder or by their name in another file."""
KINDS = (
    "pipe",
    "device",
    *(pytest.param(kind, marks=pytest.mark.long) for kind in ("pipe elsewhere", "nothing", "circle")),
)


def replace(place: Path, kind: str, outside: Path) -> None:
    """Put something that is no file to a place."""
    if kind == "pipe":
        os.mkfifo(place)
    else:
        target = {"pipe elsewhere": outside / "pipe", "device": "/dev/zero", "nothing": outside / "no"}
        place.symlink_to(target.get(kind, place.name))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Samples of all inputs, and results of verbs."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "outside").mkdir()
    os.mkfifo(folder / "outside" / "pipe")
    samples = {"plan": PLAN, "campaign": CAMPAIGN, "tasks": TASKS, "acceptance": ACCEPTANCE}
    obstacle = '\n[[workshop.obstacles]]\nname = "body"\nfile = "body.stl"\nposition_mm = [2500, 1800, 0]\n'
    samples["hall"] = PLAN.partition("[[points]]")[0].replace("title", 'points = "points.csv"\ntitle', 1) + obstacle
    samples["scenario"] = SCENARIO.partition("[work]")[0] + f"[workshop]\n{obstacle}"
    for name, text in samples.items():
        (folder / f"{name}.toml").write_text(text)
    (folder / "bench.csv").write_text(BENCH)
    (folder / "points.csv").write_text(POINTS)
    rec = str(folder / "rec")
    assert run(["simulate", "paper-workshop", "--out", rec, "-q"]) == 0
    assert run(["calibrate", rec, "--out", str(folder / "cal"), "-q"]) == 0
    assert run(["campaign", str(folder / "campaign.toml"), "--out", str(folder / "few"), "-q"]) == 0
    rows = [",".join(row.split(",")[:4]) for row in (folder / "cal" / "targets.csv").read_text().splitlines()[1:11]]
    (folder / "nominal.csv").write_text("target,x_mm,y_mm,z_mm\n" + "\n".join(rows) + "\n")
    shutil.copytree(folder / "rec", folder / "tables")
    (folder / "tables" / "observations.csv").rename(folder / "tables" / "A.csv")
    return folder


@pytest.fixture
def work(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(made, tmp_path / "work", ignore=shutil.ignore_patterns("outside"))
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work"


def test_every_input_of_every_verb_is_tried() -> None:
    assert {*WORDS} == {(verb, name) for verb in COMMANDS for name in inputs_of(verb)}


@pytest.mark.timeout(60)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("verb", "name"), WORDS)
def test_an_input_that_is_no_file_is_refused(
    verb: str, name: str, kind: str, work: Path, made: Path, capsys: Any
) -> None:
    place = "place.stl" if name == "cad" else "place"
    replace(work / place, kind, made / "outside")
    assert run([word.replace("{}", place) for word in WORDS[verb, name].split()]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("error: ") == 1 and place in captured.err
    assert not list(work.glob("made*"))


@pytest.mark.timeout(60)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("words", "file"), [(words, file) for words, files in INSIDE.items() for file in files])
def test_a_file_in_a_folder_that_is_no_file_is_refused(
    words: str, file: str, kind: str, work: Path, made: Path, capsys: Any
) -> None:
    (work / file).unlink(missing_ok=True)
    replace(work / file, kind, made / "outside")
    status = run(words.split())
    captured = capsys.readouterr()
    optional = file.endswith(("residuals.csv", "targets.csv", "covariance.csv", "rows.sha256"))  # a page says so
    assert status == 2 or (optional and status == 0)
    assert captured.err.count("error: ") == (status == 2) and "Traceback" not in captured.err
    assert status == 0 or Path(file).name in captured.err, captured.err
    assert [p.name for p in (made / "outside").iterdir()] == ["pipe"]


LONG_NAME = "x" * 300
"""A name that is longer than file systems permit."""
FILES_WITH_NAME = {
    "plan a.toml": PLAN.partition("[[points]]")[0].replace("title", f'points = "{LONG_NAME}"\ntitle', 1),
    "plan b.toml": f'format = "ltsim-plan/1"\nscenario = "{LONG_NAME}"\n',
    "simulate c.toml --out made": SCENARIO.replace("paper-workshop", LONG_NAME),
    "uncertainty d.toml": TASKS.replace('"rec"', f'"{LONG_NAME}"'),
    "campaign e.toml --out made": CAMPAIGN.replace("seed", f'scenario = "{LONG_NAME}"\nseed', 1),
    "campaign f.toml --out made": CAMPAIGN.replace("seed", f'validation_points = "{LONG_NAME}"\nseed', 1),
}
"""Verbs with the content of a file that names another one."""


@pytest.mark.parametrize("words", [*(w.replace("{}", LONG_NAME) for w in WORDS.values()), *FILES_WITH_NAME])
def test_a_name_that_no_file_can_have_is_refused(words: str, work: Path, capsys: Any) -> None:
    if words in FILES_WITH_NAME:
        (work / words.split()[1]).write_text(FILES_WITH_NAME[words])
    assert run(words.replace(f"--cad {LONG_NAME}", f"--cad {LONG_NAME}.stl").split()) == 2
    captured = capsys.readouterr()
    assert captured.err.count("error: ") == 1 and "xxxx" in captured.err and "Traceback" not in captured.err
    assert not list(work.glob("made*"))
