"""Linear model of a single set-up with repeated pointings, and two-face differences.

Every target measured twice, in the other face or later, provides redundancy without a second station. The unknowns are
three coordinates per target and the instrument parameters. A suspected cause (a bump, a drift, a gross pointing) adds
columns to the design matrix, and is tested by the decrease of chi-square after a fit of these columns.

Half differences of face 1 minus face 2 are tested target by target. Their limit includes the declared noise, and the
differences that specified errors of axes, beam and encoders (`setup.toml`, [instrument.prior]) cause at the position of
the target, because a tracker within its specification has such differences too. A user can replace the limit by
A um + B um/m for the full difference as a length (the form of ASME B89.4.19).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy import special

from ltsim.adjustment.prior import prior_sigmas
from ltsim.adjustment.significance import MIN_CHECKED_REDUNDANCY
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import NetworkError
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE
from ltsim.core.units import MICROMETRE
from ltsim.geometry.polar import from_polar, to_polar, wrap_angle
from ltsim.physics.model.construction import GeometricErrorModel, ideal_construction
from ltsim.physics.model.measurement import NetworkState, sightings_at_state
from ltsim.recordings.recording import Recording
from ltsim.scene.sightings import Sightings

MIN_INSTRUMENT_SINGULAR_VALUE = 0.1
"""Smallest singular value of a combination of instrument errors that is estimated in the model of a set-up.

