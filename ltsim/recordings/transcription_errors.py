"""Transcription errors: readings in another unit, in another sense, or of the other face.

One table serves the readers that refuse a file, the effect that simulates such an error, and the diagnosis that
corrects a station or a single pointing. A column that is wrong in all rows (radians as degrees, metres as millimetres,
gon, zenith angles) is a wrong file, which `require_degrees_and_millimetres` refuses; a wrong unit in one row is a gross
error, which the diagnosis locates.
"""

import itertools
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.units import DEGREE, MILLIMETRE, QUARTER_TURN, SI_PER_UNIT
from ltsim.geometry.polar import from_polar
from ltsim.recordings.files import SourceLocation


@dataclass(frozen=True)
class TranscriptionError:
    """Transcription error: the columns contain factor * reading + offset."""

    name: str
    wrong_content: str
    """Text of the wrong content of a column."""
    right_content: str
    """Text of the right content of a column."""
    changes: tuple[tuple[int, float, float], ...]
    """Changes by the error: column (0 range, 1 azimuth, 2 elevation), factor, and offset [rad]."""

    @property
    def columns(self) -> tuple[int, ...]:
        """Columns that the error changes."""
        return tuple(column for column, _, _ in self.changes)

    @property
    def cause(self) -> str:
        """Text of the error, such as "metres for millimetres"."""
        return f"{self.wrong_content} for {self.right_content}"

    def with_error(self, readings: Floats) -> Floats:
        """Readings (n, 3) with the error, from raw readings (n, 3)."""
        other = readings.copy()
        for column, factor, offset in self.changes:
            other[:, column] = factor * readings[:, column] + offset
        return other

    def without_error(self, readings: Floats) -> Floats:
        """Raw readings (n, 3) from readings (n, 3) with the error."""
        other = readings.copy()
        for column, factor, offset in self.changes:
            other[:, column] = (readings[:, column] - offset) / factor
        return other


def _length_error(name: str, unit: str, millimetres: float) -> TranscriptionError:
    return TranscriptionError(name, unit, "millimetres", ((0, 1.0 / millimetres, 0.0),))


GON_PER_DEGREE, RADIAN_PER_DEGREE = (SI_PER_UNIT["deg"] / SI_PER_UNIT[unit] for unit in ("gon", "rad"))

UNIT_ERRORS = (
    _length_error("inch", "inches", 25.4),
    _length_error("metre", "metres", 1e3),
    _length_error("micrometre", "micrometres", 1e-3),
    _length_error("centimetre", "centimetres", 10.0),
    _length_error("foot", "feet", 304.8),
    TranscriptionError("gon", "gon", "degrees", ((1, GON_PER_DEGREE, 0.0), (2, GON_PER_DEGREE, 0.0))),
    TranscriptionError("radian", "radians", "degrees", ((1, RADIAN_PER_DEGREE, 0.0), (2, RADIAN_PER_DEGREE, 0.0))),
    TranscriptionError("gon-azimuth", "gon", "degrees of the azimuth", ((1, GON_PER_DEGREE, 0.0),)),
    TranscriptionError("gon-elevation", "gon", "degrees of the elevation", ((2, GON_PER_DEGREE, 0.0),)),
    TranscriptionError("zenith", "zenith angles", "elevations", ((2, -1.0, QUARTER_TURN),)),
    TranscriptionError(
        "zenith-gon",
        "zenith angles in gon",
        "elevations in degrees",
        ((1, GON_PER_DEGREE, 0.0), (2, -GON_PER_DEGREE, GON_PER_DEGREE * QUARTER_TURN)),
    ),
    TranscriptionError("clockwise", "clockwise azimuths", "counter-clockwise ones", ((1, -1.0, 0.0),)),
)
"""Errors of unit or sense: the reading is in the wrong unit but interpreted in the right one."""

FACE_ERRORS = (
    TranscriptionError("face-azimuth", "the azimuth of the other face", "its own value", ((1, 1.0, np.pi),)),
    TranscriptionError("face-elevation", "the elevation of the other face", "its own value", ((2, -1.0, np.pi),)),
)
"""Errors of one angle, which is the one of the other face."""

