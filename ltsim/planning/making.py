"""From a plan file to a plan: which searches are made, and which of the layouts that they find is the plan."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ltsim.adjustment.remedies.next_measurement import Progress, quiet
from ltsim.core.errors import NetworkError, SetupError
from ltsim.core.randomness import stream
from ltsim.core.units import MICROMETRE
from ltsim.planning.plan import Plan
from ltsim.planning.planner import Option, Tried, judge, measure
from ltsim.planning.search import LayoutSearcher
from ltsim.planning.site import Placement, Site
from ltsim.planning.spec import PlanFile
from ltsim.planning.starts import Layouts, PlanningProblem, SearchTask, expected_seconds, gathered, search_one
from ltsim.planning.survey import Survey
from ltsim.planning.tolerances import Demands, holds
from ltsim.planning.workshop import fewest_sights, objective_of, site_of, ways
from ltsim.scene.floor import grid_step
from ltsim.simulation.scenario import Scenario

MOST_SETUPS = 200_000
"""Set-ups of a grid that one search holds in memory."""
SEARCHING = 0.8
"""Share of the work that is the search."""
FEWEST = 2
"""Stations of a network."""
LITTLE = 0.95
"""Factor on the largest error over its tolerance that a further station should bring."""
OPEN = (
    "no layout that was found determines all poses and points; let stations share more points "
    "(stations.seen_from = 2), or give more stations or search.starts"
)
STOPPED = "the search was stopped before it had found a layout"


@dataclass(frozen=True)
class Follower:
    """Callbacks for the progress of making a plan."""

    progress: Progress = quiet
    say: Callable[[str], None] = quiet
    """Callback for sentences: the expected duration, the best layout so far."""
    keep: Callable[[Survey], None] = quiet
    """Callback for the best layout so far."""


def make_plan(file: PlanFile, scenario: Scenario, *, jobs: int = 1, follower: Follower | None = None) -> Plan:
    """Search and explain; the same file gives the same plan whatever the number of jobs.

    Ctrl-C ends the search: the plan is then that of the best layout so far, and says so. SetupError where no layout
    keeps the plan's rules.
    """
    _check_size(file, scenario)
    heard = follower or Follower()
    heard.progress("searching layouts", 0.0)
    search = _Search(PlanningProblem(file, scenario), jobs, heard)
    best = search.fewest() if file.searches_count else search.at_count()
    if not np.isfinite(best.value):
        raise SetupError(OPEN)
    heard.progress("judging tolerances and changes", SEARCHING)
    made = judge(search.file, scenario, best.survey)
    heard.progress("judging tolerances and changes", 1.0)
    own = search.found.get((len(best.survey.position), len(best.survey.faces)), [])
    network = replace(
        made,
        options=search.options(search.found),
        spread=tuple(sorted(value for value, _, _ in own)),
        tried=tuple(search.tried),
        stopped=search.stopped,
    )
    return Plan.of(network)


@dataclass
class _Search:
    """The layouts for each way of working, and which of them is the plan."""

    problem: PlanningProblem
    jobs: int
    heard: Follower
    found: Layouts = field(default_factory=dict)
    tried: list[Tried] = field(default_factory=list)
    stopped: bool = False

    @property
    def file(self) -> PlanFile:
        return self.problem.file

    @property
    def ways(self) -> tuple[list[int], list[int]]:
        """Numbers of faces and of rounds to choose from."""
        return ways(self.file, self.problem.scenario)

    def _gather(self, tasks: Sequence[SearchTask], share: Callable[[float], float]) -> Layouts:
        """Layouts of the searches; the follower receives the best so far."""
        goal = self.file.goal

        def keep(survey: Survey, value: float) -> None:
            lengths = goal.targets > 0 and goal.instrument == goal.diagnosis == 0
            words = f"weighted point error {value / MICROMETRE:.1f} um" if lengths else f"quality {value:.4g}"
            self.heard.say(f"best so far: {len(survey.position)} stations, {words}")
            self.heard.keep(survey)

        def progress(done: float) -> None:
            self.heard.progress("searching layouts", SEARCHING * share(done))

        made, stopped = gathered(self.problem, tasks, self.jobs, progress, keep)
        self.found |= made
        self.stopped |= stopped
        return made

    def at_count(self) -> Option:
        """The best layout for a given number of stations, or for the working hours of the budget."""
        scenario = self.problem.scenario
        count, work = self.file.stations.count or len(scenario.stations), scenario.work
        site = site_of(self.file, scenario, stations=count, faces=work.faces)
        file = with_reachable_sights(self.file, site)
        self.problem = replace(self.problem, file=file)
        faces, settings = self.ways[0], file.search
        own = work.faces if work.faces in faces else faces[-1]
        tasks = [
            SearchTask(n, f, start)
            for f in faces
            for n in sorted({*file.stations.tries, count})
            for start in range(settings.starts if (n, f) == (count, own) else settings.starts_of_the_curve)
        ]
        self._estimate(tasks)
        self._gather(tasks, lambda share: share)
        if (count, own) not in self.found and not self.stopped:
            search_one(self.problem, SearchTask(count, own, 0))  # the same search again, for its sentence
        options = self.options(self.found)
        if not options:
            raise SetupError(STOPPED)
        hours = file.budget.hours
        if hours is None:
            return min(options, key=lambda o: (len(o.survey.position) != count, o.value))
        paid = [o for o in options if o.hours <= hours]
        if not paid:
            cheapest = min(o.hours for o in options)
            raise SetupError(f"budget.hours is {hours:g}, but the cheapest way of working takes {cheapest:.1f} hours")
        return min(paid, key=lambda o: o.value)

    def fewest(self) -> Option:
        """One station more at a time until the tolerances are kept; of the ways that keep them the quickest.

        Where none keeps them, the one that comes nearest.
        """
        demands, scenario = Demands.of(self.file), self.problem.scenario
        alone = demands.robust == "no"
        if not self.file.asks_for_sights:
            least = fewest_sights(scenario) + (not alone)
            self.problem = replace(self.problem, file=self.file.with_seen_from(least))
        file, faces = self.file, self.ways[0]
        seen_from = file.stations.seen_from
        first = max(FEWEST if alone else 3, len(file.stations.fixed), 1 if seen_from == "all" else seen_from)
        counts = range(first, max(first, file.stations.most) + 1)
        placement = check_in_sight(site_of(file, scenario, stations=counts[-1], faces=faces[-1]), file)
        judgements: list[tuple[float, Option]] = []
        k = 0
        for n in counts:
            if n < counts[-1] and (lacking := _lacking(self.problem.site(SearchTask(n, faces[-1], 0)), placement)):
                self.tried.append(Tried(n, None, False, lacking))
                continue
            tasks = [SearchTask(n, f, start) for f in faces for start in range(file.search.starts)]
            if not k:
                self._estimate(tasks, f" for {n} stations, as long again and more for each further number")
            # Few stations are likely enough: each further number counts half of what is left.
            made = self._gather(tasks, lambda share, k=k: 1.0 - 0.5 ** (k + share))  # type: ignore[misc]
            options = self.options({key: self._nearest(found, demands) for key, found in made.items()})
            paid = [o for o in options if o.hours <= (file.budget.hours or np.inf)]
            results = [(*holds(option.survey, demands, self.problem.built), option) for option in paid]
            judgements += [(ratio, option) for _, ratio, option in results]
            self.tried.append(Tried(n, min((ratio for _, ratio, _ in results), default=None), bool(options)))
            good = [option for kept, _, option in results if kept]
            k += 1
            if good:
                return min(good, key=lambda o: o.hours)
            if self.stopped or self._levels_off():
                break
        if not judgements:
            raise SetupError(self._none_found(counts))
        return min(judgements, key=lambda one: (one[0], one[1].hours))[1]

    def _nearest(self, found: list[tuple[float, int, Survey]], demands: Demands) -> list[tuple[float, int, Survey]]:
        """The layout that comes nearest to the tolerances, of those of several starts."""
        if len(found) == 1:
            return found
        return [min(found, key=lambda one: (holds(one[2], demands, self.problem.built)[1], one[0], one[1]))]

    def _levels_off(self) -> bool:
        """Two further stations in turn brought next to nothing."""
        ratios = [one.ratio if one.ratio is not None else np.inf for one in self.tried]
        return len(ratios) > 2 and np.isfinite(ratios[-3]) and ratios[-1] > LITTLE**2 * ratios[-3]

    def _none_found(self, counts: range) -> str:
        hours = self.file.budget.hours
        if self.stopped:
            return STOPPED
        if hours and any(one.found for one in self.tried):
            return f"no layout of {counts[0]} to {counts[-1]} stations was found that takes {hours:g} h at most"
        try:
            search_one(self.problem, SearchTask(counts[-1], self.ways[0][-1], 0))
        except (SetupError, NetworkError) as problem:
            return f"{problem}, or give more stations.most"
        return "no layout was found; widen the floor or give more stations.most"

    def _estimate(self, tasks: Sequence[SearchTask], what: str = "") -> None:
        if self.heard.say is quiet:
            return
        seconds = expected_seconds(self.problem, tasks) / min(self.jobs, len(tasks))
        time = f"{max(seconds, 5):.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
        count = f"{len(tasks)} search{'es' if len(tasks) > 1 else ''}"
        self.heard.say(f"{count}: about {time}{what}; Ctrl-C ends the search and keeps the best layout so far")

    def options(self, layouts: Layouts) -> tuple[Option, ...]:
        """The best layout of every way of working, with each number of repeats; cheapest first."""
        made = []
        for found in layouts.values():
            survey = min(found, key=lambda one: one[:2])[2]
            for repeats in self.ways[1]:
                repeated = survey.replace(repeats=repeats)
                objective = objective_of(self.file, repeated)
                made.append(Option(repeated, *measure(repeated, objective, self.problem.built)))
        if not made:
            return ()
        made.sort(key=lambda option: (option.hours, option.value))
        best = np.minimum.accumulate([option.value for option in made])
        earlier = np.r_[np.inf, best[:-1]]
        return tuple(replace(o, efficient=bool(o.value < before)) for o, before in zip(made, earlier, strict=True))


def _lacking(site: Site, placement: Placement) -> str:
    """Points out of sight, in words; empty where some layout has them all, the site's own or one on the grid."""
    own = site.survey.position
    if site.joined(own[None], site.seen(own)[None])[0]:
        return ""
    return site.lacking(placement, placement.stations(len(own) - len(site.fixed), site.least))


