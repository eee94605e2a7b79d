"""A plan moved by hand: the board says what the planner says, the page follows the mouse, what is saved is a plan."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.cli.main import run
from ltsim.core.errors import InputError
from ltsim.planning.expected_precision import ExpectedPrecision
from ltsim.planning.loading import load_plan
from ltsim.planning.planner import layout_visibility
from ltsim.planning.tolerances import check_tolerances
from ltsim.reports.board.board import MovableLayout
from ltsim.scene.visibility import InvisibilityReason
from tests.planning.test_hall import HALL, points_csv
from tests.reports.board.tab import Tab, opened
from tests.reports.browser import find_browser

TOLERANCES = '[[goal.tolerances]]\ngroup = "machine"\ntolerance_mm = 0.05\n[search]'


@pytest.fixture
def hall(tmp_path: Path) -> Path:
    (tmp_path / "points.csv").write_text(points_csv(), encoding="utf-8")
    text = HALL.replace("[search]", f"[stations]\ncount = 3\n[work]\nfaces = 1\n{TOLERANCES}")
    (tmp_path / "hall.toml").write_text(text, encoding="utf-8")
    return tmp_path / "hall.toml"


def test_the_board_says_what_the_planner_says(hall: Path) -> None:
    board = MovableLayout.from_plan(hall)
    stations = board.hall_json()["stations"]
    stations[1]["position_mm"][0] += 500.0
    evaluation = board.evaluation_json(stations)
    survey = board.survey_with_stations(stations)
    survey = survey.replace(is_visible=layout_visibility(board.search_space, survey).is_visible)
    assert survey.station_positions[1, 0] == pytest.approx(
        board.search_space.survey.station_positions[1, 0] + 0.5, abs=1e-4
    )
    information = ExpectedPrecision.from_survey(survey, board.construction)
    assert [p["sigma_um"] for p in evaluation["points"]] == pytest.approx(1e6 * information.target_point_errors)
    assert evaluation["rms_um"] == pytest.approx(1e6 * information.target_rms)
    assert (np.array(evaluation["reasons"]) == InvisibilityReason.VISIBLE).tolist() == survey.is_visible.tolist()
    assert evaluation["shadow"] == pytest.approx(survey.station_positions[:, 2] * np.tan(np.radians(35)))


def test_the_verdict_says_when_a_station_less_is_too_few(hall: Path) -> None:
    board = MovableLayout.from_plan(hall)
    stations = board.hall_json()["stations"]
    survey = board.survey_with_stations(stations)
    survey = survey.replace(is_visible=layout_visibility(board.search_space, survey).is_visible)
    lost = [check_tolerances(survey.without_station(s), board.tolerances, board.construction) for s in range(3)]
    verdict = board.verdict_json(stations)
    assert verdict is not None
    assert verdict["words"].startswith("Reached: all 8 tolerances" if verdict["reached"] else "Not reached: ")
    assert ("any one station all are met" in verdict["words"]) == all(station.meets_all_tolerances for station in lost)
    stations[0]["position_mm"] = [1000.0 * v for v in board.search_space.survey.target_points[0]]
    assert board.verdict_json(stations) is None


def test_a_layout_that_breaks_a_rule_is_never_reached(hall: Path) -> None:
    text = hall.read_text()
    text = text.replace("[stations]\n", "[stations]\nposition_tolerance_mm = 0\n")  # no sight is marginal
    hall.write_text(text.replace("tolerance_mm = 0.05", "tolerance_mm = 5"))
    board = MovableLayout.from_plan(hall)
    stations = board.hall_json()["stations"]
    assert board.verdict_json(stations)["reached"] and board.evaluation_json(stations)["problem"] == ""  # type: ignore[index]
    stations[1]["position_mm"][:2] = stations[0]["position_mm"][:2]
    verdict = board.verdict_json(stations)
    rule = "S1 and S2 are 0.00 m apart, closer than 1 m (stations.spacing_mm)"
    assert verdict is not None and not verdict["reached"]
    assert verdict["words"].startswith(f"Not reached: the layout breaks a rule ({rule}). All 8 tolerances are met")
    assert board.evaluation_json(stations)["problem"] == rule
    place = ",".join(f"{v}" for v in stations[0]["position_mm"])
    move = {name: [float(v) for v in place.split(",")] for name in ("S1", "S2")}
    with pytest.raises(InputError, match=re.escape(f"move: {rule}")):
        lt.plan(hall, move=move)


def test_a_station_next_to_a_body_breaks_the_rule_of_clearance(hall: Path) -> None:
    hall.write_text(hall.read_text().replace("[11400, 2800], [600, 2800]", "[11400, 3245], [600, 3245]"))
    board = MovableLayout.from_plan(hall)
    stations = board.hall_json()["stations"]
    stations[0]["position_mm"][:2] = [7000.0, 3245.0]
    evaluation, verdict = board.evaluation_json(stations), board.verdict_json(stations)
    assert re.match(r"S1 stands 0\.005 m from .*, closer than 0\.4 m \(stations\.clearance_mm\)", evaluation["problem"])
    assert evaluation["may_stand"][0] is False and verdict is not None and not verdict["reached"]


def test_stations_are_added_and_removed(hall: Path, tmp_path: Path) -> None:
    board = MovableLayout.from_plan(hall)
    stations = board.hall_json()["stations"]
    more = [*stations, {"name": "S9", "position_mm": [1500.0, 6500.0, 1600.0], "yaw_deg": 10.0}]
    evaluation = board.evaluation_json(more)
    assert len(evaluation["reasons"]) == 4 and evaluation["rms_um"] < board.evaluation_json(stations)["rms_um"]
    assert evaluation["hours"] > board.evaluation_json(stations)["hours"]
    fewer = board.evaluation_json(stations[:2])
    assert len(fewer["reasons"]) == 2 and fewer["rms_um"] > evaluation["rms_um"]
    board.save(more, tmp_path / "moved")
    _, scenario = load_plan(tmp_path / "moved" / "plan.toml")
    assert list(scenario.stations) == ["S1", "S2", "S3", "S9"]
    for wrong, says in (
        (stations[:1], "a layout has 2 to 40 stations, not 1"),
        ([*stations, stations[0]], "a different name"),
        ([*stations[:2], {**stations[2], "name": "<b>"}], "a different name"),
    ):
        with pytest.raises(InputError, match=says):
            board.evaluation_json(wrong)


def test_layouts_that_break_a_rule_are_reported_and_evaluated(hall: Path) -> None:
    board = MovableLayout.from_plan(hall)
    stations = board.hall_json()["stations"]
    stations[0]["position_mm"][:2] = [4700.0, 1500.0]  # in the crane way
    evaluation = board.evaluation_json(stations)
    assert evaluation["problem"] == "S1 stands in an area to be kept free (floor.keep_outs, floor.doors)"
    assert evaluation["may_stand"][0] is False
    assert evaluation["points"]
    stations[0]["position_mm"][:2] = [6000.0, 4000.0]  # inside the machine: it sees nothing
    assert "S1 stands outside the permitted floor" in board.evaluation_json(stations)["problem"]
    stations[0]["position_mm"][:2] = stations[1]["position_mm"][:2]
    assert "closer than 1 m" in board.evaluation_json(stations)["problem"]
    stations[0]["position_mm"] = [1000.0 * v for v in board.search_space.survey.target_points[0]]
    assert "station S1 coincides with target M00" in board.evaluation_json(stations)["problem"]


def test_what_is_saved_is_planned_and_simulated_where_it_stands(hall: Path, tmp_path: Path) -> None:
    board = MovableLayout.from_plan(hall)
    stations = board.hall_json()["stations"]
    stations[0]["position_mm"][:2] = [2000.0, 2000.0]
    wanted = board.evaluation_json(stations)
    board.save(stations, tmp_path / "moved")
    file, scenario = load_plan(tmp_path / "moved" / "plan.toml")
    assert len(file.listed_points) == 30
    assert len(scenario.targets) == 30
    made = lt.plan(tmp_path / "moved").network
    assert made.layout.survey.station_positions[0] == pytest.approx([2.0, 2.0, stations[0]["position_mm"][2] / 1000])
    assert made.layout.expected_precision.target_rms == pytest.approx(1e-6 * wanted["rms_um"])
    assert made.tolerance_check is not None
    recording, _ = lt.simulate(tmp_path / "moved" / "scenario.toml", seed=1)
    assert len(recording.stations) == 3
    elsewhere = (tmp_path / "moved" / "plan.toml").read_text().replace("x_mm = 4710", "x_mm = 4711", 1)
    (tmp_path / "moved" / "plan.toml").write_text(elsewhere)
    with pytest.raises(InputError, match="'M00' is the name of a target at another position"):
        load_plan(tmp_path / "moved" / "plan.toml")


def test_a_folder_of_a_plan_begins_where_the_plan_stands(hall: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["plan", "hall.toml", "--out", "made", "--jobs", "1", "--quiet"]) == 0
    planned = json.loads((tmp_path / "made" / "plan.json").read_text())
    board = MovableLayout.from_plan(tmp_path / "made")
    assert [s["position_mm"] for s in board.hall_json()["stations"]] == [s["position_mm"] for s in planned["stations"]]
    assert board.evaluation_json(board.hall_json()["stations"])["rms_um"] == pytest.approx(
        planned["rms_sigma_um"], rel=1e-4
    )


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ([], "needs a scenario, a recording, or --plan FILE"),
        (["paper-workshop", "--plan", "hall.toml"], "needs a scenario, a recording, or --plan FILE"),
        (["--plan", "nowhere.toml"], "there is no such file"),
        (["--plan", "hall.toml", "--out", "taken"], "exists already"),
    ],
)
def test_wrong_input_is_refused_in_a_sentence(given: list[str], sentence: str, hall: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(hall.parent)
    Path("taken").mkdir()
    Path("taken/plan.toml").write_text("mine")
    assert run(["view", *given]) == 2
    error_text = capsys.readouterr().err
    assert sentence in error_text
    assert error_text.count("\n") == 1


START = "import signal; signal.signal(2, signal.default_int_handler); from ltsim.cli.main import main; main()"
"""A shell in the background starts what it starts deaf to Ctrl-C."""
SIGMA = "document.querySelector('tr[data-point=M31] td:nth-child(3)').textContent"

COVERED = """(() => { stations[1].position_mm = [stations[0].position_mm[0] - 1200, stations[0].position_mm[1],
  stations[1].position_mm[2]]; placeLabels();
  const shown = [...layer.names.children].filter(label => label.getAttribute("visibility") === "visible");
  const boxes = shown.map(label => [label.textContent, label.getBBox()]);
  const across = (a, b) => a.x + 1e-6 < b.x + b.width && a.y + 1e-6 < b.y + b.height;
  return boxes.flatMap(([name, a], i) =>
    boxes.slice(i + 1).filter(([, b]) => across(a, b) && across(b, a)).map(([b]) => [name, b])); })()"""
"""Pairs of names that cover each other, the second station 1.2 m beside the first."""


CUT_OFF = """[...document.querySelectorAll("table, td button, td input, #facts > *")].filter(
  element => element.getBoundingClientRect().right > document.querySelector("main").getBoundingClientRect().right + 1
).map(element => element.outerHTML.slice(0, 60))"""
"""Tables, buttons and fields that reach beyond the right edge of the page."""


def cut_off_by_width(tab: Tab) -> dict[int, list[str]]:
    """Beginnings of the elements that reach beyond the page, by the width of the window."""
    cut_off = {}
    for width in (390, 900, 1030, 1280):
        metrics = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        tab.call("Emulation.setDeviceMetricsOverride", **metrics)
        cut_off[width] = tab.value(CUT_OFF)
    return cut_off


LATE_VERDICT = """(() => {
  let answer; const late = new Promise(resolve => { answer = resolve; }), present = post;
  post = endpoint => endpoint === "verdict" ? late : present(endpoint);
  verdict(); updateLater(); clearTimeout(timer); answer({ words: "Reached: an earlier layout", reached: true });
  setTimeout(() => { post = present; window.answered = true; }, 50);
})()"""
"""Script in which a station is moved while a verdict on the earlier layout is on its way."""


def test_a_dragged_station_changes_the_accuracy_on_the_page(hall: Path, tmp_path: Path) -> None:
    find_browser()
    command = [sys.executable, "-c", START, "view", "--plan", str(hall), "--out", str(tmp_path / "moved")]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        address = server.stdout.readline().strip()
        assert address.startswith("http://127.0.0.1:")
        with opened(address, tmp_path) as tab:
            tab.until("evaluation && evaluation.points")
            before = (
                tab.value("evaluation"),
                tab.value(SIGMA),
                tab.value("stations[0].position_mm"),
                tab.value("stations"),
            )
            x, y = tab.middle("[data-station=S1] .head")
            tab.drag((x, y), (x + 60, y + 8))
            tab.until(f"!busy && {SIGMA} != '{before[1]}'")
            after = tab.value("evaluation"), tab.value(SIGMA), tab.value("stations[0].position_mm")
            assert after[2][0] > before[2][0] + 100
            assert after[2][1] < before[2][1]
            judged = MovableLayout.from_plan(hall).evaluation_json(tab.value("stations"))
            assert float(after[1]) == pytest.approx(judged["points"][7]["sigma_um"], rel=0.01)
            assert after[0]["rms_um"] == pytest.approx(judged["rms_um"])
            assert after[0]["shadow"] == pytest.approx(judged["shadow"])
            assert tab.value("layer.sights.childElementCount") > 0
            tab.until("/eached: /.test(document.querySelector('#verdict').textContent)")
            assert tab.value("document.querySelector('#verdict').className") in ("reached", "lost")
            tab.value(LATE_VERDICT)
            tab.until("window.answered")
            assert tab.value("document.querySelector('#verdict').textContent") == "…"
            tab.value("document.querySelector('#add').click()")
            tab.until("!busy && evaluation.reasons.length === 4 && stations.length === 4")
            assert "S4" not in tab.value("evaluation.problem")
            tab.value("document.querySelector('[aria-label=\"Remove S4\"]').click()")
            tab.until("!busy && evaluation.reasons.length === 3")
            assert tab.value("layer.tripods.childElementCount") == 3
            tab.until("document.querySelector('#space iframe')?.contentWindow.global?.renderWindow")
            tab.value("document.querySelector('#save').click()")
            assert "plan.toml" in tab.until("document.querySelector('#saved').textContent")
            saved = tab.value("stations")
            tab.value("document.querySelector('#back').click()")
            tab.until("!busy && document.querySelector('#saved').textContent === ''")
            assert tab.value("stations") == before[3] != saved
            assert tab.value(COVERED) == []
            assert cut_off_by_width(tab) == {390: [], 900: [], 1030: [], 1280: []}
            assert not [line for line in tab.console_lines if "hashes" not in line and '"rendering"' not in line]
        _, scenario = load_plan(tmp_path / "moved" / "plan.toml")
        assert list(scenario.stations["S1"].position_mm) == after[2]
    finally:
        server.send_signal(signal.SIGINT)
        server.communicate(timeout=60)
    assert server.returncode == 0
