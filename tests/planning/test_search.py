"""Search: what it returns is what it says, keeps the rules, and is the same every time."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest

from ltsim.core.arrays import Floats
from ltsim.core.errors import InputError
from ltsim.core.randomness import random_stream
from ltsim.physics.effects.station_weather import StationWeather
from ltsim.physics.model.construction import misalignment_construction
from ltsim.planning.expected_precision import ExpectedPrecision
from ltsim.planning.loading import load_plan
from ltsim.planning.multistart_search import PlanningProblem, SearchTask
from ltsim.planning.objective import (
    DIAGNOSIS_QUALITY_NAME,
    INSTRUMENT_QUALITY_NAME,
    TARGETS_QUALITY_NAME,
    LayoutObjective,
    a_criterion,
    d_criterion,
)
from ltsim.planning.reflectors import choose_reflectors
from ltsim.planning.search import LayoutSearcher
from ltsim.planning.search_space import SearchSpace
from ltsim.scene.floor import StandingArea, is_inside_outline
from ltsim.scene.meshes import box_triangles, join_obstacles, rotate_and_shift_triangles
from ltsim.scene.visibility import SightLimits, compute_visibility, nest_normals_of_smallest_incidence
from tests.planning.fixtures import survey

FLOOR = np.array([[0.6, 0.6], [5.6, 0.6], [5.6, 5.6], [0.6, 5.6]])


def site(stations: int = 3, **changes: object) -> SearchSpace:
    made = survey((1,), stations)
    whole = SearchSpace(
        made,
        (StandingArea(FLOOR, (1.5, 2.1)),),
        SightLimits(),
        is_aimed_nest=np.zeros(28, dtype=bool),
        min_sights_per_target=stations,
    )
    return whole.replace(**changes)


def searcher(where: SearchSpace, objective: LayoutObjective | None = None) -> LayoutSearcher:
    return LayoutSearcher(where, objective or LayoutObjective(), grid_step=1.25, n_yaws=4, n_heights=1)


def information(where: SearchSpace, position: Floats, yaw: Floats) -> ExpectedPrecision:
    visible = where.is_visible(position)
    return ExpectedPrecision.from_survey(
        where.survey.replace(station_positions=position, station_yaws=yaw, is_visible=visible)
    )


@pytest.fixture(scope="module")
def best_layout():  # type: ignore[no-untyped-def]
    return searcher(site()).search_from(4, 1)


def test_the_value_is_that_of_the_layout_it_returns(best_layout) -> None:  # type: ignore[no-untyped-def]
    covariance = information(site(), best_layout.positions, best_layout.yaws).covariance_in_prior_sigmas
    assert best_layout.objective_value == pytest.approx(float(d_criterion(covariance)), rel=1e-8)


def test_a_search_beats_the_layout_it_did_not_know_and_keeps_the_rules(best_layout) -> None:  # type: ignore[no-untyped-def]
    where = site()
    start_layout = searcher(where).evaluate_layout(where.survey.station_positions, where.survey.station_yaws)
    assert best_layout.objective_value < 0.8 * start_layout.objective_value
    assert where.is_allowed(best_layout.positions).all()
    assert where.is_visible(best_layout.positions).all()
    gap = np.linalg.norm(best_layout.positions[:, None, :2] - best_layout.positions[None, :, :2], axis=2)[
        np.triu_indices(3, 1)
    ]
    assert gap.min() >= where.min_station_spacing - 1e-9


def test_no_single_station_of_the_grid_improves_it(best_layout) -> None:  # type: ignore[no-untyped-def]
    work = searcher(site())
    here = work.normal_blocks_of_layout(best_layout.positions, best_layout.yaws)
    for slot in range(3):
        assert work.best_replacement(here, slot, work.normal_blocks_of_grid(slot))[1] > best_layout.objective_value * (
            1 - 1e-3
        )


def test_a_search_is_reproducible_from_its_seed(best_layout) -> None:  # type: ignore[no-untyped-def]
    again = searcher(site()).search_from(4, 1)
    assert np.array_equal(again.positions, best_layout.positions)
    assert np.array_equal(again.yaws, best_layout.yaws)
    other = searcher(site()).search_from(5, 1)
    assert not np.array_equal(other.positions, best_layout.positions)


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
grid_step_mm = 1500
yaw_count = 1
height_count = 1
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
    work = problem.make_searcher(problem.search_space(SearchTask(4, 1, 0)))
    drawn = [work.random_layout(random_stream(0, "plan", 4, k)) for k in range(4)]
    infeasible = [layout for layout in drawn if not np.isfinite(work._objective_of_layout(layout))]
    assert len(infeasible) > 1
    bound = [work._connect_stations(layout) for layout in infeasible]
    assert sum(np.isfinite(work._objective_of_layout(layout)) for layout in bound) > 1
    assert all(
        work.search_space.is_feasible(layout.setup_positions[None], layout.is_visible[None])[0] for layout in bound
    )
    assert all(
        work.search_space.connectivity_scores(b.is_visible[None])
        > work.search_space.connectivity_scores(a.is_visible[None])
        for a, b in zip(infeasible, bound, strict=True)
    )


def test_a_fixed_station_stays() -> None:
    where = site(fixed_station_indices=(0,))
    made = searcher(where).search_from(1, 2)
    assert np.array_equal(made.positions[0], where.survey.station_positions[0])
    assert made.yaws[0] == pytest.approx(where.survey.station_yaws[0])


def test_an_obstacle_moves_the_plan_out_of_its_way(best_layout) -> None:  # type: ignore[no-untyped-def]
    """A machine at a station of the plan: nobody stands in it, everything is still in sight, at a price."""
    pillar = rotate_and_shift_triangles(
        box_triangles(np.array([0.5, 0.5, 1.2])), np.array([*best_layout.positions[0, :2], 0.0]), 0.0
    )
    where = site(obstacles=join_obstacles([pillar]))
    work = LayoutSearcher(where, grid_step=0.8, n_yaws=4, n_heights=1)
    assert work.evaluate_layout(best_layout.positions, best_layout.yaws).objective_value == np.inf
    made = work.search_from(4, 1)
    assert not join_obstacles([pillar]).is_setup_inside_body(made.positions).any()
    assert compute_visibility(
        made.positions, where.survey.target_points, where.sight_limits, obstacles=join_obstacles([pillar])
    ).is_visible.all()
    free = LayoutSearcher(site(), grid_step=0.8, n_yaws=4, n_heights=1).search_from(4, 1)
    assert made.objective_value > 0.97 * min(free.objective_value, best_layout.objective_value)


def test_sights_past_an_edge_hold_when_the_tripod_stands_off_its_place() -> None:
    """From the height of a table's top a point on it is in sight, from 40 mm lower it is not."""
    table = join_obstacles(
        [rotate_and_shift_triangles(box_triangles(np.array([1.0, 1.0, 1.0])), np.array([3.0, 3.0, 0.0]), 0.0)]
    )
    point = np.array([[3.0, 3.0, 1.0]])
    heads = np.array([[1.0, 3.0, height] for height in (1.001, 1.04, 1.2)])
    assert site(obstacles=table).is_visible(heads, point)[:, 0].tolist() == [True, True, True]
    assert site(obstacles=table, position_tolerance=0.05).is_visible(heads, point)[:, 0].tolist() == [
        False,
        False,
        True,
    ]


