"""Where to put the tripod, what if it cannot stand there, and what to measure next."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import SetupError, unknown_name
from ltsim.planning.files import opened
from ltsim.planning.making import Follower, make_plan
from ltsim.planning.planner import Plan, judge
from ltsim.planning.site import Site
from ltsim.planning.spec import PlanFile
from ltsim.planning.starts import PlanningProblem
from ltsim.planning.survey import Survey
from ltsim.planning.tolerances import Demands, judged, losses_of, verdict
from ltsim.planning.workshop import site_of
from ltsim.remedies.next_measurement import Progress, next_measurement as next_measurement, quiet
from ltsim.simulation.scenario import Scenario
from ltsim.units import DEGREE, MICROMETRE, MILLIMETRE

CLEAR = 2.0
"""[m]: how far from an impossible place, and from each other, places for its station are."""
MOST = 4
"""Places that are proposed."""


def plan(
    source: str | Path = "paper-workshop",
    *,
    starts: int | None = None,
    seed: int | None = None,
    jobs: int = 1,
    progress: Progress = quiet,
    follower: Follower | None = None,
    move: Mapping[str, tuple[float, ...]] | None = None,
) -> Plan:
    """Find a layout of stations and reflectors, with its reasons and its curve of cost against quality.

    Parameters
    ----------
    source : str or Path
        A plan file, a scenario file, the name of a built-in one, or the folder of a plan.
    starts : int, optional
        Independent searches; default as the file says.
    seed : int, optional
        Root of the search; default as the file says.
    jobs : int
        Processes; the plan does not depend on it.
    progress : callable
        Told what is done and the share of it.
    follower : Follower, optional
        In place of `progress`: also hears how long it may take, and is given the best layout so far.
    move : mapping, optional
        Nothing is searched: the layout as it stands, with these stations at other places (x, y and z in mm; z may be
        left out).

    Raises
    ------
    SetupError
        In one sentence, for a plan that cannot be made.

    Examples
    --------
    >>> import ltsim as lt
    >>> made = lt.plan("small-plan.toml")
    >>> made.to_dataframe("stations").shape
    (3, 6)
    """
    file, scenario = opened(source)
    if move is not None:
        return _moved(file, scenario, move)
    changes = {key: value for key, value in (("seed", seed), ("starts", starts)) if value is not None}
    file = file.model_copy(update={"search": file.search.model_copy(update=changes)})
    return make_plan(file, scenario, jobs=jobs, follower=follower or Follower(progress))


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


def without_station(source: str | Path, station: str) -> tuple[Alternative, ...]:
    """What a layout is worth without a station, then with it at the best other places, all others as they are.

    Parameters
    ----------
    source : str or Path
        The folder of a plan, a plan file or a scenario; its stations are the layout.
    station : str
        The one that cannot stand where it is.

    Raises
    ------
    SetupError
        When there is no such station, or no place for it.
    """
    file, scenario = opened(source)
    problem = PlanningProblem(file, scenario)
    site, survey = _as_it_stands(file, scenario)
    slot = _index(survey, station)
    others = [s for s in range(len(survey.position)) if s != slot]
    work = problem.searcher(site.replace(survey=survey, fixed=tuple(others), least=0))
    table = work.table(slot)
    values = work.replacements(work.layout(survey.position, survey.yaw), slot, table)
    values[_gap(table.position, survey.position[slot]) < CLEAR] = np.inf
    # Sights of points with a tolerance that would be missing decide first.
    demanded = Demands.of(file).tolerance or survey.target_names
    asked = np.array([name in demanded for name in survey.target_names])
    lacking = np.maximum(site.least - survey.seen[others].sum(axis=0) - table.seen, 0)[:, asked].sum(axis=1)
    found: list[Alternative] = []
    for best in np.lexsort((values, lacking)).tolist():
        near = [_gap(table.position[[best]], one.survey.position[slot])[0] < CLEAR for one in found]
        if len(found) == MOST or not np.isfinite(values[best]) or any(near):
            continue
        position, yaw = survey.position.copy(), survey.yaw.copy()
        position[slot], yaw[slot] = table.position[best], table.yaw[best]
        there = survey.replace(position=position, yaw=yaw, seen=site.seen(position))
        words = f"{_at(station, position[slot])}, turned by {yaw[slot] / DEGREE:.0f} deg"
        found.append(_alternative(problem, there, words))
    alone = _alternative(problem, survey.without(slot), f"without {station}")
    return (alone, *sorted(found, key=lambda one: one.worth))


def _as_it_stands(file: PlanFile, scenario: Scenario) -> tuple[Site, Survey]:
    """The freedom of a plan, and its layout as it stands in its scenario."""
    work = scenario.work
    site = site_of(file, scenario, stations=len(scenario.stations), faces=work.faces, repeats=work.repeats)
    return site, site.survey.replace(seen=site.seen(site.survey.position))


def _moved(file: PlanFile, scenario: Scenario, to: Mapping[str, tuple[float, ...]]) -> Plan:
    """The plan with stations at other places: x, y and, where it changes, z [mm] of each; raises SetupError."""
    site, survey = _as_it_stands(file, scenario)
    position = survey.position.copy()
    for name, place in to.items():
        there = position[_index(survey, name)]
        there[: len(place)] = np.array(place) * MILLIMETRE
        if not site.allowed(there[None])[0]:
            raise SetupError(f"{_at(name, there)}: no tripod may stand there")
    return judge(file, scenario, survey.replace(position=position, seen=site.seen(position)))


def _at(station: str, place: Floats) -> str:
    x, y, z = place
    return f"{station} at ({x:.2f}, {y:.2f}, {z:.2f}) m"


def _gap(places: Floats, place: Floats) -> Floats:
    return np.linalg.norm(places[:, :2] - place[:2], axis=1)


def _index(survey: Survey, name: str) -> int:
    if name not in survey.station_names:
        raise SetupError(str(unknown_name("station", name, survey.station_names)))
    return survey.station_names.index(name)


def _alternative(problem: PlanningProblem, survey: Survey, words: str) -> Alternative:
    """What a layout is worth: against its tolerances where it has some, else by its worst point."""
    demands, built = Demands.of(problem.file), problem.built
    if demands:
        kept = judged(survey, demands, built)
        losses = losses_of(survey, demands, built)
        ratio = max([kept.ratio, *([loss.ratio for loss in losses] if demands.robust != "no" else [])])
        return Alternative(words, survey, verdict(demands, kept, losses), ratio)
    kept = judged(survey, Demands(dict.fromkeys(survey.target_names, np.inf)), built)
    if not kept.radius or kept.unseen:
        return Alternative(words, survey, kept.remains, np.inf)
    worst = max(kept.radius, key=lambda name: kept.radius[name])
    size = kept.radius[worst]
    return Alternative(words, survey, f"worst {worst}, within {size / MICROMETRE:.1f} um at 95 %", size)
