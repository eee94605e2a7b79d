"""Searches from many starts, in one or several processes, and their layouts for each procedure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from signal import SIG_IGN, SIGINT, signal
from time import monotonic

import numpy as np

from ltsim.adjustment.remedies.next_measurement import no_progress
from ltsim.core.arrays import Floats
from ltsim.core.errors import NetworkError, SetupError
from ltsim.core.parallel import parallel
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
"""Number of times that stations and reflectors are chosen alternately."""
REPORT_INTERVAL = 5.0
"""Shortest time [s] between two reports of the best layout so far."""
MIN_REPORTED_GAIN = 0.01
"""Smallest relative improvement of the objective at which a layout is reported."""

Layout = tuple[float, Survey]
"""Value and survey of a layout."""
Layouts = dict[tuple[int, int], list[tuple[float, int, Survey]]]
"""Value, start and survey of each layout, by number of stations and of faces."""


@dataclass(frozen=True)
class SearchTask:
    """Search as a task for a worker process."""

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
        """Construction whose parameters are estimated."""
        return planned_construction(self.scenario)

    def site(self, task: SearchTask) -> SearchSpace:
        """Search space of a task."""
        return site_of(self.file, self.scenario, stations=task.stations, faces=task.faces)

    def searcher(
        self,
        site: SearchSpace,
        tell: Callable[[float], None] = no_progress,
        keep: Callable[[PlannedLayout], None] = no_progress,
    ) -> LayoutSearcher:
        """Search in a search space for the file's objective."""
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
    """Layouts of all searches, and True if Ctrl-C ended them; results are collected as searches end.

    `share` is called with the finished fraction, `keep` with each better layout and its objective. With one job the
    search runs in this process, reports its progress, and keeps its best layout after Ctrl-C.
    """
    best: dict[int, Layout] = {}
    finished, stopped, reported, last = 0, False, np.inf, -np.inf

    def better(number: int, value: float, survey: Survey) -> None:
        nonlocal reported, last
        best[number] = value, survey
        if value < reported * (1 - MIN_REPORTED_GAIN) and monotonic() - last >= REPORT_INTERVAL:
            reported, last = value, monotonic()
            keep(survey, value)

    def running(number: int) -> tuple[Callable[[float], None], Callable[[PlannedLayout], None]]:
        """Callbacks of a search in this process: finished fraction, better layout."""
        site = problem.site(tasks[number])
        return (
            lambda part: share((finished + part) / len(tasks)),
            lambda layout: better(number, layout.value, _moved(site, layout.position, layout.yaw)),
        )

    jobs = min(jobs, len(tasks))
    work = ((problem, task, n, *(running(n) if jobs == 1 else ())) for n, task in enumerate(tasks))
    try:
        for number, layout in parallel(_task if jobs == 1 else _task_of_worker, work, jobs, ordered=False):
            finished += 1
            share(finished / len(tasks))
            best.pop(number, None)
            if layout is not None:
                better(number, *layout)
    except KeyboardInterrupt:
        stopped = True
    layouts: Layouts = {}
    for number, (value, survey) in sorted(best.items()):
        task = tasks[number]
        layouts.setdefault((task.stations, task.faces), []).append((value, task.start, survey))
    return layouts, stopped


def _task(
    problem: PlanningProblem,
    task: SearchTask,
    number: int,
    tell: Callable[[float], None] = no_progress,
    keep: Callable[[PlannedLayout], None] = no_progress,
) -> tuple[int, Layout | None]:
    """Layout of one start; None if the rules permit none, or if ranges from too few stations determine none."""
    try:
        return number, search_from_start(problem, task, tell, keep)
    except (SetupError, NetworkError):
        return number, None


def _task_of_worker(problem: PlanningProblem, task: SearchTask, number: int) -> tuple[int, Layout | None]:
    """Layout of one start in a worker process, which ignores Ctrl-C and leaves it to the main process."""
    signal(SIGINT, SIG_IGN)
    return _task(problem, task, number)


def search_from_start(
    problem: PlanningProblem,
    task: SearchTask,
    tell: Callable[[float], None] = no_progress,
    keep: Callable[[PlannedLayout], None] = no_progress,
) -> Layout:
    """Layout of a start: search of stations, of reflectors if these are movable, and of stations again."""
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
        layout = replace(searcher, site=site, keep=no_progress).from_start(seed, 0)
        survey = _moved(site, layout.position, layout.yaw)
    return layout.value, survey


def _moved(site: SearchSpace, position: Floats, yaw: Floats) -> Survey:
    return site.survey.replace(position=position, yaw=yaw, visible=site.visible(position))
