"""Searches from many starts, in one process or in several: the layouts that they find for each way of working."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from ltsim.errors import NetworkError, SetupError
from ltsim.model.construction import Construction
from ltsim.planning.reflectors import choose_reflectors
from ltsim.planning.search import Layout, Searcher, unheard
from ltsim.planning.site import Site, grid_step
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import Survey
from ltsim.planning.workshop import objective_of, site_of, staying
from ltsim.simulation.physics import planned_construction
from ltsim.simulation.scenario import Scenario
from ltsim.workers import Notes, followed, parallel

ROUNDS = 2
"""Times stations and reflectors are chosen in turn."""

Layouts = dict[tuple[int, int], list[tuple[float, int, Survey]]]
"""Value, start and survey of each layout, by number of stations and of faces."""
Found = tuple[int, int, int, tuple[float, Survey] | None]


def gathered(
    file: PlanFile,
    scenario: Scenario,
    tasks: Sequence[tuple[int, int, int]],
    built: Construction,
    jobs: int,
    tell: Callable[[float], None],
) -> Layouts:
    """The layouts that searches found, by number of stations and of faces."""
    found: Layouts = {}
    # A construction holds functions that cannot travel; workers build the scenario's own.
    own = built if jobs == 1 else None
    with followed(len(tasks), tell) as notes:
        work = ((file, scenario, task, own, notes, number) for number, task in enumerate(tasks))
        for n, f, start, layout in parallel(_task, work, min(jobs, len(tasks)), ordered=False):
            if layout is not None:
                found.setdefault((n, f), []).append((layout[0], start, layout[1]))
    return found


def _task(
    file: PlanFile,
    scenario: Scenario,
    task: tuple[int, int, int],
    built: Construction | None,
    notes: Notes,
    number: int,
) -> Found:
    """One start's layout; None where the rules allow none, or ranges from so few stations determine none."""
    n, f, start = task
    made = built or planned_construction(scenario)
    try:
        return n, f, start, search_one(file, scenario, n, f, start, made, partial(notes.write, number))
    except (SetupError, NetworkError):
        return n, f, start, None
    finally:
        notes.write(number, 1.0)


def search_one(
    file: PlanFile,
    scenario: Scenario,
    stations: int,
    faces: int,
    start: int,
    built: Construction,
    tell: Callable[[float], None] = unheard,
) -> tuple[float, Survey]:
    """One start: stations, then reflectors where they are free, and stations again."""
    site = site_of(file, scenario, stations=stations, faces=faces)
    objective = objective_of(file, site.survey)
    settings = file.search
    stays = staying(file, scenario)

    rounds = 1 if stays.all() else 1 + ROUNDS

    def searcher(where: Site, number: int = 0) -> Searcher:
        return Searcher(
            where, objective, built, grid_step(where.areas, settings.grid_mm), settings.yaws, settings.heights,
            lambda share: tell((number + share) / rounds),
        )  # fmt: skip

    found = searcher(site).from_start(settings.seed, start)
    survey = _moved(site, found)
    for number in range(1, rounds):
        survey = choose_reflectors(site, survey, stays, objective, built)
        count = int(stays.sum())
        stays = np.arange(len(survey.points)) < count
        site = site.replace(survey=survey, aimed=np.full(len(survey.points), bool(site.aimed.any())))
        again = searcher(site, number).from_start(settings.seed, 0)
        survey, found = _moved(site, again), again
    return found.value, survey


def _moved(site: Site, layout: Layout) -> Survey:
    return site.survey.replace(position=layout.position, yaw=layout.yaw, seen=site.seen(layout.position))
