"""Network adjustment: exactness, start values, derivatives, statistics."""

import numpy as np
import pytest
from scipy import stats

from ltsim.adjustment import adjust
from ltsim.adjustment.problem import NetworkProblem
from ltsim.core.errors import ConvergenceError, NetworkError
from ltsim.core.randomness import random_stream
from ltsim.physics.model.construction import dh_construction, ideal_construction, misalignment_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState
from ltsim.recordings.setup import Station
from tests.networks import drawn, network


def in_first_frame(state: NetworkState) -> np.ndarray:
    """Targets seen from the first station."""
    return (state.target_points - state.station_positions[0]) @ state.station_rotations[0]


@pytest.mark.parametrize("faces", [1, 2])
def test_exact_readings_give_back_the_network(faces):
    recording, truth = network(faces=faces)
    adjustment = adjust(recording, ideal_construction())
    assert adjustment.solution.has_converged
    np.testing.assert_allclose(adjustment.state.target_points, in_first_frame(truth.state), atol=2e-9)
    assert adjustment.chi2 < 1e-6


@pytest.mark.parametrize("construction", [misalignment_construction(), dh_construction()], ids=["misalignment", "dh"])
def test_the_design_is_the_derivative_of_the_residuals(construction):
    recording, truth = network(faces=2, values=drawn(construction, 3), construction=construction)
    problem = NetworkProblem.from_model(MeasurementModel(recording, construction))
    design = problem.linearise(truth.state).design
    rng = random_stream(0, "directions")
    scale = 1e-6
    rows = int(problem.is_used_reading.sum()) + len(problem.gauge_rows) + int(np.isfinite(problem.prior.sigma).sum())
    for _ in range(12):
        step = scale * rng.standard_normal(problem.unknowns.n_columns)
        ahead = problem.linearise(problem.retract(truth.state, step)).whitened_residuals
        behind = problem.linearise(problem.retract(truth.state, -step)).whitened_residuals
        change = -(ahead - behind)[:rows] / 2
        linear = (design @ step)[:rows]
        # The design leaves out derivatives of the error functions themselves: a relative 1e-4.
        np.testing.assert_allclose(change, linear, atol=3e-4 * np.abs(linear).max())


def test_no_start_values_are_needed_with_stations_upside_down():
    recording, truth = network()
    flipped = truth.state.station_rotations.copy()
    flipped[2] = flipped[2] @ np.diag([1.0, -1.0, -1.0])
    state = NetworkState(
        truth.state.station_positions, flipped, truth.state.target_points, truth.state.instrument_parameters
    )
    recording = recording.with_readings(MeasurementModel(recording, misalignment_construction()).predict(state))
    np.testing.assert_allclose(adjust(recording).state.target_points, in_first_frame(state), atol=2e-9)


def test_chi2_has_its_distribution_and_redundancies_sum_to_the_degrees_of_freedom():
    values = []
    for seed in range(40):
        recording, _ = network(values=drawn(misalignment_construction(), seed), seed=seed)
        adjustment = adjust(recording, misalignment_construction())
        values.append(adjustment.p_value)
        if seed == 0:
            leverage = adjustment.factorised_normals.leverage()
            # Datum rows take one each of the six free motions.
            assert np.sum(1 - leverage) == pytest.approx(adjustment.dof, abs=1e-6)
    assert stats.kstest(values, "uniform").pvalue > 0.001


def test_an_outlier_is_detected_with_its_size():
    recording, _ = network(seed=5)
    readings = recording.readings.copy()
    readings[33, 0] += 2e-4
    adjustment = adjust(recording.with_readings(readings), misalignment_construction())
    first = adjustment.flagged_readings()[0]
    assert (first.pointing_index, first.observable_column) == (33, 0)
    assert first.estimated_error == pytest.approx(2e-4, abs=3e-5)
    assert not adjust(recording, misalignment_construction()).flagged_readings()


def test_swapped_reflectors_are_screened_and_the_rest_adjusts():
    recording, truth = network(seed=5)
    target = recording.target.copy()
    rows = [int(np.flatnonzero((recording.station == 3) & (recording.target == t))[0]) for t in (2, 17)]
    target[rows] = target[rows[::-1]]
    adjustment = adjust(recording.replace(target=target), misalignment_construction())
    assert adjustment.solution.has_converged
    assert set(np.flatnonzero(adjustment.is_gross_pointing)) == set(rows)
    assert np.abs(adjustment.state.target_points - in_first_frame(truth.state)).max() < 1e-4


