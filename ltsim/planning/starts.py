"""Searches from many starts, in one process or in several: the layouts that they find for each way of working."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from signal import SIG_IGN, SIGINT, signal
from time import monotonic

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import NetworkError, SetupError
from ltsim.model.construction import Construction
from ltsim.planning.reflectors import choose_reflectors
from ltsim.planning.search import Layout, Searcher, unheard, unkept
from ltsim.planning.site import Site, grid_step
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import Survey
from ltsim.planning.workshop import objective_of, site_of, staying
from ltsim.simulation.physics import planned_construction
from ltsim.simulation.scenario import Scenario
from ltsim.workers import Notes, followed, parallel

ROUNDS = 2
"""Times stations and reflectors are chosen in turn."""
SAYS = 5.0
"""[s] between two words on the best layout so far."""
WORTH = 0.01
"""By how much, relative, a layout must be better to be worth a word."""

Layouts = dict[tuple[int, int], list[tuple[float, int, Survey]]]
"""Value, start and survey of each layout, by number of stations and of faces."""
Found = tuple[int, tuple[float, Survey] | None]


@dataclass(frozen=True)
class Task:
    """One search."""

    stations: int
    faces: int
    start: int


def unseen(_survey: Survey, _value: float) -> None:
    """Keep nothing."""


@dataclass(frozen=True)
class Watch:
    """Whoever follows a search."""

    share: Callable[[float], None] = unheard
    """Hears the share of the whole that is done."""
    keep: Callable[[Survey, float], None] = unseen
    """Is given the best layout so far and its value, from a thread of its own."""


@dataclass(frozen=True)
class Gathered:
    """What searches found."""

    layouts: Layouts
    stopped: bool = False
    """Somebody pressed Ctrl-C: what was found by then is here."""


def gathered(
    file: PlanFile, scenario: Scenario, tasks: Sequence[Task], built: Construction, jobs: int, watch: Watch
) -> Gathered:
    """The layouts that searches found; Ctrl-C ends them with the best so far."""
    done: dict[int, tuple[float, Survey]] = {}
    # A construction holds functions that cannot travel; workers build the scenario's own.
    own = built if jobs == 1 else None
    stopped, told, last = False, np.inf, -np.inf

    def best_so_far(notes: Notes) -> dict[int, tuple[float, Survey]]:
        """Of each search that goes on, as its process noted it."""
        rows = {number: np.load(path) for number in range(len(tasks)) if (path := _note(notes, number)).is_file()}
        return {k: (float(row[0, 0]), _placed(file, scenario, tasks[k], row[1:])) for k, row in rows.items()}

    def look(share: float) -> None:
        nonlocal told, last
        watch.share(share)
        if watch.keep is unseen or monotonic() - last < SAYS:
            return
        last = monotonic()
        value, survey = min((best_so_far(notes) | done).values(), key=lambda one: one[0], default=(np.inf, None))
        if survey is not None and value < told * (1 - WORTH):
            told = value
            watch.keep(survey, value)

    with followed(len(tasks), lambda share: look(share)) as notes:
        work = ((file, scenario, task, own, notes, number) for number, task in enumerate(tasks))
        try:
            for number, layout in parallel(_task, work, min(jobs, len(tasks)), ordered=False):
                done |= {number: layout} if layout is not None else {}
        except KeyboardInterrupt:
            stopped, done = True, best_so_far(notes) | done
    found: Layouts = {}
    for number, (value, survey) in sorted(done.items()):
        task = tasks[number]
        found.setdefault((task.stations, task.faces), []).append((value, task.start, survey))
    return Gathered(found, stopped)


def _note(notes: Notes, number: int) -> Path:
    return notes.path.with_name(f"{number}.npy")


def _placed(file: PlanFile, scenario: Scenario, task: Task, rows: Floats) -> Survey:
    """The survey of noted stations (S, 4): places and turns."""
    site = site_of(file, scenario, stations=task.stations, faces=task.faces)
    return _moved(site, Layout(rows[:, :3], rows[:, 3], np.nan))


def _task(
    file: PlanFile, scenario: Scenario, task: Task, built: Construction | None, notes: Notes, number: int
) -> Found:
    """One start's layout; None where the rules allow none, or ranges from so few stations determine none."""
    if built is None:  # in a process of its own: Ctrl-C is for the one that gathers
        signal(SIGINT, SIG_IGN)

    def keep(layout: Layout) -> None:
        rows = np.column_stack([layout.position, layout.yaw])
        half = notes.path.with_name(f"{number}.half.npy")
        np.save(half, np.concatenate([np.full((1, 4), layout.value), rows]))
        half.replace(_note(notes, number))

    made = built or planned_construction(scenario)
    try:
        return number, search_one(file, scenario, task, made, partial(notes.write, number), keep)
    except (SetupError, NetworkError):
        return number, None
    finally:
        notes.write(number, 1.0)


