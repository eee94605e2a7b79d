"""The demonstration leaves what it says."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

from ltsim.cli.main import run
from ltsim.cli.simulate import DEMO_EFFECTS, DEMO_STEPS, calibrate_workshop, simulate_workshop
from ltsim.core.randomness import random_stream
from ltsim.physics.effects import find_effect


def test_first_steps(tmp_path: Path) -> None:
    assert "5 stations, 28 reflectors, 140 pointings" in simulate_workshop(tmp_path, 1)
    assert "stations agree about distances" in calibrate_workshop(tmp_path, 1)
    names = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    assert {
        "workshop/recording/observations.csv",
        "workshop/truth.json",
        "workshop/calibration.json",
    } <= names


def test_hidden_effects_exist_with_their_parameters() -> None:
    for entry in DEMO_EFFECTS:
        parameters = {p.name for p in find_effect(entry["name"]).parameters}
        assert set(entry["values"]) <= parameters
    drawn = {int(random_stream(seed, "demo", "hidden").integers(len(DEMO_EFFECTS))) for seed in range(40)}
    assert drawn == set(range(len(DEMO_EFFECTS)))


@pytest.mark.long
@pytest.mark.parametrize("seed", ["0", "2"])
def test_the_whole_demonstration(capsys, tmp_path: Path, seed: str) -> None:
    began = time.process_time()
    assert run(["demo", "--out", str(tmp_path), "--seed", seed, "--json"]) == 0
    assert time.process_time() - began < 60  # not the wall's clock: the machine may be busy with other things
    content = json.loads(capsys.readouterr().out)
    assert len(content["steps"]) == len(DEMO_STEPS)
    assert (tmp_path / "report.html").stat().st_size > 100_000
    verdict = json.loads((tmp_path / "concealed" / "diagnosis.json").read_text())
    hidden = json.loads((tmp_path / "concealed" / "truth.json").read_text())["effects"][0]["effect"]
    assert verdict["findings"][0]["effect"] == hidden