def test_only_the_wrong_pointing_of_three_is_screened():
    """Its target starts half way to it: only as the network relaxes it shows which of the three is wrong."""
    recording, truth = network(seed=5)
    keep = (recording.target != 7) | np.isin(recording.station, [1, 2])
    recording = recording.select(keep)
    at = recording.targets.index("T08")
    first = int(np.flatnonzero((recording.station == 1) & (recording.target == at))[0])
    twice = recording.select(np.append(np.arange(len(recording)), first))
    readings = twice.readings.copy()
    readings[-1] += [1.5, 0.6, 0.1]
    adjustment = adjust(twice.with_readings(readings), misalignment_construction())
    assert np.flatnonzero(adjustment.is_gross_pointing).tolist() == [len(twice) - 1]
    assert np.abs(adjustment.state.target_points - in_first_frame(truth.state)).max() < 1e-3


def test_the_datum_does_not_change_what_is_measured():
    """Adjusted readings are the same in a frame set by levels and control points as in the first station's."""
    recording, truth = network(seed=2)
    free = adjust(recording, misalignment_construction())
    levelled = recording.setup.model_copy(
        update={"stations": {"S1": Station(levelled=True, levelling_sigma_arcsec=1.0)}}
    )
    other = adjust(recording.replace(setup=levelled), misalignment_construction())
    np.testing.assert_allclose(other.residuals, free.residuals, atol=1e-11)
    assert other.dof == free.dof
    targets = dict(recording.setup.targets)
    for i in (0, 5, 20):
        point = tuple(1e3 * truth.state.target_points[i])
        targets[recording.targets[i]] = targets[recording.targets[i]].model_copy(
            update={"known_mm": point, "known_sigma_mm": 1.0}
        )
    control = adjust(
        recording.replace(setup=recording.setup.model_copy(update={"targets": targets})), misalignment_construction()
    )
    assert control.solution.has_converged
    assert np.abs(control.state.target_points - truth.state.target_points).max() < 2e-3
    assert control.dof == free.dof + 3


def test_predicted_covariance_is_the_spread_of_repeated_adjustments():
    """mrcal's test: targets, poses and parameters together, by normalised squared errors."""
    construction = misalignment_construction()
    squares = {"targets": [], "poses": [], "parameters": []}
    for seed in range(60):
        values = drawn(construction, seed)
        recording, truth = network(values=values, seed=seed)
        adjustment = adjust(recording, construction)
        off = adjustment.state.target_points - in_first_frame(truth.state)
        squares["targets"].append(
            np.mean([d @ np.linalg.solve(c, d) for d, c in zip(off, adjustment.target_covariances, strict=True)]) / 3
        )
        moved = (truth.state.station_positions[1:] - truth.state.station_positions[0]) @ truth.state.station_rotations[
            0
        ]
        gap = adjustment.state.station_positions[1:] - moved
        squares["poses"].append(
            np.mean(
                [g @ np.linalg.solve(c[:3, :3], g) for g, c in zip(gap, adjustment.pose_covariance[1:], strict=True)]
            )
            / 3
        )
        error = adjustment.state.instrument_parameters[0] - values
        squares["parameters"].append(error @ np.linalg.solve(adjustment.first_instrument_covariance, error) / 16)
    for kind, normalised in squares.items():
        spread = np.std(normalised) / np.sqrt(len(normalised))
        assert np.mean(normalised) == pytest.approx(1.0, abs=4 * spread), kind


def test_a_station_with_two_common_targets_is_named():
    recording, _ = network()
    keep = (recording.station != 4) | (recording.target < 2)
    with pytest.raises(NetworkError, match=r"S5 shares only 2 targets .*: its rotation about the line through"):
        adjust(recording.select(keep))


def test_failure_is_a_status_until_somebody_asks():
    recording, _ = network(seed=1)
    adjustment = adjust(recording, misalignment_construction())
    broken = adjustment.solution.__class__(
        adjustment.state,
        1.0,
        3,
        type(adjustment.solution.status).MAX_ITERATIONS_REACHED,
        None,
        adjustment.solution.system,
    )
    with pytest.raises(ConvergenceError, match="limit of iterations"):
        broken.require_success()
