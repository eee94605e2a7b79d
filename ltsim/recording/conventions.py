"""What the numbers of a polar file mean: unit, zenith or elevation, clockwise or not, metres or millimetres.

Decided from the data and said in a note, or asked for in one sentence; never guessed silently. Two faces
tell unit and vertical angle at once, because they add up to a full or a half circle. Where there is one
face, lengths between targets common to two stations decide: they agree in the right unit only. The sense of
the azimuth is beyond both: the mirror image of a whole network is a network with the same lengths and
faces. Coordinates or poses from elsewhere are needed for it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ltsim.arrays import Bools, Floats, Ints
from ltsim.errors import NetworkError, RecordError
from ltsim.geometry.alignment import align
from ltsim.geometry.polar import from_polar
from ltsim.geometry.rotations import about_z
from ltsim.recording.coordinates import read_points
from ltsim.recording.plausibility import SHORTEST_MM, chord_gap
from ltsim.recording.recording import Recording
from ltsim.recording.setup import Setup
from ltsim.units import DEGREE, FACTOR, MILLIMETRE

Angle = Literal["deg", "gon", "rad"]
Vertical = Literal["zenith", "elevation"]
Azimuth = Literal["clockwise", "counter-clockwise"]
Length = Literal["mm", "m"]
CIRCLE = {"deg": 360.0, "gon": 400.0, "rad": 2 * np.pi}
ANGLES: tuple[Angle, ...] = ("deg", "gon", "rad")
VERTICALS: tuple[Vertical, ...] = ("zenith", "elevation")
CLEARLY = 10.0
"""How many times better one meaning must fit than the next to be decided by the data."""
ALIKE = 1e-3
"""Part of a network's size by which a mirror image may miss it and still be one."""
MOST_NOTES = 3


@dataclass(frozen=True)
class Hints:
    """What a caller says about an ambiguous file; None leaves it to the data.

    `points` is a list of coordinates (name, x, y, z) in a right-handed frame that decides the sense of the
    azimuth; `station` names the set-up of a file that does not; `columns` says what the columns of a table hold
    (``target=Name,azimuth=Hz[gon]``), `setup` where its noise and gauge stand, `date` the order of dates with
    strokes. A file that is still `growing` may end inside a row and lack targets of known lengths.
    """

    angle: Angle | None = None
    vertical: Vertical | None = None
    azimuth: Azimuth | None = None
    length: Length | None = None
    points: Path | None = None
    station: str | None = None
    columns: str | None = None
    setup: Path | None = None
    date: Literal["dmy", "mdy"] | None = None
    growing: bool = False


NO_HINTS = Hints()
NO_NOISE = "the file states no noise: that of the default instrument is taken, edit setup.toml to state it"


@dataclass(frozen=True)
class PolarTable:
    """Numbers as printed: horizontal and vertical angle, distance (n,); who looked at whom (n,) int."""

    station: Ints
    target: Ints
    horizontal: Floats
    vertical: Floats
    distance: Floats

    def readings(self, angle: Angle, vertical: Vertical, azimuth: Azimuth, length: Length) -> Floats:
        """Raw range [m], azimuth [0, 2 pi) and elevation [-pi/2, 3 pi/2) [rad], (n, 3)."""
        sense = -1.0 if azimuth == "clockwise" else 1.0
        turned = np.mod(sense * self.horizontal * FACTOR[angle], 2 * np.pi)
        upward = self.vertical * FACTOR[angle]
        raw = np.pi / 2 - upward if vertical == "zenith" else upward
        raw = np.where(raw < -np.pi / 2 - 1e-12, raw + 2 * np.pi, raw)
        return np.stack([self.distance * FACTOR[length], turned, raw], axis=1)


def faces(readings: Floats) -> Ints:
    """Face (n,) of raw readings: 2 where the elevation lies beyond the zenith."""
    return np.where(np.abs(readings[:, 2]) > np.pi / 2 + 1e-9, 2, 1).astype(np.int64)


