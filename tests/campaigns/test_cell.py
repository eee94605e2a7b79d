"""A cell's trials are the recordings that `simulate` writes: the same draws, and calibrated the same rows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import kstest

import ltsim as lt
from ltsim.campaigns.shard_rows import ShardTask, make_shard_rows
from ltsim.campaigns.spec import CampaignFile
from ltsim.campaigns.true_network import make_true_network
from ltsim.core.errors import InputError
from ltsim.geometry.polar import wrap_angle
from ltsim.physics.effects import CATALOGUE, find_effect
from ltsim.physics.effects.effect import Blunder, NoiseEffect
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings.references import ReferenceLengths
from ltsim.simulation.draws import StandardNormalSource
from ltsim.simulation.measurement_geometry import make_measurement_geometry
from ltsim.simulation.scenario import Scenario, load_scenario, validate_scenario
from ltsim.simulation.simulator import measure_trial

BUILTIN = (
    "paper-workshop",
    "paper-workshop-two-face",
    "paper-workshop-re-aimed",
    "paper-laboratory",
    "two-trackers",
)
TRIAL, SEED = 5, 3
SIGMAS = 2e-3
"""[sigma] by which the row of a trial may differ from its recording calibrated alone: a campaign stops at 5e-5 of all
unknowns, treats effects as linear within 1e-3 of a reading's sigma, and keeps seven digits."""


def scenario(**changes: Any) -> Scenario:
    table = load_scenario("paper-workshop").model_dump(mode="json", by_alias=True, exclude_none=True)
    return validate_scenario(table | changes, Path("test.toml"))


def with_effect(name: str) -> Scenario:
    """The workshop with an effect drawn where such effects act; a blunder that is made."""
    kind = find_effect(name)
    entry: dict[str, Any] = {"name": name, "draw": True}
    if issubclass(kind, Blunder):
        sightings = make_measurement_geometry(load_scenario("paper-workshop"), SEED).sightings
        made = kind.possible_blunders(sightings)[0]
        entry = {"name": name, "values": {made.parameters[0].name: 1.0}}
        entry |= {"stations": list(made.stations), "targets": list(made.targets)}
    elif kind.scope == "station":
        entry["stations"] = ["S2"]
    elif kind.scope in ("target", "pointing", "reading"):
        entry |= {"stations": ["S2"], "targets": ["T07"]} if kind.scope != "target" else {"targets": ["T07"]}
    return scenario(effects=[entry])


