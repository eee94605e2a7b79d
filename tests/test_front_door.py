"""`import ltsim as lt`: light, complete, typed, and every result shows itself."""

from __future__ import annotations

import doctest
import importlib
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import ltsim as lt
from ltsim.cli.main import run
from ltsim.core.errors import InputError, LtsimError, ModelError, RecordError
from ltsim.core.results import MAX_NOTEBOOK_ROWS, Result

SMALL_PLAN = """
format = "ltsim-plan/1"
scenario = "paper-workshop"
[floor]
margin_mm = 600
height_mm = [1500, 2100]
[stations]
count = 3
[budget]
max_hours = 8
faces = [1]
repeats = [1]
[search]
starts = 1
grid_step_mm = 1500
yaw_count = 3
height_count = 1
"""
VERBS = [name for name in lt.__all__ if name not in ("effects", "errors")]
MODULES = sorted({lt._import_public_name(name).__module__ for name in VERBS})
EXAMPLES = {
    test.name: test
    for module in MODULES
    for test in doctest.DocTestFinder(exclude_empty=True).find(importlib.import_module(module))
    if test.examples
}


@pytest.fixture(scope="module")
def recording() -> Any:
    return lt.simulate("paper-workshop", seed=7).recording


def test_the_package_itself_loads_nothing_heavy():
    loaded = "import sys, ltsim, ltsim.core.errors; dir(ltsim); ltsim.__version__; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, check=True)
    assert not {"numpy", "scipy", "pydantic", "typer"} & set(done.stdout.split())


def test_every_name_is_there_and_no_other():
    assert set(lt.__all__) < set(dir(lt))
    for name in VERBS:
        assert callable(getattr(lt, name)), name
    with pytest.raises(AttributeError, match="no attribute 'simulation_of_everything'"):
        lt.simulation_of_everything  # noqa: B018


def test_a_verb_stays_callable_when_the_room_of_its_name_was_imported():
    import ltsim.simulation.simulator as module

    assert module.simulate is not lt.simulate
    assert len(lt.simulate("paper-workshop", seed=7).recording) == 140