def _check_size(file: PlanFile, scenario: Scenario) -> None:
    """Refuse a grid of set-ups that no memory holds."""
    step = file.search.grid_mm
    if step is None:
        return
    wide, deep, _ = scenario.workshop.size_mm
    outlines = [area.corners_mm for area in file.floor.areas] or [file.floor.corners_mm or ((0.0, 0.0), (wide, deep))]
    sizes = np.array([np.ptp(np.array(outline), axis=0) for outline in outlines])
    count = float(np.prod(1.0 + sizes / step, axis=1).sum()) * file.search.yaws * file.search.heights
    if count > MOST_SETUPS:
        raise SetupError(
            f"search: a grid of {step:g} mm over {sizes[:, 0].max():g} x {sizes[:, 1].max():g} mm has {count:.2g} "
            f"set-ups, the most is {MOST_SETUPS}; give a larger grid_mm or a smaller floor"
        )


def most_sights(site: Site, step: float, heights: int) -> tuple[int, str]:
    """The largest number of stations that some layout has in sight of every reflector; the reflector that limits it.

    A lower bound by the greedy placement, which is the truth where some place on the floor sees everything.
    """
    placement, names = site.placement(step, heights), site.survey.target_names
    limiting = names[int(np.argmin(placement.seen.mean(axis=0)))]
    count = len(site.survey.position) - len(site.fixed)
    enough = (k for k in range(site.least, 0, -1) if not placement.missing(placement.stations(count, k), k).any())
    return next(enough, 0), limiting


