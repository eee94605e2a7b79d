"""Somebody else's hall in one plan file: areas, keep-outs, points, tolerances, the page for the shop floor."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import ltsim as lt
from ltsim.cli.main import run
from ltsim.core.errors import InputError
from ltsim.planning import reasons, work_order
from ltsim.planning.layout_rules import SpacingRule, floor_rules, meets_position_rules
from ltsim.planning.loading import load_plan, read_points
from ltsim.planning.planner import StationCountResult
from ltsim.planning.result import scenario_of_plan
from ltsim.planning.search_space import SearchSpace
from ltsim.planning.station_placement import StationPlacement
from ltsim.planning.tolerances import PointTolerances, ToleranceCheck, error_radius, plan_verdict
from ltsim.planning.work_order import TapeDistance, station_instructions, tape_deficiency_sentence
from ltsim.recordings.air import AirUncertainty
from ltsim.reports.work_order_page import work_order_page
from ltsim.scene.floor import Floor, areas_and_keep_outs, invalid_outline_reason, is_inside_outline
from ltsim.scene.meshes import cylinder_triangles, join_obstacles
from ltsim.scene.visibility import compute_visibility
from ltsim.simulation.scenario import scenario_to_toml
from ltsim.simulation.workshop import make_sight_limits, planned_layout
from tests.recordings.test_limits import VERB, means

HALL = """format = "ltsim-plan/1"
title = "Hall 3"
points = "points.csv"
[workshop]
size_mm = [12000, 8000, 5000]
[[workshop.obstacles]]
box_mm = [2500, 1500, 2200]
position_mm = [6000, 4000, 0]
[instrument]
preset = "modern"
[[floor.areas]]
name = "aisle"
corners_mm = [[600, 600], [11400, 600], [11400, 2800], [600, 2800]]
[[floor.areas]]
corners_mm = [[600, 5200], [11400, 5200], [11400, 7400], [600, 7400]]
height_mm = [1400, 2200]
ceiling_mm = 2300
[[floor.keep_outs]]
corners_mm = [[4000, 600], [5500, 600], [5500, 2800], [4000, 2800]]
[[floor.doors]]
from_mm = [12000, 5500]
to_mm = [12000, 7000]
[search]
starts = 1
grid_step_mm = 1500
yaw_count = 3
height_count = 1
"""


def points_csv() -> str:
    rows = ["name,x_mm,y_mm,z_mm,group,tolerance_mm"]
    for i, (x, y) in enumerate([(4710, 3210), (7290, 3210), (7290, 4790), (4710, 4790)]):
        rows += [f"M{i}{k},{x},{y},{z},machine," for k, z in enumerate((500, 2200))]
    for i in range(22):
        t, z = (i // 4 + 0.5) / 6, (400, 1500, 2600, 3700, 4600)[(i // 4 + i % 4) % 5]
        x, y = ((12000 * t, 60), (11940, 8000 * t), (12000 * (1 - t), 7940), (60, 8000 * (1 - t)))[i % 4]
        rows.append(f"W{i:02d},{x:.0f},{y:.0f},{z},wall,")
    return "\n".join(rows) + "\n"


@pytest.fixture
def hall(tmp_path: Path) -> Path:
    (tmp_path / "points.csv").write_text(points_csv(), encoding="utf-8")
    (tmp_path / "hall.toml").write_text(HALL, encoding="utf-8")
    return tmp_path / "hall.toml"


def test_stations_begin_where_the_hall_allows_and_see_every_point(hall: Path) -> None:
    _, scenario = load_plan(hall)
    layout = planned_layout(scenario)
    assert len(layout.target_names) == 30
    x, y, z = layout.station_positions.T
    north = y > 5.19
    assert np.all(north | ((y > 0.59) & (y < 2.81)))
    assert np.all(z[north] <= 2.0)  # a head needs 0.3 m under the ceiling
    assert not np.any((x > 4.0) & (x < 5.5) & (y < 2.8))
    assert np.all(np.hypot(np.maximum(12.0 - x, 0), np.maximum(np.maximum(5.5 - y, y - 7.0), 0)) > 1.5)
    visible = compute_visibility(
        layout.station_positions, layout.target_points, make_sight_limits(scenario, scenario.instrument), obstacles=None
    ).is_visible
    assert visible.any(axis=0).all()


def test_holes_ceilings_and_clearance_take_floor_away() -> None:
    text = {
        "areas": [{"corners_mm": [[0, 0], [4000, 0], [4000, 4000], [0, 4000]],
                   "holes_mm": [[[1000, 1000], [2000, 1000], [2000, 2000], [1000, 2000]]]}],
        "keep_outs": [{"corners_mm": [[3000, 3000], [3500, 3000], [3500, 3500]], "clear_mm": 400}],
    }  # fmt: skip
    areas, free = areas_and_keep_outs(Floor.model_validate(text), (4000, 4000, 3000), (1.4, 1.8))
    at = np.array([[0.5, 0.5, 1.5], [1.5, 1.5, 1.5], [0.5, 0.5, 1.9], [2.7, 3.0, 1.5], [2.5, 3.0, 1.5]])
    assert meets_position_rules(floor_rules(areas, free, None), at).tolist() == [True, False, False, False, True]


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("[11400, 2800], [600, 2800]]", "[600, 2800], [11400, 2800]]", "floor.areas.1.corners_mm is not an outline:"),
        ("[11400, 600], [11400, 2800]", "[12400, 600], [11400, 2800]", "has the corner (12400, 600), outside the hall"),
        ("ceiling_mm = 2300", "ceiling_mm = 1500", "floor.areas.2.ceiling_mm is 1500, but tracker heads are at 1400"),
        ("[workshop]\n", 'scenario = "paper-workshop"\n[workshop]\n', "both scenario and [workshop]"),
        ("12000, 8000, 5000", "12000, 2000, 5000", "outside the hall"),
        ("[search]", '[[goal.tolerances]]\ngroup = "machin"\ntolerance_mm = 0.1\n[search]', "did you mean machine?"),
        ('points = "points.csv"', "", "has 0 reflectors"),
        ("[search]", "[stations]\ncount = 3\n[budget]\nfaces = [1]\n[search]", "budget.faces has no effect without"),
        ('"points.csv"', '"nowhere.csv"', "nowhere.csv: there is no such file"),
    ],
)  # fmt: skip
def test_a_wrong_hall_is_refused_in_a_sentence(hall: Path, old: str, new: str, sentence: str) -> None:
    assert old in HALL
    hall.write_text(HALL.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        load_plan(hall)
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_outlines_that_cross_touch_or_lie_in_a_line_are_reported() -> None:
    assert not invalid_outline_reason(np.array([[0.0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]]))
    assert "cross or touch" in invalid_outline_reason(np.array([[0.0, 0], [1, 1], [1, 0], [0, 1]]))
    assert "cross or touch" in invalid_outline_reason(np.array([[0.0, 0], [2, 0], [2, 2], [1, 0], [0, 2]]))
    assert "line" in invalid_outline_reason(np.array([[0.0, 0], [1, 1], [2, 2]]))
    assert "corner 2 coincides" in invalid_outline_reason(np.array([[0.0, 0], [0, 0], [2, 2]]))
    places = np.array([[0.2, 0.2], [0.5, 0.5], [0.6, 0.6]])
    assert is_inside_outline(np.array([[0.0, 0], [1, 0], [0, 1]]), places).tolist() == [
        True, True, False,
    ]  # fmt: skip


def test_a_list_with_semicolons_and_decimal_commas_is_read(tmp_path: Path) -> None:
    file = tmp_path / "p.csv"
    file.write_text("# CAD\nname;x_mm;y_mm;z_mm;weight;tolerance_mm\nA;1,5;2;3;;0,05\n\nB;1;2;3;4;\n", encoding="utf-8")
    first, second = read_points(file)
    assert (first.x_mm, first.weight, first.tolerance_mm) == (1.5, 1.0, 0.05)
    assert (second.weight, second.tolerance_mm) == (4.0, None)


@pytest.mark.parametrize("scale", [0.001, 1.0])
def test_points_in_a_thousandth_of_the_room_are_a_question(hall: Path, scale: float) -> None:
    listed = (hall.parent / "points.csv").read_text().splitlines()
    rows = [row.split(",") for row in listed[1:]]
    small = [",".join([r[0], *(f"{scale * float(v):.3f}" for v in r[1:4]), *r[4:]]) for r in rows]
    (hall.parent / "points.csv").write_text("\n".join([listed[0], *small]))
    if scale == 1.0:
        load_plan(hall)
        return
    with pytest.raises(InputError, match=r"all points lie within .* mm of the corner of the hall; if .* x_m, y_m, z_m"):
        load_plan(hall)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("name,x_mm,y_mm\nA,1,2\n", "column z_mm: the value is missing, expected a number"),
        ("name,x_mm,y_mm,z_mm,colour\nA,1,2,3,red\n", "has the unknown column 'colour'"),
        ("name,x_mm,y_mm,z_mm\nA,1,2\n", "3 fields, expected 4 as in the header"),
        ("name,x_mm,y_mm,z_mm\nA,1,2,x\n", "z_mm"),
        ("name,x_mm,y_mm,z_mm\nA,1,2,3\nA,1,2,4\n", "the point A occurs again"),
        ("name,x_mm,y_mm,z_mm,tolerance_mm\nA,1,2,3,0\n", "found 0, expected a positive number"),
        ("name,x_mm,y_mm,z_mm,tolerance_mm\nA,1,2,3,1e-320\n", "tolerance_mm: found 1e-320: it should be at least"),
        ("name,x_mm,y_mm,z_mm\n", "contains no points"),
    ],
)
def test_a_wrong_list_is_refused_in_a_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    file = tmp_path / "p.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_points(file)
    assert str(caught.value).startswith(str(file))
    assert sentence in str(caught.value)


def test_a_cylinder_hides_what_its_diameter_covers() -> None:
    there = join_obstacles([cylinder_triangles(1.0, 2.0)])
    origins, y = np.full((4, 3), [-3.0, 0.0, 1.0]), np.array([0.0, 0.49, 0.52, 0.0])
    origins[:, 1] = y
    ends = origins + [6.0, 0.0, 0.0]
    origins[3, 2] = ends[3, 2] = 2.1
    assert there.is_blocked(origins, ends).tolist() == [True, True, False, False]
    assert there.is_setup_inside_body(np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 1.0]])).tolist() == [True, False]


def test_a_radius_holds_the_declared_share_of_errors() -> None:
    rng = np.random.default_rng(4)
    shapes = [np.diag([1.0, 0, 0]), np.eye(3), np.diag([4.0, 1.0, 0.25]), [[2.0, 0.9, 0], [0.9, 1, 0], [0, 0, 0.1]]]
    covariance = np.array(shapes)
    limit = error_radius(covariance, 0.95)
    assert limit[:2] == pytest.approx([1.95996, 2.79548], rel=1e-5)
    for matrix, most in zip(covariance, limit, strict=True):
        errors = rng.multivariate_normal(np.zeros(3), matrix, 200_000, method="eigh")
        assert np.mean(np.linalg.norm(errors, axis=1) < most) == pytest.approx(0.95, abs=0.003)


@pytest.mark.long
def test_the_fewest_stations_meet_the_tolerances_and_a_loss_is_reported(hall: Path) -> None:
    goal = '[goal]\nloss_to_withstand = "ROBUST"\n[[goal.tolerances]]\ngroup = "machine"\ntolerance_mm = 0.03\n[search]'
    counts = {}
    for robust in ("no", "station"):
        hall.write_text(HALL.replace("[search]", goal.replace("ROBUST", robust)), encoding="utf-8")
        content = lt.plan(hall)
        made = content.network
        assert made.tolerance_check is not None
        assert made.tolerance_check.meets_all_tolerances
        counts[robust] = len(made.layout.survey.station_positions)
        assert content.tolerances_met
        assert sum(r.point_error_mm is not None and r.point_error_mm <= 0.03 for r in content.reflectors) == 8
        stations = [
            loss for loss in content.loss_checks if loss.lost_station_or_sight in made.layout.survey.station_names
        ]
        assert len(stations) == counts[robust]
        assert all(loss.tolerances_met for loss in stations) == (robust == "station")
        assert content.summary.startswith("Reached: all 8 tolerances are met at 95 % confidence; worst point M")
        assert ("any one station all are met" if robust == "station" else "they are not met") in content.summary
        assert content.goal_reached
        assert any(s.startswith(f"{counts[robust]} stations are the fewest") for s in content.reasons)
        first = 2 if robust == "no" else 3
        assert f"Layouts with fewer than {first} stations were not searched." in content.reasons
        assert not any("make no network" in sentence for sentence in content.reasons)
    assert counts["no"] < counts["station"]


def test_a_tolerance_that_nothing_keeps_is_answered_with_what_can_be_had(hall: Path) -> None:
    goal = "[[goal.tolerances]]\ntolerance_mm = 0.0001\n[stations]\nmax_count = 2\n[budget]\nrepeats = [1]\n[search]"
    hall.write_text(HALL.replace("[search]", goal), encoding="utf-8")
    content = lt.plan(hall)
    assert content.network.tolerance_check is not None
    assert not content.network.tolerance_check.meets_all_tolerances
    assert content.summary.startswith("Not reached: 0 of 30 tolerances are met")
    assert not content.goal_reached
    page = work_order_page(content)
    assert "Do not measure this layout: Not reached: 0 of 30 tolerances are met" in page
    assert any("with 2 to 2 stations" in sentence for sentence in content.reasons)


def test_the_headline_is_the_root_mean_square_of_all_points(hall: Path, tmp_path: Path) -> None:
    goal = "[[goal.tolerances]]\ngroup = 'machine'\ntolerance_mm = 0.05\n[search]"
    hall.write_text(HALL.replace("[search]", "[stations]\ncount = 2\n[work]\nfaces = 1\n" + goal), encoding="utf-8")
    content = lt.plan(hall)
    sigma = np.array([r.sigma_um for r in content.reflectors], dtype=np.float64)
    assert content.rms_sigma_um == pytest.approx(np.sqrt(np.mean(sigma**2)), rel=1e-3)
    tolerated = sigma[[r.tolerance_mm is not None for r in content.reflectors]]
    weight = np.where([r.tolerance_mm is not None for r in content.reflectors], 1.0, 0.01)
    weighted = np.sqrt(np.average(sigma**2, weights=weight))  # ten times the tolerance for points without one
    assert 1e6 * (content.qualities["targets"] or 0.0) == pytest.approx(weighted, rel=1e-3)
    assert np.sqrt(np.mean(tolerated**2)) < 0.95 * content.rms_sigma_um
    text = f"targets known to {content.rms_sigma_um:.1f} um (root mean square of all points; weighted point error"
    assert text in content.reasons[0]
    assert "not measure" not in work_order_page(content)
    scenario = scenario_of_plan(content.network)
    assert scenario.air == AirUncertainty()
    (tmp_path / "scenario.toml").write_text(scenario_to_toml(scenario), encoding="utf-8")
    assert "[air]\ntemperature_k = 0.5" in (tmp_path / "scenario.toml").read_text(encoding="utf-8")
    for setting, place in zip(
        station_instructions(content.network), content.network.layout.survey.station_positions, strict=True
    ):
        for tape in setting.tape_distances:
            path = np.linspace(place[:2], tape.mark_position[:2], 200)
            crane_way = (path[:, 0] > 4.0) & (path[:, 0] < 5.5) & (path[:, 1] > 0.6) & (path[:, 1] < 2.8)
            assert not (tape.is_along_floor and crane_way.any())


def test_points_in_sight_from_nowhere_are_named(hall: Path) -> None:
    goal = "[[goal.tolerances]]\ngroup = 'machine'\ntolerance_mm = 0.05\n[search]"
    hall.write_text(HALL.replace("[search]", goal), encoding="utf-8")
    inside = points_csv() + "IN,6000,4000,1000,machine,\n"
    (hall.parent / "points.csv").write_text(inside, encoding="utf-8")
    with pytest.raises(InputError, match=r"^no place on the floor sees IN, .* mm; IN lies inside an obstacle"):
        lt.plan(hall)


@pytest.mark.long
def test_the_work_order_places_tripods_by_tape_and_lists_the_work(hall: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    hall.write_text(HALL.replace("[search]", "[stations]\ncount = 2\n[work]\nfaces = 1\n[search]"))
    (tmp_path / "points.csv").write_text(points_csv().replace("M00,4710,", "M00,4710.123,"))
    made = lt.plan(hall).network
    points = dict(zip(made.layout.survey.target_names, made.layout.survey.target_points, strict=True))
    for setting, place in zip(station_instructions(made), made.layout.survey.station_positions, strict=True):
        assert len(setting.tape_distances) == 3
        for tape in setting.tape_distances:
            if tape.mark_name in points:
                assert tape.length == pytest.approx(np.hypot(*(points[tape.mark_name] - place)[:2]))
        assert list(setting.target_order) == [n for n in points if n in setting.target_order]
    assert run(["plan", "hall.toml", "--out", "out", "--jobs", "1"]) == 0
    rows = (tmp_path / "out" / "work-order.csv").read_text(encoding="utf-8").splitlines()
    assert len(rows) == 1 + made.layout.survey.n_pointings
    nominals = (tmp_path / "out" / "nominals.csv").read_text(encoding="utf-8").splitlines()
    assert nominals[:2] == ["name,x_mm,y_mm,z_mm", "M00,4710.123,3210,500"]
    page = (tmp_path / "out" / "work-order.html").read_text(encoding="utf-8")
    assert "Positions of the tripods" in page
    assert "Checks" in page
    again, _ = lt.simulate(tmp_path / "out" / "scenario.toml", seed=1)
    assert len(again) == made.layout.survey.n_pointings


def test_tapes_determine_a_point_or_report_what_is_missing(hall: Path, monkeypatch) -> None:
    place = np.array([3.0, 2.0, 1.5])

    def marks(*at: tuple[float, float]) -> list[TapeDistance]:
        return [
            TapeDistance.from_station(f"M{k}", np.array([*xy, 0.0]), place, is_along_floor=True)
            for k, xy in enumerate(at)
        ]

    in_line = marks((0.0, 0.0), (3.0, 0.0), (6.0, 0.0))
    assert tape_deficiency_sentence(in_line, place) == (
        "The tape distances also fit a wrong position, x 3.00, y -2.00 m: "
        "check on which side of the marks the tripod stands."
    )
    flat = tape_deficiency_sentence(marks((0.0, 2.2), (6.0, 2.2), (7.0, 2.3)), place)
    assert re.fullmatch(
        r"The tapes meet at a flat angle, so the position is uncertain by \d+ cm: mark it in another way\.", flat
    )
    assert "uncertain along a line" in tape_deficiency_sentence(marks((0.0, 2.0), (6.0, 2.0), (7.0, 2.0)), place)
    assert tape_deficiency_sentence(in_line[:2], place).startswith("Fewer than three points are within reach of a tape")
    fourth, far = marks((0.5, 4.0), (19.0, 14.0))
    for more in ([fourth], [far], [fourth, far]):  # one off the line decides, the nearer one where there is a choice
        tapes = work_order._best_tape_distances([*in_line, *more], place)
        assert any(tape is more[0] for tape in tapes)
        assert tape_deficiency_sentence(tapes, place) == ""
    assert len(work_order._best_tape_distances(in_line[:2], place)) == 2
    hall.write_text(HALL.replace("[search]", "[stations]\ncount = 2\n[work]\nfaces = 1\n[search]"))
    monkeypatch.setattr(work_order, "_candidate_tape_distances", lambda plan, place, visible: in_line[:2])
    assert "S1: Fewer than three points are within reach of a tape" in work_order_page(lt.plan(hall))


def test_a_disconnected_network_meets_no_tolerance() -> None:
    tolerance = dict.fromkeys("ABC", 1e-4)
    verdict, lost = (
        ToleranceCheck("", tolerance, {}, np.inf, "C", ("C",)),
        ToleranceCheck("S1", tolerance, {}, np.inf, ""),
    )
    judgement = plan_verdict(PointTolerances(tolerance), verdict, [lost])
    assert not judgement.is_goal_reached and judgement.sentences.startswith("Not reached: 0 of 3 tolerances are met")
    assert verdict.unseen_points == ("C",) and verdict.violations_clause.startswith("C is not visible")


def test_numbers_without_a_layout_name_the_points_that_the_best_layout_lacks() -> None:
    tried = [
        StationCountResult(3, None, False, "M1, M2"),
        StationCountResult(4, None, False, "M2"),
        StationCountResult(5, 1.2, True),
    ]
    assert reasons._station_count_clauses(tried, 2) == [
        "3 to 4 stations: no layout has every point in sight of 2 stations (the closest layout lacks sights of M2)",
        "5 stations: the best layout has an error of 1.2 times its tolerance",
    ]
    site = SimpleNamespace(min_sights_per_target=2, survey=SimpleNamespace(target_names=["M1", "M2", "M3"]))
    visible = np.array([[True, True, True], [True, False, False], [True, False, True]])
    placement = StationPlacement(np.zeros((3, 3)), visible, SpacingRule(0.0), np.zeros((0, 3)), np.array([0, 0, 1]))
    assert [SearchSpace.unseen_targets_text(site, placement, chosen) for chosen in ([0, 1], [0, 0], [1])] == [
        "M2",
        "",
        "M1, M2, M3",
    ]


@pytest.mark.long
@pytest.mark.parametrize("pictures", [False, True])
def test_a_hall_of_196608_triangles_takes_500_mb_and_30_s(tmp_path: Path, pictures: bool) -> None:
    body = trimesh.creation.box(extents=[2500, 1500, 2200])
    for _ in range(7):
        body = body.subdivide()
    body.export(tmp_path / "body.stl")
    (tmp_path / "points.csv").write_text(points_csv())
    plan = tmp_path / "plan.toml"
    plan.write_text(HALL.replace("box_mm = [2500, 1500, 2200]", 'file = "body.stl"').replace("4000, 0]", "4000, 1100]"))
    used = means(
        VERB, "plan", str(plan), "--jobs", "1", *(["--out", str(tmp_path / "out")] if pictures else ["--json"])
    )
    assert used.ru_maxrss < 500 * 1024
    assert used.ru_utime + used.ru_stime < 30
