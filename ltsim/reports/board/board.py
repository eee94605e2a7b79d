"""A plan under the hand: what a layout whose stations somebody moves would tell, and the files that keep it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.errors import LtsimError, SetupError
from ltsim.core.units import DEGREE, MICROMETRE, MILLIMETRE
from ltsim.physics.model.construction import Construction
from ltsim.planning.files import PLAN, SCENARIO, opened, with_cad_copied, with_layout
from ltsim.planning.information import LayoutInformation
from ltsim.planning.planner import sight_table
from ltsim.planning.rules import TOUCH, words_of
from ltsim.planning.site import SearchSpace
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import Survey
from ltsim.planning.tolerances import Tolerances, judged, keeps, losses_of, percent, radius, verdict
from ltsim.planning.workshop import as_it_stands
from ltsim.recordings.files import write_texts
from ltsim.recordings.settings import to_toml
from ltsim.reports.scene3d import Camera
from ltsim.reports.scene_page import scene_page
from ltsim.reports.workshop import from_scenario
from ltsim.scene.meshes import Obstacles
from ltsim.scene.visibility import Reason, shadow_radius
from ltsim.simulation.physics import planned_construction
from ltsim.simulation.scenario import Scenario, scenario_to_toml

MOST_TRIANGLES = 20_000
"""Largest number of triangles of obstacles drawn from above; the largest triangles are retained."""
FEWEST_STATIONS, MOST_STATIONS = 2, 40
"""Smallest and largest number of stations of a layout, as of a plan file."""
NAME = r"\w[\w.\-]{0,39}"
"""Pattern of the name of a station."""
FAR = 1e6
"""[mm] beyond which no station is put."""


@dataclass(frozen=True)
class Board:
    """A hall whose stations are moved by hand."""

    file: PlanFile
    scenario: Scenario
    """With the stations to begin from."""
    site: SearchSpace
    """Its survey has the scenario's way of working."""
    construction: Construction
    demands: Tolerances
    """Tolerances of points."""

    @classmethod
    def of(cls, source: str | Path) -> Board:
        """The board of a plan file, a scenario, or a folder that `ltsim plan` wrote; raises SetupError, RecordError."""
        named, scenario = opened(source)
        file, site = as_it_stands(named, scenario)
        return cls(file, scenario, site, planned_construction(scenario), Tolerances.of(file))

    def hall(self) -> dict[str, Any]:
        """Fixed parts of the hall for the page: lengths in metres, outlines from above, initial places of stations."""
        survey, floor = self.site.survey, self.file.floor
        names = [area.name for area in floor.areas] or [""]
        free = [*(place.name for place in floor.keep_outs), *(door.name for door in floor.doors)]
        groups = {point.name: point.group for point in self.file.listed}
        return {
            "title": self.file.title or self.scenario.title,
            "size": [v * MILLIMETRE for v in self.scenario.workshop.size_mm],
            "level": 100 * self.demands.level,
            "areas": [
                {"name": name, "outlines": [area.outline.tolist(), *(hole.tolist() for hole in area.holes)]}
                for name, area in zip(names, self.site.areas, strict=True)
            ],
            "free": [
                {"name": name, "outline": place.outline.tolist()}
                for name, place in zip(free, self.site.keep_outs, strict=True)
            ],
            "obstacles": _from_above(self.site.obstacles),
            "points": [
                {"name": name, "at": place, "group": groups.get(name, ""),
                 "tolerance_um": tolerance / MICROMETRE if (tolerance := self.demands.tolerance.get(name)) else None}
                for name, place in zip(survey.target_names, survey.points.tolist(), strict=True)
            ],
            "stations": [
                {"name": name, "mm": np.round(place / MILLIMETRE, 1).tolist(),
                 "yaw": round(float(yaw) / DEGREE % 360, 2)}
                for name, place, yaw in zip(survey.station_names, survey.position, survey.yaw, strict=True)
            ],
        }  # fmt: skip

    def survey(self, stations: Sequence[Mapping[str, Any]]) -> Survey:
        """The survey with these stations: `name`, `mm` (3) and `yaw` [deg] of each; raises SetupError.

        Stations that the plan does not have are further ones, which work in the order of those before them.
        """
        survey = self.site.survey
        try:
            names = tuple(str(s["name"]) for s in stations)
            place = np.array([s["mm"] for s in stations], dtype=np.float64).reshape(-1, 3)
            yaw = np.array([s["yaw"] for s in stations], dtype=np.float64)
        except (KeyError, TypeError, ValueError):
            raise SetupError("expected stations with name, mm (x, y, z) and yaw") from None
        if not np.all(np.abs([*place.ravel(), *yaw]) < FAR):
            raise SetupError("expected stations at places in millimetres, and turns in degrees")
        if not FEWEST_STATIONS <= len(names) <= MOST_STATIONS:
            raise SetupError(f"expected {FEWEST_STATIONS} to {MOST_STATIONS} stations, found {len(names)}")
        if len({*names}) < len(names) or not all(re.fullmatch(NAME, name) for name in names):
            raise SetupError("expected a different name for each station")
        before = survey.station_names
        like = [before.index(name) if name in before else k % len(before) for k, name in enumerate(names)]
        return survey.replace(
            station_names=names,
            position=place * MILLIMETRE,
            yaw=yaw * DEGREE,
            visible=survey.visible[like],
            rank=None if survey.rank is None else survey.rank[like],
        )

    def _site(self, survey: Survey) -> SearchSpace:
        """Search space of the plan for a survey, whose stations may be more or fewer than those of the plan."""
        asked = self.file.stations.min_stations_per_target
        return self.site.replace(survey=survey, min_sights=len(survey.position) if asked == "all" else asked)

    def judged(self, stations: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Evaluation of a layout: visible sights, uncertainty of each point, and broken rules."""
        survey = self.survey(stations)
        site, places = self._site(survey), self.site.broken_places(survey)
        if _touches(survey):
            return {"problem": words_of(places)}
        table = sight_table(site, survey)
        survey = survey.replace(visible=table.visible)
        found = {
            "reasons": table.reason.tolist(),
            "hidden": int(Reason.OBSTACLE),
            "may_stand": self.site.allowed(survey.position).tolist(),
            "shadow": shadow_radius(survey.position, 0.0, self.site.limits.cone_opening).tolist(),
            "hours": survey.seconds / 3600.0,
            "problem": words_of((*places, *site.broken_sights(survey))),
        }
        seen = np.asarray(survey.visible.any(axis=0))
        try:
            information = LayoutInformation.of(survey.only(seen), self.construction)
            covariance = information.target_covariance
        except LtsimError as problem:
            return found | {"problem": f"{problem}"}
        points: list[dict[str, Any] | None] = [None] * len(seen)
        sigma, within = information.target_sigma, radius(covariance, self.demands.level)
        for k, t in enumerate(np.flatnonzero(seen)):
            known = {"sigma_um": float(sigma[k]) / MICROMETRE, "within_um": float(within[k]) / MICROMETRE}
            tolerance = self.demands.tolerance.get(survey.target_names[t])
            points[t] = known | (_against(float(within[k]) / tolerance) if tolerance else {})
        return found | {"points": points, "rms_um": information.target_rms / MICROMETRE}

    def verdict(self, stations: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
        """Whether rules and tolerances are kept, and still are with any one station lost; None without tolerances."""
        survey = self.survey(stations)
        if not self.demands or _touches(survey):
            return None
        site = self._site(survey)
        survey = survey.replace(visible=sight_table(site, survey).visible)
        losses = losses_of(survey, self.demands, self.construction)
        kept = judged(survey, self.demands, self.construction)
        judgement = verdict(self.demands, kept, losses, site.broken_rules(survey))
        return {"reached": judgement.reached, "words": judgement.words}

    def moved(self, stations: Sequence[Mapping[str, Any]]) -> Scenario:
        """The scenario with its stations there."""
        return with_layout(self.scenario, self.survey(stations))

    def scene(self, stations: Sequence[Mapping[str, Any]], camera: Camera | None = None) -> str:
        """The hall in 3D as a page, seen from a camera."""
        return scene_page(from_scenario(self.moved(stations)), camera)

    def save(self, stations: Sequence[Mapping[str, Any]], folder: Path) -> list[Path]:
        """Write the layout: scenario.toml for `ltsim simulate`, plan.toml for `ltsim plan`, its stations fixed."""
        scenario = self.moved(stations)
        plan = self.file.model_dump(mode="json", exclude_defaults=True)
        for own in ("workshop", "instrument", "smr", "work"):
            plan.pop(own, None)
        names = list(scenario.stations)
        plan |= {"format": self.file.format, "scenario": SCENARIO}
        plan["stations"] = plan.get("stations", {}) | {"count": len(names), "fixed": names}
        scenario, cad = with_cad_copied(scenario)
        texts = {SCENARIO: scenario_to_toml(scenario), PLAN: to_toml(plan)}
        write_texts(folder, {**cad, **texts})
        return [folder / name for name in texts]


def _against(ratio: float) -> dict[str, Any]:
    """An error over its tolerance, in per cent, and whether it keeps it."""
    return {"ratio": ratio, "used": percent(ratio), "kept": keeps(ratio)}


def _touches(survey: Survey) -> bool:
    """True where a station stands in a target: nothing can be judged there."""
    return bool(np.linalg.norm(survey.position[:, None] - survey.points, axis=2).min() < TOUCH)


def _from_above(obstacles: Any) -> str:
    """Obstacles as the path of an SVG, x and y in metres."""
    if not isinstance(obstacles, Obstacles):
        return ""
    flat: Floats = obstacles.triangles[:, :, :2]
    one, other = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    area = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
    flat = np.where(
        area[:, None, None] < 0, flat[:, ::-1], flat
    )  # all one way round: else they would cut each other out
    kept = np.argsort(-np.abs(area), kind="stable")[:MOST_TRIANGLES]
    shown = np.round(flat[kept[area[kept] != 0]], 3).tolist()
    return "".join("M" + "L".join(f"{x:g} {y:g}" for x, y in triangle) + "Z" for triangle in shown)