@pytest.mark.parametrize("name", [kind.name for kind in CATALOGUE])
def test_a_trial_is_the_recording_that_simulate_writes(name: str) -> None:
    """Over the whole catalogue: readings to a thousandth of sigma or a step of the resolution, lengths to 1 nm."""
    given = with_effect(name)
    truth = make_true_network(given, SEED)
    block = truth.draw_batch(SEED, 0, 8)
    recording, true = lt.simulate(given, seed=SEED, trial=TRIAL)
    gap = truth.trial_readings(block, TRIAL) - recording.readings
    gap[:, 1:] = wrap_angle(gap[:, 1:])
    step = truth.resolution[0]
    assert np.all(np.abs(gap) <= 1e-3 * recording.reading_sigmas() + 1.001 * step)
    assert np.mean(np.abs(gap) > 0.5 * step) < 0.02
    np.testing.assert_array_equal(block.instrument_values[0, :, TRIAL], list(true.instrument_values.values()))
    np.testing.assert_array_equal(block.effect_values[0][:, TRIAL], true.applied_effects[0].parameter_values)
    lengths = truth.distributions.reference_lengths.lengths + block.length_errors[:, TRIAL]
    np.testing.assert_allclose(lengths, ReferenceLengths.from_recording(recording).lengths, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", BUILTIN)
def test_readings_of_every_scenario_are_those_of_simulate(name: str) -> None:
    given = load_scenario(name)
    truth = make_true_network(given, SEED)
    block = truth.draw_batch(SEED, 1)
    recording, _ = lt.simulate(given, seed=SEED, trial=300)
    gap = truth.trial_readings(block, 300 - 256) - recording.readings
    gap[:, 1:] = wrap_angle(gap[:, 1:])
    assert np.mean(np.abs(gap) > 1e-12) < 0.01


@pytest.mark.long
@pytest.mark.parametrize("geometry", ["shared", "per-trial"])
@pytest.mark.parametrize("method", ["network", "distance"])
def test_a_trial_written_and_calibrated_is_its_row(method: str, geometry: Any, tmp_path: Path) -> None:
    given = scenario(effects=[{"name": "head-sag", "draw": True}])
    campaign = CampaignFile.model_validate(
        {
            "format": "ltsim-campaign/1",
            "seed": SEED,
            "trials": 8,
            "geometry": geometry,
            "verified_trials_per_shard": 0,
            "statistics": ["estimates"],
            "methods": [{"method": method}],
        }
    )
    row = make_shard_rows(ShardTask(campaign, given, "", 0, 0)).slice(TRIAL, 1).to_pylist()[0]
    lt.write(lt.simulate(given, seed=SEED, trial=TRIAL, geometry=geometry).recording, tmp_path / "rec")
    calibration = lt.calibrate(tmp_path / "rec", method=method)
    assert row["trial"] == TRIAL
    factor = np.array([p.si_per_display_unit for p in misalignment_construction().parameters])
    ours, sigma = (
        np.array([row[f"{what}:{name}"] for name in calibration.instrument_parameter_names])
        for what in ("estimate", "sigma")
    )
    gap = (ours * factor - calibration.estimates[0]) / calibration.sigma[0]
    assert np.abs(gap).max() < SIGMAS
    np.testing.assert_allclose(sigma * factor, calibration.sigma[0], rtol=2e-3)


def test_nothing_that_is_never_negative_is_drawn_so() -> None:
    """a8a5717 drew glass of negative thickness in half of the trials of a campaign."""
    is_nonnegative = [k for k in CATALOGUE if issubclass(k, NoiseEffect) or any(p.is_nonnegative for p in k.parameters)]
    assert {"window", "noise-level"} <= {kind.name for kind in is_nonnegative}
    for kind in is_nonnegative:
        truth = make_true_network(with_effect(kind.name), 6)
        drawn = truth.distributions.draw(StandardNormalSource(6, np.arange(1024))).effect_values[0]
        for k, parameter in enumerate(truth.effects[0].effect.parameters):
            if truth.effects[0].is_nonnegative[k]:
                assert np.all(drawn[k] >= 0)
                assert kstest(drawn[k] / parameter.prior_sigma, "halfnorm").pvalue > 1e-3


def test_drawn_noise_levels_widen_single_trials() -> None:
    truth = make_true_network(scenario(effects=[{"name": "noise-level", "draw": True}]), 5)
    quiet = make_true_network(scenario(), 5)
    loud, still = truth.draw_batch(5, 0), quiet.draw_batch(5, 0)
    extra = loud.effect_values[0][0]
    assert np.all(extra >= 0) and extra.std() > 0.1
    ratio = np.std(
        loud.reading_deviations[:, 0] - quiet._exact_reading_deviations(still.instrument_values)[:, 0], axis=0
    )
    usual = np.std(
        still.reading_deviations[:, 0] - quiet._exact_reading_deviations(still.instrument_values)[:, 0], axis=0
    )
    assert np.corrcoef(ratio / usual, np.sqrt(1 + extra))[0, 1] > 0.9


def test_declared_errors_are_not_drawn() -> None:
    truth = make_true_network(scenario(instrument={"preset": "paper", "errors": {"draw": True, "beam-tilt": 7.0}}), 6)
    block = truth.draw_batch(6, 0)
    place = truth.construction.parameter_index("beam-tilt")
    assert np.all(block.instrument_values[0, place] == 7e-6)
    assert block.instrument_values[0, 0].std() > 0


def test_an_error_that_the_instrument_cannot_have_is_refused() -> None:
    given = scenario(instrument={"preset": "paper", "errors": {"beam-tlt": 7.0}})
    with pytest.raises(InputError, match="beam-tilt"):
        make_true_network(given, 6)


def test_geometry_belongs_to_its_key() -> None:
    given = scenario()
    first, other, again = (
        make_true_network(given, 7, "a"),
        make_true_network(given, 7, "b"),
        make_true_network(given, 7, "a"),
    )
    assert np.array_equal(first.state.target_points, again.state.target_points)
    assert np.abs(first.state.target_points - other.state.target_points).max() > 1e-4
    assert np.array_equal(first.state.station_positions[0], np.zeros(3))


def test_variance_below_zero_is_refused_by_both() -> None:
    given = scenario(effects=[{"name": "turbulence", "values": {"turbulence-along": -1e6}}])
    with pytest.raises(InputError, match="makes a variance of readings negative"):
        make_true_network(given, 7).draw_batch(7, 0)
    with pytest.raises(InputError, match="makes a variance of readings negative"):
        measure_trial(make_measurement_geometry(given, 7), 7)