MAX_CIRCLE_RADIANS = 2 * np.pi + 0.01
"""Largest angle [rad] of a column that is in radians: a full circle, with a margin for rounding."""
MIN_DISTANCE_MM = 200.0
"""Smallest longest distance [mm] of a recording; a smaller one is in metres."""
MAX_COMPARED_CHORDS = 400
"""Largest number of lengths between targets that are compared between stations."""
MIN_WRONG_DISAGREEMENT = 2e-3
"""Relative disagreement of lengths above which a file is wrong."""
MAX_RIGHT_DISAGREEMENT = 2e-4
"""Relative disagreement of lengths below which a file is right."""


def station_clouds(points: Floats, station: Ints, target: Ints) -> dict[int, dict[int, Floats]]:
    """Mean position of each target in each station's frame, by their indices; rows (n, 3) with NaN are ignored."""
    is_valid = np.all(np.isfinite(points), axis=1)
    count = int(target.max(initial=0)) + 1
    keys, place = np.unique(station[is_valid] * count + target[is_valid], return_inverse=True)
    mean = np.zeros((len(keys), 3))
    np.add.at(mean, place, points[is_valid])
    mean /= np.bincount(place, minlength=len(keys))[:, None]
    clouds: dict[int, dict[int, Floats]] = {}
    for key, point in zip(keys.tolist(), mean, strict=True):
        clouds.setdefault(key // count, {})[key % count] = point
    return clouds


def shared_target_counts(station: Ints, target: Ints, n_stations: int) -> Ints:
    """Numbers (S, S) of targets that pairs of S stations share, from the stations and targets (n,) of pointings."""
    shape = n_stations, int(target.max(initial=0)) + 1
    is_sighted = sp.csr_array((np.ones(len(station), dtype=np.int64), (station, target)), shape)
    is_sighted.data[:] = 1  # repeated pointings have been added up
    counts: Ints = (is_sighted @ is_sighted.T).toarray()
    return counts


def length_disagreement(points: Floats, station: Ints, target: Ints) -> float:
    """Median relative disagreement of the lengths between common targets of two stations.

    Lengths do not depend on poses: they test units and the kind of the vertical angle, but not the sense of the
    azimuth.

    `points` (n, 3) are in each station's frame. NaN if no two stations have two common targets.
    """
    clouds = station_clouds(points, station, target).values()
    gaps: list[float] = []
    for first, other in itertools.islice(itertools.combinations(clouds, 2), MAX_COMPARED_CHORDS):
        common = sorted(first.keys() & other.keys())[:60]
        if len(common) < 2 or len(gaps) >= MAX_COMPARED_CHORDS:
            continue
        here = np.array([first[k] for k in common])
        there = np.array([other[k] for k in common])
        lengths = [np.linalg.norm(np.diff(p, axis=0, append=p[:1]), axis=1) for p in (here, there)]
        scale = np.maximum(lengths[0] + lengths[1], 1e-9) / 2
        gaps += np.abs((lengths[0] - lengths[1]) / scale).tolist()
    return float(np.median(gaps)) if gaps else float("nan")


def _two_face_sums(angle: Floats, station: Ints, target: Ints, face: Ints) -> Floats:
    """Sums of the vertical angles on both faces, one per station and target measured on both."""
    keys, place = np.unique(station * (int(target.max(initial=0)) + 1) + target, return_inverse=True)
    means = []
    for side in (1, 2):
        rows = (face == side) & np.isfinite(angle)
        count = np.bincount(place[rows], minlength=len(keys))
        total = np.bincount(place[rows], weights=angle[rows], minlength=len(keys))
        means.append(total / np.where(count > 0, count, np.nan))
    sums = means[0] + means[1]
    return np.asarray(sums[np.isfinite(sums)])


def require_degrees_and_millimetres(
    measured_columns: Floats, station: Ints, target: Ints, face: Ints, file: object
) -> None:
    """Check that the columns are in degrees and millimetres; raises RecordError for another unit or another angle.

    `measured_columns` (n, 3) are distances [mm], azimuths and elevations [deg]. The message names the unit or angle
    that the column appears to have.
    """
    elevation = measured_columns[:, 2]
    longest = float(np.nanmax(measured_columns[:, 0], initial=-np.inf))
    if -np.inf < longest < MIN_DISTANCE_MM:
        message = f"no distance exceeds {longest:.4g}, which looks like metres; expected millimetres"
        raise SourceLocation(file, column="distance_mm").error(message)
    sums = _two_face_sums(elevation, station, target, face)
    median = float(np.median(sums)) if len(sums) else float("nan")
    for slip in UNIT_ERRORS:
        expected = _face_sum_with_error(slip)
        if expected is not None and abs(median - expected) < 0.005 * expected:
            message = (
                f"the two faces add up to {median:.4g}, which looks like {slip.wrong_content}; "
                "expected elevations in degrees, where they add up to 180"
            )
            raise SourceLocation(file, column="elevation_deg").error(message)
    _require_not_radians(measured_columns, station, target, file)
    _require_consistent_faces(elevation, face, file)
    readings = measured_columns * [MILLIMETRE, DEGREE, DEGREE]
    if (error := error_by_lengths(readings, station, target)) is not None:
        message = (
            "two stations disagree on the lengths between their targets, and agree if the column holds "
            f"{error.wrong_content}; expected {error.right_content}"
        )
        raise SourceLocation(file, column=("azimuth_deg", "elevation_deg")[error.columns[0] - 1]).error(message)


def _face_sum_with_error(error: TranscriptionError) -> float | None:
    """Sum [deg] of the vertical angles of a target on both faces under a transcription error; None if it is 180 too."""
    for column, factor, offset in error.changes:
        if column == 2:
            total = factor * 180.0 + 2.0 * offset / DEGREE
            return total if abs(total) > 1e-9 else abs(factor) * 360.0
    return None


def error_by_lengths(readings: Floats, station: Ints, target: Ints) -> TranscriptionError | None:
    """Error of all angles whose correction makes the lengths between targets agree between stations.

    `readings` (n, 3) are raw [m, rad, rad]. None if there is no such error, or the lengths agree already. Lengths do
    not reveal a mirrored network.
    """
    if not length_disagreement(from_polar(readings), station, target) > MIN_WRONG_DISAGREEMENT:
        return None
    angular = [slip for slip in UNIT_ERRORS if 0 not in slip.columns]
    gaps = [length_disagreement(from_polar(slip.without_error(readings)), station, target) for slip in angular]
    best_index = int(np.argmin(gaps))
    return angular[best_index] if gaps[best_index] < MAX_RIGHT_DISAGREEMENT else None


def _require_not_radians(measured_columns: Floats, station: Ints, target: Ints, file: object) -> None:
    angles = [a[np.isfinite(a)] for a in measured_columns.T[1:]]
    if max((float(np.abs(a).max()) for a in angles if len(a)), default=np.inf) > MAX_CIRCLE_RADIANS:
        return
    exceeds = [len(a) > 2 and np.ptp(a) > limit for a, limit in zip(angles, (1.0, 0.3), strict=True)]
    readings = measured_columns * [MILLIMETRE, 1.0, 1.0]
    as_radians = length_disagreement(from_polar(readings), station, target)
    as_degrees = length_disagreement(from_polar(readings * [1.0, DEGREE, DEGREE]), station, target)
    if any(exceeds) and not as_degrees <= as_radians:
        values = angles[exceeds.index(True)]
        looks = f"all angles lie between {values.min():.4g} and {values.max():.4g}, which looks like radians"
        column = "azimuth_deg" if exceeds[0] else "elevation_deg"
        raise SourceLocation(file, column=column).error(f"{looks}; expected degrees")


def _require_consistent_faces(elevation: Floats, face: Ints, file: object) -> None:
    back: Bools = (face == 2) & np.isfinite(elevation)
    reduced = back & (np.abs(elevation) < 90)
    if np.count_nonzero(reduced) > 2 and np.all(reduced == back):
        row = int(np.flatnonzero(reduced)[0])
        message = (
            f"face 2 contains {elevation[row]:.6g}: its elevations are reduced to face 1; "
            f"expected raw encoder readings, here near {180 - elevation[row]:.6g}"
        )
        raise SourceLocation(file, row + 1, "elevation_deg").error(message)
