"""Layout of a hall whose stations are moved by hand: its accuracy, and its files."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.errors import LtsimError, SetupError
from ltsim.core.units import DEGREE, MICROMETRE, MILLIMETRE
from ltsim.physics.model.construction import Construction
from ltsim.planning.information import LayoutInformation
from ltsim.planning.layout_scenario import PLAN_FILE, SCENARIO_FILE, copy_cad_files, with_layout
from ltsim.planning.planner import layout_visibility
from ltsim.planning.result import load_plan_and_scenario
from ltsim.planning.site import MAX_COINCIDENCE_DISTANCE, MIN_VISIBLE_TARGETS, SearchSpace, broken_rules_text
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import PlannedSurvey
from ltsim.planning.tolerances import (
    PointTolerances,
    check_tolerances,
    checks_after_required_losses,
    error_radius,
    is_met,
    percent_text,
    plan_verdict,
)
from ltsim.planning.workshop import unsearched_plan
from ltsim.recordings.files import write_texts
from ltsim.recordings.settings import to_toml
from ltsim.reports.scene3d import Camera
from ltsim.reports.scene_page import scene_page
from ltsim.reports.workshop import from_scenario
from ltsim.scene.floor import grid_step
from ltsim.scene.meshes import Obstacles
from ltsim.scene.visibility import InvisibilityReason, shadow_radii
from ltsim.simulation.physics import planned_construction
from ltsim.simulation.scenario import Scenario, scenario_to_toml

MAX_TRIANGLES = 20_000
"""Largest number of triangles of obstacles drawn from above; the largest triangles are retained."""
MIN_STATIONS = 2
MAX_STATIONS = 40
"""Smallest and largest number of stations of a layout, as of a plan file."""
NAME = r"\w[\w.\-]{0,39}"
"""Pattern of the name of a station."""
MAX_PLACES = 200
"""Largest number of places of a grid at which a further station is offered."""
MAX_COORDINATE_MM = 1e6
"""Largest magnitude of a coordinate [mm] of a station."""


@dataclass(frozen=True)
class Board:
    """Layout of a hall with movable stations."""

    file: PlanFile
    scenario: Scenario
    """Scenario with the initial stations."""
    site: SearchSpace
    """Search space; its survey has the faces and rounds of the scenario."""
    construction: Construction
    demands: PointTolerances
    """Tolerances of points."""

    @classmethod
    def of(cls, source: str | Path) -> Board:
        """Layout of a plan file, a scenario, or a folder that `ltsim plan` wrote; raises SetupError, RecordError."""
        named, scenario = load_plan_and_scenario(source)
        file, site = unsearched_plan(named, scenario)
        return cls(file, scenario, site, planned_construction(scenario), PointTolerances.from_plan_file(file))

    def hall(self) -> dict[str, Any]:
        """Fixed parts of the hall for the page: lengths in metres, outlines from above, initial station positions."""
        survey, floor = self.site.survey, self.file.floor
        names = [area.name for area in floor.areas] or [""]
        free = [*(place.name for place in floor.keep_outs), *(door.name for door in floor.doors)]
        groups = {point.name: point.group for point in self.file.listed_points}
        tolerances = self.demands.tolerance_by_point
        stations = zip(survey.station_names, survey.station_positions, survey.station_yaws, strict=True)
        return {
            "title": self.file.title or self.scenario.title,
            "size": [v * MILLIMETRE for v in self.scenario.workshop.size_mm],
            "level": 100 * self.demands.confidence_level,
            "areas": [
                {"name": name, "outlines": [area.outline.tolist(), *(hole.tolist() for hole in area.holes)]}
                for name, area in zip(names, self.site.allowed_areas, strict=True)
            ],
            "free": [
                {"name": name, "outline": place.outline.tolist()}
                for name, place in zip(free, self.site.forbidden_areas, strict=True)
            ],
            "obstacles": _from_above(self.site.obstacles),
            "points": [
                {"name": name, "at": place, "group": groups.get(name, ""),
                 "tolerance_um": tolerance / MICROMETRE if (tolerance := tolerances.get(name)) else None}
                for name, place in zip(survey.target_names, survey.target_points.tolist(), strict=True)
            ],
            "stations": [
                {"name": name, "mm": np.round(place / MILLIMETRE, 1).tolist(),
                 "yaw": round(float(yaw) / DEGREE % 360, 2)}
                for name, place, yaw in stations
            ],
            "places": np.round(self._places / MILLIMETRE, 1).tolist(),
        }  # fmt: skip

    @cached_property
    def _places(self) -> Floats:
        """Places (P, 3) [m] for an additional station with enough visible targets, at most `MAX_PLACES` of them."""
        search = self.file.search
        places = self.site.grid_places(grid_step(self.site.allowed_areas, search.grid_mm), search.heights)
        places = places[:: max(1, -(-len(places) // MAX_PLACES))]
        return places[self.site.is_visible(places).sum(axis=1) >= MIN_VISIBLE_TARGETS] if len(places) else places

    def survey(self, stations: Sequence[Mapping[str, Any]]) -> PlannedSurvey:
        """Survey with the given stations (`name`, `mm` (3) and `yaw` [deg] of each); raises SetupError.

        Additional stations take sights and order of the stations of the plan in turn.
        """
        survey = self.site.survey
        try:
            names = tuple(str(s["name"]) for s in stations)
            place = np.array([s["mm"] for s in stations], dtype=np.float64).reshape(-1, 3)
            yaw = np.array([s["yaw"] for s in stations], dtype=np.float64)
        except (KeyError, TypeError, ValueError):
            raise SetupError("each station needs name, mm (x, y, z) and yaw") from None
        if not np.all(np.abs([*place.ravel(), *yaw]) < MAX_COORDINATE_MM):
            raise SetupError(
                f"coordinates and yaw of a station must be smaller than {MAX_COORDINATE_MM:g} mm and degrees"
            )
        if not MIN_STATIONS <= len(names) <= MAX_STATIONS:
            raise SetupError(f"a layout has {MIN_STATIONS} to {MAX_STATIONS} stations, not {len(names)}")
        if len({*names}) < len(names) or not all(re.fullmatch(NAME, name) for name in names):
            raise SetupError("each station needs a different name of letters, digits, points and hyphens")
        before = survey.station_names
        like = [before.index(name) if name in before else k % len(before) for k, name in enumerate(names)]
        return survey.replace(
            station_names=names,
            station_positions=place * MILLIMETRE,
            station_yaws=yaw * DEGREE,
            is_visible=survey.is_visible[like],
            target_ranks=None if survey.target_ranks is None else survey.target_ranks[like],
        )

    def _site(self, survey: PlannedSurvey) -> SearchSpace:
        """Search space of the plan for a survey with any number of stations."""
        asked = self.file.stations.min_stations_per_target
        return self.site.replace(survey=survey, min_sights=len(survey.station_positions) if asked == "all" else asked)

    def judged(self, stations: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Evaluation of a layout: visible sights, uncertainty of each point, and broken rules."""
        survey = self.survey(stations)
        site, places = self._site(survey), self.site.broken_position_rules(survey)
        if _touches(survey):
            return {"problem": broken_rules_text(places)}
        table = layout_visibility(site, survey)
        survey = survey.replace(is_visible=table.is_visible)
        evaluation = {
            "reasons": table.reasons.tolist(),
            "hidden": int(InvisibilityReason.OBSTACLE),
            "may_stand": self.site.is_allowed(survey.station_positions).tolist(),
            "shadow": shadow_radii(survey.station_positions, 0.0, self.site.sight_limits.cone_opening).tolist(),
            "hours": survey.duration / 3600.0,
            "problem": broken_rules_text((*places, *site.broken_sight_rules(survey))),
        }
        visible = np.asarray(survey.is_visible.any(axis=0))
        try:
            information = LayoutInformation.from_survey(survey.with_targets_only(visible), self.construction)
            covariance = information.target_covariance
        except LtsimError as problem:
            return evaluation | {"problem": f"{problem}"}
        points: list[dict[str, Any] | None] = [None] * len(visible)
        sigma, within = information.target_sigmas, error_radius(covariance, self.demands.confidence_level)
        for k, t in enumerate(np.flatnonzero(visible)):
            accuracy = {"sigma_um": float(sigma[k]) / MICROMETRE, "within_um": float(within[k]) / MICROMETRE}
            tolerance = self.demands.tolerance_by_point.get(survey.target_names[t])
            points[t] = accuracy | (_against(float(within[k]) / tolerance) if tolerance else {})
        return evaluation | {"points": points, "rms_um": information.target_rms / MICROMETRE}

    def verdict(self, stations: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
        """Verdict on rules and tolerances, also after the loss of any single station; None without tolerances."""
        survey = self.survey(stations)
        if not self.demands or _touches(survey):
            return None
        site = self._site(survey)
        survey = survey.replace(is_visible=layout_visibility(site, survey).is_visible)
        losses = checks_after_required_losses(survey, self.demands, self.construction)
        checks = check_tolerances(survey, self.demands, self.construction)
        judgement = plan_verdict(self.demands, checks, losses, site.broken_rules(survey))
        return {"reached": judgement.is_goal_reached, "words": judgement.sentences}

    def moved(self, stations: Sequence[Mapping[str, Any]]) -> Scenario:
        """Scenario with the given stations."""
        return with_layout(self.scenario, self.survey(stations))

    def scene(self, stations: Sequence[Mapping[str, Any]], camera: Camera | None = None) -> str:
        """Page with the hall in 3D, seen from a camera."""
        return scene_page(from_scenario(self.moved(stations)), camera)

    def save(self, stations: Sequence[Mapping[str, Any]], folder: Path) -> list[Path]:
        """Write the layout: scenario.toml for `ltsim simulate`, plan.toml for `ltsim plan`, its stations fixed."""
        scenario = self.moved(stations)
        plan = self.file.model_dump(mode="json", exclude_defaults=True)
        for key in ("workshop", "instrument", "smr", "work"):
            plan.pop(key, None)
        names = list(scenario.stations)
        plan |= {"format": self.file.format, "scenario": SCENARIO_FILE}
        plan["stations"] = plan.get("stations", {}) | {"count": len(names), "fixed": names}
        scenario, cad = copy_cad_files(scenario)
        texts = {SCENARIO_FILE: scenario_to_toml(scenario), PLAN_FILE: to_toml(plan)}
        write_texts(folder, {**cad, **texts})
        return [folder / name for name in texts]


def _against(ratio: float) -> dict[str, Any]:
    """Ratio of an error to its tolerance, its text in percent, and True if the tolerance is met."""
    return {"ratio": ratio, "used": percent_text(ratio), "met": is_met(ratio)}


def _touches(survey: PlannedSurvey) -> bool:
    """True if a station coincides with a target, so that no accuracy can be computed."""
    return bool(
        np.linalg.norm(survey.station_positions[:, None] - survey.target_points, axis=2).min()
        < MAX_COINCIDENCE_DISTANCE
    )


def _from_above(obstacles: Any) -> str:
    """SVG path of the obstacles seen from above, x and y in metres."""
    if not isinstance(obstacles, Obstacles):
        return ""
    flat: Floats = obstacles.triangles[:, :, :2]
    first, second = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    flat = np.where(area[:, None, None] < 0, flat[:, ::-1], flat)  # equal orientation, else overlaps would be holes
    largest = np.argsort(-np.abs(area), kind="stable")[:MAX_TRIANGLES]
    shown = np.round(flat[largest[area[largest] != 0]], 3).tolist()
    return "".join("M" + "L".join(f"{x:g} {y:g}" for x, y in triangle) + "Z" for triangle in shown)
