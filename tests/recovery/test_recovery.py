"""Predicted uncertainty against experiment, and that the check can fail."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import ltsim as lt
from ltsim.calibration.network import calibrate_network
from ltsim.campaigns.recovery import Recovery
from ltsim.campaigns.recovery_checks import RECOVERY_FALSE_ALARM_RATE, parameter_checks, unit_mean_check
from ltsim.campaigns.recovery_trials import (
    RecoverySettings,
    RecoveryTrials,
    run_recovery_trials,
    scenario_with_errors_from_prior,
)
from ltsim.campaigns.scoring import NetworkScore, TrialScore
from ltsim.physics.effects.smr_incidence import SmrIncidence
from ltsim.physics.model.construction import GeometricErrorModel, misalignment_construction
from ltsim.simulation.builtin import builtin_names
from ltsim.simulation.measurement_geometry import make_measurement_geometry
from ltsim.simulation.scenario import Scenario, change_scenario, load_scenario
from ltsim.simulation.simulator import measure_trial
from tests.families import family
from tests.networks import target_error

COVERED_AT = stats.norm.isf(0.025)


def recovery(*trials: TrialScore | None) -> Recovery:
    return Recovery.from_trials(RecoveryTrials(trials))


def run_recovery(name: str, trials: int, **settings) -> Recovery:
    how = RecoverySettings(settings.pop("method", "network"), settings.pop("construction", None))
    return recovery(*run_recovery_trials(load_scenario(name), trials, how, seed=11, **settings))


def flipped(error_key: str) -> GeometricErrorModel:
    """The misalignment construction with the sign of one motion's error turned round."""
    construction = misalignment_construction()
    chain = tuple(
        dataclasses.replace(m, amount_factor=-m.amount_factor) if m.error_key == error_key else m
        for m in construction.kinematic_chain
    )
    assert chain != construction.kinematic_chain
    return dataclasses.replace(construction, kinematic_chain=chain)


EVERY_SCENARIO = pytest.mark.parametrize("name", builtin_names())


@EVERY_SCENARIO
def test_every_built_in_scenario_is_recovered(name: str) -> None:
    assert [c.sentence() for c in run_recovery(name, 12).failed_checks()] == []


@pytest.mark.long
@EVERY_SCENARIO
def test_every_built_in_scenario_is_recovered_in_many_trials(name: str) -> None:
    """Errors over their sigmas as they are, of a table that is stated among them, and as the check expects them."""
    recovery_result = run_recovery(name, 1000, jobs=2)
    assert [c.sentence() for c in recovery_result.failed_checks()] == []
    trials = recovery_result.arrays
    z = trials.z_scores
    assert np.abs(z.mean(axis=0)).max() < 0.15
    deviation, covered = (
        trials._attribute_by_trial("prior_independent_z_scores").std(axis=0, ddof=1),
        np.mean(np.abs(z) < COVERED_AT, axis=0),
    )
    tight = stats.norm.isf(0.5 * RECOVERY_FALSE_ALARM_RATE / (2 * z.shape[1]))
    assert np.abs(deviation - 1.0).max() < 0.05 + tight / np.sqrt(2 * len(z))
    assert np.abs(covered - 0.95).max() < 0.015 + tight * np.sqrt(0.95 * 0.05 / len(z))
    for what in ("target_mean_square", "station_mean_square"):
        assert np.mean([getattr(t.network_score, what) for t in trials.available_trial_scores]) == pytest.approx(
            1.0, abs=0.08
        )


@pytest.mark.long
def test_the_reflectors_error_is_recovered_without_a_prior() -> None:
    """A table is a set of parameters: an effect that is estimated freely finds it within its uncertainty."""
    recovery = lt.recover("paper-workshop", trials=24, seed=5, with_effects="smr-incidence")
    names = [p.parameter for p in recovery.parameters if p.parameter.startswith("smr-incidence:")]
    assert len(names) == len(SmrIncidence.parameters)
    assert [c.sentence() for c in recovery.failed_checks()] == []


@pytest.mark.long
def test_a_fixed_nest_without_the_error_in_the_model_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ltsim.physics.model.measurement.incidence_errors", lambda recording: ())
    assert run_recovery("paper-workshop", 60).failed_checks()


@pytest.mark.long
@pytest.mark.parametrize("method", ["distance", "distance-l1"])
def test_the_paper_methods_state_their_uncertainty_too(method: str) -> None:
    assert [
        c.sentence() for c in run_recovery("paper-workshop-re-aimed", 200, method=method, jobs=2).failed_checks()
    ] == []


