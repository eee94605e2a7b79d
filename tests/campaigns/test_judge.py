"""What is judged where a station sees almost nothing, and where a target is not determined."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ltsim.adjustment.evaluation.clouds import align_to_points
from ltsim.campaigns.shard_rows import ShardTask, make_shard_rows
from ltsim.campaigns.spec import CampaignFile
from ltsim.campaigns.trial_evaluation import MICROMETRES_PER_METRE, TrialEvaluator
from ltsim.campaigns.true_network import make_true_network
from ltsim.geometry.polar import from_polar
from ltsim.simulation.scenario import Scenario, load_scenario, validate_scenario

N_SIGHTS_OF_LAST = (3, 3, 3, 2, 3, 3, 2, 3)
"""Targets that S6 reaches in the geometries of trials 0 to 7."""


def with_far_station(*, levelled: bool) -> Scenario:
    table = load_scenario("paper-workshop-re-aimed").model_dump(mode="json", by_alias=True, exclude_none=True)
    table["instrument"]["limits"]["range_max_mm"] = 5300.0
    table["stations"]["S6"] = {"position_mm": [6000.0, 5000.0, 1900.0], "yaw_deg": 225.0}
    for station in table["stations"].values():
        station["levelled"] = levelled
    return validate_scenario(table, Path("far.toml"))


def rows(scenario: Scenario) -> dict[str, list[object]]:
    campaign = CampaignFile(
        format="ltsim-campaign/1", trials=len(N_SIGHTS_OF_LAST), geometry="per-trial", verified_trials_per_shard=0
    )
    return dict(make_shard_rows(ShardTask(campaign, scenario, "", 0, 0)).to_pydict())


def test_station_with_two_sights_is_excluded_from_the_error() -> None:
    truth = make_true_network(with_far_station(levelled=True), 0, "campaign", 2)
    judge, block = TrialEvaluator(truth), truth.draw_batch(0, 2, 1)
    assert judge.is_measured.sum(axis=1)[-1] == 2 and judge.is_frame_determined.tolist() == [True] * 5 + [False]
    assert not judge.can_compute_criteria
    recording, total = truth.recording, []
    for station in range(5):
        mine = recording.station == station
        cloud = from_polar(truth.trial_readings(block, 0)[mine])
        goal = truth.state.target_points[recording.target[mine]]
        total.append(np.sum((align_to_points(cloud, goal) - goal) ** 2, axis=1))
    expected = MICROMETRES_PER_METRE * np.sqrt(np.concatenate(total).mean())
    assert judge.method_independent_columns(block)["error_raw_um"][0] == pytest.approx(expected, rel=1e-6)


def test_rows_of_geometries_that_see_different_things() -> None:
    table = rows(with_far_station(levelled=True))
    assert table["status"] == ["converged"] * len(N_SIGHTS_OF_LAST)
    for name in ("error_raw_um", "error_calibrated_um", "target_error_um"):
        assert all(isinstance(value, float) and 0 < value < 200 for value in table[name]), name
    assert [value is not None for value in table["distance_after_mean_um"]] == [n == 3 for n in N_SIGHTS_OF_LAST]


def test_trial_whose_geometry_determines_too_little_is_a_failed_row() -> None:
    table = rows(with_far_station(levelled=False))
    assert table["status"] == ["converged" if n == 3 else "failed" for n in N_SIGHTS_OF_LAST]
    assert [value is not None for value in table["target_error_um"]] == [n == 3 for n in N_SIGHTS_OF_LAST]


def test_target_that_a_trial_does_not_determine_is_excluded_from_its_error() -> None:
    truth = make_true_network(load_scenario("paper-workshop-re-aimed"), 3, "campaign")
    judge, draw = TrialEvaluator(truth), np.random.default_rng(5)
    points = 1e-5 * draw.standard_normal((*truth.state.target_points.shape, 4))
    whole = judge.adjusted_target_error(points)
    lost = points.copy()
    lost[7, :, 2] = np.nan
    error = judge.adjusted_target_error(lost)
    assert np.array_equal(error[[0, 1, 3]], whole[[0, 1, 3]])
    selection = np.arange(len(points)) != 7
    true = truth.state.target_points[selection]
    gap = align_to_points(true + points[selection][:, :, 2], true) - true
    assert error[2] == pytest.approx(MICROMETRES_PER_METRE * np.sqrt(np.mean(np.sum(gap**2, axis=1))), rel=1e-6)
    lost[:, :, 1] = np.nan
    assert np.isnan(judge.adjusted_target_error(lost)[1])