The singular values are those of the whitened design columns of the instrument errors, multiplied by their prior
standard deviations. Combinations with smaller singular values change the readings by much less than the noise.
"""
MIN_DETERMINED_FRACTION_OF_PARAMETER = 0.999
"""Limit for the selection of determined parameters, between 0 (undetermined) and 1 (determined): squared length of the
unit vector of a parameter after projection onto the determined combinations of parameters. A parameter below the limit
is undetermined and gets an infinite variance."""


@dataclass(frozen=True)
class AddedColumnsFit:
    """Least-squares fit of c added design columns, such as those of a drift, to the residuals of a set-up."""

    chi2_drop: float
    """Decrease of the weighted sum of squared residuals by the fit."""
    rank: int
    """Number of linearly independent columns that were fitted: degrees of freedom of `chi2_drop`."""
    estimates: Floats
    """Estimated parameters of the c columns, (c,) [SI]."""
    covariance: Floats
    """Covariance (c, c) of the c estimates; the variance of an undetermined parameter is infinite."""

    def estimate_length_and_sigma(self, columns: slice) -> tuple[float, float]:
        """Length of the vector of those estimates that `columns` selects, and its standard deviation.

        The standard deviation is infinite if one of these estimates is undetermined.
        """
        vector, covariance = self.estimates[columns], self.covariance[columns, columns]
        vector_length = float(np.sqrt(vector @ vector))
        if not np.isfinite(np.diag(covariance)).all():
            return vector_length, float("inf")
        direction = vector / vector_length if vector_length else np.full(len(vector), 1.0 / np.sqrt(len(vector)))
        return vector_length, float(np.sqrt(max(float(direction @ covariance @ direction), 0.0)))


@dataclass(frozen=True)
class SetupModel:
    """Least-squares model of the readings of one set-up: residuals after a fit of targets and instrument errors."""

    recording: Recording
    """Recording with the pointings of this set-up only."""
    sightings: Sightings
    """Range, direction and covariates (such as time) of each pointing, in the instrument frame."""
    row_mask: Bools
    """Flags (n,), True for those of the n pointings that are in use."""
    whitened_residuals: Floats
    """Residuals of the readings of n pointings divided by their standard deviations, (n, 3); 0 for unused readings."""
    coordinate_basis: Floats
    """Orthonormal basis, (n, 3, 3), of the whitened changes of the readings of n pointings by the coordinates of their
    target. The last axis counts the three basis vectors of the target."""
    error_basis: Floats
    """Orthonormal basis, (n, 3, k), of the whitened changes of the readings by k determined combinations of instrument
    errors, and by fitted motions and drifts."""
    reading_sigmas: Floats
    """Standard deviations of the readings of n pointings, (n, 3) [m, rad, rad]."""
    dof: int
    """Degrees of freedom: number of readings in use minus number of determined unknowns."""

    @classmethod
    def from_recording(
        cls,
        recording: Recording,
        construction: GeometricErrorModel,
        row_mask: Bools | None = None,
        sigma: Floats | None = None,
    ) -> SetupModel:
        """Linear model of the readings of one set-up, with the parameters of the errors `construction` as unknowns.

        `row_mask` (n,) selects some of the n pointings, by default all. `sigma` (n, 3) [m, rad, rad] are the standard
        deviations of the readings, by default the declared ones.
        """
        mask = np.ones(len(recording), dtype=bool) if row_mask is None else row_mask
        weight = recording.is_usable_reading & mask[:, None]
        sigma = recording.reading_sigmas() if sigma is None else sigma
        sightings = replace(sightings_at_state(recording, _initial_state(recording, mask)), sight_vector_offsets=None)
        prior = prior_sigmas(recording, construction)[0]
        # Linearised at the mean of each target: a gross reading would put its error into the instrument columns.
        target_design, parameter_design = construction.reading_design(
            sightings.ideal_raw_readings, np.zeros(construction.n_parameters)
        )
        scale = (weight / sigma)[:, :, None]
        misclosure = np.where(weight, recording.readings - sightings.ideal_raw_readings, 0.0)
        misclosure[:, 1:] = wrap_angle(misclosure[:, 1:])
        basis, ranks = _orthonormal_by_target(target_design * scale, recording.target, len(recording.targets))
        no_columns = np.zeros((len(recording), 3, 0))
        unadjusted = cls(recording, sightings, mask, misclosure, basis, no_columns, sigma, 0)
        columns = unadjusted.project_columns(parameter_design * prior * scale).reshape(3 * len(recording), -1)
        u, size, _ = np.linalg.svd(columns, full_matrices=False)
        instrument = u[:, size > MIN_INSTRUMENT_SINGULAR_VALUE].reshape(len(recording), 3, -1)
        dof = int(weight.sum()) - ranks - instrument.shape[2]
        setup_model = cls(recording, sightings, mask, misclosure, basis, instrument, sigma, dof)
        return replace(
            setup_model, whitened_residuals=setup_model.project_columns(misclosure[:, :, None] * scale)[:, :, 0]
        )

    @property
    def chi2(self) -> float:
        """Chi-square: weighted sum of squared residuals after the fit of target coordinates and instrument errors."""
        return float(np.sum(self.whitened_residuals**2))

    @property
    def inverse_sigmas(self) -> Floats:
        """Inverse standard deviations (n, 3) of the readings of n pointings; 0 for readings that are not in use."""
        return np.where(self.recording.is_usable_reading & self.row_mask[:, None], 1.0 / self.reading_sigmas, 0.0)

    def project_columns(self, columns: Floats) -> Floats:
        """Part (n, 3, c) of whitened columns (n, 3, c) that target coordinates and instrument errors do not explain."""
        target_coefficients = np.einsum("nij,nic->njc", self.coordinate_basis, columns)
        target_sums = np.zeros((len(self.recording.targets), *target_coefficients.shape[1:]))
        np.add.at(target_sums, self.recording.target, target_coefficients)
        remainder = columns - np.einsum("nij,njc->nic", self.coordinate_basis, target_sums[self.recording.target])
        if self.error_basis.shape[2]:
            instrument_coefficients = np.einsum("nik,nic->kc", self.error_basis, remainder)
            remainder = remainder - np.einsum("nik,kc->nic", self.error_basis, instrument_coefficients)
        return np.asarray(remainder)

    def _projected_unit_columns(self, design: Floats) -> tuple[Floats, Floats]:
        """Design columns (3 n, c) of a suspected cause, projected on the residuals, scaled; unscaled lengths (c,).

        Column and length are 0 if target coordinates and instrument errors explain the column. `design` (n, 3, c) is
        the change of the readings of n pointings per unit of the c parameters of the cause.
        """
        whitened = design * self.inverse_sigmas[:, :, None]
        columns = self.project_columns(whitened).reshape(-1, design.shape[2])
        column_norms = np.linalg.norm(columns, axis=0)
        column_norms[column_norms < np.sqrt(NORMAL_EQUATIONS_TOLERANCE) * np.linalg.norm(whitened, axis=(0, 1))] = 0.0
        return np.where(column_norms > 0, columns / np.where(column_norms > 0, column_norms, 1.0), 0.0), column_norms

    def fit_columns(self, design: Floats) -> AddedColumnsFit:
        """Least-squares fit of a suspected cause to the residuals.

        `design` (n, 3, c) is the change of the readings of n pointings per unit of the c parameters of the cause.
        """
        unit, length = self._projected_unit_columns(design)
        u, size, right = np.linalg.svd(unit, full_matrices=False)
        is_valid = size > np.sqrt(NORMAL_EQUATIONS_TOLERANCE) * max(float(size.max(initial=0.0)), 1e-12)
        coefficients = u[:, is_valid].T @ self.whitened_residuals.ravel()
        inverse = (right[is_valid].T / size[is_valid]) / np.where(length > 0, length, np.inf)[:, None]
        covariance = inverse @ inverse.T
        is_undetermined = np.sum(right[is_valid] ** 2, axis=0) < MIN_DETERMINED_FRACTION_OF_PARAMETER
        covariance[is_undetermined, is_undetermined] = np.inf
        return AddedColumnsFit(
            float(coefficients @ coefficients), int(is_valid.sum()), inverse @ coefficients, covariance
        )

    def p_value(self, fit: AddedColumnsFit) -> float:
        """p-value of a fitted suspected cause: the larger one of two tests, with declared and with estimated noise."""
        if not fit.rank or self.dof <= fit.rank:
            return 1.0
        by_declared = float(special.chdtrc(fit.rank, fit.chi2_drop))
        dof = self.dof - fit.rank
        ratio = (fit.chi2_drop / fit.rank) / max((self.chi2 - fit.chi2_drop) / dof, 1e-30)
        return max(by_declared, float(special.fdtrc(fit.rank, dof, ratio)))

    def with_fitted_columns(self, design: Floats) -> SetupModel:
        """Linear model of the same readings with a suspected cause of errors, such as a drift, as additional unknowns.

        `design` (n, 3, c) is the change of the readings of n pointings per unit of the c parameters of the cause.
        """
        u, size, _ = np.linalg.svd(self._projected_unit_columns(design)[0], full_matrices=False)
        added = u[:, size > np.sqrt(NORMAL_EQUATIONS_TOLERANCE) * max(float(size.max(initial=0.0)), 1e-12)]
        residuals = self.whitened_residuals.ravel() - added @ (added.T @ self.whitened_residuals.ravel())
        basis = np.concatenate([self.error_basis, added.reshape(len(self.row_mask), 3, -1)], axis=2)
        return replace(
            self, whitened_residuals=residuals.reshape(-1, 3), error_basis=basis, dof=self.dof - added.shape[1]
        )

    def chi2_and_dof_by_target(self) -> tuple[Floats, Floats]:
        """Weighted sums of squared residuals (T,) of the readings to each of T targets, and degrees of freedom (T,)."""
        leverage = np.sum(self.coordinate_basis**2, axis=2) + np.sum(self.error_basis**2, axis=2)
        redundancy = np.where(self.inverse_sigmas > 0, 1.0 - leverage, 0.0).sum(axis=1)
        target, count = self.recording.target, len(self.recording.targets)
        sums = [
            np.bincount(target, weights, count) for weights in (np.sum(self.whitened_residuals**2, axis=1), redundancy)
        ]
        return np.asarray(sums[0], dtype=np.float64), np.asarray(sums[1], dtype=np.float64)

    def distance_from_mean_of_others(self, row: int) -> float:
        """Distance [m] of the point of pointing `row` from the mean of its target's other points; NaN if none."""
        points = from_polar(self.recording.readings)
        is_complete = np.isfinite(points).all(axis=1)
        others: Bools = np.logical_and(is_complete & self.row_mask, self.recording.target == self.recording.target[row])
        others[row] = False
        return float(np.linalg.norm(points[row] - points[others].mean(axis=0))) if others.any() else float("nan")

    def target_repeatability(self, target: int) -> float:
        """Standard deviation [m] of the repeated points of a target, rms over the axes; NaN for a single point."""
        points = from_polar(self.recording.readings[self.row_mask & np.asarray(self.recording.target == target)])
        points = points[np.isfinite(points).all(axis=1)]
        if len(points) < 2:
            return float("nan")
        return float(np.sqrt(np.mean(np.var(points, axis=0, ddof=1))))

    def removal_chi2_drops_and_dof(self) -> tuple[Floats, Ints]:
        """Decreases (n,) of chi-square if one of n pointings is removed, and their degrees of freedom (n,).

        The degrees of freedom, 0 to 3, count the directions in which other pointings check the point.
        """
        redundancy = np.eye(3) - np.einsum("nij,nkj->nik", self.coordinate_basis, self.coordinate_basis)
        redundancy = redundancy - np.einsum("nij,nkj->nik", self.error_basis, self.error_basis)
        in_use = self.inverse_sigmas > 0
        redundancy = np.where(in_use[:, :, None] & in_use[:, None, :], redundancy, 0.0)
        values, vectors = np.linalg.eigh(redundancy)
        is_controlled = values > MIN_CHECKED_REDUNDANCY
        components = np.einsum("nij,ni->nj", vectors, self.whitened_residuals)
        chi2_drops = np.where(is_controlled, components**2 / np.where(is_controlled, values, 1.0), 0.0).sum(axis=1)
        return chi2_drops, is_controlled.sum(axis=1).astype(np.int64)


