"""A cell's truth against the simulator: the same exact readings, the same laws of everything that is drawn."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import kstest

from ltsim.campaigns.cell import truth_of
from ltsim.campaigns.truth import BLOCK
from ltsim.effects import CATALOGUE, find_effect
from ltsim.effects.effect import NoiseEffect
from ltsim.errors import SetupError
from ltsim.geometry.polar import wrap
from ltsim.simulation.fieldwork import fieldwork
from ltsim.simulation.physics import effect_values
from ltsim.simulation.scenario import Scenario, load_scenario, scenario_from
from ltsim.simulation.simulator import exact_readings, measure, noise_sigma

BUILTIN = (
    "paper-workshop",
    "paper-workshop-two-face",
    "paper-workshop-re-aimed",
    "paper-laboratory",
    "two-trackers",
)


def scenario(**changes: Any) -> Scenario:
    table = load_scenario("paper-workshop").model_dump(mode="json", by_alias=True, exclude_none=True)
    return scenario_from(table | changes, Path("test.toml"))


@pytest.mark.parametrize("name", BUILTIN)
def test_readings_are_those_of_the_simulator(name: str) -> None:
    given = load_scenario(name)
    truth, work = truth_of(given, 3, "campaign"), fieldwork(given, 3, "campaign")
    block = truth.draw(3, 0)
    noise = noise_sigma(work, tuple(amount[:, 0] for amount in block.amounts))
    gaps = []
    for k in range(0, BLOCK, 8):
        exact = exact_readings(work, block.values[:, :, k], tuple(amount[:, k] for amount in block.amounts))
        gap = truth.readings(block, k) - exact
        gap[:, 1:] = wrap(gap[:, 1:])
        gaps.append(gap / noise)
    scores = np.array(gaps)
    assert abs(scores.mean()) < 5 / np.sqrt(scores.size)
    assert abs(scores.var() - 1) < 6 * np.sqrt(2 / scores.size)


def test_laws_are_those_of_the_simulator() -> None:
    """Means and spreads of what is drawn, against many single draws of the simulator."""
    effects = [
        {"name": "head-sag", "draw": True},
        {"name": "gauge-scale", "values": {"gauge-scale": 30.0}},
        {"name": "noise-level", "draw": True},
    ]
    given = scenario(effects=effects)
    truth, work = truth_of(given, 4, "campaign"), fieldwork(given, 4, "campaign")
    singles = [measure(work, 4, "many", k) for k in range(400)]
    blocks = [truth.draw(4, k) for k in range(4)]
    for name in ("beam-tilt", "range-scale", "beam-offset-lateral"):
        place = truth.construction.index(name)
        spread = np.std([one.instrument[name] for _, one in singles])
        assert np.std([b.values[0, place] for b in blocks]) == pytest.approx(spread, rel=0.15)
    for i in range(3):
        drawn = np.concatenate([b.amounts[i] for b in blocks], axis=1)
        known = np.array([one.effects[i].values for _, one in singles]).T
        assert np.mean(drawn, axis=1) == pytest.approx(np.mean(known, axis=1), abs=0.2 * np.std(known) + 1e-12)
        assert np.std(drawn, axis=1) == pytest.approx(np.std(known, axis=1), rel=0.2, abs=1e-12)
    stated = np.array([[d.length_mm for d in recording.gauge.distance] for recording, _ in singles]).T
    lengths = np.array([d.length_mm for d in truth.recording.gauge.distance])
    ours = np.concatenate([b.gauge_error for b in blocks], axis=1) * 1e3
    assert ours.mean(axis=1) == pytest.approx(stated.mean(axis=1) - lengths, abs=6e-4)
    assert ours.std(axis=1) == pytest.approx(stated.std(axis=1), rel=0.2)


def test_drawn_noise_levels_widen_single_trials() -> None:
    truth = truth_of(scenario(effects=[{"name": "noise-level", "draw": True}]), 5, "campaign")
    quiet = truth_of(scenario(), 5, "campaign")
    loud, still = truth.draw(5, 0), quiet.draw(5, 0)
    extra = loud.amounts[0][0]
    assert np.all(extra >= 0) and extra.std() > 0.1
    ratio = np.std(loud.deviation[:, 0] - quiet._exact(still.values)[:, 0], axis=0)
    usual = np.std(still.deviation[:, 0] - quiet._exact(still.values)[:, 0], axis=0)
    assert np.corrcoef(ratio / usual, np.sqrt(1 + extra))[0, 1] > 0.9


def test_stated_errors_are_not_drawn() -> None:
    truth = truth_of(scenario(instrument={"preset": "paper", "errors": {"draw": True, "beam-tilt": 7.0}}), 6)
    block = truth.draw(6, 0)
    place = truth.construction.index("beam-tilt")
    assert np.all(block.values[0, place] == 7e-6)
    assert block.values[0, 0].std() > 0


def test_an_error_that_the_instrument_cannot_have_is_refused() -> None:
    given = scenario(instrument={"preset": "paper", "errors": {"beam-tlt": 7.0}})
    with pytest.raises(SetupError, match="beam-tilt"):
        truth_of(given, 6)


def test_geometry_belongs_to_its_key() -> None:
    given = scenario()
    one, other, again = truth_of(given, 7, "a"), truth_of(given, 7, "b"), truth_of(given, 7, "a")
    assert np.array_equal(one.state.points, again.state.points)
    assert np.abs(one.state.points - other.state.points).max() > 1e-4
    assert np.array_equal(one.state.position[0], np.zeros(3))


def noise_effects() -> list[str]:
    return [kind.name for kind in CATALOGUE if issubclass(kind, NoiseEffect)]


@pytest.mark.parametrize("name", noise_effects())
def test_drawn_variances_are_half_normal_in_campaign_and_simulator(name: str) -> None:
    entry = {"name": name, "draw": True} | ({"stations": ["S2"]} if find_effect(name).scope == "station" else {})
    given = scenario(effects=[entry])
    truth, work = truth_of(given, 6, "campaign"), fieldwork(given, 6, "campaign")
    blocks = [truth.draw(6, k) for k in range(4)]
    assert all(np.all(np.isfinite(block.deviation)) for block in blocks)
    ours = np.concatenate([block.amounts[0] for block in blocks], axis=1)
    theirs = np.array([effect_values(given, work.effects, 6, "many", k)[0] for k in range(1000)]).T
    assert np.all(ours >= 0) and np.all(theirs >= 0)
    for k, parameter in enumerate(work.effects[0].parameters):
        assert kstest(ours[k] / parameter.prior_sigma, "halfnorm").pvalue > 1e-3
        assert kstest(theirs[k] / parameter.prior_sigma, "halfnorm").pvalue > 1e-3


def test_variance_below_zero_is_refused_by_both() -> None:
    given = scenario(effects=[{"name": "turbulence", "values": {"turbulence-along": -1e6}}])
    with pytest.raises(SetupError, match="takes away more noise than there is"):
        truth_of(given, 7, "campaign").draw(7, 0)
    with pytest.raises(SetupError, match="takes away more noise than there is"):
        measure(fieldwork(given, 7), 7)
