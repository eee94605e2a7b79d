"""Wrong units and conventions of one face: readings that agree with the other face only after a conversion.

Tables with a column per face, and programs that convert one column, can record one face in another unit, with another
kind of vertical angle, or counted in the opposite sense. Both faces of a pointing show this in the frame of their own
station, so that neither a pose nor another station is needed.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.core.notation import names_text
from ltsim.geometry.polar import from_polar, wrap_angle
from ltsim.recordings.recording import OBSERVABLES, Recording
from ltsim.recordings.transcription_errors import (
    MAX_RELATIVE_DISAGREEMENT_OF_CORRECT_LENGTHS,
    MIN_RELATIVE_DISAGREEMENT_OF_WRONG_LENGTHS,
    UNIT_AND_CONVENTION_ERRORS,
    WrongColumnConversion,
    length_disagreement,
)

MIN_TWO_FACE_TARGETS = 3
"""Smallest number of targets for a test of the unit of a face; the station measured them in both faces. With two
targets, one gross error in each would be enough to make a wrong unit fit."""
MAX_RATIO_OF_CONVERTED_DISAGREEMENT = (
    MAX_RELATIVE_DISAGREEMENT_OF_CORRECT_LENGTHS / MIN_RELATIVE_DISAGREEMENT_OF_WRONG_LENGTHS
)
"""Limit of the disagreement of both faces after a conversion of units, divided by the disagreement before it. If the
ratio is smaller, the conversion explains the disagreement."""
FULL_TURN = 2.0 * np.pi
DISAGREEMENT_ROUNDING = 1e-9
"""Largest difference between two relative disagreements of the faces that count as equal; rounding errors of double
precision are smaller."""
ReadingsWithoutError = tuple[WrongColumnConversion, int, Floats]
"""Transcription error (such as a wrong unit), face (1 or 2) that has the error, and readings (n, 3) [m, rad, rad] of n
pointings corrected for it.
"""


@dataclass(frozen=True)
class FaceUnitError:
    """Readings of one face at some stations that contain a transcription error, with the corrected readings."""

    transcription_error: WrongColumnConversion
    face: int
    """Face of the wrong readings, 1 or 2."""
    stations: tuple[str, ...]
    """Names of the stations."""
    pointing_indices: Ints
    """Indices (k,) of the k pointings with the wrong readings."""
    corrected_readings: Floats
    """Readings (k, 3) [m, rad, rad] of the k wrong pointings, corrected for the transcription error."""

    @property
    def observables(self) -> tuple[str, ...]:
        """Names of the observables that the error changes."""
        return tuple(OBSERVABLES[column] for column in self.transcription_error.changed_columns)

    @property
    def sentence(self) -> str:
        """Sentence for the user that names face, observables, stations and units."""
        observables = " and ".join(f"{name}s" for name in self.observables)
        noun = "station" if len(self.stations) == 1 else "stations"
        return (
            f"The {observables} of face {self.face} at {noun} {names_text(self.stations)} were recorded with "
            f"{self.transcription_error.description}."
        )

    @property
    def factor_text(self) -> str:
        """Text with the factor that corrects the wrong numbers; empty if no single factor does."""
        conversions = {(factor, offset) for _, factor, offset in self.transcription_error.column_factors_and_offsets}
        factor, offset = conversions.pop()
        return f" (multiply by {1.0 / factor:.6g})" if not conversions and not offset and factor > 0.0 else ""


def face_unit_errors(recording: Recording) -> list[FaceUnitError]:
    """Wrong units and conventions of one face, one element per error and face, with the stations where they occur.

    A station is tested if it measured `MIN_TWO_FACE_TARGETS` targets or more in both faces. The list is empty if the
    faces of all stations agree, or if no unit or convention explains their difference.
    """
    pairs = recording.face_pair_rows(np.any(recording.is_measured, axis=1))
    if not len(pairs):
        return []
    stations = recording.station[pairs[:, 0]]
    disagreements = _face_point_distances(recording.readings, pairs)
    suspects = [
        s
        for s in np.unique(stations).tolist()
        if len(np.unique(recording.target[pairs[stations == s, 0]])) >= MIN_TWO_FACE_TARGETS
        and np.median(disagreements[stations == s]) > MIN_RELATIVE_DISAGREEMENT_OF_WRONG_LENGTHS
    ]
    errors: dict[tuple[str, int], list[tuple[int, Floats, WrongColumnConversion]]] = {}
    for s in suspects:
        station_pairs = pairs[stations == s]
        initial = float(np.median(disagreements[stations == s]))
        candidates = list(_candidate_errors_of_face(recording, s, station_pairs))
        medians = [float(np.median(_face_point_distances(readings, station_pairs))) for _, _, readings in candidates]
        limit = min(MAX_RATIO_OF_CONVERTED_DISAGREEMENT * initial, MIN_RELATIVE_DISAGREEMENT_OF_WRONG_LENGTHS)
        if min(medians, default=initial) < limit:
            error, face, readings = _best_face_agreement(recording, candidates, medians)
            errors.setdefault((error.name, face), []).append((s, readings, error))
    return [_common_face_error(recording, face, group) for (_, face), group in errors.items()]


def _best_face_agreement(
    recording: Recording, candidates: Sequence[ReadingsWithoutError], disagreements: Sequence[float]
) -> ReadingsWithoutError:
    """Candidate with the smallest disagreement of the faces; if equal, of the lengths from several stations.

    Distances of face 1 in metres and of face 2 in micrometres have the same disagreement, for example.
    """
    equal = [i for i, value in enumerate(disagreements) if value <= min(disagreements) + DISAGREEMENT_ROUNDING]
    lengths = [
        length_disagreement(from_polar(candidates[i][2]), recording.station, recording.target)
        if len(equal) > 1
        else 0.0
        for i in equal
    ]
    return candidates[equal[int(np.argmin(np.round(np.array(lengths) / DISAGREEMENT_ROUNDING)))]]


def face_unit_warnings(recording: Recording) -> tuple[str, ...]:
    """Warnings that one face was recorded in another unit or convention, with the correction; empty otherwise."""
    return tuple(
        f"{error.sentence[0].lower()}{error.sentence[1:-1]}: correct this face in the file{error.factor_text}, or its "
        "unit in the header or with --columns, and read the file again"
        for error in face_unit_errors(recording)
    )


def _common_face_error(
    recording: Recording, face: int, group: list[tuple[int, Floats, WrongColumnConversion]]
) -> FaceUnitError:
    """Transcription error of one face that several stations have in common, with their corrected readings.

    `group` has, for each station, its index, the corrected readings (n, 3) [m, rad, rad] of all n pointings, and the
    error.
    """
    rows = [_rows_of_face(recording, s, face) for s, _, _ in group]
    corrected = np.concatenate([readings[r] for r, (_, readings, _) in zip(rows, group, strict=True)])
    names = tuple(recording.stations[s] for s, _, _ in group)
    return FaceUnitError(group[0][2], face, names, np.concatenate(rows), corrected)


def _rows_of_face(recording: Recording, station: int, face: int) -> Ints:
    """Indices (k,) of the pointings of one station in one face."""
    return np.flatnonzero((recording.station == station) & (recording.face == face))


def _face_point_distances(readings: Floats, pairs: Ints) -> Floats:
    """Distances (k,) between the points of k two-face pairs, relative to the longer of their ranges.

    `readings` (n, 3) [m, rad, rad] are those of n pointings, `pairs` (k, 2) the indices of face 1 and face 2. An
    observable that one of the faces lacks is not compared: both points then have the same range or angle.
    """
    of_pairs = readings[pairs]
    is_compared = np.asarray(np.isfinite(of_pairs).all(axis=1))
    neutral = np.array([[1.0, 0.0, 0.0], [1.0, np.pi, np.pi]])
    filled = np.where(is_compared[:, None], of_pairs, neutral)
    points = from_polar(filled.reshape(-1, 3)).reshape(filled.shape)
    return np.asarray(np.linalg.norm(points[:, 0] - points[:, 1], axis=1) / np.abs(filled[..., 0]).max(axis=1))


def _candidate_errors_of_face(recording: Recording, station: int, pairs: Ints) -> Iterator[ReadingsWithoutError]:
    """Errors and faces that may explain the disagreement of the faces, with the readings (n, 3) without the error.

    `pairs` (k, 2) are the pointings in face 1 and face 2 at the station.
    """
    for error, face in itertools.product(UNIT_AND_CONVENTION_ERRORS, (1, 2)):
        rows = _rows_of_face(recording, station, face)
        if not recording.is_measured[rows][:, list(error.changed_columns)].any(axis=0).all():
            continue
        readings = recording.readings.copy()
        readings[rows] = error.without_error(readings[rows])
        period = next(
            (FULL_TURN / factor for column, factor, _ in error.column_factors_and_offsets if column == 1), 0.0
        )
        if abs(period) not in (0.0, FULL_TURN):
            expected = np.full(len(recording.targets), np.nan)
            expected[recording.target[pairs[:, 0]]] = recording.readings[pairs[:, 2 - face], 1] + np.pi
            readings[rows, 1] = _nearest_branch(readings[rows, 1], expected[recording.target[rows]], period)
        yield error, face, readings


def _nearest_branch(azimuths: Floats, expected: Floats, period: float) -> Floats:
    """Azimuths (k,) [rad] plus the multiple of `period` [rad] that brings each next to its expected value (k,).

    An azimuth that is reduced to one turn of the wrong unit lacks a multiple of this turn. Azimuths without an expected
    value (NaN) get the multiple that is most frequent among the others.
    """
    n_periods = np.arange(-1, 2)
    branches = azimuths + period * n_periods[:, None]
    has_expected = np.isfinite(expected) & np.isfinite(azimuths)
    nearest = np.argmin(np.abs(wrap_angle(branches - np.where(has_expected, expected, 0.0))), axis=0)
    most_frequent = int(np.argmax(np.bincount(nearest[has_expected], minlength=len(n_periods))))
    return np.asarray(branches[np.where(has_expected, nearest, most_frequent), np.arange(len(azimuths))])
