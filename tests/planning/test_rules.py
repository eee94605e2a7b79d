"""Rules of a plan are named, each with its numbers; what breaks one is never reached, whoever judges it."""

from __future__ import annotations

import json
import re
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltsim as lt
from ltsim.cli.main import run
from ltsim.core.errors import InputError
from ltsim.planning.loading import load_plan
from ltsim.planning.planner import evaluate_plan
from ltsim.planning.result import Plan, load_plan_and_scenario
from ltsim.planning.search import LayoutSearcher
from ltsim.planning.search_inputs import plan_without_search
from ltsim.planning.tolerances import (
    PointTolerances,
    ToleranceCheck,
    is_tolerance_met,
    plan_verdict,
    text_distinct_from_limit,
    tolerance_ratio_text,
)
from tests.planning.fixtures import SMALL_HALL_POINTS, small_hall_plan

PLAN = small_hall_plan(
    points='points = "points.csv"\n',
    obstacle=("crate", "[600, 600, 2500]"),
    height_mm="[1400, 1800]",
    floor="[[floor.keep_outs]]\ncorners_mm = [[3900, 700], [4300, 700], [4300, 1100], [3900, 1100]]\n",
    tolerance_mm=0.5,
)
POINTS = "name,x_mm,y_mm,z_mm\n" + "".join(f"{n},{x},{y},{z}\n" for n, (x, y, z) in SMALL_HALL_POINTS.items())


@pytest.fixture
def hall(tmp_path: Path) -> Path:
    (tmp_path / "points.csv").write_text(POINTS)
    (tmp_path / "hall.toml").write_text(PLAN)
    return tmp_path / "hall.toml"


@pytest.mark.parametrize(
    ("first", "second", "rule"),
    [
        (
            (2500, 2000),
            (2500, 2100),
            "S1 and S2 are 0.10 m apart, closer than 1 m (stations.spacing_mm)",
        ),
        ((300, 2000), (4000, 2000), "S1 stands outside the permitted floor (floor.corners_mm"),
        ((2500, 2000, 2100), (4000, 2000), "S1 stands with its head at 2100 mm, expected 1400 to 1800 mm (floor.he"),
        ((4100, 900), (2000, 2000), "S1 stands in an area to be kept free (floor.keep_outs, floor.doors)"),
        ((4500, 2800), (2000, 2000), "S1 stands inside an obstacle (workshop.obstacles: crate)"),
        ((4195, 2800), (2000, 2000), "S1 stands 0.005 m from crate, closer than 0.4 m (stations.clearance_mm)"),
    ],
)
def test_a_place_that_breaks_a_rule_is_refused_by_name(
    first: tuple[float, ...], second: tuple[float, ...], rule: str, hall: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError, match="^" + re.escape(f"move: {rule}")):
        lt.plan(hall, move={"S1": first, "S2": second})
    moves = [f"--move={name}={','.join(map(str, place))}" for name, place in (("S1", first), ("S2", second))]
    assert run(["plan", str(hall), *moves]) == 2
    assert f"--move: {rule}" in capsys.readouterr().err
    file, site = plan_without_search(*load_plan_and_scenario(hall))
    position = site.survey.station_positions.copy()
    for s, place in enumerate((first, second)):
        position[s, : len(place)] = np.array(place) / 1000
    survey = site.survey.replace(station_positions=position, is_visible=site.is_visible(position))
    assert rule in "; ".join(broken.sentence for broken in site.broken_rules(survey))
    assert LayoutSearcher(site, grid_step=1.5).evaluate_layout(position, survey.station_yaws).objective_value == np.inf
    assert file.stations.min_stations_per_target == 1


