"""A plan under the hand: what a layout whose stations somebody moves would tell, and the files that keep it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import LtsimError, SetupError
from ltsim.model.construction import Construction
from ltsim.notation import listing
from ltsim.pages.scene3d import Camera
from ltsim.pages.scene_page import scene_page
from ltsim.pages.workshop import from_scenario
from ltsim.planning.files import PLAN, SCENARIO, opened, with_cad_beside, with_layout
from ltsim.planning.information import LayoutInformation
from ltsim.planning.planner import sight_table
from ltsim.planning.site import Site
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import Survey
from ltsim.planning.tolerances import Demands, judged, losses_of, radius, verdict
from ltsim.planning.workshop import site_of
from ltsim.recording.files import write_texts
from ltsim.recording.settings import to_toml
from ltsim.scene.meshes import Obstacles
from ltsim.scene.visibility import Reason, shadow_radius
from ltsim.simulation.physics import planned_construction
from ltsim.simulation.scenario import Scenario, scenario_to_toml
from ltsim.units import DEGREE, MICROMETRE, MILLIMETRE

MOST_TRIANGLES = 20_000
"""Of obstacles seen from above that are drawn, the largest."""
TOUCH = 1e-3
"""[m] from a point within which no station can look at it."""
FAR = 1e6
"""[mm] beyond which no station is put."""


@dataclass(frozen=True)
class Board:
    """A hall whose stations are moved by hand."""

    file: PlanFile
    scenario: Scenario
    """With the stations to begin from."""
    site: Site
    """Its survey has the scenario's way of working."""
    construction: Construction
    demands: Demands
    """Tolerances of points."""

    @classmethod
    def of(cls, source: str | Path) -> Board:
        """The board of a plan file, a scenario, or a folder that `ltsim plan` wrote; raises SetupError, RecordError."""
        file, scenario = opened(source)
        count, work = len(scenario.stations), scenario.work
        site = site_of(file, scenario, stations=count, faces=work.faces, repeats=work.repeats)
        return cls(file, scenario, site, planned_construction(scenario), Demands.of(file))

    @property
    def least(self) -> int:
        """From how many stations each point must be seen: what the plan asks for, else one."""
        return self.site.least if "seen_from" in self.file.stations.model_fields_set else 1

    def hall(self) -> dict[str, Any]:
        """What does not move, for the page: lengths in metres, outlines seen from above; and where stations begin."""
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
        """The survey with its stations elsewhere: `mm` (3) and `yaw` [deg] of each, in its order; raises SetupError."""
        survey = self.site.survey
        try:
            place = np.array([s["mm"] for s in stations], dtype=np.float64).reshape(-1, 3)
            yaw = np.array([s["yaw"] for s in stations], dtype=np.float64)
        except (KeyError, TypeError, ValueError):
            raise SetupError("expected stations with mm (x, y, z) and yaw") from None
        if len(place) != len(survey.position) or not np.all(np.abs([*place.ravel(), *yaw]) < FAR):
            raise SetupError(f"expected {len(survey.position)} stations at places in millimetres, and turns in degrees")
        return survey.replace(position=place * MILLIMETRE, yaw=yaw * DEGREE)

    def judged(self, stations: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """What the layout would tell: who sees whom, how well each point becomes known, what breaks a rule."""
        survey = self.survey(stations)
        gap = np.linalg.norm(survey.position[:, None] - survey.points, axis=2)
        if gap.min() < TOUCH:
            s, t = np.unravel_index(gap.argmin(), gap.shape)
            return {"problem": f"{survey.station_names[s]} stands in {survey.target_names[t]}"}
        table = sight_table(self.site, survey)
        survey = survey.replace(seen=table.visible)
        found = {
            "reasons": table.reason.tolist(),
            "hidden": int(Reason.OBSTACLE),
            "may_stand": self.site.allowed(survey.position).tolist(),
            "shadow": shadow_radius(survey.position, 0.0, self.site.limits.cone_opening).tolist(),
            "hours": survey.seconds / 3600.0,
            "problem": self._broken_rule(survey),
        }
        seen = np.asarray(survey.seen.any(axis=0))
        try:
            information = LayoutInformation.of(survey.only(seen), self.construction)
            covariance = information.target_covariance
        except LtsimError as problem:
            return found | {"problem": f"{problem}"}
        points: list[dict[str, float] | None] = [None] * len(seen)
        sigma, within = information.target_sigma, radius(covariance, self.demands.level)
        for k, t in enumerate(np.flatnonzero(seen)):
            points[t] = {"sigma_um": float(sigma[k]) / MICROMETRE, "within_um": float(within[k]) / MICROMETRE}
        return found | {"points": points, "rms_um": information.target_rms / MICROMETRE}

    def _broken_rule(self, survey: Survey) -> str:
        """Which rule of the plan a layout breaks; empty for none."""
        count = survey.seen.sum(axis=0)
        few = [name for name, n in zip(survey.target_names, count, strict=True) if n < self.least]
        gap = np.linalg.norm(survey.position[:, None, :2] - survey.position[None, :, :2], axis=2)
        close = np.argwhere(np.triu(gap < self.site.spacing - 1e-9, 1))
        off = np.flatnonzero(~self.site.allowed(survey.position))
        if len(off):
            return f"{survey.station_names[off[0]]} stands where no tripod may stand"
        if len(close):
            first, second = (survey.station_names[i] for i in close[0])
            return f"{first} and {second} stand nearer than {self.site.spacing:g} m"
        if few:
            return f"{listing(few, 1)} seen from fewer than {self.least} station{'s' if self.least > 1 else ''}"
        return ""

    def verdict(self, stations: Sequence[Mapping[str, Any]]) -> str:
        """Whether the tolerances are kept, and still are with any one station or sight lost; empty without any."""
        survey = self.survey(stations)
        if not self.demands or np.linalg.norm(survey.position[:, None] - survey.points, axis=2).min() < TOUCH:
            return ""
        survey = survey.replace(seen=sight_table(self.site, survey).visible)
        losses = losses_of(survey, self.demands, self.construction)
        return verdict(self.demands, judged(survey, self.demands, self.construction), losses)

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
        scenario, cad = with_cad_beside(scenario)
        texts = {SCENARIO: scenario_to_toml(scenario), PLAN: to_toml(plan)}
        write_texts(folder, {**cad, **texts})
        return [folder / name for name in texts]


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