@pytest.mark.long
def test_the_paper_chain_recovers_itself() -> None:
    scenario = load_scenario("paper-workshop-two-face")
    instrument = scenario.instrument.model_copy(update={"construction": "dh"})
    scenario = scenario.model_copy(update={"instrument": instrument})
    recovery_result = recovery(*run_recovery_trials(scenario, 100, RecoverySettings(), seed=3, jobs=2))
    assert [c.sentence() for c in recovery_result.failed_checks()] == []


@pytest.mark.parametrize("error_key", family(["transit-offset", "beam-tilt"]))
def test_a_flipped_sign_fails_and_is_named(error_key: str) -> None:
    failures = run_recovery("paper-workshop-two-face", 25, construction=flipped(error_key)).failed_checks()
    assert error_key in {failure.subject for failure in failures}
    assert any("standard deviation" in failure.sentence() for failure in failures)


@pytest.mark.long
def test_a_parameter_that_the_model_lacks_fails() -> None:
    from ltsim.physics.effects import ORDINARY_CALIBRATION_EFFECTS

    without = misalignment_construction(
        effect for effect in ORDINARY_CALIBRATION_EFFECTS if effect.name != "azimuth-eccentricity"
    )
    failures = run_recovery("paper-workshop-re-aimed", 25, construction=without).failed_checks()
    assert "chi-square" in {failure.subject for failure in failures}


def test_understated_noise_fails() -> None:
    scenario = load_scenario("paper-workshop-re-aimed")
    noisy = scenario.model_copy(update={"instrument": scenario.instrument.model_copy(update={"noise_factor": 1.5})})
    result = recovery(*run_recovery_trials(noisy, 20, RecoverySettings(), seed=1))
    assert {"chi-square", "targets"} <= {failure.subject for failure in result.failed_checks()}


def test_errors_are_drawn_whatever_the_scenario_says() -> None:
    scenario = load_scenario("paper-workshop-re-aimed")
    fixed = scenario.model_copy(
        update={"instrument": scenario.instrument.model_copy(update={"errors": {"beam-tilt": 900.0}})}
    )
    assert scenario_with_errors_from_prior(fixed).instrument.draws_errors
    assert "beam-tilt" not in scenario_with_errors_from_prior(fixed).instrument.errors


def with_errors(name: str, **errors: float | bool) -> Scenario:
    scenario = load_scenario(name)
    settings = {key.replace("_", "-"): value for key, value in errors.items()}
    return scenario.model_copy(update={"instrument": scenario.instrument.model_copy(update={"errors": settings})})


def test_declared_errors_are_injected_as_declared_and_recovered() -> None:
    scenario = with_errors("paper-workshop-two-face", beam_tilt=30.0, transit_offset=-12.0, draw=True)
    result = lt.recover(scenario, trials=15, seed=4)
    assert result.error_origin == "stated"
    assert [c.sentence() for c in result.failed_checks()] == []
    assert lt.recover(scenario, trials=2, errors="drawn").error_origin == "drawn"
    _, truth = lt.simulate(scenario, seed=4)
    assert truth.instrument_values["beam-tilt"] == pytest.approx(30e-6)


def test_a_declared_error_far_off_its_prior_is_reported_not_to_be_recovered() -> None:
    """A range scale stated 20 prior sigmas large, which the gauge alone tells."""
    scenario = with_errors("paper-workshop-re-aimed", draw=True, range_scale=40.0)
    failures = lt.recover(scenario, trials=15, seed=4).failed_checks()
    assert "range-scale" in {failure.subject for failure in failures}
    assert any("coverage" in failure.statistic for failure in failures)


def test_a_scatter_smaller_than_declared_fails_with_declared_errors_too() -> None:
    """Readings half as noisy as stated: the errors less what the prior makes of them scatter too little."""
    scenario = with_errors("paper-workshop-two-face", beam_tilt=30.0, draw=False)
    quiet = scenario.model_copy(update={"instrument": scenario.instrument.model_copy(update={"noise_factor": 0.5})})
    low = [f for f in lt.recover(quiet, trials=20, seed=4).failed_checks() if f.value < f.lower_limit]
    assert {"chi-square", "targets", "stations"} <= {f.subject for f in low}
    assert any("standard deviation" in f.statistic for f in low)


@pytest.mark.parametrize("method", ["network", "distance"])
def test_declared_errors_of_a_tracker_among_several_are_recovered(method: str) -> None:
    errors = {"instruments.B.errors": {"draw": True, "beam-tilt": 30.0, "vertical-index": -25.0}}
    scenario = change_scenario(load_scenario("two-trackers"), errors, Path("hall.toml"))
    result = lt.recover(scenario, trials=10, seed=2, method=method)
    assert result.error_origin == "stated"
    assert [c.sentence() for c in result.failed_checks()] == []


