"""Conventions of a file of polar readings: unit of angles, zenith angle or elevation, sense of azimuth, unit of length.

The data decide and a note reports the decision, or an error asks for a hint; nothing is assumed silently. Readings on
two faces determine unit and kind of the vertical angle, because they add up to a full or a half circle. With one face,
the lengths between targets common to two stations decide: they agree only in the right unit. The sense of the azimuth
needs coordinates or poses from another source, because the mirror image of a network has the same lengths and the same
sums of both faces.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import NetworkError, RecordError
from ltsim.core.limits import MAX_NETWORK_SETUPS, overridable_limit
from ltsim.core.notation import names_text
from ltsim.core.units import DEGREE, MILLIMETRE, SI_PER_UNIT
from ltsim.geometry.polar import from_polar
from ltsim.geometry.rigid import align_rigidly, rotation_about_z
from ltsim.recordings.coordinates import read_points
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Setup
from ltsim.recordings.transcription_errors import (
    MIN_LONGEST_DISTANCE_MM,
    length_disagreement,
    most_shared_target_pairs,
    position_disagreement,
    station_clouds,
)

AngleUnit = Literal["deg", "gon", "rad"]
VerticalKind = Literal["zenith", "elevation"]
AzimuthSense = Literal["clockwise", "counter-clockwise"]
LengthUnit = Literal["mm", "m"]
StationPoseArrays = tuple[Floats, Floats]
"""Pose of a station: rotation (3, 3) from the station frame to the network frame, and position (3,) [m]."""
AngleConvention = tuple[AngleUnit, VerticalKind]
FULL_CIRCLE_BY_UNIT = {"deg": 360.0, "gon": 400.0, "rad": 2 * np.pi}
HINTED_ANGLE_UNITS: tuple[AngleUnit, ...] = ("deg", "gon", "rad")
"""Possible units of the angles in a file; the data or a hint decide among them."""
VERTICAL_KINDS: tuple[VerticalKind, ...] = ("zenith", "elevation")
MIN_SECOND_TO_BEST_RATIO = 10.0
"""Ratio of the misfit of the second-best convention to that of the best one from which on the data decide."""
MAX_MIRROR_MISFIT_TO_NETWORK_SIZE = 1e-3
"""Median distance of mirrored points from reference points, divided by the network's size, below which they fit."""
MAX_ROWS_IN_NOTE = 3
"""Largest number of rows that a note lists, and of sentences on mirror images that are reported."""
MIN_TARGET_INTERVAL_S = 0.1
"""Shortest plausible median time [s] between consecutive targets; a shorter one raises a question about the clock."""
MAX_TARGET_INTERVAL_S = 7200.0
"""Longest plausible median time [s] between consecutive targets; a longer one raises a question about the clock."""
MIN_TARGET_CHANGES = 8
"""Number of changes from one target to the next below which the time between targets is not judged."""


@dataclass(frozen=True)
class Hints:
    """Decisions of the user on an ambiguous file; None leaves a decision to the data.

    `angle` and `length` are units, `vertical` the kind of vertical angle, `azimuth` its sense. `points` is a file of
    coordinates (name, x, y, z) in a right-handed frame, which decides the sense of the azimuth. `station` names the
    set-up of a file that contains no name. `columns` assigns the columns of a table (``target=Name,azimuth=Hz[gon]``).
    `setup` is a `setup.toml` for the file, `date` the order of day and month in dates with slashes. A file that is
    still growing (`incomplete_tail`) may end inside a row and may lack targets of reference lengths.
    """

    angle: AngleUnit | None = None
    vertical: VerticalKind | None = None
    azimuth: AzimuthSense | None = None
    length: LengthUnit | None = None
    points: Path | None = None
    station: str | None = None
    columns: str | None = None
    setup: Path | None = None
    date: Literal["dmy", "mdy"] | None = None
    incomplete_tail: bool = False


NO_HINTS = Hints()


