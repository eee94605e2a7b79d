"""Conventions of a file of polar readings: unit of angles, zenith angle or elevation, sense of azimuth, unit of length.

The data decide, and a note reports the decision; if the data are ambiguous, an error asks the user for a hint. Readings
in both faces determine the unit and the kind of the vertical angle by their sum, a full circle for zenith angles and
half a circle for elevations. With one face, lengths between targets common to two stations decide, which agree only in
the correct unit. The sense of the azimuth needs known coordinates or poses: a mirrored network has the same lengths.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import NetworkError, RecordError
from ltsim.core.limits import MAX_NETWORK_SETUPS, overridable_limit
from ltsim.core.notation import names_text
from ltsim.core.units import DEGREE, MILLIMETRE, SI_PER_UNIT
from ltsim.geometry.polar import from_polar
from ltsim.geometry.rigid import align_rigidly, rotation_about_z
from ltsim.recordings.coordinates import read_points
from ltsim.recordings.hints import AngleUnit, AzimuthSense, Hints, LengthUnit, VerticalKind
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Setup
from ltsim.recordings.transcription_errors import (
    MIN_LONGEST_DISTANCE_MM,
    length_disagreement,
    most_shared_target_pairs,
    position_disagreement,
    target_points_by_station,
)

StationPoseArrays = tuple[Floats, Floats]
"""Pose of a station: rotation (3, 3) from the station frame to the network frame, and position (3,) [m]."""
AngleConvention = tuple[AngleUnit, VerticalKind]
FULL_CIRCLE_BY_UNIT = {"deg": 360.0, "gon": 400.0, "rad": 2 * np.pi}
POSSIBLE_ANGLE_UNITS: tuple[AngleUnit, ...] = ("deg", "gon", "rad")
"""Units that the angles of a file may have; the data or the user's hint decide which."""
VERTICAL_ANGLE_KINDS: tuple[VerticalKind, ...] = ("zenith", "elevation")
MIN_DECISIVE_CONVENTION_RATIO = 10.0
"""Limit of the ratio with which the data decide between two conventions (such as gon or degrees): of the misfits
(second-best to best), or of the numbers of agreeing targets (best to second-best). Below the limit nothing is decided.
"""
MAX_RELATIVE_MIRROR_MISFIT = 1e-3
"""Limit for agreement of mirrored points with reference points: median distance, divided by the size of the network."""
MAX_ROWS_IN_NOTE = 3
"""Largest number of rows that one note lists; also the largest number of warnings about mirror images."""


@dataclass(frozen=True)
class PolarReadings:
    """Polar readings (n,) of n pointings as written in a file: indices of station and target, angles, distance."""

    station: Ints
    target: Ints
    horizontal_angles: Floats
    vertical_angles: Floats
    distance: Floats

    def points(self, angle: AngleUnit, vertical_kind: VerticalKind) -> Floats:
        """Coordinates (n, 3) of n points in the frames of their stations, in the unit of the distances.

        `angle` is the unit of the angles, `vertical_kind` the kind of the vertical ones; azimuths are taken as
        counter-clockwise.
        """
        vertical_angle = self.vertical_angles * SI_PER_UNIT[angle]
        elevation = np.pi / 2 - vertical_angle if vertical_kind == "zenith" else vertical_angle
        return from_polar(np.stack([self.distance, self.horizontal_angles * SI_PER_UNIT[angle], elevation], axis=1))


def angle_convention(polar: PolarReadings, hints: Hints, file: object) -> tuple[AngleUnit, VerticalKind, list[str]]:
    """Unit of angles, kind of vertical angles (zenith angles or elevations), and notes about how the data decided.

    The user's `hints` have priority. Raises RecordError, which names `file` and asks for a hint, if nothing decides.
    """
    angles = POSSIBLE_ANGLE_UNITS if hints.angle is None else (hints.angle,)
    verticals = VERTICAL_ANGLE_KINDS if hints.vertical is None else (hints.vertical,)
    candidates = [
        (a, v)
        for a in angles
        for v in verticals
        if _is_possible_convention(polar, a, v, is_declared=hints.vertical is not None)
    ]
    if not candidates:
        raise RecordError(_no_convention_sentence(polar, angles, hints), file=file)
    convention, reason = candidates[0], "no other interpretation fits the values"
    if len(candidates) > 1:
        convention, reason = (
            _convention_from_faces(polar, candidates)
            or _convention_from_lengths(polar, candidates)
            or _raise_missing_hint(polar, candidates, file)
        )
    notes = []
    if hints.angle is None or hints.vertical is None:
        notes.append(f"angles are interpreted as {convention[0]}, vertical angles as {convention[1]} angles ({reason})")
    return (*convention, notes)


