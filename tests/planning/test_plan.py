"""From a plan file to files that a person and the simulator can use; what is wrong with a file, in one sentence."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

import ltsim as lt
from ltsim.cli.main import run
from ltsim.core.errors import InputError, ModelError
from ltsim.planning import multistart_search
from ltsim.planning.expected_precision import ExpectedPrecision
from ltsim.planning.loading import builtin_plan_names, builtin_plan_text, load_plan
from ltsim.planning.plan_search import SearchCallbacks, make_plan
from ltsim.planning.planner import PlannedNetwork
from ltsim.planning.reasons import fewest_stations_not_worse_than_scenario
from ltsim.planning.result import Plan, scenario_of_plan, write_plan
from ltsim.planning.search import LayoutSearcher
from ltsim.planning.search_inputs import planned_survey
from ltsim.planning.spec import PlanFile, SearchSettings
from ltsim.simulation.scenario import change_scenario, load_scenario, scenario_to_toml
from ltsim.simulation.workshop import make_visibility

HEAD = 'format = "ltsim-plan/1"\n'


def small(text: str, tmp_path: Path, starts: int = 1) -> Path:
    path = tmp_path / "plan.toml"
    search = f"[search]\nstarts = {starts}\ngrid_step_mm = 1200\nyaw_count = 3\nheight_count = 1\n"
    path.write_text(HEAD + text + search, encoding="utf-8")
    return path


def table(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> PlannedNetwork:
    text = "[stations]\ncount = 4\ntradeoff_counts = [3]\n[budget]\nfaces = [1]\nrepeats = [1, 2]\nmax_hours = 24\n"
    return make_plan(*load_plan(small(text, tmp_path_factory.mktemp("plan"))))


@pytest.fixture(scope="module")
def result(plan: PlannedNetwork) -> Plan:
    return Plan.from_network(plan)


def test_a_plan_is_drawn_with_its_tripods_and_points(result: Plan) -> None:
    survey, figure = result.network.layout.survey, result.plot()
    assert isinstance(figure, Figure)
    floor = figure.axes[0]
    assert (floor.get_xlabel(), floor.get_ylabel()) == ("x [m]", "y [m]")
    marks = np.concatenate([np.asarray(points.get_offsets()) for points in floor.collections])
    for place in (*survey.station_positions[:, :2], *survey.target_points[:, :2]):
        assert np.abs(marks - place).max(axis=1).min() < 1e-4
    assert {text.get_text() for text in floor.texts} >= set(survey.station_names)


def test_a_scenario_as_a_survey_is_its_recording() -> None:
    """Same pointings, same clock, as the simulator makes them."""
    from ltsim.simulation.simulator import simulate

    scenario = load_scenario("paper-workshop")
    made = planned_survey(scenario)
    recording, _ = simulate(scenario, 0)
    ours = made.noise_free_recording(ExpectedPrecision.from_survey(made).construction)
    assert np.array_equal(ours.station, recording.station)
    assert np.array_equal(ours.target, recording.target)
    assert ours.time == pytest.approx(recording.time)
    assert np.abs(ours.readings[:, 0] - recording.readings[:, 0]).max() < 0.1


def test_the_plan_is_better_than_the_scenario_and_says_by_how_much(plan: PlannedNetwork, result: Plan) -> None:
    assert plan.scenario_layout_evaluation is not None
    content = result
    factor = plan.scenario_layout_evaluation.qualities["instrument"] / plan.layout.qualities["instrument"]
    assert factor > 1.05
    assert any(
        f"the precision of the instrument parameters is {factor:.2f} times better" in sentence
        for sentence in content.reasons
    )
    assert len(content.stations) == 4
    assert content.qualities["instrument"] == pytest.approx(plan.layout.objective_value)


def test_ranges_alone_are_planned_for(tmp_path: Path) -> None:
    """Stations are searched for the points that ranges place; no angle is asked for, compared or advised."""
    (tmp_path / "ranges.toml").write_text(scenario_to_toml(load_scenario("paper-workshop-re-aimed")), encoding="utf-8")
    scenario = 'scenario = "ranges.toml"\n'
    goal = "[goal]\ninstrument_weight = 0\ntargets_weight = 1\n[stations]\ncount = 4\ntradeoff_counts = []\n"
    file, whole = load_plan(small(scenario + goal, tmp_path))
    ranges = change_scenario(whole, {"instrument.observables": ["distance"]}, Path("ranges.toml"))
    made = make_plan(file, ranges)
    assert made.scenario_layout_evaluation is not None
    assert made.layout.qualities["targets"] < 0.7 * made.scenario_layout_evaluation.qualities["targets"]
    assert made.layout.expected_disagreement is None
    content = Plan.from_network(made)
    assert {p.name for p in content.parameters} == {"range-offset", "range-scale", "transit-offset"}
    with pytest.raises(InputError, match="but the plan requires only 2 to see it"):
        make_plan(
            file.model_copy(update={"stations": file.stations.model_copy(update={"min_stations_per_target": 2})}),
            ranges,
        )


def test_the_curve_knows_cost_and_quality(plan: PlannedNetwork) -> None:
    hours = [option.hours for option in plan.tradeoff_points]
    assert hours == sorted(hours)
    efficient = [option.objective_value for option in plan.tradeoff_points if option.is_efficient]
    assert efficient == sorted(efficient, reverse=True)
    ways = {(len(o.survey.station_positions), o.survey.repeats) for o in plan.tradeoff_points}
    assert ways == {(n, r) for n in (3, 4) for r in (1, 2)}
    point = next(o for o in plan.tradeoff_points if len(o.survey.station_positions) == 3 and o.survey.repeats == 1)
    assert point.survey.duration == 3 * (20 * 60 + 28 * 15)
    few = fewest_stations_not_worse_than_scenario(plan)
    assert few is not None
    assert len(few.survey.station_positions) <= 4


def test_files_hold_what_a_tripod_needs(plan: PlannedNetwork, result: Plan, tmp_path: Path) -> None:
    content = write_plan(result, tmp_path / "out")
    saved = json.loads((tmp_path / "out" / "plan.json").read_text(encoding="utf-8"))
    assert {**saved, "files": {}} == json.loads(json.dumps(content.content())) | {"files": {}}
    rows = table(tmp_path / "out" / "stations.csv")
    places = np.array([[float(row[k]) for k in ("x_mm", "y_mm", "z_mm")] for row in rows])
    assert places == pytest.approx(plan.layout.survey.station_positions * 1e3, abs=0.06)
    assert all(row["sees"] == "yes" for row in table(tmp_path / "out" / "visibility.csv"))
    scenario = load_scenario(tmp_path / "out" / "scenario.toml")
    assert make_visibility(scenario).is_visible.all()
    again = ExpectedPrecision.from_survey(planned_survey(scenario))
    assert again.instrument_sigmas == pytest.approx(plan.layout.expected_precision.instrument_sigmas, rel=2e-3)


def test_a_planned_scenario_keeps_the_instrument_and_the_gauge(plan: PlannedNetwork) -> None:
    made = scenario_of_plan(plan)
    assert made.gauge == plan.scenario.gauge
    assert made.instrument == plan.scenario.instrument
    assert made.target_names == plan.scenario.target_names


@pytest.mark.long
def test_the_number_of_jobs_changes_nothing(tmp_path: Path) -> None:
    file, scenario = load_plan(small("[stations]\ncount = 3\n", tmp_path))
    assert Plan.from_network(make_plan(file, scenario, jobs=2)) == Plan.from_network(make_plan(file, scenario))


def test_an_obstacle_changes_visibility_information_and_plan(tmp_path: Path) -> None:
    """A cabinet before a wall: the scenario's own layout loses sights, the plan does not."""
    base = load_scenario("paper-workshop-re-aimed")
    (tmp_path / "with.toml").write_text(_with_cabinet(base), encoding="utf-8")
    text = 'scenario = "with.toml"\n[stations]\ncount = 3\n'
    made = make_plan(*load_plan(small(text, tmp_path)))
    assert made.scenario_layout_evaluation is not None
    assert not made.scenario_layout_evaluation.survey.is_visible.all()
    near = r"S\d stands 0\.\d+ m from cabinet, closer than 0\.4 m .stations\.clearance_mm."
    broken = rf"breaks rules of the plan: {near}.*; T.* fewer than 5 stations .stations.min_stations_per_target. .S"
    assert any(re.search(broken, sentence) for sentence in Plan.from_network(made).reasons)
    assert made.layout.survey.is_visible.all()
    x, y, _ = made.layout.survey.station_positions.T
    assert not ((np.abs(x - 3.6) < 0.3) & (np.abs(y - 2.6) < 0.3)).any()


