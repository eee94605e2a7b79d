"""Quality of an adjusted network: checks that refuse an unusable adjustment, and warnings for the user."""

from collections.abc import Iterator

import numpy as np
from scipy import special
from scipy.spatial import KDTree

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.axes import MAX_RELATIVE_POINT_MISCLOSURE
from ltsim.adjustment.blunders import correct_units, detect_blunders
from ltsim.adjustment.centring import estimate_centring_errors
from ltsim.adjustment.estimate import adjust
from ltsim.adjustment.frame import MAX_FLOOR_PLAN_ERROR, DeclaredFrame, alignment_distances, upright_alignment
from ltsim.adjustment.reference_values import without_reference_coordinates
from ltsim.adjustment.significance import (
    MAX_SINGLE_ERROR_FRACTION,
    MAX_TRACKER_ERROR,
    MIN_FAULTY_FRACTION_OF_GROUP,
    MIN_MISFIT_RATIO,
    SINGLE_TEST_LEVEL,
)
from ltsim.adjustment.station_motions import motions_with_sentences
from ltsim.core.arrays import Bools, Floats
from ltsim.core.errors import LtsimError, NetworkError
from ltsim.core.notation import MAX_LISTED_SENTENCES, names_text
from ltsim.core.units import MILLIMETRE
from ltsim.geometry.polar import wrap_angle
from ltsim.geometry.rigid import MIN_POINTS_FOR_POSE, align_rigidly
from ltsim.recordings.transcription_errors import DEGREES_FOR_GON, UNIT_AND_CONVENTION_ERRORS

MAX_CONSISTENT_SIGMA0 = 100.0
"""Largest sigma0 of consistent observations. If sigma0 is larger, other units of the readings are tried, and a warning
states that standard deviations are not valid."""
MIN_COS_MEDIAN_TILT = 0.9
"""Limit of the cosine of the median tilt of the stations. If the cosine is larger, the positions of the stations are
compared with the floor plan."""
MAX_POSE_CURVATURE = 0.3
"""Limit of the nonlinearity of the readings over one standard deviation of a pose (curvature of Bates and Watts, in
standard deviations of a reading). If it is exceeded, the standard deviations of the pose are reported as too small."""
TESTED_UNIT_ERRORS = (
    *(slip for slip in UNIT_AND_CONVENTION_ERRORS if slip.name in ("gon", "metre", "inch", "clockwise", "zenith")),
    DEGREES_FOR_GON,
)
"""Errors of unit or convention that are tested for a whole file. Errors whose correction shrinks lengths are not among
them, because any shrunk network seems to fit."""


def require_usable_adjustment(adjustment: Adjustment) -> None:
    """Check that an adjustment is usable: it converged, units and known points are consistent, most pointings are used.

    Raises NetworkError for inconsistent observations, and ConvergenceError if the adjustment has no solution.
    """
    _require_consistent_units(adjustment)
    adjustment.require_solution()
    _require_consistent_control(adjustment)
    is_unused = _is_unused_pointing(adjustment)
    is_mostly_unused = is_unused.sum() > MIN_FAULTY_FRACTION_OF_GROUP * len(is_unused)
    unit_text = (
        _consistent_unit_text(adjustment) if is_mostly_unused or adjustment.sigma0 > MAX_CONSISTENT_SIGMA0 else ""
    )
    if is_mostly_unused or unit_text:
        out = f"{is_unused.sum()} of {len(is_unused)} pointings would be rejected"
        what = out if is_mostly_unused else f"sigma0 is {adjustment.sigma0:.3g}"
        cure = f"they fit as {unit_text}" if unit_text else "check units, sense of the angles and target names"
        raise NetworkError(f"the readings contradict each other ({what}): {cure}")


def _require_consistent_units(adjustment: Adjustment) -> None:
    """Check that all set-ups have the same units and sense of rotation; raises NetworkError."""
    thin = next(_sparse_station_sentences(adjustment), "")
    if thin or not adjustment.solution.has_converged or adjustment.sigma0 > MAX_CONSISTENT_SIGMA0:
        sentences = [finding.sentence.rstrip(".") for finding in correct_units(adjustment.recording)[1]]
        if sentences:
            first_sentences = "; ".join(sentences[:MAX_LISTED_SENTENCES])
            raise NetworkError(f"{first_sentences}: read the recording again with this unit or convention")


