"""Trials of several trackers on one network: drawn by name, calibrated in batch, recovered."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltsim as lt
from ltsim.campaigns.columns import parameter_labels, parameter_value_columns
from ltsim.campaigns.recovery_trials import scenario_with_errors_from_prior
from ltsim.campaigns.trial_calibrators import BatchCalibrator
from ltsim.campaigns.true_network import make_true_network
from ltsim.core.randomness import random_stream
from ltsim.simulation.scenario import change_scenario, load_scenario

TWO = load_scenario("two-trackers")


def test_a_block_draws_each_tracker_by_its_name_and_calibrates_them_together() -> None:
    truth = make_true_network(TWO, 4, "campaign")
    block = truth.draw_batch(4, 0, 64)
    assert block.instrument_values.shape == (2, 16, 64)
    for i, name in enumerate(truth.recording.instruments):
        for k, parameter in enumerate(truth.construction.parameter_names):
            drawn = random_stream(4, "instrument", name, parameter, "block", 0).standard_normal(64)
            drawn[0] = random_stream(4, "instrument", name, parameter).standard_normal()
            np.testing.assert_array_equal(
                block.instrument_values[i, k], truth.distributions.instrument_error_sigmas[i, k] * drawn
            )
    engine = BatchCalibrator(truth, truth.construction)
    calibrated = engine.calibrate(block)
    z = (calibrated.instrument_values - block.instrument_values) / calibrated.instrument_sigmas[:, :, None]
    assert np.all(np.abs(z.mean(axis=2)) < 5 / 8) and abs(np.mean(z**2) - 1) < 0.2
    assert engine.largest_solver_difference(block, int(np.argmin(calibrated.status_indices)), calibrated) < 1e-3
    labels = parameter_labels(truth.construction, truth.recording.instruments, ())
    columns = parameter_value_columns(labels, calibrated.estimates_and_sigmas[0], "estimate")
    tilt = truth.construction.parameter_index("beam-tilt")
    np.testing.assert_allclose(columns["estimate:beam-tilt@B"], calibrated.instrument_values[1, tilt] * 1e6)


def test_recovery_checks_every_trackers_parameters() -> None:
    drawn = scenario_with_errors_from_prior(load_scenario("two-trackers"))
    assert all(tracker.draws_errors and tracker.error_factor == 1.0 for tracker in drawn.trackers_in_use.values())
    recovery = lt.recover("two-trackers", trials=12, seed=1)
    assert recovery.failed_checks() == [] and recovery.arrays.z_scores.shape == (12, 32)
    names = [p.parameter for p in recovery.parameters]
    assert names[0] == "range-offset@A" and names[31] == "elevation-second-order-sin@B"


@pytest.mark.long
@pytest.mark.parametrize("construction", ["misalignment", "steering-mirror", "dh"])
@pytest.mark.parametrize("trackers", ["ABAB", "ABCA"])
def test_intervals_hold_for_every_construction_and_number_of_trackers(construction: str, trackers: str) -> None:
    changes: dict[str, Any] = {f"stations.S{i}.instrument": name for i, name in enumerate(trackers, start=1)}
    changes |= {f"instruments.{name}.construction": construction for name in set(trackers)}
    recovery = lt.recover(change_scenario(TWO, changes, Path("hall.toml")), trials=60, seed=8).arrays
    assert len(recovery.available_trial_scores) == 60
    assert 0.93 < np.mean(np.abs(recovery.z_scores) < 1.96) < 0.97