def _initial_state(recording: Recording, row_mask: Bools) -> NetworkState:
    """Network state with the instrument at the origin, targets at means of the points that `row_mask` (n,) flags."""
    points = from_polar(recording.readings)
    is_complete = np.isfinite(points).all(axis=1)
    is_valid = is_complete & row_mask if (is_complete & row_mask).any() else is_complete
    total, count = np.zeros((len(recording.targets), 3)), np.zeros(len(recording.targets))
    np.add.at(total, recording.target[is_valid], points[is_valid])
    np.add.at(count, recording.target[is_valid], 1.0)
    mean = total / np.maximum(count, 1.0)[:, None]
    mean[count == 0] = [1.0, 0.0, 0.0]  # arbitrary point: the readings of such a target have no weight
    return NetworkState(np.zeros((1, 3)), np.eye(3)[None], mean, np.zeros((1, 0)))


def _orthonormal_by_target(columns: Floats, target: Ints, n_targets: int) -> tuple[Floats, int]:
    """Orthonormal bases (n, 3, 3) of the design columns of each target, and the sum of the ranks of all targets.

    The first two axes are the readings of n pointings, the last axis counts the basis vectors of the target of the
    pointing. `columns` (n, 3, 3) are the whitened changes of the readings per unit of the coordinates of the target.
    """
    bases, ranks = np.zeros_like(columns), 0
    for t in range(n_targets):
        rows = np.flatnonzero(target == t)
        u, size, _ = np.linalg.svd(columns[rows].reshape(-1, 3), full_matrices=False)
        is_independent = size > np.sqrt(NORMAL_EQUATIONS_TOLERANCE) * max(float(size.max(initial=0.0)), 1e-12)
        basis = np.where(is_independent, u, 0.0)
        bases[rows, :, : basis.shape[1]] = basis.reshape(len(rows), 3, -1)
        ranks += int(is_independent.sum())
    return bases, ranks