def test_clearance_from_bodies_is_set_by_the_plan_and_not_required_of_fixed_stations(hall: Path) -> None:
    near = {"S1": (3850, 2800), "S2": (5200, 1500)}
    with pytest.raises(InputError, match=r"S1 stands 0\.350 m from crate, closer than 0\.4 m \(stations.clearance"):
        lt.plan(hall, move=near)
    hall.write_text(PLAN.replace("[stations]", "[stations]\nclearance_mm = 340"))
    made = lt.plan(hall, move=near)
    assert not made.broken_rules
    assert "S1 is at the minimum clearance of 0.34 m from crate (stations.clearance_mm)." in made.reasons
    _, site = plan_without_search(*load_plan_and_scenario(hall))
    position = np.array([[4.195, 2.8, 1.5], [2.0, 2.0, 1.5]])
    survey = site.survey.replace(station_positions=position, is_visible=site.is_visible(position))
    fixed = site.replace(fixed_station_indices=(0,))
    for space, n_rules in ((site, 1), (fixed, 0)):
        assert len(space.broken_position_rules(survey)) == n_rules
        assert space.is_allowed_station(survey).tolist() == [n_rules == 0, True]
    assert site.stand_clearance is not None and site.stand_clearance.has_room(site.grid_station_positions(0.1, 1)).all()


def test_two_tripods_at_the_same_place_never_occur(hall: Path) -> None:
    """The spacing cannot be switched off, and stations that are not moved are tested too."""
    hall.write_text(PLAN.replace("[stations]", "[stations]\nspacing_mm = 0"))
    with pytest.raises(InputError, match=r"stations.spacing_mm is 0"):
        lt.plan(hall)
    hall.write_text(PLAN.replace("[stations]", "[stations]\nspacing_mm = 1"))
    with pytest.raises(InputError, match=r"^move: S1 and S2 are 0.00 m apart, closer than 0.001 m"):
        lt.plan(hall, move={"S1": (2500, 2000), "S2": (2500, 2000)})
    file, site = plan_without_search(*load_plan_and_scenario(hall))
    together = np.tile(site.survey.station_positions[:1], (2, 1))
    survey = site.survey.replace(station_positions=together, is_visible=site.is_visible(together))
    network = evaluate_plan(file, load_plan_and_scenario(hall)[1], survey)
    assert network.verdict is not None and not network.verdict.is_goal_reached
    assert not Plan.from_network(network).goal_reached and "S1 and S2" in Plan.from_network(network).summary


def test_the_rules_of_the_search_are_those_that_are_named(hall: Path) -> None:
    _, site = plan_without_search(*load_plan_and_scenario(hall))
    rng, searcher = np.random.default_rng(3), LayoutSearcher(site, grid_step=1.5)
    visible = set()
    for _ in range(40):
        position = rng.uniform((0.4, 0.4, 1.3), (5.6, 3.6, 1.9), (2, 3))
        named = site.broken_rules(site.survey.replace(station_positions=position, is_visible=site.is_visible(position)))
        taken = np.isfinite(searcher.evaluate_layout(position, np.zeros(2)).objective_value)
        assert taken <= (not named)
        visible.add(bool(named))
        joined = site.is_feasible(position[None], site.is_visible(position)[None])[0]
        assert (site.is_allowed(position).all() and joined) == (not named)
    assert visible == {True, False}


def test_each_rule_of_a_search_is_a_rule_that_is_named(hall: Path) -> None:
    """The search did not know that a station may not coincide with a target."""
    _, site = plan_without_search(*load_plan_and_scenario(hall))
    position = np.array([[2.5, 2.0, 1.5], [4.0, 2.0, 1.5]])
    survey = site.survey.replace(station_positions=position, is_visible=np.ones_like(site.survey.is_visible))
    points = survey.target_points.copy()
    points[0] = position[0] + [0, 0, 5e-4]
    same = site.replace(survey=survey.replace(target_points=points))
    batch = np.array([position, position]), np.array([survey.is_visible] * 2)
    assert site.is_feasible(*batch).tolist() == [True, True] and not site.broken_rules(survey)
    assert same.is_feasible(*batch).tolist() == [False, False]
    assert [rule.sentence for rule in same.broken_rules(same.survey)] == [
        f"station S1 coincides with target {survey.target_names[0]}"
    ]


def test_sights_that_break_a_rule_are_reported_and_never_reached(hall: Path) -> None:
    hall.write_text(PLAN.replace("min_stations_per_target = 1", "min_stations_per_target = 2"))
    content = lt.plan(hall, move={"S1": (3300, 3200), "S2": (5300, 2200, 1500, 30)})
    assert content.network.layout.survey.station_yaws[1] == pytest.approx(np.radians(30))
    assert any("fewer than 2 stations (stations.min_stations_per_target)" in rule for rule in content.broken_rules)
    assert content.goal_reached is False and content.tolerances_met
    assert content.summary.startswith("Not reached: the layout breaks a rule (")


