"""Transcription errors: readings in a wrong unit, in the opposite sense, or with an angle of the other face.

The errors are listed here, because three parts use them: readers refuse a file, an effect simulates the error, and the
diagnosis corrects it at a station or in a pointing. `require_degrees_and_millimetres` refuses a file with a column that
is wrong in all rows (radians, gon or zenith angles in place of degrees of elevation, metres in place of millimetres). A
wrong unit in one row is a gross error, which the diagnosis detects.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints, batches
from ltsim.core.units import DEGREE, MILLIMETRE, QUARTER_TURN, SI_PER_UNIT
from ltsim.geometry.polar import from_polar
from ltsim.recordings.files import SourceLocation


@dataclass(frozen=True)
class WrongColumnConversion:
    """Transcription error that replaces each reading in certain columns by factor * reading + offset."""

    name: str
    wrong_content: str
    """Text for the content of the columns with the error, such as "metres"."""
    right_content: str
    """Text for the content of the columns without the error, such as "millimetres"."""
    column_factors_and_offsets: tuple[tuple[int, float, float], ...]
    """Column (0 range, 1 azimuth, 2 elevation), factor, and offset [rad] of each conversion; the wrong reading is
    factor * correct reading + offset."""

    @property
    def changed_columns(self) -> tuple[int, ...]:
        """Indices of the columns that the error changes: 0 range, 1 azimuth, 2 elevation."""
        return tuple(column for column, _, _ in self.column_factors_and_offsets)

    @property
    def description(self) -> str:
        """Text that names the error, such as "metres for millimetres"."""
        return f"{self.wrong_content} for {self.right_content}"

    def with_error(self, readings: Floats) -> Floats:
        """Readings (n, 3) [m, rad, rad] with the error, computed from correct `readings` (n, 3) of n pointings."""
        changed_readings = readings.copy()
        for column, factor, offset in self.column_factors_and_offsets:
            changed_readings[:, column] = factor * readings[:, column] + offset
        return changed_readings

    def without_error(self, readings: Floats) -> Floats:
        """Readings (n, 3) [m, rad, rad] without the error, computed from wrong `readings` (n, 3) of n pointings."""
        corrected = readings.copy()
        for column, factor, offset in self.column_factors_and_offsets:
            corrected[:, column] = (readings[:, column] - offset) / factor
        return corrected


def _length_unit_error(
    name: str, unit: str, unit_in_mm: float, right_unit: str = "millimetres", right_unit_in_mm: float = 1.0
) -> WrongColumnConversion:
    """Transcription error of distances in a wrong `unit` (plural noun) of `unit_in_mm` [mm], with the given name.

    The column should contain the unit `right_unit` (plural noun) of `right_unit_in_mm` [mm].
    """
    return WrongColumnConversion(name, unit, right_unit, ((0, right_unit_in_mm / unit_in_mm, 0.0),))


GON_PER_DEGREE, RADIAN_PER_DEGREE = (SI_PER_UNIT["deg"] / SI_PER_UNIT[unit] for unit in ("gon", "rad"))
"""Factors from degrees to gon and to radians."""

ERRORS_IN_DEGREES_AND_MILLIMETRES = (
    _length_unit_error("inch", "inches", 25.4),
    _length_unit_error("metre", "metres", 1e3),
    _length_unit_error("micrometre", "micrometres", 1e-3),
    _length_unit_error("centimetre", "centimetres", 10.0),
    _length_unit_error("foot", "feet", 304.8),
    WrongColumnConversion("gon", "gon", "degrees", ((1, GON_PER_DEGREE, 0.0), (2, GON_PER_DEGREE, 0.0))),
    WrongColumnConversion("radian", "radians", "degrees", ((1, RADIAN_PER_DEGREE, 0.0), (2, RADIAN_PER_DEGREE, 0.0))),
    WrongColumnConversion("gon-azimuth", "gon", "degrees of the azimuth", ((1, GON_PER_DEGREE, 0.0),)),
    WrongColumnConversion("gon-elevation", "gon", "degrees of the elevation", ((2, GON_PER_DEGREE, 0.0),)),
    WrongColumnConversion("zenith", "zenith angles", "elevations", ((2, -1.0, QUARTER_TURN),)),
    WrongColumnConversion(
        "zenith-gon",
        "zenith angles in gon",
        "elevations in degrees",
        ((1, GON_PER_DEGREE, 0.0), (2, -GON_PER_DEGREE, GON_PER_DEGREE * QUARTER_TURN)),
    ),
    WrongColumnConversion("clockwise", "clockwise azimuths", "counter-clockwise ones", ((1, -1.0, 0.0),)),
)
"""Transcription errors of columns that should contain degrees and millimetres: wrong units, kinds of vertical angle and
senses of the azimuth."""

DEGREES_FOR_GON = WrongColumnConversion(
    "degree", "degrees", "gon", ((1, 1.0 / GON_PER_DEGREE, 0.0), (2, 1.0 / GON_PER_DEGREE, 0.0))
)
"""Transcription error of angles in degrees that were converted to degrees as if they were gon."""

UNIT_AND_CONVENTION_ERRORS = (
    *ERRORS_IN_DEGREES_AND_MILLIMETRES,
    _length_unit_error("foot-metre", "feet", 304.8, "metres", 1e3),
    _length_unit_error("metre-foot", "metres", 1e3, "feet", 304.8),
    DEGREES_FOR_GON,
    WrongColumnConversion("degree-azimuth", "degrees", "gon of the azimuth", ((1, 1.0 / GON_PER_DEGREE, 0.0),)),
    WrongColumnConversion("degree-elevation", "degrees", "gon of the elevation", ((2, 1.0 / GON_PER_DEGREE, 0.0),)),
)
"""Transcription errors of a unit, of the kind of vertical angle, and of the sense of the azimuth."""

WRONG_FACE_ERRORS = (
    WrongColumnConversion("face-azimuth", "the azimuth of the other face", "that of its own face", ((1, 1.0, np.pi),)),
    WrongColumnConversion(
        "face-elevation", "the elevation of the other face", "that of its own face", ((2, -1.0, np.pi),)
    ),
)
"""Transcription errors of an angle that belongs to the other face."""

MAX_ANGLE_READ_AS_RADIANS = 2 * np.pi + 0.01
"""Largest angle [rad] in a column that may contain radians: a full circle plus 0.01 for rounding."""
MIN_LONGEST_DISTANCE_MM = 200.0
"""Limit of the longest distance of a recording, as a number. Below it the unit is the metre, because recordings have
distances of more than 200 mm."""
MAX_COMPARED_LENGTH_PAIRS = 400
"""Largest number of pairs of stations, and of pairs of targets, whose lengths are compared."""
MAX_COMPARED_TARGETS = 60
"""Largest number of common targets of two stations that are used to compare lengths."""
MIN_RELATIVE_DISAGREEMENT_OF_WRONG_LENGTHS = 2e-3
"""Limit of the median relative difference between the lengths that two stations measure between common targets. If it
is exceeded, a reader searches for a transcription error."""
MAX_RELATIVE_DISAGREEMENT_OF_CORRECT_LENGTHS = 2e-4
"""Limit of the median relative difference between the lengths that two stations measure between common targets. Below
it the lengths agree; a correction of a transcription error must lead to such a difference."""

MIN_TARGETS_FOR_MIRROR_TEST = 5
"""Smallest number of common targets for a test of two stations as mirror images; fewer may lie in one plane."""


@dataclass(frozen=True)
class StationTargetPoints:
    """Positions of the k targets that one station measured: target indices (k,), ascending, and mean positions (k, 3).

    Positions are in the frame of the station.
    """

    targets: Ints
    points: Floats

    def common_points(self, other_cloud: StationTargetPoints) -> tuple[Floats, Floats]:
        """Positions (m, 3) of the m targets that both stations measured, in this and in the other station's frame."""
        _, rows, other_rows = np.intersect1d(self.targets, other_cloud.targets, assume_unique=True, return_indices=True)
        return self.points[rows], other_cloud.points[other_rows]


