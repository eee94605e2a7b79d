"""Evaluation of planned layouts before measurement: expected precision, rules, tolerances, changes of reflectors."""

from dataclasses import dataclass, replace

import numpy as np

from ltsim.core.arrays import Bools
from ltsim.core.equality import ValueEquality
from ltsim.core.errors import NetworkError
from ltsim.core.notation import names_text
from ltsim.core.units import MILLIMETRE
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.planning.expected_precision import DisagreementPredictor, ExpectedDisagreement, ExpectedPrecision
from ltsim.planning.layout_rules import MAX_NAMES_IN_RULE_TEXT, BrokenRule
from ltsim.planning.layout_scorer import LayoutScorer
from ltsim.planning.objective import LayoutObjective
from ltsim.planning.reflector_changes import ReflectorChanges, evaluate_reflector_changes
from ltsim.planning.search_inputs import is_target_never_moved, layout_objective, make_search_space, planned_survey
from ltsim.planning.search_space import SearchSpace
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import PlannedSurvey
from ltsim.planning.tolerances import (
    PlanVerdict,
    PointTolerances,
    ToleranceCheck,
    check_tolerances,
    checks_after_every_loss,
    plan_verdict,
)
from ltsim.recordings.setup import Target
from ltsim.scene.visibility import Visibility, compute_visibility, nest_normals_of_smallest_incidence
from ltsim.simulation.physics import planned_construction
from ltsim.simulation.scenario import Scenario

MAX_BLOCKED_SIGHTS_IN_SENTENCE = 3
"""Largest number of blocked sights that a sentence for users describes one by one."""


@dataclass(frozen=True)
class ScoredLayout(ValueEquality):
    """Layout with its objective and qualities."""

    survey: PlannedSurvey
    """Planned survey whose stations and targets form the layout."""
    objective_value: float
    """Objective, smaller is better; infinite for a layout that breaks rules of the plan."""
    qualities: dict[str, float]
    """Values of the qualities (`instrument`, `targets`, `diagnosis`) with a weight in the goal, by name; smaller is
    better."""


@dataclass(frozen=True)
class TradeoffPoint(ScoredLayout):
    """Point of the trade-off curve between cost (duration) and quality: a measuring procedure with its best layout."""

    is_efficient: bool = False
    """True if every point of the trade-off curve with a shorter duration has a worse objective."""

    @property
    def hours(self) -> float:
        """Duration [h] of the whole measurement with this procedure."""
        return self.survey.duration / 3600.0


@dataclass(frozen=True)
class LayoutEvaluation(ScoredLayout):
    """Evaluation of a planned layout before measurement: expected precision, visibility, objective and broken rules."""

    expected_precision: ExpectedPrecision
    """Expected precision of the unknowns (poses, targets, instrument parameters) of the layout."""
    visibility: Visibility
    """Visibility of each target from each station, with the reason for each blocked line of sight."""
    expected_disagreement: ExpectedDisagreement | None
    """Expected mean disagreement of the stations in distances and coordinates, before and after calibration.

    None for ranges without angles, for a single station, and if a station does not see all targets.
    """
    broken_rules: tuple[BrokenRule, ...] = ()
    """Rules of the plan that the layout breaks."""

    def blocked_sight_sentences(self) -> list[str]:
        """Sentence with the number of blocked sights and the first of them, in a list; empty if no sight is blocked."""
        names, targets = self.survey.station_names, self.survey.target_names
        is_shown = ~self.visibility.is_marginal[~self.visibility.is_visible]
        pairs = self.visibility.invisible_pair_sentences(names, targets)
        blocked = [sentence for sentence, shown in zip(pairs, is_shown, strict=True) if shown]
        more = "; and more" if len(blocked) > MAX_BLOCKED_SIGHTS_IN_SENTENCE else ""
        first = "; ".join(blocked[:MAX_BLOCKED_SIGHTS_IN_SENTENCE])
        return [f"{len(blocked)} sights are blocked: {first}{more}."] if blocked else []

    def marginal_sight_sentences(self, position_tolerance: float) -> list[str]:
        """Sentence, in a list, on sights that are free from only a part of the permitted positions; or empty list.

        `position_tolerance` [m] is the largest distance of a station from its planned position.
        """
        names, targets = self.survey.station_names, self.survey.target_names
        pairs = [f"{names[s]} to {targets[t]}" for s, t in np.argwhere(self.visibility.is_marginal).tolist()]
        if not pairs:
            return []
        many = len(pairs) > 1
        return [
            f"{len(pairs)} marginal sight{'s' if many else ''} {'do' if many else 'does'} not count, because a tripod "
            f"{position_tolerance / MILLIMETRE:g} mm beside its planned position may lose {'them' if many else 'it'} "
            f"(stations.position_tolerance_mm): {names_text(pairs, MAX_NAMES_IN_RULE_TEXT)}."
        ]


