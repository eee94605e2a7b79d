"""A hall that the plan file itself describes: a scenario of its tables, its points and stations to begin from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import SetupError
from ltsim.planning.floor import grid_step, ground_of, may_stand, over
from ltsim.planning.points import Point
from ltsim.planning.site import FEWEST, Placement
from ltsim.scene.visibility import visibility
from ltsim.simulation.scenario import FORMAT, Scenario, scenario_from
from ltsim.simulation.sections import Station, Target
from ltsim.simulation.workshop import obstacles_of, planned, sight_limits
from ltsim.units import MILLIMETRE

if TYPE_CHECKING:
    from ltsim.planning.spec import PlanFile

TABLES = ("workshop", "instrument", "smr", "work")
"""Tables of a scenario that a plan file may hold itself."""
USUAL_HEIGHT_MM = (1400.0, 1800.0)
"""Centre of the head on a usual stand."""
SAME_MM = 0.1
"""Within which a point of a list is the scenario's target of its name."""
BEGIN = 4
"""Stations to begin from, where the plan does not say how many."""


def hall_scenario(made: PlanFile, data: Mapping[str, Any], points: Sequence[Point], file: Path) -> Scenario:
    """The scenario of the tables of a plan file and its points.

    Parameters
    ----------
    data : mapping
        The tables as the file gives them.

    Raises
    ------
    SetupError
        In one sentence, for a table that no scenario can have, or a floor on which no tripod sees three points.
    """
    table: dict[str, Any] = {"format": FORMAT, "title": made.title}
    table |= {name: data[name] for name in TABLES if name in data}
    table["work"] = {"order": "as-listed", **data.get("work", {})}
    wide, deep, _ = made.workshop.size_mm if made.workshop else (0.0, 0.0, 0.0)
    table["stations"] = {"S1": {"position_mm": [wide / 2, deep / 2, USUAL_HEIGHT_MM[0]], "yaw_deg": 0.0}}
    table["targets"] = {p.name: {"position_mm": [p.x_mm, p.y_mm, p.z_mm]} for p in points}
    scenario = scenario_from(table, file)
    count = made.stations.count or BEGIN
    places = _begin(made, scenario, count)
    stations = {
        f"S{i}": Station(position_mm=tuple(np.round(place / MILLIMETRE, 1).tolist()), yaw_deg=0.0)
        for i, place in enumerate(places, 1)
    }
    return scenario.model_copy(update={"stations": stations})


def with_points(scenario: Scenario, points: Sequence[Point], file: object) -> Scenario:
    """A scenario with further targets; points that are its targets already stay what they are."""
    for point in points:
        there = scenario.targets.get(point.name)
        place = np.array([point.x_mm, point.y_mm, point.z_mm])
        if there is not None and np.abs(np.array(there.position_mm) - place).max() < SAME_MM:
            continue
        if point.name in scenario.target_names:
            raise SetupError(f"{file}: points has the name '{point.name}', which is a target elsewhere in the scenario")
    own = scenario.targets
    added = {p.name: Target(position_mm=(p.x_mm, p.y_mm, p.z_mm)) for p in points if p.name not in own}
    return scenario.model_copy(update={"targets": {**own, **added}})


def _begin(made: PlanFile, scenario: Scenario, count: int) -> Floats:
    """Places (count, 3) [m] one after the other where they see most of what few others see."""
    heights = (USUAL_HEIGHT_MM[0] * MILLIMETRE, USUAL_HEIGHT_MM[1] * MILLIMETRE)
    areas, keep_outs = ground_of(made.floor, scenario.workshop.size_mm, heights)
    obstacles, points = obstacles_of(scenario), planned(scenario).points
    grid = np.concatenate([over(area, grid_step(areas, made.search.grid_mm), 1) for area in areas])
    grid = grid[may_stand(areas, keep_outs, obstacles, grid)]
    if not len(grid):
        raise SetupError(
            "the floor has no place where a tripod may stand; widen it, move obstacles, or give a smaller grid_mm"
        )
    seen = visibility(grid, points, sight_limits(scenario, scenario.instrument), obstacles=obstacles).visible
    useful = seen.sum(axis=1) >= FEWEST
    if not useful.any():
        raise SetupError("no place on the floor sees three points; widen the floor, or move obstacles")
    spacing, none = made.stations.spacing_mm * MILLIMETRE, np.zeros(len(points), dtype=np.int64)
    placement = Placement(grid[useful], seen[useful], spacing, np.zeros((0, 3)), none)
    chosen = placement.stations(count, 1)
    if len(chosen) < count:
        raise SetupError(f"the floor has no room for {count} tripods {spacing:g} m apart; ask for fewer, or widen it")
    return placement.position[chosen]
