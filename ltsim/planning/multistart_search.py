"""Searches for the layout with the smallest objective from many initial layouts (starts), in one or several processes.

Each combination of the number of stations and the number of faces is searched separately.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import monotonic

import numpy as np

from ltsim.adjustment.remedies.next_measurement import no_progress
from ltsim.core.arrays import Floats
from ltsim.core.errors import InputError, NetworkError
from ltsim.core.parallel import run_parallel
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.planning.reflectors import choose_reflectors
from ltsim.planning.search import LayoutSearcher, StationLayout
from ltsim.planning.search_inputs import is_target_fixed_in_search, layout_objective, make_search_space
from ltsim.planning.search_space import SearchSpace
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import PlannedSurvey
from ltsim.scene.floor import tripod_grid_spacing
from ltsim.simulation.physics import planned_construction
from ltsim.simulation.scenario import Scenario

N_STATION_REFLECTOR_ALTERNATIONS = 2
"""Number of times that reflectors and then stations are searched again after the first search for stations, if
reflectors are movable."""
MIN_REPORT_INTERVAL = 5.0
"""Shortest time [s] between two reports of the best layout so far."""
MIN_REPORTED_GAIN = 0.01
"""Smallest relative improvement of the objective since the last report that is reported as a new best layout."""

ObjectiveAndSurvey = tuple[float, PlannedSurvey]
"""Value of the objective function of a layout (smaller is better), and survey with this layout."""
LayoutsByStationsAndFaces = dict[tuple[int, int], list[tuple[float, int, PlannedSurvey]]]
"""Value of the objective function (smaller is better), number of the initial layout from which the search started, and
survey, for each layout that a search found; by number of stations and number of faces."""


@dataclass(frozen=True)
class SearchTask:
    """Task of a worker process: a search from one initial layout, with given numbers of stations and faces."""

    n_stations: int
    """Number of stations of the layout."""
    n_faces: int
    """Number of faces in which each target is measured: 1 or 2."""
    start_number: int
    """Number of the initial layout, from 0: 0 is the layout in the scenario, all others are random."""


@dataclass(frozen=True)
class PlanningProblem:
    """Plan file with its scenario, from which the inputs of a search are derived."""

    plan_file: PlanFile
    """Plan file with goal, rules and settings of the search."""
    scenario: Scenario
    """Scenario with hall, instrument, gauge and targets."""

    @property
    def construction(self) -> GeometricErrorModel:
        """Geometric error model of the instrument, whose parameters are estimated."""
        return planned_construction(self.scenario)

    def search_space(self, task: SearchTask) -> SearchSpace:
        """Search space for the number of stations and the number of faces in `task`."""
        return make_search_space(self.plan_file, self.scenario, n_stations=task.n_stations, n_faces=task.n_faces)

    def make_searcher(
        self,
        search_space: SearchSpace,
        report_progress: Callable[[float], None] = no_progress,
        store_layout: Callable[[StationLayout], None] = no_progress,
    ) -> LayoutSearcher:
        """Searcher for layouts in `search_space` with the objective and the search settings of the plan file.

        `report_progress` is called with the finished fraction of the search from one initial layout, `store_layout`
        with each layout that is better than all before it.
        """
        settings, objective = self.plan_file.search, layout_objective(self.plan_file, search_space.survey)
        step = tripod_grid_spacing(search_space.allowed_areas, settings.grid_step_mm)
        return LayoutSearcher(
            search_space,
            objective,
            self.construction,
            step,
            settings.yaw_count,
            settings.height_count,
            report_progress,
            store_layout,
        )


def run_searches(
    problem: PlanningProblem,
    tasks: Sequence[SearchTask],
    jobs: int,
    report_progress: Callable[[float], None],
    store_survey: Callable[[PlannedSurvey, float], None],
) -> tuple[LayoutsByStationsAndFaces, bool]:
    """Layouts of all searches by numbers of stations and faces, and a flag that is True if Ctrl-C ended the searches.

    `jobs` is the number of processes. `report_progress` is called with the finished fraction of all searches.
    `store_survey` is called with each layout whose objective is better by `MIN_REPORTED_GAIN`, and with this objective.
    With one job the searches run in this process: progress is reported also within a search, and after Ctrl-C its best
    layout is kept.
    """
    best_by_task: dict[int, ObjectiveAndSurvey] = {}
    finished, stopped, reported, last = 0, False, np.inf, -np.inf

    def store_better_layout(task_number: int, value: float, survey: PlannedSurvey) -> None:
        nonlocal reported, last
        best_by_task[task_number] = value, survey
        if value < reported * (1 - MIN_REPORTED_GAIN) and monotonic() - last >= MIN_REPORT_INTERVAL:
            reported, last = value, monotonic()
            store_survey(survey, value)

    def callbacks_of_task(task_number: int) -> tuple[Callable[[float], None], Callable[[StationLayout], None]]:
        """Callbacks of search `task_number` in this process: for its finished fraction, and for each better layout."""
        site = problem.search_space(tasks[task_number])
        return (
            lambda part: report_progress((finished + part) / len(tasks)),
            lambda layout: store_better_layout(
                task_number, layout.objective_value, _with_moved_stations(site, layout.positions, layout.yaws)
            ),
        )

    jobs = min(jobs, len(tasks))
    work = ((problem, task, n, *(callbacks_of_task(n) if jobs == 1 else ())) for n, task in enumerate(tasks))
    try:
        for number, layout in run_parallel(_search_result_of_task, work, jobs, keeps_order=False):
            finished += 1
            report_progress(finished / len(tasks))
            best_by_task.pop(number, None)
            if layout is not None:
                store_better_layout(number, *layout)
    except KeyboardInterrupt:
        stopped = True
    layouts: LayoutsByStationsAndFaces = {}
    for number, (value, survey) in sorted(best_by_task.items()):
        task = tasks[number]
        layouts.setdefault((task.n_stations, task.n_faces), []).append((value, task.start_number, survey))
    return layouts, stopped


def _search_result_of_task(
    problem: PlanningProblem,
    task: SearchTask,
    task_number: int,
    report_progress: Callable[[float], None] = no_progress,
    store_layout: Callable[[StationLayout], None] = no_progress,
) -> tuple[int, ObjectiveAndSurvey | None]:
    """Number of a search task, and the pair of objective and layout at the end of its search.

    The pair is None if the search finds no layout that meets the rules of the plan, or none that determines all
    unknowns. `report_progress` is called with the finished fraction of the search, `store_layout` with each better
    layout.
    """
    try:
        return task_number, search_from_start(problem, task, report_progress, store_layout)
    except (InputError, NetworkError):
        return task_number, None


def search_from_start(
    problem: PlanningProblem,
    task: SearchTask,
    report_progress: Callable[[float], None] = no_progress,
    store_layout: Callable[[StationLayout], None] = no_progress,
) -> ObjectiveAndSurvey:
    """Objective and layout at the end of the search from one initial layout.

    Stations are searched, then, if reflectors are movable, reflectors and stations in turn. `report_progress` is called
    with the finished fraction, `store_layout` with each better layout. Raises InputError or NetworkError if no layout
    is found.
    """
    site, stays, seed = (
        problem.search_space(task),
        is_target_fixed_in_search(problem.plan_file, problem.scenario),
        problem.plan_file.search.seed,
    )
    rounds, done = 1 if stays.all() else 1 + N_STATION_REFLECTOR_ALTERNATIONS, 0
    searcher = problem.make_searcher(site, lambda share: report_progress((done + share) / rounds), store_layout)
    layout = searcher.search_from(seed, task.start_number)
    survey = _with_moved_stations(site, layout.positions, layout.yaws)
    while done < rounds - 1:
        done += 1
        survey = choose_reflectors(site, survey, stays, searcher.objective, problem.construction)
        stays = np.arange(len(survey.target_points)) < stays.sum()
        site = site.replace(
            survey=survey, is_aimed_nest=np.full(len(survey.target_points), bool(site.is_aimed_nest.any()))
        )
        layout = replace(searcher, search_space=site, on_better_layout=no_progress).search_from(seed, 0)
        survey = _with_moved_stations(site, layout.positions, layout.yaws)
    return layout.objective_value, survey


def _with_moved_stations(search_space: SearchSpace, position: Floats, yaw: Floats) -> PlannedSurvey:
    """Survey of a search space with its S stations at `position` (S, 3) [m] with `yaw` (S,) [rad]."""
    return search_space.survey.replace(
        station_positions=position, station_yaws=yaw, is_visible=search_space.is_visible(position)
    )
