"""Sentences for users on the result of planning and the reasons for it, with numbers."""

from collections import Counter
from collections.abc import Sequence
from itertools import groupby

import numpy as np

from ltsim.adjustment.coordinate_uncertainty import longest_range, relevant_air_uncertainty
from ltsim.core.errors import NetworkError
from ltsim.core.notation import names_text
from ltsim.core.units import MICROMETRE, MILLIMETRE
from ltsim.physics.effects.air import air_uncertainty_text
from ltsim.planning.expected_precision import ExpectedPrecision
from ltsim.planning.layout_rules import MAX_NAMES_IN_RULE_TEXT, broken_rules_text
from ltsim.planning.objective import (
    DIAGNOSIS_QUALITY_NAME,
    INSTRUMENT_QUALITY_NAME,
    QUALITY_PHRASES,
    TARGETS_QUALITY_NAME,
    LayoutObjective,
)
from ltsim.planning.plan_entries import PlannedParameterEntry
from ltsim.planning.planner import (
    LayoutEvaluation,
    PlannedNetwork,
    StationCountResult,
    TradeoffPoint,
    objective_and_qualities,
)
from ltsim.planning.search_inputs import layout_objective
from ltsim.planning.tolerances import is_tolerance_met, loss_sentences, text_distinct_from_limit

CRITERION_PHRASES = {
    "D": "in the geometric mean over all combinations (D-optimality)",
    "A": "in the root mean square over all parameters (A-optimality)",
    "E": "in the worst combination (E-optimality)",
}
"""Phrase for users on each optimality criterion (D, A, E) of the instrument parameters."""


def reason_sentences(plan: PlannedNetwork) -> list[str]:
    """Sentences on a plan: first its result, then the reasons for its layout, its limits and alternatives."""
    sentences = [
        *_result_sentences(plan),
        *_tolerance_sentences(plan),
        *_reference_layout_sentences(plan),
        *_station_contribution_sentences(plan),
    ]
    return [
        *sentences,
        *_air_error_sentences(plan),
        *_limiting_rule_sentences(plan),
        *_tradeoff_sentences(plan),
        *_undetermined_sentences(plan),
        *_search_sentences(plan),
    ]


def _weighted_qualities_text(plan: PlannedNetwork) -> str:
    """Text with the value of each quality that has a weight in the plan's goal."""
    templates = {
        INSTRUMENT_QUALITY_NAME: "instrument parameters known to {:.3f} of their prior sigma "
        + CRITERION_PHRASES[plan.plan_file.goal.criterion],
        DIAGNOSIS_QUALITY_NAME: "effects detectable from {:.2f} of their plausible size (geometric mean)",
    }
    return ", ".join(
        _target_rms_text(plan.layout, value) if name == TARGETS_QUALITY_NAME else templates[name].format(value)
        for name, value in plan.layout.qualities.items()
    )


def _target_rms_text(layout: LayoutEvaluation, weighted_rms: float) -> str:
    """Text with the root mean square point error of a layout, and the weighted one [m] if weights of targets differ."""
    text = (
        f"targets known to {layout.expected_precision.target_rms / MICROMETRE:.1f} um (root mean square of all points"
    )
    weighted = f"; {_quality_value_text(TARGETS_QUALITY_NAME, weighted_rms)} in the search"
    return f"{text}{weighted if layout.survey.target_weights else ''})"


def _result_sentences(plan: PlannedNetwork) -> list[str]:
    """Sentences with the extent and the qualities of the planned layout, and the verdict or the worst point."""
    work = f"{plan.layout.survey.extent_text}; {_weighted_qualities_text(plan)}"
    if plan.verdict is not None:
        return [f"{plan.verdict.sentences}.", f"{work}."]
    sigma = plan.layout.expected_precision.target_point_errors
    worst_index = int(np.argmax(sigma))
    name = plan.layout.survey.target_names[worst_index]
    broken = (
        f"The layout breaks a rule of the plan: {broken_rules_text(plan.layout.broken_rules)}. "
        if plan.layout.broken_rules
        else ""
    )
    sigma_text = f"{sigma[worst_index] / MICROMETRE:.1f} um"
    return [f"{broken}{work}. The plan has no tolerance; the worst point is {name} (sigma {sigma_text})."]


def _tolerance_sentences(plan: PlannedNetwork) -> list[str]:
    return [] if plan.tolerance_check is None else [*_station_count_sentences(plan), *loss_sentences(plan.loss_checks)]


