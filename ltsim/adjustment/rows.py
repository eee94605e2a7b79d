"""Observation equations (rows of the design matrix) of reference values: lengths, known points, levels, yaws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg

from ltsim.adjustment.marks import StationMarks
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.units import ARCSECOND, DEGREE, MILLIMETRE
from ltsim.geometry.polar import wrap_angle
from ltsim.geometry.rigid import (
    MAX_COLLINEAR_RATIO,
    VERTICAL,
    cross_matrix,
    perpendicular_vectors,
    rigid_motion_jacobian,
)
from ltsim.physics.model.measurement import plumb_directions
from ltsim.recordings.recording import Recording
from ltsim.recordings.references import ReferenceLengths, mark_indices
from ltsim.recordings.setup import ReferenceDifference, Target, symmetric_matrix


@dataclass(frozen=True)
class GaugeRows(ReferenceLengths):
    """Observation equations of g reference lengths (gauge), converted to the temperature of the hall."""

    is_unweighted: Bools | bool = False
    """Flags (g,), True for those of the g lengths that get no weight because the position of an end is undetermined."""

    @cached_property
    def total_sigmas(self) -> Floats:
        """Standard deviation of each of g lengths, (g,) [m]; infinite for lengths without weight."""
        return np.where(self.is_unweighted, np.inf, super().total_sigmas)

    @cached_property
    def correlation_cholesky_factor(self) -> Floats | None:
        """Lower Cholesky factor (g, g) of the correlation matrix of the g lengths; None for uncorrelated lengths."""
        if not self.shared_error_shifts:
            return None
        shared_errors = np.array([*self.shared_error_shifts.values()]) / self.total_sigmas
        correlation = shared_errors.T @ shared_errors
        np.fill_diagonal(correlation, 1.0)
        return np.asarray(np.linalg.cholesky(correlation), dtype=np.float64)

    @property
    def covariance_cholesky_factor(self) -> Floats:
        """Lower Cholesky factor (g, g) [m] of the covariance of the g lengths; its inverse whitens length errors."""
        factor = self.correlation_cholesky_factor
        return np.diag(self.total_sigmas) if factor is None else self.total_sigmas[:, None] * factor

    def decorrelate(self, length_changes: Floats) -> Floats:
        """Whitened changes of g lengths, from changes in m, (g,), or (g, q) for q parameters."""
        scaled_values = length_changes / (self.total_sigmas if length_changes.ndim == 1 else self.total_sigmas[:, None])
        return self.decorrelate_scaled(scaled_values)

    def decorrelate_scaled(self, scaled_changes: Floats) -> Floats:
        """Whitened changes of g lengths, from changes in standard deviations, (g,), or (g, q) for q parameters."""
        return (
            scaled_changes
            if self.correlation_cholesky_factor is None
            else scipy.linalg.solve_triangular(self.correlation_cholesky_factor, scaled_changes, lower=True)
        )

    def __len__(self) -> int:
        return len(self.lengths)

    def predict(self, points: Floats) -> Floats:
        """Lengths (g,) [m] between the ends of the g reference lengths, for T targets at `points` (T, 3) [m]."""
        return np.linalg.norm(points[self.first_targets] - points[self.second_targets], axis=1)

    def line_directions(self, points: Floats) -> Floats:
        """Unit vectors (g, 3) from the second to the first target of each of g lengths; zero if both targets coincide.

        These vectors are the derivatives of the lengths with respect to the first target.
        """
        gap = points[self.first_targets] - points[self.second_targets]
        gap_lengths = np.linalg.norm(gap, axis=1, keepdims=True)
        return gap / np.where(gap_lengths > 0.0, gap_lengths, 1.0)


@dataclass(frozen=True)
class ControlRows:
    """Observation equations of k known points: targets, or instruments over known marks that are not measured."""

    point_indices: Ints
    """Index of each of k points with known coordinates, (k,): the index of a target, or of a station."""
    declared_points: Floats
    """Known coordinates of k points, (k, 3) [m]; the values of unknown coordinates are arbitrary."""
    is_declared_coordinate: Bools
    """Flags (k, 3), True for those coordinates of k points that are known."""
    whitening_matrices: Floats
    """Matrices R (k, 3, 3) [1 / m] that whiten the misclosures of k points: R' R is the inverse covariance of the known
    coordinates. Rows and columns of unknown coordinates are 0.
    """

    @classmethod
    def from_recording(cls, recording: Recording) -> ControlRows:
        """Equations of those targets of a recording that have known coordinates."""
        return cls._from_indexed_names(recording, list(enumerate(recording.targets)))

    @classmethod
    def from_stations(cls, recording: Recording, marks: StationMarks) -> ControlRows:
        """Equations of instrument positions over known marks that are not measured as targets."""
        places = [
            (i, n)
            for i, n in enumerate(marks.mark_names)
            if n and marks.target_indices[i] < 0 and marks.first_setup_on_mark[i] == i
        ]
        control_rows = cls._from_indexed_names(recording, places)
        return replace(
            control_rows,
            declared_points=control_rows.declared_points + marks.instrument_offsets[control_rows.point_indices],
        )

    @classmethod
    def _from_indexed_names(cls, recording: Recording, indices_and_names: list[tuple[int, str]]) -> ControlRows:
        """Equations of those points, given by target or station index and name, whose coordinates are known."""
        setups = [(i, recording.target_setup(name)) for i, name in indices_and_names]
        control_setups = [(i, t) for i, t in setups if t.known_mm is not None]
        return cls(
            np.array([i for i, _ in control_setups], dtype=np.int64),
            *_declared_coordinates([t for _, t in control_setups]),
        )

    def __len__(self) -> int:
        return len(self.point_indices)

    @property
    def n_coordinates(self) -> int:
        """Number c of known coordinates of all points, with one equation each."""
        return int(self.is_declared_coordinate.sum())

    def with_min_sigma(self, min_sigma: float) -> ControlRows:
        """Copy of the equations, in which standard deviations below `min_sigma` [m] are increased to this value."""
        roots = self.whitening_matrices.copy()
        for i, axes in enumerate(self.is_declared_coordinate):
            at = np.ix_(axes, axes)
            inverse = np.linalg.inv(roots[i][at])
            covariance = inverse @ inverse.T
            if np.diag(covariance).min() < min_sigma**2:
                roots[i][at] = np.linalg.inv(np.linalg.cholesky(covariance + min_sigma**2 * np.eye(len(covariance))))
        return self if np.array_equal(roots, self.whitening_matrices) else replace(self, whitening_matrices=roots)

    def whitened_residuals(self, adjusted_points: Floats) -> Floats:
        """Whitened residuals (c,) of the c known coordinates, for k `adjusted_points` (k, 3) [m]."""
        gap = np.where(self.is_declared_coordinate, self.declared_points - adjusted_points, 0.0)
        return np.einsum("kij,kj->ki", self.whitening_matrices, gap)[self.is_declared_coordinate]

    def derivatives(self) -> Floats:
        """Derivatives (c, 3) of the c known coordinates, whitened, with respect to the coordinates of their points."""
        return self.whitening_matrices[self.is_declared_coordinate]


def _declared_coordinates(entries: Sequence[Target | ReferenceDifference]) -> tuple[Floats, Bools, Floats]:
    """Declared values (k, 3) [m] of k points or differences, flags (k, 3) of known ones, whitening matrices."""
    axes = np.array([[axis in entry.known_axes for axis in "xyz"] for entry in entries], dtype=bool).reshape(-1, 3)
    roots = np.array(
        [_whitening_matrix(entry, given_axes) for entry, given_axes in zip(entries, axes, strict=True)]
    ).reshape(-1, 3, 3)
    return np.array([entry.known_mm for entry in entries], dtype=np.float64).reshape(-1, 3) * MILLIMETRE, axes, roots


def _whitening_matrix(target: Target | ReferenceDifference, is_declared_coordinate: Bools) -> Floats:
    """Whitening matrix R (3, 3) [1 / m] of known coordinates: R' R is their inverse covariance; 0 if not known."""
    if target.known_covariance_mm2 is None:
        return np.diag(is_declared_coordinate / (target.known_sigma_mm * MILLIMETRE))
    at, root = np.ix_(is_declared_coordinate, is_declared_coordinate), np.zeros((3, 3))
    covariance = symmetric_matrix(target.known_covariance_mm2)[at] * MILLIMETRE**2
    root[at] = np.linalg.inv(np.linalg.cholesky(covariance))
    return root


