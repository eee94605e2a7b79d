"""Steps of a network adjustment: start values, gross errors, least squares, estimated noise, datum."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.axes_point_tests import exclude_contradicting_axes_points
from ltsim.adjustment.datum import InnerConstraintDatum, move_to_datum, selected_datum_names
from ltsim.adjustment.prior import ParameterPrior
from ltsim.adjustment.problem import WEAK_EFFECT_PRIOR_FACTOR, NetworkProblem
from ltsim.adjustment.reference_snooping import snoop_references
from ltsim.adjustment.reference_tests import (
    TESTED_REFERENCE_KINDS,
    ReferenceTest,
    passes_global_test,
    requires_instrument_constants_for_points,
)
from ltsim.adjustment.reference_values import ReferenceKind
from ltsim.adjustment.significance import MIN_FAULTY_FRACTION_OF_GROUP
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
from ltsim.core.parallel import single_threaded
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE, SQRT_MACHINE_EPSILON
from ltsim.geometry.rigid import MIN_POINTS_FOR_POSE
from ltsim.physics.effects.linear_effect import LinearEffect
from ltsim.physics.model.construction import GeometricErrorModel, ideal_construction
from ltsim.physics.model.measurement import (
    MeasurementModel,
    NetworkState,
    smr_radius_offsets,
    with_spherical_earth_plumb_lines,
)
from ltsim.recordings.recording import Recording
from ltsim.solve.gauss_newton import Solution, solve


@raise_for_singular_network
@single_threaded
def adjust(
    recording: Recording,
    construction: GeometricErrorModel | None = None,
    *,
    start_state: NetworkState | None = None,
    effects: Sequence[LinearEffect] = (),
    sigma: Floats | None = None,
    reading_mask: Bools | None = None,
    datum_names: Sequence[str] | None = None,
    robust: bool = False,
    noise_grouping: NoiseGrouping | None = None,
    effect_prior_sigma: float = WEAK_EFFECT_PRIOR_FACTOR,
    prior: ParameterPrior | None = None,
    tested_reference_kinds: Collection[ReferenceKind] = TESTED_REFERENCE_KINDS,
) -> Adjustment:
    """Network adjustment of a recording, with or without a given start state.

    Poses, target coordinates, and the parameters of `construction` and `effects` are estimated. Gross errors of
    readings, and reference values that contradict the other observations, are excluded first, unless the adjustment
    starts at a given state.

    Parameters
    ----------
    recording : Recording
    construction : GeometricErrorModel, optional
        Geometric error model of the tracker; default: an ideal tracker without parameters.
    start_state : NetworkState, optional
        State at which the iterations start. With it, gross errors and wrong reference values are not tested. By default
        the start state is determined from the readings.
    effects : sequence of LinearEffect
        Additional effects whose parameters are estimated, with the weak prior of `effect_prior_sigma`.
    sigma : (n, 3) float, optional, [m, rad, rad]
        Standard deviations of the readings; default the declared noise.
    reading_mask : (n, 3) bool, optional
        Readings to use; default all.
    datum_names : sequence of str, optional
        Targets that define the datum by inner constraints; default those that `setup.toml` selects.
    robust : bool
        True to reject outliers by reweighting and data snooping. Each rejected reading is tested again at the end.
    noise_grouping : str, optional
        Groups of readings whose noise is estimated: ``observable`` (one group per observable), or ``instrument`` (one
        group per observable and instrument); the noise of the levels is estimated too. Default: no noise is estimated.
    effect_prior_sigma : float
        Standard deviation of the prior of each parameter of `effects`, divided by its plausible size. It bounds
        parameters that the readings hardly determine.
    prior : ParameterPrior, optional
        Prior of the instrument parameters; default that in `setup.toml`.
    tested_reference_kinds : collection of str
        Kinds of reference values (known points, lengths, levels) that are excluded if they contradict the other
        observations.

    Returns
    -------
    Adjustment
        Adjustment in the frame of the first station, unless control points, levels or a datum define another frame.
        Targets that the readings in use do not determine are omitted (`undetermined_targets`). An adjustment that did
        not converge is returned too; `solution.status` gives the reason.

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
    is_gross = np.zeros(len(recording), dtype=bool)
    is_unconnected = np.zeros(len(recording.targets), dtype=bool)
    is_screened = start_state is None
    if start_state is None:
        _, network, is_gross, is_unconnected = screen_gross_errors(recording)
        is_gross &= ~_is_over_wrong_mark(recording, is_gross)
        parameters = np.zeros((len(recording.instruments), built.n_parameters)) if prior is None else prior.mean
        start_state = NetworkState(*network, parameters)
    usable = np.broadcast_to(
        ((~is_gross | robust) & ~is_unconnected[recording.target])[:, None], recording.readings.shape
    )
    whole, start_state = _problem_and_start_state(
        MeasurementModel(recording, built, tuple(effects)),
        start_state,
        sigma,
        usable if reading_mask is None else usable & reading_mask,
        effect_prior_sigma,
        prior,
    )
    wrong: tuple[ReferenceTest, ...] = ()
    if is_screened and not robust:
        problem, solution, wrong = _without_wrong_references(whole, start_state, tested_reference_kinds)
    elif not robust:
        problem, solution = whole, solve(whole, start_state)
    else:
        if is_screened and not whole.has_no_references:
            used = whole.is_used_reading & ~is_gross[:, None] if is_gross.any() else whole.is_used_reading
            without_gross = replace(whole, is_used_reading=used)
            problem, solution, wrong = _without_wrong_references(without_gross, start_state, tested_reference_kinds)
            if wrong:
                whole, start_state = whole.with_model(problem.model), solution.x
        problem, solution = snoop_readings(whole, start_state)
    problem, solution, components = _with_estimated_noise(whole, problem, solution, noise_grouping, robust=robust)
    unconnected = tuple(recording.targets[i] for i in np.flatnonzero(is_unconnected))
    is_gross &= ~problem.is_used_reading.any(axis=1)
    adjustment = Adjustment(problem, solution, is_gross, components, unconnected, wrong, n_duplicate_rows=n_copied_rows)
    return _transform_to_datum(adjustment, datum_names)


