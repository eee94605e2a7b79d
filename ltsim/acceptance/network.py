"""Errors of lengths and two-face differences in a network, whose adjusted targets replace calibrated lengths.

Errors that `calibrate` identifies in the recording and that are not the tracker's, such as a moved target, are removed
from the tested readings. Possible errors of the tracker remain in them.

References
----------
Wang, Muralikrishnan, Icasio Hernandez, Shakarji, Sawyer, Measurement 165 (2020) 108165.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, pairwise

import numpy as np

from ltsim.acceptance.files import TestEntry, make_test_entry
from ltsim.adjustment import Adjustment
from ltsim.adjustment.identification import CauseTest
from ltsim.adjustment.identification.hypothesis import CauseKind
from ltsim.adjustment.identification.reading_shifts import ReadingShift
from ltsim.adjustment.identification.recommendations import recommendations_for_causes
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.correct import corrected_readings
from ltsim.calibration.verbs import calibrate
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import NetworkError
from ltsim.core.notation import listing
from ltsim.geometry.polar import components_across_beam, from_polar, polar_jacobian, to_polar
from ltsim.physics.effects.linear_effect import LinearEffect
from ltsim.physics.effects.motions import StationMotion, TargetMotion
from ltsim.recordings.recording import Recording
from ltsim.recordings.specification import Specification

MAX_OUTLIER_ROUNDS = 3
"""Largest number of adjustments in which outliers are identified."""
CENTRING_KIND: CauseKind = "centring"
"""Kind of a cause that is not removed from the readings: the uncertainties contain it."""
TRACKER_CAUSE_KINDS: tuple[CauseKind, ...] = ("constant-drift", "noise-level", CENTRING_KIND)
"""Kinds of causes that may be errors of the tracker. Random displacements at each set-up (`centring`) have the same
effect as errors of the tracker that repeat in all rounds.
"""
RECORDING_CAUSE_KINDS: tuple[CauseKind, ...] = (
    "constant-offset",
    "constant-step",
    "scale-error",
    "target-moved",
    "station-bump",
    "station-drift",
    "orientation",
    "reflector-radius",
)
"""Kinds of causes that are no errors of the tracker and that an adjustment estimates: wrong constants, motions, air."""


def may_be_tracker_error(cause: CauseTest) -> bool:
    """True for an identified cause that may be an error of the tracker itself.

    Elevations change with the tracker's vertical index. A constant of the distances that differs at one set-up is that
    of a reflector, and a scale that differs there is that of the air. An error at one target is none of the tracker.
    """
    is_shift = cause.kind in ("constant-offset", "constant-step")
    is_possible = cause.kind in TRACKER_CAUSE_KINDS or (is_shift and cause.acts_on == "elevation")
    return is_possible and not cause.where.targets


def is_recording_error(effect: LinearEffect) -> bool:
    """True for an estimated effect that is no error of the tracker: a motion, or a shift with another cause."""
    if isinstance(effect, ReadingShift):
        return not (effect.is_drift or effect.observable == "elevation")
    return isinstance(effect, StationMotion | TargetMotion)


def _treatment_text(cause: CauseTest, treatment_text: str) -> str:
    """Text on the treatment of a cause; for centring errors it states that the uncertainties contain them."""
    if cause.kind != CENTRING_KIND:
        return treatment_text
    return treatment_text.partition(",")[0] + ", and the uncertainties of the lengths contain it"


@dataclass(frozen=True)
class NetworkTests:
    """Tests of a tracker by a network, with the errors that were identified in the recording."""

    entries: tuple[TestEntry, ...]
    """Errors of lengths and two-face differences, with their limits."""
    corrected_causes: tuple[CauseTest, ...]
    """Errors of the recording that are no errors of the tracker. They are removed from the tested readings; centring
    errors are in the uncertainties instead.
    """
    tracker_causes: tuple[CauseTest, ...]
    """Possible errors of the tracker, which remain in the tested readings."""
    uncorrected_causes: tuple[CauseTest, ...]
    """Errors of the recording that are not removed; the tests are not valid with them."""
    outliers: tuple[CauseTest, ...]
    """Outlying readings, whose pointings are neither adjusted nor tested."""
    unexplained_noise_ratio: float
    """Ratio of the scatter of the readings to the declared noise if no cause of it is identified; otherwise 1."""
    n_rejected_without_constants: int = 0
    """Number of errors beyond their limits after the correction of the readings by the estimated constants."""

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on the errors in the recording, and on their treatment."""
        cause_groups = (
            (self.uncorrected_causes, "no error of the tracker, but it remains in the tests, which are not valid"),
            (self.corrected_causes, "no error of the tracker, and it is removed before the tests"),
            (self.tracker_causes, "possibly an error of the tracker, and it remains in the tests"),
        )
        lines = [
            f"{c.sentence} This is {_treatment_text(c, treatment_text)}."
            for causes, treatment_text in cause_groups
            for c in causes
        ]
        if self.outliers:
            lines.append(f"Pointings with outlying readings are not tested: {self._outlier_names}.")
        if self.unexplained_noise_ratio > 1.0:
            lines.append(
                f"The readings scatter {self.unexplained_noise_ratio:.2f} times as much as declared, and the cause "
                "is not identified: the uncertainties of the lengths are multiplied by this factor."
            )
        return tuple(lines)

    @property
    def _outlier_names(self) -> str:
        """Stations, targets and rows of the pointings with outlying readings, the first three by name."""
        names = (f"{t.where.stations[0]} to {t.where.targets[0]} (row {t.rows[0]})" for t in self.outliers)
        return listing(list(dict.fromkeys(names)), 3)

    @property
    def urgent_actions(self) -> tuple[str, ...]:
        """Actions without which the tests are not valid, or which separate the tracker from its surroundings."""
        unexplained = ["Run ltsim diagnose to find the cause of the scatter before you judge the tracker."]
        actions = recommendations_for_causes((*self.uncorrected_causes, *self.tracker_causes))
        return (*actions, *(unexplained if self.unexplained_noise_ratio > 1.0 else []))

    @property
    def constants_action(self) -> str:
        """Action after a rejection, by the number of errors beyond their limits without the instrument's constants."""
        count, total = self.n_rejected_without_constants, len(self.entries)
        maker = "Have the maker adjust the tracker"
        if not count:
            correction = "correct all readings by ltsim calibrate and ltsim correct"
            return f"{maker}, or {correction}. After this correction no error is rejected."
        return (
            f"{maker}. Corrections by ltsim calibrate do not suffice: the test then rejects {count} of {total} errors."
        )

    def further_actions(self, *, is_rejected: bool) -> tuple[str, ...]:
        """Actions after errors that do not impair the tests; outliers are measured again unless others are rejected."""
        again = [f"Measure again: {self._outlier_names}."] if self.outliers and not is_rejected else []
        return (*recommendations_for_causes(self.corrected_causes), *again)


