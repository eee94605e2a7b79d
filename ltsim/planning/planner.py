"""Planned networks: layouts with their expected precision, before anything is measured."""

from dataclasses import dataclass, replace

import numpy as np

from ltsim.core.arrays import Bools
from ltsim.core.errors import NetworkError
from ltsim.core.values import ValueEquality
from ltsim.physics.model.construction import Construction
from ltsim.planning.fast import LayoutScorer
from ltsim.planning.information import ExpectedErrors, LayoutInformation, Predictor
from ltsim.planning.objective import Objective
from ltsim.planning.reflectors import Changes, reflector_changes
from ltsim.planning.site import BrokenRule, SearchSpace
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import Survey
from ltsim.planning.tolerances import PlanVerdict, ToleranceCheck, Tolerances, every_loss, judged, verdict
from ltsim.planning.workshop import fixed_of, objective_of, site_of, survey_of
from ltsim.recordings.setup import Target
from ltsim.scene.visibility import Visibility, aimed_normals, visibility
from ltsim.simulation.physics import planned_construction
from ltsim.simulation.scenario import Scenario


@dataclass(frozen=True)
class TradeoffPoint(ValueEquality):
    """Point of the trade-off curve: number of rounds and faces, best layout, cost and quality."""

    survey: Survey
    value: float
    """The objective; smaller is better."""
    qualities: dict[str, float]
    efficient: bool = False
    """No other option is better and cheaper."""

    @property
    def hours(self) -> float:
        """[h] Duration of the work."""
        return self.survey.seconds / 3600.0


@dataclass(frozen=True)
class LayoutEvaluation(ValueEquality):
    """A layout with everything that is known of it before measuring."""

    survey: Survey
    value: float
    """Infinite where the plan's rules do not allow it."""
    qualities: dict[str, float]
    information: LayoutInformation
    table: Visibility
    expected: ExpectedErrors | None
    """The paper's criteria; None where some target is not seen whole from everywhere."""
    broken: tuple[BrokenRule, ...] = ()
    """Rules of the plan that it breaks."""


@dataclass(frozen=True)
class StationCountResult:
    """Outcome of the searches for one number of stations."""

    stations: int
    ratio: float | None
    """Largest error over its tolerance in the best of them; None without any."""
    has_layout: bool
    """True if a layout sees every point."""
    lacking: str = ""
    """Points that the nearest layout does not see, in words."""


@dataclass(frozen=True, repr=False)
class PlannedNetwork(ValueEquality):
    """A layout with all that the planner knows of it, as arrays; `Plan` is the result that is made of it."""

    file: PlanFile
    scenario: Scenario
    site: SearchSpace
    """Site for the chosen way of working."""
    reference: LayoutEvaluation | None
    """The scenario's own layout, worked in the chosen way; None where it determines nothing."""
    chosen: LayoutEvaluation
    changes: Changes
    """Single reflectors of the chosen layout moved, added, left out."""
    demands: Tolerances
    """Tolerances of points."""
    check: ToleranceCheck | None = None
    """Chosen layout against the tolerances; None without any."""
    losses: tuple[ToleranceCheck, ...] = ()
    """The layout against the tolerances without each station, then without each sight of a point with a tolerance."""
    options: tuple[TradeoffPoint, ...] = ()
    """The curve, cheapest first."""
    spread: tuple[float, ...] = ()
    """Values that the starts of the chosen way ended at, best first."""
    tried: tuple[StationCountResult, ...] = ()
    """Outcome for each number of stations, where the fewest are searched for."""
    stopped: bool = False
    """True where somebody ended the search."""

    @property
    def verdict(self) -> PlanVerdict | None:
        """The layout against the plan's rules and tolerances; None without tolerances."""
        if self.check is None:
            return None
        return verdict(self.demands, self.check, self.losses, self.chosen.broken)