def _station_count_sentences(plan: PlannedNetwork) -> list[str]:
    """Sentences on the numbers of stations for which layouts were searched, with the result for each number."""
    if not plan.station_count_results:
        return []
    *fewer, last = plan.station_count_results
    outcomes = _station_count_clauses(fewer, plan.search_space.min_sights_per_target)
    meets_tolerance = last.max_tolerance_ratio is not None and is_tolerance_met(last.max_tolerance_ratio)
    n_stations = len(plan.layout.survey.station_positions)
    sentences = (
        [f"{last.n_stations} stations are the fewest for which the search found a layout that meets the tolerances."]
        if meets_tolerance
        else []
    )
    if not meets_tolerance:
        sentences = [
            f"The search found no layout with {plan.station_count_results[0].n_stations} to "
            f"{last.n_stations} stations that meets the "
            f"tolerances (closest: {n_stations} stations)."
        ]
        if not plan.is_stopped:
            if last.n_stations < plan.plan_file.stations.max_count:
                sentences.append("More stations were not searched, because the last two hardly reduced the error.")
            sentences.append("Try more floor area, more rounds or wider tolerances.")
        outcomes = _station_count_clauses(plan.station_count_results, plan.search_space.min_sights_per_target)
    sentences += [f"Searched: {'; '.join(outcomes)}."] if outcomes else []
    return [
        *sentences,
        f"Layouts with fewer than {plan.station_count_results[0].n_stations} stations were not searched.",
    ]


def _station_count_clauses(results: Sequence[StationCountResult], min_stations: int) -> list[str]:
    """Clauses with the result for each number of stations, where `min_stations` stations must see each point.

    Numbers with equal results share a clause.
    """

    def result_text(count_result: StationCountResult) -> str:
        if count_result.max_tolerance_ratio is not None and np.isfinite(count_result.max_tolerance_ratio):
            ratio_text = text_distinct_from_limit(count_result.max_tolerance_ratio, 1.0)
            return f"the best layout has an error of {ratio_text} times its tolerance"
        if count_result.has_layout:
            return "the best layout does not determine every point"
        return f"no layout has every point in sight of {min_stations} station{'s' if min_stations > 1 else ''}"

    def counts_clause(text: str, results: Sequence[StationCountResult]) -> str:
        first, last = results[0].n_stations, results[-1].n_stations
        nearest = (
            f" (the closest layout lacks sights of {results[-1].points_lacking_sights_text})"
            if results[-1].points_lacking_sights_text
            else ""
        )
        return f"{first}{f' to {last}' if last > first else ''} stations: {text}{nearest}"

    return [counts_clause(text, list(same)) for text, same in groupby(results, key=result_text)]


def _air_error_sentences(plan: PlannedNetwork) -> list[str]:
    """Sentence on the uncertainty of the air that the point errors include, in a list; empty if it is neglected."""
    adjustment = plan.layout.expected_precision.adjustment
    air = relevant_air_uncertainty(adjustment)
    if air is None:
        return []
    words = air_uncertainty_text(air, longest_range(adjustment))
    return [f"All point errors include the {words}; change these values in the table [air] of the plan."]


def _reference_layout_sentences(plan: PlannedNetwork) -> list[str]:
    """Sentences that compare the planned layout with the layout in the scenario."""
    reference, chosen = plan.scenario_layout_evaluation, plan.layout
    if plan.plan_file.workshop is not None:
        return []
    if reference is None:
        return ["The scenario's layout does not determine its poses and targets; the layout of the plan does."]
    sentences = []
    if reference.broken_rules:
        lost = reference.visibility.invisible_pair_sentences(
            reference.survey.station_names, reference.survey.target_names
        )
        why = f" ({lost[0]}{', and more' if len(lost) > 1 else ''})" if lost else ""
        sentences.append(
            f"The scenario's layout breaks rules of the plan: {broken_rules_text(reference.broken_rules)}{why}."
        )
    for name in [name for name in chosen.qualities if name in reference.qualities]:
        factor = reference.qualities[name] / chosen.qualities[name]
        sentences.append(
            f"Compared with the scenario's layout of {len(reference.survey.station_positions)} stations, "
            f"measured in the same way, {QUALITY_PHRASES[name]} is {max(factor, 1 / factor):.2f} times "
            f"{'better' if factor >= 1 else 'worse'} ({_quality_value_text(name, reference.qualities[name])} there)."
        )
    sentences += _parameter_sigma_sentences(reference, chosen)
    if reference.expected_disagreement is not None and chosen.expected_disagreement is not None:
        a, b = reference.expected_disagreement, chosen.expected_disagreement
        sentences.append(
            "For errors within the specification, calibration is expected to reduce the disagreement of the stations "
            f"in the distances between targets by {b.distance_improvement[0]:.0f} % and in the coordinates of targets "
            f"by {b.coordinate_improvement[0]:.0f} % (scenario's layout: {a.distance_improvement[0]:.0f} % and "
            f"{a.coordinate_improvement[0]:.0f} %)."
        )
    return sentences


