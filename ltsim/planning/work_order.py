"""From a plan to work on the shop floor: the tripod placed by tape, the order of measuring, what to check."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from ltsim.arrays import Bools, Floats
from ltsim.effects.noise import white_noise_sigma
from ltsim.model.measurement import sightings_of
from ltsim.planning.planner import Plan
from ltsim.units import DEGREE, MILLIMETRE

REACH = 2.2
"""[m] above the floor to which a point can be plumbed to the floor."""
TAPE = 20.0
"""[m] length of a tape."""
NEAR = 0.3
"""[m] under which a distance fixes nothing."""
ANKLE = 0.1
"""[m] above the floor at which the tape must have a free way."""
BORED = 0.03
"""What a metre more of tape must gain in the sine of the angle at which two distances cross."""
TRUST = 3.0
"""Sigmas beyond which a repeated point is taken to have moved."""
COMMON = 3
"""Points that are measured again at the end of a station."""


@dataclass(frozen=True)
class Tape:
    """A distance along the floor, from under the head to under a point."""

    to: str
    metres: float


@dataclass(frozen=True)
class Setting:
    """One station of the work."""

    name: str
    height: float
    """[m]: of the head's centre above the floor."""
    tapes: tuple[Tape, ...]
    """Three where the floor is free."""
    towards: str
    """Where azimuth zero looks, in words."""
    order: tuple[str, ...]
    """Targets in the order of their first pointing."""
    again: dict[str, float]
    """[m]: targets to measure again at the end, and how far they may be off then."""
    minutes: float
    """Of pointing."""


def settings_of(plan: Plan) -> tuple[Setting, ...]:
    """The stations of a plan in the order of the work."""
    survey, built = plan.chosen.survey, plan.chosen.information.construction
    recording = survey.recording(built)
    sightings = sightings_of(recording, survey.state(built))
    sigma = white_noise_sigma(sightings, [survey.setup.instrument.noise]) * survey.used
    flat = sightings.range_ * np.cos(sightings.elevation)
    error = np.linalg.norm(sigma * np.stack([np.ones_like(flat), flat, sightings.range_], axis=1), axis=1)
    names, marks = _marks(plan)
    found = []
    for s, name in enumerate(recording.stations):
        rows = np.flatnonzero(recording.station == s)
        place = survey.position[survey.station_names.index(name)]
        yaw = float(survey.yaw[survey.station_names.index(name)])
        first = list(dict.fromkeys(recording.target[rows].tolist()))
        limit = {t: TRUST * np.sqrt(2.0) * float(error[rows[recording.target[rows] == t][0]]) for t in first}
        again = [first[i] for i in np.unique(np.linspace(0, len(first) - 1, COMMON).round().astype(int))]
        found.append(
            Setting(
                name=name,
                height=float(place[2]),
                tapes=_tapes(plan, place, names, marks),
                towards=_towards(plan, place, yaw, survey.seen[survey.station_names.index(name)]),
                order=tuple(recording.targets[t] for t in first),
                again={recording.targets[t]: limit[t] for t in again},
                minutes=len(rows) * survey.seconds_per_pointing / 60.0,
            )
        )
    return tuple(found)


def _marks(plan: Plan) -> tuple[list[str], Floats]:
    """Names and places (n, 2) [m] that a tape can be held to: points that can be plumbed, corners of the room."""
    survey = plan.chosen.survey
    low = np.flatnonzero(survey.points[:, 2] <= REACH)
    wide, deep = np.array(plan.scenario.workshop.size_mm[:2]) * MILLIMETRE
    corners = {(x, y): f"room corner ({x:g} m, {y:g} m)" for x in (0.0, wide) for y in (0.0, deep)}
    names = [survey.target_names[t] for t in low] + list(corners.values())
    return names, np.concatenate([survey.points[low, :2], np.array(list(corners))])


def _tapes(plan: Plan, place: Floats, names: Sequence[str], marks: Floats) -> tuple[Tape, ...]:
    """Three marks whose distances cross well and are short, with a free way along the floor."""
    way = marks - place[:2]
    length = np.linalg.norm(way, axis=1)
    good: Bools = (length > NEAR) & (length < TAPE)
    if plan.site.obstacles is not None and good.any():
        start = np.column_stack([np.tile(place[:2], (len(marks), 1)), np.full(len(marks), ANKLE)])
        end = np.column_stack([marks, np.full(len(marks), ANKLE)])
        good[good] = ~plan.site.obstacles.blocked(start[good], end[good])
    turn = np.arctan2(way[:, 1], way[:, 0])
    near = np.flatnonzero(good)[np.argsort(length[good], kind="stable")][:16]

    def worth(three: tuple[int, ...]) -> float:
        crossing = min(abs(np.sin(turn[i] - turn[j])) for i, j in combinations(three, 2))
        return float(crossing - BORED * length[list(three)].max())

    if len(near) < 3:
        return tuple(Tape(names[i], float(length[i])) for i in near)
    best = max(combinations(near.tolist(), 3), key=worth)
    return tuple(Tape(names[i], float(length[i])) for i in best)


def _towards(plan: Plan, place: Floats, yaw: float, seen: Bools) -> str:
    """Where azimuth zero looks: the target in sight that is nearest to it, and how far beside."""
    survey = plan.chosen.survey
    way = survey.points[seen] - place
    off = np.angle(np.exp(1j * (np.arctan2(way[:, 1], way[:, 0]) - yaw)))
    best = int(np.argmin(np.abs(off)))
    name = survey.target_names[np.flatnonzero(seen)[best]]
    degrees = round(abs(float(off[best])) / DEGREE)
    return name if degrees == 0 else f"{degrees}° {'right' if off[best] > 0 else 'left'} of {name}"


def work_rows(plan: Plan) -> list[list[Any]]:
    """Rows of `work-order.csv`: every pointing with the readings of a perfect instrument at its place."""
    recording = plan.chosen.survey.recording(plan.chosen.information.construction)
    return [
        [
            i + 1, recording.stations[recording.station[i]], recording.targets[recording.target[i]],
            int(recording.face[i]), int(recording.repeat[i]), round(float(recording.time[i]) / 60.0, 2),
            round(float(reading[1]) / DEGREE % 360, 3), round(float(reading[2]) / DEGREE, 3),
            round(float(reading[0]) / MILLIMETRE, 1),
        ]
        for i, reading in enumerate(recording.readings)
    ]  # fmt: skip


def checks(plan: Plan) -> list[str]:
    """What to check and when, in the order of the work."""
    survey, file = plan.chosen.survey, plan.file
    found = [
        f"Before the first pointing: the tracker is warm, its own checks are passed, the air has the planned "
        f"{plan.scenario.workshop.temperature_c:g} °C; note temperature, pressure and humidity.",
        f"At every station, before its first pointing: the head stands within {file.stations.play_mm:g} mm of its "
        "place, and every point of its list is in sight.",
        "At the end of every station: measure the points under 'again' once more; where one is off by more than "
        "stated, the tripod or the point has moved, and the station is measured anew.",
    ]
    if len(survey.faces) == 2:
        found.append("In both faces: the two readings of a point differ as those of the others do; else one is a slip.")
    if len(survey.position) > 1:
        found.append(
            "Before the second station and each later one is left: ltsim adjust of all so far suspects no pointing."
        )
    return found