def evaluate_network(recording: Recording, instrument_specification: Specification) -> NetworkTests:
    """Errors of lengths measured by each station, relative to the adjusted network, and differences between faces.

    The network is adjusted together with the instrument's constants and with the errors identified in the recording, so
    that its lengths contain neither. The lengths of each station in one face are compared with them. They contain the
    errors of the instrument. Raises NetworkError for a network with one station, which has no independent lengths, for
    several instruments, and for a network that cannot be adjusted.
    """
    if len(recording.stations) < 2:
        raise NetworkError("the recording has one station; the network method needs at least two")
    if len(recording.instruments) > 1:
        raise NetworkError(f"the recording has {len(recording.instruments)} instruments; an acceptance test needs one")
    calibration, outliers = _calibrate_without_outliers(recording)
    adjustment = calibration.adjustment
    assert adjustment is not None
    adjustment.solution.require_success()
    network = TestedNetwork(adjustment, calibration.uncertainty_factor)
    test_entries = network.test_entries(instrument_specification)
    if not test_entries:
        raise NetworkError("no station measured the distance and both angles of two targets; a length needs both ends")
    n_rejected = 0
    if any(entry.judgement == "rejected" for entry in test_entries):
        without_constants = replace(network, is_corrected_for_constants=True).test_entries(instrument_specification)
        n_rejected = sum(entry.judgement == "rejected" for entry in without_constants)
    causes = [test for test in calibration.tests if test.is_fault and test.kind != "outlier"]
    corrected = tuple(c for c in causes if not may_be_tracker_error(c) and network.is_corrected(c))
    tracker = tuple(c for c in causes if may_be_tracker_error(c))
    other_causes = tuple(c for c in causes if c not in corrected and c not in tracker)
    factor = 1.0 if causes else calibration.uncertainty_factor
    return NetworkTests(tuple(test_entries), corrected, tracker, other_causes, outliers, factor, n_rejected)


