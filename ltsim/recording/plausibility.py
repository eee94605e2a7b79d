"""Columns that do not hold what they promise: radians as degrees, metres as millimetres, gon, zenith angles.

Single odd readings are left alone: a wrong unit in one row is a gross error for the diagnosis to find, in all
rows it is a wrong file.
"""

from __future__ import annotations

import itertools

import numpy as np

from ltsim.arrays import Bools, Floats, Ints
from ltsim.errors import RecordError
from ltsim.geometry.polar import from_polar
from ltsim.recording.slips import UNIT_SLIPS, Slip
from ltsim.units import DEGREE, MILLIMETRE

FULL_RADIANS = 2 * np.pi + 0.01
SHORTEST_MM = 200.0
MAX_CHORDS = 400
DIFFERENT, ALIKE = 2e-3, 2e-4
"""Relative disagreement of lengths that no right file has, and that no wrong one has."""


def chord_gap(points: Floats, station: Ints, target: Ints) -> float:
    """Median relative disagreement of the lengths between common targets as two stations see them.

    Lengths do not depend on poses: they judge units and the meaning of the vertical angle, not handedness.

    Parameters
    ----------
    points : (n, 3) float, [m]
        In each station's frame; rows with NaN are ignored.
    station, target : (n,) int

    Returns
    -------
    float
        NaN where no two stations share two targets.
    """
    good = np.all(np.isfinite(points), axis=1)
    count = int(target.max(initial=0)) + 1
    keys, place = np.unique(station[good] * count + target[good], return_inverse=True)
    mean = np.zeros((len(keys), 3))
    np.add.at(mean, place, points[good])
    mean /= np.bincount(place, minlength=len(keys))[:, None]
    cloud: dict[int, dict[int, Floats]] = {}
    for key, point in zip(keys.tolist(), mean, strict=True):
        cloud.setdefault(key // count, {})[key % count] = point
    gaps: list[float] = []
    for one, other in itertools.islice(itertools.combinations(cloud.values(), 2), MAX_CHORDS):
        common = sorted(one.keys() & other.keys())[:60]
        if len(common) < 2 or len(gaps) >= MAX_CHORDS:
            continue
        here = np.array([one[k] for k in common])
        there = np.array([other[k] for k in common])
        lengths = [np.linalg.norm(np.diff(p, axis=0, append=p[:1]), axis=1) for p in (here, there)]
        scale = np.maximum(lengths[0] + lengths[1], 1e-9) / 2
        gaps += np.abs((lengths[0] - lengths[1]) / scale).tolist()
    return float(np.median(gaps)) if gaps else float("nan")


def two_face_sums(angle: Floats, station: Ints, target: Ints, face: Ints) -> Floats:
    """Sums of the vertical angle on both faces, one per station and target that were seen on both."""
    count = int(target.max(initial=0)) + 1
    key = station * count + target
    keys, place = np.unique(key, return_inverse=True)
    mean = np.full((2, len(keys)), np.nan)
    for f in (1, 2):
        rows = (face == f) & np.isfinite(angle)
        number = np.bincount(place[rows], minlength=len(keys))
        total = np.bincount(place[rows], weights=angle[rows], minlength=len(keys))
        seen = number > 0
        mean[f - 1, seen] = total[seen] / number[seen]
    sums = mean.sum(axis=0)
    return np.asarray(sums[np.isfinite(sums)])


def check_degrees(
    azimuth: Floats,
    elevation: Floats,
    distance: Floats,
    station: Ints,
    target: Ints,
    face: Ints,
    file: object,
) -> None:
    """Refuse columns of angles [deg] that look like another unit or another angle; distances in mm.

    Raises
    ------
    RecordError
        The sentence says what the column looks like.
    """
    _check_millimetres(distance, file)
    sums = two_face_sums(elevation, station, target, face)
    middle = float(np.median(sums)) if len(sums) else float("nan")
    for slip in UNIT_SLIPS:
        expected = _sum_of_faces(slip)
        if expected is not None and abs(middle - expected) < 0.005 * expected:
            message = (
                f"the two faces add up to {middle:.4g}, which looks like {slip.found}; "
                "expected elevations in degrees, where they add up to 180"
            )
            raise RecordError(message, file=file, column="elevation_deg")
    _check_not_radians(azimuth, elevation, distance, station, target, file)
    _check_faces(elevation, face, file)
    readings = np.stack([distance * MILLIMETRE, azimuth * DEGREE, elevation * DEGREE], axis=1)
    if (found := slip_by_lengths(readings, station, target)) is not None:
        message = (
            "two stations see other lengths between their targets, and the same ones if the column holds "
            f"{found.found}; expected {found.expected}"
        )
        raise RecordError(message, file=file, column=("azimuth_deg", "elevation_deg")[found.columns[0] - 1])


def _sum_of_faces(slip: Slip) -> float | None:
    """What the vertical angles of a target on both faces add up to [deg] under a slip; None if that is 180 too."""
    for column, factor, offset in slip.changes:
        if column == 2:
            total = factor * 180.0 + 2.0 * offset / DEGREE
            return total if abs(total) > 1e-9 else abs(factor) * 360.0
    return None


def slip_by_lengths(readings: Floats, station: Ints, target: Ints) -> Slip | None:
    """The slip of all angles that makes stations see the same lengths between targets, where as it stands they do not.

    Parameters
    ----------
    readings : (n, 3) float
        Raw range [m], azimuth and elevation [rad].
    station, target : (n,) int

    Returns
    -------
    Slip or None
        None where the lengths agree as they are, or nothing makes them agree. No length tells of a mirrored network.
    """
    if not chord_gap(from_polar(readings), station, target) > DIFFERENT:
        return None
    angular = [slip for slip in UNIT_SLIPS if 0 not in slip.columns]
    gaps = [chord_gap(from_polar(slip.mended(readings)), station, target) for slip in angular]
    best = int(np.argmin(gaps))
    return angular[best] if gaps[best] < ALIKE else None


def _check_millimetres(distance: Floats, file: object) -> None:
    known = distance[np.isfinite(distance)]
    if len(known) and float(known.max()) < SHORTEST_MM:
        message = f"no distance exceeds {known.max():.4g}, which looks like metres; expected millimetres"
        raise RecordError(message, file=file, column="distance_mm")


def _check_not_radians(
    azimuth: Floats, elevation: Floats, distance: Floats, station: Ints, target: Ints, file: object
) -> None:
    angles = [a[np.isfinite(a)] for a in (azimuth, elevation)]
    if max((float(np.abs(a).max()) for a in angles if len(a)), default=np.inf) > FULL_RADIANS:
        return
    wide = [len(a) > 2 and np.ptp(a) > limit for a, limit in zip(angles, (1.0, 0.3), strict=True)]
    readings = np.stack([distance * MILLIMETRE, azimuth, elevation], axis=1)
    as_radians = chord_gap(from_polar(readings), station, target)
    as_degrees = chord_gap(from_polar(readings * [1.0, DEGREE, DEGREE]), station, target)
    if any(wide) and not as_degrees <= as_radians:
        column = "azimuth_deg" if wide[0] else "elevation_deg"
        values = angles[0 if wide[0] else 1]
        message = (
            f"all angles lie between {values.min():.4g} and {values.max():.4g}, which looks like radians; "
            "expected degrees"
        )
        raise RecordError(message, file=file, column=column)


def _check_faces(elevation: Floats, face: Ints, file: object) -> None:
    back: Bools = (face == 2) & np.isfinite(elevation)
    reduced = back & (np.abs(elevation) < 90)
    if np.count_nonzero(reduced) > 2 and np.all(reduced == back):
        row = int(np.flatnonzero(reduced)[0])
        message = (
            f"face 2 holds {elevation[row]:.6g}, as all its elevations reduced to face 1; "
            f"expected raw encoder readings, here near {180 - elevation[row]:.6g}"
        )
        raise RecordError(message, file=file, row=row + 1, column="elevation_deg")