def _problem_and_start_state(
    model: MeasurementModel,
    start_state: NetworkState,
    sigma: Floats | None,
    reading_mask: Bools,
    effect_prior_sigma: float,
    prior: ParameterPrior | None,
) -> tuple[NetworkProblem, NetworkState]:
    """Least-squares problem without undetermined targets, and its start state.

    The plumb lines of the stations in the model, and the positions of stations over marks, are computed from
    `start_state`; parameters of effects that it does not contain start at zero. The other arguments are those of
    `adjust`.
    """
    model = replace(model, recording=with_spherical_earth_plumb_lines(model.recording, start_state.station_positions))
    if len(start_state.extra_parameters) != model.n_extra_parameters:
        start_state = replace(start_state, extra_parameters=np.zeros(model.n_extra_parameters))
    problem = NetworkProblem.from_model(
        model, sigma=sigma, reading_mask=reading_mask, effect_prior_sigma=effect_prior_sigma, prior=prior
    )
    _require_fixed_smr_offsets(problem)
    positions = problem.marks.positions_on_marks(start_state.station_positions, start_state.target_points)
    start_state = replace(start_state, station_positions=positions)
    return drop_undetermined_targets(problem, start_state), start_state


def _without_wrong_references(
    problem: NetworkProblem, start_state: NetworkState, tested_reference_kinds: Collection[ReferenceKind]
) -> tuple[NetworkProblem, Solution[NetworkState], tuple[ReferenceTest, ...]]:
    """Problem without reference values that contradict the readings, its solution, and the tests of these values.

    During the tests the instrument constants (such as the range offset) are estimated if possible, because a wrong
    constant looks like a wrong length or point.
    """
    tested, tested_state = problem.with_instrument_constants(start_state)
    remaining, solution, wrong = snoop_references(tested, solve(tested, tested_state), tested_reference_kinds)
    if tested is problem and requires_instrument_constants_for_points(remaining, solution, wrong):
        with_shape_parameters, state = problem.with_instrument_constants(start_state, requires_length=False)
        snooped = snoop_references(with_shape_parameters, solve(with_shape_parameters, state), tested_reference_kinds)
        # Any misfit is a reason to try the constants; only a point that was excluded without them can become undecided.
        is_point_blamed = any(test.kind == "point" and test.is_excluded for test in wrong)
        is_undecided = is_point_blamed and any(test.indistinguishable_from for test in snooped[2])
        if passes_global_test(*snooped[:2]) or is_undecided:
            tested, (remaining, solution, wrong) = with_shape_parameters, snooped
    if tested is problem:
        return remaining, solution, wrong
    model = replace(problem.model, recording=remaining.model.recording)
    without_constants = problem.with_model(model) if wrong else problem
    state = replace(solution.x, instrument_parameters=start_state.instrument_parameters)
    return without_constants, solve(without_constants, state), wrong