@pytest.mark.parametrize("place", [(1.0,), (1, 2, 3, 4, 5), (float("nan"), 2.0), ()])
def test_a_move_has_two_to_four_numbers(place: tuple[float, ...], hall: Path) -> None:
    with pytest.raises(InputError, match=r"^move S1=.*: expected STATION=X,Y or"):
        lt.plan(hall, move={"S1": place})


def test_without_works_for_two_stations_and_prints_the_command_that_follows(
    hall: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    alone, *others = lt.station_alternatives(hall, "S2")
    assert alone.position_text == "without S2" and not alone.move_option
    assert others and all(
        station.move_option.startswith("S2=") and station.move_option.count(",") == 3 for station in others
    )
    assert [station.meets_goal for station in others] == sorted(
        [station.meets_goal for station in others], reverse=True
    )
    assert run(["plan", str(hall), "--without", "S2"]) == 0
    command = capsys.readouterr().out.splitlines()[-1].partition(": ltsim ")[2].split()
    assert command[:3] == ["plan", str(hall), "--move"]
    assert run([*command, "--quiet"]) == 0
    content = json.loads((tmp_path / "hall-moved" / "plan.json").read_text())
    assert [*content["stations"][1]["position_mm"], content["stations"][1]["yaw_deg"]] == pytest.approx(
        [float(v) for v in others[0].move_option.removeprefix("S2=").split(",")], abs=0.1
    )
    assert content["summary"].rstrip(".") == others[0].verdict


def test_the_number_of_stations_per_target_that_a_search_chose_is_no_rule_of_the_user(
    hall: Path, tmp_path: Path
) -> None:
    text = PLAN.replace("min_stations_per_target = 1", "")
    assert text != PLAN
    hall.write_text(text)
    assert run(["plan", str(hall), "--out", str(tmp_path / "made"), "--jobs", "1", "--starts", "1", "--quiet"]) == 0
    for folder in (tmp_path / "made", tmp_path / "moved"):
        if folder.name == "moved":
            x, y, *_ = json.loads((tmp_path / "made" / "plan.json").read_text())["stations"][0]["position_mm"]
            move = f"--move=S1={x},{y}"
            assert run(["plan", str(tmp_path / "made"), move, "--out", str(folder), "--quiet"]) == 0
        assert not load_plan_and_scenario(folder)[0].gives_min_stations_per_target
        assert not any(
            "min_stations_per_target" in alternative.verdict for alternative in lt.station_alternatives(folder, "S1")
        )


def test_a_tolerance_missed_by_a_little_is_not_met_and_is_displayed_so() -> None:
    demands = PointTolerances({"A": 1e-4})
    missed = ToleranceCheck("", demands.tolerance_by_point_m, {"A": 1.004e-4}, 1.004, "A")
    verdict = plan_verdict(demands, missed, [])
    assert not verdict.is_goal_reached and not missed.meets_all_tolerances and missed.exceeding_points == ["A"]
    assert verdict.sentences.endswith("worst point A: 0.1004 mm, limit 0.1 mm (0.4 % too large)")
    far = ToleranceCheck("", demands.tolerance_by_point_m, {"A": 1.236e-4}, 1.236, "A")
    assert "(24 % too large)" in far.worst_point_margin_text
    assert (
        tolerance_ratio_text(1.004) == "100.4 %"
        and tolerance_ratio_text(0.8543) == "85.4 %"
        and tolerance_ratio_text(1.0 + 1e-9).startswith("100.0000001")
    )
    assert (
        text_distinct_from_limit(0.1004, 0.1) == "0.1004"
        and text_distinct_from_limit(0.0999, 0.1) == "0.0999"
        and text_distinct_from_limit(0.25, 0.1) == "0.25"
    )
    assert is_tolerance_met(1.0) and not is_tolerance_met(np.nextafter(1.0, 2.0)) and not is_tolerance_met(np.inf)


def test_the_page_marks_what_the_verdict_does_not_keep(hall: Path, tmp_path: Path) -> None:
    from ltsim.reports.document_model import TableBlock
    from ltsim.reports.sections.plan import _tolerance_tables

    move = {"S1": (1200, 2000), "S2": (4700, 1200)}
    made = lt.plan(hall, move=move).network
    worst = made.tolerance_check.error_by_point_m[made.tolerance_check.worst_point_name]  # type: ignore[union-attr]
    hall.write_text(PLAN.replace("tolerance_mm = 0.5", f"tolerance_mm = {worst * 1000 / 1.0004!r}"))
    content = lt.plan(hall, move=move)
    (grid, *_) = _tolerance_tables(content)
    assert isinstance(grid, TableBlock) and len(grid.marked_rows) == 1 and content.goal_reached is False
    (row,) = (grid.rows[i] for i in grid.marked_rows)
    assert row[0] == made.tolerance_check.worst_point_name and row[3] == "100.04 %"  # type: ignore[union-attr]
    assert [entry.tolerance_met for entry in content.reflectors if entry.name == row[0]] == [False]


@pytest.mark.parametrize("rows", [200, 31])
def test_places_of_reflectors_are_bounded_before_any_is_made(rows: int, hall: Path, tmp_path: Path) -> None:
    """40,000,000 places of 1,000 surfaces would take gigabytes for their names alone."""
    surface = (
        "[[reflectors.surfaces]]\nname = 'w{}'\norigin_mm = [0, 0, 0]\nacross_mm = [6000, 0, 0]\nup_mm = [0, 0, 3000]\n"
        f"rows = {rows}\ncolumns = 100\n"
    )
    count = 1000 if rows == 200 else 1
    file = tmp_path / "many.toml"
    file.write_text(
        'format = "ltsim-plan/1"\nscenario = "paper-workshop"\n' + "".join(map(surface.format, range(count)))
    )
    with pytest.raises(InputError, match=f"reflectors: {count * rows * 100} candidate places, expected at most 3000"):
        lt.plan(file)


def test_a_fine_grid_of_a_hall_is_refused_before_it_is_built(tmp_path: Path) -> None:
    """A million places took 1.3 GB and 27 s; a thousandth of a millimetre would take all memory."""
    (tmp_path / "points.csv").write_text(POINTS)
    (tmp_path / "plan.toml").write_text(re.sub(r"grid_step_mm = .*", "grid_step_mm = 5", PLAN))
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"a grid of 5 mm .* the limit is 200000"):
            load_plan(tmp_path / "plan.toml")
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()


