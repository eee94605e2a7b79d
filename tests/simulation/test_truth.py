from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ltsim.adjustment.evaluation.criteria import read_nominal
from ltsim.core.errors import ModelError, RecordError
from ltsim.simulation.scenario import Scenario, load_scenario
from ltsim.simulation.simulator import simulate
from ltsim.simulation.truth import Truth, nominal_points_csv, read_truth, write_truth

EFFECTS = [
    {"name": "station-settling", "stations": ["S3"], "draw": True, "shape": {"time_constant": 9.0}},
    {"name": "azimuth-harmonic", "draw": True, "shape": {"order": 4}},
]


@pytest.fixture(scope="module")
def truth() -> Truth:
    data = load_scenario("paper-workshop").model_dump(by_alias=True, exclude_none=True)
    return simulate(Scenario.model_validate({**data, "effects": EFFECTS}), 3)[1]


def test_round_trip(truth: Truth, tmp_path: Path) -> None:
    path = tmp_path / "truth.json"
    write_truth(truth, path)
    again = read_truth(path)
    for name in ("station_positions", "station_rotations", "target_points"):
        np.testing.assert_allclose(getattr(again, name), getattr(truth, name), rtol=0, atol=1e-14)
    assert again.instrument_values == pytest.approx(truth.instrument_values, rel=1e-14)
    assert (again.stations, again.targets, again.parameter_units) == (
        truth.stations,
        truth.targets,
        truth.parameter_units,
    )
    assert [a.name for a in again.effects] == ["station-settling", "azimuth-harmonic", "smr-incidence"]
    for effect, other in zip(again.applied_effects, truth.applied_effects, strict=True):
        assert effect.effect == other.effect
        np.testing.assert_allclose(effect.parameter_values, other.parameter_values, rtol=1e-14)


def test_display_units_in_the_file(truth: Truth) -> None:
    content = truth.content()
    tilt = next(p for p in content["parameters"] if p["name"] == "beam-tilt")
    assert tilt["unit"] == "urad" and tilt["value"] == pytest.approx(truth.instrument_values["beam-tilt"] * 1e6)
    assert content["effects"][0]["shape"]["time_constant"] == pytest.approx(9.0)
    assert truth.applied_effects[0].effect.time_constant == pytest.approx(540.0)  # type: ignore[attr-defined]


def test_nominal_points_are_what_verification_reads(tmp_path: Path) -> None:
    _, truth = simulate(load_scenario("paper-laboratory"), 3)
    nominal = truth.arrays.nominal_points
    assert nominal is not None
    path = tmp_path / "nominal.csv"
    path.write_text(nominal_points_csv(truth))
    read = read_nominal(path)
    np.testing.assert_allclose([read[name] for name in truth.target_names], nominal, atol=0.6e-7)
    again = Truth.model_validate(truth.content()).arrays.nominal_points
    assert again is not None
    np.testing.assert_allclose(again, nominal, atol=1e-14)


def test_no_nominal_points_without_a_machine(truth: Truth) -> None:
    with pytest.raises(ModelError, match="measures_targets = true"):
        nominal_points_csv(truth)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "ltsim-recording/1"}, "format"),
        ({"stations": []}, "stations"),
        ({"noise_factor": "loud"}, "noise_factor"),
        ({"parameters": [{"name": "a", "value": 1.0, "unit": "furlong"}]}, "'furlong' is not a unit"),
        ({"effects": [{"effect": "ghost"}]}, "no effect called 'ghost'"),
        ({"nominal_points": [{"name": "X", "position_mm": [0, 0, 0]}]}, "differ from those of the targets"),
    ],
)
def test_wrong_files_are_refused_in_a_sentence(
    change: dict[str, object], message: str, truth: Truth, tmp_path: Path
) -> None:
    path = tmp_path / "truth.json"
    path.write_text(json.dumps({**truth.content(), **change}))
    with pytest.raises(RecordError, match=message) as caught:
        read_truth(path)
    assert "truth.json" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[1]"])
def test_files_that_are_no_truth(text: str, tmp_path: Path) -> None:
    path = tmp_path / "truth.json"
    path.write_text(text)
    with pytest.raises(RecordError, match=r"truth\.json"):
        read_truth(path)
