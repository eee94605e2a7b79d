"""Slips of the pen: readings in another unit, counted another way, or of the other face.

One table for all who meet them: readers that refuse a file, the effect that simulates a slip, the diagnosis that mends
a station or a single pointing. Columns that hold a slip in all rows (radians as degrees, metres as millimetres, gon,
zenith angles) are a wrong file, which `check_degrees` refuses; a wrong unit in one row is a gross error for the
diagnosis to find.
"""

import itertools
from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.units import DEGREE, FACTOR, MILLIMETRE
from ltsim.geometry.polar import from_polar
from ltsim.recordings.files import FilePlace


@dataclass(frozen=True)
class Slip:
    """A slip that writes factor * reading + offset in some columns."""

    name: str
    found: str
    expected: str
    """The content of the column, and the right one."""
    changes: tuple[tuple[int, float, float], ...]
    """Column (0 range, 1 azimuth, 2 elevation), factor, and offset [rad]."""

    @property
    def columns(self) -> tuple[int, ...]:
        """The columns that are wrong."""
        return tuple(column for column, _, _ in self.changes)

    @property
    def cause(self) -> str:
        """The slip in words: metres for millimetres."""
        return f"{self.found} for {self.expected}"

    def written(self, readings: Floats) -> Floats:
        """Readings (n, 3) as they are written down, from raw readings (n, 3)."""
        other = readings.copy()
        for column, factor, offset in self.changes:
            other[:, column] = factor * readings[:, column] + offset
        return other

    def mended(self, readings: Floats) -> Floats:
        """The raw readings (n, 3) of which `readings` were written down."""
        other = readings.copy()
        for column, factor, offset in self.changes:
            other[:, column] = (readings[:, column] - offset) / factor
        return other


def _length(name: str, found: str, millimetres: float) -> Slip:
    return Slip(name, found, "millimetres", ((0, 1.0 / millimetres, 0.0),))


QUARTER = 0.5 * np.pi
GON, RADIAN = (FACTOR["deg"] / FACTOR[unit] for unit in ("gon", "rad"))

UNIT_SLIPS = (
    _length("inch", "inches", 25.4),
    _length("metre", "metres", 1e3),
    _length("micrometre", "micrometres", 1e-3),
    _length("centimetre", "centimetres", 10.0),
    _length("foot", "feet", 304.8),
    Slip("gon", "gon", "degrees", ((1, GON, 0.0), (2, GON, 0.0))),
    Slip("radian", "radians", "degrees", ((1, RADIAN, 0.0), (2, RADIAN, 0.0))),
    Slip("gon-azimuth", "gon", "degrees of the azimuth", ((1, GON, 0.0),)),
    Slip("gon-elevation", "gon", "degrees of the elevation", ((2, GON, 0.0),)),
    Slip("zenith", "zenith angles", "elevations", ((2, -1.0, QUARTER),)),
    Slip("zenith-gon", "zenith angles in gon", "elevations in degrees", ((1, GON, 0.0), (2, -GON, GON * QUARTER))),
    Slip("clockwise", "clockwise azimuths", "counter-clockwise ones", ((1, -1.0, 0.0),)),
)
"""Another unit, or another way to count; a reading becomes what is written in the wrong unit, read as the right one."""

FACE_SLIPS = (
    Slip("face-azimuth", "the azimuth of the other face", "that of its own", ((1, 1.0, np.pi),)),
    Slip("face-elevation", "the elevation of the other face", "that of its own", ((2, -1.0, np.pi),)),
)
"""One angle of the other face."""

FULL_RADIANS = 2 * np.pi + 0.01
SHORTEST_MM = 200.0
MAX_CHORDS = 400
DIFFERENT, ALIKE = 2e-3, 2e-4
"""Relative disagreement of lengths that no right file has, and that no wrong one has."""


