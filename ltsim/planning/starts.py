"""Searches from many starts, in one process or in several: the layouts that they find for each way of working."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from signal import SIG_IGN, SIGINT, signal
from time import monotonic

import numpy as np

from ltsim.adjustment.remedies.next_measurement import quiet
from ltsim.core.arrays import Floats
from ltsim.core.errors import NetworkError, SetupError
from ltsim.core.parallel import ProgressWriter, parallel, track_progress
from ltsim.physics.model.construction import Construction
from ltsim.planning.reflectors import choose_reflectors
from ltsim.planning.search import LayoutSearcher, PlannedLayout
from ltsim.planning.site import SearchSpace
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import Survey
from ltsim.planning.workshop import objective_of, site_of, staying
from ltsim.scene.floor import grid_step
from ltsim.simulation.physics import planned_construction
from ltsim.simulation.scenario import Scenario

ROUNDS = 2
"""Times stations and reflectors are chosen in turn."""
SAYS = 5.0
"""[s] between two words on the best layout so far."""
WORTH = 0.01
"""By how much, relative, a layout must be better to be worth a word."""
SAMPLE, AROUND = 480, 24
"""Set-ups that are tried at once for an estimate: of a grid, and around a station."""
SWEEPS, MOVES = 3.0, 14.0
"""Rounds of exchanges, and of moves off the grid, that a search usually takes."""

Layout = tuple[float, Survey]
"""Value and survey of a layout."""
Layouts = dict[tuple[int, int], list[tuple[float, int, Survey]]]
"""Value, start and survey of each layout, by number of stations and of faces."""


@dataclass(frozen=True)
class SearchTask:
    """One search."""

    stations: int
    faces: int
    start: int


@dataclass(frozen=True)
class PlanningProblem:
    """Search problem: a plan file with its scenario."""

    file: PlanFile
    scenario: Scenario

    @property
    def built(self) -> Construction:
        """The construction whose parameters are meant."""
        return planned_construction(self.scenario)

    def site(self, task: SearchTask) -> SearchSpace:
        """Search space of a task."""
        return site_of(self.file, self.scenario, stations=task.stations, faces=task.faces)

    def searcher(
        self, site: SearchSpace, tell: Callable[[float], None] = quiet, keep: Callable[[PlannedLayout], None] = quiet
    ) -> LayoutSearcher:
        """The search on a site for the file's objective."""
        settings, objective = self.file.search, objective_of(self.file, site.survey)
        step = grid_step(site.areas, settings.grid_mm)
        return LayoutSearcher(site, objective, self.built, step, settings.yaws, settings.heights, tell, keep)


def gathered(
    problem: PlanningProblem,
    tasks: Sequence[SearchTask],
    jobs: int,
    share: Callable[[float], None],
    keep: Callable[[Survey, float], None],
) -> tuple[Layouts, bool]:
    """The layouts that searches found, and whether Ctrl-C ended them: these are then the best so far.

    `share` hears the share of the whole that is done; `keep` is given the best layout so far and its value, from a
    thread of its own.
    """
    done: dict[int, Layout] = {}
    stopped, reported, last = False, np.inf, -np.inf

    def best_so_far(notes: ProgressWriter) -> dict[int, Layout]:
        """Best layout of each running search, from the notes of its process."""
        rows = {number: np.load(path) for number in range(len(tasks)) if (path := _note(notes, number)).is_file()}
        return {
            k: (float(row[0, 0]), _moved(problem.site(tasks[k]), row[1:, :3], row[1:, 3])) for k, row in rows.items()
        }

    def look(done_share: float) -> None:
        nonlocal reported, last
        share(done_share)
        if monotonic() - last < SAYS:
            return
        last = monotonic()
        value, survey = min((best_so_far(notes) | done).values(), key=lambda layout: layout[0], default=(np.inf, None))
        if survey is not None and value < reported * (1 - WORTH):
            reported = value
            keep(survey, value)

    with track_progress(len(tasks), lambda done_share: look(done_share)) as notes:
        jobs = min(jobs, len(tasks))
        work = ((problem, task, notes, number, jobs == 1) for number, task in enumerate(tasks))
        try:
            for number, layout in parallel(_task, work, jobs, ordered=False):
                done |= {number: layout} if layout is not None else {}
        except KeyboardInterrupt:
            stopped, done = True, best_so_far(notes) | done
    layouts: Layouts = {}
    for number, (value, survey) in sorted(done.items()):
        task = tasks[number]
        layouts.setdefault((task.stations, task.faces), []).append((value, task.start, survey))
    return layouts, stopped


