"""An adjustment that is only planned, and problems that share their structure."""

from dataclasses import replace

import numpy as np
import pytest

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.problem import NetworkProblem
from ltsim.core.errors import NetworkError
from ltsim.physics.model.construction import misalignment_construction
from ltsim.physics.model.measurement import MeasurementModel
from ltsim.solve.gauss_newton import TerminationStatus
from tests.campaigns.workshop import workshop


def test_a_planned_adjustment_has_the_precision_of_the_solved_adjustment() -> None:
    recording, state = workshop(faces=2)
    planned, solved = (
        Adjustment.from_plan(recording, state, misalignment_construction()),
        adjust(recording, misalignment_construction()),
    )
    assert planned.solution.status is TerminationStatus.PLANNED
    assert planned.solution.has_converged
    for name in ("first_instrument_covariance", "pose_covariance", "target_covariances", "redundancy"):
        ours, theirs = getattr(planned, name), getattr(solved, name)
        assert ours == pytest.approx(theirs, rel=1e-6, abs=1e-9 * np.abs(theirs).max())


def test_a_plan_that_leaves_a_station_open_is_refused_with_its_name() -> None:
    recording, state = workshop()
    readings = recording.readings.copy()
    readings[(recording.station == 3) & (recording.target > 1)] = np.nan
    with pytest.raises(NetworkError, match="station S4 measures fewer than three targets that are not on one line"):
        Adjustment.from_plan(recording.with_readings(readings), state)


def test_a_problem_at_another_state_equals_a_newly_made_problem() -> None:
    recording, state = workshop(faces=2)
    there = state.with_increments(np.full((5, 6), 0.01), np.full((28, 3), 0.02), np.zeros((1, 16)), np.zeros(0))
    order = np.random.default_rng(0).permutation(len(recording))
    rows = {name: getattr(recording, name)[order] for name in ("station", "target", "face", "repeat", "time")}
    moved = recording.replace(**rows, readings=recording.readings[order])
    model = MeasurementModel(moved, misalignment_construction())
    ours = (
        NetworkProblem.from_model(MeasurementModel(recording, misalignment_construction()))
        .with_positions_of_model(model)
        .linearise(there)
    )
    alone = NetworkProblem.from_model(model).linearise(there)
    np.testing.assert_array_equal(ours.design, alone.design)
    np.testing.assert_array_equal(ours.whitened_residuals, alone.whitened_residuals)


def test_other_readings_in_use_are_counted_anew() -> None:
    recording, _ = workshop()
    problem = NetworkProblem.from_model(MeasurementModel(recording, misalignment_construction()))
    use = problem.is_used_reading.copy()
    use[recording.target == 5] = False
    use[recording.station == 2, 1] = False
    fewer = replace(problem, is_used_reading=use)
    assert np.flatnonzero(fewer.undetermined_unknowns.is_unmeasured_target).tolist() == [5]
    assert fewer.undetermined_unknowns.yaw_undetermined_stations.tolist() == [2]
    assert fewer.undetermined_unknowns.n_fixing_equations == len(fewer.undetermined_unknowns.fixed_columns) == 4
    assert fewer.unknowns is problem.unknowns
    assert problem.dof - fewer.dof == (~use).sum() - 4
