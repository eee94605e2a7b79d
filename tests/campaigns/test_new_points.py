"""Campaigns that judge on points that were not calibrated on, effects of the session, and paired differences."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment.evaluation.clouds import removed_error_fraction
from ltsim.campaigns.results import _requested_level
from ltsim.campaigns.schema import RESULT_COLUMNS, find_result_column
from ltsim.campaigns.shard_rows import ShardTask, make_shard_rows
from ltsim.campaigns.spec import CampaignFile, make_validation_scenario
from ltsim.core.errors import InputError, ModelError
from ltsim.physics.effects import CATALOGUE
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter, design_from_front_face_corrections
from ltsim.scene.sightings import Sightings
from ltsim.simulation.scenario import Scenario, load_scenario
from tests.networks import share_removed

PAPER = load_scenario("paper-workshop")
ERRORS = tuple(f"new_point_error_{what}_um" for what in ("raw", "calibrated", "true_parameters"))


@dataclass(frozen=True)
class SlowWarp(Effect):
    """Elevation creeps with time: an effect of this session, without a card or a package."""

    name = "slow-warp"
    light_path_stage = LightPathStage.ENCODERS
    parameters = (Parameter("rate", "urad/h", "elevation", 20e-6 / 3600),)

    def design(self, sightings: Sightings) -> np.ndarray:
        return design_from_front_face_corrections(sightings, elevation=sightings.time)[:, :, None]


@pytest.fixture(autouse=True)
def session() -> Iterator[None]:
    """The effect is known in these tests alone."""
    catalogue = dict(CATALOGUE.__dict__)
    assert lt.add_effect(SlowWarp) is SlowWarp
    yield
    CATALOGUE.__dict__.clear()
    CATALOGUE.__dict__.update(catalogue)


def campaign(**more: Any) -> CampaignFile:
    base = {"format": "ltsim-campaign/1", "seed": 4, "trials": 48, "verified_trials_per_shard": 1}
    return CampaignFile.model_validate({**base, **more})


def rows(made: CampaignFile, scenario: Scenario = PAPER) -> dict[str, list[Any]]:
    judge = (
        make_validation_scenario(made.validation_points, scenario, Path("campaign.toml"))
        if made.validation_points
        else None
    )
    return dict(make_shard_rows(ShardTask(made, scenario, "", 0, 0, judge)).to_pydict())


@pytest.mark.long
def test_the_same_instruments_are_judged_where_nothing_was_calibrated(tmp_path: Path) -> None:
    """Every trial's error there, against a recording of that place corrected by what the trial found."""
    made = campaign(validation_points="paper-laboratory", statistics=["errors", "estimates", "truth"], trials=6)
    table = rows(made)
    raw, after, perfect = (np.array(table[name]) for name in ERRORS)
    assert np.mean(perfect) < np.mean(after) and np.all(after < raw)
    room = load_scenario("paper-laboratory")
    names = lt.calibrate(lt.simulate(PAPER, seed=4).recording).instrument_parameter_names
    for trial in range(2):
        exact = {name: table[f"true:{name}"][trial] for name in names}
        measured, truth = lt.simulate(room, seed=9, trial=trial, changes={"instrument.errors": exact})
        built = lt.calibrate(lt.simulate(PAPER, seed=4).recording).construction
        values = np.array(
            [
                table[f"estimate:{n}"][trial] * p.si_per_display_unit
                for n, p in zip(names, built.parameters, strict=True)
            ]
        )
        true = np.array([truth.instrument_values[n] for n in names])
        judged = share_removed(measured, truth.target_points, built, calibrated=values, true_parameters=true)
        # Another noise, another placing: the same instrument's error to a fifth.
        assert raw[trial] == pytest.approx(1e6 * judged.raw_rms, rel=0.2)
        assert perfect[trial] == pytest.approx(1e6 * judged.true_parameters_rms, rel=0.2)
        assert after[trial] == pytest.approx(1e6 * judged.calibrated_rms, rel=0.25)


def test_points_of_a_table_are_measured_from_the_stations_of_the_cell(tmp_path: Path) -> None:
    table = "target,x_mm,y_mm,z_mm\nA,500,500,1500\nB,5500,600,2500\nC,800,5400,700\nD,5200,5300,3200\n"
    (tmp_path / "points.csv").write_text(table)
    judge = make_validation_scenario("points.csv", PAPER, tmp_path / "campaign.toml")
    assert tuple(judge.targets) == ("A", "B", "C", "D") and judge.gauge is None
    assert judge.stations == PAPER.stations and judge.instrument == PAPER.instrument
    made = campaign(validation_points=str(tmp_path / "points.csv"), statistics=["errors"], trials=8)
    assert all(value is not None for name in ERRORS for value in rows(made)[name])
    for lost, says in (("nowhere.csv", "nowhere.csv"), ("two-trackers", "should name the trackers of the cells")):
        with pytest.raises(InputError, match=says):
            make_validation_scenario(lost, PAPER, tmp_path / "campaign.toml")


