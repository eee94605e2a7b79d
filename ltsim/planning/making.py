"""Searches of a plan file, and selection of the plan from their layouts."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ltsim.adjustment.remedies.next_measurement import ProgressCallback, no_progress
from ltsim.core.errors import NetworkError, SetupError
from ltsim.core.randomness import stream
from ltsim.core.units import MICROMETRE
from ltsim.planning.planner import PlannedNetwork, StationCountResult, TradeoffPoint, judge, measure
from ltsim.planning.search import LayoutSearcher
from ltsim.planning.site import Placement, SearchSpace
from ltsim.planning.spec import PlanFile
from ltsim.planning.starts import Layouts, PlanningProblem, SearchTask, gathered, search_from_start
from ltsim.planning.survey import Survey
from ltsim.planning.tolerances import Tolerances, is_feasible
from ltsim.planning.workshop import fewest_sights, objective_of, site_of, ways
from ltsim.scene.floor import grid_step
from ltsim.simulation.scenario import Scenario

MAX_SETUPS = 200_000
"""Largest number of set-ups of a grid that one search holds in memory."""
SEARCH_SHARE = 0.8
"""Fraction of the progress bar for the search."""
MIN_STATIONS = 2
"""Smallest number of stations of a network."""
MAX_IMPROVEMENT_FACTOR = 0.95
"""Largest factor on the ratio of error to tolerance by which an additional station must reduce it; otherwise the search
stops.
"""
OPEN = (
    "no layout of the search determines all poses and points; let stations share more points "
    "(stations.min_stations_per_target = 2), or give more stations or more search.starts"
)
STOPPED = "the search was stopped before it found a layout; let it run longer"


@dataclass(frozen=True)
class Follower:
    """Callbacks for the progress of a search."""

    progress: ProgressCallback = no_progress
    say: Callable[[str], None] = no_progress
    """Callback for sentences on the best layout so far."""
    keep: Callable[[Survey], None] = no_progress
    """Callback for the best layout so far."""


def make_plan(file: PlanFile, scenario: Scenario, *, jobs: int = 1, follower: Follower | None = None) -> PlannedNetwork:
    """Planned network of a search; it is equal for any number of processes.

    Ctrl-C ends the search with the best layout so far, which the result states. Raises SetupError if no layout meets
    the rules of the plan.
    """
    _check_size(file, scenario)
    heard = follower or Follower()
    heard.progress("searching layouts", 0.0)
    search = _Search(PlanningProblem(file, scenario), jobs, heard)
    best = search.fewest() if file.searches_count else search.at_count()
    if not np.isfinite(best.value):
        raise SetupError(OPEN)
    heard.progress("check of tolerances and changes", SEARCH_SHARE)
    made = judge(search.file, scenario, best.survey)
    heard.progress("check of tolerances and changes", 1.0)
    values = search.layouts.get((len(best.survey.position), len(best.survey.faces)), [])
    return replace(
        made,
        options=search.options(search.layouts),
        spread=tuple(sorted(value for value, _, _ in values)),
        tried=tuple(search.tried),
        stopped=search.stopped,
    )


@dataclass
class _Search:
    """State of the planning: layouts for each measuring procedure, and selection of the plan."""

    problem: PlanningProblem
    jobs: int
    heard: Follower
    layouts: Layouts = field(default_factory=dict)
    tried: list[StationCountResult] = field(default_factory=list)
    stopped: bool = False

    @property
    def file(self) -> PlanFile:
        return self.problem.file

    @property
    def ways(self) -> tuple[list[int], list[int]]:
        """Numbers of faces and of rounds that may be chosen."""
        return ways(self.file, self.problem.scenario)

    def _gather(self, tasks: Sequence[SearchTask], share: Callable[[float], float]) -> Layouts:
        """Layouts of the searches; the best so far is passed to the follower."""
        goal = self.file.goal

        def keep(survey: Survey, value: float) -> None:
            lengths = goal.targets > 0 and goal.instrument == goal.diagnosis == 0
            words = f"weighted point error {value / MICROMETRE:.1f} um" if lengths else f"quality {value:.4g}"
            self.heard.say(f"best layout so far: {len(survey.position)} stations, {words}")
            self.heard.keep(survey)

        def progress(done: float) -> None:
            self.heard.progress("searching layouts", SEARCH_SHARE * share(done))

        made, stopped = gathered(self.problem, tasks, self.jobs, progress, keep)
        self.layouts |= made
        self.stopped |= stopped
        return made

    def at_count(self) -> TradeoffPoint:
        """Best layout for a given number of stations, or for the working hours of the budget."""
        scenario = self.problem.scenario
        count, work = self.file.stations.count or len(scenario.stations), scenario.work
        site = site_of(self.file, scenario, stations=count, faces=work.faces)
        file = with_reachable_sights(self.file, site)
        self.problem = replace(self.problem, file=file)
        faces, settings = self.ways[0], file.search
        usual_faces = work.faces if work.faces in faces else faces[-1]
        tasks = [
            SearchTask(n, f, start)
            for f in faces
            for n in sorted({*file.stations.tradeoff_counts, count})
            for start in range(settings.starts if (n, f) == (count, usual_faces) else settings.tradeoff_starts)
        ]
        self._gather(tasks, lambda share: share)
        if (count, usual_faces) not in self.layouts and not self.stopped:
            search_from_start(
                self.problem, SearchTask(count, usual_faces, 0)
            )  # the same search again, for its sentence
        options = self.options(self.layouts)
        if not options:
            raise SetupError(STOPPED)
        hours = file.budget.hours
        if hours is None:
            return min(options, key=lambda o: (len(o.survey.position) != count, o.value))
        paid = [o for o in options if o.hours <= hours]
        if not paid:
            cheapest = min(o.hours for o in options)
            raise SetupError(
                f"budget.hours is {hours:g} h, but the cheapest way of working takes {cheapest:.1f} h; give more hours"
            )
        return min(paid, key=lambda o: o.value)

    def fewest(self) -> TradeoffPoint:
        """Layout with the fewest stations that meets the tolerances, with the fastest measuring procedure for it.

        If none meets them, it is the closest one.
        """
        demands, scenario = Tolerances.of(self.file), self.problem.scenario
        alone = demands.robust == "no"
        if not self.file.asks_for_sights:
            least = fewest_sights(scenario) + (not alone)
            self.problem = replace(self.problem, file=self.file.with_min_stations(least))
        file, faces = self.file, self.ways[0]
        min_stations = file.stations.min_stations_per_target
        first = max(
            MIN_STATIONS if alone else 3, len(file.stations.fixed), 1 if min_stations == "all" else min_stations
        )
        counts = range(first, max(first, file.stations.max_count) + 1)
        placement = check_in_sight(site_of(file, scenario, stations=counts[-1], faces=faces[-1]), file)
        judgements: list[tuple[float, TradeoffPoint]] = []
        k = 0
        for n in counts:
            if n < counts[-1] and (
                lacking := _unseen_by_all_layouts(self.problem.site(SearchTask(n, faces[-1], 0)), placement)
            ):
                self.tried.append(StationCountResult(n, None, False, lacking))
                continue
            tasks = [SearchTask(n, f, start) for f in faces for start in range(file.search.starts)]
            # Few stations are likely enough: each further number counts half of what is left.
            made = self._gather(tasks, lambda share, k=k: 1.0 - 0.5 ** (k + share))  # type: ignore[misc]
            options = self.options({key: self._nearest(layouts, demands) for key, layouts in made.items()})
            paid = [o for o in options if o.hours <= (file.budget.hours or np.inf)]
            results = [(*is_feasible(option.survey, demands, self.problem.built), option) for option in paid]
            judgements += [(ratio, option) for _, ratio, option in results]
            self.tried.append(
                StationCountResult(n, min((ratio for _, ratio, _ in results), default=None), bool(options))
            )
            good = [option for feasible, _, option in results if feasible]
            k += 1
            if good:
                return min(good, key=lambda o: o.hours)
            if self.stopped or self._levels_off():
                break
        if not judgements:
            raise SetupError(self._no_layout_message(counts))
        return min(judgements, key=lambda judgement: (judgement[0], judgement[1].hours))[1]

    def _nearest(
        self, layouts: list[tuple[float, int, Survey]], demands: Tolerances
    ) -> list[tuple[float, int, Survey]]:
        """Layout, among those of several starts, that comes closest to the tolerances."""
        if len(layouts) == 1:
            return layouts
        return [
            min(
                layouts,
                key=lambda layout: (is_feasible(layout[2], demands, self.problem.built)[1], layout[0], layout[1]),
            )
        ]

    def _levels_off(self) -> bool:
        """True if neither of the last two additional stations reduced the largest error by `MAX_IMPROVEMENT_FACTOR`."""
        ratios = [outcome.ratio if outcome.ratio is not None else np.inf for outcome in self.tried]
        return len(ratios) > 2 and np.isfinite(ratios[-3]) and ratios[-1] > MAX_IMPROVEMENT_FACTOR**2 * ratios[-3]

    def _no_layout_message(self, counts: range) -> str:
        hours = self.file.budget.hours
        if self.stopped:
            return STOPPED
        if hours and any(outcome.has_layout for outcome in self.tried):
            return (
                f"no layout of {counts[0]} to {counts[-1]} stations takes at most {hours:g} h; give more budget.hours"
            )
        try:
            search_from_start(self.problem, SearchTask(counts[-1], self.ways[0][-1], 0))
        except (SetupError, NetworkError) as problem:
            return f"{problem}, or give more stations.max_count"
        return "the search found no layout; enlarge the floor or give more stations.max_count"

    def options(self, layouts: Layouts) -> tuple[TradeoffPoint, ...]:
        """Best layout of every measuring procedure and number of repeats, in the order of cost."""
        made = []
        for starts in layouts.values():
            survey = min(starts, key=lambda layout: layout[:2])[2]
            for repeats in self.ways[1]:
                repeated = survey.replace(repeats=repeats)
                objective = objective_of(self.file, repeated)
                made.append(TradeoffPoint(repeated, *measure(repeated, objective, self.problem.built)))
        if not made:
            return ()
        made.sort(key=lambda option: (option.hours, option.value))
        best = np.minimum.accumulate([option.value for option in made])
        earlier = np.r_[np.inf, best[:-1]]
        return tuple(replace(o, efficient=bool(o.value < before)) for o, before in zip(made, earlier, strict=True))


def _unseen_by_all_layouts(site: SearchSpace, placement: Placement) -> str:
    """Text of the points that neither any layout on the grid nor the present one sees; empty for none."""
    position = site.survey.position
    if site.feasible(position[None], site.visible(position)[None])[0]:
        return ""
    return site.unseen_targets(placement, placement.stations(len(position) - len(site.fixed), site.min_sights))


def _check_size(file: PlanFile, scenario: Scenario) -> None:
    """Check that the grid of set-ups fits into memory; raises SetupError."""
    step = file.search.grid_mm
    if step is None:
        return
    wide, deep, _ = scenario.workshop.size_mm
    outlines = [area.corners_mm for area in file.floor.areas] or [file.floor.corners_mm or ((0.0, 0.0), (wide, deep))]
    sizes = np.array([np.ptp(np.array(outline), axis=0) for outline in outlines])
    count = float(np.prod(1.0 + sizes / step, axis=1).sum()) * file.search.yaws * file.search.heights
    if count > MAX_SETUPS:
        raise SetupError(
            f"search: a grid of {step:g} mm over {sizes[:, 0].max():g} x {sizes[:, 1].max():g} mm has {count:.2g} "
            f"set-ups, the limit is {MAX_SETUPS}; give a larger grid_mm or a smaller floor"
        )


def most_sights(site: SearchSpace, step: float, heights: int) -> tuple[int, str]:
    """Largest number of stations that can see every reflector in some layout, and the limiting reflector.

    It is a lower bound from greedy placement, and exact if one place on the floor sees everything.
    """
    placement, names = site.placement(step, heights), site.survey.target_names
    limiting = names[int(np.argmin(placement.visible.mean(axis=0)))]
    count = len(site.survey.position) - len(site.fixed)
    enough = (k for k in range(site.min_sights, 0, -1) if not placement.missing(placement.stations(count, k), k).any())
    return next(enough, 0), limiting


def with_reachable_sights(file: PlanFile, site: SearchSpace) -> PlanFile:
    """Plan file with a value of `stations.min_stations_per_target` that some layout meets.

    A given value is not reduced; instead SetupError reports the largest possible value.
    """
    settings, count = file.search, len(site.survey.position)
    step = grid_step(site.areas, settings.grid_mm)
    reachable, limiting = most_sights(site, step, settings.heights)
    if reachable >= site.min_sights:
        return file

    def refused(least: int) -> SetupError | None:
        """Error of the search for an initial layout; None if there is a layout."""
        searcher = LayoutSearcher(site.replace(min_sights=least), step=step, yaws=1, heights=settings.heights)
        try:
            searcher.random_layout(stream(settings.seed, "plan", "sights"))
        except SetupError as problem:
            return problem
        return None

    if not file.asks_for_sights and reachable:
        while reachable > 1 and refused(reachable):
            reachable -= 1
        return file.with_min_stations(reachable)
    problem = refused(site.min_sights)
    if problem is None:
        return file
    if not reachable:
        raise problem
    cure = "remove a station from stations.fixed" if len(site.fixed) else "enlarge the floor"
    raise SetupError(
        f"stations.min_stations_per_target requires {site.min_sights} of {count} stations to see every reflector, but "
        f"at most {reachable} can, and {limiting} is visible from the fewest places: set "
        f"stations.min_stations_per_target = {reachable}, move {limiting}, or {cure}"
    )


def check_in_sight(site: SearchSpace, file: PlanFile) -> Placement:
    """Candidate places of stations; raises SetupError with the names of points that no place sees."""
    placement = site.placement(grid_step(site.areas, file.search.grid_mm), file.search.heights)
    if not placement.visible.any(axis=0).all():
        raise SetupError(site.out_of_sight(np.flatnonzero(~placement.visible.any(axis=0))))
    return placement