def target_points_by_station(
    points: Floats, station: Ints, target: Ints, max_stations: int | None = None
) -> dict[int, StationTargetPoints]:
    """Mean positions of the targets of each station, by station index.

    `points` (n, 3) are the positions measured in n pointings, in the frames of the stations; rows with NaN are ignored.
    `station` and `target` (n,) are indices. The result has at most the first `max_stations` stations, by default all.
    """
    is_valid = np.all(np.isfinite(points), axis=1)
    n_targets = int(target.max(initial=0)) + 1
    keys, place = np.unique(station[is_valid] * n_targets + target[is_valid], return_inverse=True)
    mean_points = np.zeros((len(keys), 3))
    np.add.at(mean_points, place, points[is_valid])
    mean_points /= np.bincount(place, minlength=len(keys))[:, None]
    stations, first_rows = np.unique(keys // n_targets, return_index=True)
    bounds = [*first_rows.tolist(), len(keys)]
    return {
        s: StationTargetPoints(keys[start:end] % n_targets, mean_points[start:end])
        for s, (start, end) in zip(stations[:max_stations].tolist(), itertools.pairwise(bounds), strict=False)
    }


def shared_target_counts(station: Ints, target: Ints, n_stations: int) -> Ints:
    """Numbers (S, S) of targets that each pair of S stations measured both.

    `station` and `target` (n,) are the indices of station and target in n pointings.
    """
    pairs = np.unique(np.stack([target, station]), axis=1)
    counts = np.zeros((n_stations, n_stations), dtype=np.int64)
    for part in batches(int(target.max(initial=0)) + 1, n_stations):
        first, last = np.searchsorted(pairs[0], [part.start, part.stop])
        is_sighted = np.zeros((part.stop - part.start, n_stations), dtype=np.float32)
        is_sighted[pairs[0, first:last] - part.start, pairs[1, first:last]] = 1.0
        counts += (is_sighted.T @ is_sighted).astype(np.int64)
    return counts


def most_shared_target_pairs(station: Ints, target: Ints, n_stations: int) -> list[tuple[int, int]]:
    """Pairs (earlier, later) of station indices: each station with the earlier station that shares most targets.

    Pairs with fewer than `MIN_TARGETS_FOR_MIRROR_TEST` common targets are omitted, because these may lie in a plane,
    and the mirror image of a plane is equal to it.
    """
    n_shared = np.triu(shared_target_counts(station, target, n_stations), 1)
    best_neighbours = n_shared.argmax(axis=0).tolist()
    return [(first, s) for s, first in enumerate(best_neighbours) if n_shared[first, s] >= MIN_TARGETS_FOR_MIRROR_TEST]


def length_disagreement(points: Floats, station: Ints, target: Ints) -> float:
    """Median relative difference between the lengths that two stations measure between their common targets.

    `points` (n, 3) are the positions measured in n pointings, in the frames of the stations. The result is NaN if no
    two stations have two common targets. Lengths do not depend on the poses of stations. They reveal wrong units and a
    wrong kind of vertical angle, but not a wrong sense of the azimuth.
    """
    clouds = target_points_by_station(points, station, target, MAX_COMPARED_LENGTH_PAIRS + 1).values()
    disagreements: list[float] = []
    for cloud, other in itertools.islice(itertools.combinations(clouds, 2), MAX_COMPARED_LENGTH_PAIRS):
        if len(disagreements) >= MAX_COMPARED_LENGTH_PAIRS:
            break
        common_points = [p[:MAX_COMPARED_TARGETS] for p in cloud.common_points(other)]
        if len(common_points[0]) < 2:
            continue
        lengths = [np.linalg.norm(np.diff(p, axis=0, append=p[:1]), axis=1) for p in common_points]
        scale = np.maximum(lengths[0] + lengths[1], 1e-9) / 2
        disagreements += np.abs((lengths[0] - lengths[1]) / scale).tolist()
    return float(np.median(disagreements)) if disagreements else float("nan")


def position_disagreement(points: Floats, station: Ints, target: Ints) -> float:
    """Median distance [m] between the positions of a target measured from different stations.

    `points` (n, 3) are the positions measured in n pointings, in a common frame. The result is NaN if no target was
    measured from two stations.
    """
    clouds = target_points_by_station(points, station, target).values()
    if not clouds:
        return float("nan")
    targets = np.concatenate([cloud.targets for cloud in clouds])
    order = np.argsort(targets, kind="stable")
    positions = np.concatenate([cloud.points for cloud in clouds])[order]
    _, first_rows, counts = np.unique(targets[order], return_index=True, return_counts=True)
    ranges = np.maximum.reduceat(positions, first_rows) - np.minimum.reduceat(positions, first_rows)
    distances = np.linalg.norm(ranges[counts > 1], axis=1)
    return float(np.median(distances)) + 1e-9 if len(distances) else float("nan")


def _two_face_vertical_angle_sums(angle: Floats, station: Ints, target: Ints, face: Ints) -> Floats:
    """Sums (k,) of the vertical angles in face 1 and face 2, for k pairs of station and target."""
    keys, place = np.unique(station * (int(target.max(initial=0)) + 1) + target, return_inverse=True)
    means = []
    for side in (1, 2):
        rows = (face == side) & np.isfinite(angle)
        count = np.bincount(place[rows], minlength=len(keys))
        total = np.bincount(place[rows], weights=angle[rows], minlength=len(keys))
        means.append(total / np.where(count > 0, count, np.nan))
    face_sums = means[0] + means[1]
    return np.asarray(face_sums[np.isfinite(face_sums)])


def require_degrees_and_millimetres(
    measured_columns: Floats, station: Ints, target: Ints, face: Ints, file: object
) -> None:
    """Check that the columns (n, 3) of n rows contain distances [mm], azimuths and elevations [deg].

    Raises RecordError, which names the unit or the kind of angle that a column appears to contain.
    """
    elevation = measured_columns[:, 2]
    longest = float(np.nanmax(measured_columns[:, 0], initial=-np.inf))
    if -np.inf < longest < MIN_LONGEST_DISTANCE_MM:
        message = f"the longest distance is {longest:.4g}, so distances appear to be in metres; expected millimetres"
        raise SourceLocation(file, column="distance_mm").error(message)
    face_sums = _two_face_vertical_angle_sums(elevation, station, target, face)
    median = float(np.median(face_sums)) if len(face_sums) else float("nan")
    for unit_error in ERRORS_IN_DEGREES_AND_MILLIMETRES:
        expected = _face_sum_with_error(unit_error)
        if expected is not None and abs(median - expected) < 0.005 * expected:
            message = (
                f"the elevations of a target in both faces add up to {median:.4g}, as they do for "
                f"{unit_error.wrong_content}; expected elevations in degrees, which add up to 180"
            )
            raise SourceLocation(file, column="elevation_deg").error(message)
    _require_not_radians(measured_columns, station, target, file)
    _require_consistent_faces(elevation, face, file)
    readings = measured_columns * [MILLIMETRE, DEGREE, DEGREE]
    if (error := error_from_lengths(readings, station, target)) is not None:
        message = (
            "two stations measure different lengths between their targets; the lengths agree if the column contains "
            f"{error.wrong_content}; expected {error.right_content}"
        )
        raise SourceLocation(file, column=("azimuth_deg", "elevation_deg")[error.changed_columns[0] - 1]).error(message)


def _face_sum_with_error(error: WrongColumnConversion) -> float | None:
    """Sum of the vertical angles in both faces that a file with this error contains, in the wrong unit.

    The result is None if the error does not change vertical angles.
    """
    for column, factor, offset in error.column_factors_and_offsets:
        if column == 2:
            total = factor * 180.0 + 2.0 * offset / DEGREE
            return total if abs(total) > 1e-9 else abs(factor) * 360.0
    return None


def error_from_lengths(readings: Floats, station: Ints, target: Ints) -> WrongColumnConversion | None:
    """Transcription error of angles whose correction makes the lengths between targets equal from all stations.

    `readings` (n, 3) [m, rad, rad] are those of n pointings, not corrected. The result is None if there is no such
    error, or if the lengths already agree. Lengths cannot reveal a wrong sense of the azimuth.
    """
    if not length_disagreement(from_polar(readings), station, target) > MIN_RELATIVE_DISAGREEMENT_OF_WRONG_LENGTHS:
        return None
    angle_errors = [error for error in ERRORS_IN_DEGREES_AND_MILLIMETRES if 0 not in error.changed_columns]
    disagreements = [
        length_disagreement(from_polar(error.without_error(readings)), station, target) for error in angle_errors
    ]
    best_index = int(np.argmin(disagreements))
    return (
        angle_errors[best_index] if disagreements[best_index] < MAX_RELATIVE_DISAGREEMENT_OF_CORRECT_LENGTHS else None
    )


def _require_not_radians(measured_columns: Floats, station: Ints, target: Ints, file: object) -> None:
    """Check that the columns of angles do not contain radians; raises RecordError."""
    angles = [a[np.isfinite(a)] for a in measured_columns.T[1:]]
    if max((float(np.abs(a).max()) for a in angles if len(a)), default=np.inf) > MAX_ANGLE_READ_AS_RADIANS:
        return
    has_wide_range = [len(a) > 2 and np.ptp(a) > limit for a, limit in zip(angles, (1.0, 0.3), strict=True)]
    readings = measured_columns * [MILLIMETRE, 1.0, 1.0]
    as_radians = length_disagreement(from_polar(readings), station, target)
    as_degrees = length_disagreement(from_polar(readings * [1.0, DEGREE, DEGREE]), station, target)
    if any(has_wide_range) and not as_degrees <= as_radians:
        values = angles[has_wide_range.index(True)]
        sentence = f"all angles lie between {values.min():.4g} and {values.max():.4g} and appear to be radians"
        column = "azimuth_deg" if has_wide_range[0] else "elevation_deg"
        raise SourceLocation(file, column=column).error(f"{sentence}; expected degrees")


def _require_consistent_faces(elevation: Floats, face: Ints, file: object) -> None:
    """Check that the elevations of face 2 are raw encoder readings, not reduced to face 1; raises RecordError."""
    is_face_2: Bools = (face == 2) & np.isfinite(elevation)
    is_reduced = is_face_2 & (np.abs(elevation) < 90)
    if np.count_nonzero(is_reduced) > 2 and np.all(is_reduced == is_face_2):
        row = int(np.flatnonzero(is_reduced)[0])
        message = (
            f"face 2 contains {elevation[row]:.6g}, so its elevations appear to be reduced to face 1; "
            f"expected raw encoder readings, here near {180 - elevation[row]:.6g}"
        )
        raise SourceLocation(file, row + 1, "elevation_deg").error(message)