def angle_meaning(table: PolarTable, hints: Hints, file: object) -> tuple[Angle, Vertical, list[str]]:
    """Unit of the angles and meaning of the vertical one, with a note for what the data decided.

    Raises
    ------
    RecordError
        Asking for a hint where the data do not decide.
    """
    angles = ANGLES if hints.angle is None else (hints.angle,)
    verticals = VERTICALS if hints.vertical is None else (hints.vertical,)
    open_ = [(a, v) for a in angles for v in verticals if _possible(table, a, v, stated=hints.vertical is not None)]
    if not open_:
        raise RecordError("the angles fit no unit that is known here (deg, gon or rad)", file=file)
    found, why = open_[0], "the only meaning that its values allow"
    if len(open_) > 1:
        found, why = _by_faces(table, open_) or _by_lengths(table, open_) or _ask(open_, file)
    notes = []
    if hints.angle is None or hints.vertical is None:
        notes.append(f"angles taken as {found[0]} with the vertical one as {found[1]}: {why}")
    return (*found, notes)


def _possible(table: PolarTable, angle: Angle, vertical: Vertical, *, stated: bool) -> bool:
    """Whether every value lies on the circle, and the vertical angles are what an instrument can read.

    An elevation beyond the zenith is read on face 2 only; a file that has such, but no target on two faces, holds
    zenith angles unless it is `stated` otherwise.
    """
    circle = CIRCLE[angle]
    horizontal, upward = table.horizontal, table.vertical
    if np.nanmax(np.abs(horizontal), initial=0) > circle * 1.001 or np.nanmax(np.abs(upward), initial=0) > circle:
        return False
    if vertical == "elevation":
        highest = float(np.nanmax(upward, initial=0))
        within = float(np.nanmin(upward, initial=0)) >= -circle / 4 and highest <= 0.75 * circle
        return within and (stated or highest <= circle / 4 or _on_two_faces(table, angle, vertical) > 0)
    return bool(np.nanmin(upward, initial=0) >= 0)


def _same_target(table: PolarTable) -> tuple[Ints, Ints]:
    """Pairs of rows, each with the next one of the same station and target."""
    order = np.lexsort((np.arange(len(table.station)), table.target, table.station))
    one, next_ = order[:-1], order[1:]
    keep = (table.station[one] == table.station[next_]) & (table.target[one] == table.target[next_])
    return one[keep], next_[keep]


def _on_two_faces(table: PolarTable, angle: Angle, vertical: Vertical) -> int:
    """How many pairs of rows are one target on both faces: half a circle apart, vertical angles adding up."""
    one, other = _same_target(table)
    circle = CIRCLE[angle]
    total = circle if vertical == "zenith" else circle / 2
    turn = np.abs(np.mod(table.horizontal[one] - table.horizontal[other], circle) - circle / 2)
    rest = np.abs(table.vertical[one] + table.vertical[other] - total)
    fits: Bools = (turn < 1e-3 * circle) & (rest < 1e-3 * circle)
    return int(fits.sum())


def _by_faces(table: PolarTable, open_: list[tuple[Angle, Vertical]]) -> tuple[tuple[Angle, Vertical], str] | None:
    """The meaning under which most repeated targets were seen on two faces, if only one does so."""
    counts = [_on_two_faces(table, angle, vertical) for angle, vertical in open_]
    best = int(np.argmax(counts))
    if counts[best] < 2 or sorted(counts)[-2] * CLEARLY > counts[best]:
        return None
    return open_[best], f"{counts[best]} targets were seen on two faces that add up accordingly"


def _by_lengths(table: PolarTable, open_: list[tuple[Angle, Vertical]]) -> tuple[tuple[Angle, Vertical], str] | None:
    """The meaning under which two stations see the same lengths between targets, if only one does so."""
    gaps = []
    for angle, vertical in open_:
        readings = table.readings(angle, vertical, "counter-clockwise", "m")
        gaps.append(chord_gap(from_polar(readings), table.station, table.target))
    if not np.all(np.isfinite(gaps)):
        return None
    first, second = np.argsort(gaps)[:2]
    if gaps[first] > 1e-2 or gaps[first] * CLEARLY > gaps[second]:
        return None
    return open_[first], f"two stations then see the same lengths within a part in {1 / max(gaps[first], 1e-9):.0f}"


