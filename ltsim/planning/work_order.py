"""Work order of a plan for the shop floor: tape distances that locate the tripods, order of measurement, checks.

A mark is the end point of a tape distance: a reflector, a point below a reflector, or a corner of the hall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.core.units import DEGREE, MILLIMETRE
from ltsim.physics.model.measurement import sightings_at_state
from ltsim.planning.planner import PlannedNetwork

MAX_PLUMB_HEIGHT = 2.2
"""Largest height [m] from which a point is plumbed to the floor; the tape distance to a higher point is straight."""
MAX_TAPE_DISTANCE = 15.0
"""Largest distance [m] for a tape or a distance meter; a longer distance is used only if there are too few shorter
distances."""
MAX_CONSIDERED_TAPE_MARKS = 16
"""Largest number of marks (end points of tape distances) among which the three marks of a station are selected."""
MIN_STRENGTH_GAIN_OF_STRAIGHT_DISTANCE = 0.1
"""Limit of the increase of the strength of the intersection of tape distances (`intersection_strength`: their smallest
change, in metres, if the tripod moves by 1 m). If a straight distance to a reflector increases it more, it replaces a
distance along the floor."""
TAPE_RESOLUTION = 0.01
"""Resolution [m] with which a distance is read from a tape."""
MAX_TAPE_POSITION_ERROR = 0.03
"""Largest uncertainty [m] of a tripod position from three distances read to `TAPE_RESOLUTION`. Above it the work order
asks the user to mark the position in another way."""
MIN_SECOND_INTERSECTION_MISCLOSURE = 0.1
"""Smallest difference [m] between the measured third tape distance and its value at the second intersection of the
first two distances. If the difference is smaller, the position is ambiguous."""
MIN_TAPE_DISTANCE = 0.3
"""Smallest distance [m] of a mark (end point of a tape distance) from a tripod."""
TAPE_CLEARANCE_HEIGHT = 0.1
"""Height [m] above the floor at which no obstacle may cross the tape."""
MIN_STRENGTH_GAIN_PER_METRE = 0.03
"""Smallest increase of the strength of the intersection of three tape distances (`intersection_strength`: their
smallest change, in metres, if the tripod moves by 1 m) that justifies a longest distance longer by one metre."""
MAX_REPEAT_DIFFERENCE_SIGMAS = 3.0
"""Limit of the difference between two measurements of a point, in standard deviations. If it is exceeded, the tripod or
the point has moved."""
N_REPEATED_POINTS_PER_STATION = 3
"""Number of points that are measured again at the end of each station, to detect a moved tripod."""


@dataclass(frozen=True)
class TapeDistance:
    """Distance between a tripod and a mark, measured with a tape along the floor or straight.

    A distance along the floor leads from the point below the tracker head to the point below the mark, a straight one
    from the head to a reflector.
    """

    mark_name: str
    """Name of the mark: a reflector, or a corner of the hall."""
    mark_position: Floats
    """Coordinates of the mark, (3,) [m]."""
    length: float
    """Distance [m] that the tape should show."""
    is_along_floor: bool
    """True for a distance along the floor, False for a straight one."""

    @property
    def text(self) -> str:
        """Text of the distance and its mark, such as "3.25 m to P4 (straight)"."""
        return f"{self.length:.2f} m to {self.mark_name}{'' if self.is_along_floor else ' (straight)'}"

    @classmethod
    def from_station(
        cls, target: str, target_position: Floats, station: Floats, *, is_along_floor: bool
    ) -> TapeDistance:
        """Tape distance from an instrument at `station` (3,) [m] to the mark `target` at `target_position` (3,) [m]."""
        gap = target_position - station
        return cls(target, target_position, float(np.linalg.norm(gap[:2] if is_along_floor else gap)), is_along_floor)


@dataclass(frozen=True)
class StationInstruction:
    """Instructions for one station in the work order of a plan."""

    name: str
    """Name of the station."""
    head_height: float
    """Height [m] of the head's centre above the floor."""
    tape_distances: tuple[TapeDistance, ...]
    """Three tape distances that locate the tripod; `deficiency_sentence` reports if they are insufficient."""
    deficiency_sentence: str
    """Sentence with the reason why the tape distances do not determine the position; empty if they do."""
    zero_direction_text: str
    """Text of the direction of azimuth zero."""
    target_order: tuple[str, ...]
    """Names of the targets in the order of their first pointing."""
    permitted_difference_by_repeated_target: dict[str, float]
    """Largest permitted difference [m] between the first and the repeated measurement of each target that is measured
    again at the end, by name of the target."""
    minutes: float
    """Duration [min] of all pointings from this station."""