def test_limits_do_not_widen_with_a_sample_that_fails() -> None:
    values = 1.0 + 0.3 * np.random.default_rng(0).standard_normal(40)
    right = unit_mean_check("targets", "mean", values, 1e-3)
    assert right.passed
    assert unit_mean_check("targets", "mean", 100 * values, 1e-3).upper_limit == pytest.approx(right.upper_limit)
    values[:4] = 500.0
    assert unit_mean_check("targets", "mean", values, 1e-3).upper_limit < right.upper_limit + 0.15


def test_tolerances_are_those_of_the_specification_for_many_trials() -> None:
    z = stats.norm.ppf((np.arange(100_000) + 0.5) / 100_000)
    mean, spread, coverage = parameter_checks("x", z, RECOVERY_FALSE_ALARM_RATE / 48)
    assert (mean.lower_limit, mean.upper_limit) == (-0.1, 0.1)
    assert (spread.lower_limit, spread.upper_limit) == pytest.approx((0.95, 1.05))
    assert (coverage.lower_limit, coverage.upper_limit) == pytest.approx((0.935, 0.965))
    assert mean.passed
    assert spread.passed
    assert coverage.passed
    for wrong in (z + 0.12, 1.06 * z, 0.9 * z):
        assert not all(check.passed for check in parameter_checks("x", wrong, RECOVERY_FALSE_ALARM_RATE / 48))


def test_chance_alone_fails_1_run_in_100() -> None:
    """Runs of a check on pure normal numbers: the share that fails, against its stated rate."""
    rng = np.random.default_rng(0)
    runs, count, size = 150, 30, 16
    failed = 0
    for _ in range(runs):
        level = RECOVERY_FALSE_ALARM_RATE / (3 * size + 3)
        z = rng.standard_normal((count, size))
        failed += any(not c.passed for k in range(size) for c in parameter_checks("x", z[:, k], level))
    assert failed <= stats.binom.ppf(0.999, runs, RECOVERY_FALSE_ALARM_RATE)


def test_a_trial_that_does_not_converge_fails() -> None:
    good = TrialScore(
        ("a",), ("urad",), np.zeros(1), np.ones(1), np.zeros(1), np.zeros(1), NetworkScore(1, 1, 10, 10, 10, 4.5)
    )
    failures = recovery(good, good, None).failed_checks()
    assert failures[0].sentence() == "convergence fails: trials without a result = 1 (required 0)"
    assert not unit_mean_check("x", "mean", np.array([2.0, 2.1]), 0.5).passed


def errors_of(trials: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors (N, d) of parameters, targets and poses on one geometry, their stated sigmas, and inner-datum ratios."""
    scenario = scenario_with_errors_from_prior(load_scenario("paper-workshop-re-aimed"))
    work = make_measurement_geometry(scenario, 5)
    errors, sigmas, inner = [], [], []
    for trial in range(trials):
        recording, truth = measure_trial(work, 5, trial)
        calibration = calibrate_network(recording, recommend_measurements=False)
        true = np.array([truth.instrument_values[name] for name in calibration.instrument_parameter_names])
        held = calibration.adjustment.state  # the first station stands where it was put; the truth is moved there
        turn = truth.station_rotations[0] @ held.station_rotations[0].T
        points = (truth.target_points - truth.station_positions[0]) @ turn + held.station_positions[0]
        place = (truth.station_positions[1:] - truth.station_positions[0]) @ turn + held.station_positions[0]
        stood = np.array([s.position for s in calibration.stations[1:]])
        errors.append(
            np.concatenate(
                [calibration.estimates[0] - true, (calibration.target_points - points).ravel(), (stood - place).ravel()]
            )
        )
        spread = np.sqrt(np.einsum("tii->ti", calibration.target_covariances))
        poses = np.array([s.sigma_position for s in calibration.stations[1:]])
        sigmas.append(np.concatenate([calibration.sigma[0], spread.ravel(), poses.ravel()]))
        predicted = np.einsum("tii->", calibration.adjustment.with_inner_datum().target_covariances) / len(points)
        inner.append(target_error(calibration.target_points, points) ** 2 / predicted)
    return np.array(errors), np.array(sigmas), np.array(inner)


@pytest.mark.long
def test_predicted_covariance_is_the_spread_of_repeated_calibrations() -> None:
    trials = 500
    errors, sigmas, inner = errors_of(trials)
    z = errors / sigmas
    level = 0.001 / z.shape[1]
    low, high = np.sqrt(stats.chi2.ppf([level / 2, 1 - level / 2], trials) / trials)
    spread = np.sqrt(np.mean(z**2, axis=0))
    assert np.all((low < spread) & (spread < high)), (spread.min(), spread.max(), low, high)
    assert inner.mean() == pytest.approx(1.0, abs=4 * inner.std() / np.sqrt(trials))