def _ask(open_: list[tuple[Angle, Vertical]], file: object) -> tuple[tuple[Angle, Vertical], str]:
    choices = " or ".join(f"{v} angles in {a}" for a, v in open_)
    message = f"the angles may be {choices} and nothing in the file decides; say which: " + _options(open_)
    raise RecordError(message, file=file)


def _options(open_: list[tuple[Angle, Vertical]]) -> str:
    """What to type for the first of the choices, without what they have in common."""
    angles, verticals = {a for a, _ in open_}, {v for _, v in open_}
    said = [f"--hint angle={open_[0][0]}"] if len(angles) > 1 else []
    said += [f"--hint vertical={open_[0][1]}"] if len(verticals) > 1 else []
    return " ".join(said)


def length_meaning(table: PolarTable, hints: Hints) -> tuple[Length, list[str]]:
    """Unit of the distances: metres where none exceeds what a tracker network measures in millimetres."""
    if hints.length is not None:
        return hints.length, []
    longest = float(np.nanmax(table.distance, initial=0))
    length: Length = "m" if longest < SHORTEST_MM else "mm"
    return length, [f"distances taken as {length}: the longest is {longest:.6g}"]


def sense_unknown() -> str:
    """The sentence that asks for the sense of the azimuth."""
    return (
        "nothing in this file tells whether azimuths run clockwise (its mirror image fits as well); say which, "
        "--hint azimuth=clockwise or --hint azimuth=counter-clockwise, or give coordinates of some targets, "
        "--hint points=FILE"
    )


def known_sense(
    local: Floats, table: PolarTable, targets: tuple[str, ...], hints: Hints
) -> tuple[Azimuth, list[str]] | None:
    """The sense by the coordinates of `hints.points`, with its notes; None where no points are given.

    Raises
    ------
    RecordError
        Where the points do not decide.
    """
    if hints.points is None:
        return None
    points = read_points(hints.points, strict=False)
    place = {name: i for i, name in enumerate(targets)}
    known = {place[n]: p for n, p in zip(points.names, points.points, strict=True) if n in place}
    azimuth = sense_by_points(local, table, known)
    if azimuth is None:
        message = f"{len(known)} of its targets have coordinates here, which does not decide whether azimuths run "
        raise RecordError(message + "clockwise; say which: --hint azimuth=clockwise", file=hints.points)
    why = f"azimuths taken as {azimuth}: so the targets fit the coordinates in {hints.points.name}"
    return azimuth, [why, *points.notes]


def sense_by_points(local: Floats, table: PolarTable, known: Mapping[int, Floats]) -> Azimuth | None:
    """The sense of the azimuth under which a station's targets fit known points (by target index) rigidly.

    `local` (n, 3) [m] are the targets with the azimuth taken counter-clockwise. None where neither sense
    fits ten times better, as with points in one plane.
    """
    votes = []
    for s in np.unique(table.station):
        rows = np.flatnonzero((table.station == s) & np.isin(table.target, list(known)))
        rows = rows[np.all(np.isfinite(local[rows]), axis=1)]
        if len(np.unique(table.target[rows])) < 4:
            continue
        goal = np.array([known[int(t)] for t in table.target[rows]])
        misfit = [_misfit(local[rows] * [1.0, side, 1.0], goal) for side in (1.0, -1.0)]
        if max(misfit) > CLEARLY * min(misfit):
            votes.append(int(np.argmin(misfit)))
    return _vote(votes)


def _misfit(source: Floats, goal: Floats) -> float:
    try:
        rotation, shift = align(source, goal)
    except NetworkError:
        return 1.0
    return float(np.median(np.linalg.norm(source @ rotation.T + shift - goal, axis=1))) + 1e-9