@pytest.mark.long
@pytest.mark.parametrize("solver", ["batch", "single"])
def test_an_effect_of_the_session_is_fitted_taken_out_and_has_columns(solver: str) -> None:
    entry = [{"name": "slow-warp"}]
    methods = [{"name": "plain", "solver": solver}, {"name": "with", "solver": solver, "effects": entry}]
    warped = lt.scenario(PAPER, {"effects": [{"name": "slow-warp", "draw": True}]})
    table = rows(campaign(methods=methods, trials=24, statistics=["errors", "estimates", "truth", "z-scores"]), warped)
    mine = np.array(table["method"]) == "with"
    columns = {
        kind: np.array(table[f"{kind}:slow-warp:rate"], dtype=float) for kind in ("estimate", "sigma", "true", "z")
    }
    z = (columns["estimate"] - columns["true"])[mine] / columns["sigma"][mine]
    assert z == pytest.approx(columns["z"][mine], abs=1e-3) and 0.5 < z.std() < 1.6
    error = np.array(table["error_calibrated_um"])
    assert np.sqrt(np.mean(error[mine] ** 2)) < 0.9 * np.sqrt(np.mean(error[~mine] ** 2))


@pytest.mark.long
def test_what_calibrate_fits_is_taken_out_of_what_it_improves() -> None:
    """a8a5717 left it in: a fit that explains the readings made the improvement fall."""
    changes = {"effects": [{"name": "slow-warp", "values": {"rate": 60.0}}]}
    recording, _ = lt.simulate(PAPER, seed=3, changes=changes)
    plain, fitted = (lt.calibrate(recording, with_effects=effects) for effects in ((), ("slow-warp",)))
    assert fitted.fit.chi2 < 0.8 * plain.fit.chi2
    assert fitted.criteria.distance.improvement_percent > plain.criteria.distance.improvement_percent + 2


def test_an_effect_of_the_session_is_checked() -> None:
    assert SlowWarp in CATALOGUE and CATALOGUE.runtime_effects == (SlowWarp,)
    with pytest.raises(ModelError, match="not a class derived from"):
        lt.add_effect(int)
    with pytest.raises(ModelError, match="already has an effect 'head-sag'"):
        lt.add_effect(type("Mine", (SlowWarp,), {"name": "head-sag"}))


@pytest.mark.long
def test_paired_differences_on_common_draws(tmp_path: Path) -> None:
    methods = [{"method": "network"}, {"method": "distance"}]
    made = campaign(
        methods=methods, grid={"work.faces": [1, 2]}, statistics=["errors"], validation_points="paper-laboratory"
    )
    results = lt.campaign(made.model_dump(mode="json", exclude_none=True), out=tmp_path / "out")
    (face_1, face_2) = results.paired_differences(
        "new_point_error_calibrated_um", method=("distance", "network")
    ).entries
    assert [e.shared_levels for e in (face_1, face_2)] == [{"faces": 1}, {"faces": 2}] and face_1.unit == "um"
    assert face_1.low < face_1.difference < face_1.high and face_1.trials == 48
    values = results.to_dataframe("rows").pivot_table(
        "new_point_error_calibrated_um", ["cell", "trial"], "method", aggfunc="first"
    )
    gap = (values["distance"] - values["network"])[0]
    assert face_1.difference == pytest.approx(gap.mean(), rel=1e-6)
    separate_sigma = np.sqrt(values["distance"][0].var() + values["network"][0].var())
    assert gap.std() < 0.9 * separate_sigma  # the draws are common
    faces = results.paired_differences("share_removed", faces=(2, 1))
    assert [e.shared_levels for e in faces.entries] == [{"method": "network"}, {"method": "distance"}]
    frame = results.to_dataframe("rows").query("method == 'network'")
    shares = [
        removed_error_fraction(
            *(group[f"error_{what}_um"].to_numpy() for what in ("raw", "calibrated", "true_parameters"))
        )
        for _, group in frame.groupby("faces")
    ]
    assert faces.entries[0].difference == pytest.approx(shares[1] - shares[0], rel=1e-5)
    spread = next(s for s in results.statistic_summaries("share_removed") if (s.cell, s.method) == (0, "network"))
    assert spread.mean == pytest.approx(shares[0], rel=1e-5) and spread.low < spread.mean < spread.high
    for wrong in ({"method": ("distance", "nothing")}, {"face": (1, 2)}, {"faces": (1, 3)}):
        with pytest.raises(ModelError):
            results.paired_differences("target_error_um", **wrong)


def test_every_column_of_rows_is_defined_once() -> None:
    made = campaign(
        trials=4,
        statistics=["criteria", "errors", "z-scores", "estimates", "truth"],
        validation_points="paper-workshop",
    )
    judge = make_validation_scenario(made.validation_points, PAPER, Path("campaign.toml"))
    schema = make_shard_rows(ShardTask(made, PAPER, "", 0, 0, judge)).schema
    results = [field for field in schema if field.name not in ("cell", "method", "trial", "status")]
    assert all(field.metadata[b"meaning"].decode() == find_result_column(field.name).meaning for field in results)
    assert len({column.name for column in RESULT_COLUMNS}) == len(RESULT_COLUMNS)


@pytest.mark.parametrize("given", ["2 urad", 0.412529612494, 0.41253, 0.4125])
def test_a_level_is_given_with_its_unit_or_rounded(given: object) -> None:
    levels = [0.9, 0.412529612494193, 2.0]
    assert _requested_level("angle_noise_arcsec", given, levels) == levels[1]


@pytest.mark.parametrize("given", ["2 mm", 0.42, "small", True])
def test_a_value_that_is_no_level_is_refused(given: object) -> None:
    with pytest.raises(ModelError, match=r"level of angle_noise_arcsec"):
        _requested_level("angle_noise_arcsec", given, [0.9, 0.412529612494193, 2.0])
    with pytest.raises(ModelError, match=r"level of angle_noise_arcsec"):
        _requested_level("angle_noise_arcsec", 0.41253, [0.41252, 0.41254])