def test_lists_of_a_plan_hold_each_value_once(tmp_path: Path) -> None:
    """390,000 times one effect took 40 s before the search began."""
    (tmp_path / "points.csv").write_text(POINTS)
    effects = '[goal]\neffects = ["range-step", "range-step"]\n'
    (tmp_path / "plan.toml").write_text(PLAN.replace("[[goal.tolerances]]", f"{effects}[[goal.tolerances]]"))
    plan, _ = load_plan(tmp_path / "plan.toml")
    assert plan.goal.effects == ("range-step",)


def test_parts_of_a_floor_are_bounded(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text(POINTS)
    door = "[[floor.doors]]\nfrom_mm = [0, 0]\nto_mm = [1, 0]\n"
    (tmp_path / "plan.toml").write_text(PLAN + door * 201)
    with pytest.raises(InputError, match=r"floor\.doors .*at most 200"):
        load_plan(tmp_path / "plan.toml")


def test_points_of_a_plan_are_bounded(tmp_path: Path) -> None:
    """16,000 points took 2.1 GB."""
    (tmp_path / "points.csv").write_text("name,x_mm,y_mm,z_mm\n" + "".join(f"P{i},{i},1,2\n" for i in range(2001)))
    (tmp_path / "plan.toml").write_text('format = "ltsim-plan/1"\npoints = "points.csv"\n')
    with pytest.raises(InputError, match="2001 points, expected at most 2000"):
        lt.plan(tmp_path / "plan.toml")


def test_a_search_reads_the_plan_once(hall: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read_files = []

    def load_and_count(source: str | Path) -> Any:
        read_files.append(Path(source))
        return load_plan(source)

    monkeypatch.setattr("ltsim.planning.result.load_plan", load_and_count)
    assert run(["plan", str(hall), "--out", str(tmp_path / "out"), "--jobs", "1", "--quiet"]) == 0
    assert read_files == [hall]
    assert not (tmp_path / "out" / "best-so-far.toml").exists()
