"""Adjusted network whose targets are reference values, and tests of the readings of each station against them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, pairwise

import numpy as np

from ltsim.acceptance.files import TestOutcome, measured_test_outcome
from ltsim.adjustment import Adjustment
from ltsim.adjustment.identification import CauseTest
from ltsim.adjustment.identification.hypothesis import CauseKind
from ltsim.adjustment.identification.reading_shifts import ReadingShift
from ltsim.calibration.correct import corrected_readings
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.geometry.polar import beam_frame_axes, components_across_beam, from_polar, polar_jacobian, to_polar
from ltsim.physics.effects.linear_effect import LinearEffect
from ltsim.physics.effects.motions import StationMotionEffect, TargetDisplacementEffect
from ltsim.recordings.specification import Specification

CENTRING_CAUSE_KIND: CauseKind = "centring"
"""Kind of the cause `centring error`, which is included in the uncertainties and not removed from the readings."""
ESTIMATED_NON_TRACKER_CAUSE_KINDS: tuple[CauseKind, ...] = (
    "constant-offset",
    "constant-step",
    "scale-error",
    "target-moved",
    "station-bump",
    "station-drift",
    "station-settling",
    "orientation",
    "reflector-radius",
)
"""Kinds of causes of a misfit that an adjustment estimates and that are no errors of the tracker: wrong additive
constants, motions, air."""


def is_non_tracker_effect(effect: LinearEffect) -> bool:
    """True for an estimated effect that is no error of the tracker: a motion, or a shift of distances or azimuths."""
    if isinstance(effect, ReadingShift):
        return not (effect.is_drift or effect.observable == "elevation")
    return isinstance(effect, StationMotionEffect | TargetDisplacementEffect)


@dataclass(frozen=True)
class TestedNetwork:
    """Adjusted network whose targets provide reference lengths for the readings of each station.

    Additional parameters of the adjustment are those of effects and nuisance errors (such as centring errors).
    """

    __test__ = False
    """False: pytest does not collect this class."""

    adjustment: Adjustment
    """Adjustment that also estimates the instrument constants and the errors identified in the recording."""
    uncertainty_factor: float
    """Factor by which the standard deviations of the adjustment are multiplied if the readings scatter more than
    declared and no cause is identified; otherwise 1."""
    is_corrected_by_estimated_constants: bool = False
    """True if the readings are corrected by the estimated instrument constants before the tests."""

    @cached_property
    def _additional_parameter_slices(self) -> list[tuple[LinearEffect, slice]]:
        """Estimated effects and nuisance errors (such as centring errors), each with the slice of its parameters."""
        effects = self.adjustment.problem.model.effects_and_nuisance_errors
        ends = np.cumsum([0, *(len(effect.parameters) for effect in effects)])
        return [(e, slice(int(a), int(b))) for e, (a, b) in zip(effects, pairwise(ends), strict=True)]

    @cached_property
    def _is_non_tracker_parameter(self) -> Bools:
        """Mask (additional parameters,) of the parameters of effects that are no errors of the tracker."""
        flags = [
            np.full(at.stop - at.start, is_non_tracker_effect(effect))
            for effect, at in self._additional_parameter_slices
        ]
        return np.concatenate([np.zeros(0, dtype=bool), *flags])

    @cached_property
    def _is_nuisance_parameter(self) -> Bools:
        """Mask (additional parameters,) of the parameters of nuisance errors, such as centring errors."""
        n_effect_parameters = self.adjustment.problem.model.n_effect_parameters
        return np.arange(len(self._is_non_tracker_parameter)) >= n_effect_parameters

    @cached_property
    def _additional_parameter_design(self) -> Floats:
        """Change (pointings, 3, parameters) of readings per unit of each parameter of an effect or nuisance error."""
        return self.adjustment.problem.model.extra_design(self.adjustment.sightings)

    @cached_property
    def corrected_readings_in_face_1(self) -> Floats:
        """Readings (pointings, 3) [m, rad, rad] converted to face 1, without the errors identified in the recording.

        The readings are corrected by the estimated instrument constants if `is_corrected_by_estimated_constants` is
        True.
        """
        adjustment = self.adjustment
        readings = adjustment.recording.readings.copy()
        if self.is_corrected_by_estimated_constants:
            constants = adjustment.state.instrument_parameters[0]
            readings = corrected_readings(adjustment.recording, adjustment.construction, constants)
        for effect, at in self._additional_parameter_slices:
            if is_non_tracker_effect(effect):
                readings -= effect.reading_change(adjustment.sightings, adjustment.state.extra_parameters[at])
        return to_polar(from_polar(readings))

    def is_cause_corrected(self, cause: CauseTest) -> bool:
        """True if an error in the recording is removed from the readings, or included in uncertainties of lengths."""
        place = cause.where
        if cause.kind == CENTRING_CAUSE_KIND:
            return bool(self.adjustment.problem.model.centring_errors)
        if cause.kind in ESTIMATED_NON_TRACKER_CAUSE_KINDS:
            return any(
                is_non_tracker_effect(e) and (e.stations, e.targets) == (place.stations, place.targets)
                for e in self.adjustment.effects
            )
        is_reference = cause.kind in ("reference-value", "reference-scale")
        return cause.sentence in self.adjustment.cause_sentences or (
            is_reference and bool(self.adjustment.rejected_references)
        )

    def test_outcomes(self, specification: Specification) -> list[TestOutcome]:
        """Outcomes of the tests of lengths and two-face differences of all stations, from the pointings in use."""
        is_tested: Bools = np.asarray(self.adjustment.problem.is_used_reading.all(axis=1))
        stations = range(len(self.adjustment.recording.stations))
        return [entry for s in stations for entry in self.station_outcomes(s, is_tested, specification)]

    def station_outcomes(self, station: int, is_tested: Bools, specification: Specification) -> list[TestOutcome]:
        """Outcomes of the tests of a station, from the pointings in the mask `is_tested` (pointings,).

        `station` is the index of the station.
        """
        recording = self.adjustment.recording
        rows_by_face = [
            np.flatnonzero(is_tested & (recording.station == station) & (recording.face == f)) for f in (1, 2)
        ]
        tested_rows = rows_by_face[0] if len(rows_by_face[0]) else rows_by_face[1]
        test_outcomes = self._length_outcomes(recording.stations[station], tested_rows, specification)
        front, back = map(self._mean_points, rows_by_face)
        targets = sorted(front.keys() & back.keys())
        if not targets:
            return test_outcomes
        points = np.array([front[t] for t in targets])
        differences = points - np.array([back[t] for t in targets])
        error = np.linalg.norm(components_across_beam(differences, points), axis=1)
        expanded = 2 * np.sqrt(self._two_face_variance(targets, rows_by_face, points))
        names = [f"{recording.stations[station]}: {recording.targets[t]} two-face" for t in targets]
        sizes = (error.tolist(), specification.two_face_limits(points).tolist(), expanded.tolist())
        return test_outcomes + [
            measured_test_outcome(name, "two-face", *v) for name, *v in zip(names, *sizes, strict=True)
        ]

    def _mean_points(self, pointing_rows: Ints) -> dict[int, Floats]:
        """Mean measured point (3,) [m] of each target in the instrument's frame, over the pointings `pointing_rows`."""
        points, targets = (
            from_polar(self.corrected_readings_in_face_1[pointing_rows]),
            self.adjustment.recording.target[pointing_rows],
        )
        return {int(t): points[targets == t].mean(axis=0) for t in np.unique(targets)}

    def _length_outcomes(self, station: str, row_indices: Ints, specification: Specification) -> list[TestOutcome]:
        """Outcomes of the tests of all lengths between targets, from the pointings of one station and face.

        `station` is the name of the station, and `row_indices` are the pointings.
        """
        adjustment = self.adjustment
        names, points = adjustment.recording.targets, adjustment.state.target_points
        mean_points = self._mean_points(row_indices)
        targets = [
            t for t in mean_points if names[t] not in adjustment.undetermined_targets and np.isfinite(points[t]).all()
        ]
        target_pairs = np.array(list(combinations(range(len(targets)), 2)), dtype=np.int64).reshape(-1, 2)
        if not len(target_pairs):
            return []
        measured, reference = np.array([mean_points[t] for t in targets]), points[targets]
        lengths, reference_lengths = (_pair_vectors(p, target_pairs) for p in (measured, reference))
        error = np.linalg.norm(lengths, axis=1) - np.linalg.norm(reference_lengths, axis=1)
        limit = specification.length_limits(*(measured[target_pairs[:, end]] for end in (0, 1)))
        variance = self._length_variance(targets, row_indices, target_pairs, lengths, reference_lengths)
        return [
            measured_test_outcome(
                f"{station}: {names[targets[a]]} to {names[targets[b]]}", f"lengths from {station}", *values
            )
            for (a, b), *values in zip(
                target_pairs, error.tolist(), limit.tolist(), (2 * np.sqrt(variance)).tolist(), strict=True
            )
        ]

    def _length_variance(
        self, targets: list[int], row_indices: Ints, point_pairs: Ints, lengths: Floats, reference_lengths: Floats
    ) -> Floats:
        """Variances (lengths,) [m^2] of measured minus reference lengths, without errors of the instrument.

        The two ends of a length share most errors (poses, instrument constants). The joint covariance of both ends is
        therefore used, together with that of the corrections of the measured lengths. A length does not depend on the
        datum. Nuisance errors are not corrected, because only the tested readings determine them; their prior variance
        is added. `point_pairs` (lengths, 2) are indices of the ends in `targets`.
        """
        unknowns, size = self.adjustment.problem.unknowns, len(targets)
        length_changes = np.einsum(
            "kj,kjq->kq",
            lengths / np.linalg.norm(lengths, axis=1)[:, None],
            _pair_vectors(self._mean_point_derivatives_by_effects(targets, row_indices), point_pairs),
        )
        is_corrected, is_nuisance = self._is_non_tracker_parameter, self._is_nuisance_parameter
        form = np.zeros((len(point_pairs), size, 3))
        direction = reference_lengths / np.linalg.norm(reference_lengths, axis=1)[:, None]
        every = np.arange(len(point_pairs))
        form[every, point_pairs[:, 0]], form[every, point_pairs[:, 1]] = direction, -direction
        coefficients = np.concatenate([form.reshape(len(point_pairs), -1), -length_changes[:, is_corrected]], axis=1)
        columns = np.concatenate([unknowns.target_columns[targets].ravel(), unknowns.effect_columns[is_corrected]])
        unit = np.zeros((unknowns.n_columns, len(columns)))
        unit[columns, np.arange(len(columns))] = 1.0
        covariance = self.adjustment.factorised_normals.multiply_by_covariance(unit)[columns]
        adjusted = self.uncertainty_factor**2 * np.einsum("ki,ij,kj->k", coefficients, covariance, coefficients)
        prior = self.adjustment.problem.effect_prior_sigmas[is_nuisance]
        return np.asarray(adjusted + np.sum((length_changes[:, is_nuisance] * prior) ** 2, axis=1))

    def _two_face_variance(self, targets: list[int], rows_by_face: list[Ints], points: Floats) -> Floats:
        """Variances (targets,) [m^2] of two-face differences of targets, without errors of the instrument.

        A difference between the faces needs no reference, and the declared noise is an error of the instrument. The
        variance therefore consists of the uncertainty of the errors removed from the recording, and of nuisance errors
        that differ between the faces. Noise beyond the declared noise is added, because its cause may not be the
        instrument. The result is the variance in the worst direction perpendicular to the beam at `points` (targets, 3)
        [m]. `rows_by_face` are the pointings in each face.
        """
        _, across, up = beam_frame_axes(*to_polar(points).T[1:])
        directions = np.stack([across, up], axis=1)
        changes = [self._mean_point_derivatives_by_effects(targets, rows) for rows in rows_by_face]
        extra_design = np.einsum("tci,tiq->tcq", directions, changes[0] - changes[1])
        corrected = extra_design[:, :, self._is_non_tracker_parameter]
        nuisance = (
            extra_design[:, :, self._is_nuisance_parameter]
            * self.adjustment.problem.effect_prior_sigmas[self._is_nuisance_parameter]
        )
        factor = self.uncertainty_factor
        covariance = factor**2 * np.einsum(
            "tci,ij,tdj->tcd", corrected, self._non_tracker_parameter_covariance, corrected
        )
        covariance += np.einsum("tcq,tdq->tcd", nuisance, nuisance)
        for rows in rows_by_face:
            root = self._point_derivatives_by_readings(rows) * self.adjustment.problem.reading_sigmas[rows][:, None, :]
            noise = np.einsum("tn,nij->tij", self._mean_weights(targets, rows) ** 2, root @ np.swapaxes(root, 1, 2))
            covariance += max(factor**2 - 1.0, 0.0) * (directions @ noise @ np.swapaxes(directions, 1, 2))
        return np.asarray(np.linalg.eigvalsh(covariance)[:, -1].clip(min=0.0))

    @cached_property
    def _non_tracker_parameter_covariance(self) -> Floats:
        """Covariance (parameters, parameters) [SI] of the estimates of effects that are no errors of the tracker."""
        columns = self.adjustment.problem.unknowns.effect_columns[self._is_non_tracker_parameter]
        unit = np.zeros((self.adjustment.problem.unknowns.n_columns, len(columns)))
        unit[columns, np.arange(len(columns))] = 1.0
        return np.asarray(self.adjustment.factorised_normals.multiply_by_covariance(unit)[columns])

    def _mean_point_derivatives_by_effects(self, targets: list[int], row_indices: Ints) -> Floats:
        """Derivative (targets, 3, parameters) of mean points in the instrument's frame by effects and nuisances.

        Nuisances are nuisance errors, such as centring errors. `row_indices` are the averaged pointings.
        """
        point_changes = (
            self._point_derivatives_by_readings(row_indices) @ self._additional_parameter_design[row_indices]
        )
        return np.einsum("tn,niq->tiq", self._mean_weights(targets, row_indices), point_changes)

    def _mean_weights(self, targets: list[int], row_indices: Ints) -> Floats:
        """Weights (targets, pointings) of the pointings `row_indices` in the mean points of `targets`."""
        is_mine = self.adjustment.recording.target[row_indices] == np.array(targets)[:, None]
        return np.asarray(is_mine / is_mine.sum(axis=1, keepdims=True))

    def _point_derivatives_by_readings(self, row_indices: Ints) -> Floats:
        """Derivative (pointings, 3, 3) of measured points by the raw readings of the pointings `row_indices`."""
        faces = self.adjustment.recording.face[row_indices]
        return np.asarray(np.linalg.inv(polar_jacobian(self.corrected_readings_in_face_1[row_indices], faces)))


def _pair_vectors(points: Floats, point_pairs: Ints) -> Floats:
    """Vectors from the first to the second row of `points` (targets, ...) for each pair of `point_pairs` (pairs, 2)."""
    return np.asarray(points[point_pairs[:, 1]] - points[point_pairs[:, 0]])
