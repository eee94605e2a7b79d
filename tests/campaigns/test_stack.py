"""Trials with geometries of their own side by side are the same as each of them alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ltsim.campaigns.calibrators import StackCalibrator, stacks
from ltsim.campaigns.engine import BatchCalibrator, Calibrated
from ltsim.campaigns.judge import TrialEvaluator
from ltsim.campaigns.spec import Method
from ltsim.campaigns.truth import CellTruth, truth_of
from ltsim.physics.model.construction import misalignment_construction
from ltsim.simulation.scenario import change_scenario, load_scenario

TRIALS = 5


def drawn(name: str) -> dict[int, CellTruth]:
    """Truths whose pointings come in different orders."""
    scenario = change_scenario(load_scenario(name), {"work.order": "by-station-random"}, Path(name))
    common = truth_of(scenario, 8, "campaign")
    return {k: truth_of(scenario, 8, "campaign", k, like=common) for k in range(TRIALS)}


@pytest.mark.parametrize("name", ["paper-workshop", "paper-workshop-two-face"])
def test_side_by_side_is_as_alone(name: str) -> None:
    truths = drawn(name)
    ((stack, numbers),) = stacks(truths)
    block = stack.draw_trials(8, numbers)
    calibrator = StackCalibrator.of(Method(), stack)
    found, together = calibrator.calibrate(block, np.arange(TRIALS)), TrialEvaluator(stack)
    columns = together.after(block, found, misalignment_construction())
    assert np.all(found.status == 0)
    assert len(np.unique(stack.rows, axis=1).T) == TRIALS
    for k, truth in truths.items():
        own, engine, judge = (
            truth.draw(8, k, 1),
            BatchCalibrator(truth, misalignment_construction()),
            TrialEvaluator(truth),
        )
        assert np.abs(own.deviation - block.alone[k].deviation).max() < 1e-12
        theirs = engine.calibrate(own)
        assert found.sigma[:, :, k] == pytest.approx(theirs.sigma, rel=1e-9)
        assert np.abs(found.values[:, :, k] - theirs.values[:, :, 0]).max() < 1e-4 * theirs.sigma.min()
        expected = judge.after(own, theirs, misalignment_construction())
        for column, value in expected.items():
            assert columns[column][k] == pytest.approx(value[0], rel=1e-5), column
    assert calibrator.difference(block, 2, found) < 1e-3


def test_trial_that_the_batch_gives_up_is_done_alone() -> None:
    """A pointing that is centimetres off is the full solver's business: it leaves it out."""
    truths = drawn("paper-workshop")
    ((stack, numbers),) = stacks(truths)
    block = stack.draw_trials(8, numbers)
    block.alone[3].deviation[11, 0] += 0.02
    block.deviation[stack.rows[:, 3] == 11, 0, 3] += 0.02
    calibrator = StackCalibrator.of(Method(), stack)
    found: Calibrated = calibrator.calibrate(block, np.arange(TRIALS))
    assert found.status.tolist() == [0, 0, 0, 1, 0]
    assert np.abs(found.values[:, :, 3] / found.sigma[:, :, 3]).max() < 1e3