def _require_consistent_control(adjustment: Adjustment) -> None:
    """Check that the known points are not the only cause of a large misfit; raises NetworkError."""
    control, recording = adjustment.problem.control_rows, adjustment.recording
    if not (adjustment.sigma0 > MAX_CONSISTENT_SIGMA0 and len(control)):
        return
    try:
        alone = adjust(
            without_reference_coordinates(recording), adjustment.construction, prior=adjustment.problem.prior
        )
    except LtsimError:
        return
    if not (alone.solution.has_converged and MIN_MISFIT_RATIO * alone.sigma0 < adjustment.sigma0):
        return
    gap = 1e3 * float(np.abs(adjustment.state.target_points[control.point_indices] - control.declared_points).max())
    is_complete = control.is_declared_coordinate.all(axis=1)
    points = alone.state.target_points[control.point_indices[is_complete]]
    raise NetworkError(
        f"the known points contradict the readings (sigma0 {adjustment.sigma0:.3g}, without them {alone.sigma0:.3g}; "
        f"largest difference {gap:.3g} mm): {_control_error_cause_text(points, control.declared_points[is_complete])}"
    )


def _control_error_cause_text(network_points: Floats, control_points: Floats) -> str:
    """Text on the likely cause of differences between k control points (k, 3) [m] and network points (k, 3) [m].

    Possible causes are another scale, a mirror image, equal coordinates, and single wrong points.
    """
    spread = [float(np.sqrt(np.sum((x - x.mean(axis=0)) ** 2))) for x in (network_points, control_points)]
    if len(network_points) < 3 or not spread[0] > 0.0:
        return "check their coordinates"
    if spread[1] < 1e-6 * spread[0]:
        return "all known points have the same coordinates"
    scale, mirrored = spread[1] / spread[0], "check the order and the signs of their axes, or the sense of the azimuths"
    misfit_by_text = {
        f"they fit if their coordinates are multiplied by {1 / scale:.6g}; check the unit": _rigid_fit_misfit(
            network_points * scale, control_points
        ),
        f"they fit the mirror image; {mirrored}": _rigid_fit_misfit(-network_points, control_points),
    }
    best_way = min(misfit_by_text, key=lambda way: misfit_by_text[way])
    return (
        best_way
        if MIN_MISFIT_RATIO * misfit_by_text[best_way] < _rigid_fit_misfit(network_points, control_points)
        else "check their coordinates and names"
    )


def _rigid_fit_misfit(points: Floats, goal_points: Floats) -> float:
    """Root of the sum of squared distances [m] of k points (k, 3) from goal points (k, 3) after a rigid alignment."""
    try:
        return float(np.linalg.norm(alignment_distances(points, goal_points, align_rigidly(points, goal_points))))
    except NetworkError:
        return float("inf")


def _is_unused_pointing(adjustment: Adjustment) -> Bools:
    """Flags (m,), True for those of the m measured pointings without any reading in use."""
    measured, used = (
        np.asarray(adjustment.recording.is_measured.any(axis=1)),
        adjustment.problem.is_used_reading.any(axis=1),
    )
    return ~np.asarray(used)[measured]


def _consistent_unit_text(adjustment: Adjustment) -> str:
    """Text on the unit that makes the readings consistent, such as `gon, not degrees`; empty if no unit does."""
    recording, most = adjustment.recording, MAX_CONSISTENT_SIGMA0
    if adjustment.sigma0 > MAX_CONSISTENT_SIGMA0:
        most = adjustment.sigma0 / MIN_MISFIT_RATIO
    for slip in TESTED_UNIT_ERRORS:
        try:
            adjusted = adjust(recording.with_readings(slip.without_error(recording.readings)))
        except LtsimError:
            continue
        if (
            adjusted.solution.has_converged
            and adjusted.sigma0 < most
            and _is_unused_pointing(adjusted).mean() < MAX_SINGLE_ERROR_FRACTION
        ):
            return f"{slip.wrong_content}, not {slip.right_content}"
    return ""


# --- warnings -----------------------------------------------------------------------------------------------------