def _calibrate_without_outliers(recording: Recording) -> tuple[Calibration, tuple[CauseTest, ...]]:
    """Calibration without the pointings in which outliers are identified, and the tests of the outliers.

    Outliers are identified again without the first ones, at most `MAX_OUTLIER_ROUNDS` times.
    """
    outliers: list[CauseTest] = []
    for _ in range(MAX_OUTLIER_ROUNDS):
        calibration = calibrate(recording, advise=False)
        identified = [test for test in calibration.tests if test.kind == "outlier"]
        if not identified:
            break
        outliers += identified
        readings = recording.readings.copy()
        readings[[row - 1 for test in identified for row in test.rows]] = np.nan
        recording = recording.with_readings(readings)
    else:
        calibration = calibrate(recording, advise=False)
    return calibration, tuple(outliers)


@dataclass(frozen=True)
class TestedNetwork:
    """Adjusted network with reference lengths, and the readings of each station that are compared with them."""

    __test__ = False

    adjustment: Adjustment
    """Adjustment with the instrument's constants and the errors of the recording."""
    uncertainty_factor: float
    """Factor on the standard deviations of the adjustment."""
    is_corrected_for_constants: bool = False
    """True to test the readings after their correction by the estimated constants of the instrument."""

    @cached_property
    def _extra_slices(self) -> list[tuple[LinearEffect, slice]]:
        """Estimated effects and nuisance errors, each with the slice of its additional parameters."""
        effects = self.adjustment.problem.model.extra_effects
        ends = np.cumsum([0, *(len(effect.parameters) for effect in effects)])
        return [(e, slice(int(a), int(b))) for e, (a, b) in zip(effects, pairwise(ends), strict=True)]

    @cached_property
    def _is_recording_error(self) -> Bools:
        """Flags (q,) of the additional parameters of errors of the recording."""
        flags = [np.full(at.stop - at.start, is_recording_error(effect)) for effect, at in self._extra_slices]
        return np.concatenate([np.zeros(0, dtype=bool), *flags])

    @cached_property
    def _is_nuisance(self) -> Bools:
        """Flags (q,) of the additional parameters of nuisance errors, such as centring."""
        n_effect_parameters = self.adjustment.problem.model.n_effect_parameters
        return np.arange(len(self._is_recording_error)) >= n_effect_parameters

    @cached_property
    def _extra_design(self) -> Floats:
        """Change (n, 3, q) of the readings per unit of each additional parameter."""
        return self.adjustment.problem.model.extra_design(self.adjustment.sightings)

    @cached_property
    def readings(self) -> Floats:
        """Front-face readings (n, 3) [m, rad, rad] without the errors of the recording."""
        adjustment = self.adjustment
        readings = adjustment.recording.readings.copy()
        if self.is_corrected_for_constants:
            constants = adjustment.state.instrument_parameters[0]
            readings = corrected_readings(adjustment.recording, adjustment.construction, constants)
        for effect, at in self._extra_slices:
            if is_recording_error(effect):
                readings -= effect.reading_change(adjustment.sightings, adjustment.state.extra_parameters[at])
        return to_polar(from_polar(readings))

    def is_corrected(self, cause: CauseTest) -> bool:
        """True if an error of the recording is removed from the readings, or in the uncertainties of the lengths."""
        place = cause.where
        if cause.kind == CENTRING_KIND:
            return bool(self.adjustment.problem.model.centring_errors)
        if cause.kind in RECORDING_CAUSE_KINDS:
            return any(
                is_recording_error(e) and (e.stations, e.targets) == (place.stations, place.targets)
                for e in self.adjustment.effects
            )
        is_reference = cause.kind in ("reference-value", "reference-scale")
        return cause.sentence in self.adjustment.cause_sentences or (
            is_reference and bool(self.adjustment.rejected_references)
        )

    def test_entries(self, limits: Specification) -> list[TestEntry]:
        """Entries of the lengths and two-face differences of all stations, from the pointings in use."""
        is_tested: Bools = np.asarray(self.adjustment.problem.is_used_reading.all(axis=1))
        stations = range(len(self.adjustment.recording.stations))
        return [entry for s in stations for entry in self.station_entries(s, is_tested, limits)]

    def station_entries(self, station: int, is_tested: Bools, limits: Specification) -> list[TestEntry]:
        """Entries of the lengths and two-face differences of a station, from the pointings that `is_tested` flags."""
        recording = self.adjustment.recording
        rows_by_face = [
            np.flatnonzero(is_tested & (recording.station == station) & (recording.face == f)) for f in (1, 2)
        ]
        tested_rows = rows_by_face[0] if len(rows_by_face[0]) else rows_by_face[1]
        test_entries = self._length_entries(recording.stations[station], tested_rows, limits)
        front, back = map(self._mean_points, rows_by_face)
        for t in sorted(front.keys() & back.keys()):
            error = float(np.linalg.norm(components_across_beam((front[t] - back[t])[None], front[t][None])))
            limit = float(limits.two_face_limits(front[t][None])[0])
            name = f"{recording.stations[station]}: {recording.targets[t]}"
            test_entries.append(make_test_entry(name, "two-face", error, limit))
        return test_entries

    def _mean_points(self, pointing_rows: Ints) -> dict[int, Floats]:
        """Mean points (3,) [m] in the instrument's frame, by target, of the pointings in some rows."""
        points, targets = from_polar(self.readings[pointing_rows]), self.adjustment.recording.target[pointing_rows]
        return {int(t): points[targets == t].mean(axis=0) for t in np.unique(targets)}

    def _length_entries(self, station: str, row_indices: Ints, limits: Specification) -> list[TestEntry]:
        """Entries of all lengths between the targets in some rows of a station, with their uncertainty."""
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
        limit = limits.length_limits(*(measured[target_pairs[:, end]] for end in (0, 1)))
        variance = self._length_variance(targets, row_indices, target_pairs, lengths, reference_lengths)
        return [
            make_test_entry(
                f"{station}: {names[targets[a]]} to {names[targets[b]]}", f"lengths from {station}", *values
            )
            for (a, b), *values in zip(
                target_pairs, error.tolist(), limit.tolist(), (2 * np.sqrt(variance)).tolist(), strict=True
            )
        ]

    def _length_variance(
        self, targets: list[int], row_indices: Ints, point_pairs: Ints, lengths: Floats, reference_lengths: Floats
    ) -> Floats:
        """Variances (k,) [m^2] of measured minus reference lengths, without the errors of the instrument.

        The ends of a length have most errors in common (poses, constants), so that their joint covariance is needed; a
        length does not depend on the datum. The corrections of the measured lengths belong to that covariance. Nuisance
        errors are not corrected, because they are estimated from the tested readings alone; their prior variance is
        added.
        """
        unknowns, size = self.adjustment.problem.unknowns, len(targets)
        length_changes = np.einsum(
            "kj,kjq->kq",
            lengths / np.linalg.norm(lengths, axis=1)[:, None],
            _pair_vectors(self._mean_point_changes(targets, row_indices), point_pairs),
        )
        is_corrected, is_nuisance = self._is_recording_error, self._is_nuisance
        form = np.zeros((len(point_pairs), size, 3))
        direction = reference_lengths / np.linalg.norm(reference_lengths, axis=1)[:, None]
        every = np.arange(len(point_pairs))
        form[every, point_pairs[:, 0]], form[every, point_pairs[:, 1]] = direction, -direction
        coefficients = np.concatenate([form.reshape(len(point_pairs), -1), -length_changes[:, is_corrected]], axis=1)
        columns = np.concatenate([unknowns.target_columns[targets].ravel(), unknowns.effect_columns[is_corrected]])
        unit = np.zeros((unknowns.n_columns, len(columns)))
        unit[columns, np.arange(len(columns))] = 1.0
        covariance = self.adjustment.factorised_normals.covariance_columns(unit)[columns]
        adjusted = self.uncertainty_factor**2 * np.einsum("ki,ij,kj->k", coefficients, covariance, coefficients)
        prior = self.adjustment.problem.effect_sigma[is_nuisance]
        return np.asarray(adjusted + np.sum((length_changes[:, is_nuisance] * prior) ** 2, axis=1))

    def _mean_point_changes(self, targets: list[int], row_indices: Ints) -> Floats:
        """Derivative (t, 3, q) of the mean points by the additional parameters, in the frame of the instrument."""
        adjustment = self.adjustment
        by_reading = np.linalg.inv(polar_jacobian(self.readings[row_indices], adjustment.recording.face[row_indices]))
        point_changes = by_reading @ self._extra_design[row_indices]
        is_mine = adjustment.recording.target[row_indices] == np.array(targets)[:, None]
        return np.einsum("tn,niq->tiq", is_mine / is_mine.sum(axis=1, keepdims=True), point_changes)


def _pair_vectors(points: Floats, point_pairs: Ints) -> Floats:
    """Second minus first of each pair (k, 2) of rows of values (t, ...)."""
    return np.asarray(points[point_pairs[:, 1]] - points[point_pairs[:, 0]])