def judge(file: PlanFile, scenario: Scenario, survey: Survey) -> PlannedNetwork:
    """The plan of a layout as it is, without a search."""
    built, demands = planned_construction(scenario), Tolerances.of(file)
    site = site_of(file, scenario, stations=len(survey.position), faces=len(survey.faces), repeats=survey.repeats)
    objective = objective_of(file, survey)
    return PlannedNetwork(
        file=file,
        scenario=scenario,
        site=site,
        reference=_reference(file, scenario, site, built, survey),
        chosen=evaluated(site, survey, objective, built),
        demands=demands,
        check=judged(survey, demands, built) if demands else None,
        losses=every_loss(survey, demands, built),
        changes=reflector_changes(site, survey, fixed_of(file, scenario, survey), objective, built),
    )


def measure(survey: Survey, objective: Objective, built: Construction) -> tuple[float, dict[str, float]]:
    """Objective and qualities of a survey as it is."""
    reducer = LayoutScorer(survey, built, objective.effects)
    slots = np.arange(len(survey.position))
    reduced = reducer.reduce(
        reducer.blocks(survey.position, survey.yaw, slots, survey.visible), slots[None], targets=objective.wants_targets
    )
    if survey.air is not None and objective.wants_targets:  # the search knows no more of the air than its scatter
        rms = LayoutInformation.of(survey, built).target_rms if np.isfinite(reduced.target_rms[0]) else np.nan
        reduced = replace(reduced, target_rms=np.array([rms]))
    qualities = objective.qualities(reduced, built.size)
    value = float(objective.values(reduced, built.size)[0])
    return value, {name: float(quality[0]) for name, quality in qualities.items()}


def evaluated(site: SearchSpace, survey: Survey, objective: Objective, built: Construction) -> LayoutEvaluation:
    """Evaluation of a layout before measuring; NetworkError where poses or targets are undetermined."""
    table = sight_table(site, survey)
    survey = survey.replace(visible=table.visible)
    information = LayoutInformation.of(with_aimed_nests(site, survey), built)
    broken = site.broken_rules(survey)
    value, qualities = measure(survey, objective, built)
    compared = survey.is_whole and survey.visible.all() and len(survey.position) > 1
    expected = Predictor.of(information).expected() if compared else None
    return LayoutEvaluation(survey, np.inf if broken else value, qualities, information, table, expected, broken)


def sight_table(site: SearchSpace, survey: Survey) -> Visibility:
    """Sights between stations and targets, with fixed nests, those of chosen reflectors too, aimed at the stations."""
    normal, aimed = aimed_normals(survey.position, survey.points)[0], _aimed(site, survey)
    return visibility(
        survey.position, survey.points, site.limits, nest_normal=normal, reaimed=~aimed, obstacles=site.obstacles
    )


def _aimed(site: SearchSpace, survey: Survey) -> Bools:
    """Targets of a survey in fixed nests that are aimed at its stations, (T,)."""
    aimed = np.full(len(survey.points), bool(site.aimed.any()))
    aimed[: len(site.aimed)] = site.aimed[: len(survey.points)]
    return aimed


def with_aimed_nests(site: SearchSpace, survey: Survey) -> Survey:
    """The survey whose set-up says how its fixed nests are aimed at its stations."""
    targets, normals = dict(survey.setup.targets), aimed_normals(survey.position, survey.points)[0]
    for at in np.flatnonzero(_aimed(site, survey)).tolist():
        name = survey.target_names[at]
        aim = {"nest_normal": tuple(normals[at].tolist()), "reaimed": False}
        targets[name] = targets.get(name, Target()).model_copy(update=aim)
    return survey.replace(setup=survey.setup.model_copy(update={"targets": targets}))


def _reference(
    file: PlanFile, scenario: Scenario, site: SearchSpace, built: Construction, way: Survey
) -> LayoutEvaluation | None:
    """The scenario's own layout, worked in the same way; none in a hall that the plan itself describes."""
    if file.workshop is not None:
        return None
    work = ("faces", "repeats", "seconds_per_pointing", "seconds_per_move", "air")
    reference = survey_of(scenario).replace(**{name: getattr(way, name) for name in work})
    count = len(reference.position)
    least = (
        count if file.stations.min_stations_per_target == "all" else min(file.stations.min_stations_per_target, count)
    )
    try:
        return evaluated(
            site.replace(survey=reference, min_sights=least, position_tolerance=0.0),
            reference,
            objective_of(file, reference),
            built,
        )
    except NetworkError:
        return None