def _no_convention_sentence(polar: PolarReadings, angles: Sequence[AngleUnit], hints: Hints) -> str:
    """Sentence for an error, if the angles fit no convention.

    It says that kinds of vertical angle are mixed, or that the angles fit none of the units `angles`.
    """
    lowest, highest = (float(f(polar.vertical_angles, initial=0)) for f in (np.nanmin, np.nanmax))
    circle = FULL_CIRCLE_BY_UNIT[angles[0]]
    if len(angles) == 1 and hints.vertical is None and lowest < 0 and circle / 4 < highest <= circle:
        return (
            f"the vertical angles contain {lowest:.6g}, which is no zenith angle, and {highest:.6g}, which is no "
            "elevation of face 1: they mix zenith angles and elevations; write all of them in one kind"
        )
    units = "have none of the units deg, gon and rad" if len(angles) > 1 else f"are not in {angles[0]}"
    return f"the angles {units}; check the columns"


def _is_possible_convention(
    polar: PolarReadings, angle: AngleUnit, vertical: VerticalKind, *, is_declared: bool
) -> bool:
    """True if the angles are possible readings in this unit (`angle`) and of this kind of vertical angle (`vertical`).

    All angles must be within a full circle, and vertical angles within the range of an instrument. An elevation beyond
    the zenith is possible in face 2 only. Without targets in both faces, a file with such values therefore contains
    zenith angles, unless the user declared the kind (`is_declared`).
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


def _repeated_pointing_row_pairs(polar: PolarReadings) -> tuple[Ints, Ints]:
    """Row indices of k pairs of successive pointings from one station to one target: earlier (k,), later (k,)."""
    order = np.lexsort((np.arange(len(polar.station)), polar.target, polar.station))
    first, next_ = order[:-1], order[1:]
    is_repeated = (polar.station[first] == polar.station[next_]) & (polar.target[first] == polar.target[next_])
    return first[is_repeated], next_[is_repeated]


def _count_two_face_pairs(polar: PolarReadings, angle: AngleUnit, vertical_kind: VerticalKind) -> int:
    """Number of pairs of rows that show one target in both faces, if angles have the unit `angle` and the given kind.

    The azimuths of such a pair differ by half a circle. Its vertical angles have the sum of both faces: a full circle
    for zenith angles, half a circle for elevations.
    """
    first, other = _repeated_pointing_row_pairs(polar)
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
    """Convention among `candidates` with which most targets are measured in both faces, and text of the reason.

    None unless these targets are `MIN_DECISIVE_CONVENTION_RATIO` times as many as for any other candidate.
    """
    counts = [_count_two_face_pairs(polar, angle, vertical) for angle, vertical in candidates]
    best_index = int(np.argmax(counts))
    if counts[best_index] < 2 or sorted(counts)[-2] * MIN_DECISIVE_CONVENTION_RATIO > counts[best_index]:
        return None
    return candidates[best_index], f"the readings of {counts[best_index]} targets on both faces then agree"


def _convention_from_lengths(
    polar: PolarReadings, candidates: list[AngleConvention]
) -> tuple[AngleConvention, str] | None:
    """Convention among `candidates` with which stations measure equal lengths between targets, and text of the reason.

    The result is None if no candidate, or more than one, gives equal lengths.
    """
    misfits = [length_disagreement(polar.points(unit, kind), polar.station, polar.target) for unit, kind in candidates]
    if not np.all(np.isfinite(misfits)):
        return None
    first, second = np.argsort(misfits)[:2]
    if misfits[first] > 1e-2 or misfits[first] * MIN_DECISIVE_CONVENTION_RATIO > misfits[second]:
        return None
    accuracy = 1 / max(misfits[first], 1e-9)
    return candidates[first], f"two stations then measure equal lengths within 1 part in {accuracy:.0f}"


def _raise_missing_hint(polar: PolarReadings, candidates: list[AngleConvention], file: object) -> NoReturn:
    """RecordError that lists the `candidates` and the options to type; the function always raises it."""
    candidates = sorted(candidates, key=lambda candidate: FULL_CIRCLE_BY_UNIT[candidate[0]])  # directions fill circles
    has_common_unit = len({a for a, _ in candidates}) == 1
    kinds = [f"{k if np.isfinite(polar.vertical_angles).any() else 'horizontal'} angles" for _, k in candidates]
    choices = " or ".join(k if has_common_unit else f"{k} in {a}" for k, (a, _) in zip(kinds, candidates, strict=True))
    hints = [] if has_common_unit else [f"--hint angle={candidates[0][0]}"]
    hints += [f"--hint vertical={candidates[0][1]}"] if len({v for _, v in candidates}) > 1 else []
    message = f"the angles may be {choices}; the data do not decide which, therefore give"
    raise RecordError(f"{message} {' '.join(hints)}", file=file)


def distance_unit_from_size(distance: Floats, hints: Hints) -> tuple[LengthUnit, list[str]]:
    """Unit of n distances (n,), from the hint or else from their size (`MIN_LONGEST_DISTANCE_MM`), and notes."""
    if hints.length is not None:
        return hints.length, []
    longest = float(np.nanmax(distance, initial=0))
    length_unit: LengthUnit = "m" if longest < MIN_LONGEST_DISTANCE_MM else "mm"
    return length_unit, [f"distances are interpreted as {length_unit} (the longest is {longest:.6g})"]


AZIMUTH_SENSE_UNKNOWN_NOTE = (
    "the sense of the azimuths is unknown, because the mirror image of the readings fits equally well; give "
    "--hint azimuth=clockwise or --hint azimuth=counter-clockwise, or the coordinates of some targets with "
    "--hint points=FILE"
)


def azimuth_sense_from_points(
    local_points: Floats, polar: PolarReadings, targets: Sequence[str], file: Path
) -> tuple[AzimuthSense, list[str]]:
    """Sense of the azimuth from known coordinates of targets in `file`, and notes about it; or else RecordError.

    `local_points` (n, 3) [m] are n measured positions in the frames of their stations, computed with counter-clockwise
    azimuths. `targets` are the names to which the indices `polar.target` refer.
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
    """Sense of the azimuth with which the targets of each station fit known points after a rigid alignment.

    `points_by_target` are the known points (3,) [m] by index of the target. `local_points` (n, 3) [m] are the positions
    measured in n pointings, computed with counter-clockwise azimuths. None if neither sense fits ten times better than
    the other, for example if all points lie in one plane.
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
        if max(misfit) > MIN_DECISIVE_CONVENTION_RATIO * min(misfit):
            station_senses.append(int(np.argmin(misfit)))
    return _unanimous_azimuth_sense(station_senses)


def _rigid_misfits(points: Floats, fixed_points: Floats) -> list[float]:
    """Median distances [m] of `points` (n, 3), and of their mirror image, from `fixed_points` (n, 3) after alignment.

    The alignment is rigid (rotation and translation). The median distance is set to 1 m if no alignment is possible.
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
    """Sense of the azimuth with which stations of known pose measure equal positions of common targets.

    `poses` are the rough poses by station index. `local_points` (n, 3) [m] are the positions measured in n pointings,
    in the frames of their stations, computed with counter-clockwise azimuths. None if the data do not decide.
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
    if not np.all(np.isfinite(misfits)) or max(misfits) < MIN_DECISIVE_CONVENTION_RATIO * min(misfits):
        return None
    return _unanimous_azimuth_sense([int(np.argmin(misfits))])


def _unanimous_azimuth_sense(station_senses: list[int]) -> AzimuthSense | None:
    """Sense of the azimuth if all stations have the same one (0 counter-clockwise, 1 clockwise); otherwise None."""
    if not station_senses or min(station_senses) != max(station_senses):
        return None
    return "clockwise" if station_senses[0] else "counter-clockwise"


def vertical_sight_notes(recording: Recording) -> tuple[str, ...]:
    """Note on pointings straight up or down, of which an adjustment uses the distance only; empty without them."""
    vertical_rows = np.flatnonzero(recording.is_along_standing_axis & recording.is_measured[:, 1:].any(axis=1))
    if not len(vertical_rows):
        return ()
    listed_rows = names_text([recording.row_text(int(row) + 1) for row in vertical_rows], MAX_ROWS_IN_NOTE)
    return (
        f"{listed_rows}: along the vertical axis of the tracker the azimuth is undefined, so the angles are not used; "
        "to measure angles to this target, tilt or move the tracker",
    )


def mirror_image_warnings(recording: Recording) -> tuple[str, ...]:
    """Warnings that readings fit declared positions of stations, or other readings, only as a mirror image.

    No warning is given for points in one plane, for declared positions that fit neither the readings nor their mirror
    image, and for more than the permitted number of set-ups.
    """
    if len(recording.stations) > overridable_limit(MAX_NETWORK_SETUPS):
        return ()
    local_points = from_polar(recording.readings)
    polar = PolarReadings(recording.station, recording.target, *recording.readings[:, [1, 2, 0]].T)
    poses = floor_plan_poses(recording.setup, recording.stations)
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
    """Indices (earlier, later) of pairs of stations whose common targets fit each other only as mirror images."""
    measured = np.isfinite(local_points).all(axis=1)
    clouds, pairs = target_points_by_station(local_points, recording.station, recording.target), []
    stations, targets = recording.station[measured], recording.target[measured]
    for other, s in most_shared_target_pairs(stations, targets, len(recording.stations)):
        here, there = clouds[s].common_points(clouds[other])
        misfit, mirror = _rigid_misfits(here, there)
        extent = float(np.ptp(there, axis=0).max())
        if misfit > MIN_DECISIVE_CONVENTION_RATIO * mirror and mirror < MAX_RELATIVE_MIRROR_MISFIT * extent:
            pairs.append((other, s))
    return pairs


def floor_plan_poses(setup: Setup, names: Sequence[str]) -> dict[int, StationPoseArrays]:
    """Rough pose of each station, by its index in `names`, if the floor plan in `setup` gives position and yaw."""
    poses = {}
    for i, name in enumerate(names):
        station = setup.stations.get(name)
        if station is not None and station.position_mm is not None and station.yaw_deg is not None:
            poses[i] = rotation_about_z(station.yaw_deg * DEGREE), np.array(station.position_mm) * MILLIMETRE
    return poses