@dataclass(frozen=True)
class PolarReadings:
    """Polar readings (n,) of n pointings in the units of a file: indices of station and target, angles, distance."""

    station: Ints
    target: Ints
    horizontal_angles: Floats
    vertical_angles: Floats
    distance: Floats

    def points(self, angle: AngleUnit, vertical_kind: VerticalKind) -> Floats:
        """Coordinates (n, 3) of the n measured points in each station's frame, with counter-clockwise azimuths.

        `angle` is the unit of the angles, `vertical_kind` the kind of the vertical angles; the coordinates have the
        unit of the distances.
        """
        vertical_angle = self.vertical_angles * SI_PER_UNIT[angle]
        elevation = np.pi / 2 - vertical_angle if vertical_kind == "zenith" else vertical_angle
        return from_polar(np.stack([self.distance, self.horizontal_angles * SI_PER_UNIT[angle], elevation], axis=1))


def angle_convention(polar: PolarReadings, hints: Hints, file: object) -> tuple[AngleUnit, VerticalKind, list[str]]:
    """Unit of the angles, kind of the vertical angles, and notes on decisions from the data; `file` is named in errors.

    Raises RecordError, which asks for a hint, if the data do not decide.
    """
    angles = HINTED_ANGLE_UNITS if hints.angle is None else (hints.angle,)
    verticals = VERTICAL_KINDS if hints.vertical is None else (hints.vertical,)
    candidates = [
        (a, v)
        for a in angles
        for v in verticals
        if _is_possible_convention(polar, a, v, is_declared=hints.vertical is not None)
    ]
    if not candidates:
        raise RecordError("the angles have none of the units deg, gon and rad; check the columns", file=file)
    convention, reason = candidates[0], "no other interpretation fits the values"
    if len(candidates) > 1:
        convention, reason = (
            _convention_from_faces(polar, candidates)
            or _convention_from_lengths(polar, candidates)
            or _raise_missing_hint(polar, candidates, file)
        )
    notes = []
    if hints.angle is None or hints.vertical is None:
        notes.append(
            f"angles are interpreted as {convention[0]}, the vertical ones as {convention[1]} angles ({reason})"
        )
    return (*convention, notes)


def _is_possible_convention(
    polar: PolarReadings, angle: AngleUnit, vertical: VerticalKind, *, is_declared: bool
) -> bool:
    """True if every value lies within the circle, and the vertical angles are within the travel of an instrument.

    An elevation beyond the zenith occurs on face 2 only. A file with such values, but without a target on two faces,
    therefore holds zenith angles, unless the user declared the kind of vertical angle (`is_declared`).
    """
    circle = FULL_CIRCLE_BY_UNIT[angle]
    horizontal, readings = polar.horizontal_angles, polar.vertical_angles
    if np.nanmax(np.abs(horizontal), initial=0) > circle * 1.001 or np.nanmax(np.abs(readings), initial=0) > circle:
        return False
    if vertical == "elevation":
        highest = float(np.nanmax(readings, initial=0))
        within = float(np.nanmin(readings, initial=0)) >= -circle / 4 and highest <= 0.75 * circle
        return within and (is_declared or highest <= circle / 4 or _count_two_face_pairs(polar, angle, vertical) > 0)
    return bool(np.nanmin(readings, initial=0) >= 0)


def _same_target_rows(polar: PolarReadings) -> tuple[Ints, Ints]:
    """Rows of k pairs of successive pointings from a station to one target: earlier ones (k,), later ones (k,)."""
    order = np.lexsort((np.arange(len(polar.station)), polar.target, polar.station))
    first, next_ = order[:-1], order[1:]
    is_repeated = (polar.station[first] == polar.station[next_]) & (polar.target[first] == polar.target[next_])
    return first[is_repeated], next_[is_repeated]


def _count_two_face_pairs(polar: PolarReadings, angle: AngleUnit, vertical_kind: VerticalKind) -> int:
    """Number of pairs of rows with one target on both faces: azimuths half a circle apart, matching vertical angles."""
    first, other = _same_target_rows(polar)
    circle = FULL_CIRCLE_BY_UNIT[angle]
    sum_of_faces = circle if vertical_kind == "zenith" else circle / 2
    azimuth_misfit = np.abs(
        np.mod(polar.horizontal_angles[first] - polar.horizontal_angles[other], circle) - circle / 2
    )
    vertical_misfit = np.abs(polar.vertical_angles[first] + polar.vertical_angles[other] - sum_of_faces)
    is_two_face_pair: Bools = (azimuth_misfit < 1e-3 * circle) & (vertical_misfit < 1e-3 * circle)
    return int(is_two_face_pair.sum())


