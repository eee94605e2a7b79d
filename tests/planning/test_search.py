"""Search: what it returns is what it says, keeps the rules, and is the same every time."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest

from ltsim.core.arrays import Floats
from ltsim.core.errors import SetupError
from ltsim.core.randomness import stream
from ltsim.physics.effects.station_weather import StationWeather
from ltsim.physics.model.construction import misalignment_construction
from ltsim.planning.information import LayoutInformation
from ltsim.planning.loading import load_plan
from ltsim.planning.objective import DIAGNOSIS, INSTRUMENT, TARGETS, Objective, a_criterion, d_criterion
from ltsim.planning.reflectors import choose_reflectors
from ltsim.planning.search import LayoutSearcher
from ltsim.planning.site import SearchSpace
from ltsim.planning.starts import PlanningProblem, SearchTask
from ltsim.scene.floor import Area, inside
from ltsim.scene.meshes import box, joined_obstacles, transformed
from ltsim.scene.visibility import SightLimits, aimed_normals, visibility
from tests.planning.fixtures import survey

FLOOR = np.array([[0.6, 0.6], [5.6, 0.6], [5.6, 5.6], [0.6, 5.6]])


def site(stations: int = 3, **changes: object) -> SearchSpace:
    made = survey((1,), stations)
    whole = SearchSpace(
        made, (Area(FLOOR, (1.5, 2.1)),), SightLimits(), aimed=np.zeros(28, dtype=bool), min_sights=stations
    )
    return whole.replace(**changes)


def searcher(where: SearchSpace, objective: Objective | None = None) -> LayoutSearcher:
    return LayoutSearcher(where, objective or Objective(), step=1.25, yaws=4, heights=1)


def information(where: SearchSpace, position: Floats, yaw: Floats) -> LayoutInformation:
    visible = where.visible(position)
    return LayoutInformation.of(where.survey.replace(position=position, yaw=yaw, visible=visible))


@pytest.fixture(scope="module")
def found():  # type: ignore[no-untyped-def]
    return searcher(site()).from_start(4, 1)


def test_the_value_is_that_of_the_layout_it_returns(found) -> None:  # type: ignore[no-untyped-def]
    covariance = information(site(), found.position, found.yaw).scaled_covariance
    assert found.value == pytest.approx(float(d_criterion(covariance)), rel=1e-8)


def test_a_search_beats_the_layout_it_did_not_know_and_keeps_the_rules(found) -> None:  # type: ignore[no-untyped-def]
    where = site()
    own = searcher(where).evaluate(where.survey.position, where.survey.yaw)
    assert found.value < 0.8 * own.value
    assert where.allowed(found.position).all()
    assert where.visible(found.position).all()
    gap = np.linalg.norm(found.position[:, None, :2] - found.position[None, :, :2], axis=2)[np.triu_indices(3, 1)]
    assert gap.min() >= where.spacing - 1e-9


def test_no_single_station_of_the_grid_improves_it(found) -> None:  # type: ignore[no-untyped-def]
    work = searcher(site())
    here = work.layout(found.position, found.yaw)
    for slot in range(3):
        assert work.best_replacement(here, slot, work.table(slot))[1] > found.value * (1 - 1e-3)


def test_a_search_is_reproducible_from_its_seed(found) -> None:  # type: ignore[no-untyped-def]
    again = searcher(site()).from_start(4, 1)
    assert np.array_equal(again.position, found.position)
    assert np.array_equal(again.yaw, found.yaw)
    other = searcher(site()).from_start(5, 1)
    assert not np.array_equal(other.position, found.position)


LONG_HALL = """format = "ltsim-plan/1"
points = "points.csv"
[workshop]
size_mm = [40000, 25000, 12000]
[[workshop.obstacles]]
box_mm = [28000, 4000, 6000]
position_mm = [20000, 12500, 0]
[instrument]
preset = "modern"
[instrument.limits]
range_max_mm = 20000
[[floor.areas]]
corners_mm = [[1000, 1000], [39000, 1000], [39000, 2500], [1000, 2500]]
[[floor.areas]]
corners_mm = [[1000, 22500], [39000, 22500], [39000, 24000], [1000, 24000]]
[[floor.areas]]
corners_mm = [[1000, 2500], [5000, 2500], [5000, 22500], [1000, 22500]]
[stations]
count = 4
min_stations_per_target = 1
[search]
grid_mm = 1500
yaws = 1
heights = 1
"""


def test_stations_that_share_too_little_are_bound_together(tmp_path: Path) -> None:
    """Points on both sides of a long body: each is in sight, but what stands on one side is not tied to the other."""
    sides = product((8000, 14000, 20000, 26000, 32000), (10470, 14530), (2000, 4000))
    walls = product((300, 39700), (300, 24700), (2500,))
    places = [*sides, *walls, (20000, 300, 2500), (20000, 24700, 2500), (39700, 12500, 2500)]
    rows = [f"P{i},{x},{y},{z}" for i, (x, y, z) in enumerate(places)]
    (tmp_path / "points.csv").write_text("\n".join(["name,x_mm,y_mm,z_mm", *rows]))
    (tmp_path / "hall.toml").write_text(LONG_HALL)
    file, scenario = load_plan(tmp_path / "hall.toml")
    problem = PlanningProblem(file, scenario)
    work = problem.searcher(problem.site(SearchTask(4, 1, 0)))
    drawn = [work.random_layout(stream(0, "plan", 4, k)) for k in range(4)]
    apart = [layout for layout in drawn if not np.isfinite(work._value(layout))]
    assert len(apart) > 1
    bound = [work._bound(layout) for layout in apart]
    assert sum(np.isfinite(work._value(layout)) for layout in bound) > 1
    assert all(work.site.feasible(layout.position[None], layout.visible[None])[0] for layout in bound)
    assert all(
        work.site.connectivity(b.visible[None]) > work.site.connectivity(a.visible[None])
        for a, b in zip(apart, bound, strict=True)
    )


def test_a_fixed_station_stays() -> None:
    where = site(fixed=(0,))
    made = searcher(where).from_start(1, 2)
    assert np.array_equal(made.position[0], where.survey.position[0])
    assert made.yaw[0] == pytest.approx(where.survey.yaw[0])


def test_an_obstacle_moves_the_plan_out_of_its_way(found) -> None:  # type: ignore[no-untyped-def]
    """A machine at a station of the plan: nobody stands in it, everything is still in sight, at a price."""
    pillar = transformed(box(np.array([0.5, 0.5, 1.2])), np.array([*found.position[0, :2], 0.0]), 0.0)
    where = site(obstacles=joined_obstacles([pillar]))
    work = LayoutSearcher(where, step=0.8, yaws=4, heights=1)
    assert work.evaluate(found.position, found.yaw).value == np.inf
    made = work.from_start(4, 1)
    assert not joined_obstacles([pillar]).encloses(made.position).any()
    assert visibility(
        made.position, where.survey.points, where.limits, obstacles=joined_obstacles([pillar])
    ).visible.all()
    free = LayoutSearcher(site(), step=0.8, yaws=4, heights=1).from_start(4, 1)
    assert made.value > 0.97 * min(free.value, found.value)


def test_sights_past_an_edge_hold_when_the_tripod_stands_off_its_place() -> None:
    """From the height of a table's top a point on it is in sight, from 40 mm lower it is not."""
    table = joined_obstacles([transformed(box(np.array([1.0, 1.0, 1.0])), np.array([3.0, 3.0, 0.0]), 0.0)])
    point = np.array([[3.0, 3.0, 1.0]])
    heads = np.array([[1.0, 3.0, height] for height in (1.001, 1.04, 1.2)])
    assert site(obstacles=table).visible(heads, point)[:, 0].tolist() == [True, True, True]
    assert site(obstacles=table, position_tolerance=0.05).visible(heads, point)[:, 0].tolist() == [False, False, True]