def sense_by_poses(local: Floats, table: PolarTable, poses: Mapping[int, tuple[Floats, Floats]]) -> Azimuth | None:
    """The sense of the azimuth under which stations of known pose (rotation, position) see the same points."""
    misfit = []
    for side in (1.0, -1.0):
        world = np.full_like(local, np.nan)
        for s, (rotation, position) in poses.items():
            rows = table.station == s
            world[rows] = (local[rows] * [1.0, side, 1.0]) @ rotation.T + position
        misfit.append(_spread_between_stations(world, table))
    if not np.all(np.isfinite(misfit)) or max(misfit) < CLEARLY * min(misfit):
        return None
    return _vote([int(np.argmin(misfit))])


def _spread_between_stations(world: Floats, table: PolarTable) -> float:
    """Median distance between first sightings of a target from different stations; NaN where none has two."""
    first: dict[int, dict[int, Floats]] = {}
    for s, t, point in zip(table.station.tolist(), table.target.tolist(), world, strict=True):
        if np.all(np.isfinite(point)):
            first.setdefault(t, {}).setdefault(s, point)
    gaps = [np.linalg.norm(np.ptp(np.array(list(seen.values())), axis=0)) for seen in first.values() if len(seen) > 1]
    return float(np.median(gaps)) + 1e-9 if gaps else float("nan")


def _vote(votes: list[int]) -> Azimuth | None:
    if not votes or min(votes) != max(votes):
        return None
    return "clockwise" if votes[0] else "counter-clockwise"


def contradictions(recording: Recording) -> tuple[str, ...]:
    """What set-ups or their stated places say against the sense of the azimuths: a mirror image fits, the readings not.

    Coordinates in one plane, or a floor plan that fits neither, say nothing.
    """
    local = from_polar(recording.readings)
    table = PolarTable(recording.station, recording.target, *recording.readings[:, [1, 2, 0]].T)
    poses = poses_of(recording.setup, recording.stations)
    notes = []
    if len(poses) > 1 and sense_by_poses(local, table, poses) == "clockwise":
        notes.append(
            "the stated places of the stations fit the readings only as their mirror image: if the azimuths run "
            "clockwise say --hint azimuth=clockwise, otherwise the floor plan is left-handed"
        )
    for one, other in _mirrored_pairs(local, recording):
        notes.append(
            f"the targets of {recording.stations[one]} and {recording.stations[other]} fit each other only as mirror "
            "images: the azimuths of one of them run clockwise"
        )
    return tuple(notes[:MOST_NOTES])


def _mirrored_pairs(local: Floats, recording: Recording) -> list[tuple[int, int]]:
    """Each station that is the mirror image of the one before it with which it shares most targets."""
    clouds: list[dict[int, Floats]] = [{} for _ in recording.stations]
    whole = np.isfinite(local).all(axis=1)
    for s, t, point in zip(
        recording.station[whole].tolist(), recording.target[whole].tolist(), local[whole], strict=True
    ):
        clouds[s].setdefault(t, point)
    found = []
    for s, cloud in enumerate(clouds):
        other = max(range(s), key=lambda k: len(clouds[k].keys() & cloud.keys()), default=s)
        common = sorted(clouds[other].keys() & cloud.keys())
        if other == s or len(common) < 5:
            continue
        here, there = (np.array([of[t] for t in common]) for of in (cloud, clouds[other]))
        right, mirrored = (_misfit(here * [1.0, side, 1.0], there) for side in (1.0, -1.0))
        if right > CLEARLY * mirrored and mirrored < ALIKE * float(np.ptp(there, axis=0).max()):
            found.append((other, s))
    return found


def poses_of(setup: Setup, names: Sequence[str]) -> dict[int, tuple[Floats, Floats]]:
    """Rough poses of stations by the floor plan: place and direction of zero."""
    found = {}
    for i, name in enumerate(names):
        station = setup.stations.get(name)
        if station is not None and station.position_mm is not None and station.yaw_deg is not None:
            found[i] = about_z(station.yaw_deg * DEGREE), np.array(station.position_mm) * MILLIMETRE
    return found
