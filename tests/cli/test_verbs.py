"""The verbs as a user calls them: answers, files, exit status, one sentence for whatever is wrong."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

import ltsim.cli
from ltsim.cli.main import COMMANDS, run
from ltsim.core.errors import ModelError
from ltsim.core.notation import align_columns
from ltsim.physics.effects import CATALOGUE, catalogue_entry
from ltsim.recordings import read
from ltsim.simulation.truth import read_truth
from tests.families import family


@pytest.fixture(scope="module")
def workplace(tmp_path_factory) -> Path:
    """A simulated recording with its truth, and its calibration."""
    folder = tmp_path_factory.mktemp("work")
    assert (
        run(["simulate", "paper-workshop", "--out", str(folder / "rec"), "--truth", str(folder / "truth.json"), "-q"])
        == 0
    )
    assert run(["calibrate", str(folder / "rec"), "--out", str(folder / "cal"), "-q"]) == 0
    return folder


@pytest.mark.parametrize("verb", COMMANDS)
def test_every_verb_has_help_with_an_example(verb: str, capsys) -> None:
    assert run([verb, "--help"]) == 0
    text = capsys.readouterr().out
    assert f"Example: ltsim {verb}" in text
    assert "--quiet" in text
    assert "--json" in text or verb in ("report", "view")  # their answer is a page or a picture


def test_help_without_arguments(capsys) -> None:
    assert run([]) == 0
    text = capsys.readouterr().out
    assert all(verb in text for verb in COMMANDS)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["calibrat"], "No such command 'calibrat'"),
        (["calibrate"], "Missing argument 'REC'"),
        (["calibrate", "nowhere"], "nowhere: there is no such file or folder"),
        (["calibrate", "nowhere", "--method", "guess"], "--method is guess, expected network"),
        (["calibrate", "nowhere", "--hint", "angle=furlong"], "angle can be deg or gon or rad"),
        (["calibrate", "nowhere", "--hint", "colour=red"], "expected KEY=VALUE with a key among angle"),
        (["check", "nowhere", "--control"], "ltsim check: Option '--control' requires an argument; see ltsim check"),
        (["correct", "nowhere", "--out", "x"], "Missing option '--calibration'"),
        (["simulate", "paper-workshp", "--out", "x"], "did you mean paper-workshop"),
        (["simulate", "paper-workshop"], "ltsim simulate needs --out REC"),
        (["effects", "station-setling"], "did you mean station-settling"),
        (["recover", "paper-workshop", "--trials", "1"], "--trials"),
        (["recover", "nowhere.toml"], "there is no such file"),
        (
            ["plan", "paper-workshop", "--without", "S1", "--without", "S2"],
            "plan: --without was given 2 times, and takes",
        ),
        (["simulate", "paper-workshop", "--seed", "1", "--seed=2", "--out", "x"], "--seed was given 2 times"),
    ],
)
def test_bad_usage_is_a_sentence_and_status_2(
    arguments: list[str], sentence: str, capsys, monkeypatch, tmp_path
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert printed.err.startswith("error: ")
    assert sentence in printed.err
    assert "Traceback" not in printed.err
    assert list(tmp_path.iterdir()) == []


def test_calibrate_reports_determined_and_undetermined_parameters(workplace: Path, capsys) -> None:
    assert run(["calibrate", str(workplace / "rec")]) == 0
    text = capsys.readouterr().out
    assert "the readings agree with the model and the declared noise (chi2 " in text
    assert "degrees of freedom: 318" in text
    assert "beam-tilt" in text
    assert "Not determined by this recording" in text
    assert "measure every target in both faces (information" in text
    assert "Axes: the frame of the floor plan" in text
    assert text.isascii()  # whatever the terminal's encoding


@pytest.mark.parametrize("method", ["network", "distance", "distance-l1"])
def test_json_alone_on_standard_output(workplace: Path, capsys, method: str) -> None:
    assert run(["calibrate", str(workplace / "rec"), "--json", "--method", method]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["method"] == method
    truth = read_truth(workplace / "truth.json")
    z = [(p["value"] * 1e-6 - truth.instrument_values[p["name"]]) / (p["sigma"] * 1e-6) for p in content["parameters"]]
    assert np.abs(z).max() < 4.5


def test_quiet_prints_nothing(workplace: Path, capsys, tmp_path: Path) -> None:
    assert run(["adjust", str(workplace / "rec"), "--out", str(tmp_path / "a"), "-q"]) == 0
    printed = capsys.readouterr()
    assert printed.out == printed.err == ""
    assert json.loads((tmp_path / "a" / "calibration.json").read_text())["parameters"] == []


def test_evaluate_before_and_after(workplace: Path, capsys, tmp_path: Path) -> None:
    rec, cal = str(workplace / "rec"), str(workplace / "cal")
    assert run(["evaluate", rec, "--calibration", cal, "--json", "--out", str(tmp_path)]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["distance"]["improvement_percent"] > 20
    assert json.loads((tmp_path / "criteria.json").read_text()) == content
    criteria = json.loads((workplace / "cal" / "calibration.json").read_text())["criteria"]
    assert criteria["coordinate"]["after"] == pytest.approx(content["coordinate"]["after"], rel=1e-6)
    assert run(["evaluate", rec]) == 0
    assert "coordinate" in capsys.readouterr().out


def test_correct_takes_the_errors_out(workplace: Path, capsys, tmp_path: Path) -> None:
    rec, cal, out = str(workplace / "rec"), str(workplace / "cal"), str(tmp_path / "corrected")
    assert run(["correct", rec, "--calibration", cal, "--out", out]) == 0
    assert "140 pointings corrected by up to" in capsys.readouterr().out
    assert run(["evaluate", out, "--json"]) == 0
    corrected = json.loads(capsys.readouterr().out)
    assert run(["evaluate", rec, "--calibration", cal, "--json"]) == 0
    expected = json.loads(capsys.readouterr().out)
    assert corrected["distance"]["before"]["mean_um"] == pytest.approx(
        expected["distance"]["after"]["mean_um"], rel=1e-3
    )
    assert read(Path(out)).setup.instrument.corrected


def test_verify_against_the_laboratory(workplace: Path, capsys, tmp_path: Path) -> None:
    lab, cmm = str(tmp_path / "lab"), str(tmp_path / "cmm.csv")
    assert run(["simulate", "paper-laboratory", "--out", lab, "--nominal", cmm, "-q"]) == 0
    assert run(["verify", lab, "--nominal", cmm, "--calibration", str(workplace / "cal"), "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert set(content) == {"format", "recording", "distance", "coordinate"}
    assert 0 < content["coordinate"]["after"]["mean_um"] < 500


def test_simulate_is_reproducible_and_can_be_shown(capsys, tmp_path: Path) -> None:
    for name in ("a", "b"):
        assert run(["simulate", "paper-workshop", "--out", str(tmp_path / name), "--seed", "3", "-q"]) == 0
    first, second = (tmp_path / n / "observations.csv" for n in ("a", "b"))
    assert first.read_bytes() == second.read_bytes()
    assert run(["simulate", "paper-workshop", "--show"]) == 0
    (tmp_path / "mine.toml").write_text(capsys.readouterr().out)
    assert run(["simulate", str(tmp_path / "mine.toml"), "--out", str(tmp_path / "c"), "--seed", "3", "-q"]) == 0
    assert (tmp_path / "c" / "observations.csv").read_bytes() == first.read_bytes()


def test_nominal_points_are_asked_for_in_vain(capsys, tmp_path: Path) -> None:
    out, cmm = str(tmp_path / "rec"), str(tmp_path / "cmm.csv")
    assert run(["simulate", "paper-workshop", "--out", out, "--nominal", cmm]) == 2
    assert "measures_targets = true" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_convert_there_and_back(workplace: Path, capsys, tmp_path: Path) -> None:
    text, back = str(tmp_path / "rec.txt"), str(tmp_path / "back")
    assert run(["convert", str(workplace / "rec"), text, "--to", "polar-text", "-q"]) == 0
    status = run(["convert", text, back, "--hint", "azimuth=counter-clockwise", "--hint", "angle=deg", "-q"])
    assert status == 0
    recording, other = read(workplace / "rec"), read(Path(back))
    assert len(recording) == len(other)
    assert run(["convert", str(workplace / "rec"), str(tmp_path / "x"), "--to", "papyrus"]) == 2
    assert "papyrus" in capsys.readouterr().err


def test_effects_lists_the_whole_catalogue(capsys) -> None:
    assert run(["effects"]) == 0
    text = capsys.readouterr().out
    assert all(effect.name in text for effect in CATALOGUE)
    assert run(["effects", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)) == len(CATALOGUE)


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda effect: effect.name)
def test_the_card_of_every_effect(effect, capsys) -> None:
    assert run(["effects", effect.name]) == 0
    text = capsys.readouterr().out
    assert text.startswith(f"{effect.name}: {catalogue_entry(effect).title} (")
    assert "Source" in text
    assert all(p.name in text for p in effect.parameters)


def test_the_installed_command_leaves_no_traceback(workplace: Path) -> None:
    start = "from ltsim.cli.main import main; main()"
    bad = subprocess.run(
        [sys.executable, "-c", start, "calibrate", "nowhere"], capture_output=True, text=True, check=False
    )
    assert (bad.returncode, bad.stdout) == (2, "")
    assert bad.stderr == "error: nowhere: there is no such file or folder\n"
    command = f"{sys.executable} -c '{start}' effects | head -1"
    cut = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert cut.stderr == ""


def test_the_package_is_run_as_a_module() -> None:
    command = [sys.executable, "-m", "ltsim", "calibrate", "nowhere"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (2, "error: nowhere: there is no such file or folder\n")


HEAVY = {"numba", "pyvista", "matplotlib", "scipy", "duckdb", "pyarrow", "joblib", "trimesh", "jinja2", "pandas"}
NUMERIC = ("convert", "effects")  # verbs whose help lists what the rooms hold


def loaded_by(*commands: list[str]) -> set[str]:
    """Modules that a process has imported after these commands."""
    calls = "; ".join(f"assert run({command}) == 0" for command in commands)
    code = f"from ltsim.cli.main import run; import sys; {calls}; print('|', *sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.rpartition("|")[2].split())


def test_help_of_every_verb_waits_for_nothing_heavy() -> None:
    loaded = loaded_by(["--help"], ["--version"], *([verb, "--help"] for verb in COMMANDS if verb not in NUMERIC))
    assert not (HEAVY | {"numpy"}) & loaded


def test_light_verbs_wait_for_nothing_heavy(workplace: Path, tmp_path: Path) -> None:
    loaded = loaded_by(
        ["effects"],
        ["effects", "backlash"],
        ["simulate", "--show", "paper-workshop"],
        ["convert", str(workplace / "rec"), str(tmp_path / "polar.txt"), "--to", "polar-text"],
        *([verb, "--help"] for verb in NUMERIC),
    )
    assert not HEAVY & {name.partition(".")[0] for name in loaded}


def test_text_of_a_result_waits_for_no_picture(workplace: Path, tmp_path: Path) -> None:
    loaded = loaded_by(
        ["adjust", str(workplace / "rec"), "--out", str(tmp_path / "adjustment")],
        ["calibrate", str(workplace / "rec"), "--out", str(tmp_path / "calibration")],
        ["check", str(workplace / "rec")],
    )
    assert not {"matplotlib", "duckdb", "pyarrow", "numba", "scipy.stats"} & loaded


def test_picture_of_a_check_waits_for_no_campaign(workplace: Path, tmp_path: Path) -> None:
    loaded = loaded_by(["check", str(workplace / "rec"), "--out", str(tmp_path / "check")])
    assert "matplotlib" in loaded
    assert not {"duckdb", "pyarrow", "numba", "scipy.stats", "ltsim.campaigns", "ltsim.diagnosis.diagnosis"} & loaded


def test_a_single_effect_loads_no_file_format() -> None:
    code = "import sys, ltsim.physics.effects.beam_tilt; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "ltsim.recordings.exchange" not in loaded
    assert not [name for name in loaded if name.startswith("ltsim.recordings.formats")]


def test_the_version(capsys) -> None:
    assert run(["--version"]) == 0
    assert capsys.readouterr().out == f"ltsim {version('ltsim')}\n"


@pytest.mark.parametrize("shell", family(["bash", "zsh", "fish"]))
def test_the_shell_completes_verbs_and_options(shell: str) -> None:
    command = [sys.executable, "-c", "from ltsim.cli.main import main; main()"]
    words = {
        "bash": {"COMP_WORDS": "ltsim cal", "COMP_CWORD": "1"},
        "zsh": {"_TYPER_COMPLETE_ARGS": "ltsim cal"},
        "fish": {"_TYPER_COMPLETE_ARGS": "ltsim cal", "_TYPER_COMPLETE_FISH_ACTION": "get-args"},
    }[shell]
    asked = os.environ | words | {"_LTSIM_COMPLETE": f"complete_{shell}"}
    done = subprocess.run(command, env=asked, capture_output=True, text=True, check=False)
    assert "calibrate" in done.stdout, done.stderr
    assert "campaign" not in done.stdout


def test_every_module_of_a_verb_is_listed() -> None:
    folder = Path(ltsim.cli.__file__).parent
    helpers = {"__init__", "estimation_options", "main", "options", "output_checks", "terminal"}
    assert {path.stem for path in folder.glob("*.py")} - helpers == {module for module, _ in COMMANDS.values()}


def test_folder_that_cannot_be_written(workplace: Path, capsys, tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    taken.write_text("")
    assert run(["calibrate", str(workplace / "rec"), "--out", str(taken)]) == 2
    assert str(taken) in capsys.readouterr().err
    assert taken.read_text() == ""


def test_tables() -> None:
    assert align_columns(["a", "b"], [["x", "1"], ["yy", "22"]]) == "a    b\nx    1\nyy  22"
    with pytest.raises(ModelError):
        align_columns(["a"], [["x", "y"]])


WITHOUT = """
import sys
for name in ("duckdb", "numba", "llvmlite", "pyarrow", "pandas", "openpyxl", "dask", "distributed"):
    sys.modules[name] = None
from ltsim.cli.main import run
sys.exit(max(run(command.split()) for command in {commands}))
"""


def without_extras(commands: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """A process that runs commands as a plain installation would, without the packages of any extra."""
    code = WITHOUT.format(commands=commands)
    return subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False)


def test_a_plain_installation_does_all_but_campaigns(workplace: Path, tmp_path: Path) -> None:
    commands = [
        f"evaluate {workplace / 'rec'} --calibration {workplace / 'cal'}",
        "recover paper-workshop-re-aimed --trials 2 --out checked",
        f"correct {workplace / 'rec'} --calibration {workplace / 'cal'} --out corrected",
        "report corrected",
        "plan --show paper-workshop",
    ]
    done = without_extras(commands, tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("command", family(["campaign mine.toml", "demo"]))
def test_campaigns_say_which_extra_they_need(command: str, tmp_path: Path) -> None:
    done = without_extras([command], tmp_path)
    assert done.returncode == 2
    assert done.stderr == "error: campaigns need the extra 'campaigns': pip install \"ltsim[campaigns]\"\n"
    assert not list(tmp_path.iterdir())