@dataclass(frozen=True)
class StationCountResult:
    """Result of the searches for layouts with a certain number of stations."""

    n_stations: int
    """Number of stations of the layouts."""
    max_tolerance_ratio: float | None
    """Largest ratio of point error to tolerance in the best layout; None if the search found no layout."""
    has_layout: bool
    """True if the search found a layout in which every point has the required sights."""
    points_lacking_sights_text: str = ""
    """Names of points that too few stations see in the layout with the fewest missing sights; empty if none is missing.
    """


@dataclass(frozen=True, repr=False)
class PlannedNetwork(ValueEquality):
    """Planned network with its evaluations as arrays, from which the result `Plan` is created."""

    plan_file: PlanFile
    """Plan file with the goal, the rules and the settings of the search."""
    scenario: Scenario
    """Scenario with hall, instrument, gauge and targets."""
    search_space: SearchSpace
    """Search space (permitted positions and rules) for the chosen numbers of faces and rounds."""
    scenario_layout_evaluation: LayoutEvaluation | None
    """Evaluation of the layout in the scenario, measured with the same faces and rounds as the planned layout; None if
    the scenario's layout is undetermined, or if the plan file describes a hall instead of a scenario."""
    layout: LayoutEvaluation
    """Evaluation of the planned layout."""
    reflector_changes: ReflectorChanges
    """Evaluated changes of single reflectors of the planned layout: moved, added, removed."""
    tolerances: PointTolerances
    """Tolerances of the points."""
    tolerance_check: ToleranceCheck | None = None
    """Check of the planned layout against the tolerances; None without tolerances."""
    loss_checks: tuple[ToleranceCheck, ...] = ()
    """Checks of the tolerances after the loss of each station, and of each sight of a point with a tolerance."""
    tradeoff_points: tuple[TradeoffPoint, ...] = ()
    """Points of the trade-off curve between cost and quality, in ascending order of duration."""
    start_objectives: tuple[float, ...] = ()
    """Value of the objective function at the end of the search from each initial layout, in ascending order, for the
    chosen numbers of faces and rounds."""
    station_count_results: tuple[StationCountResult, ...] = ()
    """Result for each number of stations that was searched, if the plan asks for the fewest stations; otherwise empty.
    """
    is_stopped: bool = False
    """True if the user stopped the search."""

    @property
    def verdict(self) -> PlanVerdict | None:
        """Verdict whether the layout meets the rules and tolerances of the plan; None without tolerances."""
        if self.tolerance_check is None:
            return None
        return plan_verdict(self.tolerances, self.tolerance_check, self.loss_checks, self.layout.broken_rules)


def evaluate_plan(plan_file: PlanFile, scenario: Scenario, survey: PlannedSurvey) -> PlannedNetwork:
    """Planned network whose layout is that of `survey`, evaluated without a search."""
    built, demands = planned_construction(scenario), PointTolerances.from_plan_file(plan_file)
    site = make_search_space(
        plan_file,
        scenario,
        n_stations=len(survey.station_positions),
        n_faces=len(survey.faces),
        n_repeats=survey.repeats,
    )
    objective = layout_objective(plan_file, survey)
    layout = evaluate_layout(site, survey, objective, built)
    survey = layout.survey  # all parts of the plan have its sights
    return PlannedNetwork(
        plan_file=plan_file,
        scenario=scenario,
        search_space=site,
        scenario_layout_evaluation=_scenario_layout_evaluation(plan_file, scenario, site, built, survey),
        layout=layout,
        tolerances=demands,
        tolerance_check=check_tolerances(survey, demands, built) if demands else None,
        loss_checks=checks_after_every_loss(survey, demands, built),
        reflector_changes=evaluate_reflector_changes(
            site, survey, is_target_never_moved(plan_file, scenario, survey), objective, built
        ),
    )


def objective_and_qualities(
    survey: PlannedSurvey, objective: LayoutObjective, construction: GeometricErrorModel
) -> tuple[float, dict[str, float]]:
    """Objective of the layout of a survey, and value of each quality with a weight in the objective, by name.

    `construction` is the geometric error model whose parameters a calibration would estimate.
    """
    reducer = LayoutScorer(survey, construction, objective.effects)
    stations = np.arange(len(survey.station_positions))
    reduced = reducer.evaluate_layouts(
        reducer.normal_blocks(survey.station_positions, survey.station_yaws, stations, survey.is_visible),
        stations[None],
        with_target_errors=objective.needs_target_errors,
    )
    if survey.air is not None and objective.needs_target_errors:  # the search includes turbulence only
        rms = (
            ExpectedPrecision.from_survey(survey, construction).weighted_target_rms
            if np.isfinite(reduced.weighted_target_rms[0])
            else np.nan
        )
        reduced = replace(reduced, weighted_target_rms=np.array([rms]))
    qualities = objective.qualities(reduced, construction.n_parameters)
    value = float(objective.objective_values(reduced, construction.n_parameters)[0])
    return value, {name: float(quality[0]) for name, quality in qualities.items()}


