"""Conventions of a polar file: unit, zenith angle or elevation, sense of the azimuth, metres or millimetres.

The data decide and a note reports the decision, or an error asks for a hint; nothing is assumed silently. Two faces
determine unit and vertical angle, because their readings add up to a full or a half circle. With one face, the lengths
between targets common to two stations decide: they agree only in the right unit. Neither determines the sense of the
azimuth: the mirror image of a network has the same lengths and faces. Coordinates or poses from another source are
needed for it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import NetworkError, RecordError
from ltsim.core.limits import MAX_NETWORK_SETUPS, max_pointings
from ltsim.core.notation import listing
from ltsim.core.units import DEGREE, MILLIMETRE, SI_PER_UNIT
from ltsim.geometry.alignment import align_rigidly
from ltsim.geometry.polar import from_polar
from ltsim.geometry.rotations import rotation_about_z
from ltsim.recordings.coordinates import read_points
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Setup
from ltsim.recordings.transcription_errors import (
    MIN_DISTANCE_MM,
    length_disagreement,
    shared_target_counts,
    station_clouds,
)

AngleUnit = Literal["deg", "gon", "rad"]
VerticalKind = Literal["zenith", "elevation"]
AzimuthSense = Literal["clockwise", "counter-clockwise"]
LengthUnit = Literal["mm", "m"]
StationPoseArrays = tuple[Floats, Floats]
"""Pose of a station: rotation (3, 3) from the station frame to the network frame, and position (3,) [m]."""
FULL_CIRCLE_BY_UNIT = {"deg": 360.0, "gon": 400.0, "rad": 2 * np.pi}
HINTED_ANGLE_UNITS: tuple[AngleUnit, ...] = ("deg", "gon", "rad")
"""Units of angles that a hint can give."""
VERTICAL_KINDS: tuple[VerticalKind, ...] = ("zenith", "elevation")
MIN_MISFIT_RATIO = 10.0
"""Smallest ratio of the second-best to the best misfit from which the data decide on a convention."""
MIN_MIRRORED_TARGETS = 5
"""Smallest number of common targets of two stations that are compared with mirror images: four may lie in a plane."""
MAX_MIRROR_MISFIT = 1e-3
"""Largest misfit of a mirror image, relative to the size of the network, at which it counts as a fit."""
MAX_LISTED_NOTES = 3
"""Largest number of rows or notes that a message lists."""
MIN_PLAUSIBLE_PACE_S = 0.1
"""Shortest plausible median time [s] between consecutive targets; below it a question about the clock is asked."""
MAX_PLAUSIBLE_PACE_S = 7200.0
"""Longest plausible median time [s] between consecutive targets; above it a question about the clock is asked."""
MIN_TARGET_CHANGES = 8
"""Smallest number of changes of the target for which the median time between targets is judged."""


@dataclass(frozen=True)
class Hints:
    """Decisions of the user on an ambiguous file; None leaves a decision to the data.

    `points` is a list of coordinates (name, x, y, z) in a right-handed frame that decides the sense of the azimuth;
    `station` names the set-up of a file that contains no name; `columns` assigns the columns of a table
    (``target=Name,azimuth=Hz[gon]``), `setup` is the file with noise and gauge, `date` the order of day and month in
    dates with slashes. A file that is still growing (`incomplete_tail`) may end inside a row and may lack targets of
    reference lengths.
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
    """Polar readings as they are in a file: horizontal and vertical angle, distance, indices of station and target.

    All are (n,).
    """

    station: Ints
    target: Ints
    horizontal: Floats
    vertical: Floats
    distance: Floats

    def points(self, angle: AngleUnit, vertical: VerticalKind) -> Floats:
        """Coordinates (n, 3) in each station's frame, in the unit of the distances.

        Azimuths are taken as counter-clockwise.
        """
        upward = self.vertical * SI_PER_UNIT[angle]
        elevation = np.pi / 2 - upward if vertical == "zenith" else upward
        return from_polar(np.stack([self.distance, self.horizontal * SI_PER_UNIT[angle], elevation], axis=1))


