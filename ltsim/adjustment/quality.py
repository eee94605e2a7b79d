"""Quality of an adjusted network: conditions under which it is unusable, and warnings that precede all results."""

from collections.abc import Iterator

import numpy as np
from scipy.spatial import KDTree

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.blunders import CLOSE, correct_units, detect_blunders
from ltsim.adjustment.centring import centring_errors
from ltsim.adjustment.estimate import adjust
from ltsim.adjustment.frame import ROUGH_PLACE, Frame, misses, upright_alignment
from ltsim.adjustment.reference_values import without_coordinates
from ltsim.adjustment.significance import MAJORITY
from ltsim.adjustment.station_motions import motion_sentences
from ltsim.core.arrays import Bools, Floats
from ltsim.core.errors import LtsimError, NetworkError
from ltsim.core.notation import listing
from ltsim.core.units import MILLIMETRE
from ltsim.geometry.alignment import align
from ltsim.geometry.polar import wrap
from ltsim.recordings.transcription_errors import GON, UNIT_ERRORS, TranscriptionError

FITS = 0.1
"""Fraction of unused pointings below which another unit of the readings counts as correct."""
CONTRADICTION = 100.0
"""Limit of sigma0 above which readings contradict each other and linearised covariances are meaningless."""
HEALED = 0.1
"""Ratio of sigma0 without and with the known points below which the known points are the contradiction."""
MOST_NAMED = 4
"""Largest number of sentences of one kind."""
LEAST_PLACES = 3
"""Smallest number of station positions on a plan from which a mirror image is recognised."""
FAR = 0.01
"""Misclosure of approximate positions that is accepted, relative to the extent of the network."""
CLEARLY = 0.3
"""Ratio of the misclosures below which the mirror image fits clearly better."""
UPRIGHT = 0.9
"""Cosine of the stations' median tilt above which a plan is compared with the network."""
BENT = 0.3
"""Curvature (Bates and Watts) [sigmas of a reading] above which linearised standard deviations are unreliable."""
STRAIGHT = 0.03
"""Upper bound of the curvature below which it is not computed for a station."""
SLIPS = (
    *(slip for slip in UNIT_ERRORS if slip.name in ("gon", "metre", "inch", "clockwise", "zenith")),
    TranscriptionError("degree", "degrees", "gon", ((1, 1.0 / GON, 0.0), (2, 1.0 / GON, 0.0))),
)
"""Errors of unit or convention of a whole file that are tried; those that shrink lengths are excluded, because any
network then seems to fit.
"""


def require_usable(adjustment: Adjustment) -> None:
    """Check that most pointings are used and that known points are consistent; raises NetworkError.

    Raises ConvergenceError if there is no solution.
    """
    _require_consistent_units(adjustment)
    adjustment.require_solution()
    _require_consistent_control(adjustment)
    unused = _unused(adjustment)
    lost = unused.sum() > MAJORITY * len(unused)
    fits = _unit_that_fits(adjustment) if lost or adjustment.sigma0 > CONTRADICTION else ""
    if lost or fits:
        out = f"{unused.sum()} of {len(unused)} pointings would be left out"
        what = out if lost else f"sigma0 is {adjustment.sigma0:.3g}"
        cure = f"they fit as {fits}" if fits else "check units, sense of the angles and names"
        raise NetworkError(f"the readings contradict each other ({what}): {cure}")


def _require_consistent_units(adjustment: Adjustment) -> None:
    """Check that no set-up is in another unit or sense than the others; raises NetworkError."""
    thin = next(_thin_stations(adjustment), "")
    if thin or not adjustment.solution.converged or adjustment.sigma0 > CONTRADICTION:
        sentences = [finding.sentence.rstrip(".") for finding in correct_units(adjustment.recording)[1]]
        if sentences:
            first_sentences = "; ".join(sentences[:MOST_NAMED])
            raise NetworkError(f"{first_sentences}: read the recording again in that unit or convention")


