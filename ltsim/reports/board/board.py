"""Layout whose stations the user moves in the browser: accuracy of the points, tolerances, and saved files."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.errors import InputError, LtsimError
from ltsim.core.units import DEGREE, MICROMETRE, MILLIMETRE
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.planning.expected_precision import ExpectedPrecision
from ltsim.planning.layout_rules import CoincidenceRule, broken_rules_text, sees_enough_targets
from ltsim.planning.planner import layout_visibility
from ltsim.planning.result import (
    PLAN_FILE_NAME,
    SCENARIO_FILE_NAME,
    load_plan_and_scenario,
    scenario_with_layout,
    with_cad_file_copies,
)
from ltsim.planning.search_inputs import plan_without_search
from ltsim.planning.search_space import SearchSpace
from ltsim.planning.spec import MAX_STATIONS, MIN_STATIONS, PlanFile
from ltsim.planning.survey import PlannedSurvey
from ltsim.planning.tolerances import (
    PointTolerances,
    check_tolerances,
    checks_after_required_losses,
    error_radius,
    is_tolerance_met,
    plan_verdict,
    tolerance_ratio_text,
)
from ltsim.recordings.files import write_texts
from ltsim.recordings.settings import to_toml
from ltsim.reports.scene3d import Camera
from ltsim.reports.scene_page import scene_page
from ltsim.reports.workshop_scene import workshop_from_scenario
from ltsim.scene.floor import tripod_grid_spacing
from ltsim.scene.meshes import Obstacles
from ltsim.scene.visibility import InvisibilityReason, stand_shadow_radii
from ltsim.simulation.physics import planned_construction
from ltsim.simulation.scenario import Scenario, scenario_to_toml

MAX_DRAWN_TRIANGLES = 20_000
"""Largest number of triangles of obstacles in the view from above; if there are more, the largest triangles are
drawn."""
STATION_NAME_PATTERN = r"\w[\w.\-]{0,39}"
"""Pattern of the permitted names of a station."""
MAX_OFFERED_POSITIONS = 200
"""Largest number of grid positions that the page offers for an additional station."""
MAX_COORDINATE_MM = 1e6
"""Largest magnitude of a coordinate [mm] of a station."""


@dataclass(frozen=True)
class MovableLayout:
    """Layout of a plan whose stations the user moves in the browser, with all data for its evaluation."""

    plan_file: PlanFile
    """Content of the plan file."""
    scenario: Scenario
    """Scenario with the initial stations."""
    search_space: SearchSpace
    """Permitted positions of stations, and lines of sight; the `survey` in it has the faces and rounds of the
    scenario."""
    construction: GeometricErrorModel
    """Geometric error model of the instruments."""
    tolerances: PointTolerances
    """Tolerances of the points in the plan file."""

    @classmethod
    def from_plan(cls, source: str | Path) -> MovableLayout:
        """Layout of a plan file, a scenario, or a folder that `ltsim plan` wrote; raises InputError, RecordError."""
        plan_or_scenario, scenario = load_plan_and_scenario(source)
        plan_file, search_space = plan_without_search(plan_or_scenario, scenario)
        return cls(
            plan_file, scenario, search_space, planned_construction(scenario), PointTolerances.from_plan_file(plan_file)
        )

    def hall_json(self) -> dict[str, Any]:
        """Description of the hall for the page: size [m], outlines from above, points, initial stations."""
        survey, floor = self.search_space.survey, self.plan_file.floor
        names = [area.name for area in floor.areas] or [""]
        free = [*(place.name for place in floor.keep_outs), *(door.name for door in floor.doors)]
        group_by_point = {point.name: point.group for point in self.plan_file.listed_points}
        tolerances = self.tolerances.tolerance_by_point_m
        stations = zip(survey.station_names, survey.station_positions, survey.station_yaws, strict=True)
        return {
            "title": self.plan_file.title or self.scenario.title,
            "size": [v * MILLIMETRE for v in self.scenario.workshop.size_mm],
            "level": 100 * self.tolerances.confidence_level,
            "areas": [
                {"name": name, "outlines": [area.outline.tolist(), *(hole.tolist() for hole in area.holes)]}
                for name, area in zip(names, self.search_space.allowed_areas, strict=True)
            ],
            "free": [
                {"name": name, "outline": place.outline.tolist()}
                for name, place in zip(free, self.search_space.forbidden_areas, strict=True)
            ],
            "obstacles": _obstacle_path(self.search_space.obstacles),
            "points": [
                {"name": name, "at": place, "group": group_by_point.get(name, ""),
                 "tolerance_um": tolerance / MICROMETRE if (tolerance := tolerances.get(name)) else None}
                for name, place in zip(survey.target_names, survey.target_points.tolist(), strict=True)
            ],
            "stations": [
                {"name": name, "position_mm": np.round(place / MILLIMETRE, 1).tolist(),
                 "yaw_deg": round(float(yaw) / DEGREE % 360, 2)}
                for name, place, yaw in stations
            ],
            "places": np.round(self._suggested_station_positions / MILLIMETRE, 1).tolist(),
        }  # fmt: skip

    @cached_property
    def _suggested_station_positions(self) -> Floats:
        """Positions (P, 3) [m] that the page offers for another station, at most `MAX_OFFERED_POSITIONS`.

        The P positions are points of a grid on the floor from which enough targets are visible.
        """
        search = self.plan_file.search
        places = self.search_space.grid_station_positions(
            tripod_grid_spacing(self.search_space.allowed_areas, search.grid_step_mm), search.height_count
        )
        places = places[:: max(1, -(-len(places) // MAX_OFFERED_POSITIONS))]
        return places[sees_enough_targets(self.search_space.is_visible(places))] if len(places) else places

    def survey_with_stations(self, stations: Sequence[Mapping[str, Any]]) -> PlannedSurvey:
        """Survey with the given stations (mappings with `name`, `position_mm` and `yaw_deg`); raises InputError.

        A station that is not in the plan has the lines of sight and the order of targets of a station of the plan; the
        stations of the plan are taken in turn.
        """
        survey = self.search_space.survey
        try:
            names = tuple(str(s["name"]) for s in stations)
            positions_mm = np.array([s["position_mm"] for s in stations], dtype=np.float64).reshape(-1, 3)
            yaws_deg = np.array([s["yaw_deg"] for s in stations], dtype=np.float64)
        except (KeyError, TypeError, ValueError):
            raise InputError("each station needs name, position_mm (x, y, z) and yaw_deg") from None
        if not np.all(np.abs([*positions_mm.ravel(), *yaws_deg]) < MAX_COORDINATE_MM):
            raise InputError(
                f"coordinates and yaw of a station must be smaller than {MAX_COORDINATE_MM:g} mm and degrees"
            )
        if not MIN_STATIONS <= len(names) <= MAX_STATIONS:
            raise InputError(f"a layout has {MIN_STATIONS} to {MAX_STATIONS} stations, not {len(names)}")
        if len({*names}) < len(names) or not all(re.fullmatch(STATION_NAME_PATTERN, name) for name in names):
            raise InputError("each station needs a different name of letters, digits, points and hyphens")
        old_names = survey.station_names
        template_stations = [
            old_names.index(name) if name in old_names else k % len(old_names) for k, name in enumerate(names)
        ]
        return survey.replace(
            station_names=names,
            station_positions=positions_mm * MILLIMETRE,
            station_yaws=yaws_deg * DEGREE,
            is_visible=survey.is_visible[template_stations],
            target_ranks=None if survey.target_ranks is None else survey.target_ranks[template_stations],
        )

    def _search_space_for_survey(self, survey: PlannedSurvey) -> SearchSpace:
        """Search space (permitted positions and rules) of the plan for the stations of `survey`.

        `survey` may have more or fewer stations than the plan.
        """
        min_stations = self.plan_file.stations.min_stations_per_target
        return self.search_space.replace(
            survey=survey,
            min_sights_per_target=len(survey.station_positions) if min_stations == "all" else min_stations,
        )

    def evaluation_json(self, stations: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Evaluation of a layout for the page: visible sights, uncertainty of each point, and broken rules.

        The stations are mappings with `name`, `position_mm` and `yaw_deg`.
        """
        survey = self.survey_with_stations(stations)
        search_space, broken_position_rules = (
            self._search_space_for_survey(survey),
            self.search_space.broken_position_rules(survey),
        )
        if _station_coincides_with_target(survey):
            return {"problem": broken_rules_text(broken_position_rules)}
        visibility = layout_visibility(search_space, survey)
        survey = survey.replace(is_visible=visibility.is_visible)
        evaluation = {
            "reasons": visibility.reason_codes.tolist(),
            "hidden": int(InvisibilityReason.HIDDEN_BY_OBSTACLE),
            "may_stand": self.search_space.is_allowed_station(survey).tolist(),
            "shadow": stand_shadow_radii(
                survey.station_positions, 0.0, self.search_space.sight_limits.shadow_cone_opening
            ).tolist(),
            "hours": survey.duration / 3600.0,
            "problem": broken_rules_text((*broken_position_rules, *search_space.broken_sight_rules(survey))),
        }
        visible = np.asarray(survey.is_visible.any(axis=0))
        try:
            information = ExpectedPrecision.from_survey(survey.with_targets_only(visible), self.construction)
            covariance = information.target_covariances
        except LtsimError as problem:
            return evaluation | {"problem": f"{problem}"}
        points: list[dict[str, Any] | None] = [None] * len(visible)
        sigmas, error_radii = (
            information.target_point_errors,
            error_radius(covariance, self.tolerances.confidence_level),
        )
        for k, t in enumerate(np.flatnonzero(visible)):
            accuracy = {"sigma_um": float(sigmas[k]) / MICROMETRE, "within_um": float(error_radii[k]) / MICROMETRE}
            tolerance = self.tolerances.tolerance_by_point_m.get(survey.target_names[t])
            points[t] = accuracy | (_tolerance_entries(float(error_radii[k]) / tolerance) if tolerance else {})
        return evaluation | {"points": points, "rms_um": information.target_rms / MICROMETRE}

    def verdict_json(self, stations: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
        """Verdict on rules and tolerances, also after the loss of a station or sight; None without tolerances.

        The stations are mappings with `name`, `position_mm` and `yaw_deg`.
        """
        survey = self.survey_with_stations(stations)
        if not self.tolerances or _station_coincides_with_target(survey):
            return None
        search_space = self._search_space_for_survey(survey)
        survey = survey.replace(is_visible=layout_visibility(search_space, survey).is_visible)
        losses = checks_after_required_losses(survey, self.tolerances, self.construction)
        checks = check_tolerances(survey, self.tolerances, self.construction)
        verdict = plan_verdict(self.tolerances, checks, losses, search_space.broken_rules(survey))
        return {"reached": verdict.is_goal_reached, "words": verdict.sentences}

    def scenario_with_stations(self, stations: Sequence[Mapping[str, Any]]) -> Scenario:
        """Scenario of the plan with the given stations (mappings with `name`, `position_mm` and `yaw_deg`)."""
        return scenario_with_layout(self.scenario, self.survey_with_stations(stations))

    def scene_page_with_stations(self, stations: Sequence[Mapping[str, Any]], camera: Camera | None = None) -> str:
        """HTML page of the hall in 3D with the given stations, seen from `camera` if it is given.

        The stations are mappings with `name`, `position_mm` and `yaw_deg`.
        """
        return scene_page(workshop_from_scenario(self.scenario_with_stations(stations)), camera)

    def save(self, stations: Sequence[Mapping[str, Any]], folder: Path) -> list[Path]:
        """Paths of the two written files: scenario.toml, and a plan.toml in which all stations are fixed."""
        scenario = self.scenario_with_stations(stations)
        plan = self.plan_file.model_dump(mode="json", exclude_defaults=True)
        for key in ("workshop", "instrument", "smr", "work"):
            plan.pop(key, None)
        names = list(scenario.stations)
        plan |= {"format": self.plan_file.format, "scenario": SCENARIO_FILE_NAME}
        plan["stations"] = plan.get("stations", {}) | {"count": len(names), "fixed_stations": names}
        scenario, cad_files = with_cad_file_copies(scenario)
        texts = {SCENARIO_FILE_NAME: scenario_to_toml(scenario), PLAN_FILE_NAME: to_toml(plan)}
        write_texts(folder, {**cad_files, **texts})
        return [folder / name for name in texts]


def _tolerance_entries(error_to_tolerance: float) -> dict[str, Any]:
    """Data of a point for the page, by key: ratio of error to tolerance, this ratio as text, and if it is met."""
    return {
        "ratio": error_to_tolerance,
        "used": tolerance_ratio_text(error_to_tolerance),
        "met": is_tolerance_met(error_to_tolerance),
    }


def _station_coincides_with_target(survey: PlannedSurvey) -> bool:
    """True if a station coincides with a target, so that no accuracy can be computed."""
    return bool(CoincidenceRule(survey.target_points).broken_rules(survey))


def _obstacle_path(obstacles: Any) -> str:
    """SVG path of the obstacles seen from above, x and y in metres."""
    if not isinstance(obstacles, Obstacles):
        return ""
    corners_xy: Floats = obstacles.triangles[:, :, :2]
    first, second = corners_xy[:, 1] - corners_xy[:, 0], corners_xy[:, 2] - corners_xy[:, 0]
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    corners_xy = np.where(
        area[:, None, None] < 0, corners_xy[:, ::-1], corners_xy
    )  # equal orientation, else overlaps would be holes
    largest_indices = np.argsort(-np.abs(area), kind="stable")[:MAX_DRAWN_TRIANGLES]
    drawn_triangles = np.round(corners_xy[largest_indices[area[largest_indices] != 0]], 3).tolist()
    return "".join("M" + "L".join(f"{x:g} {y:g}" for x, y in triangle) + "Z" for triangle in drawn_triangles)
