"""From a plan file to a plan: search, curve of cost against quality, information, reasons."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import NetworkError, SetupError
from ltsim.model.construction import Construction
from ltsim.notebook import Columns, Shown, by_row
from ltsim.plan.changes import Changes, reflector_changes
from ltsim.plan.fast import Reducer
from ltsim.plan.improvement import Expected, Predictor
from ltsim.plan.information import LayoutInformation
from ltsim.plan.objective import Objective
from ltsim.plan.reflectors import choose_reflectors
from ltsim.plan.search import Layout, Searcher
from ltsim.plan.sights import with_reachable_sights
from ltsim.plan.site import Site
from ltsim.plan.spec import PlanFile
from ltsim.plan.survey import Survey
from ltsim.plan.workshop import fixed_of, objective_of, site_of, staying, survey_of
from ltsim.remedies.next_measurement import Progress, quiet
from ltsim.scene.visibility import Visibility, aimed_normals, visibility
from ltsim.simulate.physics import planned_construction
from ltsim.simulate.scenario import Scenario
from ltsim.units import MILLIMETRE
from ltsim.workers import parallel

MOST_SETUPS = 200_000
"""Set-ups of a grid that one search holds in memory."""
ROUNDS = 2
"""Times stations and reflectors are chosen in turn."""


@dataclass(frozen=True)
class Option:
    """One point of the curve: a way of working, the best layout found for it, what it costs and what it is worth.

    Attributes
    ----------
    survey : Survey
    value : float
        The objective; smaller is better.
    qualities : dict of str to float
    efficient : bool
        No other option is better and cheaper.
    """

    survey: Survey
    value: float
    qualities: dict[str, float]
    efficient: bool = False

    @property
    def hours(self) -> float:
        """[h] the work takes."""
        return self.survey.seconds / 3600.0


@dataclass(frozen=True)
class Evaluated:
    """A layout with everything that is known of it before measuring.

    Attributes
    ----------
    survey : Survey
    value : float
        Infinite where the plan's rules do not allow it.
    qualities : dict of str to float
    information : LayoutInformation
    table : Visibility
    expected : Expected or None
        The paper's criteria; None where some target is not seen from everywhere.
    """

    survey: Survey
    value: float
    qualities: dict[str, float]
    information: LayoutInformation
    table: Visibility
    expected: Expected | None


@dataclass(frozen=True, repr=False)
class Plan(Shown):
    """The answer.

    Attributes
    ----------
    file : PlanFile
    scenario : Scenario
    site : Site
        Of the chosen way of working.
    objective : Objective
    reference : Evaluated or None
        The scenario's own layout, worked in the chosen way; None where it determines nothing.
    chosen : Evaluated
    options : tuple of Option
        The curve, cheapest first.
    changes : Changes
        Single reflectors of the chosen layout moved, added, left out.
    spread : tuple of float
        Values that the starts of the chosen way ended at, best first.
    """

    file: PlanFile
    scenario: Scenario
    site: Site
    objective: Objective
    reference: Evaluated | None
    chosen: Evaluated
    options: tuple[Option, ...]
    spread: tuple[float, ...]
    changes: Changes

    def _lines(self) -> list[str]:
        qualities = ", ".join(f"{name} {value:.4g}" for name, value in self.chosen.qualities.items())
        return [f"Plan: {self.chosen.survey.words}", f"{qualities}; {len(self.options)} ways of working compared"]

    def _tables(self) -> Mapping[str, Callable[[], Columns]]:
        return {"stations": self._stations, "options": self._options}

    def _stations(self) -> Columns:
        survey = self.chosen.survey
        x, y, z = (survey.position / MILLIMETRE).T.tolist()
        return {
            "station": list(survey.station_names),
            "x_mm": x,
            "y_mm": y,
            "z_mm": z,
            "yaw_deg": np.degrees(survey.yaw).tolist(),
            "reflectors_seen": survey.seen.sum(axis=1).tolist(),
        }

    def _options(self) -> Columns:
        return by_row(
            [
                {
                    "stations": len(option.survey.position),
                    "faces": len(option.survey.faces),
                    "repeats": option.survey.repeats,
                    "hours": option.hours,
                    "value": option.value,
                    "efficient": option.efficient,
                }
                for option in self.options
            ]
        )


def make_plan(
    file: PlanFile,
    scenario: Scenario,
    *,
    jobs: int = 1,
    progress: Progress = quiet,
    construction: Construction | None = None,
) -> Plan:
    """Search and explain; the same file gives the same plan whatever the number of jobs.

    Raises
    ------
    SetupError
        When no layout keeps the plan's rules.
    """
    _check_size(file, scenario)
    built = construction or planned_construction(scenario)
    count = file.stations.count or len(scenario.stations)
    faces = scenario.work.faces
    file = with_reachable_sights(file, site_of(file, scenario, stations=count, faces=faces))
    ways = [(n, f) for f in sorted({*file.budget.faces, faces}) for n in sorted({*file.stations.tries, count})]
    tasks = [(n, f, start) for n, f in ways for start in range(_starts(file, n, f, count, faces))]
    found: dict[tuple[int, int], list[tuple[float, int, Survey]]] = {}
    for done, (n, f, start, layout) in enumerate(_searched(file, scenario, tasks, built, jobs), 1):
        progress("searching layouts", done / len(tasks))
        if layout is not None:
            found.setdefault((n, f), []).append((layout[0], start, layout[1]))
    if (count, faces) not in found:
        # The same search again, for its sentence.
        _search_one(file, scenario, count, faces, 0, built)
    options = _options(file, scenario, found, built)
    best = _chosen(file, options, count, faces, scenario.work.repeats)
    site = site_of(
        file, scenario, stations=len(best.survey.position), faces=len(best.survey.faces), repeats=best.survey.repeats
    )
    objective = objective_of(file, best.survey)
    own = found[len(best.survey.position), len(best.survey.faces)]
    return Plan(
        file=file,
        scenario=scenario,
        site=site,
        objective=objective,
        reference=_reference(file, scenario, site, built, best.survey),
        chosen=evaluated(site, best.survey, objective, built),
        options=options,
        spread=tuple(sorted(value for value, _, _ in own)),
        changes=reflector_changes(site, best.survey, fixed_of(file, scenario, best.survey), objective, built),
    )


def _check_size(file: PlanFile, scenario: Scenario) -> None:
    """Refuse a grid of set-ups that no memory holds."""
    outlines = [area.corners_mm for area in file.floor.areas] or [file.floor.corners_mm or _corners(scenario)]
    sizes = np.array([np.ptp(np.array(outline), axis=0) for outline in outlines])
    rows = 1.0 + sizes / file.search.grid_mm
    count = float(np.prod(rows, axis=1).sum()) * file.search.yaws * file.search.heights
    if count > MOST_SETUPS:
        raise SetupError(
            f"search: a grid of {file.search.grid_mm:g} mm over {sizes[:, 0].max():g} x {sizes[:, 1].max():g} mm has "
            f"{count:.2g} set-ups, the most is {MOST_SETUPS}; "
            "give a larger grid_mm or a smaller floor"
        )


def _corners(scenario: Scenario) -> tuple[tuple[float, float], ...]:
    wide, deep, _ = scenario.workshop.size_mm
    return (0.0, 0.0), (wide, deep)


def _starts(file: PlanFile, n: int, f: int, count: int, faces: int) -> int:
    return file.search.starts if (n, f) == (count, faces) else file.search.starts_of_the_curve


Found = tuple[int, int, int, tuple[float, Survey] | None]


def _searched(
    file: PlanFile, scenario: Scenario, tasks: Sequence[tuple[int, int, int]], built: Construction, jobs: int
) -> Iterator[Found]:
    """Each task's layout as it comes; None where the rules allow none."""
    if jobs == 1:
        yield from (_task(file, scenario, task, built) for task in tasks)
        return
    # A construction holds functions that cannot travel; workers build the scenario's own.
    work = ((file, scenario, task, None) for task in tasks)
    yield from parallel(_task, work, min(jobs, len(tasks)), ordered=False)