def _require_consistent_control(adjustment: Adjustment) -> None:
    """Check that the known points are not the cause of all contradictions; raises NetworkError."""
    control, recording = adjustment.problem.control, adjustment.recording
    if not (adjustment.sigma0 > CONTRADICTION and len(control)):
        return
    try:
        alone = adjust(without_coordinates(recording), adjustment.construction, prior=adjustment.problem.prior)
    except LtsimError:
        return
    if not (alone.solution.converged and alone.sigma0 < HEALED * adjustment.sigma0):
        return
    gap = 1e3 * float(np.abs(adjustment.state.target_points[control.target] - control.points).max())
    whole = control.axes.all(axis=1)
    raise NetworkError(
        f"the known points contradict the readings (sigma0 {adjustment.sigma0:.3g}, without them {alone.sigma0:.3g}; "
        f"largest miss {gap:.3g} mm): {_how(alone.state.target_points[control.target[whole]], control.points[whole])}"
    )


def _how(here: Floats, there: Floats) -> str:
    """Text on the difference of control points (k, 3) `there` from the network `here`: scale, mirror image, points."""
    spread = [float(np.sqrt(np.sum((x - x.mean(axis=0)) ** 2))) for x in (here, there)]
    if len(here) < 3 or not spread[0] > 0.0:
        return "check their coordinates"
    if spread[1] < 1e-6 * spread[0]:
        return "all of them coincide"
    scale, mirrored = spread[1] / spread[0], "check the order and the signs of their axes, or the sense of the azimuths"
    ways = {
        f"they fit scaled by {1 / scale:.6g}; check their unit": _miss(here * scale, there),
        f"they fit mirrored; {mirrored}": _miss(-here, there),
    }
    best = min(ways, key=lambda way: ways[way])
    return best if ways[best] < HEALED * _miss(here, there) else "check their coordinates and names"


def _miss(source: Floats, goal: Floats) -> float:
    """Root sum of squares [m] after a rigid fit."""
    try:
        return float(np.linalg.norm(misses(source, goal, align(source, goal))))
    except NetworkError:
        return float("inf")


def _unused(adjustment: Adjustment) -> Bools:
    """Flags (m,) of the measured pointings without a used reading."""
    measured, used = np.asarray(adjustment.recording.measured.any(axis=1)), adjustment.problem.use.any(axis=1)
    return ~np.asarray(used)[measured]


def _unit_that_fits(adjustment: Adjustment) -> str:
    """Unit that makes the readings consistent, as `gon, not degrees`; empty if there is none."""
    recording, most = adjustment.recording, CONTRADICTION
    if adjustment.sigma0 > CONTRADICTION:
        most = HEALED * adjustment.sigma0
    for slip in SLIPS:
        try:
            adjusted = adjust(recording.with_readings(slip.corrected(recording.readings)))
        except LtsimError:
            continue
        if adjusted.solution.converged and adjusted.sigma0 < most and _unused(adjusted).mean() < FITS:
            return f"{slip.content}, not {slip.expected}"
    return ""


# --- in doubt -----------------------------------------------------------------------------------------------------


def warnings_of(adjustment: Adjustment) -> tuple[str, ...]:
    """Warnings: undecidable contradictions, blunders, stations with few readings, unreliable standard deviations."""
    slips = _undecided, _mistakes, _two_names, _tripods
    kinds = _causes, _references, _motions, _plan, *slips, _thin_stations, _uncertain_figures, _copies
    return tuple(doubt for kind in kinds for doubt in kind(adjustment))


def network_warnings(adjustment: Adjustment) -> tuple[str, ...]:
    """Warnings on the network as a whole, not on single reference values or blunders."""
    kinds = _plan, _undecided, _thin_stations, _uncertain_figures
    return tuple(doubt for kind in kinds for doubt in kind(adjustment))


def _references(adjustment: Adjustment) -> Iterator[str]:
    """Sentences on reference values that contradict the other observations."""
    every = (*adjustment.rejected_references, *adjustment.axis_tests)
    sentences = [
        test.sentence for test in every if test.excluded or test.indistinguishable_from or test.kind == "scale"
    ]
    yield from sentences[:MOST_NAMED]
    if len(sentences) > MOST_NAMED:
        yield f"{len(sentences) - MOST_NAMED} more reference values contradict the other observations"


def _causes(adjustment: Adjustment) -> Iterator[str]:
    """Sentences on simple causes in the model."""
    yield from (sentence.rstrip(".") for sentence in adjustment.causes)