def _with_cabinet(scenario) -> str:  # type: ignore[no-untyped-def]
    from ltsim.simulation.scenario import scenario_to_toml
    from ltsim.simulation.sections import Obstacle

    cabinet = Obstacle(name="cabinet", box_mm=(600, 600, 1700), position_mm=(3600, 2600, 0))
    workshop = scenario.workshop.model_copy(update={"obstacles": (cabinet,)})
    return scenario_to_toml(scenario.model_copy(update={"workshop": workshop}))


@pytest.mark.long
def test_a_budget_in_hours_buys_the_best_that_it_pays_for(tmp_path: Path) -> None:
    text = "[stations]\ncount = 3\n[budget]\nfaces = [1]\nrepeats = [1, 2]\nmax_hours = 1.8\n"
    made = make_plan(*load_plan(small(text, tmp_path)))
    assert made.layout.survey.repeats == 2
    poor = text.replace("1.8", "0.5")
    with pytest.raises(InputError, match=r"the fastest procedure takes 1\.4 h"):
        make_plan(*load_plan(small(poor, tmp_path)))


def test_ctrl_c_keeps_the_best_layout_so_far(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Somebody ends the search after the exchange on the grid: the plan is the layout that it had then, and says so."""
    exchanged = []

    def stop(_searcher: LayoutSearcher, layout: Any, value: float, _rng: object) -> None:
        exchanged.append((layout.setup_positions, value))
        raise KeyboardInterrupt

    monkeypatch.setattr(LayoutSearcher, "refine_off_grid", stop)
    lines: list[str] = []
    file, scenario = load_plan(small("[stations]\ncount = 3\n", tmp_path))
    made = make_plan(file, scenario, callbacks=SearchCallbacks(on_progress_sentence=lines.append))
    ((position, value),) = exchanged
    assert made.layout.survey.station_positions == pytest.approx(position)
    assert made.layout.objective_value == pytest.approx(value, rel=1e-6)
    assert Plan.from_network(made).reasons[-1].startswith("The search was stopped")
    assert lines and lines[0].startswith("best layout so far: 3 stations")


@pytest.mark.long
def test_the_best_so_far_is_given_on_the_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(multistart_search, "MIN_REPORT_INTERVAL", 0.0)
    layouts: list[Any] = []
    file, scenario = load_plan(small("[stations]\ncount = 3\n", tmp_path))
    scenarios: list[Any] = []
    callbacks = SearchCallbacks(on_better_layout=layouts.append, on_scenario=scenarios.append)
    made = make_plan(file, scenario, callbacks=callbacks)
    assert scenarios == [scenario]
    assert layouts
    assert layouts[-1].target_names == made.layout.survey.target_names
    assert made.search_space.is_allowed(layouts[-1].station_positions).all()


def test_built_in_plans_load_and_print() -> None:
    assert builtin_plan_names()[0] == "paper-workshop"
    made, scenario = load_plan("paper-workshop")
    assert made.stations.count == 5
    assert len(scenario.targets) == 24
    assert "height_mm" in builtin_plan_text("paper-workshop")
    assert load_plan("paper-laboratory")[0] == PlanFile(scenario="paper-laboratory")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[stations]\ncont = 5\n", "unknown key stations.cont; did you mean count"),
        ("[stations]\ncount = 1\n", "stations.count is 1"),
        (
            '[stations]\nfixed_stations = ["S9"]\n',
            "stations.fixed_stations names 'S9', which does not exist; did you mean S",
        ),
        ("[stations]\nmin_stations_per_target = 7\n", "min_stations_per_target is 7, but there are 5 stations"),
        ('[goal]\ncriterion = "T"\n', "goal.criterion"),
        ("[goal]\ninstrument_weight = 0\n", "at least one of instrument_weight, targets_weight and diagnosis_weight"),
        ('[goal]\ndiagnosis_weight = 1\neffects = ["stationweather"]\n', "did you mean station-weather"),
        ("[floor]\nheight_mm = [2000, 1500]\n", "must give the lower height first"),
        ("[floor]\ncorners_mm = [[0, 0], [1, 1]]\n", "corners_mm"),
        (
            "[floor]\ncorners_mm = [[0, 0, 1, 2], [1, 1], [2, 3]]\n",
            "floor.corners_mm.1 is [0, 0, 1, 2], but it should hold at most 2",
        ),
        ("[[points]]\nposition_mm = [1, 2, 3, 4]\n", "unknown key points.1.position_mm"),
    ],
)
def test_a_wrong_file_is_refused_in_a_sentence(text: str, sentence: str, tmp_path: Path) -> None:
    path = tmp_path / "plan.toml"
    path.write_text(HEAD + text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        load_plan(path)
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_such_file_and_no_floor(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file, and no built-in plan"):
        load_plan(tmp_path / "nowhere.toml")
    file = PlanFile.model_validate({"floor": {"margin_mm": 3000}})
    with pytest.raises(InputError, match="leaves no floor"):
        make_plan(file.model_copy(update={"search": SearchSettings(starts=1)}), load_scenario("paper-workshop"))


def test_the_command_leaves_coordinates_and_a_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = small("[stations]\ncount = 3\n", tmp_path)
    assert run(["plan", str(path), "--out", str(tmp_path / "out"), "--jobs", "1", "--seed", "3"]) == 0
    output = capsys.readouterr().out
    assert "Positions of the tripod" in output
    written = {file.name for file in (tmp_path / "out").iterdir()}
    assert {"floor.png", "tradeoff.png", "stations.csv", "plan.json", "scenario.toml"} <= written
    assert (tmp_path / "out" / "floor.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads((tmp_path / "out" / "plan.json").read_text(encoding="utf-8"))["seed"] == 3
    assert run(["plan", "paper-workshop", "--show"]) == 0
    assert capsys.readouterr().out == builtin_plan_text("paper-workshop")


@pytest.mark.parametrize("arguments", [["plan"], ["plan", "nothing"], ["plan", "paper-workshop", "--between", "a,b"]])
def test_bad_usage_is_refused_in_a_sentence(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(arguments) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_a_plan_is_declared_once(result: Plan, tmp_path: Path) -> None:
    """Python object, JSON, CSV files, terminal and page are one model with its tables."""
    from ltsim.planning.tables import PLAN_TABLES
    from ltsim.reports.sections import result_section

    folder = tmp_path / "out"
    lt.write(result, folder)
    content = lt.read(folder / "plan.json")
    assert type(content) is type(result)
    assert content.model_dump(exclude={"files"}) == result.model_dump(exclude={"files"})
    names = set(result._table_makers())
    assert {table.name for table in PLAN_TABLES} == names | {"visibility", "work-order"}
    for name in names:
        table = result.table(name)
        assert content.table(name) == table and (folder / table.file).read_text() == table.csv_text()
        assert [column.name for column in table.columns if not column.meaning] == []
    assert repr(result).splitlines()[0] == content.summary == repr(content).splitlines()[0]
    shown = result_section(content).terminal_text()
    for name in ("stations", "tradeoff"):
        assert all(cell in shown for row in result.table(name).displayed_cells() for cell in row)
    with pytest.raises(ModelError, match=r"^a plan read from a file has no arrays"):
        content.plot()


def test_tolerances_of_a_plan_are_a_table(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text("name,x_mm,y_mm,z_mm\nA,500,300,500\nB,5500,300,2000\nC,3000,3700,800\n")
    text = 'format = "ltsim-plan/1"\npoints = "points.csv"\n[workshop]\nsize_mm = [6000, 4000, 3000]\n'
    text += "[stations]\ncount = 2\n[[goal.tolerances]]\ntolerance_mm = 0.5\n"
    (tmp_path / "hall.toml").write_text(text)
    made = lt.plan(tmp_path / "hall.toml", move={"S1": (1200, 2000), "S2": (4700, 2000)})
    table = made.table("tolerances")
    assert table.column("point") == ["A", "B", "C"] and table.column("tolerance_met") == [True, True, True]
    assert table.column("tolerance_mm") == [0.5, 0.5, 0.5]
    check = made.network.tolerance_check
    assert check is not None
    assert table.column("point_error_mm") == pytest.approx([1e3 * check.error_by_point_m[name] for name in "ABC"])
    assert {"S1", "S2"} <= set(made.table("losses").column("lost_station_or_sight"))