def _convention_from_faces(
    polar: PolarReadings, candidates: list[AngleConvention]
) -> tuple[AngleConvention, str] | None:
    """Candidate (unit, kind of vertical angle) with which most repeated targets are on two faces; this reason as text.

    None without `MIN_SECOND_TO_BEST_RATIO` times as many such targets as with any other candidate.
    """
    counts = [_count_two_face_pairs(polar, angle, vertical) for angle, vertical in candidates]
    best_index = int(np.argmax(counts))
    if counts[best_index] < 2 or sorted(counts)[-2] * MIN_SECOND_TO_BEST_RATIO > counts[best_index]:
        return None
    return candidates[best_index], f"the readings of {counts[best_index]} targets on both faces then agree"


def _convention_from_lengths(
    polar: PolarReadings, candidates: list[AngleConvention]
) -> tuple[AngleConvention, str] | None:
    """Candidate (unit, kind of vertical angle) with which stations measure equal lengths; this reason as text.

    None if no candidate, or more than one, makes the lengths between targets equal.
    """
    misfits = [length_disagreement(polar.points(unit, kind), polar.station, polar.target) for unit, kind in candidates]
    if not np.all(np.isfinite(misfits)):
        return None
    first, second = np.argsort(misfits)[:2]
    if misfits[first] > 1e-2 or misfits[first] * MIN_SECOND_TO_BEST_RATIO > misfits[second]:
        return None
    accuracy = 1 / max(misfits[first], 1e-9)
    return candidates[first], f"two stations then measure equal lengths within 1 part in {accuracy:.0f}"


def _raise_missing_hint(
    polar: PolarReadings, candidates: list[AngleConvention], file: object
) -> tuple[AngleConvention, str]:
    """RecordError that asks which candidate is right, with the option to type; the function never returns."""
    has_common_unit = len({a for a, _ in candidates}) == 1
    has_vertical_angles = bool(np.isfinite(polar.vertical_angles).any())
    kinds = [f"{kind} angles" if has_vertical_angles else "horizontal angles" for _, kind in candidates]
    choices = " or ".join(
        kind if has_common_unit else f"{kind} in {unit}" for kind, (unit, _) in zip(kinds, candidates, strict=True)
    )
    hints = [] if has_common_unit else [f"--hint angle={candidates[0][0]}"]
    hints += [f"--hint vertical={candidates[0][1]}"] if len({v for _, v in candidates}) > 1 else []
    message = f"the angles may be {choices}, and the data do not decide which; give {' '.join(hints)}"
    raise RecordError(message, file=file)


def length_unit_from_size(distance: Floats, hints: Hints) -> tuple[LengthUnit, list[str]]:
    """Unit of n distances (n,), and notes on it: m if the longest is below `MIN_LONGEST_DISTANCE_MM`, otherwise mm."""
    if hints.length is not None:
        return hints.length, []
    longest = float(np.nanmax(distance, initial=0))
    length_unit: LengthUnit = "m" if longest < MIN_LONGEST_DISTANCE_MM else "mm"
    return length_unit, [f"distances are interpreted as {length_unit} (the longest is {longest:.6g})"]


AZIMUTH_SENSE_UNKNOWN_NOTE = (
    "this file does not show whether azimuths run clockwise, because its mirror image fits as well; give "
    "--hint azimuth=clockwise or --hint azimuth=counter-clockwise, or the coordinates of some targets with "
    "--hint points=FILE"
)


def azimuth_sense_from_points(
    local_points: Floats, polar: PolarReadings, targets: Sequence[str], file: Path
) -> tuple[AzimuthSense, list[str]]:
    """Sense of the azimuth from coordinates of targets in `file`, and notes on it.

    `local_points` (n, 3) [m] are n measured positions in each station's frame, with counter-clockwise azimuths.
    `targets` are the names to which the indices `polar.target` refer. Raises RecordError if the coordinates do not
    decide.
    """
    point_list = read_points(file, refuses_contradictions=False)
    index_of = {name: i for i, name in enumerate(targets)}
    points = {index_of[n]: p for n, p in zip(point_list.names, point_list.points, strict=True) if n in index_of}
    azimuth = _azimuth_sense_by_alignment(local_points, polar, points)
    if azimuth is None:
        message = f"the coordinates of {len(points)} targets do not decide whether azimuths run clockwise; give "
        raise RecordError(message + "--hint azimuth=clockwise or --hint azimuth=counter-clockwise", file=file)
    return azimuth, [
        f"azimuths are interpreted as {azimuth} (the targets then fit the coordinates in {file.name})",
        *point_list.notes,
    ]


