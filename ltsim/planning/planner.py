"""From a plan file to a plan: search, curve of cost against quality, information, reasons."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import NetworkError, SetupError
from ltsim.model.construction import Construction
from ltsim.planning.changes import Changes, reflector_changes
from ltsim.planning.fast import Reducer
from ltsim.planning.improvement import Expected, Predictor
from ltsim.planning.information import LayoutInformation
from ltsim.planning.objective import Objective
from ltsim.planning.sights import with_reachable_sights
from ltsim.planning.site import Site
from ltsim.planning.spec import PlanFile
from ltsim.planning.starts import Layouts, gathered, search_one
from ltsim.planning.survey import Survey
from ltsim.planning.tolerances import Demands, Kept, every_loss, holds, judged
from ltsim.planning.workshop import SIGHTS, fixed_of, objective_of, site_of, survey_of
from ltsim.recording.recording import OBSERVABLES
from ltsim.remedies.next_measurement import Progress, quiet
from ltsim.results import Columns, Result, by_row
from ltsim.scene.visibility import Visibility, aimed_normals, visibility
from ltsim.simulation.physics import planned_construction
from ltsim.simulation.scenario import Scenario
from ltsim.units import MILLIMETRE

MOST_SETUPS = 200_000
"""Set-ups of a grid that one search holds in memory."""
SEARCHING = 0.8
"""Share of the work that is the search."""
FEWEST = 2
"""Stations of a network."""


@dataclass(frozen=True)
class Option:
    """One point of the curve: a way of working, the best layout found for it, what it costs and what it is worth."""

    survey: Survey
    value: float
    """The objective; smaller is better."""
    qualities: dict[str, float]
    efficient: bool = False
    """No other option is better and cheaper."""

    @property
    def hours(self) -> float:
        """[h] the work takes."""
        return self.survey.seconds / 3600.0


@dataclass(frozen=True)
class Evaluated:
    """A layout with everything that is known of it before measuring."""

    survey: Survey
    value: float
    """Infinite where the plan's rules do not allow it."""
    qualities: dict[str, float]
    information: LayoutInformation
    table: Visibility
    expected: Expected | None
    """The paper's criteria; None where some target is not seen whole from everywhere."""


@dataclass(frozen=True, repr=False)
class Plan(Result):
    """The answer."""

    file: PlanFile
    scenario: Scenario
    site: Site
    """Of the chosen way of working."""
    objective: Objective
    reference: Evaluated | None
    """The scenario's own layout, worked in the chosen way; None where it determines nothing."""
    chosen: Evaluated
    options: tuple[Option, ...]
    """The curve, cheapest first."""
    spread: tuple[float, ...]
    """Values that the starts of the chosen way ended at, best first."""
    changes: Changes
    """Single reflectors of the chosen layout moved, added, left out."""
    demands: Demands
    """Tolerances of points."""
    kept: Kept | None = None
    """How the chosen layout stands to them; None without any."""
    losses: tuple[Kept, ...] = ()
    """How it stands to them without each station, then without each sight of such a point."""

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
    progress("searching layouts", 0.0)

    def searching(what: str, share: float) -> None:
        progress(what, SEARCHING * share)

    demands = Demands.of(file)
    if demands and file.stations.count is None:
        file, found, options, best = _fewest(file, scenario, demands, built, jobs, searching)
    else:
        found, options, best = _at_count(file := _reachable(file, scenario), scenario, built, jobs, searching)
    site = site_of(
        file, scenario, stations=len(best.survey.position), faces=len(best.survey.faces), repeats=best.survey.repeats
    )
    objective = objective_of(file, best.survey)
    own = found[len(best.survey.position), len(best.survey.faces)]
    progress("judging tolerances and changes", SEARCHING)
    made = Plan(
        file=file,
        scenario=scenario,
        site=site,
        objective=objective,
        reference=_reference(file, scenario, site, built, best.survey),
        chosen=evaluated(site, best.survey, objective, built),
        options=options,
        spread=tuple(sorted(value for value, _, _ in own)),
        demands=demands,
        kept=judged(best.survey, demands, built) if demands else None,
        losses=every_loss(best.survey, demands, built),
        changes=reflector_changes(site, best.survey, fixed_of(file, scenario, best.survey), objective, built),
    )
    progress("judging tolerances and changes", 1.0)
    return made


def _reachable(file: PlanFile, scenario: Scenario) -> PlanFile:
    count = file.stations.count or len(scenario.stations)
    return with_reachable_sights(file, site_of(file, scenario, stations=count, faces=scenario.work.faces))