def _task(file: PlanFile, scenario: Scenario, task: tuple[int, int, int], built: Construction | None) -> Found:
    n, f, start = task
    try:
        return n, f, start, _search_one(file, scenario, n, f, start, built or planned_construction(scenario))
    except SetupError:
        return n, f, start, None


def _search_one(
    file: PlanFile, scenario: Scenario, stations: int, faces: int, start: int, built: Construction
) -> tuple[float, Survey]:
    """One start: stations, then reflectors where they are free, and stations again."""
    site = site_of(file, scenario, stations=stations, faces=faces)
    objective = objective_of(file, site.survey)
    settings = file.search
    stays = staying(file, scenario)

    def searcher(where: Site) -> Searcher:
        return Searcher(where, objective, built, settings.grid_mm * 1e-3, settings.yaws, settings.heights)

    found = searcher(site).from_start(settings.seed, start)
    survey = _moved(site, found)
    for _ in range(0 if stays.all() else ROUNDS):
        survey = choose_reflectors(site, survey, stays, objective, built)
        count = int(stays.sum())
        stays = np.arange(len(survey.points)) < count
        site = site.replace(survey=survey, aimed=np.full(len(survey.points), bool(site.aimed.any())))
        again = searcher(site).from_start(settings.seed, 0)
        survey, found = _moved(site, again), again
    return found.value, survey