def _azimuth_sense_by_alignment(
    local_points: Floats, polar: PolarReadings, points_by_target: Mapping[int, Floats]
) -> AzimuthSense | None:
    """Sense of the azimuth with which the targets of each station fit `points_by_target` [m] after a rigid alignment.

    `local_points` (n, 3) [m] are positions measured in n pointings, computed with counter-clockwise azimuths. None if
    neither sense fits ten times better than the other, for example if all points lie in one plane.
    """
    station_senses = []
    is_usable = np.isin(polar.target, list(points_by_target)) & np.all(np.isfinite(local_points), axis=1)
    usable_rows = np.flatnonzero(is_usable)
    usable_rows = usable_rows[np.argsort(polar.station[usable_rows], kind="stable")]
    for rows in np.split(usable_rows, np.flatnonzero(np.diff(polar.station[usable_rows])) + 1):
        if len(np.unique(polar.target[rows])) < 4:
            continue
        fixed_points = np.array([points_by_target[int(t)] for t in polar.target[rows]])
        misfit = _rigid_misfits(local_points[rows], fixed_points)
        if max(misfit) > MIN_SECOND_TO_BEST_RATIO * min(misfit):
            station_senses.append(int(np.argmin(misfit)))
    return _unanimous_sense(station_senses)


def _rigid_misfits(points: Floats, fixed_points: Floats) -> list[float]:
    """Median distances [m] from n `fixed_points` (n, 3): of `points` (n, 3), and of their mirror image.

    Both are first aligned rigidly with `fixed_points`. A median distance is 1 m if the alignment is not possible.
    """
    misfits = []
    for y_sign in (1.0, -1.0):
        image = points * [1.0, y_sign, 1.0]
        try:
            rotation, shift = align_rigidly(image, fixed_points)
            misfits.append(float(np.median(np.linalg.norm(image @ rotation.T + shift - fixed_points, axis=1))) + 1e-9)
        except NetworkError:
            misfits.append(1.0)
    return misfits


def azimuth_sense_from_poses(
    local_points: Floats, polar: PolarReadings, poses: Mapping[int, StationPoseArrays]
) -> AzimuthSense | None:
    """Sense of the azimuth with which stations of known pose (by station index) measure equal positions of targets.

    `local_points` (n, 3) [m] are positions measured in n pointings, in the frame of their station, computed with
    counter-clockwise azimuths. None if the data do not decide.
    """
    misfits = []
    rows = np.flatnonzero(np.isin(polar.station, list(poses)))
    stations, index = np.unique(polar.station[rows], return_inverse=True)
    rotations = np.array([poses[int(s)][0] for s in stations]).reshape(-1, 3, 3)
    positions = np.array([poses[int(s)][1] for s in stations]).reshape(-1, 3)
    for y_sign in (1.0, -1.0):
        points = np.full_like(local_points, np.nan)
        images = local_points[rows] * [1.0, y_sign, 1.0]
        points[rows] = np.einsum("nij,nj->ni", rotations[index], images) + positions[index]
        misfits.append(position_disagreement(points, polar.station, polar.target))
    if not np.all(np.isfinite(misfits)) or max(misfits) < MIN_SECOND_TO_BEST_RATIO * min(misfits):
        return None
    return _unanimous_sense([int(np.argmin(misfits))])


def _unanimous_sense(station_senses: list[int]) -> AzimuthSense | None:
    """Sense of the azimuth in which all stations agree (0 counter-clockwise, 1 clockwise); None if they do not."""
    if not station_senses or min(station_senses) != max(station_senses):
        return None
    return "clockwise" if station_senses[0] else "counter-clockwise"