def station_instructions(plan: PlannedNetwork) -> tuple[StationInstruction, ...]:
    """Instructions for each station of a plan, in the order of measurement."""
    survey, built = plan.layout.survey, plan.layout.expected_precision.construction
    recording = survey.noise_free_recording(built)
    sightings = sightings_at_state(recording, survey.nominal_state(built))
    sigma = survey.noise_sigmas(sightings) * survey.is_recorded_observable
    horizontal = sightings.range_ * np.cos(sightings.elevation)
    error = np.linalg.norm(sigma * np.stack([np.ones_like(horizontal), horizontal, sightings.range_], axis=1), axis=1)
    settings = []
    for s, name in enumerate(recording.stations):
        rows = np.flatnonzero(recording.station == s)
        at = survey.station_names.index(name)
        place, visible = survey.station_positions[at], survey.is_visible[at]
        order = list(dict.fromkeys(recording.target[rows].tolist()))
        again = [
            order[i]
            for i in np.unique(np.linspace(0, len(order) - 1, N_REPEATED_POINTS_PER_STATION).round().astype(int))
        ]
        limit = {
            t: MAX_REPEAT_DIFFERENCE_SIGMAS * np.sqrt(2.0) * float(error[rows[recording.target[rows] == t][0]])
            for t in again
        }
        tapes = _best_tape_distances(_candidate_tape_distances(plan, place, visible), place)
        settings.append(
            StationInstruction(
                name=name,
                head_height=float(place[2]),
                tape_distances=tapes,
                deficiency_sentence=tape_deficiency_sentence(tapes, place),
                zero_direction_text=_zero_direction_text(plan, place, float(survey.station_yaws[at]), visible),
                target_order=tuple(recording.targets[t] for t in order),
                permitted_difference_by_repeated_target={recording.targets[t]: value for t, value in limit.items()},
                minutes=len(rows) * survey.seconds_per_pointing / 60.0,
            )
        )
    return tuple(settings)


def _candidate_tape_distances(plan: PlannedNetwork, place: Floats, is_visible: Bools) -> list[TapeDistance]:
    """Tape distances from a station at `place` (3,) [m] to possible marks, in order of preference.

    Distances within reach of a tape come before longer ones, distances along the floor before straight ones, short ones
    before long ones. Distances along the floor lead to points that can be plumbed and to corners of the hall, if no
    obstacle and no keep-out area is in the path. Straight ones lead to the reflectors that `is_visible` (T,) flags.
    """
    survey, obstacles = plan.layout.survey, plan.search_space.obstacles
    targets = list(zip(survey.target_names, survey.target_points, strict=True))
    wide, deep = np.array(plan.scenario.workshop.size_mm[:2]) * MILLIMETRE
    corners = [(f"hall corner ({x:g} m, {y:g} m)", np.array([x, y, 0.0])) for x in (0.0, wide) for y in (0.0, deep)]
    plumbed = [*((name, point) for name, point in targets if point[2] <= MAX_PLUMB_HEIGHT), *corners]
    level = [TapeDistance.from_station(name, point, place, is_along_floor=True) for name, point in plumbed]
    tapes = [np.stack([place[:2], mark.mark_position[:2]]) for mark in level]
    crossed = [any(area.is_crossed_by_path(tape) for area in plan.search_space.forbidden_areas) for tape in tapes]
    level = [mark for mark, is_crossed in zip(level, crossed, strict=True) if not is_crossed]
    if obstacles is not None:
        ends = np.array([[*mark.mark_position[:2], TAPE_CLEARANCE_HEIGHT] for mark in level])
        blocked = obstacles.is_blocked(np.tile([*place[:2], TAPE_CLEARANCE_HEIGHT], (len(ends), 1)), ends)
        level = [mark for mark, hidden in zip(level, blocked, strict=True) if not hidden]
    reachable = {mark.mark_name for mark in level}
    straight = [
        TapeDistance.from_station(*targets[t], place, is_along_floor=False)
        for t in np.flatnonzero(is_visible)
        if targets[t][0] not in reachable
    ]
    candidates = [mark for mark in (*level, *straight) if mark.length > MIN_TAPE_DISTANCE]
    return sorted(candidates, key=lambda mark: (mark.length > MAX_TAPE_DISTANCE, not mark.is_along_floor, mark.length))[
        :MAX_CONSIDERED_TAPE_MARKS
    ]


def _best_tape_distances(marks: Sequence[TapeDistance], place: Floats) -> tuple[TapeDistance, ...]:
    """Three short distances with a strong intersection that determine the position `place` (3,) [m] uniquely.

    If no three distances determine it, the result is the three with the strongest intersection, or all if there are
    fewer than three.
    """

    def preference(candidate_distances: tuple[TapeDistance, ...]) -> tuple[bool, bool, float]:
        """Sort key of three tape distances: larger for distances that are preferred."""
        strength, good = (
            intersection_strength(candidate_distances, place),
            not tape_deficiency_sentence(candidate_distances, place),
        )
        longest, straight = (
            max(mark.length for mark in candidate_distances),
            sum(not mark.is_along_floor for mark in candidate_distances),
        )
        return (
            good,
            good and longest <= MAX_TAPE_DISTANCE,
            strength
            - good * (MIN_STRENGTH_GAIN_PER_METRE * longest + MIN_STRENGTH_GAIN_OF_STRAIGHT_DISTANCE * straight),
        )

    return max(combinations(marks, 3), key=preference, default=tuple(marks))


