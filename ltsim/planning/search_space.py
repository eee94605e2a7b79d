"""Search space of a plan: candidate positions of stations and reflectors, with the rules of a layout.

`SearchSpace.is_feasible` tests many layouts at once in a search; `SearchSpace.broken_rules` describes the rules that a
single layout breaks. Both apply the rules of `ltsim.planning.layout_rules`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.equality import ValueEquality
from ltsim.core.notation import names_text
from ltsim.planning.layout_rules import (
    MAX_NAMES_IN_RULE_TEXT,
    MIN_VISIBLE_TARGETS_PER_STATION,
    BrokenRule,
    ClearanceRule,
    CoincidenceRule,
    LayoutRule,
    NestAimRule,
    PositionRule,
    SpacingRule,
    StationSightsRule,
    TargetSightsRule,
    floor_rules,
    is_feasible_layout,
    meets_position_rules,
)
from ltsim.planning.station_placement import StationPlacement
from ltsim.planning.survey import PlannedSurvey
from ltsim.scene.clearance import StandClearance
from ltsim.scene.floor import KeepOutArea, StandingArea, grid_over_area, height_range_text
from ltsim.scene.meshes import Obstacles
from ltsim.scene.visibility import SightLimits, compute_visibility

MAX_DISTANCE_TO_CLEARANCE_RATIO = 1.05
"""Limit of the distance of a station from a body, divided by the clearance. A station with a smaller ratio is said to
be limited by the clearance."""
MAX_DISTANCE_TO_SPACING_RATIO = 1.02
"""Limit of the distance of two stations, divided by the smallest permitted distance. Stations with a smaller ratio are
said to be limited by the spacing."""


@dataclass(frozen=True)
class SearchSpace(ValueEquality):
    """Search space of a plan: allowed positions of stations and reflectors, and the sights that a layout must have."""

    survey: PlannedSurvey
    """Planned survey with the initial layout, targets, gauge (reflectors at known distances), noise and order of
    measurement."""
    allowed_areas: tuple[StandingArea, ...]
    """Areas where tripods may stand."""
    sight_limits: SightLimits
    """Limits of range, elevation and incidence within which a station can measure a target."""
    is_aimed_nest: Bools
    """Flags (T,): True for a target in a fixed nest that is aimed at the stations of every layout anew."""
    obstacles: Obstacles | None = None
    """Obstacles that block sights and tripods; None without obstacles."""
    stand_clearance: StandClearance | None = None
    """Clearance of stands from bodies; None without obstacles."""
    forbidden_areas: tuple[KeepOutArea, ...] = ()
    """Areas where no tripod may stand, even inside `allowed_areas`."""
    min_station_spacing: float = 1.0
    """Smallest horizontal distance between two stations [m]."""
    position_tolerance: float = 0.0
    """Largest horizontal distance [m] of an instrument from its planned position at which every sight must still be
    free."""
    min_sights_per_target: int = 1
    """Smallest number of stations that must see each target."""
    fixed_station_indices: tuple[int, ...] = ()
    """Indices of the stations that keep their positions."""
    candidate_reflector_places: Floats | None = None
    """Coordinates (P, 3) [m] of P candidate positions of reflectors; None if reflectors do not move."""
    reflector_place_names: tuple[str, ...] = ()
    """Name that a reflector gets at each of `candidate_reflector_places`."""
    min_reflector_spacing: float = 0.3
    """Smallest distance between reflectors [m]."""

    @property
    def head_heights(self) -> tuple[float, float]:
        """Lowest and highest permitted height [m] of the centre of a tracker head, over all allowed areas."""
        lowest, highest = zip(*(area.head_height_range for area in self.allowed_areas), strict=True)
        return min(lowest), max(highest)

    def replace(self, **changes: Any) -> SearchSpace:
        """Copy of the search space in which `changes` replace the fields with these names."""
        return replace(self, **changes)

    def is_allowed(self, position: Floats, needs_clearance: Bools | bool = True) -> Bools:
        """Flags (N,): True for each of N positions (N, 3) [m] of tracker heads where a tripod may stand.

        `needs_clearance` (N,) is False for a position at which a station already stands, so that its stand fits.
        """
        is_allowed = meets_position_rules(self._floor_rules, position)
        tested = np.flatnonzero(is_allowed & needs_clearance)
        if self._clearance_rule is not None:
            is_allowed[tested] = meets_position_rules([self._clearance_rule], position[tested])
        return is_allowed

    def is_allowed_station(self, survey: PlannedSurvey) -> Bools:
        """Flags (S,): True for each of the S stations of a layout that stands where a tripod may stand.

        Fixed stations, such as pillars and brackets on walls, need no clearance.
        """
        return self.is_allowed(survey.station_positions, self._needs_clearance(survey.station_names))

    def _needs_clearance(self, station_names: Sequence[str]) -> Bools:
        """Flags (S,): True for each of S stations that is not fixed and must keep the clearance from bodies."""
        fixed_names = [self.survey.station_names[s] for s in self.fixed_station_indices]
        return np.array([name not in fixed_names for name in station_names], dtype=bool)

    def is_visible(self, position: Floats, points: Floats | None = None) -> Bools:
        """Flags (N, T): True if a target is visible from everywhere near a position (N, 3) [m].

        Near are all positions within the position tolerance. `points` (T, 3) [m] are the targets, by default those of
        the survey. Angles of incidence on fixed nests are not tested, because these nests are aimed later.
        """
        goal = self.survey.target_points if points is None else points
        table = compute_visibility(position, goal, self.sight_limits, obstacles=self.obstacles)
        turn = self.position_tolerance / table.ranges
        lowest = max(self.sight_limits.elevation_min, 0.5 * (self.sight_limits.shadow_cone_opening - np.pi))
        is_visible_place: Bools = (
            table.is_visible
            & (table.elevations - turn >= lowest)
            & (table.elevations + turn <= self.sight_limits.elevation_max)
        )
        is_visible_place &= table.ranges - self.position_tolerance >= self.sight_limits.range_min
        if self.obstacles is not None and self.position_tolerance:
            s, t = np.nonzero(is_visible_place)
            is_visible_place[s, t] = ~self.obstacles.is_blocked_within_tolerance(
                position[s], self.obstacles.moved_to_surface(goal)[t], self.position_tolerance
            )
        return is_visible_place

    def is_feasible(self, position: Floats, is_visible: Bools) -> Bools:
        """Flags (B,): True for a layout that meets all rules on spacing, sights and fixed nests.

        `position` (B, S, 3) [m] are the positions of S stations, `is_visible` (B, S, T) flags their sights to T
        targets.
        """
        return is_feasible_layout((*self._joint_position_rules, *self._sight_rules), position, is_visible)

    def broken_rules(self, survey: PlannedSurvey) -> tuple[BrokenRule, ...]:
        """Rules of the plan that a layout breaks, first those on positions, then those on sights; empty if none."""
        return (*self.broken_position_rules(survey), *self.broken_sight_rules(survey))

    def broken_position_rules(self, survey: PlannedSurvey) -> tuple[BrokenRule, ...]:
        """Broken rules on floor, clearance, coincidence and spacing of the positions of stations; empty if all hold.

        For each station only the first broken rule on its own position is described.
        """
        rules, names = list[BrokenRule](), survey.station_names
        for name, place, needs_clearance in zip(
            names, survey.station_positions, self._needs_clearance(names), strict=True
        ):
            clearance = [self._clearance_rule] if self._clearance_rule is not None and needs_clearance else []
            broken = (rule for rule in (*self._floor_rules, *clearance) if rule.is_broken(place[None])[0])
            rules += [BrokenRule(f"{name} stands {rule.reason(place)}", (name,)) for rule in islice(broken, 1)]
        joint = self.replace(survey=survey)._joint_position_rules
        return (*rules, *(broken for rule in joint for broken in rule.broken_rules(survey)))

    def broken_sight_rules(self, survey: PlannedSurvey) -> tuple[BrokenRule, ...]:
        """Rules on sights that a layout breaks, according to `is_visible` of the survey; empty if none is broken."""
        return tuple(broken for rule in self._sight_rules for broken in rule.broken_rules(survey))

    @property
    def _floor_rules(self) -> tuple[PositionRule, ...]:
        """Rules on the position of a tripod, without its clearance from bodies."""
        return floor_rules(self.allowed_areas, self.forbidden_areas, self.obstacles)

    @property
    def _clearance_rule(self) -> ClearanceRule | None:
        """Rule on the clearance of a stand; None without obstacles."""
        return None if self.stand_clearance is None else ClearanceRule(self.stand_clearance)

    @property
    def _joint_position_rules(self) -> tuple[LayoutRule, ...]:
        """Rules on the positions of all stations together."""
        return CoincidenceRule(self.survey.target_points), SpacingRule(self.min_station_spacing)

    @property
    def _sight_rules(self) -> tuple[LayoutRule, ...]:
        """Rules on the sights of a layout; the aim of fixed nests, which takes most time, is the last."""
        rules = (TargetSightsRule(self.min_sights_per_target), StationSightsRule())
        if not self.is_aimed_nest.any():
            return rules
        names = tuple(self.survey.target_names[t] for t in np.flatnonzero(self.is_aimed_nest))
        points = self.survey.target_points[self.is_aimed_nest]
        return (*rules, NestAimRule(names, points, self.sight_limits.max_incidence_angle, self.position_tolerance))

    def spacing_limit_sentences(self, survey: PlannedSurvey) -> list[str]:
        """Sentence, in a list, on pairs of stations whose distance is hardly larger than permitted; or empty list."""
        too_near, near = (
            [broken.stations for broken in SpacingRule(factor * self.min_station_spacing).broken_rules(survey)]
            for factor in (1.0, MAX_DISTANCE_TO_SPACING_RATIO)
        )
        pairs = ", ".join(" and ".join(pair) for pair in near if pair not in too_near)
        return [f"{pairs} are at the minimum spacing of {self.min_station_spacing:g} m."] if pairs else []

    def clearance_limit_sentences(self, survey: PlannedSurvey) -> list[str]:
        """Sentences on stations of a layout, as a list, that keep the clearance from bodies but hardly more."""
        if self.stand_clearance is None:
            return []
        radius, position = self.stand_clearance.radius, survey.station_positions
        wider = replace(self.stand_clearance, radius=MAX_DISTANCE_TO_CLEARANCE_RATIO * radius)
        is_near = self.stand_clearance.has_room(position) & ~wider.has_room(position)
        return [
            f"{survey.station_names[s]} is at the minimum clearance of {radius:g} m from "
            f"{wider.nearest_body(position[s])[1] or 'a body'} (stations.clearance_mm)."
            for s in np.flatnonzero(is_near).tolist()
        ]

    def connectivity_scores(self, is_visible: Bools) -> Floats:
        """Score (B,) of B layouts: number of stations connected to the first station, plus a fraction.

        Two stations are connected if they see at least two common targets, directly or through other stations. The
        fraction is below 1 and grows with the mean number of common targets; at most three count for each pair of
        stations. `is_visible` (B, S, T) flags the sights from S stations to T targets.
        """
        shared = np.minimum(
            np.einsum("bst,brt->bsr", is_visible, is_visible, dtype=np.int64), MIN_VISIBLE_TARGETS_PER_STATION
        )
        linked = np.linalg.matrix_power((shared > 1).astype(np.float64), shared.shape[1])[:, 0] > 0
        return np.asarray(linked.sum(axis=1) + shared.mean(axis=(1, 2)) / (MIN_VISIBLE_TARGETS_PER_STATION + 1))

    def invisible_targets_sentence(self, target_indices: Ints) -> str:
        """Sentence on targets (by index) that no position on the floor sees, with the action to take."""
        held = (
            target_indices[self.obstacles.is_inside_body(self.survey.target_points[target_indices])]
            if self.obstacles
            else target_indices[:0]
        )
        names, within = ([self.survey.target_names[t] for t in indices] for indices in (target_indices, held))
        cure = "raise the heads (floor.height_mm), enlarge the floor, or move the hidden targets"
        if within and self.obstacles:
            lie = "lies" if len(within) == 1 else "lie"
            bodies = self.obstacles.body_names_around(self.survey.target_points[held])
            where = f"inside an obstacle{f' ({names_text(bodies, MAX_NAMES_IN_RULE_TEXT)})' if bodies else ''}"
            cure = f"{names_text(within, MAX_NAMES_IN_RULE_TEXT)} {lie} {where}: move points or bodies"
        heights = height_range_text(*self.head_heights)
        return (
            f"no place on the floor sees {names_text(names, MAX_NAMES_IN_RULE_TEXT)}, from heads at {heights}; {cure}"
        )

    def unseen_targets_text(self, placement: StationPlacement, place_indices: list[int]) -> str:
        """Names of the targets that too few stations see from the given candidate positions; empty if none.

        `placement` holds the candidate positions, `place_indices` the indices of those where stations are.
        """
        deficient_names = np.flatnonzero(placement.missing_sights(place_indices, self.min_sights_per_target))
        return (
            names_text([self.survey.target_names[t] for t in deficient_names], MAX_NAMES_IN_RULE_TEXT)
            if len(deficient_names)
            else ""
        )

    def grid_station_positions(self, step: float, n_heights: int) -> Floats:
        """Coordinates (N, 3) [m] of N grid points where a tripod may stand.

        `step` [m] is the horizontal step; each point of the horizontal grid has `n_heights` heights.
        """
        grid = np.concatenate([grid_over_area(area, step, n_heights) for area in self.allowed_areas])
        return np.unique(grid[self.is_allowed(grid)], axis=0)

    def candidate_placement(self, step: float, n_heights: int) -> StationPlacement:
        """Candidate positions on a grid from which at least `MIN_VISIBLE_TARGETS_PER_STATION` targets are visible.

        The result also contains the fixed stations. `step` [m] is the horizontal step, `n_heights` the number of
        heights. Raises InputError if no position sees enough targets.
        """
        places = self.grid_station_positions(step, n_heights)
        fixed = self.survey.station_positions[list(self.fixed_station_indices)]
        visible = self.is_visible(places)
        counted = self.is_visible(fixed).sum(axis=0) if len(fixed) else np.zeros(visible.shape[1], dtype=np.int64)
        return StationPlacement.from_grid(places, visible, SpacingRule(self.min_station_spacing), fixed, counted)