def test_all_targets_that_no_place_sees_are_named() -> None:
    with pytest.raises(InputError, match=r"no place on the floor sees \w+, .*, from heads at .* mm; raise the heads"):
        searcher(site(sight_limits=SightLimits(range_max=2.0))).search_from(0, 1)


def test_least_stations_a_target_lets_single_sights_go() -> None:
    where = site(4, min_sights_per_target=2, sight_limits=SightLimits(range_max=5.5))
    made = searcher(where).search_from(0, 1)
    visible = where.is_visible(made.positions)
    assert not visible.all()
    assert (visible.sum(axis=0) >= 2).all()
    with pytest.raises(InputError, match="no place on the floor sees every reflector"):
        searcher(site(sight_limits=SightLimits(range_max=5.5))).search_from(0, 1)


def test_fixed_nests_are_served_by_all_stations() -> None:
    aimed = np.ones(28, dtype=bool)
    where = site(is_aimed_nest=aimed)
    made = searcher(where).search_from(0, 1)
    half = nest_normals_of_smallest_incidence(made.positions, where.survey.target_points)[1]
    assert half.max() <= where.sight_limits.max_incidence_angle
    free = searcher(site()).search_from(0, 1)
    assert (
        nest_normals_of_smallest_incidence(free.positions, where.survey.target_points)[1].max()
        > where.sight_limits.max_incidence_angle
    )