def adjustment_warnings(adjustment: Adjustment) -> tuple[str, ...]:
    """Warnings for the user on an adjustment: contradictions, blunders, stations with few readings, invalid sigmas."""
    slips = _undecided_target_sentences, _blunder_sentences, _duplicate_target_sentences, _centring_sentences
    kinds = (
        _cause_sentences,
        _reference_value_sentences,
        _motion_sentences,
        _declared_position_sentences,
        *slips,
        _sparse_station_sentences,
        _unreliable_sigma_sentences,
        _duplicate_row_sentences,
    )
    return tuple(doubt for kind in kinds for doubt in kind(adjustment))


def network_warnings(adjustment: Adjustment) -> tuple[str, ...]:
    """Warnings for the user on the network as a whole, without warnings on single reference values or blunders."""
    kinds = (
        _declared_position_sentences,
        _undecided_target_sentences,
        _sparse_station_sentences,
        _unreliable_sigma_sentences,
    )
    return tuple(doubt for kind in kinds for doubt in kind(adjustment))


def _reference_value_sentences(adjustment: Adjustment) -> Iterator[str]:
    """Sentences on reference values that contradict the other observations."""
    candidates = (*adjustment.rejected_references, *adjustment.axes_point_tests)
    sentences = [
        test.sentence for test in candidates if test.is_excluded or test.indistinguishable_from or test.kind == "scale"
    ]
    yield from sentences[:MAX_LISTED_SENTENCES]
    if len(sentences) > MAX_LISTED_SENTENCES:
        yield f"{len(sentences) - MAX_LISTED_SENTENCES} more reference values contradict the other observations"


def _cause_sentences(adjustment: Adjustment) -> Iterator[str]:
    """Sentences on the identified errors that are part of the model."""
    yield from (sentence.rstrip(".") for sentence in adjustment.cause_sentences)


def _motion_sentences(adjustment: Adjustment) -> Iterator[str]:
    """Sentences on estimated motions of stations during their occupation."""
    yield from () if adjustment.cause_sentences else (sentence for _, sentence in motions_with_sentences(adjustment))


def _declared_position_sentences(adjustment: Adjustment) -> Iterator[str]:
    """Sentence on positions of stations on a floor plan that do not fit the network, or fit its mirror image."""
    frame, state = DeclaredFrame.from_recording(adjustment.recording), adjustment.state
    planned_indices = np.flatnonzero(np.isfinite(frame.floor_plan_positions).all(axis=1))
    if len(planned_indices) < MIN_POINTS_FOR_POSE or np.median(state.station_rotations[:, 2, 2]) < MIN_COS_MEDIAN_TILT:
        return
    here, there = state.station_positions[planned_indices], frame.floor_plan_positions[planned_indices]
    has_heights = bool(np.ptp(there[:, 2]))  # one height for all stations declares none
    if not has_heights:
        here, there = here * [1.0, 1.0, 0.0], there * [1.0, 1.0, 0.0]
    extent = float(np.ptp(here[:, :2], axis=0).max())
    if extent < MAX_FLOOR_PLAN_ERROR:  # set-ups over one mark
        return
    as_is, *mirrored = (
        alignment_distances(places, there, upright_alignment(places, there))
        for places in (here, here * [1.0, -1.0, 1.0], here * [1.0, 1.0, -1.0])
    )
    if as_is.max() < max(MAX_FLOOR_PLAN_ERROR, MAX_RELATIVE_POINT_MISCLOSURE * extent):
        return
    names = names_text([adjustment.recording.stations[s] for s in planned_indices])
    nearest = min(mirrored, key=lambda distances: float(distances.max()))
    dof = 3 * len(here) - 4 if has_heights else 2 * len(here) - 3  # a rotation and a translation are fitted
    p_value = float(special.fdtrc(dof, dof, np.sum(as_is**2) / np.sum(nearest**2)))  # equal errors of the floor plan
    if nearest.max() < MAX_FLOOR_PLAN_ERROR and p_value < SINGLE_TEST_LEVEL:
        angles, error = ("azimuths", "are clockwise") if nearest is mirrored[0] else ("elevations", "have a wrong sign")
        yield (
            f"the declared positions of stations {names} fit the mirror image of this network within "
            f"{nearest.max():.2g} m, and the network itself within {as_is.max():.2g} m: if the {angles} {error}, all "
            f"coordinates are mirrored; check the sense of the {angles}"
        )
    else:
        yield (
            f"the declared positions of stations {names} differ from the network by up to {as_is.max():.2g} m and are "
            "not used: check them"
        )


