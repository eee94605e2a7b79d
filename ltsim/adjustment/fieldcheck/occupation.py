"""Model of a single set-up: repeated pointings after a fit of targets and instrument errors.

Every target measured twice, on the other face or later, provides redundancy without a second station. The linear model
has three coordinates per target and the instrument's parameters; a suspected cause (a bump, a drift, a gross pointing)
is tested by the chi-square decrease of its columns.

Two-face differences, half of face 1 minus face 2, are tested target by target. Their limit includes the declared noise
and, since a tracker within its specification has such differences too, the differences that the specified errors of
axes, beam and encoders cause at that position (`setup.toml`, [instrument.prior]). A limit given as A um + B um/m of the
full difference as a length (the form of ASME B89.4.19) replaces it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy import special

from ltsim.adjustment.prior import prior_sigmas
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import NetworkError
from ltsim.core.units import MICROMETRE
from ltsim.geometry.polar import from_polar, to_polar, wrap_angle
from ltsim.physics.model.construction import Construction, ideal_construction
from ltsim.physics.model.measurement import NetworkState, sightings_of
from ltsim.recordings.recording import Recording
from ltsim.scene.sightings import Sightings

MIN_INSTRUMENT_CHANGE = 0.1
"""Smallest change of a reading, in its sigma, by a direction of the instrument's errors that is kept in the model."""
MIN_READING_REDUNDANCY = 0.05
"""Redundancy below which an error of a reading is not visible."""
MIN_DETERMINED_FRACTION = 0.999
"""Fraction of a parameter within the determined directions above which its value is reported."""
MIN_REMAINING_SIGNATURE_FRACTION = 0.01
"""Fraction of a suspected cause's signature that must remain after targets and instrument for a test."""
MIN_RELATIVE_SINGULAR_VALUE = 1e-6
"""Smallest singular value of whitened columns, relative to the largest, that counts as a separate direction."""


@dataclass(frozen=True)
class ColumnsFit:
    """Least-squares fit of columns to an occupation: chi-square decrease, rank, estimate and covariance.

    The variance of an undetermined value is infinite.
    """

    chi2_drop: float
    rank: int
    estimates: Floats
    covariance: Floats

    def length_and_sigma(self, columns: slice) -> tuple[float, float]:
        """Length of the vector of some estimated values, and its standard deviation."""
        part, spread = self.estimates[columns], self.covariance[columns, columns]
        length = float(np.sqrt(part @ part))
        if not np.isfinite(np.diag(spread)).all():
            return length, float("inf")
        along = part / length if length else np.full(len(part), 1.0 / np.sqrt(len(part)))
        return length, float(np.sqrt(max(float(along @ spread @ along), 0.0)))