@dataclass(frozen=True)
class MarkDifferenceRows(ControlRows):
    """Observation equations of k known differences: coordinates of the end mark minus coordinates of the start mark.

    Ends are given by an index in the list of T targets, S instruments and the origin. The origin stands for a mark that
    is known but not measured. Its coordinates, and the heights of instruments over their marks, are included in
    `declared_points`, the declared differences.
    """

    start_indices: Ints
    """Index (k,) of the start point of each of k coordinate differences, in the list of T targets, S instruments and
    the origin. The end point has the index `point_indices` (k,)."""
    origin_index: int
    """Index of the origin in the list of T targets, S instruments and the origin: T + S."""
    names: tuple[str, ...]
    """Name of each difference, from the names of both ends."""

    @classmethod
    def from_marks(cls, recording: Recording, marks: StationMarks) -> MarkDifferenceRows:
        """Equations of those known differences of a recording whose two ends are measured or known."""
        places, count = mark_indices(recording), len(recording.targets)
        last, differences = count + len(recording.stations), recording.setup.differences
        differences = tuple(
            difference for difference in differences if {difference.from_, difference.to} <= places.keys()
        )
        points, axes, roots = _declared_coordinates(differences)
        end_indices = np.array(
            [[places[difference.from_], places[difference.to]] for difference in differences], dtype=np.int64
        ).reshape(-1, 2)
        for k, difference in enumerate(differences):
            for sign, name, place in zip((-1.0, 1.0), (difference.from_, difference.to), end_indices[k], strict=True):
                if place == last:
                    points[k] -= sign * np.array(recording.target_setup(name).known_mm) * MILLIMETRE
                elif place >= count:
                    points[k] += sign * marks.instrument_offsets[place - count]
        labels = tuple(difference.label for difference in differences)
        return cls(end_indices[:, 1], points, axes, roots, end_indices[:, 0], last, labels)

    @property
    def start_and_end_indices(self) -> Ints:
        """Indices (2, k) of start and end of each of k differences in the list of targets, instruments and origin."""
        return np.stack([self.start_indices, self.point_indices])

    def subset(self, mask: Bools) -> MarkDifferenceRows:
        """Equations of those of the k differences that `mask` (k,) flags."""
        return MarkDifferenceRows(
            self.point_indices[mask],
            self.declared_points[mask],
            self.is_declared_coordinate[mask],
            self.whitening_matrices[mask],
            self.start_indices[mask],
            self.origin_index,
            tuple(name for name, is_chosen in zip(self.names, mask, strict=True) if is_chosen),
        )

    def predict(self, points: Floats, position: Floats) -> Floats:
        """Differences (k, 3) [m] of k pairs of points, from targets `points` (T, 3), instruments `position` (S, 3)."""
        places = np.concatenate([points, position, np.zeros((1, 3))])
        return places[self.point_indices] - places[self.start_indices]

    def derivatives(self) -> Floats:
        """Derivatives (c, 6) of the c whitened known components by start and end point of their difference."""
        signs = np.where(self.start_and_end_indices == self.origin_index, 0.0, [[-1.0], [1.0]])[:, :, None, None]
        return np.concatenate([*(signs * self.whitening_matrices)], axis=2)[self.is_declared_coordinate]

    def is_height_undetermined(self, is_undetermined: Bools) -> Bools:
        """Flags (T + S + 1,) of T targets, S instruments and the origin, True for heights that remain undetermined.

        `is_undetermined` (T + S + 1,) flags the heights that are undetermined without the known differences.
        """
        is_undetermined, ends = is_undetermined.copy(), self.start_and_end_indices[:, self.is_declared_coordinate[:, 2]]
        while (half := is_undetermined[ends[0]] != is_undetermined[ends[1]]).any():
            is_undetermined[ends[:, half]] = False
        return is_undetermined

    def motion_derivatives(self, centre: Floats, length_unit: float) -> Floats:
        """Derivatives (c, 6) of the c known components of differences by translation and rotation of the network.

        Rotations are about `centre` (3,) [m], and lengths are in the unit `length_unit` [m]. A difference to the origin
        is a known point. Other differences depend on the rotation alone.
        """
        tied, size = (
            (self.start_and_end_indices == self.origin_index).any(axis=0),
            np.linalg.norm(self.declared_points, axis=1, keepdims=True),
        )
        place = np.where(self.start_indices == self.origin_index, 1.0, -1.0)[:, None] * self.declared_points
        arm = self.declared_points / np.where(size > 0.0, size, 1.0)
        derivatives = rigid_motion_jacobian(np.where(tied[:, None], (place - centre) / length_unit, arm)).reshape(
            -1, 3, 6
        )
        derivatives[~tied, :, :3] = 0.0
        return derivatives[self.is_declared_coordinate]