def _undecided_target_sentences(adjustment: Adjustment) -> Iterator[str]:
    """Sentences on targets whose positions from two stations differ, so that pointings from them were rejected."""
    recording = adjustment.recording
    measured_pairs, used_pairs = np.zeros((2, len(recording.stations), len(recording.targets)), dtype=bool)
    for table, readings in ((measured_pairs, recording.is_measured), (used_pairs, adjustment.problem.is_used_reading)):
        rows = readings.any(axis=1)
        table[recording.station[rows], recording.target[rows]] = True
    is_paired = measured_pairs.sum(axis=0) == 2
    ends = {1: "the coordinates follow from one station only", 0: "the target has no coordinates"}
    for stations, end in ends.items():
        names = [recording.targets[t] for t in np.flatnonzero(is_paired & (used_pairs.sum(axis=0) == stations))]
        if names:
            contradiction = "the positions from two stations differ, and the readings do not show which one is right"
            yield f"{names_text(names)}: {contradiction}; {end}"


def _blunder_sentences(adjustment: Adjustment) -> Iterator[str]:
    """Sentences on blunders that explain the rejected pointings: exchanged reflectors, wrong units, wrong faces."""
    sentences = [finding.sentence.rstrip(".") for finding, *_ in detect_blunders(adjustment)]
    if sentences:
        more = (
            f"; {len(sentences) - MAX_LISTED_SENTENCES} more blunders" if len(sentences) > MAX_LISTED_SENTENCES else ""
        )
        shown_ones = "; ".join(sentences[:MAX_LISTED_SENTENCES])
        yield f"{shown_ones}{more}: these pointings are not used; run ltsim diagnose to correct them"


def _duplicate_target_sentences(adjustment: Adjustment) -> Iterator[str]:
    """Sentences on pairs of targets that may be one target with two names.

    The targets of such a pair have the same position, and no set-up measures both.
    """
    recording, points = adjustment.recording, adjustment.state.target_points
    is_sighted = np.zeros((len(recording.targets), len(recording.stations)), dtype=bool)
    placed = adjustment.problem.is_used_reading.all(axis=1)
    is_sighted[recording.target[placed], recording.station[placed]] = True
    placed_targets = np.flatnonzero(is_sighted.any(axis=1))
    for a, b in KDTree(points[placed_targets]).query_pairs(MAX_TRACKER_ERROR, output_type="ndarray"):
        first, second = placed_targets[[a, b]]
        if not (is_sighted[first] & is_sighted[second]).any():
            gap = float(np.linalg.norm(points[first] - points[second])) / MILLIMETRE
            names = f"{recording.targets[first]} and {recording.targets[second]}"
            yield f"{names} are {gap:.2g} mm apart and no set-up measures both: they may be one target with two names"


def _centring_sentences(adjustment: Adjustment) -> Iterator[str]:
    """Sentence on centring errors at marks that were occupied on several days, if there are any."""
    centring_errors = estimate_centring_errors(adjustment)
    if centring_errors is not None:
        yield centring_errors.sentence


def _sparse_station_sentences(adjustment: Adjustment) -> Iterator[str]:
    """Sentences on stations of which most pointings are not in use."""
    recording, measured = adjustment.recording, adjustment.recording.is_measured.any(axis=1)
    n_stations = len(recording.stations)
    n_complete = np.bincount(recording.station[measured], minlength=n_stations)
    n_used = np.bincount(recording.station[adjustment.problem.is_used_reading.any(axis=1)], minlength=n_stations)
    for s in np.flatnonzero((n_used > 0) & (n_used < MIN_FAULTY_FRACTION_OF_GROUP * n_complete)):
        yield (
            f"station {recording.stations[s]} has {n_used[s]} of its {n_complete[s]} pointings in use: its position is "
            "uncertain; check the names of its targets, its units and the direction in which its azimuths increase"
        )