@dataclass(frozen=True)
class StationOccupation:
    """Occupation: a set-up with whitened readings, from which targets and instrument errors are projected out."""

    recording: Recording
    """Recording of this station."""
    sightings: Sightings
    """Sightings in the instrument frame."""
    row_mask: Bools
    """Flags (n,) of the pointings in use."""
    whitened_residuals: Floats
    """Residuals of the readings divided by sigma, (n, 3); 0 for unused ones."""
    target_basis: Floats
    """Orthonormal columns of each pointing's target, (n, 3, 3)."""
    instrument_basis: Floats
    """Orthonormal columns of the instrument's errors over all targets, (n, 3, k)."""
    sigma: Floats
    """Standard deviations of the readings, (n, 3)."""
    dof: int
    """Degrees of freedom."""

    @classmethod
    def from_recording(
        cls,
        recording: Recording,
        construction: Construction,
        row_mask: Bools | None = None,
        sigma: Floats | None = None,
    ) -> StationOccupation:
        """Occupation of a recording's station.

        `row_mask` (n,) selects pointings, `sigma` (n, 3) replaces the declared noise.
        """
        mask = np.ones(len(recording), dtype=bool) if row_mask is None else row_mask
        weight = recording.usable & mask[:, None]
        sigma = recording.sigma() if sigma is None else sigma
        sightings = replace(sightings_of(recording, _initial_state(recording, mask)), reflector_offsets=None)
        prior = prior_sigmas(recording, construction)[0]
        # At the mean of each target: at a gross reading, the columns of the instrument would contain its error.
        by_point, by_value = construction.reading_design(sightings.raw_readings, np.zeros(construction.n_parameters))
        scale = (weight / sigma)[:, :, None]
        gap = np.where(weight, recording.readings - sightings.raw_readings, 0.0)
        gap[:, 1:] = wrap_angle(gap[:, 1:])
        by_target, ranks = _orthonormal_by_target(by_point * scale, recording.target, len(recording.targets))
        blank = np.zeros((len(recording), 3, 0))
        unadjusted = cls(recording, sightings, mask, gap, by_target, blank, sigma, 0)
        columns = unadjusted.project_columns(by_value * prior * scale).reshape(3 * len(recording), -1)
        u, size, _ = np.linalg.svd(columns, full_matrices=False)
        instrument = u[:, size > MIN_INSTRUMENT_CHANGE].reshape(len(recording), 3, -1)
        dof = int(weight.sum()) - ranks - instrument.shape[2]
        occupation = cls(recording, sightings, mask, gap, by_target, instrument, sigma, dof)
        return replace(occupation, whitened_residuals=occupation.project_columns(gap[:, :, None] * scale)[:, :, 0])

    @property
    def chi2(self) -> float:
        """Weighted sum of squared residuals after targets and instrument errors."""
        return float(np.sum(self.whitened_residuals**2))

    @property
    def inverse_sigmas(self) -> Floats:
        """Inverse standard deviations (n, 3) of the readings in use, 0 for others."""
        return np.where(self.recording.usable & self.row_mask[:, None], 1.0 / self.sigma, 0.0)

    def project_columns(self, columns: Floats) -> Floats:
        """Whitened columns (n, 3, c) with targets and instrument errors projected out."""
        on_target = np.einsum("nij,nic->njc", self.target_basis, columns)
        target_sums = np.zeros((len(self.recording.targets), *on_target.shape[1:]))
        np.add.at(target_sums, self.recording.target, on_target)
        remainder = columns - np.einsum("nij,njc->nic", self.target_basis, target_sums[self.recording.target])
        if self.instrument_basis.shape[2]:
            amount = np.einsum("nik,nic->kc", self.instrument_basis, remainder)
            remainder = remainder - np.einsum("nik,kc->nic", self.instrument_basis, amount)
        return np.asarray(remainder)

    def _unit_columns(self, design: Floats) -> tuple[Floats, Floats]:
        """Unit columns (3 n, c) of a suspected cause and their lengths (c,).

        It is 0 if targets and instrument errors absorb them.
        """
        whitened = design * self.inverse_sigmas[:, :, None]
        columns = self.project_columns(whitened).reshape(-1, design.shape[2])
        length = np.linalg.norm(columns, axis=0)
        length[length < MIN_REMAINING_SIGNATURE_FRACTION * np.linalg.norm(whitened, axis=(0, 1))] = 0.0
        return np.where(length > 0, columns / np.where(length > 0, length, 1.0), 0.0), length

    def fit_columns(self, design: Floats) -> ColumnsFit:
        """Fit of the columns (n, 3, c) of a suspected cause, which are changes of the readings."""
        unit, length = self._unit_columns(design)
        u, size, right = np.linalg.svd(unit, full_matrices=False)
        is_valid = size > np.sqrt(MIN_RELATIVE_SINGULAR_VALUE) * max(float(size.max(initial=0.0)), 1e-12)
        amount = u[:, is_valid].T @ self.whitened_residuals.ravel()
        inverse = (right[is_valid].T / size[is_valid]) / np.where(length > 0, length, np.inf)[:, None]
        covariance = inverse @ inverse.T
        unseen = np.sum(right[is_valid] ** 2, axis=0) < MIN_DETERMINED_FRACTION
        covariance[unseen, unseen] = np.inf
        return ColumnsFit(float(amount @ amount), int(is_valid.sum()), inverse @ amount, covariance)

    def p_value(self, fit: ColumnsFit) -> float:
        """p-value of a chi-square decrease: the larger one of declared and of estimated noise."""
        if not fit.rank or self.dof <= fit.rank:
            return 1.0
        by_declared = float(special.chdtrc(fit.rank, fit.chi2_drop))
        dof = self.dof - fit.rank
        ratio = (fit.chi2_drop / fit.rank) / max((self.chi2 - fit.chi2_drop) / dof, 1e-30)
        return max(by_declared, float(special.fdtrc(fit.rank, dof, ratio)))

    def with_fitted_columns(self, design: Floats) -> StationOccupation:
        """Occupation with the columns (n, 3, c) of a suspected cause fitted too."""
        u, size, _ = np.linalg.svd(self._unit_columns(design)[0], full_matrices=False)
        added = u[:, size > np.sqrt(MIN_RELATIVE_SINGULAR_VALUE) * max(float(size.max(initial=0.0)), 1e-12)]
        residuals = self.whitened_residuals.ravel() - added @ (added.T @ self.whitened_residuals.ravel())
        basis = np.concatenate([self.instrument_basis, added.reshape(len(self.row_mask), 3, -1)], axis=2)
        return replace(
            self, whitened_residuals=residuals.reshape(-1, 3), instrument_basis=basis, dof=self.dof - added.shape[1]
        )

    def target_chi2_and_dof(self) -> tuple[Floats, Floats]:
        """Chi-square (T,) of each target's pointings, and its degrees of freedom."""
        leverage = np.sum(self.target_basis**2, axis=2) + np.sum(self.instrument_basis**2, axis=2)
        redundancy = np.where(self.inverse_sigmas > 0, 1.0 - leverage, 0.0).sum(axis=1)
        target, count = self.recording.target, len(self.recording.targets)
        sums = [
            np.bincount(target, weights, count) for weights in (np.sum(self.whitened_residuals**2, axis=1), redundancy)
        ]
        return np.asarray(sums[0], dtype=np.float64), np.asarray(sums[1], dtype=np.float64)

    def distance_from_mean(self, row: int) -> float:
        """Distance [m] of a pointing from the mean of the other pointings to its target; NaN without others."""
        points = from_polar(self.recording.readings)
        is_complete = np.isfinite(points).all(axis=1)
        others: Bools = np.logical_and(is_complete & self.row_mask, self.recording.target == self.recording.target[row])
        others[row] = False
        return float(np.linalg.norm(points[row] - points[others].mean(axis=0))) if others.any() else float("nan")

    def target_point_sigma(self, target: int) -> float:
        """Standard deviation [m] of the points of a target along one axis; NaN with fewer than two complete ones."""
        points = from_polar(self.recording.readings[self.row_mask & np.asarray(self.recording.target == target)])
        points = points[np.isfinite(points).all(axis=1)]
        if len(points) < 2:
            return float("nan")
        return float(np.sqrt(np.mean(np.var(points, axis=0, ddof=1))))

    def pointing_removal_tests(self) -> tuple[Floats, Ints]:
        """Chi-square decrease (n,) if a pointing is removed, and number of readings (n,) that test it."""
        response = np.eye(3) - np.einsum("nij,nkj->nik", self.target_basis, self.target_basis)
        response = response - np.einsum("nij,nkj->nik", self.instrument_basis, self.instrument_basis)
        in_use = self.inverse_sigmas > 0
        response = np.where(in_use[:, :, None] & in_use[:, None, :], response, 0.0)
        values, vectors = np.linalg.eigh(response)
        is_controlled = values > MIN_READING_REDUNDANCY
        amount = np.einsum("nij,ni->nj", vectors, self.whitened_residuals)
        chi2_drops = np.where(is_controlled, amount**2 / np.where(is_controlled, values, 1.0), 0.0).sum(axis=1)
        return chi2_drops, is_controlled.sum(axis=1).astype(np.int64)


