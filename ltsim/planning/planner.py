"""Planned networks: layouts with their expected precision before measurement."""

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
    """Objective; smaller is better."""
    qualities: dict[str, float]
    efficient: bool = False
    """True if no other option is both better and cheaper."""

    @property
    def hours(self) -> float:
        """Duration [h] of the measurement."""
        return self.survey.seconds / 3600.0


@dataclass(frozen=True)
class LayoutEvaluation(ValueEquality):
    """Evaluation of a layout before measurement."""

    survey: Survey
    value: float
    """Objective; infinite for a layout that breaks rules of the plan."""
    qualities: dict[str, float]
    information: LayoutInformation
    table: Visibility
    expected: ExpectedErrors | None
    """Paper's criteria; None if a target is not completely visible from all stations."""
    broken: tuple[BrokenRule, ...] = ()
    """Rules of the plan that the layout breaks."""


@dataclass(frozen=True)
class StationCountResult:
    """Result of the searches for one number of stations."""

    stations: int
    ratio: float | None
    """Largest ratio of error to tolerance in the best layout; None without one."""
    has_layout: bool
    """True if a layout sees every point."""
    lacking: str = ""
    """Text of the points that the nearest layout does not see."""


@dataclass(frozen=True, repr=False)
class PlannedNetwork(ValueEquality):
    """Planned network as arrays, from which the result `Plan` is created."""

    file: PlanFile
    scenario: Scenario
    site: SearchSpace
    """Search space for the chosen measuring procedure."""
    reference: LayoutEvaluation | None
    """Evaluation of the scenario's own layout with the chosen procedure; None if it is undetermined."""
    chosen: LayoutEvaluation
    changes: Changes
    """Changes of single reflectors of the chosen layout: moved, added, removed."""
    demands: Tolerances
    """Tolerances of the points."""
    check: ToleranceCheck | None = None
    """Check of the chosen layout against the tolerances; None without tolerances."""
    losses: tuple[ToleranceCheck, ...] = ()
    """Checks of the tolerances without each station, then without each sight of a point with a tolerance."""
    options: tuple[TradeoffPoint, ...] = ()
    """Trade-off curve in the order of cost."""
    spread: tuple[float, ...] = ()
    """Final objectives of all starts with the chosen procedure, the best first."""
    tried: tuple[StationCountResult, ...] = ()
    """Result for each number of stations, if the smallest number is searched."""
    stopped: bool = False
    """True if the user stopped the search."""

    @property
    def verdict(self) -> PlanVerdict | None:
        """Verdict on the layout by rules and tolerances; None without tolerances."""
        if self.check is None:
            return None
        return verdict(self.demands, self.check, self.losses, self.chosen.broken)


def judge(file: PlanFile, scenario: Scenario, survey: Survey) -> PlannedNetwork:
    """Planned network of a given layout, without a search."""
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
    """Objective and qualities of a survey."""
    reducer = LayoutScorer(survey, built, objective.effects)
    slots = np.arange(len(survey.position))
    reduced = reducer.reduce(
        reducer.blocks(survey.position, survey.yaw, slots, survey.visible), slots[None], targets=objective.wants_targets
    )
    if survey.air is not None and objective.wants_targets:  # the search knows no more of the air than its scatter
        rms = LayoutInformation.of(survey, built).target_rms if np.isfinite(reduced.target_rms[0]) else np.nan
        reduced = replace(reduced, target_rms=np.array([rms]))
    qualities = objective.qualities(reduced, built.n_parameters)
    value = float(objective.values(reduced, built.n_parameters)[0])
    return value, {name: float(quality[0]) for name, quality in qualities.items()}


def evaluated(site: SearchSpace, survey: Survey, objective: Objective, built: Construction) -> LayoutEvaluation:
    """Evaluation of a layout before measurement; raises NetworkError for undetermined poses or targets."""
    table = sight_table(site, survey)
    survey = survey.replace(visible=table.visible)
    information = LayoutInformation.of(with_aimed_nests(site, survey), built)
    broken = site.broken_rules(survey)
    value, qualities = measure(survey, objective, built)
    compared = survey.is_whole and survey.visible.all() and len(survey.position) > 1
    expected = Predictor.of(information).expected() if compared else None
    return LayoutEvaluation(survey, np.inf if broken else value, qualities, information, table, expected, broken)


def sight_table(site: SearchSpace, survey: Survey) -> Visibility:
    """Visibility between stations and targets, with fixed nests (including chosen ones) aimed at the stations."""
    normal, aimed = aimed_normals(survey.position, survey.points)[0], _aimed(site, survey)
    return visibility(
        survey.position, survey.points, site.limits, nest_normal=normal, reaimed=~aimed, obstacles=site.obstacles
    )


def _aimed(site: SearchSpace, survey: Survey) -> Bools:
    """Flags (T,) of the targets of a survey in fixed nests that are aimed at its stations."""
    aimed = np.full(len(survey.points), bool(site.aimed.any()))
    aimed[: len(site.aimed)] = site.aimed[: len(survey.points)]
    return aimed


def with_aimed_nests(site: SearchSpace, survey: Survey) -> Survey:
    """Survey whose set-up contains the directions in which its fixed nests are aimed at its stations."""
    targets, normals = dict(survey.setup.targets), aimed_normals(survey.position, survey.points)[0]
    for at in np.flatnonzero(_aimed(site, survey)).tolist():
        name = survey.target_names[at]
        aim = {"nest_normal": tuple(normals[at].tolist()), "reaimed": False}
        targets[name] = targets.get(name, Target()).model_copy(update=aim)
    return survey.replace(setup=survey.setup.model_copy(update={"targets": targets}))


def _reference(
    file: PlanFile, scenario: Scenario, site: SearchSpace, built: Construction, way: Survey
) -> LayoutEvaluation | None:
    """Evaluation of the scenario's own layout with the same procedure; None for a hall described by the plan."""
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