@dataclass(frozen=True)
class TwoFaceDifferences:
    """Half differences (face 1 minus face 2) of the m pairs of pointings of one set-up, with their limits."""

    uncorrected_pairs: TwoFacePairs
    """Pairs of pointings to one target in both faces, with readings as recorded."""
    motion_corrected_pairs: TwoFacePairs
    """Pairs of pointings with readings corrected for detected motions of the station and drifts of the instrument."""
    half_difference_sigmas: Floats
    """Standard deviations (m, 3) [m, rad, rad] of the half differences of m pairs, from the declared noise."""
    exceeds_limit: Bools
    """Flags (m, 3) of m pairs, True for half differences above their limits after the correction for motions."""
    half_difference_limits: Floats
    """Largest permitted half differences of m pairs, (m, 3) [m, rad, rad]."""

    @classmethod
    def from_recordings(
        cls,
        recording: Recording,
        motion_corrected_recording: Recording,
        construction: GeometricErrorModel,
        alpha: float,
        mpe: tuple[float, float] | None,
    ) -> TwoFaceDifferences | None:
        """Two-face differences of a recording with one station; None if no target was measured in both faces.

        `motion_corrected_recording` is the recording without the effects of detected motions. `alpha` is the
        probability of at least one false alarm among the differences. `mpe` is a pair of numbers A and B: the maximum
        permissible full difference is A um + B um per metre of range. If `mpe` is None, the limit is computed from the
        declared noise and the specification of the instrument.
        """
        if not len(recording.face_pair_rows()):
            return None
        pairs, corrected_pairs = two_face_pairs(recording), two_face_pairs(motion_corrected_recording)
        sigma = recording.reading_sigmas()
        sigma[:, 1] *= np.abs(np.cos(recording.readings[:, 2]))
        noise_sigma = 0.5 * np.sqrt(np.sum(sigma[pairs.pointing_indices] ** 2, axis=1))
        prior = prior_sigmas(recording, construction)[0]
        change = [
            two_face_pairs(recording, construction, np.diag(prior)[k]).half_differences - pairs.half_differences
            for k in range(len(prior))
        ]
        specification_sigma = np.sqrt(np.sum(np.square(change), axis=0))
        if mpe is None:
            critical = -special.ndtri(alpha / (2 * pairs.half_differences.size))
            limit = critical * np.hypot(noise_sigma, specification_sigma)
        else:
            metres = pairs.mean_front_face_readings[:, 0]
            allowed = 0.5 * MICROMETRE * (mpe[0] + mpe[1] * metres)
            limit = np.stack([allowed, allowed / metres, allowed / metres], axis=1)
        return cls(pairs, corrected_pairs, noise_sigma, np.abs(corrected_pairs.half_differences) > limit, limit)