def search_one(
    file: PlanFile,
    scenario: Scenario,
    task: Task,
    built: Construction,
    tell: Callable[[float], None] = unheard,
    keep: Callable[[Layout], None] = unkept,
) -> tuple[float, Survey]:
    """One start: stations, then reflectors where they are free, and stations again."""
    site = site_of(file, scenario, stations=task.stations, faces=task.faces)
    objective = objective_of(file, site.survey)
    settings = file.search
    stays = staying(file, scenario)

    rounds = 1 if stays.all() else 1 + ROUNDS

    def searcher(where: Site, number: int = 0) -> Searcher:
        return Searcher(
            where, objective, built, grid_step(where.areas, settings.grid_mm), settings.yaws, settings.heights,
            lambda share: tell((number + share) / rounds), unkept if number else keep,
        )  # fmt: skip

    found = searcher(site).from_start(settings.seed, task.start)
    survey = _moved(site, found)
    for number in range(1, rounds):
        survey = choose_reflectors(site, survey, stays, objective, built)
        count = int(stays.sum())
        stays = np.arange(len(survey.points)) < count
        site = site.replace(survey=survey, aimed=np.full(len(survey.points), bool(site.aimed.any())))
        again = searcher(site, number).from_start(settings.seed, 0)
        survey, found = _moved(site, again), again
    return found.value, survey


SAMPLE = 48
"""Set-ups that are tried for an estimate."""
SWEEPS, MOVES = 3.0, 14.0
"""Rounds of exchanges, and of moves off the grid, that a search usually takes."""


def expected_seconds(file: PlanFile, scenario: Scenario, tasks: Sequence[Task], built: Construction) -> float:
    """How long searches will take, one after the other, from a sample of what they do."""
    total, each = 0.0, {}
    for task in tasks:
        key = task.stations, task.faces
        if key not in each:
            each[key] = _seconds_of_one(file, scenario, task, built)
        total += each[key]
    return total


def _seconds_of_one(file: PlanFile, scenario: Scenario, task: Task, built: Construction) -> float:
    site, settings = site_of(file, scenario, stations=task.stations, faces=task.faces), file.search
    step = grid_step(site.areas, settings.grid_mm)
    work = Searcher(site, objective_of(file, site.survey), built, step, settings.yaws, settings.heights)
    places = site.places(step, settings.heights)
    if not len(places):
        return 0.0
    some = places[np.linspace(0, len(places) - 1, SAMPLE).astype(int)]
    began = monotonic()
    seen = site.seen(some)
    looked = (monotonic() - began) / SAMPLE
    began = monotonic()
    pool = work.pool(some, np.zeros(SAMPLE), 0, seen)
    built_one = (monotonic() - began) / SAMPLE
    began = monotonic()
    work.replacements(pool.take(np.arange(task.stations)), 0, pool, anywhere=True)
    valued = (monotonic() - began) / SAMPLE
    setups, free = len(places) * settings.yaws, task.stations - len(site.fixed)
    exchanges = len(places) * looked + setups * (built_one + SWEEPS * free * valued)
    return exchanges + MOVES * free * 24 * (looked + built_one + valued)


def _moved(site: Site, layout: Layout) -> Survey:
    return site.survey.replace(position=layout.position, yaw=layout.yaw, seen=site.seen(layout.position))
