"""Trials with geometries of their own side by side are the same as each of them alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ltsim.campaigns.calibrators import StackCalibrator, stack_geometries
from ltsim.campaigns.spec import CalibrationMethod
from ltsim.campaigns.trial_calibrators import BatchCalibrator, CalibratedBatch
from ltsim.campaigns.trial_evaluation import TrialEvaluator
from ltsim.campaigns.true_network import TrueNetwork, make_true_network
from ltsim.physics.model.construction import misalignment_construction
from ltsim.simulation.scenario import change_scenario, load_scenario

TRIALS = 5


def drawn(name: str) -> dict[int, TrueNetwork]:
    """Truths whose pointings come in different orders."""
    scenario = change_scenario(load_scenario(name), {"work.order": "by-station-random"}, Path(name))
    common = make_true_network(scenario, 8, "campaign")
    return {k: make_true_network(scenario, 8, "campaign", k, reference_network=common) for k in range(TRIALS)}


@pytest.mark.parametrize("name", ["paper-workshop", "paper-workshop-two-face"])
def test_side_by_side_is_as_alone(name: str) -> None:
    truths = drawn(name)
    ((stack, numbers),) = stack_geometries(truths)
    block = stack.draw_numbered_trials(8, numbers)
    calibrator = StackCalibrator.for_stack(CalibrationMethod(), stack)
    calibrated, together = calibrator.calibrate(block, np.arange(TRIALS)), TrialEvaluator(stack)
    columns = together.method_columns(block, calibrated, misalignment_construction())
    assert np.all(calibrated.status_indices == 0)
    assert len(np.unique(stack.recording_row_of_pointing, axis=1).T) == TRIALS
    for k, truth in truths.items():
        single, engine, judge = (
            truth.draw_batch(8, k, 1),
            BatchCalibrator(truth, misalignment_construction()),
            TrialEvaluator(truth),
        )
        assert np.abs(single.reading_deviations - block.single_trial_batches[k].reading_deviations).max() < 1e-12
        theirs = engine.calibrate(single)
        assert calibrated.instrument_sigmas[:, :, k] == pytest.approx(theirs.instrument_sigmas, rel=1e-9)
        assert (
            np.abs(calibrated.instrument_values[:, :, k] - theirs.instrument_values[:, :, 0]).max()
            < 1e-4 * theirs.instrument_sigmas.min()
        )
        expected = judge.method_columns(single, theirs, misalignment_construction())
        for column, value in expected.items():
            assert columns[column][k] == pytest.approx(value[0], rel=1e-5), column
    assert calibrator.largest_solver_difference(block, 2, calibrated) < 1e-3


def test_trial_that_the_batch_gives_up_is_done_alone() -> None:
    """A pointing that is centimetres off is the full solver's business: it leaves it out."""
    truths = drawn("paper-workshop")
    ((stack, numbers),) = stack_geometries(truths)
    block = stack.draw_numbered_trials(8, numbers)
    block.single_trial_batches[3].reading_deviations[11, 0] += 0.02
    block.reading_deviations[stack.recording_row_of_pointing[:, 3] == 11, 0, 3] += 0.02
    calibrator = StackCalibrator.for_stack(CalibrationMethod(), stack)
    calibrated: CalibratedBatch = calibrator.calibrate(block, np.arange(TRIALS))
    assert calibrated.status_indices.tolist() == [0, 0, 0, 1, 0]
    assert np.abs(calibrated.instrument_values[:, :, 3] / calibrated.instrument_sigmas[:, :, 3]).max() < 1e3