def test_all_targets_that_no_place_sees_are_named() -> None:
    with pytest.raises(SetupError, match=r"no place on the floor sees \w+, .*, from heads at .* mm; raise the heads"):
        searcher(site(limits=SightLimits(range_max=2.0))).from_start(0, 1)


def test_least_stations_a_target_lets_single_sights_go() -> None:
    where = site(4, min_sights=2, limits=SightLimits(range_max=5.5))
    made = searcher(where).from_start(0, 1)
    visible = where.visible(made.position)
    assert not visible.all()
    assert (visible.sum(axis=0) >= 2).all()
    with pytest.raises(SetupError, match="no place on the floor sees every reflector"):
        searcher(site(limits=SightLimits(range_max=5.5))).from_start(0, 1)


def test_fixed_nests_are_served_by_all_stations() -> None:
    aimed = np.ones(28, dtype=bool)
    where = site(aimed=aimed)
    made = searcher(where).from_start(0, 1)
    half = aimed_normals(made.position, where.survey.points)[1]
    assert half.max() <= where.limits.acceptance
    free = searcher(site()).from_start(0, 1)
    assert aimed_normals(free.position, where.survey.points)[1].max() > where.limits.acceptance


def test_targets_and_diagnosis_are_goals_of_their_own() -> None:
    where = site()
    effects = tuple(StationWeather(stations=(name,)) for name in where.survey.station_names)
    goals = {TARGETS: Objective({TARGETS: 1.0}), DIAGNOSIS: Objective({DIAGNOSIS: 1.0}, effects=effects)}
    best = {name: searcher(where, goal).from_start(2, 1) for name, goal in goals.items()}
    rms = {name: information(where, made.position, made.yaw).target_rms for name, made in best.items()}
    assert best[TARGETS].value == pytest.approx(rms[TARGETS], rel=1e-8)
    assert rms[TARGETS] < rms[DIAGNOSIS]
    judge = searcher(where, goals[DIAGNOSIS])
    assert best[DIAGNOSIS].value < judge.evaluate(best[TARGETS].position, best[TARGETS].yaw).value
    mixed = searcher(where, Objective({INSTRUMENT: 1.0, TARGETS: 1.0}, "A")).from_start(2, 1)
    slow = information(where, mixed.position, mixed.yaw)
    mean = np.sqrt(float(a_criterion(slow.scaled_covariance)) * slow.target_rms)
    assert mixed.value == pytest.approx(mean, rel=1e-8)