def _motions(adjustment: Adjustment) -> Iterator[str]:
    """Sentences on stations that move while they measure."""
    yield from () if adjustment.causes else (sentence for _, sentence in motion_sentences(adjustment))


def _plan(adjustment: Adjustment) -> Iterator[str]:
    """Sentences on approximate positions of upright stations that do not fit the network, or only its mirror image."""
    frame, state = Frame.of(adjustment.recording), adjustment.state
    planned = np.flatnonzero(np.isfinite(frame.plan).all(axis=1))
    if len(planned) < LEAST_PLACES or np.median(state.station_rotations[:, 2, 2]) < UPRIGHT:
        return
    here, there = state.station_positions[planned] * [1.0, 1.0, 0.0], frame.plan[planned] * [1.0, 1.0, 0.0]
    extent = float(np.ptp(here, axis=0).max())
    if extent < ROUGH_PLACE:  # set-ups over one mark
        return
    as_is, mirrored = (
        float(misses(places, there, upright_alignment(places, there)).max())
        for places in (here, here * [1.0, -1.0, 1.0])
    )
    if as_is < max(ROUGH_PLACE, FAR * extent):
        return
    names = listing([adjustment.recording.stations[s] for s in planned])
    if mirrored < min(ROUGH_PLACE, CLEARLY * as_is):
        yield (
            f"the declared places of stations {names} fit the mirror image of this network (within {mirrored:.2g} m; "
            f"as it is {as_is:.2g} m): the azimuths may be clockwise, and all coordinates mirrored"
        )
    else:
        yield f"the declared places of the stations {names} miss the network by up to {as_is:.2g} m and were not used"


def _undecided(adjustment: Adjustment) -> Iterator[str]:
    """Sentences on targets that two stations measure, one or both of which were rejected."""
    recording = adjustment.recording
    measured_pairs, used_pairs = np.zeros((2, len(recording.stations), len(recording.targets)), dtype=bool)
    for table, readings in ((measured_pairs, recording.measured), (used_pairs, adjustment.problem.use)):
        rows = readings.any(axis=1)
        table[recording.station[rows], recording.target[rows]] = True
    two = measured_pairs.sum(axis=0) == 2
    ends = {1: "its coordinates are those of one of them", 0: "the target has no coordinates"}
    for stations, end in ends.items():
        names = [recording.targets[t] for t in np.flatnonzero(two & (used_pairs.sum(axis=0) == stations))]
        if names:
            contradiction = "the positions from two stations differ and the data do not show which one is right"
            yield f"{listing(names)}: {contradiction}; {end}"


def _mistakes(adjustment: Adjustment) -> Iterator[str]:
    """Sentences on blunders that explain the rejected pointings: exchanged reflectors, wrong units, wrong faces."""
    sentences = [finding.sentence.rstrip(".") for finding, *_ in detect_blunders(adjustment)]
    if sentences:
        more = f"; {len(sentences) - MOST_NAMED} more such mistakes" if len(sentences) > MOST_NAMED else ""
        yield f"{'; '.join(sentences[:MOST_NAMED])}{more}: these pointings are not used; ltsim diagnose corrects them"


def _two_names(adjustment: Adjustment) -> Iterator[str]:
    """Sentences on two targets at one position that no set-up measures both, possibly one target under two names."""
    recording, points = adjustment.recording, adjustment.state.target_points
    is_sighted = np.zeros((len(recording.targets), len(recording.stations)), dtype=bool)
    placed = adjustment.problem.use.all(axis=1)
    is_sighted[recording.target[placed], recording.station[placed]] = True
    placed_targets = np.flatnonzero(is_sighted.any(axis=1))
    for a, b in KDTree(points[placed_targets]).query_pairs(CLOSE, output_type="ndarray"):
        first, second = placed_targets[[a, b]]
        if not (is_sighted[first] & is_sighted[second]).any():
            gap = float(np.linalg.norm(points[first] - points[second])) / MILLIMETRE
            names = f"{recording.targets[first]} and {recording.targets[second]}"
            yield f"{names} lie within {gap:.2g} mm and no set-up sees both: they may be one target under two names"


def _tripods(adjustment: Adjustment) -> Iterator[str]:
    moved = centring_errors(adjustment)
    if moved is not None:
        yield moved.sentence


