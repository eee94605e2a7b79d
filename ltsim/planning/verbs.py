"""Public functions of planning: search for a layout, alternatives to a station, next measurement."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ltsim.adjustment.remedies.candidates import VisibilityFunction
from ltsim.adjustment.remedies.network import PlannedNetwork as ExtendedNetwork
from ltsim.adjustment.remedies.next_measurement import (
    DEFAULT_MOVE_TIME,
    ProgressCallback,
    no_progress,
    rank_informative_measurements,
    rank_measurements_between,
)
from ltsim.adjustment.snooping import without_copied_rows
from ltsim.calibration.identified_network import IdentifiedNetwork
from ltsim.core.arguments import (
    MAX_MAPPING_ARGUMENT_MAGNITUDE,
    STATION_POSITION_SYNTAX,
    check_argument_bounds,
    check_mapping_argument,
)
from ltsim.core.arrays import Bools, Floats
from ltsim.core.errors import InputError, option_text, unknown_name_error
from ltsim.core.units import DEGREE, MICROMETRE, MILLIMETRE
from ltsim.physics.effects.linear_effect import LinearEffect
from ltsim.physics.model.construction import declared_construction
from ltsim.planning.layout_rules import broken_rules_text
from ltsim.planning.multistart_search import PlanningProblem
from ltsim.planning.plan_search import SearchCallbacks, make_plan
from ltsim.planning.planner import PlannedNetwork, evaluate_plan
from ltsim.planning.proposals import NextMeasurement
from ltsim.planning.result import Plan, load_plan_and_scenario
from ltsim.planning.search_inputs import plan_without_search
from ltsim.planning.search_space import SearchSpace
from ltsim.planning.site_axes import with_station_poses_on_site
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import PlannedSurvey
from ltsim.planning.tolerances import PointTolerances, check_tolerances, checks_after_required_losses, plan_verdict
from ltsim.recordings import Recording
from ltsim.recordings.exchange import RecordingSource, load_recording
from ltsim.recordings.result_file import ResultSource
from ltsim.simulation.scenario import Scenario

MIN_ALTERNATIVE_DISTANCE = 2.0
"""Smallest horizontal distance [m] of a proposed position of a station from its planned position and from other
proposals."""
MAX_STATION_ALTERNATIVES = 4
"""Largest number of alternative positions that are proposed for a station."""


def plan(
    source: str | Path = "paper-workshop",
    *,
    starts: int | None = None,
    seed: int | None = None,
    jobs: int = 1,
    progress: ProgressCallback = no_progress,
    callbacks: SearchCallbacks | None = None,
    move: Mapping[str, Sequence[float]] | None = None,
) -> Plan:
    """Layout of stations and reflectors, with the reasons for it and the trade-off curve between cost and quality.

    Parameters
    ----------
    source : str or Path
        Plan file, scenario file, name of a built-in plan or scenario, or folder of a plan.
    starts : int, optional
        Number of independent searches; default from the plan file.
    seed : int, optional
        Seed of the random draws of the search; default from the plan file.
    jobs : int
        Number of processes; the plan does not depend on it.
    progress : callable
        Callback with the name of the present task and its finished fraction.
    callbacks : SearchCallbacks, optional
        Callbacks in place of `progress`: for the progress, and for the best layout so far.
    move : mapping, optional
        Positions of stations, x, y, z in mm and yaw in degrees; yaw, or z and yaw, can be omitted. The layout with
        these positions is evaluated, without a search.

    Raises
    ------
    InputError
        If the plan file is not valid, or no layout meets its rules.

    Examples
    --------
    >>> import ltsim as lt
    >>> made = lt.plan("small-plan.toml")
    >>> made.to_dataframe("stations").shape
    (3, 9)
    """
    check_argument_bounds(starts=starts, seed=seed, jobs=jobs, required_argument="jobs")
    check_mapping_argument("move", move)
    file, scenario = load_plan_and_scenario(source)
    if move is not None:
        return Plan.from_network(_plan_with_moved_stations(file, scenario, move))
    search_changes = {key: value for key, value in (("seed", seed), ("starts", starts)) if value is not None}
    file = file.model_copy(update={"search": file.search.model_copy(update=search_changes)})
    return Plan.from_network(make_plan(file, scenario, jobs=jobs, callbacks=callbacks or SearchCallbacks(progress)))


def next_measurement(
    recording: RecordingSource,
    *,
    between: Sequence[str] = (),
    with_effects: str | LinearEffect | Sequence[str | LinearEffect] = (),
    site: str | Path | None = None,
    minutes_per_move: float = DEFAULT_MOVE_TIME / 60.0,
    progress: ProgressCallback = no_progress,
) -> NextMeasurement:
    """Ranking of additional measurements after a recording, and the identified causes of a misfit of its readings.

    Parameters
    ----------
    recording : Recording, str or Path
        Measured or simulated recording.
    between : sequence of str
        Names of two or more effects that explain the recording. Measurements are ranked by the number of effects that
        they distinguish from the first effect, then by effort and time, then by evidence. Without names they are ranked
        by the information that they give on the instrument parameters.
    with_effects : str, Effect or sequence of them
        Effects that the model of the recording already contains, in addition to those of `between`. An effect given by
        name acts on the stations or targets where it fits the residuals best.
    site : str or Path, optional
        Plan file, scenario or folder of a plan. New stations are then proposed only where the floor and the obstacles
        of this plan permit a tripod, and only for visible targets. The network, adjusted with the identified causes in
        its model, is transformed to the axes of this plan by the targets that have names of points of the plan. If
        there are fewer than three such targets, the positions of the stations in `setup.toml` are used.
    minutes_per_move : float
        Time [min] to move the tripod to another position.
    progress : callable
        Callback with the name of the present task and its finished fraction.

    Raises
    ------
    ModelError
        When an effect does not exist, is a noise effect, or cannot be fitted to this recording.
    InputError
        When the axes of the recording are not those of the site, or are not known.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> proposals = lt.next_measurement(recording)
    >>> proposals.proposals[0].remaining_sigma_fraction < 1
    True
    """
    measured = load_recording(recording)
    space = None if site is None else plan_without_search(*load_plan_and_scenario(site))[1]
    construction, source = declared_construction(measured), ResultSource.from_recording(measured)
    visibility_function: VisibilityFunction | None = None
    network = IdentifiedNetwork.from_recording(measured, construction)
    if space is not None:
        measured = with_station_poses_on_site(measured, network.adjustment, space, str(site))
        visibility_function = _visibility_function(space, measured)
        network = IdentifiedNetwork.from_recording(measured, construction)
    extended = ExtendedNetwork.from_adjustment(network.adjustment)
    options: dict[str, Any] = {
        "seconds_per_move": 60.0 * minutes_per_move,
        "visibility_function": visibility_function,
        "progress": progress,
    }
    if len(between) > 1:  # the effects are fitted to the readings as they are, linearised at the identified network
        uncorrected = replace(extended, recording=without_copied_rows(measured)[0]).make_adjustment()
        made = rank_measurements_between(uncorrected, between, with_effects, **options)
    else:
        made = rank_informative_measurements(extended, **options)
    return NextMeasurement.from_ranking(made, source, network.tests, site=str(site or ""))


def _visibility_function(search_space: SearchSpace, recording: Recording) -> VisibilityFunction:
    """Function of positions on a site that returns the targets visible from each; none where no tripod may stand.

    A height outside the permitted range is tolerated if it differs by less than the position tolerance. The stations of
    the recording need no clearance from bodies, because they stood there.
    """
    placed = [p for station in recording.setup.stations.values() if (p := station.position_mm) is not None]
    recorded_positions = np.array(placed, dtype=np.float64).reshape(-1, 3) * MILLIMETRE
    low, high = np.array([area.head_height_range for area in search_space.allowed_areas]).T

    def sights(places: Floats, targets: Floats) -> Bools:
        height = np.clip(places[:, 2], low.min(), high.max())
        is_near = np.abs(height - places[:, 2]) <= search_space.position_tolerance
        standing = np.column_stack([places[:, :2], np.where(is_near, height, places[:, 2])])
        distances = np.linalg.norm(places[:, None] - recorded_positions, axis=2)
        is_new = distances.min(axis=1, initial=np.inf) > search_space.position_tolerance
        is_allowed = search_space.is_allowed(standing, is_new)
        return np.asarray(search_space.is_visible(places, targets) & is_allowed[:, None])

    return sights


@dataclass(frozen=True)
class StationAlternative:
    """Alternative layout for a station that cannot stand at its planned position.

    The station is at another position or is left out; all other stations are unchanged.
    """

    position_text: str
    """Description of the new position of the station, or `without NAME` if the station NAME is left out."""
    survey: PlannedSurvey
    """Planned survey with the alternative layout."""
    verdict: str
    """Sentence with the verdict on the alternative layout."""
    max_tolerance_ratio_or_error: float
    """Largest ratio of point error to tolerance, including losses that must be withstood. Without tolerances it is the
    largest point error [m] that is not exceeded at 95 % confidence."""
    meets_goal: bool
    """True if the layout breaks no rule and meets all tolerances, if there are any."""
    move_option: str = ""
    """Value of the option `--move` that evaluates this alternative; empty for the layout without the station."""


def station_alternatives(source: str | Path, station: str) -> tuple[StationAlternative, ...]:
    """Alternative layouts for a station: without the station, then with it at other positions, the best first.

    Parameters
    ----------
    source : str or Path
        Folder of a plan, plan file or scenario with the planned layout.
    station : str
        Name of the station that cannot stand at its planned position.

    Raises
    ------
    InputError
        When there is no such station, or no position for it on the floor.
    """
    named, scenario = load_plan_and_scenario(source)
    file, site = plan_without_search(named, scenario)
    problem, survey = PlanningProblem(file, scenario), site.survey
    station_index = _station_index(survey, station)
    other_stations = [s for s in range(len(survey.station_positions)) if s != station_index]
    work = problem.make_searcher(
        site.replace(survey=survey, fixed_station_indices=tuple(other_stations), min_sights_per_target=0)
    )
    table = work.normal_blocks_of_grid(station_index)
    objectives = work.replacement_objectives(
        work.normal_blocks_of_layout(survey.station_positions, survey.station_yaws), station_index, table
    )
    objectives[
        _horizontal_distances(table.setup_positions, survey.station_positions[station_index]) < MIN_ALTERNATIVE_DISTANCE
    ] = np.inf
    # Sights of points with a tolerance that would be missing decide first.
    demanded = PointTolerances.from_plan_file(file).tolerance_by_point_m or survey.target_names
    asked = np.array([name in demanded for name in survey.target_names])
    lacking = np.maximum(
        site.min_sights_per_target - survey.is_visible[other_stations].sum(axis=0) - table.is_visible, 0
    )[:, asked].sum(axis=1)
    alternatives: list[StationAlternative] = []
    for best in np.lexsort((objectives, lacking)).tolist():
        near = [
            _horizontal_distances(table.setup_positions[[best]], option_.survey.station_positions[station_index])[0]
            < MIN_ALTERNATIVE_DISTANCE
            for option_ in alternatives
        ]
        if len(alternatives) == MAX_STATION_ALTERNATIVES or not np.isfinite(objectives[best]) or any(near):
            continue
        position, yaw = survey.station_positions.copy(), survey.station_yaws.copy()
        position[station_index], yaw[station_index] = table.setup_positions[best], table.setup_yaws[best]
        there = survey.replace(station_positions=position, station_yaws=yaw, is_visible=site.is_visible(position))
        yaw_deg = yaw[station_index] / DEGREE
        words = f"{_station_position_text(station, position[station_index])}, turned by {yaw_deg:.0f} deg"
        x, y, z = position[station_index] / MILLIMETRE
        move = f"{station}={x:.1f},{y:.1f},{z:.1f},{yaw_deg:g}"
        alternatives.append(_evaluate_alternative(problem, site, there, words, move))
    alone = _evaluate_alternative(problem, site, survey.without_station(station_index), f"without {station}")
    return (
        alone,
        *sorted(alternatives, key=lambda option_: (not option_.meets_goal, option_.max_tolerance_ratio_or_error)),
    )


def _plan_with_moved_stations(
    plan: PlanFile, scenario: Scenario, new_positions: Mapping[str, Sequence[float]]
) -> PlannedNetwork:
    """Planned network with stations at new positions; `new_positions` holds x, y, z [mm] and yaw [deg] by station name.

    If yaw, or z and yaw, are missing, the planned values are used. Raises InputError for a position where no tripod may
    stand.
    """
    file, site = plan_without_search(plan, scenario)
    survey = site.survey
    position, yaw = survey.station_positions.copy(), survey.station_yaws.copy()
    for name, given in new_positions.items():
        station_index, place = _station_index(survey, name), _position_numbers(name, given)
        position[station_index, : len(place[:3])] = place[:3] * MILLIMETRE
        yaw[station_index] = place[3] * DEGREE if len(place) == 4 else yaw[station_index]
    survey = survey.replace(station_positions=position, station_yaws=yaw)
    wrong = [rule for rule in site.broken_position_rules(survey) if {*rule.stations} & {*new_positions}]
    if wrong:
        raise InputError(f"{option_text('move')}: {broken_rules_text(wrong)}")
    network = evaluate_plan(file, scenario, survey.replace(is_visible=site.is_visible(position)))
    return replace(network, plan_file=plan)


def _position_numbers(name: str, position: object) -> Floats:
    """Numbers of a new position of the station `name`: x and y [mm], then z [mm] and yaw [deg] if they are given.

    Raises InputError if `position` has other content.
    """
    words = np.ravel(np.asarray(position, dtype=object)).tolist()
    try:
        place = np.array(words, dtype=np.float64)
    except (TypeError, ValueError):
        place = np.zeros(0)
    if not 2 <= len(place) <= 4 or not np.all(np.abs(place) <= MAX_MAPPING_ARGUMENT_MAGNITUDE):
        raise InputError(
            f"{option_text('move')} {name}={','.join(map(str, words))}: expected {STATION_POSITION_SYNTAX}"
        )
    return place


def _station_position_text(station: str, place: Floats) -> str:
    """Text with the name of a station and its position `place` (3,) [m]."""
    x, y, z = place
    return f"{station} at ({x:.2f}, {y:.2f}, {z:.2f}) m"


def _horizontal_distances(places: Floats, place: Floats) -> Floats:
    """Horizontal distances (N,) [m] between N positions `places` (N, 3) [m] and the position `place` (3,) [m]."""
    return np.linalg.norm(places[:, :2] - place[:2], axis=1)


def _station_index(survey: PlannedSurvey, name: str) -> int:
    """Index of the station `name` in the survey; raises InputError for an unknown name."""
    if name not in survey.station_names:
        raise InputError(str(unknown_name_error("station", name, survey.station_names)))
    return survey.station_names.index(name)


def _evaluate_alternative(
    problem: PlanningProblem, search_space: SearchSpace, survey: PlannedSurvey, description: str, move: str = ""
) -> StationAlternative:
    """Alternative with the layout of `survey`, and its verdict by the rules and tolerances of the plan.

    Without tolerances the verdict reports the worst point. `description` is the text of the new position, `move` the
    value of the option `--move`.
    """
    demands, built, broken = (
        PointTolerances.from_plan_file(problem.plan_file),
        problem.construction,
        search_space.broken_rules(survey),
    )
    if demands:
        check = check_tolerances(survey, demands, built)
        losses = checks_after_required_losses(survey, demands, built)
        ratio = max(
            [
                check.max_tolerance_ratio,
                *([loss.max_tolerance_ratio for loss in losses] if demands.loss_to_withstand != "no" else []),
            ]
        )
        judgement = plan_verdict(demands, check, losses, broken)
        return StationAlternative(description, survey, judgement.sentences, ratio, judgement.is_goal_reached, move)
    check = check_tolerances(survey, PointTolerances(dict.fromkeys(survey.target_names, np.inf)), built)
    rules = f"it breaks a rule ({broken_rules_text(broken)}); " if broken else ""
    if not check.error_by_point_m or check.unseen_points:
        return StationAlternative(description, survey, rules + check.violations_clause, np.inf, False, move)
    worst_point = max(check.error_by_point_m, key=lambda name: check.error_by_point_m[name])
    worst_error = check.error_by_point_m[worst_point]
    text = f"{rules}worst point {worst_point}: error at most {worst_error / MICROMETRE:.1f} um at 95 % confidence"
    return StationAlternative(description, survey, text, worst_error, not broken, move)
