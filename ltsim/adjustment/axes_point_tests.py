"""Tests of the points with declared coordinates that define the axes of a network, each against the other points."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.datum import motions_about_centre, move_to_datum, selected_datum_names
from ltsim.adjustment.frame import alignment_distances
from ltsim.adjustment.reference_tests import ReferenceTest, length_sigma
from ltsim.adjustment.reliability import noise_factor
from ltsim.adjustment.significance import (
    FAMILY_WISE_LEVEL,
    MAX_TRACKER_ERROR,
    MIN_CERTAIN_ERROR_SIGMAS,
    MIN_MISFIT_RATIO,
)
from ltsim.core.arrays import Bools, Floats
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE
from ltsim.core.units import MILLIMETRE
from ltsim.geometry.rigid import MIN_POINTS_FOR_POSE, align_robustly, rigid_motion_jacobian
from ltsim.recordings.recording import Recording


def exclude_contradicting_axes_points(
    adjustment: Adjustment, names: Sequence[str]
) -> tuple[Recording, tuple[ReferenceTest, ...]]:
    """Recording without contradicting points in its datum, and the test of each point that defines the axes, `names`.

    The other points define axes in which the misclosure of a point is computed. The misclosure is compared with the
    uncertainty of the network (for the estimated noise, if it is larger than declared) and with the scatter of the
    other points. A contradicting point is excluded from the datum. If the other points alone do not determine the axes,
    the point remains, and its declared coordinates are corrected by the estimated error.
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
        if use[k] and use.sum() <= MIN_POINTS_FOR_POSE:
            tests[k] = replace(tests[k], is_excluded=True)
            declared_points[k] -= tests[k].error
            break
        use = use ^ (np.arange(len(names)) == k)
    targets = dict(recording.setup.targets)
    for name, used, place in zip(names, use, declared_points / MILLIMETRE, strict=True):
        targets[name] = targets[name].model_copy(update={"datum": bool(used), "approximate_mm": tuple(place.tolist())})
    return recording.replace(setup=recording.setup.model_copy(update={"targets": targets})), tuple(tests)


def axes_point_tests_with_declared_points(
    adjustment: Adjustment, declared_recording: Recording
) -> tuple[ReferenceTest, ...]:
    """Tests of all points that define the axes in `declared_recording`, with identified errors in the model.

    An earlier adjustment without these errors in its model may have excluded right points. All points are therefore
    tested again. The result is empty if no declared points define the axes.
    """
    declared, recording = declared_recording.setup, adjustment.recording
    if not declared.datum_source:
        return ()
    targets = dict(recording.setup.targets)
    for name in declared.targets.keys() & targets.keys():
        point = declared.targets[name]
        update = {"datum": point.datum, "approximate_mm": point.approximate_mm}
        targets[name] = targets[name].model_copy(update=update)
    recording = recording.replace(setup=recording.setup.model_copy(update={"targets": targets}))
    problem = replace(adjustment.problem, model=replace(adjustment.problem.model, recording=recording))
    names = [name for name in selected_datum_names(problem) if name not in adjustment.undetermined_targets]
    if len(names) < MIN_POINTS_FOR_POSE:
        return ()
    return exclude_contradicting_axes_points(replace(adjustment, problem=problem), names)[1]


def _axes_point_tests(
    adjustment: Adjustment, names: Sequence[str], declared_points: Floats, used_mask: Bools, factor: float
) -> list[ReferenceTest]:
    """Tests of k points with declared coordinates (k, 3) [m], each against those points that `used_mask` (k,) flags.

    The standard deviations of the adjusted coordinates are multiplied by `factor`, the ratio of the estimated to the
    declared noise.
    """
    chosen = [name for name, used in zip(names, used_mask, strict=True) if used]
    datum_adjustment = adjustment.with_inner_datum(chosen)
    indices = [datum_adjustment.recording.targets.index(name) for name in names]
    state, _ = move_to_datum(datum_adjustment.problem, datum_adjustment.state, chosen)
    turn = state.station_rotations[0] @ datum_adjustment.state.station_rotations[0].T
    covariance = factor**2 * turn @ datum_adjustment.target_covariances[indices] @ turn.T
    gap, places = declared_points - state.target_points[indices], state.target_points[indices]
    centre = places[used_mask].mean(axis=0)
    motions = motions_about_centre(datum_adjustment.problem.free_motions, centre)
    motion = (rigid_motion_jacobian(places, centre) @ motions).reshape(-1, 3, motions.shape[1])
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
    """Test of the declared coordinates of one point, the target `target_name`, that may define the axes.

    `misclosure` (3,) [m] is declared minus adjusted coordinates, `covariance` (3, 3) [m^2] the covariance of the
    adjusted coordinates. `hat_block` (3, 3) is the block of the hat matrix of the alignment for this point. For a point
    that `is_used` in the alignment, the misclosure is (1 - `hat_block`) times the error of the declared coordinates;
    for an excluded point it is the full error. `scatter_dof_and_level` contains the sum of squared misclosures of the
    points in use, its degrees of freedom, and the significance level of this test.
    """
    share, turned = np.linalg.eigh(np.eye(3) - hat_block if is_used else np.eye(3) + hat_block)
    is_checked = share > NORMAL_EQUATIONS_TOLERANCE
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
        declared_axes="xyz",
        declared_sigmas=np.sqrt(np.diag(covariance) + variance_factor),
        residual=misclosure,
        error=turned @ error,
        error_sigmas=np.sqrt(np.einsum("ik,kl,il->i", turned, spread, turned)),
        chi2_drop=float(error @ np.linalg.solve(spread, error)),
        rank=len(share),
        is_excluded=not is_used,
        critical_value=max(MIN_CERTAIN_ERROR_SIGMAS, float(np.sqrt(limit))),
        error_length_sigma=length_sigma(turned @ error, turned @ spread @ turned.T),
    )