def _quality_value_text(name: str, value: float) -> str:
    """Text with the value of the quality `name`: the point error of targets in um, other qualities without unit."""
    return f"weighted point error {value / MICROMETRE:.1f} um" if name == TARGETS_QUALITY_NAME else f"{value:.3f}"


def _parameter_sigma_sentences(reference: LayoutEvaluation, evaluation: LayoutEvaluation) -> list[str]:
    """Sentences on the parameters whose sigma differs most between `evaluation` and the layout in the scenario."""
    entry_pairs = list(
        zip(
            PlannedParameterEntry.from_expected_precision(reference.expected_precision),
            PlannedParameterEntry.from_expected_precision(evaluation.expected_precision),
            strict=True,
        )
    )
    entry_pairs.sort(key=lambda pair: pair[0].sigma / pair[1].sigma, reverse=True)
    words = [(b.sigma / a.sigma, f"{a.name} {b.sigma:.3g} to {a.sigma:.3g} {a.unit}") for b, a in entry_pairs]
    gained = [text for ratio, text in words[:4] if ratio > 1.05]
    worse_texts = [text for ratio, text in words[::-1][:3] if ratio < 0.95]
    sentences = (
        [f"Parameters whose sigma is reduced most, relative to the scenario's layout: {'; '.join(gained)}."]
        if gained
        else []
    )
    return sentences + (
        [f"Parameters whose sigma increases, relative to the scenario's layout: {'; '.join(worse_texts)}."]
        if worse_texts
        else []
    )


def _station_contribution_sentences(plan: PlannedNetwork) -> list[str]:
    """Sentence for each station with the loss of quality without it, and the parameter whose sigma grows most."""
    survey, now, qualities = plan.layout.survey, plan.layout.expected_precision, plan.layout.qualities
    objective, sentences = LayoutObjective({INSTRUMENT_QUALITY_NAME: 1.0}, plan.plan_file.goal.criterion), []
    for s, name in enumerate(survey.station_names):
        remaining = survey.without_station(s)
        try:
            without = ExpectedPrecision.from_survey(remaining, now.construction)
        except NetworkError as problem:
            sentences.append(f"{name} is indispensable: without it, {problem}.")
            continue
        if INSTRUMENT_QUALITY_NAME in qualities:
            worse = (
                objective_and_qualities(remaining, objective, now.construction)[0] / qualities[INSTRUMENT_QUALITY_NAME]
            )
        else:
            worse = without.weighted_target_rms / now.weighted_target_rms
        ratio = without.instrument_sigmas / now.instrument_sigmas
        most = int(np.argmax(ratio))
        x, y, _ = survey.station_positions[s]
        sentences.append(
            f"Without {name} at ({x:.2f}, {y:.2f}) m the quality is {100 * (worse - 1):.0f} % worse; the sigma of "
            f"{now.construction.parameter_names[most]} grows most, by {100 * (ratio[most] - 1):.0f} %."
        )
    return sentences


def _limiting_rule_sentences(plan: PlannedNetwork) -> list[str]:
    """Sentences on rules and circumstances that limit the layout: spacing, edge of the floor, sights, obstacles."""
    survey, site = plan.layout.survey, plan.search_space
    names, sentences = survey.station_names, site.spacing_limit_sentences(survey)
    steps = 0.03 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    edge = [
        name
        for name, place in zip(names, survey.station_positions, strict=True)
        if site.is_allowed(place[None], False)[0] and not site.is_allowed(place + steps, False).all()
    ]
    if edge:
        verb = "stands" if len(edge) == 1 else "stand"
        sentences.append(
            f"{', '.join(edge)} {verb} at the edge of the allowed floor; a larger floor there may improve the layout."
        )
    sentences += site.clearance_limit_sentences(survey)
    if site.min_sights_per_target < len(names):
        least = survey.is_visible.sum(axis=0).min()
        sentences.append(f"Every reflector is visible from at least {least} station{'s' if least > 1 else ''}.")
    if site.obstacles is not None:
        depth = np.linalg.norm(site.obstacles.moved_to_surface(survey.target_points) - survey.target_points, axis=1)
        if under := [name for name, d in zip(survey.target_names, depth, strict=True) if d]:
            sentences.append(
                f"{names_text(under, MAX_NAMES_IN_RULE_TEXT)} lie up to {depth.max() / MILLIMETRE:.2g} mm inside a "
                "curved body, within the tolerance of its mesh, and are treated as on its surface."
            )
    sentences += plan.layout.blocked_sight_sentences()
    sentences += plan.layout.marginal_sight_sentences(site.position_tolerance)
    return sentences