def _initial_state(recording: Recording, row_mask: Bools) -> NetworkState:
    """State with the instrument at the origin and targets at the mean of their pointings."""
    points = from_polar(recording.readings)
    is_complete = np.isfinite(points).all(axis=1)
    is_valid = is_complete & row_mask if (is_complete & row_mask).any() else is_complete
    total, count = np.zeros((len(recording.targets), 3)), np.zeros(len(recording.targets))
    np.add.at(total, recording.target[is_valid], points[is_valid])
    np.add.at(count, recording.target[is_valid], 1.0)
    mean = total / np.maximum(count, 1.0)[:, None]
    mean[count == 0] = [1.0, 0.0, 0.0]  # never in use whole: its rows have no weight
    return NetworkState(np.zeros((1, 3)), np.eye(3)[None], mean, np.zeros((1, 0)))


def _orthonormal_by_target(columns: Floats, target: Ints, n_targets: int) -> tuple[Floats, int]:
    """Orthonormal basis of the columns (n, 3, 3) of each target over all its rows, and the sum of their ranks."""
    bases, ranks = np.zeros_like(columns), 0
    for t in range(n_targets):
        rows = np.flatnonzero(target == t)
        u, size, _ = np.linalg.svd(columns[rows].reshape(-1, 3), full_matrices=False)
        good = size > np.sqrt(MIN_RELATIVE_SINGULAR_VALUE) * max(float(size.max(initial=0.0)), 1e-12)
        basis = np.where(good, u, 0.0)
        bases[rows, :, : basis.shape[1]] = basis.reshape(len(rows), 3, -1)
        ranks += int(good.sum())
    return bases, ranks


