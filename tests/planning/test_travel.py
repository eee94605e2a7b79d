"""A plan's folder holds what it needs: CAD travels, the board saves living paths; one station elsewhere."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

import ltsim as lt
from ltsim.cli.main import run
from ltsim.reports.board.board import MovableLayout
from tests.planning.test_hall import HALL, points_csv

BOX = "box_mm = [2500, 1500, 2200]\nposition_mm = [6000, 4000, 0]\n"
WANTED = "[stations]\ncount = 3\n[[goal.tolerances]]\ngroup = 'machine'\ntolerance_mm = 0.05\n[search]"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plan whose machine is CAD in a folder beside it; where the plan was made is gone afterwards."""
    folder = tmp_path_factory.mktemp("travel")
    where = folder / "first"
    (where / "cad").mkdir(parents=True)
    trimesh.creation.box(bounds=[[4750, 3250, 0], [7250, 4750, 2200]]).export(where / "cad" / "machine.stl")
    (where / "points.csv").write_text(points_csv().replace("60,", "60.1234,", 1), encoding="utf-8")
    text = HALL.replace(BOX, 'name = "machine"\nfile = "cad/machine.stl"\n').replace("[search]", WANTED)
    (where / "hall.toml").write_text(text, encoding="utf-8")
    assert run(["plan", str(where / "hall.toml"), "--out", str(folder / "made"), "--jobs", "1", "--quiet"]) == 0
    shutil.rmtree(where)
    return folder / "made"


@pytest.mark.long
def test_every_verb_works_on_the_folder(made: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["report", str(made), "--quiet"]) == 0
    assert run(["simulate", str(made), "--out", "rec", "--seed", "1", "--quiet"]) == 0
    assert run(["simulate", str(made / "scenario.toml"), "--out", "rec2", "--seed", "1", "--quiet"]) == 0
    assert run(["view", str(made), "--html", "room.html", "--quiet"]) == 0
    board = MovableLayout.from_plan(made)
    board.save(board.hall_json()["stations"], tmp_path / "moved")
    assert {f.name for f in (tmp_path / "moved").iterdir()} == {"plan.toml", "scenario.toml", "machine.stl"}
    shutil.move(tmp_path / "moved", tmp_path / "elsewhere")
    saved = json.loads((made / "plan.json").read_text())
    again = MovableLayout.from_plan(tmp_path / "elsewhere" / "plan.toml")
    assert [s["mm"] for s in again.hall_json()["stations"]] == [s["position_mm"] for s in saved["stations"]]
    assert "machine (machine.stl, coordinates read as millimetres, z up): 2.5 x 1.5 x 2.2 m" in saved["bodies"][0]


def test_points_are_reported_to_the_micrometre_with_uncertainty_and_stations(made: Path) -> None:
    nominal = list(csv.DictReader((made / "nominals.csv").read_text().splitlines()))
    assert any(row["y_mm"] == "60.123" for row in nominal)
    content = json.loads((made / "plan.json").read_text())
    rows = list(csv.DictReader((made / "reflectors.csv").read_text().splitlines()))
    pairs = csv.DictReader((made / "visibility.csv").read_text().splitlines())
    sees = {(r["station"], r["target"]) for r in pairs if r["sees"] == "yes"}
    for row, entry in zip(rows, content["reflectors"], strict=True):
        u = np.array([float(row[f"U_{k}_um"]) for k in "xyz"])
        assert np.linalg.norm(u) == pytest.approx(2 * entry["sigma_um"], abs=0.03)
        assert {(s, row["target"]) for s in row["visible_from"].split()} <= sees
        assert len(row["visible_from"].split()) == entry["stations_seeing"]


@pytest.mark.long
def test_a_station_at_another_place_is_a_single_command(made: Path, tmp_path: Path, capsys) -> None:
    assert run(["plan", str(made), "--without", "S2"]) == 0
    lost, *places, follows = capsys.readouterr().out.strip().splitlines()
    assert follows.startswith("To plan with the best of these positions: ltsim plan")
    assert lost.startswith(("- without S2: Not reached", "- without S2: Reached"))
    assert 1 <= len(places) <= 4
    assert all(line.startswith("- S2 at (") for line in places)
    alternatives = lt.station_alternatives(made, "S2")
    old = np.array(json.loads((made / "plan.json").read_text())["stations"][1]["position_mm"][:2]) / 1e3
    assert all(
        np.linalg.norm(alternative.survey.station_positions[1, :2] - old) >= 2.0 for alternative in alternatives[1:]
    )
    x, y, z = (1e3 * alternatives[1].survey.station_positions[1]).tolist()
    out = str(tmp_path / "other")
    assert run(["plan", str(made), "--move", f"S2={x},{y},{z}", "--out", out, "--quiet"]) == 0
    content = json.loads((tmp_path / "other" / "plan.json").read_text())
    assert content["stations"][1]["position_mm"] == pytest.approx([x, y, z], abs=0.06)
    assert content["summary"].split(":")[0] == alternatives[1].verdict.split(":")[0]


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        (["--without", "S9"], "S9"),
        (["--move", "S2=1"], "expected STATION=X,Y or STATION=X,Y,Z or STATION=X,Y,Z,YAW in mm"),
        (["--move", "S2=6000,4000"], "S2 stands outside the permitted floor"),
        (["--without", "S2", "--out", "there"], "--without lists positions"),
    ],
)
def test_wrong_input_is_refused_in_a_sentence(
    given: list[str], sentence: str, made: Path, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert run(["plan", str(made), *given]) == 2
    error_text = capsys.readouterr().err
    assert sentence in error_text
    assert error_text.count("\n") == 1
    assert not list(tmp_path.iterdir())