def _thin_stations(adjustment: Adjustment) -> Iterator[str]:
    """Sentences on stations that lost most of their pointings."""
    recording, measured = adjustment.recording, adjustment.recording.measured.any(axis=1)
    count = len(recording.stations)
    whole = np.bincount(recording.station[measured], minlength=count)
    used = np.bincount(recording.station[adjustment.problem.use.any(axis=1)], minlength=count)
    for s in np.flatnonzero((used > 0) & (used < MAJORITY * whole)):
        yield (
            f"station {recording.stations[s]} has {used[s]} of its {whole[s]} pointings in use: its position is "
            "uncertain; check its names, units and sense of azimuth"
        )


def _uncertain_figures(adjustment: Adjustment) -> Iterator[str]:
    """Sentences on fixed or nonlinear poses, and on a sum of squares without meaning."""
    if adjustment.undetermined_stations:
        yield (
            "the readings in use do not determine the full pose of station "
            f"{listing(adjustment.undetermined_stations)}: the undetermined components have no standard deviation"
        )
    bend = np.nan_to_num(curvature(adjustment)) if adjustment.solution.converged else np.zeros(0)
    bent = [adjustment.recording.stations[s] for s in np.flatnonzero(bend > BENT)]
    if bent:
        yield (
            f"the targets of station {listing(bent)} "
            "hardly determine its pose, so that its standard deviations (a linear approximation) are too small "
            f"(curvature {bend.max():.2g}, trustworthy below {BENT:g}): add targets far apart and not on one line"
        )
    if adjustment.sigma0 > CONTRADICTION:
        yield (
            f"sigma0 is {adjustment.sigma0:.3g}: readings, lengths and known points contradict each other, and the "
            "standard deviations are not valid"
        )


def _copies(adjustment: Adjustment) -> Iterator[str]:
    if adjustment.duplicate_rows:
        yield f"{adjustment.duplicate_rows} rows repeat others to the last digit: each is used once"


def curvature(adjustment: Adjustment) -> Floats:
    """Curvature (S,) of all readings over one standard deviation of each pose, along its least determined direction.

    A covariance is valid if readings are linear over the region that it describes. The pose of a station whose targets
    are nearly collinear, or close together and far away, may be too uncertain for that. With f the whitened readings
    and v a step of one standard deviation of the network, the curvature is |f(x + v) - 2 f(x) + f(x - v)| / 2. It is
    zero for a well-determined pose and NaN for a fixed one.

    References
    ----------
    Bates and Watts, Nonlinear Regression Analysis and Its Applications (1988), 7.1: relative curvature, here of the
    parameters as they are and of the expectation surface together.
    """
    problem, state, spread = adjustment.problem, adjustment.state, adjustment.pose_covariance
    range_, station = adjustment.sightings.range_, adjustment.recording.station
    across = problem.sigma * np.stack([np.ones_like(range_), range_, range_], axis=1)
    finest = np.min(np.where(problem.use, across, np.inf), axis=1)
    steepest, has_readings = np.zeros(len(spread)), np.isfinite(finest)
    np.maximum.at(steepest, station[has_readings], (range_ / finest)[has_readings])
    bend = np.where(np.isnan(spread).any(axis=(1, 2)), np.nan, 0.0)
    turn = np.trace(np.nan_to_num(spread)[:, 3:, 3:], axis1=1, axis2=2)
    for s in np.flatnonzero((0.5 * turn * steepest > STRAIGHT) & ~np.isnan(bend)):
        columns, size = problem.unknowns.pose[s], np.sqrt(np.diag(spread[s]))
        worst = np.linalg.eigh(spread[s] / np.outer(size, size))[1][:, -1] / size
        direction = np.zeros((problem.unknowns.size, 1))
        direction[columns, 0] = worst
        carried = adjustment.factor.covariance_columns(direction)[:, 0]
        step = carried / np.sqrt(carried[columns] @ worst)
        gaps = [problem.model.predict(problem.retract(state, sign * step)) for sign in (1.0, -1.0)]
        gaps = [gap - problem.model.predict(state) for gap in gaps]
        for gap in gaps:
            gap[:, 1:] = wrap(gap[:, 1:])
        bend[s] = 0.5 * float(np.linalg.norm((sum(gaps) / problem.sigma)[problem.use]))
    return bend