def _moved(site: Site, layout: Layout) -> Survey:
    return site.survey.replace(position=layout.position, yaw=layout.yaw, seen=site.seen(layout.position))


def measure(survey: Survey, objective: Objective, built: Construction) -> tuple[float, dict[str, float]]:
    """Objective and qualities of a survey as it is."""
    reducer = Reducer(survey, built, objective.effects)
    slots = np.arange(len(survey.position))
    reduced = reducer.reduce(
        reducer.blocks(survey.position, survey.yaw, slots, survey.seen), slots[None], targets=objective.wants_targets
    )
    qualities = objective.qualities(reduced, built.size)
    value = float(objective.values(reduced, built.size)[0])
    return value, {name: float(quality[0]) for name, quality in qualities.items()}


def _options(
    file: PlanFile,
    scenario: Scenario,
    found: dict[tuple[int, int], list[tuple[float, int, Survey]]],
    built: Construction,
) -> tuple[Option, ...]:
    """The best layout of every way of working, with each number of repeats; cheapest first."""
    made = []
    for layouts in found.values():
        survey = min(layouts, key=lambda one: (one[0], one[1]))[2]
        for repeats in sorted({*file.budget.repeats, scenario.work.repeats}):
            repeated = survey.replace(repeats=repeats)
            value, qualities = measure(repeated, objective_of(file, repeated), built)
            made.append(Option(repeated, value, qualities))
    made.sort(key=lambda option: (option.hours, option.value))
    best = np.minimum.accumulate([option.value for option in made])
    earlier = np.r_[np.inf, best[:-1]]
    return tuple(replace(o, efficient=bool(o.value < before)) for o, before in zip(made, earlier, strict=True))


def _chosen(file: PlanFile, options: tuple[Option, ...], count: int, faces: int, repeats: int) -> Option:
    """The way of working asked for; with a budget in hours the best that it pays for."""
    hours = file.budget.hours
    if hours is None:
        wanted = [
            o
            for o in options
            if len(o.survey.position) == count and len(o.survey.faces) == faces and o.survey.repeats == repeats
        ]
        return wanted[0]
    paid = [o for o in options if o.hours <= hours]
    if not paid:
        cheapest = min(options, key=lambda o: o.hours)
        raise SetupError(f"budget.hours is {hours:g}, but the cheapest way of working takes {cheapest.hours:.1f} hours")
    return min(paid, key=lambda o: o.value)


def evaluated(site: Site, survey: Survey, objective: Objective, built: Construction) -> Evaluated:
    """Everything that is known of a layout before measuring.

    Raises
    ------
    NetworkError
        When it does not determine its poses and targets.
    """
    table = sight_table(site, survey)
    survey = survey.replace(seen=table.visible)
    information = LayoutInformation.of(survey, built)
    allowed = bool(site.allowed(survey.position).all())
    allowed &= bool(site.joined(survey.position[None], survey.seen[None])[0])
    value, qualities = measure(survey, objective, built)
    expected = Predictor.of(information).expected() if survey.seen.all() and len(survey.position) > 1 else None
    return Evaluated(survey, value if allowed else np.inf, qualities, information, table, expected)


def sight_table(site: Site, survey: Survey) -> Visibility:
    """Who sees whom, with fixed nests aimed at the layout's stations."""
    aimed = np.full(len(survey.points), bool(site.aimed.any()))
    aimed[: len(site.aimed)] = site.aimed[: len(survey.points)]
    normal: Floats = aimed_normals(survey.position, survey.points)[0]
    return visibility(
        survey.position,
        survey.points,
        site.limits,
        nest_normal=normal,
        reaimed=~aimed,
        obstacles=site.obstacles,
    )


def _reference(file: PlanFile, scenario: Scenario, site: Site, built: Construction, way: Survey) -> Evaluated | None:
    """The scenario's own layout, worked in the same way; none in a hall that the plan itself describes."""
    if file.workshop is not None:
        return None
    own = survey_of(scenario).replace(
        faces=way.faces,
        repeats=way.repeats,
        seconds_per_pointing=way.seconds_per_pointing,
        seconds_per_move=way.seconds_per_move,
    )
    count = len(own.position)
    least = count if file.stations.seen_from == "all" else min(file.stations.seen_from, count)
    try:
        where = site.replace(survey=own, least=least, play=0.0)
        return evaluated(where, own, objective_of(file, own), built)
    except NetworkError:
        return None
