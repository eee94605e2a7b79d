"""Network adjustment of a recording: start values, gross errors, least squares, noise, datum."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.datum import InnerDatum, motions_about_centre, move_to_datum, selected_datum_names
from ltsim.adjustment.frame import alignment_distances
from ltsim.adjustment.prior import ParameterPrior
from ltsim.adjustment.problem import WEAK_PRIOR_FACTOR, NetworkProblem
from ltsim.adjustment.reference_snooping import snoop_references
from ltsim.adjustment.reference_tests import (
    TESTED_REFERENCE_KINDS,
    ReferenceTest,
    passes_global_test,
    requires_instrument_constants_for_points,
)
from ltsim.adjustment.reference_values import ReferenceKind
from ltsim.adjustment.reliability import noise_factor
from ltsim.adjustment.significance import (
    FAMILY_WISE_LEVEL,
    MAX_TRACKER_ERROR,
    MIN_CLEAR_SIGMAS,
    MIN_FAULTY_FRACTION_OF_GROUP,
    MIN_MISFIT_RATIO,
)
from ltsim.adjustment.snooping import (
    drop_undetermined_targets,
    screen_gross_errors,
    snoop_readings,
    without_copied_rows,
)
from ltsim.adjustment.stochastic_model import NoiseGrouping, VarianceComponent, estimate_variance_components
from ltsim.adjustment.structure import raise_for_singular_network
from ltsim.core.arrays import Bools, Floats
from ltsim.core.errors import ModelError, NetworkError
from ltsim.core.limits import MAX_ADJUSTED_POINTINGS, MAX_ADJUSTED_TARGETS
from ltsim.core.rounding import MAX_ROUNDING_ERROR, MAX_SOLUTION_ROUNDING_ERROR
from ltsim.core.units import MILLIMETRE
from ltsim.geometry.rigid import MIN_RIGID_POINTS, align_robustly, rigid_motion_design
from ltsim.physics.effects.linear_effect import LinearEffect
from ltsim.physics.model.construction import GeometricErrorModel, ideal_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState, smr_radius_offsets, with_plumb_lines
from ltsim.recordings.recording import Recording
from ltsim.solve.gauss_newton import Solution, solve
from ltsim.solve.threads import single_threaded


@raise_for_singular_network
@single_threaded
def adjust(
    recording: Recording,
    construction: GeometricErrorModel | None = None,
    *,
    effects: Sequence[LinearEffect] = (),
    sigma: Floats | None = None,
    reading_mask: Bools | None = None,
    start_state: NetworkState | None = None,
    datum_names: Sequence[str] | None = None,
    robust: bool = False,
    noise_grouping: NoiseGrouping | None = None,
    effect_prior_sigma: float = WEAK_PRIOR_FACTOR,
    prior: ParameterPrior | None = None,
    tested_reference_kinds: Collection[ReferenceKind] = TESTED_REFERENCE_KINDS,
) -> Adjustment:
    """Network adjustment: targets, poses, and the parameters of `construction` and `effects`.

    Parameters
    ----------
    recording : Recording
    construction : GeometricErrorModel, optional
        Default: an ideal tracker without parameters.
    effects : sequence of LinearEffect
        Additional effects whose parameters are estimated, with the weak prior of `effect_prior_sigma`.
    sigma : (n, 3) float, optional, [m, rad, rad]
        Standard deviations of the readings; default the declared noise.
    reading_mask : (n, 3) bool, optional
        Readings to use; default all.
    start_state : NetworkState, optional
        State from which the adjustment starts; default from the recording alone. With a start state no pointing is
        rejected before the adjustment.
    datum_names : sequence of str, optional
        Targets that define the datum by inner constraints; default those that the set-up selects.
    robust : bool
        Rejection of outliers by reweighting and data snooping. Each rejected reading is tested again at the end.
    noise_grouping : str, optional
        Groups of readings whose noise is estimated: each ``observable``, or each observable of each ``instrument``; the
        noise of the levels is estimated too. Default: no noise is estimated.
    effect_prior_sigma : float
        Standard deviation of a prior on each parameter of `effects`, in units of its plausible size. It limits
        parameters that the readings hardly determine.
    prior : ParameterPrior, optional
        Prior of the instrument parameters; default that of the set-up.
    tested_reference_kinds : collection of str
        Kinds of reference values that are excluded if they contradict the other observations; none is excluded with a
        `start_state`.

    Returns
    -------
    Adjustment
        Adjustment in the frame of the first station, unless control points, levels or a datum define another one.
        Targets that the readings in use do not determine are omitted (`undetermined_targets`). An adjustment that did
        not converge is returned, and its solution has the status.

    Raises
    ------
    NetworkError
        When a station is not connected to the network, when a station measures the target that it stands on, when SMRs
        have several radii and no observation fixes the frame of the normals of their nests, or when there are more than
        `MAX_ADJUSTED_POINTINGS` pointings.
    ModelError
        When `datum_names` contains an unknown or undetermined target, or targets that do not fix the free motions.
    """
    recording.require_at_most(MAX_ADJUSTED_POINTINGS, MAX_ADJUSTED_TARGETS, "an adjustment")
    built = construction or ideal_construction()
    recording, n_copied_rows = without_copied_rows(recording)
    gross, lost = np.zeros(len(recording), dtype=bool), np.zeros(len(recording.targets), dtype=bool)
    needs_start = start_state is None
    if start_state is None:
        _, network, gross, lost = screen_gross_errors(recording)
        gross &= ~_is_over_wrong_mark(recording, gross)
        parameters = np.zeros((len(recording.instruments), built.n_parameters)) if prior is None else prior.mean
        start_state = NetworkState(*network, parameters)
    recording = with_plumb_lines(recording, start_state.station_positions)
    measurement_model = MeasurementModel(recording, built, tuple(effects))
    if len(start_state.extra_parameters) != measurement_model.n_extra_parameters:
        start_state = replace(start_state, extra_parameters=np.zeros(measurement_model.n_extra_parameters))
    keep = np.broadcast_to(((~gross | robust) & ~lost[recording.target])[:, None], recording.readings.shape)
    mask = keep if reading_mask is None else keep & reading_mask
    find = snoop_readings if robust else _solve
    whole = NetworkProblem.from_model(
        measurement_model, sigma=sigma, reading_mask=mask, effect_prior_sigma=effect_prior_sigma, prior=prior
    )
    _require_fixed_smr_offsets(whole)
    start_state = replace(
        start_state,
        station_positions=whole.marks.positions_on_marks(start_state.station_positions, start_state.target_points),
    )
    whole = drop_undetermined_targets(whole, start_state)
    wrong: tuple[ReferenceTest, ...] = ()
    if needs_start and not (robust and whole.has_no_references):
        sound = (
            replace(whole, is_used_reading=whole.is_used_reading & ~gross[:, None]) if robust and gross.any() else whole
        )
        tested, tested_state = sound.with_instrument_constants(start_state)
        problem, solution, wrong = snoop_references(tested, solve(tested, tested_state), tested_reference_kinds)
        if tested is sound and requires_instrument_constants_for_points(problem, solution):
            with_constants, state = sound.with_instrument_constants(start_state, requires_length=False)
            snooped = snoop_references(with_constants, solve(with_constants, state), tested_reference_kinds)
            if passes_global_test(*snooped[:2]):
                tested, (problem, solution, wrong) = with_constants, snooped
        if tested is not sound:
            problem = (
                sound.with_model(replace(measurement_model, recording=problem.model.recording)) if wrong else sound
            )
            state = replace(solution.x, instrument_parameters=start_state.instrument_parameters)
            solution = solve(problem, state)
        measurement_model = problem.model
    if wrong and robust:
        whole, start_state = whole.with_model(measurement_model), solution.x
    if robust or not needs_start:
        problem, solution = find(whole, start_state)
    components: tuple[VarianceComponent, ...] = ()
    if noise_grouping is not None:
        problem, solution, components = estimate_variance_components(
            problem, solution, noise_grouping, find, whole.is_used_reading
        )
    unconnected = tuple(recording.targets[i] for i in np.flatnonzero(lost))
    gross &= ~problem.is_used_reading.any(axis=1)
    adjustment = Adjustment(problem, solution, gross, components, unconnected, wrong, n_duplicate_rows=n_copied_rows)
    return _transform_to_datum(adjustment, datum_names)


def _is_over_wrong_mark(recording: Recording, is_gross: Bools) -> Bools:
    """Flags (n,) of those of n pointings that are from set-ups whose declared mark may be wrong.

    Most pointings of such a set-up have gross errors; `is_gross` (n,) flags the pointings with gross errors.
    """
    n_stations = len(recording.stations)
    has_mark = np.array([recording.station_setup(name).over is not None for name in recording.stations])
    share = np.bincount(recording.station, is_gross, n_stations) / np.bincount(recording.station, minlength=n_stations)
    return np.asarray((has_mark & (share > MIN_FAULTY_FRACTION_OF_GROUP))[recording.station])


def _require_fixed_smr_offsets(problem: NetworkProblem) -> None:
    """Check that no undetermined rotation of the network changes the offsets of SMRs; raises NetworkError.

    Such offsets along the normals of nests exist if the SMRs have several radii.
    """
    offsets = smr_radius_offsets(problem.model.recording)
    if offsets is None:
        return
    rotated = np.cross(problem.free_motions[3:].T[:, None], offsets[None])
    if np.any(np.abs(rotated) > MAX_SOLUTION_ROUNDING_ERROR * np.abs(offsets).max()):
        raise NetworkError(
            "the centres of SMRs with different radii lie at different heights over their nests, along the normals of "
            "the nests; no observation fixes the rotation of the network, so the directions of the normals are "
            "unknown; declare three known points (known_mm), or levels if all normals are vertical"
        )


def _solve(problem: NetworkProblem, start_state: NetworkState) -> tuple[NetworkProblem, Solution[NetworkState]]:
    """Problem, unchanged, and its least-squares solution without a rejection of outliers."""
    return problem, solve(problem, start_state)


def _transform_to_datum(adjustment: Adjustment, datum_names: Sequence[str] | None) -> Adjustment:
    """Adjustment with state and covariances in the datum of selected targets.

    The targets are `datum_names`, by default all determined targets that the set-up selects for the datum. Targets that
    only define the axes are tested first, and contradicting targets are excluded.
    """
    problem, solution, lost = adjustment.problem, adjustment.solution, adjustment.undetermined_targets
    names = (
        [name for name in selected_datum_names(problem) if name not in lost]
        if datum_names is None
        else list(datum_names)
    )
    for name in datum_names or ():
        if name in lost:
            raise ModelError(f"the readings do not determine target {name} of the datum: remove it from the datum")
    if not names or solution.factor is None or not problem.free_motions.shape[1]:
        return adjustment
    if adjustment.recording.setup.datum_source and datum_names is None and len(names) >= MIN_RIGID_POINTS:
        fitted, tests = exclude_contradicting_axes_points(adjustment, names)
        problem = replace(problem, model=replace(problem.model, recording=fitted))
        adjustment, names = (
            replace(adjustment, problem=problem, axes_point_tests=tests),
            list(selected_datum_names(problem)),
        )
    state, turned = move_to_datum(problem, solution.x, names)
    solution = replace(solution, x=state)
    if turned > MAX_ROUNDING_ERROR:  # the factorisation belongs to the frame before the rotation
        again = solve(problem, state)
        solution = replace(again, n_iterations=solution.n_iterations, status=solution.status)
    datum = None if solution.factor is None else InnerDatum.from_points(problem, state, solution.factor, names)
    return replace(adjustment, solution=solution, datum=datum)


def exclude_contradicting_axes_points(
    adjustment: Adjustment, names: Sequence[str]
) -> tuple[Recording, tuple[ReferenceTest, ...]]:
    """Recording whose datum consists of the points with consistent declared coordinates, and the test of each point.

    `names` are the points that define the axes. Each point is tested against the other points: its misclosure in their
    axes is compared with the uncertainty of the network at this point, multiplied by the `noise_factor` of the fit, and
    with the scatter of the other points. A contradicting point is excluded. If the other points alone do not determine
    the axes, the point remains, with its coordinates corrected by the estimated error.
    """
    recording = adjustment.recording
    declared_points = (
        np.array([recording.target_setup(name).approximate_mm for name in names], dtype=np.float64) * MILLIMETRE
    )
    adjusted_points = adjustment.state.target_points[[recording.targets.index(name) for name in names]]
    deviations = alignment_distances(adjusted_points, declared_points, align_robustly(adjusted_points, declared_points))
    use = deviations <= max(MIN_MISFIT_RATIO * float(np.median(deviations)), MAX_TRACKER_ERROR)
    use |= use.sum() <= len(names) / 2
    factor = noise_factor(adjustment.problem, adjustment.solution)
    for _ in range(2 * len(names)):
        tests = _axes_point_tests(adjustment, names, declared_points, use, factor)
        ratio = np.array([test.normalised_error / test.critical_value for test in tests])
        if (~use & (ratio <= 1.0)).any():
            k = int(np.argmin(np.where(use, np.inf, ratio)))
        elif (use & (ratio > 1.0)).any():
            k = int(np.argmax(np.where(use, ratio, 0.0)))
        else:
            break
        if use[k] and use.sum() <= MIN_RIGID_POINTS:
            tests[k] = replace(tests[k], is_excluded=True)
            declared_points[k] -= tests[k].error
            break
        use = use ^ (np.arange(len(names)) == k)
    targets = dict(recording.setup.targets)
    for name, used, place in zip(names, use, declared_points / MILLIMETRE, strict=True):
        targets[name] = targets[name].model_copy(update={"datum": bool(used), "approximate_mm": tuple(place.tolist())})
    return recording.replace(setup=recording.setup.model_copy(update={"targets": targets})), tuple(tests)


def _axes_point_tests(
    adjustment: Adjustment, names: Sequence[str], declared_points: Floats, used_mask: Bools, factor: float
) -> list[ReferenceTest]:
    """Tests of k points with declared coordinates (k, 3) [m], each against the points that `used_mask` (k,) flags.

    The standard deviations of the network are multiplied by `factor`.
    """
    chosen = [name for name, used in zip(names, used_mask, strict=True) if used]
    datum_adjustment = adjustment.with_inner_datum(chosen)
    indices = [datum_adjustment.recording.targets.index(name) for name in names]
    state, _ = move_to_datum(datum_adjustment.problem, datum_adjustment.state, chosen)
    turn = state.station_rotations[0] @ datum_adjustment.state.station_rotations[0].T
    covariance = factor**2 * turn @ datum_adjustment.target_covariance[indices] @ turn.T
    gap, places = declared_points - state.target_points[indices], state.target_points[indices]
    centre = places[used_mask].mean(axis=0)
    motions = motions_about_centre(datum_adjustment.problem.free_motions, centre)
    motion = (rigid_motion_design(places, centre) @ motions).reshape(-1, 3, motions.shape[1])
    leverages = motion @ np.linalg.inv(np.linalg.qr(motion[used_mask].reshape(-1, motion.shape[2]))[1])
    hat_blocks = leverages @ np.swapaxes(leverages, 1, 2)
    square = float(np.sum(gap[used_mask] ** 2)) - float(np.trace(covariance[used_mask].sum(axis=0)))
    test_values = square, 3 * int(used_mask.sum()) - motion.shape[2], FAMILY_WISE_LEVEL / len(names)
    return [
        _axes_point_test(
            name, gap[k], covariance[k], hat_blocks[k], is_used=bool(used_mask[k]), scatter_dof_and_level=test_values
        )
        for k, name in enumerate(names)
    ]


def _axes_point_test(
    target_name: str,
    misclosure: Floats,
    covariance: Floats,
    hat_block: Floats,
    *,
    is_used: bool,
    scatter_dof_and_level: tuple[float, int, float],
) -> ReferenceTest:
    """Test of one of the points that define the axes.

    `misclosure` (3,) [m] is declared minus adjusted coordinates, `covariance` (3, 3) [m^2] the covariance of the
    latter. `hat_block` (3, 3) is the block of the hat matrix of the alignment for this point. The misclosure of a point
    in use is (1 - `hat_block`) times its error; that of an excluded point is its full error. `scatter_dof_and_level`
    contains the sum of squared misclosures of the points in use, its degrees of freedom, and the significance level of
    this test.
    """
    share, turned = np.linalg.eigh(np.eye(3) - hat_block if is_used else np.eye(3) + hat_block)
    is_checked = share > MAX_SOLUTION_ROUNDING_ERROR
    turned, share = turned[:, is_checked], share[is_checked]
    redundancy = share if is_used else np.ones(len(share))
    square, dof, level = scatter_dof_and_level
    error = turned.T @ misclosure / redundancy
    if is_used:
        square, dof = square - float(share @ error**2) + float(np.trace(covariance)), dof - len(share)
    variance_factor = max(square, 0.0) / max(dof, 1)
    network = (turned.T @ covariance @ turned) / np.outer(redundancy, redundancy)
    spread = network + np.diag(variance_factor / share if is_used else variance_factor * share)
    limit = len(share) * special.fdtri(len(share), max(dof, 1), 1.0 - level)
    return ReferenceTest(
        kind="axes",
        name=target_name,
        declared_components="xyz",
        sigma=np.sqrt(np.diag(covariance) + variance_factor),
        residual=misclosure,
        error=turned @ error,
        sigma_error=np.sqrt(np.einsum("ik,kl,il->i", turned, spread, turned)),
        chi2_drop=float(error @ np.linalg.solve(spread, error)),
        rank=len(share),
        is_excluded=not is_used,
        critical_value=max(MIN_CLEAR_SIGMAS, float(np.sqrt(limit))),
    )
