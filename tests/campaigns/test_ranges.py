"""Trials of ranges alone: the batch against the full solver, predicted against achieved, and the planner's figure."""

from __future__ import annotations

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment.evaluation.clouds import align_to_points
from ltsim.campaigns.calibrators import StackCalibrator, calibrator_of, stacks
from ltsim.campaigns.engine import BatchCalibrator
from ltsim.campaigns.judge import TrialEvaluator
from ltsim.campaigns.spec import Method
from ltsim.campaigns.truth import CellTruth, truth_of
from ltsim.core.errors import NetworkError, SetupError
from ltsim.planning.fast import LayoutScorer
from ltsim.planning.information import LayoutInformation
from ltsim.planning.workshop import survey_of
from ltsim.simulation.physics import planned_construction

SCENE = lt.scenario(
    "paper-workshop-re-aimed", {"instrument.observables": ["distance"], "instrument.errors": {"draw": True}}
)


@pytest.fixture(scope="module")
def truth() -> CellTruth:
    return truth_of(SCENE, 4, "campaign")


def test_the_batch_is_the_full_solver_and_scatters_as_predicted(truth: CellTruth) -> None:
    engine, block = BatchCalibrator(truth, truth.construction), truth.draw(4, 0)
    found = engine.calibrate(block)
    assert (found.status == 0).mean() > 0.95
    assert np.isnan(truth.readings(block, 0)[:, 1:]).all()
    # Rough places say which way is up, to a degree: it shows in what the elevation has to do with a range.
    assert max(engine.difference(block, k, found) for k in (0, 100)) < 0.02
    z = ((found.values - block.values) / found.sigma[:, :, None])[0]
    np.testing.assert_allclose(z.std(axis=1), 1.0, atol=0.16)
    dof = engine.network.problem.dof
    assert abs(found.chi2.mean() - dof) < 5 * np.sqrt(2 * dof / found.chi2.size)
    points = truth.state.target_points
    moved = np.stack([align_to_points(points + gap, points) - points for gap in np.moveaxis(found.points, 2, 0)])
    assert np.sqrt(np.mean((moved / engine.sigma_targets) ** 2)) == pytest.approx(1.0, abs=0.06)
    columns = TrialEvaluator(truth).before(block)
    assert np.isnan(columns["error_raw_um"]).all()  # no station tells a point by itself


def test_a_plan_of_ranges_predicts_what_trials_achieve(truth: CellTruth) -> None:
    """The planner's point error, at the places of the trials, against the spread of 256 of them."""
    survey, built = survey_of(SCENE), planned_construction(SCENE)
    assert [p.name for p in built.parameters] == ["range-offset", "range-scale", "transit-offset"]
    at = truth.sightings
    order = [at.target_names.index(name) for name in survey.target_names]
    there = survey.replace(position=at.position, points=at.points[order])
    reducer, slots = LayoutScorer(there, built), np.arange(len(there.position))
    fast = reducer.reduce(reducer.blocks(there.position, there.yaw, slots, there.visible), slots[None], targets=True)
    slow = LayoutInformation.of(there, built)
    assert fast.target_rms[0] == pytest.approx(slow.target_rms, rel=1e-6)
    known = np.sqrt(np.diag(np.linalg.inv(fast.information[0]))) * slow.prior_sigma
    np.testing.assert_allclose(known, slow.instrument_sigma, rtol=1e-6)
    found = BatchCalibrator(truth, built).calibrate(truth.draw(5, 0))
    points = truth.state.target_points
    errors = [align_to_points(points + gap, points) - points for gap in np.moveaxis(found.points, 2, 0)]
    achieved = np.sqrt(np.mean(np.sum(np.square(errors), axis=2)))
    assert achieved / slow.target_rms == pytest.approx(1.0, abs=0.07)


def test_ranges_from_two_stations_place_nothing(truth: CellTruth) -> None:
    survey = survey_of(SCENE)
    seen = survey.visible.copy()
    seen[2:, 0] = False
    lost = survey.replace(visible=seen)
    reducer, slots = LayoutScorer(lost), np.arange(len(seen))
    out = reducer.reduce(reducer.blocks(lost.position, lost.yaw, slots, seen), slots[None], targets=True)
    assert not np.isfinite(out.information).any()
    with pytest.raises(NetworkError, match="do not determine target T01"):
        LayoutInformation.of(lost)


def test_a_distance_calibrator_and_a_mixture_of_trackers_are_refused(truth: CellTruth) -> None:
    with pytest.raises(SetupError, match="compares points"):
        calibrator_of(Method(method="distance"), truth)
    mixed = lt.scenario("two-trackers")
    trackers = dict(mixed.instruments)
    first = next(iter(trackers))
    trackers[first] = trackers[first].model_copy(update={"observables": ("distance",)})
    with pytest.raises(SetupError, match="observables differ"):
        truth_of(mixed.model_copy(update={"instruments": trackers}), 1)


def test_each_trial_may_have_its_own_places(truth: CellTruth) -> None:
    own = {k: truth_of(SCENE, 4, "campaign", k, like=truth) for k in range(6)}
    ((stack, numbers),) = stacks(own)
    block = stack.draw_trials(4, numbers)
    calibrator = StackCalibrator.of(Method(method="network"), stack)
    assert isinstance(calibrator.alone(0), BatchCalibrator)
    found = calibrator.calibrate(block, np.arange(6))
    assert (found.status == 0).all()
    assert calibrator.difference(block, 2, found) < 0.02
