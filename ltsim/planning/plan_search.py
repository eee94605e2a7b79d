"""Searches for the layouts that a plan file requires, and choice of the planned layout among the layouts found."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ltsim.adjustment.remedies.next_measurement import ProgressCallback, no_progress
from ltsim.core.errors import InputError, NetworkError
from ltsim.core.units import MICROMETRE
from ltsim.planning.loading import require_small_grid
from ltsim.planning.multistart_search import (
    LayoutsByStationsAndFaces,
    PlanningProblem,
    SearchTask,
    run_searches,
    search_from_start,
)
from ltsim.planning.planner import (
    PlannedNetwork,
    StationCountResult,
    TradeoffPoint,
    evaluate_plan,
    objective_and_qualities,
)
from ltsim.planning.required_sights import (
    candidate_placement_seeing_all_points,
    points_lacking_sights_text,
    with_feasible_min_sights,
)
from ltsim.planning.search_inputs import (
    candidate_procedures,
    layout_objective,
    make_search_space,
    min_sights_of_reflector,
)
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import PlannedSurvey
from ltsim.planning.tolerances import PointTolerances, feasibility_and_tolerance_ratio
from ltsim.simulation.scenario import Scenario

SEARCH_PROGRESS_FRACTION = 0.8
"""Fraction of the progress bar for the search; the other part is for checks of tolerances and changes of reflectors."""
MIN_NETWORK_STATIONS = 2
"""Smallest number of stations of a network."""
MAX_ERROR_RATIO_OF_USEFUL_STATION = 0.95
"""Limit of the largest error with an additional station, divided by that without it (point errors divided by
tolerances). A station with a smaller ratio counts as useful. The search ends if the last two stations together have a
ratio above the square of the limit."""
UNDETERMINED_LAYOUT_MESSAGE = (
    "no layout of the search determines all poses and points; let stations share more points "
    "(stations.min_stations_per_target = 2), or increase the number of stations or search.starts"
)
"""Error message for a search without a layout that determines all poses and points."""
STOPPED_SEARCH_MESSAGE = "the search was stopped before it found a layout; let it run longer"
"""Error message for a search that the user stopped before it had a layout."""


@dataclass(frozen=True)
class SearchCallbacks:
    """Callbacks that report the progress of a search to the user."""

    on_progress: ProgressCallback = no_progress
    """Callback with the name of the present step ("searching layouts") and its finished fraction."""
    on_progress_sentence: Callable[[str], None] = no_progress
    """Callback with a sentence on the best layout so far, called for each better layout."""
    on_scenario: Callable[[Scenario], None] = no_progress
    """Callback with the scenario of the plan, called once before the search."""
    on_better_layout: Callable[[PlannedSurvey], None] = no_progress
    """Callback with the survey of the best layout so far, called for each better layout."""


def make_plan(
    file: PlanFile, scenario: Scenario, *, jobs: int = 1, callbacks: SearchCallbacks | None = None
) -> PlannedNetwork:
    """Planned network with the best layout of all searches that `file` requires.

    The result does not depend on the number of processes `jobs`. Ctrl-C ends the search with the best layout so far
    (`PlannedNetwork.is_stopped`). Raises InputError if no layout meets the rules of the plan.
    """
    require_small_grid(file, scenario)
    progress_callbacks = callbacks or SearchCallbacks()
    progress_callbacks.on_scenario(scenario)
    progress_callbacks.on_progress("searching layouts", 0.0)
    search = _PlanSearch(PlanningProblem(file, scenario), jobs, progress_callbacks)
    best_layout = search.best_with_fewest_stations() if file.searches_station_count else search.best_for_station_count()
    if not np.isfinite(best_layout.objective_value):
        raise InputError(UNDETERMINED_LAYOUT_MESSAGE)
    progress_callbacks.on_progress("check of tolerances and changes", SEARCH_PROGRESS_FRACTION)
    made = evaluate_plan(search.plan_file, scenario, best_layout.survey)
    progress_callbacks.on_progress("check of tolerances and changes", 1.0)
    values = search.layouts.get((len(best_layout.survey.station_positions), len(best_layout.survey.faces)), [])
    plan_file = made.plan_file
    if not file.gives_min_stations_per_target:
        plan_file = plan_file.without_min_stations_per_target()
    return replace(
        made,
        plan_file=plan_file,  # the search may have set the number of stations per target, which is no rule of the user
        tradeoff_points=search.tradeoff_points(search.layouts),
        start_objectives=tuple(sorted(value for value, _, _ in values)),
        station_count_results=tuple(search.station_count_results),
        is_stopped=search.is_stopped,
    )


@dataclass
class _PlanSearch:
    """State of the searches for a plan: layouts for each number of stations and faces, choice of the best layout."""

    problem: PlanningProblem
    """Plan file and scenario."""
    jobs: int
    """Number of processes."""
    callbacks: SearchCallbacks
    """Callbacks that report the progress."""
    layouts: LayoutsByStationsAndFaces = field(default_factory=dict)
    """Layouts found so far, by number of stations and number of faces."""
    station_count_results: list[StationCountResult] = field(default_factory=list)
    """Result for each number of stations that was searched."""
    is_stopped: bool = False
    """True if the user stopped the search."""

    @property
    def plan_file(self) -> PlanFile:
        """Plan file of the planning problem."""
        return self.problem.plan_file

    @property
    def face_and_round_choices(self) -> tuple[list[int], list[int]]:
        """Candidate numbers of faces, and candidate numbers of rounds, of the measuring procedure."""
        return candidate_procedures(self.plan_file, self.problem.scenario)

    def _run_searches(
        self, tasks: Sequence[SearchTask], report_progress: Callable[[float], float]
    ) -> LayoutsByStationsAndFaces:
        """Layouts found by the searches `tasks`, by numbers of stations and faces; they are also stored in `layouts`.

        `report_progress` converts the finished fraction of these tasks to that of all searches of the plan. The
        callbacks receive each better layout.
        """
        goal = self.plan_file.goal

        def report_layout(survey: PlannedSurvey, objective_value: float) -> None:
            is_point_error = goal.targets_weight > 0 and goal.instrument_weight == goal.diagnosis_weight == 0
            quality_text = (
                f"weighted point error {objective_value / MICROMETRE:.1f} um"
                if is_point_error
                else f"quality {objective_value:.4g}"
            )
            quality_text += (
                " without the common errors of the air" if survey.air is not None and goal.targets_weight > 0 else ""
            )
            self.callbacks.on_progress_sentence(
                f"best layout so far: {len(survey.station_positions)} stations, {quality_text}"
            )
            self.callbacks.on_better_layout(survey)

        def report_search_progress(finished_fraction: float) -> None:
            self.callbacks.on_progress(
                "searching layouts", SEARCH_PROGRESS_FRACTION * report_progress(finished_fraction)
            )

        made, stopped = run_searches(self.problem, tasks, self.jobs, report_search_progress, report_layout)
        self.layouts |= made
        self.is_stopped |= stopped
        return made

    def best_for_station_count(self) -> TradeoffPoint:
        """Layout with the smallest objective for the given number of stations, or within the hours of the budget.

        With tolerances the result is the layout that meets them in the shortest time; if no layout meets them, the
        layout with the smallest ratio of point error to tolerance.
        """
        scenario = self.problem.scenario
        count, work = self.plan_file.stations.count or len(scenario.stations), scenario.work
        site = make_search_space(self.plan_file, scenario, n_stations=count, n_faces=work.faces)
        file = with_feasible_min_sights(self.plan_file, site)
        self.problem = replace(self.problem, plan_file=file)
        faces, settings = self.face_and_round_choices[0], file.search
        usual_faces = work.faces if work.faces in faces else faces[-1]
        searched_faces = faces if file.has_tolerances else [usual_faces]
        tasks = [
            SearchTask(n, f, start)
            for f in faces
            for n in sorted({*file.stations.tradeoff_counts, count})
            for start in range(settings.starts if n == count and f in searched_faces else settings.tradeoff_starts)
        ]
        self._run_searches(tasks, lambda share: share)
        if (count, usual_faces) not in self.layouts and not self.is_stopped:
            search_from_start(
                self.problem, SearchTask(count, usual_faces, 0)
            )  # the same search again, for its sentence
        options = self.tradeoff_points(self.layouts)
        if not options:
            raise InputError(STOPPED_SEARCH_MESSAGE)
        hours = np.inf if file.budget.max_hours is None else file.budget.max_hours
        demands = PointTolerances.from_plan_file(file)
        if demands:
            of_count = {key: layouts for key, layouts in self.layouts.items() if key[0] == count} or self.layouts
            options = self.tradeoff_points(
                {key: self._layout_with_smallest_tolerance_ratio(layouts, demands) for key, layouts in of_count.items()}
            )
        elif np.isinf(hours):
            return min(options, key=lambda o: (len(o.survey.station_positions) != count, o.objective_value))
        paid = [o for o in options if o.hours <= hours]
        if not paid:
            cheapest = min(o.hours for o in options)
            raise InputError(
                f"budget.max_hours is {hours:g} h, but the fastest procedure takes {cheapest:.1f} h: increase it"
            )
        if demands:
            judged = [(*feasibility_and_tolerance_ratio(o.survey, demands, self.problem.construction), o) for o in paid]
            good = [option for feasible, _, option in judged if feasible]
            if good:
                return min(good, key=lambda o: o.hours)
            return min(judged, key=lambda judgement: (judgement[1], judgement[2].hours))[2]
        return min(paid, key=lambda o: o.objective_value)

    def best_with_fewest_stations(self) -> TradeoffPoint:
        """Layout with the fewest stations that meets the tolerances; of several such layouts, the fastest to measure.

        If no layout meets the tolerances, the result is the layout with the smallest ratio of point error to tolerance.
        """
        demands, scenario = PointTolerances.from_plan_file(self.plan_file), self.problem.scenario
        alone = demands.loss_to_withstand == "no"
        if not self.plan_file.gives_min_stations_per_target:
            least = min_sights_of_reflector(scenario) + (not alone)
            self.problem = replace(self.problem, plan_file=self.plan_file.with_min_stations_per_target(least))
        file, faces = self.plan_file, self.face_and_round_choices[0]
        min_stations = file.stations.min_stations_per_target
        min_count = max(
            MIN_NETWORK_STATIONS if alone else 3,
            len(file.stations.fixed_stations),
            1 if min_stations == "all" else min_stations,
        )
        station_counts = range(min_count, max(min_count, file.stations.max_count) + 1)
        placement = candidate_placement_seeing_all_points(
            make_search_space(file, scenario, n_stations=station_counts[-1], n_faces=faces[-1]), file
        )
        judgements: list[tuple[float, TradeoffPoint]] = []
        k = 0
        for n in station_counts:
            if n < station_counts[-1] and (
                lacking := points_lacking_sights_text(self.problem.search_space(SearchTask(n, faces[-1], 0)), placement)
            ):
                self.station_count_results.append(StationCountResult(n, None, False, lacking))
                continue
            tasks = [SearchTask(n, f, start) for f in faces for start in range(file.search.starts)]
            # Few stations are likely enough: each further number counts half of what is left.
            made = self._run_searches(tasks, lambda share, k=k: 1.0 - 0.5 ** (k + share))  # type: ignore[misc]
            options = self.tradeoff_points(
                {key: self._layout_with_smallest_tolerance_ratio(layouts, demands) for key, layouts in made.items()}
            )
            paid = [o for o in options if o.hours <= (file.budget.max_hours or np.inf)]
            results = [
                (*feasibility_and_tolerance_ratio(option.survey, demands, self.problem.construction), option)
                for option in paid
            ]
            judgements += [(ratio, option) for _, ratio, option in results]
            self.station_count_results.append(
                StationCountResult(n, min((ratio for _, ratio, _ in results), default=None), bool(options))
            )
            good = [option for feasible, _, option in results if feasible]
            k += 1
            if good:
                return min(good, key=lambda o: o.hours)
            if self.is_stopped or self._has_converged():
                break
        if not judgements:
            raise InputError(self._no_layout_message(station_counts))
        return min(judgements, key=lambda judgement: (judgement[0], judgement[1].hours))[1]

    def _layout_with_smallest_tolerance_ratio(
        self, layouts: list[tuple[float, int, PlannedSurvey]], tolerances: PointTolerances
    ) -> list[tuple[float, int, PlannedSurvey]]:
        """List with the layout whose largest ratio of point error to tolerance is the smallest of all `layouts`.

        Each entry of `layouts` is the objective, the number of the initial layout, and the survey.
        """
        if len(layouts) == 1:
            return layouts
        return [
            min(
                layouts,
                key=lambda layout: (
                    feasibility_and_tolerance_ratio(layout[2], tolerances, self.problem.construction)[1],
                    layout[0],
                    layout[1],
                ),
            )
        ]

    def _has_converged(self) -> bool:
        """True if the last two additional stations hardly reduced the largest ratio of point error to tolerance."""
        ratios = [
            outcome.max_tolerance_ratio if outcome.max_tolerance_ratio is not None else np.inf
            for outcome in self.station_count_results
        ]
        return (
            len(ratios) > 2
            and np.isfinite(ratios[-3])
            and ratios[-1] > MAX_ERROR_RATIO_OF_USEFUL_STATION**2 * ratios[-3]
        )

    def _no_layout_message(self, station_counts: range) -> str:
        """Error message for a search that found no layout with any of the numbers of stations `station_counts`."""
        hours = self.plan_file.budget.max_hours
        if self.is_stopped:
            return STOPPED_SEARCH_MESSAGE
        if hours and any(outcome.has_layout for outcome in self.station_count_results):
            range_text = f"{station_counts[0]} to {station_counts[-1]}"
            return f"no layout of {range_text} stations takes at most {hours:g} h; increase budget.max_hours"
        try:
            search_from_start(self.problem, SearchTask(station_counts[-1], self.face_and_round_choices[0][-1], 0))
        except (InputError, NetworkError) as problem:
            return f"{problem}, or increase stations.max_count"
        return "the search found no layout; enlarge the floor or increase stations.max_count"

    def tradeoff_points(self, layouts: LayoutsByStationsAndFaces) -> tuple[TradeoffPoint, ...]:
        """Best layout for each number of stations, faces and rounds, in ascending order of duration."""
        points = []
        for starts in layouts.values():
            survey = min(starts, key=lambda layout: layout[:2])[2]
            for repeats in self.face_and_round_choices[1]:
                repeated = survey.replace(repeats=repeats)
                objective = layout_objective(self.plan_file, repeated)
                points.append(
                    TradeoffPoint(repeated, *objective_and_qualities(repeated, objective, self.problem.construction))
                )
        if not points:
            return ()
        points.sort(key=lambda option: (option.hours, option.objective_value))
        best_values = np.minimum.accumulate([option.objective_value for option in points])
        previous_best = np.r_[np.inf, best_values[:-1]]
        return tuple(
            replace(o, is_efficient=bool(o.objective_value < before))
            for o, before in zip(points, previous_best, strict=True)
        )