@dataclass(frozen=True)
class LevelRows:
    """Observation equations of k levelled stations: the two tilts of the standing axis from the plumb line are zero."""

    station_indices: Ints
    """Index of each of k levelled stations, (k,)."""
    tilt_sigmas: Floats
    """Standard deviation of both tilts of each of k levelled stations, (k,) [rad]."""
    plumb_directions: Floats
    """Upward unit vector of the plumb line at each of k levelled stations, (k, 3)."""
    horizontal_axes: Floats
    """Two horizontal unit vectors at each of k levelled stations, (k, 2, 3)."""

    @classmethod
    def from_recording(cls, recording: Recording, is_used_reading: Bools) -> LevelRows:
        """Equations of those levelled stations whose readings in use contain angles.

        `is_used_reading` (n, 3) flags the readings in use of n pointings.
        """
        angles = np.bincount(recording.station, is_used_reading[:, 1:].any(axis=1), len(recording.stations)) > 0
        setups = [(i, recording.station_setup(name)) for i, name in enumerate(recording.stations)]
        levelled_setups = [(i, s) for i, s in setups if s.levelled and angles[i]]
        station = np.array([i for i, _ in levelled_setups], dtype=np.int64)
        vertical = plumb_directions(recording)[station]
        sideways, back = perpendicular_vectors(vertical)
        sigma = np.array([s.levelling_sigma_arcsec for _, s in levelled_setups], dtype=np.float64) * ARCSECOND
        return cls(station, sigma, vertical, np.stack([-back, sideways], axis=1))

    def __len__(self) -> int:
        return len(self.station_indices)

    def with_min_sigma(self, min_sigma: float) -> LevelRows:
        """Copy of the equations, in which standard deviations below `min_sigma` [rad] are increased to this value."""
        raised = np.maximum(self.tilt_sigmas, min_sigma)
        return self if np.all(self.tilt_sigmas == raised) else replace(self, tilt_sigmas=raised)

    def axis_tilts(self, rotation: Floats) -> Floats:
        """Tilts (k, 2) [rad] of k standing axes towards the `horizontal_axes`, for S station rotations (S, 3, 3)."""
        axis = rotation[self.station_indices] @ VERTICAL
        return np.einsum("lij,lj->li", self.horizontal_axes, axis)

    def tilt_derivatives(self, rotation: Floats) -> Floats:
        """Derivatives (k, 2, 3) of the two tilts of k stations by their rotation vectors in the network frame."""
        return -self.horizontal_axes @ cross_matrix(rotation[self.station_indices] @ VERTICAL)