def angle_convention(table: PolarReadings, hints: Hints, file: object) -> tuple[AngleUnit, VerticalKind, list[str]]:
    """Unit of the angles, kind of the vertical angle, and notes on what the data decided.

    Raises RecordError, which asks for a hint, if the data do not decide.
    """
    angles = HINTED_ANGLE_UNITS if hints.angle is None else (hints.angle,)
    verticals = VERTICAL_KINDS if hints.vertical is None else (hints.vertical,)
    open_ = [
        (a, v)
        for a in angles
        for v in verticals
        if _is_possible_convention(table, a, v, is_declared=hints.vertical is not None)
    ]
    if not open_:
        raise RecordError("the angles have none of the units deg, gon and rad; check the columns", file=file)
    meaning, why = open_[0], "no other interpretation fits the values"
    if len(open_) > 1:
        meaning, why = (
            _convention_from_faces(table, open_)
            or _convention_from_lengths(table, open_)
            or _missing_hint_error(open_, file)
        )
    notes = []
    if hints.angle is None or hints.vertical is None:
        notes.append(f"angles are interpreted as {meaning[0]}, the vertical ones as {meaning[1]} angles ({why})")
    return (*meaning, notes)


def _is_possible_convention(
    table: PolarReadings, angle: AngleUnit, vertical: VerticalKind, *, is_declared: bool
) -> bool:
    """True if every value lies within the circle, and the vertical angles are within the travel of an instrument.

    An elevation beyond the zenith occurs on face 2 only. A file with such values, but without a target on two faces,
    therefore holds zenith angles, unless the kind is declared (`is_declared`).
    """
    circle = FULL_CIRCLE_BY_UNIT[angle]
    horizontal, upward = table.horizontal, table.vertical
    if np.nanmax(np.abs(horizontal), initial=0) > circle * 1.001 or np.nanmax(np.abs(upward), initial=0) > circle:
        return False
    if vertical == "elevation":
        highest = float(np.nanmax(upward, initial=0))
        within = float(np.nanmin(upward, initial=0)) >= -circle / 4 and highest <= 0.75 * circle
        return within and (is_declared or highest <= circle / 4 or _count_two_face_pairs(table, angle, vertical) > 0)
    return bool(np.nanmin(upward, initial=0) >= 0)


def _same_target_rows(table: PolarReadings) -> tuple[Ints, Ints]:
    """Pairs of rows: each row and the next one with the same station and target."""
    order = np.lexsort((np.arange(len(table.station)), table.target, table.station))
    first, next_ = order[:-1], order[1:]
    keep = (table.station[first] == table.station[next_]) & (table.target[first] == table.target[next_])
    return first[keep], next_[keep]


def _count_two_face_pairs(table: PolarReadings, angle: AngleUnit, vertical: VerticalKind) -> int:
    """Number of pairs of rows with one target on both faces: azimuths half a circle apart, matching vertical angles."""
    first, other = _same_target_rows(table)
    circle = FULL_CIRCLE_BY_UNIT[angle]
    total = circle if vertical == "zenith" else circle / 2
    turn = np.abs(np.mod(table.horizontal[first] - table.horizontal[other], circle) - circle / 2)
    rest = np.abs(table.vertical[first] + table.vertical[other] - total)
    fits: Bools = (turn < 1e-3 * circle) & (rest < 1e-3 * circle)
    return int(fits.sum())


def _convention_from_faces(
    table: PolarReadings, open_: list[tuple[AngleUnit, VerticalKind]]
) -> tuple[tuple[AngleUnit, VerticalKind], str] | None:
    """Unit and kind of vertical angle under which most repeated targets are on two faces; None if several are equal."""
    counts = [_count_two_face_pairs(table, angle, vertical) for angle, vertical in open_]
    best_index = int(np.argmax(counts))
    if counts[best_index] < 2 or sorted(counts)[-2] * MIN_MISFIT_RATIO > counts[best_index]:
        return None
    return open_[best_index], f"{counts[best_index]} targets in two faces add up accordingly"


def _convention_from_lengths(
    table: PolarReadings, open_: list[tuple[AngleUnit, VerticalKind]]
) -> tuple[tuple[AngleUnit, VerticalKind], str] | None:
    """Unit and kind of vertical angle under which two stations see equal lengths between targets.

    It is None if several do.
    """
    gaps = [
        length_disagreement(table.points(angle, vertical), table.station, table.target) for angle, vertical in open_
    ]
    if not np.all(np.isfinite(gaps)):
        return None
    first, second = np.argsort(gaps)[:2]
    if gaps[first] > 1e-2 or gaps[first] * MIN_MISFIT_RATIO > gaps[second]:
        return None
    return open_[first], f"two stations then measure equal lengths within 1 part in {1 / max(gaps[first], 1e-9):.0f}"


def _missing_hint_error(
    open_: list[tuple[AngleUnit, VerticalKind]], file: object
) -> tuple[tuple[AngleUnit, VerticalKind], str]:
    """Error that asks the user to choose between conventions; raises RecordError with the option to type."""
    has_common_unit = len({a for a, _ in open_}) == 1
    choices = " or ".join(f"{v} angles" if has_common_unit else f"{v} angles in {a}" for a, v in open_)
    hints = [] if has_common_unit else [f"--hint angle={open_[0][0]}"]
    hints += [f"--hint vertical={open_[0][1]}"] if len({v for _, v in open_}) > 1 else []
    message = f"the angles may be {choices}, and the file does not decide; give {' '.join(hints)}"
    raise RecordError(message, file=file)


