"""What a campaign can also compare: eq. 9 as printed, what is applied, wrong priors, instruments that change."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ltsim.campaigns.shard_rows import ShardTask, make_shard_rows
from ltsim.campaigns.spec import CampaignFile, make_validation_scenario
from ltsim.core.errors import RecordError
from ltsim.recordings.settings import validate_settings
from ltsim.simulation.scenario import change_scenario, load_scenario
from ltsim.simulation.simulator import simulate

PAPER = load_scenario("paper-workshop")
FILE = Path("campaign.toml")
ERROR = "new_point_error_calibrated_um"


def rows(key: str, value: Any, trials: int, *methods: dict[str, Any], **more: Any) -> dict[str, Any]:
    """Columns as arrays; `key` of the scenario changed."""
    tables = {"format": "ltsim-campaign/1", "seed": 4, "trials": trials, "methods": methods, "statistics": ["errors"]}
    made = CampaignFile.model_validate(
        {**tables, "validation_points": "paper-laboratory", "verified_trials_per_shard": 2, **more}
    )
    scenario = change_scenario(PAPER, {key: value}, FILE)
    table = make_shard_rows(
        ShardTask(made, scenario, "", 0, 0, make_validation_scenario(made.validation_points, scenario, FILE))
    )
    return {name: np.array(column) for name, column in table.to_pydict().items()}


def mean(columns: dict[str, Any], column: str, method: str) -> float:
    return float(np.mean(columns[column][columns["method"] == method].astype(float)))


@pytest.mark.long
def test_the_batch_finds_the_minimum_of_equation_9_that_users_find() -> None:
    columns = rows("work.faces", 1, 4, {"method": "equation-9"}, {"method": "equation-9-l1"})
    gaps = columns["full_difference_sigma"].astype(float)
    assert np.sum(np.isfinite(gaps)) == 4
    assert np.nanmax(gaps) < 1e-3
    assert set(columns["status"]) == {"converged"}


def test_a_wrong_prior_changes_declared_values_and_no_true_values() -> None:
    wide = change_scenario(PAPER, {"instrument.prior_factor": 100.0}, FILE)
    (right, truth), (recordings, same) = simulate(PAPER, 3), simulate(wide, 3)
    assert recordings.setup.instrument.prior.angle_arcsec == 100 * right.setup.instrument.prior.angle_arcsec
    assert dict(truth.instrument_values) == dict(same.instrument_values)
    np.testing.assert_array_equal(right.readings, recordings.readings)


@pytest.mark.long
def test_what_is_applied_minds_a_wrong_prior_less_than_the_estimates() -> None:
    applied = {"name": "applied", "solver": "single", "uses_applied_corrections": True}
    columns = rows("instrument.prior_factor", 1000.0, 4, applied, {"name": "estimates"})
    assert mean(columns, ERROR, "applied") < mean(columns, ERROR, "estimates")


def test_an_instrument_that_changed_reads_otherwise_where_it_is_judged() -> None:
    still, moved = (rows("work.faces", 1, 64, {}, validation_drift=drift) for drift in (0.0, 1.0))
    np.testing.assert_array_equal(still["error_calibrated_um"], moved["error_calibrated_um"])
    assert mean(moved, ERROR, "network") > 1.1 * mean(still, ERROR, "network")
    assert mean(moved, "new_point_error_raw_um", "network") > 1.1 * mean(still, "new_point_error_raw_um", "network")


@pytest.mark.parametrize(
    ("tables", "sentence"),
    [
        ({"methods": [{"effects": [{"name": "range-step"}] * 201}]}, "should hold at most 200"),
        ({"linked_keys": {f"k{i}": ["instrument.noise_factor"] for i in range(65)}}, "should hold at most 64"),
    ],
)
def test_lists_are_limited_before_any_work(tables: dict[str, Any], sentence: str) -> None:
    """20,000 effects of a method took all memory."""
    with pytest.raises(RecordError, match=sentence):
        validate_settings({"format": "ltsim-campaign/1", **tables}, CampaignFile, "campaign", FILE)


def test_a_repeated_statistic_counts_once() -> None:
    tables = {"format": "ltsim-campaign/1", "statistics": ["errors"] * 1000}
    assert validate_settings(tables, CampaignFile, "campaign", FILE).statistics == ("errors",)


@pytest.mark.parametrize(
    "method",
    [{"uses_applied_corrections": True}, {"uses_applied_corrections": True, "solver": "single", "method": "distance"}],
)
def test_applied_values_exist_for_single_networks_only(method: dict[str, Any]) -> None:
    with pytest.raises(RecordError, match=r"solver = .single."):
        validate_settings({"format": "ltsim-campaign/1", "methods": [method]}, CampaignFile, "campaign", FILE)