def _has_same_procedure(plan: PlannedNetwork, option: TradeoffPoint) -> bool:
    """True if the point `option` of the trade-off curve has the same faces and rounds as the plan."""
    survey = plan.layout.survey
    return option.survey.faces == survey.faces and option.survey.repeats == survey.repeats


def fewest_stations_not_worse_than_scenario(plan: PlannedNetwork) -> TradeoffPoint | None:
    """Point of the trade-off curve with the fewest stations whose objective is at most that of the scenario's layout.

    Only points with the faces and rounds of the plan are compared. None if there is no such point.
    """
    if plan.scenario_layout_evaluation is None or not plan.scenario_layout_evaluation.qualities:
        return None
    goal = _objective_of_scenario_layout(plan)
    equal_options = [o for o in plan.tradeoff_points if _has_same_procedure(plan, o) and o.objective_value <= goal]
    return min(equal_options, key=lambda o: (len(o.survey.station_positions), o.objective_value), default=None)


def _tradeoff_sentences(plan: PlannedNetwork) -> list[str]:
    """Sentences on fewer stations that match the scenario's quality, and on the additional time of a better layout."""
    sentences, few, reference = [], fewest_stations_not_worse_than_scenario(plan), plan.scenario_layout_evaluation
    if (
        few is not None
        and reference is not None
        and len(few.survey.station_positions) < len(reference.survey.station_positions)
    ):
        goal = " ".join(plan.layout.qualities)
        sentences.append(
            f"{len(few.survey.station_positions)} stations suffice to match the "
            f"{len(reference.survey.station_positions)} of the "
            f"scenario's layout ({_quality_value_text(goal, few.objective_value)} against "
            f"{_quality_value_text(goal, _objective_of_scenario_layout(plan))}) in {few.hours:.1f} h."
        )
    n_stations = len(plan.layout.survey.station_positions)
    now = next(
        (
            o
            for o in plan.tradeoff_points
            if len(o.survey.station_positions) == n_stations and _has_same_procedure(plan, o)
        ),
        None,
    )
    dearer = [
        o
        for o in plan.tradeoff_points
        if o.is_efficient and now is not None and o.objective_value < 0.95 * now.objective_value
    ]
    if now is not None and dearer:
        best = min(dearer, key=lambda o: o.hours)
        faces = "both faces" if len(best.survey.faces) == 2 else "one face"
        rounds = f"{best.survey.repeats} round{'s' if best.survey.repeats > 1 else ''}"
        change = best.hours - now.hours
        time = f"{abs(60 * change):.0f} min {'more' if change > 0 else 'less'}"
        sentences.append(
            f"A layout of {len(best.survey.station_positions)} stations, {faces}, {rounds} is "
            f"{now.objective_value / best.objective_value:.1f} times better and takes {time}."
        )
    return sentences


def _objective_of_scenario_layout(plan: PlannedNetwork) -> float:
    """Value of the plan's objective for the layout in the scenario; infinite without an evaluation of that layout."""
    if plan.scenario_layout_evaluation is None:
        return float("inf")
    survey = plan.scenario_layout_evaluation.survey
    return objective_and_qualities(
        survey, layout_objective(plan.plan_file, survey), plan.layout.expected_precision.construction
    )[0]


def _undetermined_sentences(plan: PlannedNetwork) -> list[str]:
    """Sentence on undetermined combinations of parameters and on the best further measurement, as a list; or empty."""
    information = plan.layout.expected_precision
    count = len(information.undetermined_combinations)
    if not count:
        return []
    phrase = f"{count} combination{'s' if count > 1 else ''} of instrument parameters {'are' if count > 1 else 'is'}"
    measured = Counter(m.instruction for m in information.measurements_for_undetermined() if m.instruction)
    cure = f"; to determine most of them, {measured.most_common(1)[0][0]}" if measured else ""
    return [f"{phrase} not determined by this layout (see the table of undetermined combinations){cure}."]


def _search_sentences(plan: PlannedNetwork) -> list[str]:
    """Sentence, in a list, on how well the results of independent searches from several initial layouts agree."""
    n_searches = len(plan.start_objectives)
    if plan.is_stopped:
        return ["The search was stopped; this is the best layout that it had found."]
    if n_searches < 2:
        return []
    n_searches_near_best = sum(value < 1.02 * plan.start_objectives[0] for value in plan.start_objectives)
    return [
        f"{n_searches_near_best} of {n_searches} independent searches ended within 2 % of the best objective; the "
        f"worst objective is {plan.start_objectives[-1] / plan.start_objectives[0]:.2f} times the best; "
        + (
            "a much better layout is unlikely."
            if n_searches_near_best > 1
            else "a larger search.starts may give a better layout."
        )
    ]
