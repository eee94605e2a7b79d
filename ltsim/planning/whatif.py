"""What if a station is impossible, or stands elsewhere: places for one station while all others stay."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import SetupError, unknown_name
from ltsim.model.construction import Construction
from ltsim.planning.planner import Plan, judge
from ltsim.planning.search import Searcher
from ltsim.planning.site import grid_step
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import Survey
from ltsim.planning.tolerances import Demands, after_losses, judged, verdict
from ltsim.planning.workshop import objective_of, site_of
from ltsim.simulation.physics import planned_construction
from ltsim.simulation.scenario import Scenario
from ltsim.units import DEGREE, MICROMETRE, MILLIMETRE

CLEAR = 2.0
"""[m]: how far from an impossible place, and from each other, places for its station are."""
MOST = 4
"""Places that are proposed."""


@dataclass(frozen=True)
class Alternative:
    """A place for a station, all others as they are; or the layout without it."""

    words: str
    """What it is."""
    survey: Survey
    verdict: str
    """What it is worth."""
    worth: float
    """Largest error over its tolerance, after the losses that matter too; without tolerances the largest sigma [m]."""


def current(file: PlanFile, scenario: Scenario) -> Survey:
    """The layout of a plan, as it stands in its scenario."""
    work = scenario.work
    site = site_of(file, scenario, stations=len(scenario.stations), faces=work.faces, repeats=work.repeats)
    return site.survey.replace(seen=site.seen(site.survey.position))


def moved(file: PlanFile, scenario: Scenario, to: Mapping[str, tuple[float, ...]]) -> Plan:
    """The plan with stations at other places: x, y and, where it changes, z [mm] of each; raises SetupError."""
    survey = current(file, scenario)
    position = survey.position.copy()
    for name, place in to.items():
        position[_index(survey, name), : len(place)] = np.array(place) * MILLIMETRE
    site = site_of(file, scenario, stations=len(position), faces=len(survey.faces), repeats=survey.repeats)
    for name in to:
        x, y, z = position[_index(survey, name)]
        if not site.allowed(np.array([[x, y, z]]))[0]:
            raise SetupError(f"{name} at ({x:.2f}, {y:.2f}, {z:.2f}) m: no tripod may stand there")
    return judge(file, scenario, survey.replace(position=position, seen=site.seen(position)))


def without(file: PlanFile, scenario: Scenario, name: str) -> tuple[Alternative, ...]:
    """The layout without a station, then with it at the best other places, the best first; raises SetupError."""
    built, survey = planned_construction(scenario), current(file, scenario)
    slot = _index(survey, name)
    count, settings = len(survey.position), file.search
    others = tuple(s for s in range(count) if s != slot)
    site = site_of(file, scenario, stations=count, faces=len(survey.faces), repeats=survey.repeats)
    step, objective = grid_step(site.areas, settings.grid_mm), objective_of(file, survey)
    where = site.replace(survey=survey, fixed=others, least=0)
    work = Searcher(where, objective, built, step, settings.yaws, settings.heights)
    table = work.table(slot)
    values = work.replacements(work.layout(survey), slot, table)
    values[_gap(table.position, survey.position[slot]) < CLEAR] = np.inf
    # Sights of points with a tolerance that would be missing decide first.
    demanded = Demands.of(file).tolerance or survey.target_names
    asked = np.array([name in demanded for name in survey.target_names])
    had = survey.seen[list(others)].sum(axis=0)
    lacking = np.maximum(site.least - had - table.seen, 0)[:, asked].sum(axis=1)
    found = [_alternative(file, survey.without(slot), f"without {name}", built)]
    for best in np.lexsort((values, lacking)).tolist():
        if len(found) > MOST:
            break
        if not np.isfinite(values[best]):
            continue
        taken = [one.survey.position[slot] for one in found[1:]]
        if any(_gap(table.position[[best]], place)[0] < CLEAR for place in taken):
            continue
        position, yaw = survey.position.copy(), survey.yaw.copy()
        position[slot], yaw[slot] = table.position[best], table.yaw[best]
        there = survey.replace(position=position, yaw=yaw, seen=site.seen(position))
        x, y, z = position[slot]
        words = f"{name} at ({x:.2f}, {y:.2f}, {z:.2f}) m, turned by {yaw[slot] / DEGREE:.0f} deg"
        found.append(_alternative(file, there, words, built))
    return (found[0], *sorted(found[1:], key=lambda one: one.worth))


def _gap(places: Floats, place: Floats) -> Floats:
    return np.linalg.norm(places[:, :2] - place[:2], axis=1)


def _index(survey: Survey, name: str) -> int:
    if name not in survey.station_names:
        raise SetupError(str(unknown_name("station", name, survey.station_names)))
    return survey.station_names.index(name)


def _alternative(file: PlanFile, survey: Survey, words: str, built: Construction) -> Alternative:
    """What a layout is worth: against its tolerances where it has some, else by its worst point."""
    demands = Demands.of(file)
    if demands:
        kept, losses = judged(survey, demands, built), tuple(after_losses(survey, demands, built, "station"))
        if demands.robust == "sight":
            losses += tuple(after_losses(survey, demands, built, "sight"))
        ratio = max([kept.ratio, *([loss.ratio for loss in losses] if demands.robust != "no" else [])])
        return Alternative(words, survey, verdict(demands, kept, losses), ratio)
    every = Demands(dict.fromkeys(survey.target_names, np.inf))
    kept = judged(survey, every, built)
    if not kept.radius or kept.unseen:
        lost = f"{', '.join(kept.unseen)} seen from nowhere" if kept.unseen else "nothing is determined"
        return Alternative(words, survey, lost, np.inf)
    worst = max(kept.radius, key=lambda name: kept.radius[name])
    size = kept.radius[worst]
    return Alternative(words, survey, f"worst {worst}, within {size / MICROMETRE:.1f} um at 95 %", size)