def _with_estimated_noise(
    full_problem: NetworkProblem,
    problem: NetworkProblem,
    solution: Solution[NetworkState],
    noise_grouping: NoiseGrouping | None,
    *,
    robust: bool,
) -> tuple[NetworkProblem, Solution[NetworkState], tuple[VarianceComponent, ...]]:
    """Problem with estimated noise, its solution, and the variance components.

    `full_problem` contains all readings, `problem` does not contain outliers. With `robust` the outliers are searched
    again. If `noise_grouping` is None, problem and solution are returned unchanged, without variance components.
    """
    if noise_grouping is None:
        return problem, solution, ()
    find = snoop_readings if robust else _solve_without_outlier_search
    return estimate_variance_components(problem, solution, noise_grouping, find, full_problem.is_used_reading)


def _is_over_wrong_mark(recording: Recording, is_gross: Bools) -> Bools:
    """Flags (n,) of n pointings, True if the declared mark of the set-up may be wrong: most of its pointings are gross.

    `is_gross` (n,) flags the pointings with gross errors.
    """
    n_stations = len(recording.stations)
    has_mark = np.array([recording.station_setup(name).over is not None for name in recording.stations])
    share = np.bincount(recording.station, is_gross, n_stations) / np.bincount(recording.station, minlength=n_stations)
    return np.asarray((has_mark & (share > MIN_FAULTY_FRACTION_OF_GROUP))[recording.station])


def _require_fixed_smr_offsets(problem: NetworkProblem) -> None:
    """Check that the directions of the nest normals are determined if SMRs have several radii; raises NetworkError.

    SMRs of different radii have their centres at different heights over the nests, along the normals of the nests. If
    no observation fixes the rotation of the network, these directions are unknown.
    """
    offsets = smr_radius_offsets(problem.model.recording)
    if offsets is None:
        return
    rotated = np.cross(problem.free_motions[3:].T[:, None], offsets[None])
    if np.any(np.abs(rotated) > NORMAL_EQUATIONS_TOLERANCE * np.abs(offsets).max()):
        raise NetworkError(
            "SMRs of different radii have their centres at different heights over the nests, along the nest normals; "
            "the directions of these normals are unknown, because no observation fixes the rotation of the network; "
            "declare three known points (known_mm), or levels if all normals are vertical"
        )


def _solve_without_outlier_search(
    problem: NetworkProblem, start_state: NetworkState
) -> tuple[NetworkProblem, Solution[NetworkState]]:
    """The unchanged problem and its least-squares solution, without rejection of outliers."""
    return problem, solve(problem, start_state)


def _transform_to_datum(adjustment: Adjustment, datum_names: Sequence[str] | None) -> Adjustment:
    """Adjustment with state and covariances in the datum of the targets `datum_names`, by inner constraints.

    By default these are all determined targets that `setup.toml` selects for the datum. Targets that only define the
    axes are tested first, and contradicting targets are excluded from the datum.
    """
    problem, solution, lost = adjustment.problem, adjustment.solution, adjustment.undetermined_targets
    names = (
        [name for name in selected_datum_names(problem) if name not in lost]
        if datum_names is None
        else list(datum_names)
    )
    for name in datum_names or ():
        if name in lost:
            raise ModelError(f"the readings do not determine target {name} of the datum: omit it in `datum`")
    if not names or solution.factor is None or not problem.free_motions.shape[1]:
        return adjustment
    if adjustment.recording.setup.datum_source and datum_names is None and len(names) >= MIN_POINTS_FOR_POSE:
        fitted, tests = exclude_contradicting_axes_points(adjustment, names)
        problem = replace(problem, model=replace(problem.model, recording=fitted))
        adjustment, names = (
            replace(adjustment, problem=problem, axes_point_tests=tests),
            list(selected_datum_names(problem)),
        )
    state, turned = move_to_datum(problem, solution.x, names)
    solution = replace(solution, x=state)
    if turned > SQRT_MACHINE_EPSILON:  # the factorisation belongs to the frame before the rotation
        again = solve(problem, state)
        solution = replace(again, n_iterations=solution.n_iterations, status=solution.status)
    datum = (
        None if solution.factor is None else InnerConstraintDatum.from_points(problem, state, solution.factor, names)
    )
    return replace(adjustment, solution=solution, datum=datum)