def intersection_strength(distances: Sequence[TapeDistance], place: Floats) -> float:
    """Strength of the intersection of tape distances: smallest change of the distances if `place` moves by one metre.

    It is the smallest singular value of the derivatives of the distances by the horizontal coordinates of `place` (3,)
    [m]. The value is between 0 (undetermined) and the square root of the number of distances.
    """
    slopes = np.array([(place[:2] - mark.mark_position[:2]) / mark.length for mark in distances])
    return float(np.linalg.svd(slopes, compute_uv=False).min())


def tape_deficiency_sentence(tape_distances: Sequence[TapeDistance], place: Floats) -> str:
    """Sentence with the reason why tape distances do not determine the position `place` (3,) [m]; empty if they do.

    The distances are read to `TAPE_RESOLUTION`.
    """
    if len(tape_distances) < 3:
        return "Fewer than three points are within reach of a tape: mark the position in another way."
    if (strength := intersection_strength(tape_distances, place)) * MAX_TAPE_POSITION_ERROR < TAPE_RESOLUTION:
        wide = f"by {100 * TAPE_RESOLUTION / strength:.0f} cm" if strength > TAPE_RESOLUTION else "along a line"
        return f"The tapes meet at a flat angle, so the position is uncertain {wide}: mark it in another way."
    end_points = np.array([mark.mark_position[:2] for mark in tape_distances])
    rise = np.array([mark.length for mark in tape_distances]) ** 2 - np.sum((place[:2] - end_points) ** 2, axis=1)
    first, second = max(combinations(end_points, 2), key=lambda ends: float(np.linalg.norm(ends[1] - ends[0])))
    direction = (second - first) / np.linalg.norm(second - first)
    gap = place[:2] - first
    mirror = place[:2] - 2.0 * (gap - direction * (gap @ direction))
    misses = np.sqrt(np.sum((mirror - end_points) ** 2, axis=1) + rise) - [mark.length for mark in tape_distances]
    if (
        np.linalg.norm(mirror - place[:2]) < MAX_TAPE_POSITION_ERROR
        or np.abs(misses).max() > MIN_SECOND_INTERSECTION_MISCLOSURE
    ):
        return ""
    position = f"x {mirror[0]:.2f}, y {mirror[1]:.2f} m"
    return (
        f"The tape distances also fit a wrong position, {position}: check on which side of the marks the tripod stands."
    )


def _zero_direction_text(plan: PlannedNetwork, place: Floats, yaw: float, is_visible: Bools) -> str:
    """Text of the direction of azimuth zero: the nearest visible target, and the angle from it.

    `place` (3,) [m] is the position of the station, `is_visible` (T,) flags the visible targets.
    """
    survey = plan.layout.survey
    way = survey.target_points[is_visible] - place
    direction_errors = np.angle(np.exp(1j * (np.arctan2(way[:, 1], way[:, 0]) - yaw)))
    best_index = int(np.argmin(np.abs(direction_errors)))
    name = survey.target_names[np.flatnonzero(is_visible)[best_index]]
    degrees = round(abs(float(direction_errors[best_index])) / DEGREE)
    return name if degrees == 0 else f"{degrees}° {'right' if direction_errors[best_index] > 0 else 'left'} of {name}"


def operator_check_sentences(plan: PlannedNetwork) -> list[str]:
    """Sentences on the checks that the operator makes during the measurement of a plan, in the order of the work."""
    survey, file = plan.layout.survey, plan.plan_file
    sentences = [
        f"Before the first pointing: the tracker is warm, its built-in checks are passed, the air has the planned "
        f"{plan.scenario.workshop.temperature_c:g} °C. Note temperature, pressure and humidity.",
        "At every station, before its first pointing: the head is within "
        f"{file.stations.position_tolerance_mm:g} mm of its planned position, and every point of its list is visible.",
        "At the end of every station: measure the points under 'again' once more. If one differs by more than "
        "its limit, the tripod or the point has moved: measure the station again.",
    ]
    if len(survey.faces) == 2:
        sentences.append(
            "In both faces: the difference between the readings of both faces is similar for all points; otherwise one "
            "of the readings is wrong."
        )
    if len(survey.station_positions) > 1:
        sentences.append(
            "Before you leave the second and each later station: ltsim adjust with all readings reports no outlier."
        )
    return sentences