def evaluate_layout(
    search_space: SearchSpace, survey: PlannedSurvey, objective: LayoutObjective, construction: GeometricErrorModel
) -> LayoutEvaluation:
    """Evaluation of the layout of `survey` before measurement, by the rules of `search_space`.

    `construction` is the geometric error model whose parameters a calibration would estimate. Raises NetworkError for
    undetermined poses or targets.
    """
    table = layout_visibility(search_space, survey)
    survey = survey.replace(is_visible=table.is_visible)
    _require_sight_of_every_target(survey, table)
    information = ExpectedPrecision.from_survey(with_aimed_nests(search_space, survey), construction)
    broken = search_space.broken_rules(survey)
    value, qualities = objective_and_qualities(survey, objective, construction)
    compared = survey.records_angles and survey.is_visible.all() and len(survey.station_positions) > 1
    expected = DisagreementPredictor.from_expected_precision(information).expected_disagreement() if compared else None
    return LayoutEvaluation(survey, np.inf if broken else value, qualities, information, table, expected, broken)


def _require_sight_of_every_target(survey: PlannedSurvey, visibility: Visibility) -> None:
    """Check that a station sees each target; otherwise raises NetworkError with the reason for each station."""
    unseen = np.flatnonzero(~visibility.is_visible.any(axis=0))
    if not len(unseen):
        return
    first = survey.target_names[unseen[0]]
    named = names_text([survey.target_names[t] for t in unseen], MAX_NAMES_IN_RULE_TEXT)
    reasons = "; ".join(
        f"{station} does not see {first}: {texts[unseen[0]]}"
        for station, texts in zip(survey.station_names, visibility.reason_texts(), strict=True)
    )
    verb = "s {} are" if len(unseen) > 1 else " {} is"
    raise NetworkError(f"target{verb.format(named)} not visible from any station ({reasons})")


def layout_visibility(search_space: SearchSpace, survey: PlannedSurvey) -> Visibility:
    """Visibility between stations and targets; fixed nests without a declared normal are aimed at the stations.

    A sight is free only if it is free from every position within `SearchSpace.position_tolerance` of its planned
    station.
    """
    normal, aimed = (
        nest_normals_of_smallest_incidence(survey.station_positions, survey.target_points)[0],
        _is_aimed_nest(search_space, survey),
    )
    table = compute_visibility(
        survey.station_positions,
        survey.target_points,
        search_space.sight_limits,
        nest_normals=normal,
        is_reaimed=~aimed,
        obstacles=search_space.obstacles,
    )
    if not search_space.position_tolerance:
        return table
    return table.with_marginal_pairs(~search_space.is_visible(survey.station_positions, survey.target_points))


def _is_aimed_nest(search_space: SearchSpace, survey: PlannedSurvey) -> Bools:
    """Flags (T,): True for a target in a fixed nest without a declared normal, which is aimed at the stations."""
    aimed = np.full(len(survey.target_points), bool(search_space.is_aimed_nest.any()))
    aimed[: len(search_space.is_aimed_nest)] = search_space.is_aimed_nest[: len(survey.target_points)]
    return aimed


def with_aimed_nests(search_space: SearchSpace, survey: PlannedSurvey) -> PlannedSurvey:
    """Survey in which fixed nests without a declared normal have the normal that aims them at the stations."""
    targets, normals = (
        dict(survey.setup.targets),
        nest_normals_of_smallest_incidence(survey.station_positions, survey.target_points)[0],
    )
    for at in np.flatnonzero(_is_aimed_nest(search_space, survey)).tolist():
        name = survey.target_names[at]
        aim = {"nest_normal": tuple(normals[at].tolist()), "reaimed": False}
        targets[name] = targets.get(name, Target()).model_copy(update=aim)
    return survey.replace(setup=survey.setup.model_copy(update={"targets": targets}))


def _scenario_layout_evaluation(
    file: PlanFile,
    scenario: Scenario,
    search_space: SearchSpace,
    construction: GeometricErrorModel,
    survey_with_procedure: PlannedSurvey,
) -> LayoutEvaluation | None:
    """Evaluation of the scenario's layout, measured with the faces, rounds and times of `survey_with_procedure`.

    None if the plan file describes a hall instead of a scenario, and for an undetermined layout.
    """
    if file.workshop is not None:
        return None
    work = ("faces", "repeats", "seconds_per_pointing", "seconds_per_move", "air")
    reference = planned_survey(scenario).replace(**{name: getattr(survey_with_procedure, name) for name in work})
    n_stations = len(reference.station_positions)
    least = (
        n_stations
        if file.stations.min_stations_per_target == "all"
        else min(file.stations.min_stations_per_target, n_stations)
    )
    try:
        return evaluate_layout(
            search_space.replace(survey=reference, min_sights_per_target=least, position_tolerance=0.0),
            reference,
            layout_objective(file, reference),
            construction,
        )
    except NetworkError:
        return None