def clouds_of(points: Floats, station: Ints, target: Ints) -> dict[int, dict[int, Floats]]:
    """Mean place of each target as each station sees it, by their indices; rows (n, 3) with NaN are ignored."""
    good = np.all(np.isfinite(points), axis=1)
    count = int(target.max(initial=0)) + 1
    keys, place = np.unique(station[good] * count + target[good], return_inverse=True)
    mean = np.zeros((len(keys), 3))
    np.add.at(mean, place, points[good])
    mean /= np.bincount(place, minlength=len(keys))[:, None]
    clouds: dict[int, dict[int, Floats]] = {}
    for key, point in zip(keys.tolist(), mean, strict=True):
        clouds.setdefault(key // count, {})[key % count] = point
    return clouds


def chord_gap(points: Floats, station: Ints, target: Ints) -> float:
    """Median relative disagreement of the lengths between common targets as two stations see them.

    Lengths do not depend on poses: they judge units and the meaning of the vertical angle, not handedness.

    `points` (n, 3) are in each station's frame. NaN where no two stations share two targets.
    """
    clouds = clouds_of(points, station, target).values()
    gaps: list[float] = []
    for one, other in itertools.islice(itertools.combinations(clouds, 2), MAX_CHORDS):
        common = sorted(one.keys() & other.keys())[:60]
        if len(common) < 2 or len(gaps) >= MAX_CHORDS:
            continue
        here = np.array([one[k] for k in common])
        there = np.array([other[k] for k in common])
        lengths = [np.linalg.norm(np.diff(p, axis=0, append=p[:1]), axis=1) for p in (here, there)]
        scale = np.maximum(lengths[0] + lengths[1], 1e-9) / 2
        gaps += np.abs((lengths[0] - lengths[1]) / scale).tolist()
    return float(np.median(gaps)) if gaps else float("nan")


def _two_face_sums(angle: Floats, station: Ints, target: Ints, face: Ints) -> Floats:
    """Sums of the vertical angle on both faces, one per station and target that were seen on both."""
    keys, place = np.unique(station * (int(target.max(initial=0)) + 1) + target, return_inverse=True)
    means = []
    for one in (1, 2):
        rows = (face == one) & np.isfinite(angle)
        count = np.bincount(place[rows], minlength=len(keys))
        total = np.bincount(place[rows], weights=angle[rows], minlength=len(keys))
        means.append(total / np.where(count > 0, count, np.nan))
    sums = means[0] + means[1]
    return np.asarray(sums[np.isfinite(sums)])


def check_degrees(measured: Floats, station: Ints, target: Ints, face: Ints, file: object) -> None:
    """Refuse columns that look like another unit or another angle.

    `measured` (n, 3) are distances [mm], azimuths and elevations [deg]. Raises RecordError; the sentence says what the
    column looks like.
    """
    elevation = measured[:, 2]
    longest = float(np.nanmax(measured[:, 0], initial=-np.inf))
    if -np.inf < longest < SHORTEST_MM:
        message = f"no distance exceeds {longest:.4g}, which looks like metres; expected millimetres"
        raise FilePlace(file, column="distance_mm").wrong(message)
    sums = _two_face_sums(elevation, station, target, face)
    middle = float(np.median(sums)) if len(sums) else float("nan")
    for slip in UNIT_SLIPS:
        expected = _sum_of_faces(slip)
        if expected is not None and abs(middle - expected) < 0.005 * expected:
            message = (
                f"the two faces add up to {middle:.4g}, which looks like {slip.found}; "
                "expected elevations in degrees, where they add up to 180"
            )
            raise FilePlace(file, column="elevation_deg").wrong(message)
    _check_not_radians(measured, station, target, file)
    _check_faces(elevation, face, file)
    readings = measured * [MILLIMETRE, DEGREE, DEGREE]
    if (found := slip_by_lengths(readings, station, target)) is not None:
        message = (
            "two stations see other lengths between their targets, and the same ones if the column holds "
            f"{found.found}; expected {found.expected}"
        )
        raise FilePlace(file, column=("azimuth_deg", "elevation_deg")[found.columns[0] - 1]).wrong(message)


def _sum_of_faces(slip: Slip) -> float | None:
    """Sum [deg] of the vertical angles of a target on both faces under a slip; None if that is 180 too."""
    for column, factor, offset in slip.changes:
        if column == 2:
            total = factor * 180.0 + 2.0 * offset / DEGREE
            return total if abs(total) > 1e-9 else abs(factor) * 360.0
    return None


def slip_by_lengths(readings: Floats, station: Ints, target: Ints) -> Slip | None:
    """The slip of all angles that makes stations see the same lengths between targets, where as it stands they do not.

    `readings` (n, 3) are raw [m, rad, rad]. None where the lengths agree as they are, or nothing makes them agree. No
    length tells of a mirrored network.
    """
    if not chord_gap(from_polar(readings), station, target) > DIFFERENT:
        return None
    angular = [slip for slip in UNIT_SLIPS if 0 not in slip.columns]
    gaps = [chord_gap(from_polar(slip.mended(readings)), station, target) for slip in angular]
    best = int(np.argmin(gaps))
    return angular[best] if gaps[best] < ALIKE else None


def _check_not_radians(measured: Floats, station: Ints, target: Ints, file: object) -> None:
    angles = [a[np.isfinite(a)] for a in measured.T[1:]]
    if max((float(np.abs(a).max()) for a in angles if len(a)), default=np.inf) > FULL_RADIANS:
        return
    wide = [len(a) > 2 and np.ptp(a) > limit for a, limit in zip(angles, (1.0, 0.3), strict=True)]
    readings = measured * [MILLIMETRE, 1.0, 1.0]
    as_radians = chord_gap(from_polar(readings), station, target)
    as_degrees = chord_gap(from_polar(readings * [1.0, DEGREE, DEGREE]), station, target)
    if any(wide) and not as_degrees <= as_radians:
        values = angles[wide.index(True)]
        looks = f"all angles lie between {values.min():.4g} and {values.max():.4g}, which looks like radians"
        column = "azimuth_deg" if wide[0] else "elevation_deg"
        raise FilePlace(file, column=column).wrong(f"{looks}; expected degrees")


def _check_faces(elevation: Floats, face: Ints, file: object) -> None:
    back: Bools = (face == 2) & np.isfinite(elevation)
    reduced = back & (np.abs(elevation) < 90)
    if np.count_nonzero(reduced) > 2 and np.all(reduced == back):
        row = int(np.flatnonzero(reduced)[0])
        message = (
            f"face 2 holds {elevation[row]:.6g}, as all its elevations reduced to face 1; "
            f"expected raw encoder readings, here near {180 - elevation[row]:.6g}"
        )
        raise FilePlace(file, row + 1, "elevation_deg").wrong(message)
