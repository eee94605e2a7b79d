"""Work order of a plan on the shop floor: tripods placed by tape, order of measuring, checks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.core.units import DEGREE, MILLIMETRE
from ltsim.physics.model.measurement import sightings_of
from ltsim.planning.planner import PlannedNetwork

REACH = 2.2
"""[m] Largest height from which a point can be plumbed to the floor."""
TAPE = 15.0
"""[m] Longest distance for a tape or a distance meter."""
MOST_MARKS = 16
"""Marks of a station that are looked at."""
STRAIGHT = 0.1
"""Least gain in firmness of a distance straight to a reflector over one along the floor."""
READ, PLAY, CLEAR = 0.01, 0.03, 0.1
"""[m] Resolution of a tape; largest ambiguity of the place from three distances; smallest miss of any other place."""
NEAR = 0.3
"""[m] Shortest useful distance."""
ANKLE = 0.1
"""[m] Height above the floor at which the tape must pass freely."""
BORED = 0.03
"""Least gain in firmness of three distances for one more metre of tape."""
TRUST = 3.0
"""Sigmas beyond which a repeated point is taken to have moved."""
COMMON = 3
"""Points that are measured again at the end of a station."""


@dataclass(frozen=True)
class TapeDistance:
    """A distance along the floor, from under the head to under a point, or straight from the head to a reflector."""

    to: str
    place: Floats
    """(3,) [m]: of the point."""
    metres: float
    floor: bool

    @property
    def words(self) -> str:
        """The distance with its end."""
        return f"{self.metres:.2f} m to {self.to}{'' if self.floor else ' (straight)'}"

    @classmethod
    def of(cls, to: str, place: Floats, station: Floats, *, floor: bool) -> TapeDistance:
        """Tape distance from an instrument at `station` (3,) [m]."""
        gap = place - station
        return cls(to, place, float(np.linalg.norm(gap[:2] if floor else gap)), floor)


@dataclass(frozen=True)
class StationSetup:
    """Station of the work order."""

    name: str
    height: float
    """[m]: of the head's centre above the floor."""
    tapes: tuple[TapeDistance, ...]
    """Three, which meet in one point unless `lacking` says otherwise."""
    lacking: str
    """Deficiency of the tapes in fixing the place, as a sentence; empty where they fix it."""
    towards: str
    """Direction of azimuth zero, in words."""
    order: tuple[str, ...]
    """Targets in the order of their first pointing."""
    again: dict[str, float]
    """[m]: targets to measure again at the end, and how far they may be off then."""
    minutes: float
    """Duration of the pointings [min]."""


def settings_of(plan: PlannedNetwork) -> tuple[StationSetup, ...]:
    """The stations of a plan in the order of the work."""
    survey, built = plan.chosen.survey, plan.chosen.information.construction
    recording = survey.recording(built)
    sightings = sightings_of(recording, survey.state(built))
    sigma = survey.noise(sightings) * survey.used
    flat = sightings.range_ * np.cos(sightings.elevation)
    error = np.linalg.norm(sigma * np.stack([np.ones_like(flat), flat, sightings.range_], axis=1), axis=1)
    settings = []
    for s, name in enumerate(recording.stations):
        rows = np.flatnonzero(recording.station == s)
        at = survey.station_names.index(name)
        place, visible = survey.position[at], survey.visible[at]
        order = list(dict.fromkeys(recording.target[rows].tolist()))
        again = [order[i] for i in np.unique(np.linspace(0, len(order) - 1, COMMON).round().astype(int))]
        limit = {t: TRUST * np.sqrt(2.0) * float(error[rows[recording.target[rows] == t][0]]) for t in again}
        tapes = _tapes(_marks(plan, place, visible), place)
        settings.append(
            StationSetup(
                name=name,
                height=float(place[2]),
                tapes=tapes,
                lacking=lacking(tapes, place),
                towards=_towards(plan, place, float(survey.yaw[at]), visible),
                order=tuple(recording.targets[t] for t in order),
                again={recording.targets[t]: value for t, value in limit.items()},
                minutes=len(rows) * survey.seconds_per_pointing / 60.0,
            )
        )
    return tuple(settings)