def length_meaning(distance: Floats, hints: Hints) -> tuple[LengthUnit, list[str]]:
    """Unit of the distances, with notes: metres if none exceeds the largest value of a tracker network in metres."""
    if hints.length is not None:
        return hints.length, []
    longest = float(np.nanmax(distance, initial=0))
    length: LengthUnit = "m" if longest < MIN_DISTANCE_MM else "mm"
    return length, [f"distances are interpreted as {length} (the longest is {longest:.6g})"]


SENSE_UNKNOWN_NOTE = (
    "this file does not show whether azimuths run clockwise, because its mirror image fits as well; give "
    "--hint azimuth=clockwise or --hint azimuth=counter-clockwise, or the coordinates of some targets with "
    "--hint points=FILE"
)


def azimuth_sense_from_points(
    local: Floats, table: PolarReadings, targets: Sequence[str], file: Path
) -> tuple[AzimuthSense, list[str]]:
    """Sense of the azimuth by the coordinates of targets in `file`, with notes.

    Raises RecordError if they do not decide.
    """
    points = read_points(file, requires_all=False)
    place = {name: i for i, name in enumerate(targets)}
    places = {place[n]: p for n, p in zip(points.names, points.points, strict=True) if n in place}
    azimuth = _azimuth_sense_by_alignment(local, table, places)
    if azimuth is None:
        message = f"the coordinates of {len(places)} targets do not decide whether azimuths run clockwise; give "
        raise RecordError(message + "--hint azimuth=clockwise or --hint azimuth=counter-clockwise", file=file)
    return azimuth, [
        f"azimuths are interpreted as {azimuth} (the targets then fit the coordinates in {file.name})",
        *points.notes,
    ]


def _azimuth_sense_by_alignment(
    local: Floats, table: PolarReadings, place_of: Mapping[int, Floats]
) -> AzimuthSense | None:
    """Sense of the azimuth under which the targets of a station fit known points (by target index) rigidly.

    `local` (n, 3) [m] are the targets with counter-clockwise azimuth. None if neither sense fits ten times better, such
    as for points in one plane.
    """
    votes = []
    for s in np.unique(table.station):
        rows = np.flatnonzero((table.station == s) & np.isin(table.target, list(place_of)))
        rows = rows[np.all(np.isfinite(local[rows]), axis=1)]
        if len(np.unique(table.target[rows])) < 4:
            continue
        misfit = _misfits(local[rows], np.array([place_of[int(t)] for t in table.target[rows]]))
        if max(misfit) > MIN_MISFIT_RATIO * min(misfit):
            votes.append(int(np.argmin(misfit)))
    return _majority_sense(votes)


def _misfits(source: Floats, goal_points: Floats) -> list[float]:
    """Median misfits [m] of points (n, 3), and of their mirror image, to other points after a rigid alignment.

    A misfit is 1 if no alignment exists.
    """
    misfits = []
    for side in (1.0, -1.0):
        image = source * [1.0, side, 1.0]
        try:
            rotation, shift = align_rigidly(image, goal_points)
            misfits.append(float(np.median(np.linalg.norm(image @ rotation.T + shift - goal_points, axis=1))) + 1e-9)
        except NetworkError:
            misfits.append(1.0)
    return misfits


def azimuth_sense_from_poses(
    local: Floats, table: PolarReadings, poses: Mapping[int, StationPoseArrays]
) -> AzimuthSense | None:
    """Sense of the azimuth under which stations of known pose (rotation, position) see the same points."""
    misfit = []
    for side in (1.0, -1.0):
        world = np.full_like(local, np.nan)
        for s, (rotation, position) in poses.items():
            rows = table.station == s
            world[rows] = (local[rows] * [1.0, side, 1.0]) @ rotation.T + position
        misfit.append(_median_station_distance(world, table))
    if not np.all(np.isfinite(misfit)) or max(misfit) < MIN_MISFIT_RATIO * min(misfit):
        return None
    return _majority_sense([int(np.argmin(misfit))])


def _median_station_distance(world: Floats, table: PolarReadings) -> float:
    """Median distance between the positions of a target from different stations; NaN without such a target."""
    places_of: dict[int, list[Floats]] = {}
    for cloud in station_clouds(world, table.station, table.target).values():
        for target, point in cloud.items():
            places_of.setdefault(target, []).append(point)
    gaps = [np.linalg.norm(np.ptp(np.array(places), axis=0)) for places in places_of.values() if len(places) > 1]
    return float(np.median(gaps)) + 1e-9 if gaps else float("nan")