def _at_count(
    file: PlanFile, scenario: Scenario, built: Construction, jobs: int, progress: Progress
) -> tuple[Layouts, tuple[Option, ...], Option]:
    """Layouts, curve and choice for a stated number of stations and those of the curve."""
    count, faces = file.stations.count or len(scenario.stations), scenario.work.faces
    ways = [(n, f) for f in sorted({*file.budget.faces, faces}) for n in sorted({*file.stations.tries, count})]
    tasks = [(n, f, start) for n, f in ways for start in range(_starts(file, n, f, count, faces))]
    found = gathered(file, scenario, tasks, built, jobs, lambda share: progress("searching layouts", share))
    if (count, faces) not in found:
        # The same search again, for its sentence.
        search_one(file, scenario, count, faces, 0, built)
    options = _options(file, scenario, found, built)
    return found, options, _chosen(file, options, count, faces, scenario.work.repeats)


def _fewest(
    file: PlanFile, scenario: Scenario, demands: Demands, built: Construction, jobs: int, progress: Progress
) -> tuple[PlanFile, Layouts, tuple[Option, ...], Option]:
    """One station more at a time until the tolerances are kept; of the ways that keep them the quickest.

    Where none keeps them, the one that comes nearest.
    """
    if "seen_from" not in file.stations.model_fields_set:
        alone = 1 if scenario.instrument.observables == OBSERVABLES else SIGHTS
        least = alone if demands.robust == "no" else alone + 1
        file = file.model_copy(update={"stations": file.stations.model_copy(update={"seen_from": least})})
    faces = sorted({*file.budget.faces, scenario.work.faces})
    first = max(FEWEST, len(file.stations.fixed), 2 if demands.robust == "no" else 3)
    counts = range(first, max(first, file.stations.most) + 1)
    found: Layouts = {}
    judgements: list[tuple[float, Option]] = []
    for k, n in enumerate(counts):

        def tell(share: float, done: int = k) -> None:
            # Few stations are likely enough: each further number counts half of what is left.
            progress("searching layouts", 1.0 - 0.5 ** (done + share))

        tasks = [(n, f, start) for f in faces for start in range(file.search.starts)]
        made = gathered(file, scenario, tasks, built, jobs, tell)
        found |= made
        paid = [o for o in _options(file, scenario, made, built) if o.hours <= (file.budget.hours or np.inf)]
        results = [(holds(option.survey, demands, built), option) for option in paid]
        judgements += [(ratio, option) for (_, ratio), option in results]
        good = [option for (kept, _), option in results if kept]
        if good:
            return file, found, _options(file, scenario, found, built), min(good, key=lambda o: o.hours)
    if not judgements:
        raise SetupError(
            f"no layout of {counts[0]} to {counts[-1]} stations has every point in sight of {file.stations.seen_from}"
            f"{' within budget.hours' if file.budget.hours else ''}; widen the floor or give more stations.most"
        )
    nearest = min(judgements, key=lambda one: (one[0], one[1].hours))[1]
    return file, found, _options(file, scenario, found, built), nearest


def _check_size(file: PlanFile, scenario: Scenario) -> None:
    """Refuse a grid of set-ups that no memory holds."""
    if file.search.grid_mm is None:
        return
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


def measure(survey: Survey, objective: Objective, built: Construction) -> tuple[float, dict[str, float]]:
    """Objective and qualities of a survey as it is."""
    reducer = Reducer(survey, built, objective.effects)
    slots = np.arange(len(survey.position))
    reduced = reducer.reduce(
        reducer.blocks(survey.position, survey.yaw, slots, survey.seen), slots[None], targets=objective.wants_targets
    )
    if survey.air is not None and objective.wants_targets:  # the search knows no more of the air than its scatter
        rms = LayoutInformation.of(survey, built).target_rms if np.isfinite(reduced.target_rms[0]) else np.nan
        reduced = replace(reduced, target_rms=np.array([rms]))
    qualities = objective.qualities(reduced, built.size)
    value = float(objective.values(reduced, built.size)[0])
    return value, {name: float(quality[0]) for name, quality in qualities.items()}


def _options(
    file: PlanFile,
    scenario: Scenario,
    found: Layouts,
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
    if not made:
        return ()
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
    compared = survey.is_whole and survey.seen.all() and len(survey.position) > 1
    expected = Predictor.of(information).expected() if compared else None
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
        air=way.air,
    )
    count = len(own.position)
    least = count if file.stations.seen_from == "all" else min(file.stations.seen_from, count)
    try:
        where = site.replace(survey=own, least=least, play=0.0)
        return evaluated(where, own, objective_of(file, own), built)
    except NetworkError:
        return None