def _note(notes: ProgressWriter, number: int) -> Path:
    return notes.path.with_name(f"{number}.npy")


def _task(
    problem: PlanningProblem, task: SearchTask, notes: ProgressWriter, number: int, here: bool
) -> tuple[int, Layout | None]:
    """One start's layout; None where the rules allow none, or ranges from so few stations determine none."""
    if not here:  # in a process of its own: Ctrl-C is for the one that gathers
        signal(SIGINT, SIG_IGN)

    def keep(layout: PlannedLayout) -> None:
        rows = np.column_stack([layout.position, layout.yaw])
        half = notes.path.with_name(f"{number}.half.npy")
        np.save(half, np.concatenate([np.full((1, 4), layout.value), rows]))
        half.replace(_note(notes, number))

    try:
        return number, search_from_start(problem, task, partial(notes.write, number), keep)
    except (SetupError, NetworkError):
        return number, None
    finally:
        notes.write(number, 1.0)


def search_from_start(
    problem: PlanningProblem,
    task: SearchTask,
    tell: Callable[[float], None] = quiet,
    keep: Callable[[PlannedLayout], None] = quiet,
) -> Layout:
    """One start: stations, then reflectors where they are free, and stations again."""
    site, stays, seed = problem.site(task), staying(problem.file, problem.scenario), problem.file.search.seed
    rounds, done = 1 if stays.all() else 1 + ROUNDS, 0
    searcher = problem.searcher(site, lambda share: tell((done + share) / rounds), keep)
    layout = searcher.from_start(seed, task.start)
    survey = _moved(site, layout.position, layout.yaw)
    while done < rounds - 1:
        done += 1
        survey = choose_reflectors(site, survey, stays, searcher.objective, problem.built)
        stays = np.arange(len(survey.points)) < stays.sum()
        site = site.replace(survey=survey, aimed=np.full(len(survey.points), bool(site.aimed.any())))
        layout = replace(searcher, site=site, keep=quiet).from_start(seed, 0)
        survey = _moved(site, layout.position, layout.yaw)
    return layout.value, survey


def _moved(site: SearchSpace, position: Floats, yaw: Floats) -> Survey:
    return site.survey.replace(position=position, yaw=yaw, visible=site.visible(position))


def expected_seconds(problem: PlanningProblem, tasks: Sequence[SearchTask]) -> float:
    """Expected duration [s] of searches, one after the other, from timing a sample of their steps."""
    ways = Counter((task.stations, task.faces) for task in tasks)
    return sum(count * _seconds_of_search(problem, SearchTask(*way, 0)) for way, count in ways.items())


def _seconds_of_search(problem: PlanningProblem, task: SearchTask) -> float:
    site = problem.site(task)
    work = problem.searcher(site)
    places = site.places(work.step, work.heights)
    if not len(places):
        return 0.0
    looked, built, valued = _seconds_of_setups(work, places, task.stations, SAMPLE)
    setups, free = len(places) * work.yaws, task.stations - len(site.fixed)
    exchanges = len(places) * looked + setups * (built + SWEEPS * free * valued)
    few = _seconds_of_setups(work, places, task.stations, AROUND)
    return float(exchanges + MOVES * free * AROUND * few.sum())


def _seconds_of_setups(work: LayoutSearcher, places: Floats, stations: int, count: int) -> Floats:
    """Seconds (3,) a set-up takes among so many at once: to see what it sees, to be made, to be valued in a layout."""
    sample = places[np.linspace(0, len(places) - 1, count).astype(int)]
    for _ in range(2):  # what the first calls load is no part of the work
        times = [monotonic()]
        visible = work.site.visible(sample)
        times.append(monotonic())
        pool = work.pool(sample, np.zeros(count), 0, visible)
        times.append(monotonic())
        work.replacements(pool.take(np.arange(stations)), 0, pool, anywhere=True)
        times.append(monotonic())
    return np.diff(times) / count
