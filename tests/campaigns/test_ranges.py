"""Trials of ranges alone: the batch against the full solver, predicted against achieved, and the planner's figure."""

from __future__ import annotations

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment.evaluation.clouds import align_to_points
from ltsim.campaigns.calibrators import StackCalibrator, make_calibrator, stack_geometries
from ltsim.campaigns.spec import CalibrationMethod
from ltsim.campaigns.trial_calibrators import BatchCalibrator
from ltsim.campaigns.trial_evaluation import TrialEvaluator
from ltsim.campaigns.true_network import TrueNetwork, make_true_network
from ltsim.core.errors import InputError, NetworkError
from ltsim.planning.expected_precision import ExpectedPrecision
from ltsim.planning.layout_scorer import LayoutScorer
from ltsim.planning.search_inputs import planned_survey
from ltsim.simulation.physics import planned_construction

SCENE = lt.scenario(
    "paper-workshop-re-aimed", {"instrument.observables": ["distance"], "instrument.errors": {"draw": True}}
)


@pytest.fixture(scope="module")
def truth() -> TrueNetwork:
    return make_true_network(SCENE, 4, "campaign")


def test_the_batch_is_the_full_solver_and_scatters_as_predicted(truth: TrueNetwork) -> None:
    engine, block = BatchCalibrator(truth, truth.construction), truth.draw_batch(4, 0)
    calibrated = engine.calibrate(block)
    assert (calibrated.status_indices == 0).mean() > 0.95
    assert np.isnan(truth.trial_readings(block, 0)[:, 1:]).all()
    # Rough places say which way is up, to a degree: it shows in what the elevation has to do with a range.
    assert max(engine.largest_solver_difference(block, k, calibrated) for k in (0, 100)) < 0.02
    z = ((calibrated.instrument_values - block.instrument_values) / calibrated.instrument_sigmas[:, :, None])[0]
    np.testing.assert_allclose(z.std(axis=1), 1.0, atol=0.16)
    dof = engine.batch_network.problem.dof
    assert abs(calibrated.chi2.mean() - dof) < 5 * np.sqrt(2 * dof / calibrated.chi2.size)
    points = truth.state.target_points
    moved = np.stack(
        [align_to_points(points + gap, points) - points for gap in np.moveaxis(calibrated.target_errors, 2, 0)]
    )
    assert np.sqrt(np.mean((moved / engine.target_sigmas) ** 2)) == pytest.approx(1.0, abs=0.06)
    columns = TrialEvaluator(truth).method_independent_columns(block)
    assert np.isnan(columns["error_raw_um"]).all()  # no station tells a point by itself


def test_a_plan_of_ranges_predicts_what_trials_achieve(truth: TrueNetwork) -> None:
    """The planner's point error, at the places of the trials, against the spread of 256 of them."""
    survey, built = planned_survey(SCENE), planned_construction(SCENE)
    assert [p.name for p in built.parameters] == ["range-offset", "range-scale", "transit-offset"]
    at = truth.sightings
    order = [at.target_names.index(name) for name in survey.target_names]
    there = survey.replace(station_positions=at.station_positions, target_points=at.target_points[order])
    reducer, slots = LayoutScorer(there, built), np.arange(len(there.station_positions))
    fast = reducer.evaluate_layouts(
        reducer.normal_blocks(there.station_positions, there.station_yaws, slots, there.is_visible),
        slots[None],
        with_target_errors=True,
    )
    slow = ExpectedPrecision.from_survey(there, built)
    assert fast.weighted_target_rms[0] == pytest.approx(slow.target_rms, rel=1e-6)
    sigmas = np.sqrt(np.diag(np.linalg.inv(fast.information_matrices[0]))) * slow.prior_sigma
    np.testing.assert_allclose(sigmas, slow.instrument_sigmas, rtol=1e-6)
    calibrated = BatchCalibrator(truth, built).calibrate(truth.draw_batch(5, 0))
    points = truth.state.target_points
    errors = [align_to_points(points + gap, points) - points for gap in np.moveaxis(calibrated.target_errors, 2, 0)]
    achieved = np.sqrt(np.mean(np.sum(np.square(errors), axis=2)))
    assert achieved / slow.target_rms == pytest.approx(1.0, abs=0.07)


def test_ranges_from_two_stations_place_nothing(truth: TrueNetwork) -> None:
    survey = planned_survey(SCENE)
    is_visible = survey.is_visible.copy()
    is_visible[2:, 0] = False
    lost = survey.replace(is_visible=is_visible)
    reducer, slots = LayoutScorer(lost), np.arange(len(is_visible))
    out = reducer.evaluate_layouts(
        reducer.normal_blocks(lost.station_positions, lost.station_yaws, slots, is_visible),
        slots[None],
        with_target_errors=True,
    )
    assert not np.isfinite(out.information_matrices).any()
    with pytest.raises(NetworkError, match="do not determine target T01"):
        ExpectedPrecision.from_survey(lost)


def test_a_distance_calibrator_and_a_mixture_of_trackers_are_refused(truth: TrueNetwork) -> None:
    with pytest.raises(InputError, match="needs ranges and angles"):
        make_calibrator(CalibrationMethod(method="distance"), truth)
    mixed = lt.scenario("two-trackers")
    trackers = dict(mixed.instruments)
    first = next(iter(trackers))
    trackers[first] = trackers[first].model_copy(update={"observables": ("distance",)})
    with pytest.raises(InputError, match="observables differ"):
        make_true_network(mixed.model_copy(update={"instruments": trackers}), 1)


def test_each_trial_may_have_separate_positions(truth: TrueNetwork) -> None:
    networks = {k: make_true_network(SCENE, 4, "campaign", k, reference_network=truth) for k in range(6)}
    ((stack, numbers),) = stack_geometries(networks)
    block = stack.draw_numbered_trials(4, numbers)
    calibrator = StackCalibrator.for_stack(CalibrationMethod(method="network"), stack)
    assert isinstance(calibrator.single_trial_calibrator(0), BatchCalibrator)
    calibrated = calibrator.calibrate(block, np.arange(6))
    assert (calibrated.status_indices == 0).all()
    assert calibrator.largest_solver_difference(block, 2, calibrated) < 0.02