def _majority_sense(votes: list[int]) -> AzimuthSense | None:
    if not votes or min(votes) != max(votes):
        return None
    return "clockwise" if votes[0] else "counter-clockwise"


def clock_question(recording: Recording) -> tuple[str, ...]:
    """Question about the clock of a recording whose median time between targets is implausible; empty otherwise."""
    is_change = (np.diff(recording.target) != 0) & (np.diff(recording.station) == 0)
    steps = np.abs(np.diff(recording.time))[is_change]
    steps = steps[np.isfinite(steps)]
    if not recording.has_clock or len(steps) < MIN_TARGET_CHANGES:
        return ()
    step = float(np.median(steps))
    if MIN_PLAUSIBLE_PACE_S <= step <= MAX_PLAUSIBLE_PACE_S:
        return ()
    span = float(np.nanmax(recording.time) - np.nanmin(recording.time))
    return (
        f"the {len(recording)} pointings take {span:.4g} s, {step:.3g} s from one target to the next: check the unit "
        "of the time column and give it with --columns, such as time=HEADER[h]; drifts in time depend on it",
    )


def vertical_pointings_note(recording: Recording) -> tuple[str, ...]:
    """Note on pointings along the vertical axis, of which a network uses only the distances."""
    rows = np.flatnonzero(recording.vertical & recording.is_measured[:, 1:].any(axis=1))
    if not len(rows):
        return ()
    listed_rows = listing([recording.where(int(row) + 1) for row in rows], MAX_LISTED_NOTES)
    return (
        f"{listed_rows}: along the vertical axis of the tracker the azimuth is undefined, so the angles are not used; "
        "to locate this target from there, tilt or move the tracker",
    )


def convention_contradictions(recording: Recording) -> tuple[str, ...]:
    """Contradictions between set-ups, or rough positions, and the sense of the azimuths: only a mirror image fits.

    Coordinates in one plane, or a floor plan that fits neither sense, are no contradiction. None are sought among more
    set-ups than a network may have.
    """
    if len(recording.stations) > max_pointings(MAX_NETWORK_SETUPS):
        return ()
    local = from_polar(recording.readings)
    table = PolarReadings(recording.station, recording.target, *recording.readings[:, [1, 2, 0]].T)
    poses = rough_poses(recording.setup, recording.stations)
    notes = []
    if len(poses) > 1 and azimuth_sense_from_poses(local, table, poses) == "clockwise":
        notes.append(
            "the declared places of the stations fit only the mirror image of the readings: if the azimuths run "
            "clockwise give --hint azimuth=clockwise, otherwise the floor plan is left-handed"
        )
    for first, other in _mirrored_station_pairs(local, recording):
        notes.append(
            f"the targets of {recording.stations[first]} and {recording.stations[other]} fit each other only as mirror "
            "images: the azimuths of one of them run clockwise"
        )
    return tuple(notes[:MAX_LISTED_NOTES])


def _mirrored_station_pairs(local: Floats, recording: Recording) -> list[tuple[int, int]]:
    """Pairs of stations that are mirror images: each station and the previous one with which it shares most targets."""
    measured = np.isfinite(local).all(axis=1)
    counts = shared_target_counts(recording.station[measured], recording.target[measured], len(recording.stations))
    n_shared = np.triu(counts, 1)  # of each station with the previous ones, in a column
    clouds, pairs = station_clouds(local, recording.station, recording.target), []
    for s, other in enumerate(n_shared.argmax(axis=0).tolist()):
        if n_shared[other, s] < MIN_MIRRORED_TARGETS:
            continue
        common = sorted(clouds[other].keys() & clouds[s].keys())
        here, there = (np.array([clouds[k][t] for t in common]) for k in (s, other))
        right, mirrored = _misfits(here, there)
        if right > MIN_MISFIT_RATIO * mirrored and mirrored < MAX_MIRROR_MISFIT * float(np.ptp(there, axis=0).max()):
            pairs.append((other, s))
    return pairs


def rough_poses(setup: Setup, names: Sequence[str]) -> dict[int, StationPoseArrays]:
    """Rough poses of stations by index, from the floor plan: position and direction of azimuth zero."""
    poses = {}
    for i, name in enumerate(names):
        station = setup.stations.get(name)
        if station is not None and station.position_mm is not None and station.yaw_deg is not None:
            poses[i] = rotation_about_z(station.yaw_deg * DEGREE), np.array(station.position_mm) * MILLIMETRE
    return poses