@dataclass(frozen=True)
class TwoFaceDifferences:
    """Two-face half differences of one set-up with their limits."""

    uncorrected_pairs: TwoFacePairs
    """Two-face pairs, uncorrected."""
    motion_corrected_pairs: TwoFacePairs
    """Two-face pairs without the contribution of a moving station or a drifting instrument."""
    half_difference_sigmas: Floats
    """Standard deviation of each half difference by the declared noise, (m, 3) [m, rad, rad]."""
    exceeds_limit: Bools
    """Flags (m, 3) of the half differences (without motions) that exceed their limits."""
    max_half_differences: Floats
    """Largest permitted half difference, (m, 3)."""

    @classmethod
    def from_recordings(
        cls,
        recording: Recording,
        motion_corrected: Recording,
        construction: Construction,
        alpha: float,
        mpe: tuple[float, float] | None,
    ) -> TwoFaceDifferences | None:
        """Differences of a recording with one station; None if no target was measured on both faces.

        `motion_corrected_pairs` has its readings without motions.

        `alpha` is the chance of one false alarm over all of them; `mpe` a limit of lengths [um], and [um/m].
        """
        if not len(face_pair_rows(recording)):
            return None
        pairs, unmoved = two_face_pairs(recording), two_face_pairs(motion_corrected)
        sigma = recording.sigma()
        sigma[:, 1] *= np.abs(np.cos(recording.readings[:, 2]))
        noise = 0.5 * np.sqrt(np.sum(sigma[pairs.rows] ** 2, axis=1))
        prior = prior_sigmas(recording, construction)[0]
        change = [
            two_face_pairs(recording, construction, np.diag(prior)[k]).half_differences - pairs.half_differences
            for k in range(len(prior))
        ]
        guarantee = np.sqrt(np.sum(np.square(change), axis=0))
        if mpe is None:
            critical = -special.ndtri(alpha / (2 * pairs.half_differences.size))
            limit = critical * np.hypot(noise, guarantee)
        else:
            metres = pairs.front_face_readings[:, 0]
            allowed = 0.5 * MICROMETRE * (mpe[0] + mpe[1] * metres)
            limit = np.stack([allowed, allowed / metres, allowed / metres], axis=1)
        return cls(pairs, unmoved, noise, np.abs(unmoved.half_differences) > limit, limit)


@dataclass(frozen=True)
class TwoFacePairs:
    """Pairs of pointings of one station to one target on both faces."""

    rows: Ints
    """Rows of the recording with face 1 and face 2, (m, 2)."""
    front_face_readings: Floats
    """Mean front-face range, azimuth, elevation, (m, 3) [m, rad, rad]."""
    half_differences: Floats
    """Half of face 1 minus face 2, (m, 3) [m, rad, rad]: range, azimuth perpendicular to the beam (times the cosine of
    the elevation), elevation.
    """

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def rms(self) -> Floats:
        """Root mean square (3,) of the half differences: range [m], azimuth across the beam and elevation [rad]."""
        return np.sqrt(np.mean(self.half_differences**2, axis=0))

    @property
    def median(self) -> Floats:
        """Median (3,) of the absolute half differences, insensitive to a few gross errors."""
        return np.median(np.abs(self.half_differences), axis=0)

    def select(self, pairs: Bools) -> Self:
        """Selection of the pairs by flags (m,)."""
        return replace(
            self,
            rows=self.rows[pairs],
            front_face_readings=self.front_face_readings[pairs],
            half_differences=self.half_differences[pairs],
        )


def face_pair_rows(recording: Recording) -> Ints:
    """Rows (m, 2) of complete pointings on face 1 and face 2 of the same station, target and repeat."""
    whole = np.all(recording.usable, axis=1)
    rows_by_key: dict[tuple[int, int, int], dict[int, int]] = {}
    keys = zip(recording.station.tolist(), recording.target.tolist(), recording.repeat.tolist(), strict=True)
    for row, key in enumerate(keys):
        if whole[row]:
            rows_by_key.setdefault(key, {})[int(recording.face[row])] = row
    pairs = [(faces[1], faces[2]) for faces in rows_by_key.values() if len(faces) == 2]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def two_face_pairs(
    recording: Recording, construction: Construction | None = None, values: Floats | None = None
) -> TwoFacePairs:
    """Two-face half differences of a recording, corrected with parameters (p,) or (n, p) [SI] of a construction.

    The default is an ideal tracker, which does not correct. Raises NetworkError if no target was measured on both
    faces.
    """
    pairs = face_pair_rows(recording)
    if not len(pairs):
        raise NetworkError("no station measured a target in range and both angles on both faces")
    model = construction or ideal_construction()
    applied_values = np.zeros(model.n_parameters) if values is None else values
    readings = np.where(recording.is_measured, recording.readings, 1.0)
    polar = to_polar(model.point(readings, applied_values))
    first, second = polar[pairs[:, 0]], polar[pairs[:, 1]]
    gap = first - second
    gap[:, 1:] = wrap_angle(gap[:, 1:])
    place = first - 0.5 * gap
    half_difference = 0.5 * gap
    half_difference[:, 1] *= np.cos(place[:, 2])
    return TwoFacePairs(pairs, place, half_difference)
