"""Rules of a layout: floor, heights, obstacles, clearance, coincidence, spacing, sights, and fixed nests.

Each rule is one class. Its test works on many positions or layouts at once, as a search needs it; the sentence on a
broken rule applies the same test to one layout. A sight is an unobstructed line from a station to a target.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.notation import names_text
from ltsim.core.units import MILLIMETRE
from ltsim.planning.survey import PlannedSurvey
from ltsim.scene.clearance import StandClearance
from ltsim.scene.floor import KeepOutArea, StandingArea, height_range_text
from ltsim.scene.meshes import Obstacles
from ltsim.scene.visibility import narrowest_cone_axes

MIN_VISIBLE_TARGETS_PER_STATION = 3
"""Smallest number of targets that a station must see; fewer do not determine its pose."""
MAX_COINCIDENCE_DISTANCE = 1e-3
"""Limit of the distance [m] of a station and a target. Below it they count as the same point, which a plan does not
permit."""
STATION_SPACING_TOLERANCE = 1e-9
"""Amount [m] by which the distance of two stations may fall below the smallest permitted distance, because of
rounding."""
MAX_NEST_AIMING_STEPS = 60
"""Largest number of steps of the iteration that aims a fixed nest at all stations."""
NEST_ANGLE_MARGIN = 0.004
"""Angle [rad] by which a search reduces the acceptance angle of a fixed nest, because the aiming iteration is inexact.
"""
MAX_NAMES_IN_RULE_TEXT = 8
"""Largest number of names that a sentence on a rule of the plan lists."""


class BrokenRule(NamedTuple):
    """Rule of the plan that a layout breaks."""

    sentence: str
    """Sentence without full stop on the broken rule, with the numbers and the key of the plan file."""
    stations: tuple[str, ...] = ()
    """Names of the stations whose positions break the rule; empty for a rule about sights."""


def broken_rules_text(rules: Sequence[BrokenRule]) -> str:
    """Sentences on the broken rules in one line, separated by semicolons; empty if no rule is broken."""
    return "; ".join(rule.sentence for rule in rules)


class PositionRule(ABC):
    """Rule that the position of a tripod meets or breaks, whatever the other positions are."""

    @abstractmethod
    def is_broken(self, position: Floats) -> Bools:
        """Flags (N,): True for each of N positions (N, 3) [m] of tracker heads that breaks the rule."""

    @abstractmethod
    def reason(self, position: Floats) -> str:
        """Reason why a position (3,) [m] that breaks the rule is not permitted, with the key of the plan file.

        The reason continues a sentence that begins with "S1 stands".
        """


@dataclass(frozen=True)
class StandingAreaRule(PositionRule):
    """Rule that a tripod stands in a permitted area, with the tracker head between the heights of this area."""

    areas: tuple[StandingArea, ...]
    """Areas where tripods may stand."""

    def is_broken(self, position: Floats) -> Bools:
        """Flags (N,): True for each of N positions (N, 3) [m] outside all permitted areas or their ranges of height."""
        is_in_area = np.zeros(len(position), dtype=bool)
        for area in self.areas:
            is_in_area |= area.contains_instrument(position)
        return ~is_in_area

    def reason(self, position: Floats) -> str:
        """Reason why a position (3,) [m] is not permitted, with the permitted heights over a permitted area."""
        areas_below = [area for area in self.areas if area.covers_positions(position[None, :2])[0]]
        if not areas_below:
            return "outside the permitted floor (floor.corners_mm, floor.areas, floor.margin_mm)"
        lowest, highest = zip(*(area.head_height_range for area in areas_below), strict=True)
        span = height_range_text(min(lowest), max(highest))
        return f"with its head at {position[2] / MILLIMETRE:.0f} mm, expected {span} (floor.height_mm)"


@dataclass(frozen=True)
class KeepOutRule(PositionRule):
    """Rule that no tripod stands in an area to be kept free."""

    areas: tuple[KeepOutArea, ...]
    """Areas to be kept free of tripods."""

    def is_broken(self, position: Floats) -> Bools:
        """Flags (N,): True for each of N positions (N, 3) [m] in an area to be kept free, or in its clearance."""
        is_in_area = np.zeros(len(position), dtype=bool)
        for area in self.areas:
            is_in_area |= area.blocks_positions(position[:, :2])
        return is_in_area

    def reason(self, position: Floats) -> str:
        """Reason why a position (3,) [m] is not permitted: keys of the areas to be kept free in which it lies."""
        return "in an area to be kept free (floor.keep_outs, floor.doors)"


@dataclass(frozen=True)
class ObstacleRule(PositionRule):
    """Rule that no tripod stands inside a body of the hall."""

    obstacles: Obstacles
    """Bodies of the hall."""

    def is_broken(self, position: Floats) -> Bools:
        """Flags (N,): True for each of N positions (N, 3) [m] inside a body."""
        return self.obstacles.is_setup_inside_body(position)

    def reason(self, position: Floats) -> str:
        """Reason why a position (3,) [m] is not permitted: names of the bodies of the hall that contain it."""
        names = self.obstacles.body_names_around(position[None], of_setups=True)
        return f"inside an obstacle (workshop.obstacles{': ' if names else ''}{', '.join(names)})"


@dataclass(frozen=True)
class ClearanceRule(PositionRule):
    """Rule that the stand of an instrument keeps a clearance from the bodies of the hall."""

    clearance: StandClearance
    """Clearance around stands."""

    def is_broken(self, position: Floats) -> Bools:
        """Flags (N,): True for each of N positions (N, 3) [m] with a body of the hall in the clearance of the stand."""
        return ~self.clearance.has_room(position)

    def reason(self, position: Floats) -> str:
        """Reason why a position (3,) [m] is not permitted: distance and name of the nearest body of the hall."""
        distance, body = self.clearance.nearest_body(position)
        words = f"{distance:.3f} m from {body or 'a body'}, closer than {self.clearance.radius:g} m"
        return f"{words} (stations.clearance_mm)"


def floor_rules(
    standing_areas: Sequence[StandingArea], keep_out_areas: Sequence[KeepOutArea], obstacles: Obstacles | None
) -> tuple[PositionRule, ...]:
    """Rules on the position of a tripod without its clearance, in the order in which a position is refused."""
    rules = (StandingAreaRule(tuple(standing_areas)), KeepOutRule(tuple(keep_out_areas)))
    return rules if obstacles is None else (*rules, ObstacleRule(obstacles))


def meets_position_rules(rules: Sequence[PositionRule], position: Floats) -> Bools:
    """Flags (N,): True for each of N positions (N, 3) [m] that meets all rules.

    Later rules are tested only at the positions that meet the earlier ones.
    """
    is_met = np.ones(len(position), dtype=bool)
    for rule in rules:
        tested = np.flatnonzero(is_met)
        if len(tested):
            is_met[tested] = ~rule.is_broken(position[tested])
    return is_met


class LayoutRule(ABC):
    """Rule on all stations of a layout together."""

    @abstractmethod
    def violations(self, position: Floats, is_visible: Bools) -> Bools:
        """Flags (B, k): True for each of k elements (pairs, targets, stations) that breaks the rule in B layouts.

        `position` (B, S, 3) [m] are the positions of S stations, `is_visible` (B, S, T) flags their sights to T
        targets.
        """

    @abstractmethod
    def sentences(self, survey: PlannedSurvey, broken: Ints) -> list[BrokenRule]:
        """Sentences on the layout of a survey, in which the elements with the indices `broken` break the rule."""

    def broken_rules(self, survey: PlannedSurvey) -> list[BrokenRule]:
        """Sentences on the violations of the rule in the layout of a survey; empty if there are none."""
        flags = self.violations(survey.station_positions[None], survey.is_visible[None])[0]
        return self.sentences(survey, np.flatnonzero(flags)) if flags.any() else []


@dataclass(frozen=True)
class CoincidenceRule(LayoutRule):
    """Rule that no station coincides with a target; the elements are the pairs of a station and a target."""

    target_points: Floats
    """Coordinates (T, 3) [m] of the targets."""

    def violations(self, position: Floats, is_visible: Bools) -> Bools:
        """Flags (B, S * T): True for a pair of a station and a target at the same point, station by station."""
        is_same = np.abs(position[:, :, None, 0] - self.target_points[:, 0]) < MAX_COINCIDENCE_DISTANCE
        b, s, t = np.nonzero(is_same)  # few pairs have one coordinate in common
        is_same[b, s, t] = np.linalg.norm(position[b, s] - self.target_points[t], axis=1) < MAX_COINCIDENCE_DISTANCE
        return is_same.reshape(len(position), -1)

    def sentences(self, survey: PlannedSurvey, broken: Ints) -> list[BrokenRule]:
        """Sentence on each pair of a station and a target at the same point; `broken` (k,) are indices of pairs."""
        pairs = zip(*np.divmod(broken, len(self.target_points)), strict=True)
        return [
            BrokenRule(
                f"station {survey.station_names[s]} coincides with target {survey.target_names[t]}",
                (survey.station_names[s],),
            )
            for s, t in pairs
        ]


@dataclass(frozen=True)
class SpacingRule(LayoutRule):
    """Rule that two stations keep a horizontal distance from each other; the elements are the pairs of stations."""

    min_spacing: float
    """Smallest permitted horizontal distance [m] of two stations."""

    def is_too_near(self, distance: Floats) -> Bools:
        """Flags, with the shape of `distance` [m]: True where a horizontal distance of two stations is too small."""
        return np.asarray(distance <= self.min_spacing - STATION_SPACING_TOLERANCE)

    def violations(self, position: Floats, is_visible: Bools) -> Bools:
        """Flags (B, S (S - 1) / 2): True for a pair of stations that are too near each other."""
        first, second = np.triu_indices(position.shape[1], 1)
        return self.is_too_near(np.linalg.norm(position[:, first, :2] - position[:, second, :2], axis=2))

    def sentences(self, survey: PlannedSurvey, broken: Ints) -> list[BrokenRule]:
        """Sentence on each pair of stations that are too near each other, with their distance."""
        names, position = survey.station_names, survey.station_positions
        pairs = np.column_stack(np.triu_indices(len(names), 1))[broken].tolist()
        return [
            BrokenRule(
                f"{names[a]} and {names[b]} are {np.linalg.norm(position[a, :2] - position[b, :2]):.2f} m apart, "
                f"closer than {self.min_spacing:g} m (stations.spacing_mm)",
                (names[a], names[b]),
            )
            for a, b in pairs
        ]


@dataclass(frozen=True)
class TargetSightsRule(LayoutRule):
    """Rule that enough stations see each target; the elements are the targets."""

    min_sights_per_target: int
    """Smallest number of stations that must see each target."""

    def violations(self, position: Floats, is_visible: Bools) -> Bools:
        """Flags (B, T): True for a target that too few stations see."""
        return np.asarray(is_visible.sum(axis=1) < self.min_sights_per_target)

    def sentences(self, survey: PlannedSurvey, broken: Ints) -> list[BrokenRule]:
        """Sentence, in a list, on all targets that too few stations see."""
        named = names_text([survey.target_names[t] for t in broken], MAX_NAMES_IN_RULE_TEXT)
        verb = "is" if len(broken) == 1 else "are"
        stations = f"{self.min_sights_per_target} station{'s' if self.min_sights_per_target > 1 else ''}"
        return [BrokenRule(f"{named} {verb} visible from fewer than {stations} (stations.min_stations_per_target)")]


def sees_enough_targets(is_visible: Bools) -> Bools:
    """Flags (...): True for a station or position that sees at least `MIN_VISIBLE_TARGETS_PER_STATION` targets.

    `is_visible` (..., T) flags the sights to T targets.
    """
    return np.asarray(is_visible.sum(axis=-1) >= MIN_VISIBLE_TARGETS_PER_STATION)


class StationSightsRule(LayoutRule):
    """Rule that each station sees enough targets to determine its pose; the elements are the stations."""

    def violations(self, position: Floats, is_visible: Bools) -> Bools:
        """Flags (B, S): True for a station that sees too few targets."""
        return ~sees_enough_targets(is_visible)

    def sentences(self, survey: PlannedSurvey, broken: Ints) -> list[BrokenRule]:
        """Sentence on each station that sees too few targets, with the number of targets that it sees."""
        return [
            BrokenRule(
                f"{survey.station_names[s]} sees {survey.is_visible[s].sum()} targets, expected at least "
                f"{MIN_VISIBLE_TARGETS_PER_STATION}"
            )
            for s in broken
        ]


@dataclass(frozen=True)
class NestAimRule(LayoutRule):
    """Rule that each fixed nest can be aimed so that it returns the beams of all stations; the elements are nests."""

    target_names: tuple[str, ...]
    """Names of the targets in k fixed nests."""
    target_points: Floats
    """Coordinates (k, 3) [m] of the targets in k fixed nests."""
    max_incidence_angle: float
    """Acceptance angle [rad] of a nest."""
    position_tolerance: float
    """Largest horizontal distance [m] of an instrument from its planned position."""

    def violations(self, position: Floats, is_visible: Bools) -> Bools:
        """Flags (B, k): True where a fixed nest cannot be aimed at all stations, for B layouts and k nests."""
        back = position[:, None] - self.target_points[:, None, :]
        range_ = np.linalg.norm(back, axis=3, keepdims=True)
        cosine = np.einsum("btsk,btk->bts", back / range_, narrowest_cone_axes(back / range_, MAX_NEST_AIMING_STEPS))
        incidence = np.arccos(np.clip(cosine, -1.0, 1.0)) + self.position_tolerance / range_[..., 0]
        return np.asarray(incidence.max(axis=2) >= self.max_incidence_angle - NEST_ANGLE_MARGIN)

    def sentences(self, survey: PlannedSurvey, broken: Ints) -> list[BrokenRule]:
        """Sentence, in a list, on all fixed nests that cannot be aimed at all stations."""
        named = names_text([self.target_names[k] for k in broken], MAX_NAMES_IN_RULE_TEXT)
        return [BrokenRule(f"fixed nests of {named} cannot be aimed at all stations (smr.acceptance_deg)")]


def is_feasible_layout(rules: Sequence[LayoutRule], position: Floats, is_visible: Bools) -> Bools:
    """Flags (B,): True for a layout that meets all rules.

    `position` (B, S, 3) [m] are the positions of S stations, `is_visible` (B, S, T) flags their sights to T targets.
    Later rules are tested only on the layouts that meet the earlier ones.
    """
    is_feasible: Bools = np.zeros(len(position), dtype=bool)
    remaining = np.arange(len(position))
    for rule in rules:
        if len(remaining):
            is_met = ~rule.violations(position, is_visible).any(axis=1)
            if not is_met.all():
                remaining, position, is_visible = remaining[is_met], position[is_met], is_visible[is_met]
    is_feasible[remaining] = True
    return is_feasible