def test_targets_and_diagnosis_are_separate_goals() -> None:
    where = site()
    effects = tuple(StationWeather(stations=(name,)) for name in where.survey.station_names)
    goals = {
        TARGETS_QUALITY_NAME: LayoutObjective({TARGETS_QUALITY_NAME: 1.0}),
        DIAGNOSIS_QUALITY_NAME: LayoutObjective({DIAGNOSIS_QUALITY_NAME: 1.0}, effects=effects),
    }
    best = {name: searcher(where, goal).search_from(2, 1) for name, goal in goals.items()}
    rms = {name: information(where, made.positions, made.yaws).target_rms for name, made in best.items()}
    assert best[TARGETS_QUALITY_NAME].objective_value == pytest.approx(rms[TARGETS_QUALITY_NAME], rel=1e-8)
    assert rms[TARGETS_QUALITY_NAME] < rms[DIAGNOSIS_QUALITY_NAME]
    judge = searcher(where, goals[DIAGNOSIS_QUALITY_NAME])
    assert (
        best[DIAGNOSIS_QUALITY_NAME].objective_value
        < judge.evaluate_layout(best[TARGETS_QUALITY_NAME].positions, best[TARGETS_QUALITY_NAME].yaws).objective_value
    )
    mixed = searcher(
        where, LayoutObjective({INSTRUMENT_QUALITY_NAME: 1.0, TARGETS_QUALITY_NAME: 1.0}, "A")
    ).search_from(2, 1)
    slow = information(where, mixed.positions, mixed.yaws)
    mean = np.sqrt(float(a_criterion(slow.covariance_in_prior_sigmas)) * slow.target_rms)
    assert mixed.objective_value == pytest.approx(mean, rel=1e-8)


def test_reflectors_move_to_better_places_and_the_gauge_stays() -> None:
    along, height = np.meshgrid(np.linspace(0.3, 5.7, 6), [0.15, 2.0, 4.0, 5.9])
    wall = np.stack([np.zeros(24), along.ravel(), height.ravel()], axis=1)
    places = np.concatenate([wall, wall[:, [1, 0, 2]]])
    names = tuple(f"P{i}" for i in range(len(places)))
    where = site(candidate_reflector_places=places, reflector_place_names=names, min_reflector_spacing=0.5)
    stays = np.arange(28) >= 24
    made = choose_reflectors(where, where.survey, stays, LayoutObjective(), misalignment_construction())
    before = d_criterion(ExpectedPrecision.from_survey(where.survey).covariance_in_prior_sigmas)
    after = d_criterion(ExpectedPrecision.from_survey(made).covariance_in_prior_sigmas)
    assert after < 0.97 * before
    assert len(made.target_names) == len(set(made.target_names)) == 28
    assert made.target_points[:4] == pytest.approx(where.survey.target_points[24:])
    moved = made.target_points[4:]
    gap = np.linalg.norm(moved[:, None] - moved[None], axis=2)[np.triu_indices(24, 1)]
    assert gap.min() > 0.4


def test_points_inside_a_floor_that_is_not_convex() -> None:
    room = np.array([[0.0, 0], [4, 0], [4, 4], [2, 4], [2, 2], [0, 2]])
    points = np.array([[1.0, 1], [1, 3], [3, 3], [2, 3], [4, 4], [5, 1]])
    assert is_inside_outline(room, points).tolist() == [True, False, True, True, True, False]