def test_reflectors_move_to_better_places_and_the_gauge_stays() -> None:
    along, height = np.meshgrid(np.linspace(0.3, 5.7, 6), [0.15, 2.0, 4.0, 5.9])
    wall = np.stack([np.zeros(24), along.ravel(), height.ravel()], axis=1)
    places = np.concatenate([wall, wall[:, [1, 0, 2]]])
    names = tuple(f"P{i}" for i in range(len(places)))
    where = site(nests=places, nest_names=names, reflector_spacing=0.5)
    stays = np.arange(28) >= 24
    made = choose_reflectors(where, where.survey, stays, Objective(), misalignment_construction())
    before = d_criterion(LayoutInformation.of(where.survey).scaled_covariance)
    after = d_criterion(LayoutInformation.of(made).scaled_covariance)
    assert after < 0.97 * before
    assert len(made.target_names) == len(set(made.target_names)) == 28
    assert made.points[:4] == pytest.approx(where.survey.points[24:])
    moved = made.points[4:]
    gap = np.linalg.norm(moved[:, None] - moved[None], axis=2)[np.triu_indices(24, 1)]
    assert gap.min() > 0.4


def test_points_inside_a_floor_that_is_not_convex() -> None:
    room = np.array([[0.0, 0], [4, 0], [4, 4], [2, 4], [2, 2], [0, 2]])
    points = np.array([[1.0, 1], [1, 3], [3, 3], [2, 3], [4, 4], [5, 1]])
    assert inside(room, points).tolist() == [True, False, True, True, True, False]