def _marks(plan: PlannedNetwork, place: Floats, visible: Bools) -> list[TapeDistance]:
    """Marks that a station can be taped to: in reach of a tape first, then along the floor, then the nearest.

    Along the floor: points that can be plumbed and corners of the room, if the way is free; else straight to any
    other reflector in sight.
    """
    survey, obstacles = plan.chosen.survey, plan.site.obstacles
    targets = list(zip(survey.target_names, survey.points, strict=True))
    wide, deep = np.array(plan.scenario.workshop.size_mm[:2]) * MILLIMETRE
    corners = [(f"room corner ({x:g} m, {y:g} m)", np.array([x, y, 0.0])) for x in (0.0, wide) for y in (0.0, deep)]
    plumbed = [*((name, point) for name, point in targets if point[2] <= REACH), *corners]
    level = [TapeDistance.of(name, point, place, floor=True) for name, point in plumbed]
    if obstacles is not None:
        ends = np.array([[*mark.place[:2], ANKLE] for mark in level])
        blocked = obstacles.blocked(np.tile([*place[:2], ANKLE], (len(ends), 1)), ends)
        level = [mark for mark, hidden in zip(level, blocked, strict=True) if not hidden]
    reachable = {mark.to for mark in level}
    straight = [
        TapeDistance.of(*targets[t], place, floor=False)
        for t in np.flatnonzero(visible)
        if targets[t][0] not in reachable
    ]
    every = [mark for mark in (*level, *straight) if mark.metres > NEAR]
    return sorted(every, key=lambda mark: (mark.metres > TAPE, not mark.floor, mark.metres))[:MOST_MARKS]


def _tapes(marks: Sequence[TapeDistance], place: Floats) -> tuple[TapeDistance, ...]:
    """Three distances that cross well, are short and meet in one point only, the station's; else the firmest three."""

    def worth(three: tuple[TapeDistance, ...]) -> tuple[bool, bool, float]:
        firm, good = firmness(three, place), not lacking(three, place)
        longest, straight = max(mark.metres for mark in three), sum(not mark.floor for mark in three)
        return good, good and longest <= TAPE, firm - good * (BORED * longest + STRAIGHT * straight)

    return max(combinations(marks, 3), key=worth, default=tuple(marks))


def firmness(three: Sequence[TapeDistance], place: Floats) -> float:
    """Smallest change of distances per step on the floor: the least singular value of their gradients."""
    slopes = np.array([(place[:2] - mark.place[:2]) / mark.metres for mark in three])
    return float(np.linalg.svd(slopes, compute_uv=False).min())


def lacking(tapes: Sequence[TapeDistance], place: Floats) -> str:
    """Deficiency of distances, read within `READ`, in giving one place and no other, as a sentence; empty for none."""
    if len(tapes) < 3:
        return "Fewer than three points can be taped to: mark its place by another way."
    if (firm := firmness(tapes, place)) * PLAY < READ:
        wide = f"by {100 * READ / firm:.0f} cm" if firm > READ else "along a line"
        return f"The tapes cross too flat and leave its place open {wide}: mark it by another way."
    at = np.array([mark.place[:2] for mark in tapes])
    rise = np.array([mark.metres for mark in tapes]) ** 2 - np.sum((place[:2] - at) ** 2, axis=1)
    first, second = max(combinations(at, 2), key=lambda ends: float(np.linalg.norm(ends[1] - ends[0])))
    along = (second - first) / np.linalg.norm(second - first)
    gap = place[:2] - first
    mirror = place[:2] - 2.0 * (gap - along * (gap @ along))
    misses = np.sqrt(np.sum((mirror - at) ** 2, axis=1) + rise) - [mark.metres for mark in tapes]
    if np.linalg.norm(mirror - place[:2]) < PLAY or np.abs(misses).max() > CLEAR:
        return ""
    return f"The tapes meet a second time, at x {mirror[0]:.2f}, y {mirror[1]:.2f} m: that is the wrong side."


def _towards(plan: PlannedNetwork, place: Floats, yaw: float, visible: Bools) -> str:
    """Direction of azimuth zero: the target in sight that is nearest to it, and the angle between them."""
    survey = plan.chosen.survey
    way = survey.points[visible] - place
    off = np.angle(np.exp(1j * (np.arctan2(way[:, 1], way[:, 0]) - yaw)))
    best = int(np.argmin(np.abs(off)))
    name = survey.target_names[np.flatnonzero(visible)[best]]
    degrees = round(abs(float(off[best])) / DEGREE)
    return name if degrees == 0 else f"{degrees}° {'right' if off[best] > 0 else 'left'} of {name}"


def checks(plan: PlannedNetwork) -> list[str]:
    """Checks in the order of the work, a sentence each."""
    survey, file = plan.chosen.survey, plan.file
    sentences = [
        f"Before the first pointing: the tracker is warm, its own checks are passed, the air has the planned "
        f"{plan.scenario.workshop.temperature_c:g} °C; note temperature, pressure and humidity.",
        "At every station, before its first pointing: the head is within "
        f"{file.stations.position_tolerance_mm:g} mm of its planned position, and every point of its list is visible.",
        "At the end of every station: measure the points under 'again' once more; where one is off by more than "
        "stated, the tripod or the point has moved, and the station is measured anew.",
    ]
    if len(survey.faces) == 2:
        sentences.append(
            "In both faces: the two readings of a point differ as those of the others do; else one is a slip."
        )
    if len(survey.position) > 1:
        sentences.append(
            "Before the second station and each later one is left: ltsim adjust of all so far suspects no pointing."
        )
    return sentences
