"""Displacements of points between two epochs: adjustment of each epoch, alignment, and congruence test.

The second epoch is aligned to the first by the rigid motions that are free in one of the epochs, and by a scale if
requested. The coordinate differences are tested with their full covariance. Moved points are added one by one, each
time the point that explains most of the differences. Each moved point is finally tested with the other moved points in
the model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import scipy.linalg

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.coordinate_uncertainty import covariance_due_to_air, displacement_per_observation
from ltsim.calibration.identified_network import network_uncertainty_factor
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import ModelError, NetworkError, option_text, unknown_name_error
from ltsim.core.limits import require_small_joint_covariance
from ltsim.core.notation import names_text
from ltsim.core.rounding import SQRT_MACHINE_EPSILON
from ltsim.geometry.rigid import align_rigidly, rigid_motion_jacobian
from ltsim.measurands.comparison import Comparison, EpochDifference, congruence_test
from ltsim.measurands.coordinate_lists import matched_lists, with_covariances
from ltsim.measurands.displacement_fit import coordinate_indices
from ltsim.measurands.inputs import (
    CONTROL_POINTS_SOURCE_NAME,
    PRIOR_SOURCE_NAME,
    REFERENCE_LENGTHS_SOURCE_NAME,
    observation_uncertainty_sources,
)
from ltsim.recordings.epoch_coordinates import EpochCoordinates
from ltsim.recordings.references import EXPANSION_ERROR_PREFIX
from ltsim.recordings.result_file import ResultSource
from ltsim.recordings.setup import LengthGauge
from ltsim.solve.gauss_newton import MAX_ITERATIONS

ALL_AXIS_INDICES = np.arange(3)
"""Indices of the coordinate axes x, y and z."""


def compare_adjustments(
    first: Adjustment, second: Adjustment, *, stable_names: Sequence[str] | None = None, with_scale: bool = False,
    same_instrument: bool = False, alpha: float = 0.05
) -> Comparison:  # fmt: skip
    """Comparison of the targets of two converged adjustments, which have separate frames.

    `stable_names` are targets that are certain not to have moved. `with_scale` estimates a scale of the second epoch.
    `same_instrument` is True if one tracker with unchanged errors measured both. `alpha` is the significance level for
    all targets together. Errors are those of `lt.compare`.
    """
    undetermined = {*first.undetermined_targets, *second.undetermined_targets}
    common = [n for n in first.recording.targets if n in second.recording.targets and n not in undetermined]
    stable_points = _stable_point_mask("recordings", common, stable_names, n_frame_points=3)
    indices = [np.array([a.recording.targets.index(n) for n in common]) for a in (first, second)]
    common_groups = _common_error_sources(first, second, same_instrument)
    before, after = (_Epoch.from_adjustment(a, i, common_groups) for a, i in zip((first, second), indices, strict=True))
    sources = (ResultSource.from_recording(first.recording), ResultSource.from_recording(second.recording))
    return _compare_epochs(
        before, after, with_scale, stable_points, stable_points & (stable_names is not None), alpha, sources
    )


def compare_coordinates(
    first: EpochCoordinates, second: EpochCoordinates, *, stable_names: Sequence[str] | None = None,
    has_free_motions: bool = False, with_scale: bool = False, alpha: float = 0.05
) -> Comparison:  # fmt: skip
    """Comparison of two lists of coordinates, which have separate frames if `has_free_motions` is True.

    `stable_names` are points that are certain not to have moved. `with_scale` estimates a scale of the second list.
    `alpha` is the significance level for all points together. Errors are those of `lt.compare`.
    """
    first, second, covariance_notes = with_covariances(first, second)
    first, second, match_notes = matched_lists(first, second)
    common_names = [name for name in first.names if name in second.names]
    open_ = [np.eye(6) if has_free_motions else free_motions_of_epoch(epoch) for epoch in (first, second)]
    is_open = with_scale or any(motions.shape[1] for motions in open_)
    stable_points = _stable_point_mask(
        "lists", common_names, stable_names, n_frame_points=len(first.axes) if is_open else 0
    )
    before, after = (
        _Epoch.from_coordinates(epoch, common_names, motions)
        for epoch, motions in zip((first, second), open_, strict=True)
    )
    n_open = 0 if has_free_motions else max(motions.shape[1] for motions in open_)
    notes = [*covariance_notes, *match_notes, *([undetermined_motions_note(n_open)] if n_open else [])]
    sources = ResultSource.from_coordinates(first), ResultSource.from_coordinates(second)
    stable_mask = stable_points & (stable_names is not None)
    result = _compare_epochs(
        before, after, with_scale, stable_points, stable_mask, alpha, sources, first.axis_indices, notes
    )
    if is_open or len(first.axes) < len(ALL_AXIS_INDICES) or len(common_names) <= len(ALL_AXIS_INDICES):
        return result
    return _with_rigid_motion_note(
        result,
        lambda: compare_coordinates(
            first, second, stable_names=stable_names, has_free_motions=True, with_scale=with_scale, alpha=alpha
        ),
    )


def _with_rigid_motion_note(comparison: Comparison, compare_with_free_motions: Callable[[], Comparison]) -> Comparison:
    """Comparison of lists in one frame, with a note if one rigid motion explains most displacements.

    `compare_with_free_motions` computes the comparison for separate frames.
    """
    n_points = len(comparison.displacements)
    if 2 * len(comparison.moved_points) <= n_points:
        return comparison
    free = compare_with_free_motions()
    if 2 * len(free.moved_points) > n_points:
        return comparison
    moved_names_text = f": {names_text(list(free.moved_points))}" if free.moved_points else ""
    note = (
        f"most points moved together like one rigid body; after alignment of the lists by {option_text('free=True')}, "
        f"{len(free.moved_points)} of {n_points} points moved{moved_names_text}"
    )
    return comparison.model_copy(update={"notes": (*comparison.notes, note), "has_common_rigid_motion": True})


def _compare_epochs(
    first: _Epoch, second: _Epoch, with_scale: bool, stable_mask: Bools, is_declared_stable: Bools, alpha: float,
    epoch_sources: tuple[ResultSource, ResultSource], axis_indices: Ints = ALL_AXIS_INDICES,
    notes: Sequence[str] = ()
) -> Comparison:  # fmt: skip
    """Comparison of two epochs; points whose names are exchanged are compared by their positions.

    The points flagged in `stable_mask` (points,) define the frame. Those flagged in `is_declared_stable` are not
    tested. `alpha` is the significance level for all points together.
    """
    gap = _epoch_difference(first, second, with_scale, stable_mask, axis_indices)
    result = congruence_test(gap, is_declared_stable, alpha, epoch_sources)
    order = order_of_exchanged_names(gap, [i for i, d in enumerate(result.displacements) if d.moved])
    if order is not None:
        result = congruence_test(
            _epoch_difference(
                first, second.with_point_order(order, len(axis_indices)), with_scale, stable_mask, axis_indices
            ),
            is_declared_stable,
            alpha,
            epoch_sources,
        )
        notes = [*notes, exchanged_names_sentence(first.point_names, order)]
    return result.model_copy(update={"notes": tuple(notes)})


def _stable_point_mask(
    point_noun: str, common_names: Sequence[str], stable_names: Sequence[str] | None, *, n_frame_points: int
) -> Bools:
    """Mask of the common points that may define the frame: all common points, or the user's `stable_names`.

    At least `n_frame_points` are necessary. `point_noun` names the epochs in messages, such as "recordings".
    """
    for name in stable_names or ():
        if name not in common_names:
            raise unknown_name_error("common point", name, common_names)
    require_small_joint_covariance(3 * len(common_names), None)
    if len(common_names) < n_frame_points + 1:
        needed = f"at least {n_frame_points + 1} are needed to detect that one of them moved"
        raise NetworkError(f"the {point_noun} share {len(common_names)} points; {needed}")
    if stable_names is not None and len(stable_names) < n_frame_points:
        raise ModelError(f"{len(stable_names)} stable points do not define a frame; name at least {n_frame_points}")
    return np.array([stable_names is None or name in stable_names for name in common_names])


@dataclass(frozen=True)
class _Epoch:
    """Points of one epoch, their joint covariance, and the rigid motions that the epoch does not determine."""

    point_names: Sequence[str]
    """Names of the points."""
    points: Floats
    """Coordinates of the points, shape (points, 3) [m]."""
    covariance: Floats
    """Joint covariance of the compared coordinates of all points, shape (coordinates, coordinates) [m^2]."""
    displacements_per_common_error: Floats
    """Displacements (coordinates, errors) [m] by one standard deviation of each error that the two epochs may share."""
    free_motions: Floats
    """Coefficients (6, motions) of undetermined motions: three translations, then three rotations about the origin."""

    @classmethod
    def from_adjustment(cls, adjustment: Adjustment, target_indices: Ints, common_sources: Sequence[str]) -> Self:
        """Epoch with the targets `target_indices`; `common_sources` names the sources whose errors two epochs share."""
        columns = adjustment.problem.unknowns.target_columns[target_indices].reshape(1, -1)
        reach = displacement_per_observation(adjustment, columns[0])
        shifts_by_source = {
            s.name: s.displacements_per_sigma for s in observation_uncertainty_sources(adjustment, reach)
        }
        responses = [
            np.zeros((reach.shape[1], 0)),
            *(shifts_by_source[name] for name in common_sources if name in shifts_by_source),
        ]
        names = [adjustment.recording.targets[i] for i in target_indices]
        factor = network_uncertainty_factor(adjustment)
        covariance = factor**2 * (reach.T @ reach) + covariance_due_to_air(adjustment, columns)[0]
        return cls(
            names,
            adjustment.state.target_points[target_indices],
            covariance,
            factor * np.hstack(responses),
            adjustment.problem.free_motions,
        )

    @classmethod
    def from_coordinates(cls, coordinates: EpochCoordinates, point_names: Sequence[str], free_motions: Floats) -> Self:
        """Epoch with the points `point_names` of a list of coordinates, and with given free motions (6, motions)."""
        indices = np.array([coordinates.names.index(name) for name in point_names])
        row_indices = coordinate_indices(indices, len(coordinates.axes))
        return cls(
            point_names,
            coordinates.points[indices],
            coordinates.covariance[np.ix_(row_indices, row_indices)],
            np.zeros((len(row_indices), 0)),
            free_motions,
        )

    def with_point_order(self, point_order: Ints, n_axes: int) -> Self:
        """Epoch whose point i is the present point `point_order[i]`, with `n_axes` coordinates per point."""
        row_indices = coordinate_indices(point_order, n_axes)
        return replace(
            self,
            points=self.points[point_order],
            covariance=self.covariance[np.ix_(row_indices, row_indices)],
            displacements_per_common_error=self.displacements_per_common_error[row_indices],
        )


def _common_error_sources(first: Adjustment, second: Adjustment, same_instrument: bool) -> list[str]:
    """Names of the sources of uncertainty whose errors two epochs share, since both recordings declare them equally."""
    earlier, later = first.recording.setup, second.recording.setup
    common = []
    if same_instrument:
        if first.problem.prior.sigma.shape != second.problem.prior.sigma.shape:
            needs = f"{option_text('same_instrument=True')} needs equal numbers"
            raise ModelError(f"the recordings have different numbers of instruments; {needs}")
        common.append(PRIOR_SOURCE_NAME)
    if (
        earlier.gauge is not None
        and later.gauge is not None
        and _gauge_without_temperatures(earlier.gauge) == _gauge_without_temperatures(later.gauge)
    ):
        shared = [a.problem.gauge_rows.shared_error_shifts for a in (first, second)]
        common += [
            REFERENCE_LENGTHS_SOURCE_NAME,
            *(name for name in shared[0] if name in shared[1] and name.startswith(EXPANSION_ERROR_PREFIX)),
        ]
    control = [{n: t.known_mm for n, t in s.targets.items() if t.known_mm is not None} for s in (earlier, later)]
    if control[0] and control[0] == control[1]:
        common.append(CONTROL_POINTS_SOURCE_NAME)
    return common


def _gauge_without_temperatures(gauge: LengthGauge) -> LengthGauge:
    """Copy of a gauge (reflectors at known distances) with its certified lengths, without measured temperatures."""
    plain = {"measured_at_c": None, "sigma_temperature_k": None}
    lengths = tuple(line.model_copy(update=plain) for line in gauge.distance)
    return gauge.model_copy(update={"measured_at_c": 0.0, "sigma_temperature_k": None, "distance": lengths})


def _epoch_difference(
    first_epoch: _Epoch, second_epoch: _Epoch, with_scale: bool, stable_mask: Bools, axes: Ints = ALL_AXIS_INDICES
) -> EpochDifference:
    """Coordinate differences after the second epoch was aligned to the first by the free motions of the two epochs.

    The points in the mask `stable_mask` (points,) define the alignment. `axes` are the indices of the compared axes.
    """
    before, after, turn = first_epoch.points, second_epoch.points, np.eye(3)
    centre = before[stable_mask].mean(axis=0)
    stacked = np.hstack([first_epoch.free_motions, second_epoch.free_motions])
    free = scipy.linalg.orth(stacked) if stacked.shape[1] else stacked
    if free.shape[1] and len(axes) > 1:
        weights = stable_mask.astype(np.float64)
        for _ in range(MAX_ITERATIONS):
            turn, shift = align_rigidly(second_epoch.points, before, weights)
            after = second_epoch.points @ turn.T + shift
            off = np.linalg.norm(after - before, axis=1)
            # A displaced point must not rotate the other points.
            previous, weights = weights, stable_mask / (off + np.median(off[stable_mask]) + 1e-12)
            if np.abs(weights - previous).max() < SQRT_MACHINE_EPSILON * weights.max():
                break
    big = np.kron(np.eye(len(before)), turn[np.ix_(axes, axes)])
    shared = first_epoch.displacements_per_common_error @ second_epoch.displacements_per_common_error.T @ big.T
    covariance = first_epoch.covariance + big @ second_epoch.covariance @ big.T - shared - shared.T
    motions = rigid_motion_jacobian(before, centre)
    motions = motions @ _motions_with_rotations_about_centre(free, centre) if free.shape[1] else motions[:, :0]
    motions = motions.reshape(len(before), 3, -1)[:, axes].reshape(len(covariance), -1)
    motions = motions[:, np.linalg.norm(motions, axis=0) > SQRT_MACHINE_EPSILON * np.abs(before - centre).max()]
    if motions.shape[1]:
        basis = scipy.linalg.orth(motions)
        covariance = covariance + np.trace(covariance) * basis @ basis.T
    if with_scale:
        motions = np.hstack([motions, (before - centre)[:, axes].reshape(-1, 1)])
    return EpochDifference(
        first_epoch.point_names, (after - before)[:, axes].ravel(), covariance, motions, axes, before, with_scale
    )


def _motions_with_rotations_about_centre(free_motions: Floats, centre: Floats) -> Floats:
    """Coefficients (6, motions) of the motions if their rotations are about `centre` (3,) [m] instead of the origin."""
    about = free_motions.copy()
    about[:3] += np.cross(free_motions[3:].T, centre).T
    return about


MAX_NAME_EXCHANGE_RATIO = 0.1
"""Limit of the distance of each of two points from the first-epoch position of the other point, divided by the distance
between the points. If the ratio is smaller, their names count as exchanged."""
MOTIONS_BY_RANK_DEFECT = {3: (0, 1, 2), 4: (0, 1, 2, 5), 6: tuple(range(6))}
"""Indices of the free rigid motions of a network, by the rank defect of its covariance matrix; 0 to 2 are translations
along x, y and z, 3 to 5 are rotations about these axes."""


def free_motions_of_epoch(epoch: EpochCoordinates) -> Floats:
    """Coefficients (6, motions) of the rigid motions that an epoch leaves free, from the rank defect of its covariance.

    If inner constraints over all points define the datum, the variance along the free motions is zero. If only some
    points define the datum, the rank defect is the same but other directions have no variance; `MOTIONS_BY_RANK_DEFECT`
    then gives the motions.
    """
    scale = np.sqrt(np.diag(epoch.covariance))
    if not scale.any():
        return np.zeros((6, 0))
    eigenvalues = np.linalg.eigvalsh(epoch.covariance / np.outer(scale, scale))
    defect = int((eigenvalues < SQRT_MACHINE_EPSILON * eigenvalues[-1]).sum())
    if not defect:
        return np.zeros((6, 0))
    centre = epoch.points.mean(axis=0)
    motions = (
        rigid_motion_jacobian(epoch.points, centre)
        .reshape(len(epoch.points), 3, 6)[:, epoch.axis_indices]
        .reshape(len(scale), 6)
    )
    moving = np.flatnonzero(np.linalg.norm(motions, axis=0) > 0)
    basis, triangle = np.linalg.qr(motions[:, moving])
    variance, directions = np.linalg.eigh(basis.T @ epoch.covariance @ basis)
    still = directions[:, variance < SQRT_MACHINE_EPSILON * scale.max() ** 2]
    free_motions = np.zeros((6, still.shape[1]))
    free_motions[moving] = scipy.linalg.solve_triangular(triangle, still)
    if still.shape[1] != defect:
        usual = np.array(MOTIONS_BY_RANK_DEFECT.get(defect, range(6)) if len(epoch.axes) == len("xyz") else range(6))
        free_motions = np.eye(6)[:, usual[np.isin(usual, moving)]]
    free_motions[:3] += np.cross(centre, free_motions[3:].T).T  # from rotations about the centre to the origin
    return free_motions


def order_of_exchanged_names(difference: EpochDifference, moved_points: Sequence[int]) -> Ints | None:
    """Order (points,) of the second epoch's points that corrects exchanged names; None if no names are exchanged.

    Names are exchanged if each of the `moved_points` (indices) is near the first-epoch position of another moved point.
    """
    if len(moved_points) < 2:
        return None
    before = difference.first_epoch_points[moved_points][:, difference.axis_indices]
    after = before + difference.coordinate_differences.reshape(difference.n_points, -1)[moved_points]
    gaps = np.linalg.norm(after[:, None] - before[None], axis=2)
    nearest, distance = np.argmin(gaps, axis=1), np.diag(gaps)
    taken = (nearest != np.arange(len(moved_points))) & (gaps.min(axis=1) < MAX_NAME_EXCHANGE_RATIO * distance)
    places = {moved_points[i]: moved_points[nearest[i]] for i in np.flatnonzero(taken).tolist()}
    if not places or set(places) != set(places.values()):
        return None
    order = np.arange(difference.n_points)
    order[list(places.values())] = list(places)
    return order


def exchanged_names_sentence(names: Sequence[str], point_order: Ints) -> str:
    """Sentence on the names that are exchanged in the second epoch, from the result of `order_of_exchanged_names`."""
    changed_indices = np.flatnonzero(point_order != np.arange(len(point_order)))
    names_changed = names_text([names[i] for i in changed_indices.tolist()], len(changed_indices))
    return f"the names {names_changed} are exchanged in the second epoch; these points are compared by position"


def undetermined_motions_note(n_motions: int) -> str:
    """Note on the `n_motions` undetermined motions of the whole network, and on the alignment along them."""
    return (
        f"the covariances leave {n_motions} motions of the whole network undetermined (free networks): the second "
        "epoch is aligned with the first along them"
    )
