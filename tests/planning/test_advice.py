"""One set of sights for all parts of a plan, the procedure of a fixed count, and advice that names the cure."""

from __future__ import annotations

from pathlib import Path

import pytest

import ltsim as lt
from ltsim.cli.main import run
from ltsim.core.errors import InputError, NetworkError
from ltsim.planning.loading import load_plan
from ltsim.planning.result import write_plan
from tests.planning.fixtures import SMALL_HALL_POINTS, small_hall_plan
from tests.planning.test_hall import HALL, points_csv

PLAN = small_hall_plan(obstacle=("press", "[800, 800, 2200]"), height_mm="[1500, 1500]", tolerance_mm=0.03)
POINTS = (*SMALL_HALL_POINTS.values(), (5800, 2000, 1200))
INSIDE_PRESS = (4500, 2800, 1000)


def builtin_plan_text(points: tuple[tuple[int, int, int], ...] = POINTS) -> str:
    named = zip("ABCDEFG", points, strict=False)
    return PLAN + "".join(f'[[points]]\nname = "{n}"\nx_mm = {x}\ny_mm = {y}\nz_mm = {z}\n' for n, (x, y, z) in named)


@pytest.fixture
def hall(tmp_path: Path) -> Path:
    (tmp_path / "hall.toml").write_text(builtin_plan_text())
    return tmp_path / "hall.toml"


def test_a_moved_layout_has_a_single_set_of_sights(hall: Path) -> None:
    """From S1 the press hides F to a tripod 50 mm beside its place: no part of the plan counts this sight."""
    plan = lt.plan(hall, move={"S1": (1500, 3000), "S2": (3000, 1200)})
    (point,) = [reflector for reflector in plan.reflectors if reflector.name == "F"]
    assert point.visible_from == ("S2",) and point.point_error_mm is not None
    assert 1e3 * point.point_error_mm / point.sigma_um == pytest.approx(1.6, abs=0.3)  # radius per rms of the axes
    assert "S2 is indispensable" in " ".join(plan.reasons)
    sentence = (
        "1 marginal sight does not count, because a tripod 50 mm beside its planned position may lose it "
        "(stations.position_tolerance_mm): S1 to F."
    )
    assert sentence in plan.reasons
    hall.write_text(builtin_plan_text().replace("count = 2", "count = 2\nposition_tolerance_mm = 0"))
    exact = lt.plan(hall, move={"S1": (1500, 3000), "S2": (3000, 1200)})
    assert exact.network.layout.survey.n_pointings == plan.network.layout.survey.n_pointings + 1
    assert "marginal" not in " ".join(exact.reasons)


def test_all_tables_of_a_moved_layout_have_the_same_sights(hall: Path, tmp_path: Path) -> None:
    plan = lt.plan(hall, move={"S1": (1500, 3000), "S2": (3000, 1200)})
    write_plan(plan, tmp_path / "out")
    rows = (tmp_path / "out" / "visibility.csv").read_text().splitlines()
    (lost,) = [row for row in rows if row.startswith("S1,F,")]
    assert ",no,marginal, not free" in lost.replace('"', "")
    order = (tmp_path / "out" / "work-order.csv").read_text().splitlines()
    assert not any(",S1,F," in row for row in order) and any(",S2,F," in row for row in order)


def test_a_target_with_marginal_sights_only_is_refused_with_the_reason(hall: Path) -> None:
    with pytest.raises(NetworkError, match=r"^target F is not visible from any station \(S1 does not see F: marginal"):
        lt.plan(hall, move={"S1": (1500, 3000), "S2": (2800, 2700)})


def test_a_fixed_count_chooses_the_fastest_procedure_within_the_tolerances(hall: Path) -> None:
    fast = lt.plan(hall)
    assert fast.goal_reached and (fast.faces, fast.repeats) == (1, 1)
    error = max(r.point_error_mm for r in fast.reflectors if r.point_error_mm is not None)
    hall.write_text(builtin_plan_text().replace("tolerance_mm = 0.03", f"tolerance_mm = {0.8 * error:.5f}"))
    slower = lt.plan(hall)
    assert slower.goal_reached and slower.faces * slower.repeats > 1
    work = "[work]\nfaces = 1\n[budget]\nfaces = [1]\nrepeats = [1]\n[[goal"
    hall.write_text(hall.read_text().replace("[[goal", work))
    assert not lt.plan(hall).goal_reached


def test_faces_and_rounds_of_a_budget_need_hours_or_tolerances(hall: Path) -> None:
    text = builtin_plan_text().replace(
        "[[goal.tolerances]]\ntolerance_mm = 0.03\n", "[budget]\nfaces = [1]\nrepeats = [1]\n"
    )
    hall.write_text(text)
    with pytest.raises(InputError, match=r"budget.faces and budget.repeats have no effect without budget.max_h"):
        load_plan(hall)
    hall.write_text(text.replace("repeats = [1]\n", ""))
    with pytest.raises(InputError, match=r"budget.faces has no effect without budget.max_hours or tolerances; "):
        load_plan(hall)


def test_a_point_inside_a_body_is_named_with_the_body(hall: Path) -> None:
    text = builtin_plan_text((*POINTS, INSIDE_PRESS))
    sentence = r"^no place on the floor sees G, from heads at 1500 mm; G lies inside an obstacle \(press\): move "
    for count, asked in ((2, 1), (3, 2), (3, 3)):
        stations = f"count = {count}\nmin_stations_per_target = {asked}"
        changed = text.replace("count = 2\nmin_stations_per_target = 1", stations)
        for goal in (changed, changed.replace("[[goal.tolerances]]\ntolerance_mm = 0.03\n", "")):
            hall.write_text(goal)
            with pytest.raises(InputError, match=sentence):
                lt.plan(hall)


@pytest.mark.parametrize(("count", "asked", "larger"), [(2, "2", 3), (4, "4", 6), (2, '"all"', 0)])
def test_too_few_stations_are_advised_to_be_more(count: int, asked: str, larger: int, tmp_path: Path) -> None:
    def text(n_stations: int) -> str:
        return HALL.replace(
            "[search]", f"[stations]\ncount = {n_stations}\nmin_stations_per_target = {asked}\n[search]"
        )

    (tmp_path / "points.csv").write_text(points_csv(), encoding="utf-8")
    (tmp_path / "hall.toml").write_text(text(count), encoding="utf-8")
    advice = f"set stations.count = {larger}, " if larger else ""
    with pytest.raises(InputError, match=rf"set stations.min_stations_per_target = \d, {advice}move M10, or enlarge"):
        lt.plan(tmp_path / "hall.toml")
    if larger == 3:  # the advice is right
        (tmp_path / "hall.toml").write_text(text(larger), encoding="utf-8")
        assert len(lt.plan(tmp_path / "hall.toml").stations) == larger


def test_a_refused_place_names_the_body_and_a_height(hall: Path) -> None:
    with pytest.raises(InputError, match=r"S1 stands inside an obstacle \(workshop.obstacles: press\)$"):
        lt.plan(hall, move={"S1": (4500, 2800)})
    with pytest.raises(InputError, match=r"S1 stands with its head at 1700 mm, expected 1500 mm \(floor.height_mm\)"):
        lt.plan(hall, move={"S1": (1500, 3000, 1700)})


def test_an_evaluation_without_a_folder_says_that_nothing_is_written(
    hall: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(hall.parent)
    assert run(["plan", str(hall), "--move", "S1=1500,3000"]) == 0
    assert "No file was written; --out DIR writes this plan" in capsys.readouterr().out
    assert [path.name for path in hall.parent.iterdir()] == ["hall.toml"]
