"""Data snooping: removal of duplicate rows, undetermined targets, gross errors before and outliers in the adjustment.

Rejected readings are tested again after each solution, and are used again if they agree with it.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ltsim.adjustment.problem import NetworkProblem
from ltsim.adjustment.reliability import (
    critical_normalised_residual,
    noise_factor_from_residuals,
    normalise_residuals,
    redundancy_numbers,
)
from ltsim.adjustment.significance import (
    MAX_TRACKER_ERROR,
    MIN_FAULTY_FRACTION_OF_GROUP,
    MIN_GROSS_ERROR_SIGMAS,
    MIN_RANGE_OF_PROPORTIONAL_ERROR_LIMIT,
)
from ltsim.adjustment.start import initial_network
from ltsim.adjustment.stochastic_model import iterate_reweighted
from ltsim.adjustment.structure import raise_for_singular_network
from ltsim.core.arrays import Bools, Floats
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE
from ltsim.geometry.polar import wrap_angle
from ltsim.geometry.rigid import determines_pose
from ltsim.physics.model.construction import ideal_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState, Prediction
from ltsim.recordings.recording import Recording
from ltsim.solve.design import POINT_RANK_TOLERANCE, robust_sigma, scale_to_unit_diagonal, to_dense
from ltsim.solve.elimination import FactorisedNormals, SingularSystemError
from ltsim.solve.gauss_newton import MAX_CONVERGENCE_RATIO, MAX_ITERATIONS, Solution, solve

MIN_COPIED_ROWS = 10
"""Smallest number of equal rows that count as copies in a recording without times. All repeated pointings must then be
copies of each other, because two pointings may be equal by chance."""
MAX_REWEIGHTINGS_BEFORE_SNOOPING = 8
"""Largest number of iterations of reweighted least squares before data snooping."""
MAX_SNOOPING_PASSES = 20
"""Largest number of solutions in data snooping until the set of rejected readings is stable. Readings that still
alternate between rejected and used remain rejected."""
MAX_STEPS_PER_SNOOPING_PASS = 10
"""Largest number of Gauss-Newton steps of each solution in data snooping; the last solution has no such limit."""
MAX_SIGMA_OF_PREDICTED_READING = 100.0
"""Standard deviation of a prediction of a rejected reading by the used readings, in standard deviations of the reading.
Above it the used readings hardly determine the target or set-up, and all readings of this target or set-up are
rejected."""


def without_copied_rows(recording: Recording) -> tuple[Recording, int]:
    """Recording without the readings of rows that are exact copies of earlier rows, and the number of these rows."""
    is_copied = _is_copied_row(recording)
    if not is_copied.any():
        return recording, 0
    return recording.with_readings(np.where(is_copied[:, None], np.nan, recording.readings)), int(is_copied.sum())


def _is_copied_row(recording: Recording) -> Bools:
    """Flags (n,) of n rows, True for exact copies of an earlier row with equal time, set-up, target and face.

    Without times, two pointings may be equal by chance; rows are then copies only if all repeated pointings are equal.
    """
    sorted_readings = np.sort(recording.readings, axis=None)
    if not np.any(sorted_readings[1:] == sorted_readings[:-1]):
        return np.zeros(len(recording), dtype=bool)
    place = np.stack([recording.station, recording.target, recording.face], axis=1)
    clock = recording.time[:, None] if recording.has_clock else np.zeros((len(recording), 0))
    comparable_rows = np.concatenate([place, clock, np.nan_to_num(recording.readings, nan=np.inf)], axis=1)
    is_repeated = _equals_earlier_row(np.concatenate([place, clock], axis=1))
    is_copied = _equals_earlier_row(comparable_rows) & recording.is_measured.any(axis=1)
    if recording.has_clock:
        return is_copied
    return is_copied & (is_copied.sum() >= max(MIN_COPIED_ROWS, int(is_repeated.sum())))


def _equals_earlier_row(array_rows: np.ndarray) -> Bools:
    """Flags (n,), True for those of the n rows of an array that equal an earlier row."""
    is_later = np.ones(len(array_rows), dtype=bool)
    is_later[np.unique(array_rows, axis=0, return_index=True)[1]] = False
    return is_later


# --- undetermined targets and poses -------------------------------------------------------------------------------


def drop_undetermined_targets(problem: NetworkProblem, state: NetworkState) -> NetworkProblem:
    """Problem without the readings and known differences of undetermined targets.

    Reference lengths to these targets get no weight.
    """
    while True:
        loose = is_undetermined_target(problem, state)
        gauge = problem.gauge_rows
        reached = problem.undetermined_unknowns.is_unmeasured_target | loose
        idle = (reached[gauge.first_targets] | reached[gauge.second_targets]) & np.isfinite(gauge.total_sigmas)
        use = problem.is_used_reading & ~loose[problem.model.recording.target][:, None]
        differences = problem.difference_rows.subset(~problem.is_undetermined_difference(reached))
        if (
            np.array_equal(use, problem.is_used_reading)
            and not idle.any()
            and len(differences) == len(problem.difference_rows)
        ):
            return problem
        problem = replace(
            problem,
            gauge_rows=replace(gauge, is_unweighted=gauge.is_unweighted | idle),
            is_used_reading=use,
            difference_rows=differences,
        )


def is_undetermined_target(problem: NetworkProblem, state: NetworkState) -> Bools:
    """Flags (T,), True for those of T targets that would be undetermined even if all stations were known."""
    recording, count = problem.model.recording, len(problem.model.recording.targets)
    n_complete = np.bincount(recording.target, problem.is_used_reading.all(axis=1), count) > 0
    is_doubtful = ~n_complete & ~problem.undetermined_unknowns.is_unmeasured_target
    is_doubtful[problem.marks.target_indices[problem.marks.target_indices >= 0]] = False
    if not is_doubtful.any():
        return is_doubtful
    weights = np.where(problem.is_used_reading, 1.0 / problem.reading_sigmas, 0.0)[:, :, None]
    whitened_rows = np.where(
        problem.is_used_reading[:, :, None], problem.model.linearise(state).target_derivatives * weights, 0.0
    )
    normal = np.zeros((count, 3, 3))
    np.add.at(normal, recording.target, np.swapaxes(whitened_rows, 1, 2) @ whitened_rows)
    gauge, control = problem.gauge_rows, problem.control_rows
    along = gauge.line_directions(state.target_points) / gauge.total_sigmas[:, None]
    for end in (gauge.first_targets, gauge.second_targets):
        np.add.at(normal, end, along[:, :, None] * along[:, None, :])
    np.add.at(normal, control.point_indices, np.swapaxes(control.whitening_matrices, 1, 2) @ control.whitening_matrices)
    for end in problem.difference_rows.start_and_end_indices:
        rows_at_end = problem.difference_rows.subset(end < count)
        np.add.at(
            normal, end[end < count], np.swapaxes(rows_at_end.whitening_matrices, 1, 2) @ rows_at_end.whitening_matrices
        )
    normal[problem.undetermined_unknowns.is_height_undetermined_target, 2, 2] += np.trace(
        normal[problem.undetermined_unknowns.is_height_undetermined_target], axis1=1, axis2=2
    )
    # Scaled to unit diagonal: a coordinate determined to 1 um does not hide another that is determined to 1 m.
    scaled, _ = scale_to_unit_diagonal(normal, np.diagonal(normal, axis1=1, axis2=2))
    return is_doubtful & (np.linalg.eigvalsh(scaled)[:, 0] <= POINT_RANK_TOLERANCE)


def pose_defect_sentence(problem: NetworkProblem, state: NetworkState) -> str:
    """Sentence on a station that measured too few targets for its pose; empty if there is no such station.

    Set-ups over marks and stations without readings are not considered.
    """
    recording, marks = problem.model.recording, problem.marks
    is_sighted = np.zeros((len(recording.stations), len(recording.targets)), dtype=bool)
    is_used = problem.is_used_reading.any(axis=1)
    is_sighted[recording.station[is_used], recording.target[is_used]] = True
    vertical = np.full((len(is_sighted), 3), np.nan)
    vertical[problem.level_rows.station_indices] = problem.level_rows.plumb_directions
    is_free = np.array([not name for name in marks.mark_names]) & is_sighted.any(axis=1)
    deficient_names = np.flatnonzero(is_free & ~determines_pose(state.target_points, is_sighted, vertical))
    if not len(deficient_names):
        return ""
    levelled = deficient_names[0] in problem.level_rows.station_indices
    phrase = "two targets that are not above one another" if levelled else "three targets that are not on one line"
    name = recording.stations[deficient_names[0]]
    return f"station {name} measures fewer than {phrase}: its pose is undetermined; measure more targets from it"


# --- gross errors before the adjustment ---------------------------------------------------------------------------


class ScreenedNetwork(NamedTuple):
    """Start values of a network, with flags that mark pointings with gross errors and unconnected targets."""

    recording: Recording
    """Recording without the readings to unconnected targets."""
    start_poses_and_points: tuple[Floats, Floats, Floats]
    """Positions (S, 3) [m] and rotations (S, 3, 3) of S stations, and positions (T, 3) [m] of T targets."""
    is_gross_pointing: Bools
    """Flags (n,), True for those of n pointings with gross errors, larger than any error of a tracker."""
    is_unconnected_target: Bools
    """Flags (T,), True for those of the T targets that are not connected to the network."""


@raise_for_singular_network
def screen_gross_errors(recording: Recording) -> ScreenedNetwork:
    """Start values of a network, and its pointings with gross errors; raises NetworkError for unconnected stations.

    Gross pointings, for example to an exchanged reflector or with a wrong unit, have far larger misclosures than other
    pointings. Start values of a long chain of stations have large misclosures too, because errors accumulate. If any
    misclosure is large, the network is therefore adjusted, with reduced weights of these pointings, until the set of
    gross pointings is stable.
    """
    reached, lost = initial_network(recording)
    recording = recording.with_readings(np.where(lost[recording.target][:, None], np.nan, recording.readings))
    model = MeasurementModel(recording, ideal_construction())
    state = NetworkState(*reached, np.zeros((len(recording.instruments), 0)), np.zeros(model.n_extra_parameters))
    excess = _relative_misclosure(model, state)
    for _ in range(MAX_ITERATIONS if np.any(excess > 1.0) else 0):
        problem = drop_undetermined_targets(NetworkProblem.from_model(model), state)
        state, length = _gauss_newton_step(problem, state, model.linearise(state), np.maximum(excess, 1.0)[:, None])
        before, excess = excess, _relative_misclosure(model, state)
        if not length or not np.any((excess > 1.0) & (excess < MAX_CONVERGENCE_RATIO * before)):
            break
    return ScreenedNetwork(
        recording, (state.station_positions, state.station_rotations, state.target_points), excess > 1.0, lost
    )


def _relative_misclosure(model: MeasurementModel, state: NetworkState) -> Floats:
    """Misclosures (n,) of n pointings as displacements of the point, divided by the limit of a gross error."""
    readings, predicted = model.recording.readings, model.predict(state)
    gap = readings - predicted
    gap[:, 1:] = wrap_angle(gap[:, 1:])
    range_ = model.sightings_without_covariates(state).range_
    gap[:, 1] *= range_ * np.cos(predicted[:, 2])
    gap[:, 2] *= range_
    miss = np.linalg.norm(np.nan_to_num(gap), axis=1)
    limit = np.maximum(
        MAX_TRACKER_ERROR * np.maximum(1.0, range_ / MIN_RANGE_OF_PROPORTIONAL_ERROR_LIMIT),
        MIN_GROSS_ERROR_SIGMAS * robust_sigma(miss),
    )
    return miss / limit


def _gauss_newton_step(
    problem: NetworkProblem, state: NetworkState, prediction: Prediction, sigma_factors: Floats
) -> tuple[NetworkState, float]:
    """State after one Gauss-Newton step, and squared length of the step in standard deviations; 0 if singular.

    The standard deviations of the readings of n pointings are multiplied by `sigma_factors` (n, 1).
    """
    try:
        weighted_problem = replace(problem, reading_sigmas=problem.reading_sigmas * sigma_factors)
        system = weighted_problem.linear_system(state, prediction)
        step = FactorisedNormals(system).step()
    except SingularSystemError:
        return state, 0.0
    return problem.retract(state, step), float(np.sum((system.design @ step) ** 2))


# --- outliers in the adjustment -----------------------------------------------------------------------------------


def snoop_readings(
    problem: NetworkProblem, state: NetworkState, max_passes: int = MAX_SNOOPING_PASSES
) -> tuple[NetworkProblem, Solution[NetworkState]]:
    """Problem without outliers, and its solution; `state` is an approximate solution.

    Reweighted least squares gives a network that outliers hardly distort. Readings that contradict this network are
    rejected. Data snooping is the second step: after each of up to `max_passes` solutions all used and rejected
    readings are tested again.
    """
    limit = critical_normalised_residual(int(problem.is_used_reading.sum()))
    state, _ = iterate_reweighted(
        problem, state, int(problem.is_used_reading.sum()), min_scale=1e-3, max_steps=MAX_REWEIGHTINGS_BEFORE_SNOOPING
    )
    try:
        rejected = _is_newly_rejected(problem, state, limit)
    except SingularSystemError:
        return problem, solve(problem, state)
    tried_sets: set[bytes] = set()
    placed, target = state.target_points, problem.model.recording.target
    while True:
        reduced_problem = drop_undetermined_targets(
            replace(problem, is_used_reading=problem.is_used_reading & ~rejected), state
        )
        solution = solve(reduced_problem, state, max_iterations=MAX_STEPS_PER_SNOOPING_PASS)
        tried_sets.add(rejected.tobytes())
        if not _is_determined(reduced_problem, solution):  # too many readings are rejected
            if not rejected.any():
                return reduced_problem, solution
            whole = rejected | (
                _is_mostly_rejected_setup(rejected, problem)[problem.model.recording.station][:, None]
                & problem.is_used_reading
            )
            if not np.array_equal(whole, rejected):  # few readings of a set-up do not determine its pose
                rejected = whole
                continue
            size = np.where(rejected, absolute_whitened_residuals(problem, state), -1.0)
            half = np.argsort(-size, axis=None)[: int(rejected.sum()) // 2]
            rejected = np.isin(np.arange(size.size), half).reshape(size.shape)
            continue
        state = solution.x
        new = _is_rejected_in_repeated_test(problem, reduced_problem, solution, rejected, limit)
        if np.array_equal(new, rejected):
            return reduced_problem, solution if solution.has_converged else solve(reduced_problem, state)
        if (
            new.tobytes() in tried_sets or len(tried_sets) >= max_passes
        ):  # no convergence: readings that were rejected in either pass remain rejected
            last = drop_undetermined_targets(
                replace(problem, is_used_reading=problem.is_used_reading & ~(new | rejected)), state
            )
            ended = solve(last, state)
            return (last, ended) if _is_determined(last, ended) else (reduced_problem, solve(reduced_problem, state))
        rejected = new
        held = np.bincount(target, (problem.is_used_reading & ~rejected).any(axis=1), len(placed)) > 0
        # A target without used readings is at its robust position.
        state = replace(state, target_points=np.where(held[:, None], state.target_points, placed))


def _is_determined(problem: NetworkProblem, solution: Solution[NetworkState]) -> bool:
    """True if a problem has used readings, and these determine its unknowns."""
    return solution.factor is not None and bool(problem.is_used_reading.any())


def _is_newly_rejected(problem: NetworkProblem, state: NetworkState, limit: float) -> Bools:
    """Flags (n, 3) of used readings of n pointings whose normalised residual exceeds `limit` times the noise factor.

    The noise factor is estimated from the residuals. Raises SingularSystemError if unknowns are undetermined.
    """
    prediction = problem.model.linearise(state)
    readings, system = prediction.readings, problem.linear_system(state, prediction)
    del prediction
    w, scale, _ = _normalised_residuals_and_noise(problem, problem, readings, FactorisedNormals(system))
    return np.asarray(w > limit * scale)


def _is_mostly_rejected_setup(is_rejected: Bools, problem: NetworkProblem) -> Bools:
    """Flags (S,) of S set-ups, True if more than half of the readings are rejected; `is_rejected` (n, 3) flags them."""
    recording = problem.model.recording
    out, used = (
        np.bincount(recording.station, rows.sum(axis=1), len(recording.stations))
        for rows in (is_rejected, problem.is_used_reading)
    )
    return np.asarray(out > MIN_FAULTY_FRACTION_OF_GROUP * used)


def absolute_whitened_residuals(problem: NetworkProblem, state: NetworkState) -> Floats:
    """Absolute residuals (n, 3) of n pointings in standard deviations of the readings; 0 if not measured."""
    return _absolute_residuals_of_prediction(problem, problem.model.predict(state))


def _absolute_residuals_of_prediction(problem: NetworkProblem, readings: Floats) -> Floats:
    """Absolute residuals (n, 3) of n pointings in standard deviations, from predicted `readings`; 0 if unmeasured."""
    return np.nan_to_num(np.abs(problem.reading_residuals(readings) / problem.reading_sigmas))


def prediction_error_sigmas(
    problem: NetworkProblem, solution: Solution[NetworkState], is_omitted: Bools, prediction: Prediction | None = None
) -> Floats:
    """Standard deviations (k,) of the differences of k rejected readings from their predictions by the used readings.

    The unit is the declared standard deviation of the reading. `is_omitted` (n, 3) flags the rejected readings of n
    pointings. `prediction` contains predicted readings at the solution and derivatives; it is computed if None.
    """
    assert solution.factor is not None
    system = problem.linear_system(solution.x, prediction or problem.model.linearise(solution.x))
    omitted_rows = to_dense(system.design[np.flatnonzero(is_omitted[problem.is_used_reading])])
    response = solution.factor.multiply_by_covariance(np.ascontiguousarray(omitted_rows.T))
    return np.asarray(np.sqrt(1.0 + np.maximum(np.sum(omitted_rows * response.T, axis=1), 0.0)))


def _normalised_residuals_and_noise(
    problem: NetworkProblem, reduced_problem: NetworkProblem, readings: Floats, normal_equations: FactorisedNormals
) -> tuple[Floats, float, Floats]:
    """Absolute normalised residuals (n, 3) of n pointings, estimated noise factor, and redundancy numbers (n, 3).

    `readings` (n, 3) are the predicted readings, `normal_equations` those of `reduced_problem` at the same state.
    """
    redundancy = redundancy_numbers(reduced_problem, normal_equations)
    w = normalise_residuals(reduced_problem, problem.reading_residuals(readings), redundancy)
    return np.nan_to_num(np.abs(w)), noise_factor_from_residuals(w, redundancy), redundancy


def _is_rejected_in_repeated_test(
    problem: NetworkProblem,
    reduced_problem: NetworkProblem,
    solution: Solution[NetworkState],
    is_rejected: Bools,
    limit: float,
) -> Bools:
    """Flags (n, 3) of rejected readings of n pointings, after all readings were tested again against `limit`."""
    assert solution.factor is not None
    out = is_rejected & problem.is_used_reading
    targets, stations = problem.model.recording.target, problem.model.recording.station
    prediction = problem.model.linearise(solution.x) if out.any() else None
    readings = problem.model.predict(solution.x) if prediction is None else prediction.readings
    w, scale, redundancy = _normalised_residuals_and_noise(problem, reduced_problem, readings, solution.factor)
    new: Bools = (w > limit * scale) & (redundancy > NORMAL_EQUATIONS_TOLERANCE)
    if new.any():
        new &= w > 0.5 * w.max()
    if prediction is not None:
        spread = prediction_error_sigmas(problem, solution, out, prediction)
        still, lost = np.zeros_like(is_rejected), np.zeros(len(problem.model.recording.stations), dtype=bool)
        alone = np.zeros_like(reduced_problem.undetermined_unknowns.is_unmeasured_target)
        still[out] = _absolute_residuals_of_prediction(problem, readings)[out] / spread > limit * scale
        unpredicted = np.argwhere(out)[spread > MAX_SIGMA_OF_PREDICTED_READING, 0]
        # The used readings of a mostly rejected set-up do not determine its pose.
        is_open = _is_mostly_rejected_setup(out, problem)[stations[unpredicted]]
        alone[targets[unpredicted[~is_open]]] = True
        lost[stations[unpredicted[is_open]]] = True
        # Readings to a target remain rejected if the used readings do not determine it, or hardly determine it.
        new |= (
            still
            | (is_rejected & reduced_problem.undetermined_unknowns.is_unmeasured_target[targets][:, None])
            | (problem.is_used_reading & alone[targets][:, None])
        )
        new |= problem.is_used_reading & lost[stations][:, None]
    return new