def _unreliable_sigma_sentences(adjustment: Adjustment) -> Iterator[str]:
    """Sentences on standard deviations that are missing, too small (nonlinear pose), or not valid (large sigma0)."""
    if adjustment.undetermined_stations:
        yield (
            "the readings in use do not determine the full pose of station "
            f"{names_text(adjustment.undetermined_stations)}: the undetermined components have no standard deviation"
        )
    bend = np.nan_to_num(pose_curvatures(adjustment)) if adjustment.solution.has_converged else np.zeros(0)
    curved_stations = [adjustment.recording.stations[s] for s in np.flatnonzero(bend > MAX_POSE_CURVATURE)]
    if curved_stations:
        yield (
            f"the targets of station {names_text(curved_stations)} "
            "hardly determine its pose, so that its standard deviations (a linear approximation) are too small "
            f"(curvature {bend.max():.2g}, trustworthy below {MAX_POSE_CURVATURE:g}): "
            "add targets far apart and not on one line"
        )
    if adjustment.sigma0 > MAX_CONSISTENT_SIGMA0:
        yield (
            f"sigma0 is {adjustment.sigma0:.3g}: readings, lengths and known points contradict each other, and the "
            "standard deviations are not valid; find and correct the wrong values first"
        )


def _duplicate_row_sentences(adjustment: Adjustment) -> Iterator[str]:
    """Sentence on rows that are exact copies of other rows, if there are any."""
    if adjustment.n_duplicate_rows:
        yield f"{adjustment.n_duplicate_rows} rows are exact copies of other rows: the copies are not used"


def pose_curvatures(adjustment: Adjustment) -> Floats:
    """Curvatures (S,) of the readings along the least determined direction of the pose of each of S stations.

    A covariance is valid if the readings are linear over one standard deviation of the unknowns. The pose of a station
    whose targets are nearly collinear, or close together and far away, may be too uncertain for this. With f the
    whitened readings, x the state, and v a change of x by one standard deviation in the least determined direction, the
    curvature is |f(x + v) - 2 f(x) + f(x - v)| / 2. It is zero for a well-determined and NaN for an undetermined pose.

    References
    ----------
    Bates and Watts, Nonlinear Regression Analysis and Its Applications (1988), 7.1: relative curvature, here the sum of
    intrinsic and parameter-effects curvature.
    """
    problem, state, spread = adjustment.problem, adjustment.state, adjustment.pose_covariance
    range_, station = adjustment.sightings.range_, adjustment.recording.station
    sigma_lengths = problem.reading_sigmas * np.stack([np.ones_like(range_), range_, range_], axis=1)
    min_sigmas = np.min(np.where(problem.is_used_reading, sigma_lengths, np.inf), axis=1)
    steepest, has_readings = np.zeros(len(spread)), np.isfinite(min_sigmas)
    np.maximum.at(steepest, station[has_readings], (range_ / min_sigmas)[has_readings])
    bend = np.where(np.isnan(spread).any(axis=(1, 2)), np.nan, 0.0)
    turn = np.trace(np.nan_to_num(spread)[:, 3:, 3:], axis1=1, axis2=2)
    for s in np.flatnonzero((0.5 * turn * steepest > MAX_POSE_CURVATURE) & ~np.isnan(bend)):
        columns, size = problem.unknowns.pose_columns[s], np.sqrt(np.diag(spread[s]))
        size = np.where(size > 0, size, 1.0)  # components that define the frame do not vary
        worst = np.linalg.eigh(spread[s] / np.outer(size, size))[1][:, -1] / size
        direction = np.zeros((problem.unknowns.n_columns, 1))
        direction[columns, 0] = worst
        carried = adjustment.factorised_normals.multiply_by_covariance(direction)[:, 0]
        step = carried / np.sqrt(carried[columns] @ worst)
        gaps = [problem.model.predict(problem.retract(state, sign * step)) for sign in (1.0, -1.0)]
        gaps = [gap - problem.model.predict(state) for gap in gaps]
        for gap in gaps:
            gap[:, 1:] = wrap_angle(gap[:, 1:])
        bend[s] = 0.5 * float(np.linalg.norm((sum(gaps) / problem.reading_sigmas)[problem.is_used_reading]))
    return bend