@dataclass(frozen=True)
class TwoFacePairs:
    """Pairs of pointings from one station to one target, one pointing in each face; m in number."""

    pointing_indices: Ints
    """Indices (m, 2) in the recording of the pointings in face 1 and face 2 of m pairs."""
    mean_front_face_readings: Floats
    """Mean range, azimuth and elevation of both faces of m pairs, converted to face 1, (m, 3) [m, rad, rad]."""
    half_differences: Floats
    """Half of face 1 minus face 2 of m pairs, (m, 3) [m, rad, rad]: of the range, of the azimuth times the cosine of
    the elevation (across the beam), and of the elevation.
    """

    def __len__(self) -> int:
        return len(self.pointing_indices)

    @property
    def rms_half_differences(self) -> Floats:
        """Root mean square (3,) of the half differences: range [m], azimuth across the beam and elevation [rad]."""
        return np.sqrt(np.mean(self.half_differences**2, axis=0))

    @property
    def median_absolute_half_differences(self) -> Floats:
        """Median (3,) of the absolute half differences: range [m], azimuth across the beam and elevation [rad]."""
        return np.median(np.abs(self.half_differences), axis=0)

    def select(self, is_selected: Bools) -> Self:
        """Subset of the m pairs: those that `is_selected` (m,) flags."""
        return replace(
            self,
            pointing_indices=self.pointing_indices[is_selected],
            mean_front_face_readings=self.mean_front_face_readings[is_selected],
            half_differences=self.half_differences[is_selected],
        )


def two_face_pairs(
    recording: Recording, construction: GeometricErrorModel | None = None, parameter_values: Floats | None = None
) -> TwoFacePairs:
    """Pairs of pointings in both faces with their half differences, after a correction for instrument errors.

    `parameter_values` [SI] are the p parameters of the error model `construction`, (p,), or (n, p) for n pointings. By
    default the readings are not corrected. Raises NetworkError if no target was measured in both faces.
    """
    row_pairs = recording.face_pair_rows()
    if not len(row_pairs):
        raise NetworkError(
            "no station measured range and both angles to a target in both faces; measure some targets in both faces"
        )
    model = construction or ideal_construction()
    applied_values = np.zeros(model.n_parameters) if parameter_values is None else parameter_values
    readings = np.where(recording.is_measured, recording.readings, 1.0)
    polar = to_polar(model.points_from_readings(readings, applied_values))
    first, second = polar[row_pairs[:, 0]], polar[row_pairs[:, 1]]
    difference = first - second
    difference[:, 1:] = wrap_angle(difference[:, 1:])
    mean_reading = first - 0.5 * difference
    half_difference = 0.5 * difference
    half_difference[:, 1] *= np.cos(mean_reading[:, 2])
    return TwoFacePairs(row_pairs, mean_reading, half_difference)
