"""Data snooping: duplicate rows, undetermined targets, gross errors before the adjustment, outliers within it.

Rejected readings are tested again after each solution, and accepted if they fit.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ltsim.adjustment.problem import NetworkProblem
from ltsim.adjustment.reliability import critical_w, normalised, redundancy_of, scale_of
from ltsim.adjustment.significance import MAJORITY, UNCHECKED
from ltsim.adjustment.start import initial_network
from ltsim.adjustment.stochastic_model import reweighted
from ltsim.adjustment.structure import refusing_singular
from ltsim.core.arrays import Bools, Floats
from ltsim.geometry.polar import wrap
from ltsim.geometry.rigid import determines_pose
from ltsim.physics.model.construction import ideal_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState, Prediction
from ltsim.recordings.recording import Recording
from ltsim.solve.design import POINT_RANK_TOLERANCE, as_dense, median_deviation, unit_diagonal
from ltsim.solve.elimination import BlockFactor, SingularSystemError
from ltsim.solve.gauss_newton import Solution, solve

LEAST = 10
"""Smallest number of rows without a clock that must repeat others (all that can) before they count as copies."""
LARGEST_ERROR = 1e-3
"""Error [m] beyond any plausible tracker error within `WORKSHOP`."""
WORKSHOP = 10.0
"""[m] Range up to which `LARGEST_ERROR` holds; beyond it, errors of angles grow with the range."""
FACTOR = 30.0
"""Ratio of a misclosure to the robust standard deviation of all misclosures above which a pointing is a gross
error and not noise.
"""
PASSES = 20
"""Largest number of linear steps from approximate coordinates until no gross misclosure decreases."""
SETTLED = 0.9
"""Ratio of successive gross misclosures below which an iteration is not converged."""
RELAXATIONS = 8
"""Number of reweightings before snooping; the single steps of snooping correct the remaining outliers."""
ROUNDS = 20
"""Largest number of solutions until the set of rejected readings is stable; readings that still alternate are
borderline.
"""
STEPS = 10
"""Largest number of iterations of an intermediate solution; the last one converges."""
UNPREDICTED = 100.0
"""Standard deviation of a prediction, in sigmas of a rejected reading, above which the target
counts as undetermined.
"""


def copied_rows(recording: Recording) -> Bools:
    """Flags (n,) of the rows that equal an earlier one of the same time, set-up, target and face in every digit.

    Without a clock two pointings may be equal by chance: rows are then copies only if all repeated pointings are equal
    in every digit.
    """
    values = np.sort(recording.readings, axis=None)
    if not np.any(values[1:] == values[:-1]):
        return np.zeros(len(recording), dtype=bool)
    place = np.stack([recording.station, recording.target, recording.face], axis=1)
    clock = recording.time[:, None] if recording.has_clock else np.zeros((len(recording), 0))
    whole = np.concatenate([place, clock, np.nan_to_num(recording.readings, nan=np.inf)], axis=1)
    repeated = _later(np.concatenate([place, clock], axis=1))
    copied = _later(whole) & recording.measured.any(axis=1)
    if recording.has_clock:
        return copied
    return copied & (copied.sum() >= max(LEAST, int(repeated.sum())))


def _later(rows: np.ndarray) -> Bools:
    """Flags (n,) of the rows that equal an earlier one."""
    later = np.ones(len(rows), dtype=bool)
    later[np.unique(rows, axis=0, return_index=True)[1]] = False
    return later


# --- what the readings in use do not place ------------------------------------------------------------------------


def drop_undetermined(problem: NetworkProblem, state: NetworkState) -> NetworkProblem:
    """Problem without the readings, reference lengths and differences of undetermined targets.

    The row of a length to such a target remains, without weight.
    """
    while True:
        loose = undetermined_targets(problem, state)
        gauge = problem.gauge
        reached = problem.structure.unseen | loose
        idle = (reached[gauge.first] | reached[gauge.second]) & np.isfinite(gauge.sigma)
        use = problem.use & ~loose[problem.model.recording.target][:, None]
        differences = problem.differences.subset(~problem.unplaced(reached))
        if np.array_equal(use, problem.use) and not idle.any() and len(differences) == len(problem.differences):
            return problem
        problem = replace(problem, gauge=replace(gauge, idle=gauge.idle | idle), use=use, differences=differences)


def undetermined_targets(problem: NetworkProblem, state: NetworkState) -> Bools:
    """Flags (T,) of the targets whose used readings leave a direction undetermined, given the stations."""
    recording, count = problem.model.recording, len(problem.model.recording.targets)
    whole = np.bincount(recording.target, problem.use.all(axis=1), count) > 0
    doubtful = ~whole & ~problem.structure.unseen
    doubtful[problem.marks.target[problem.marks.target >= 0]] = False
    if not doubtful.any():
        return doubtful
    weighted = np.where(problem.use, 1.0 / problem.sigma, 0.0)[:, :, None]
    rows = np.where(problem.use[:, :, None], problem.model.linearised(state).target_derivatives * weighted, 0.0)
    normal = np.zeros((count, 3, 3))
    np.add.at(normal, recording.target, np.swapaxes(rows, 1, 2) @ rows)
    gauge, control = problem.gauge, problem.control
    along = gauge.directions(state.target_points) / gauge.sigma[:, None]
    for end in (gauge.first, gauge.second):
        np.add.at(normal, end, along[:, :, None] * along[:, None, :])
    np.add.at(normal, control.target, np.swapaxes(control.root, 1, 2) @ control.root)
    for end in problem.differences.ends:
        rows_at_end = problem.differences.subset(end < count)
        np.add.at(normal, end[end < count], np.swapaxes(rows_at_end.root, 1, 2) @ rows_at_end.root)
    normal[problem.structure.height_free_targets, 2, 2] += np.trace(
        normal[problem.structure.height_free_targets], axis1=1, axis2=2
    )
    # In each axis' own unit: a coordinate that is known to a micrometre leaves one that is read to a metre known.
    scaled, _ = unit_diagonal(normal, np.diagonal(normal, axis1=1, axis2=2))
    return doubtful & (np.linalg.eigvalsh(scaled)[:, 0] <= POINT_RANK_TOLERANCE)


def pose_defect(problem: NetworkProblem, state: NetworkState) -> str:
    """Sentence on a station whose targets do not determine its pose, by geometry alone; empty for none.

    Set-ups over marks and stations without readings are excluded.
    """
    recording, marks = problem.model.recording, problem.marks
    sighted = np.zeros((len(recording.stations), len(recording.targets)), dtype=bool)
    used = problem.use.any(axis=1)
    sighted[recording.station[used], recording.target[used]] = True
    vertical = np.full((len(sighted), 3), np.nan)
    vertical[problem.levels.station] = problem.levels.vertical
    free = np.array([not name for name in marks.names]) & sighted.any(axis=1)
    few = np.flatnonzero(free & ~determines_pose(state.target_points, sighted, vertical))
    if not len(few):
        return ""
    levelled = few[0] in problem.levels.station
    what = "two targets that are not above one another" if levelled else "three targets that are not on one line"
    return f"station {recording.stations[few[0]]} sees fewer than {what}, which a pose needs"


# --- before the adjustment ----------------------------------------------------------------------------------------


class Screened(NamedTuple):
    """Recording without readings to unconnected targets, and the start of its network."""

    recording: Recording
    network: tuple[Floats, Floats, Floats]
    """Positions (S, 3), rotations (S, 3, 3) and targets (T, 3), after correction of errors in the start values."""
    gross: Bools
    """Flags (n,) of the pointings with errors beyond any tracker error."""
    lost: Bools
    """Flags (T,) of the targets that are not connected to the network."""


@refusing_singular
def screen_gross_errors(recording: Recording) -> Screened:
    """Start of a network, and its gross pointings; raises NetworkError.

    Gross pointings have far larger misclosures than the others: an exchanged or misnamed reflector, a wrong unit in one
    row. A long chain of stations that were joined one by one does not close, which looks similar. If any pointing seems
    gross, the network is therefore iterated with reduced weights of such pointings until the set is stable.
    """
    reached, lost = initial_network(recording)
    recording = recording.with_readings(np.where(lost[recording.target][:, None], np.nan, recording.readings))
    model = MeasurementModel(recording, ideal_construction())
    state = NetworkState(*reached, np.zeros((len(recording.instruments), 0)), np.zeros(model.n_extra_parameters))
    excess = _excess(model, state)
    for _ in range(PASSES if np.any(excess > 1.0) else 0):
        problem = drop_undetermined(NetworkProblem.of(model), state)
        state, length = _step(problem, state, model.linearised(state), np.maximum(excess, 1.0)[:, None])
        before, excess = excess, _excess(model, state)
        if not length or not np.any((excess > 1.0) & (excess < SETTLED * before)):
            break
    return Screened(
        recording, (state.station_positions, state.station_rotations, state.target_points), excess > 1.0, lost
    )


def _excess(model: MeasurementModel, state: NetworkState) -> Floats:
    """Misclosure (n,) of each pointing divided by the limit for gross errors."""
    readings, predicted = model.recording.readings, model.predict(state)
    gap = readings - predicted
    gap[:, 1:] = wrap(gap[:, 1:])
    range_ = model.geometry(state).range_
    gap[:, 1] *= range_ * np.cos(predicted[:, 2])
    gap[:, 2] *= range_
    miss = np.linalg.norm(np.nan_to_num(gap), axis=1)
    limit = np.maximum(LARGEST_ERROR * np.maximum(1.0, range_ / WORKSHOP), FACTOR * median_deviation(miss))
    return miss / limit


def _step(
    problem: NetworkProblem, state: NetworkState, prediction: Prediction, loose: Floats
) -> tuple[NetworkState, float]:
    """State after a step with standard deviations multiplied by `loose`, and its squared length.

    It is 0 for a singular system.
    """
    try:
        system = replace(problem, sigma=problem.sigma * loose).system(state, prediction)
        step = BlockFactor(system).step()
    except SingularSystemError:
        return state, 0.0
    return problem.retract(state, step), float(np.sum((system.design @ step) ** 2))


# --- within the adjustment ----------------------------------------------------------------------------------------


def snoop_readings(
    problem: NetworkProblem, state: NetworkState, rounds: int = ROUNDS
) -> tuple[NetworkProblem, Solution[NetworkState]]:
    """Problem without outliers, and its solution.

    All readings in `use` may be used, and `state` is an approximate solution.

    Reweighting gives a network that many outliers do not distort, and readings that it rejects are removed. Data
    snooping follows, and removed readings are tested again against the network without them.
    """
    limit = critical_w(int(problem.use.sum()))
    state, _ = reweighted(problem, state, int(problem.use.sum()), least=1e-3, steps=RELAXATIONS)
    try:
        rejected = _rejected(problem, state, limit)
    except SingularSystemError:
        return problem, solve(problem, state)
    tried: set[bytes] = set()
    placed, target = state.target_points, problem.model.recording.target
    while True:
        reduced = drop_undetermined(replace(problem, use=problem.use & ~rejected), state)
        solution = solve(reduced, state, cap=STEPS)
        tried.add(rejected.tobytes())
        if solution.factor is None:  # Too much at once: what is left does not hold the network.
            if not rejected.any():
                return reduced, solution
            whole = rejected | (_mostly(rejected, problem)[problem.model.recording.station][:, None] & problem.use)
            if not np.array_equal(whole, rejected):  # a set-up of which little is left holds its pose by nothing
                rejected = whole
                continue
            size = np.where(rejected, whitened_readings(problem, state), -1.0)
            half = np.argsort(-size, axis=None)[: int(rejected.sum()) // 2]
            rejected = np.isin(np.arange(size.size), half).reshape(size.shape)
            continue
        state = solution.x
        new = _retested(problem, reduced, solution, rejected, limit)
        if np.array_equal(new, rejected):
            return reduced, solution if solution.converged else solve(reduced, state)
        if new.tobytes() in tried or len(tried) >= rounds:  # On the edge: what is out in either stays out.
            last = drop_undetermined(replace(problem, use=problem.use & ~(new | rejected)), state)
            ended = solve(last, state)
            return (reduced, solve(reduced, state)) if ended.factor is None else (last, ended)
        rejected = new
        held = np.bincount(target, (problem.use & ~rejected).any(axis=1), len(placed)) > 0
        state = replace(
            state, target_points=np.where(held[:, None], state.target_points, placed)
        )  # misses are told from there


def _rejected(problem: NetworkProblem, state: NetworkState, limit: float) -> Bools:
    """Readings (n, 3) in use whose test statistic is over `limit`; SingularSystemError where unknowns are open."""
    prediction = problem.model.linearised(state)
    readings, system = prediction.readings, problem.system(state, prediction)
    del prediction
    w, scale, _ = _tested(problem, problem, readings, BlockFactor(system))
    return np.asarray(w > limit * scale)


def _mostly(rejected: Bools, problem: NetworkProblem) -> Bools:
    """Flags (S,) of the set-ups with more rejected readings (n, 3) than used ones."""
    recording = problem.model.recording
    out, used = (
        np.bincount(recording.station, rows.sum(axis=1), len(recording.stations)) for rows in (rejected, problem.use)
    )
    return np.asarray(out > MAJORITY * used)


def whitened_readings(problem: NetworkProblem, state: NetworkState) -> Floats:
    """Absolute residuals (n, 3) in standard deviations of the readings; 0 if not measured."""
    return _whitened(problem, problem.model.predict(state))


def _whitened(problem: NetworkProblem, readings: Floats) -> Floats:
    """Absolute residuals (n, 3) in standard deviations, as `whitened_readings`, for given predicted readings (n, 3)."""
    return np.nan_to_num(np.abs(problem.residuals(readings) / problem.sigma))


def prediction_spread(
    problem: NetworkProblem, solution: Solution[NetworkState], omitted: Bools, prediction: Prediction | None = None
) -> Floats:
    """Standard deviations (k,) of the deviations of `omitted` (n, 3) readings from predictions, over the declared.

    The `prediction` is that of the solution's state, computed here by default.
    """
    assert solution.factor is not None
    system = problem.system(solution.x, prediction or problem.model.linearised(solution.x))
    rows = as_dense(system.design[np.flatnonzero(omitted[problem.use])])
    response = solution.factor.covariance_columns(np.ascontiguousarray(rows.T))
    return np.asarray(np.sqrt(1.0 + np.maximum(np.sum(rows * response.T, axis=1), 0.0)))


def _tested(
    problem: NetworkProblem, reduced: NetworkProblem, readings: Floats, factor: BlockFactor
) -> tuple[Floats, float, Floats]:
    """Values |w| (n, 3) of the readings of `reduced`, the scale of the noise, and redundancy numbers (n, 3).

    `factor` belongs to the state that predicts the `readings` (n, 3).
    """
    redundancy = redundancy_of(reduced, factor)
    w = normalised(reduced, problem.residuals(readings), redundancy)
    return np.nan_to_num(np.abs(w)), scale_of(w, redundancy), redundancy


def _retested(
    problem: NetworkProblem, reduced: NetworkProblem, solution: Solution[NetworkState], rejected: Bools, limit: float
) -> Bools:
    """Flags (n, 3) of the rejected readings after a test of all rejected and used readings."""
    assert solution.factor is not None
    out = rejected & problem.use
    targets, stations = problem.model.recording.target, problem.model.recording.station
    prediction = problem.model.linearised(solution.x) if out.any() else None
    readings = problem.model.predict(solution.x) if prediction is None else prediction.readings
    w, scale, redundancy = _tested(problem, reduced, readings, solution.factor)
    new: Bools = (w > limit * scale) & (redundancy > UNCHECKED)
    if new.any():
        new &= w > 0.5 * w.max()
    if prediction is not None:
        spread = prediction_spread(problem, solution, out, prediction)
        still, alone = np.zeros_like(rejected), np.zeros(len(reduced.structure.unseen), dtype=bool)
        lost = np.zeros(len(problem.model.recording.stations), dtype=bool)
        still[out] = _whitened(problem, readings)[out] / spread > limit * scale
        unpredicted = np.argwhere(out)[spread > UNPREDICTED, 0]
        is_open = _mostly(out, problem)[stations[unpredicted]]  # what is left of such a set-up holds no pose
        alone[targets[unpredicted[~is_open]]] = True
        lost[stations[unpredicted[is_open]]] = True
        # A target that is left out by now cannot speak for its readings, nor can one that is as good as that.
        new |= still | (rejected & reduced.structure.unseen[targets][:, None]) | (problem.use & alone[targets][:, None])
        new |= problem.use & lost[stations][:, None]
    return new