def clock_questions(recording: Recording) -> tuple[str, ...]:
    """Question about the unit of time, if the median time between targets is implausible; otherwise empty."""
    is_change = (np.diff(recording.target) != 0) & (np.diff(recording.station) == 0)
    paces = np.abs(np.diff(recording.time))[is_change]
    paces = paces[np.isfinite(paces)]
    if not recording.has_clock or len(paces) < MIN_TARGET_CHANGES:
        return ()
    pace = float(np.median(paces))
    if MIN_TARGET_INTERVAL_S <= pace <= MAX_TARGET_INTERVAL_S:
        return ()
    span_s = float(np.nanmax(recording.time) - np.nanmin(recording.time))
    return (
        f"the {len(recording)} pointings take {span_s:.4g} s, {pace:.3g} s from one target to the next: check the unit "
        "of the time column and give it with --columns, such as time=HEADER[h]; drifts in time depend on it",
    )


def vertical_pointings_notes(recording: Recording) -> tuple[str, ...]:
    """Note on pointings along the vertical axis, of which an adjustment uses only the distances; empty without them."""
    vertical_rows = np.flatnonzero(recording.is_along_standing_axis & recording.is_measured[:, 1:].any(axis=1))
    if not len(vertical_rows):
        return ()
    listed_rows = names_text([recording.row_text(int(row) + 1) for row in vertical_rows], MAX_ROWS_IN_NOTE)
    return (
        f"{listed_rows}: along the vertical axis of the tracker the azimuth is undefined, so the angles are not used; "
        "to locate this target from there, tilt or move the tracker",
    )


def mirror_image_sentences(recording: Recording) -> tuple[str, ...]:
    """Sentences on stations whose readings fit the declared positions, or another station, only as a mirror image.

    Coordinates in one plane, or a floor plan that fits neither sense, give no sentence. A recording with more set-ups
    than a network may have is not examined.
    """
    if len(recording.stations) > overridable_limit(MAX_NETWORK_SETUPS):
        return ()
    local_points = from_polar(recording.readings)
    polar = PolarReadings(recording.station, recording.target, *recording.readings[:, [1, 2, 0]].T)
    poses = rough_poses(recording.setup, recording.stations)
    notes = []
    if len(poses) > 1 and azimuth_sense_from_poses(local_points, polar, poses) == "clockwise":
        notes.append(
            "the declared positions of the stations fit only the mirror image of the readings: if the azimuths run "
            "clockwise give --hint azimuth=clockwise, otherwise the floor plan is left-handed"
        )
    for first, other in _mirrored_station_pairs(local_points, recording):
        notes.append(
            f"the targets of {recording.stations[first]} and {recording.stations[other]} fit each other only as mirror "
            "images: the azimuths of one of these stations run clockwise"
        )
    return tuple(notes[:MAX_ROWS_IN_NOTE])


def _mirrored_station_pairs(local_points: Floats, recording: Recording) -> list[tuple[int, int]]:
    """Mirror-image pairs of stations: each station and the earlier one with which it shares most targets (indices)."""
    measured = np.isfinite(local_points).all(axis=1)
    clouds, pairs = station_clouds(local_points, recording.station, recording.target), []
    stations, targets = recording.station[measured], recording.target[measured]
    for other, s in most_shared_target_pairs(stations, targets, len(recording.stations)):
        here, there = clouds[s].common_points(clouds[other])
        misfit, mirror = _rigid_misfits(here, there)
        extent = float(np.ptp(there, axis=0).max())
        if misfit > MIN_SECOND_TO_BEST_RATIO * mirror and mirror < MAX_MIRROR_MISFIT_TO_NETWORK_SIZE * extent:
            pairs.append((other, s))
    return pairs


def rough_poses(setup: Setup, names: Sequence[str]) -> dict[int, StationPoseArrays]:
    """Rough pose of stations by index in `names`, if the floor plan has both position and direction of azimuth zero."""
    poses = {}
    for i, name in enumerate(names):
        station = setup.stations.get(name)
        if station is not None and station.position_mm is not None and station.yaw_deg is not None:
            poses[i] = rotation_about_z(station.yaw_deg * DEGREE), np.array(station.position_mm) * MILLIMETRE
    return poses