@pytest.mark.parametrize("name", sorted(set(VERBS) - {"injection_curve", "station_alternatives"}))  # minutes each
def test_every_function_has_an_example(name: str):
    function = lt._import_public_name(name)  # the attribute may be a room of that name, which can be called too
    assert f"{function.__module__}.{name}" in EXAMPLES


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_examples_say_what_they_say(name: str, tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("small-plan.toml").write_text(SMALL_PLAN)
    lines: list[str] = []
    failed = doctest.DocTestRunner().run(EXAMPLES[name], out=lines.append).failed
    assert not failed, "".join(lines)


def test_a_table_that_does_not_exist_is_answered_with_those_that_do(recording):
    with pytest.raises(ModelError, match="no table of a Recording called 'points'; did you mean pointings"):
        recording.to_dataframe("points")


def test_without_pandas_a_sentence_says_what_to_install(recording, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(InputError, match=r"data frames need the extra 'pandas': pip install .*ltsim\[pandas\]"):
        recording.to_dataframe()


def test_a_notebook_shows_text_as_text_and_the_beginning_of_a_table(recording):
    hostile = recording.setup.model_copy(update={"title": "<script>alert(1)</script>"})
    page = replace(recording, setup=hostile)._repr_html_()
    assert "<script>" not in page
    assert page.count("<tr>") == MAX_NOTEBOOK_ROWS + 1
    assert f"and {len(recording) - MAX_NOTEBOOK_ROWS} more rows" in page


def test_an_empty_table_is_shown_as_nothing():
    class Empty(Result):
        def _summary_lines(self) -> list[str]:
            return ["nothing"]

        def _table_makers(self) -> Any:
            return {"none": dict[str, list[int]]}

    assert Empty()._repr_html_() == "<p>nothing</p>"


def test_changes_of_a_scenario_are_checked(tmp_path: Path):
    assert lt.scenario("paper-workshop", {"work.faces": 2}).work.faces == 2
    with pytest.raises(InputError, match=r"work\.faces"):
        lt.scenario("paper-workshop", {"work.faces": 3})
    with pytest.raises(InputError, match="not a table"):
        lt.scenario("paper-workshop", {"work.faces.first": 1})


def test_results_are_written_as_their_commands_do(recording, tmp_path: Path):
    calibration = lt.calibrate(recording)
    lt.write(calibration, tmp_path / "calibration")
    assert len(lt.correct(recording, tmp_path / "calibration")) == len(recording)
    assert len(lt.history([tmp_path / "calibration", recording]).calibrations) == 2
    with pytest.raises(ModelError, match="a dict cannot be written"):
        lt.write({}, tmp_path / "nothing")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "make",
    [
        lambda recording: lt.check(recording),
        lambda recording: lt.evaluate(recording, lt.calibrate(recording, advise=False)),
        lambda recording: lt.history(2 * [lt.calibrate(recording, advise=False)]),
        lambda recording: lt.adjust(recording),
        lambda recording: lt.simulate("paper-workshop", seed=3).truth,
        lambda recording: lt.accept({"standard": "asme-b89.4.19-2006", "instrument": "leica-at500", "trials": 1000}),
    ],
    ids=["check", "evaluate", "history", "adjust", "simulate", "accept"],
)
def test_a_result_is_read_as_the_class_and_with_the_content_that_was_written(make, recording, tmp_path: Path):
    made = make(recording)
    file = tmp_path / "written" / made.FILE
    lt.write(made, file if made.FILE == "truth.json" else file.parent)
    again = lt.read(file)
    assert type(again) is type(made)
    assert {**again.content(), "files": None} == {**made.content(), "files": None}
    assert all((file.parent / name).is_file() for name in again.files)
    assert again.table().header == made.table().header


def test_a_campaign_that_is_no_file_needs_a_folder():
    with pytest.raises(InputError, match="needs a folder"):
        lt.campaign({"format": "ltsim-campaign/1"})


def test_a_bare_text_is_a_single_name_and_effects_are_objects_or_words(recording):
    words = lt.calibrate(recording, with_effects="index-drift:S3", parameters="beam-tilt", advise=False)
    made = lt.calibrate(recording, with_effects=lt.Effect("index-drift", stations="S3"), parameters=["beam-tilt"])
    assert words.effects == made.effects
    assert int((~words.is_fixed).sum()) == 1
    assert lt.adjust(recording, datum=["T01", "T05", "T12"]).frame.endswith("T01, T05, T12")
    with pytest.raises(ModelError, match="no shape parameter called 'colour'"):
        lt.Effect("index-drift", colour="red")


def test_an_effect_of_a_users_class_is_fitted(recording):
    class Mine(lt.effects.find_effect("index-drift")):  # type: ignore[misc]
        """An index drift, by another class."""

    calibration = lt.calibrate(recording, with_effects=Mine(stations=("S3",)), advise=False)
    words = lt.calibrate(recording, with_effects="index-drift:S3", advise=False)
    assert calibration.effects[0].chi2_drop == pytest.approx(words.effects[0].chi2_drop)


def test_results_are_read_back_whatever_wrote_them(recording, tmp_path: Path):
    calibration = lt.calibrate(recording, advise=False)
    lt.write(calibration, tmp_path / "folder")
    assert lt.read(tmp_path / "folder").instrument_parameter_names == calibration.instrument_parameter_names
    truth = lt.simulate("paper-workshop").truth
    lt.write(truth, tmp_path / "truth.json")
    assert lt.read(tmp_path / "truth.json").construction == truth.construction
    (tmp_path / "other.json").write_text('{"format": "elsewhere/1"}')
    with pytest.raises(RecordError, match="no recording and no result of ltsim"):
        lt.read(tmp_path / "other.json")


def test_an_option_is_called_what_its_reader_calls_it(recording, tmp_path: Path, capsys):
    with pytest.raises(ModelError, match="robust, noise_from_data, datum, prior and with_effects need method network"):
        lt.calibrate(recording, method="distance", robust=True)
    lt.write(recording, tmp_path / "rec")
    assert run(["calibrate", str(tmp_path / "rec"), "--method", "distance", "--robust"]) == 2
    assert "--prior and --with need --method network" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda rec, cal: lt.simulate("paper-workshop", seed=-1), "seed is -1, expected a whole number, 0 or more"),
        (lambda rec, cal: lt.calibrate(cal), "expected a recording or the path of one, found a Calibration"),
        (lambda rec, cal: lt.compare(rec, cal), "expected a recording or the path of one, found a Calibration"),
        (
            lambda rec, cal: lt.inject(rec, "index-drift", noncentrality=-4),
            "noncentrality is -4, expected a number, 0.001 or more",
        ),
        (lambda rec, cal: lt.Effect("index-drift", index_drft=3), "only a simulation accepts, are index-drift"),
    ],
)
def test_invalid_inputs_are_refused_in_a_sentence(recording, call, says: str):
    with pytest.raises(LtsimError, match=says):
        call(recording, lt.calibrate(recording, advise=False))