def with_reachable_sights(file: PlanFile, site: Site) -> PlanFile:
    """The file with a `stations.seen_from` that some layout keeps.

    One that was asked for is not lowered: SetupError says what can be had.
    """
    settings, count = file.search, len(site.survey.position)
    step = grid_step(site.areas, settings.grid_mm)
    found, limiting = most_sights(site, step, settings.heights)
    if found >= site.least:
        return file

    def refused(least: int) -> SetupError | None:
        """Why the search finds no layout to begin from; None where it does."""
        searcher = LayoutSearcher(site.replace(least=least), step=step, yaws=1, heights=settings.heights)
        try:
            searcher.random_layout(stream(settings.seed, "plan", "sights"))
        except SetupError as problem:
            return problem
        return None

    if not file.asks_for_sights and found:
        while found > 1 and refused(found):
            found -= 1
        return file.with_seen_from(found)
    problem = refused(site.least)
    if problem is None:
        return file
    if not found:
        raise problem
    cure = "take a station out of stations.fixed" if len(site.fixed) else "widen the floor"
    raise SetupError(
        f"stations.seen_from asks that every reflector is seen from {site.least} of {count} stations; {found} is "
        f"the best that was found, and {limiting} is seen from the fewest places: set stations.seen_from = "
        f"{found}, move {limiting}, or {cure}"
    )


def check_in_sight(site: Site, file: PlanFile) -> Placement:
    """Candidate places of stations; SetupError, with their names, where points are in sight from no place."""
    placement = site.placement(grid_step(site.areas, file.search.grid_mm), file.search.heights)
    if not placement.seen.any(axis=0).all():
        raise SetupError(site.out_of_sight(np.flatnonzero(~placement.seen.any(axis=0))))
    return placement