@dataclass(frozen=True)
class YawRows:
    """Observation equations of k stations with known yaws (directions of azimuth zero, as measured by a gyroscope)."""

    station_indices: Ints
    """Index of each of k stations with a known yaw, (k,)."""
    yaw_sigmas: Floats
    """Standard deviation of each of k known yaws, (k,) [rad]."""
    yaws: Floats
    """Known yaws of k stations, counter-clockwise from x, (k,) [rad]."""

    @classmethod
    def from_recording(cls, recording: Recording, is_used_reading: Bools) -> YawRows:
        """Equations of those stations with a known yaw whose readings in use contain azimuths.

        `is_used_reading` (n, 3) flags the readings in use of n pointings.
        """
        n_azimuths = np.bincount(recording.station, is_used_reading[:, 1], len(recording.stations)) > 0
        setups = [(i, recording.station_setup(name)) for i, name in enumerate(recording.stations)]
        yaw_setups = [(i, s.yaw_sigma_arcsec, s.yaw_deg) for i, s in setups if s.yaw_sigma_arcsec and n_azimuths[i]]
        station, sigma, yaw = (np.array([row[k] for row in yaw_setups], dtype=np.float64) for k in range(3))
        return cls(station.astype(np.int64), sigma * ARCSECOND, yaw * DEGREE)

    def __len__(self) -> int:
        return len(self.station_indices)

    def with_min_sigma(self, min_sigma: float) -> YawRows:
        """Copy of the equations, in which standard deviations below `min_sigma` [rad] are increased to this value."""
        raised = np.maximum(self.yaw_sigmas, min_sigma)
        return self if np.all(self.yaw_sigmas == raised) else replace(self, yaw_sigmas=raised)

    def yaw_residuals(self, rotation: Floats) -> Floats:
        """Declared minus adjusted yaws (k,) [rad] of the k stations, from the rotations (S, 3, 3) of all S stations."""
        headings = rotation[self.station_indices, :, 0]
        return wrap_angle(self.yaws - np.arctan2(headings[:, 1], headings[:, 0]))

    def yaw_derivatives(self, rotation: Floats) -> Floats:
        """Derivatives (k, 3) of the yaws of k stations by their rotation vectors in the network frame."""
        headings = rotation[self.station_indices, :, 0]
        horizontal = headings * [1.0, 1.0, 0.0]
        return np.cross(headings, np.cross(VERTICAL, horizontal) / np.sum(horizontal**2, axis=1, keepdims=True))


MAX_PARALLEL_PLUMB_ANGLE = 1e-2
"""Largest angle [rad] between plumb lines that count as parallel. Parallel plumb lines do not determine the yaw of the
network. The angle corresponds to 64 km on the earth."""


def free_motions(
    control: ControlRows, marks: ControlRows, differences: MarkDifferenceRows, level_rows: LevelRows, yaw_rows: YawRows
) -> Floats:
    """Rigid motions (6, f) of the network that no known point, difference, level or yaw fixes.

    Each column is a translation and a rotation. Their number f is 0 with three known points that are not collinear, 4
    with levels alone, 6 without reference values.
    """
    controls = [group for group in (control, marks) if len(group)]
    points = np.concatenate([group.declared_points for group in controls]) if controls else np.zeros((1, 3))
    centre = points.mean(axis=0)
    radius = max(float(np.abs(points - centre).max()), 1e-9) if len(points) > 1 else 1.0
    constraint_rows = [
        rigid_motion_jacobian((group.declared_points - centre) / radius)[group.is_declared_coordinate.ravel()]
        for group in controls
    ]
    if len(differences):
        constraint_rows.append(differences.motion_derivatives(centre, radius))
    if len(level_rows):
        mean = level_rows.plumb_directions.mean(axis=0)
        is_parallel = float(np.linalg.norm(level_rows.plumb_directions - mean, axis=1).max()) < MAX_PARALLEL_PLUMB_ANGLE
        across = level_rows.horizontal_axes[:1] if is_parallel else level_rows.horizontal_axes
        constraint_rows.append(np.concatenate([np.zeros((2 * len(across), 3)), across.reshape(-1, 3)], axis=1))
    if len(yaw_rows):
        constraint_rows.append(np.eye(6)[5:])
    if not constraint_rows:
        return np.eye(6)
    _, singular, right = np.linalg.svd(np.vstack(constraint_rows))
    rank = int(np.sum(singular > MAX_COLLINEAR_RATIO * singular.max(initial=0.0)))
    motions = right[rank:].T
    motions[3:] /= radius
    motions /= np.linalg.norm(motions, axis=0, keepdims=True)
    motions[:3] -= np.cross(motions[3:].T, centre).T
    return motions
