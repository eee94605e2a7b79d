"""Sentences on the reasons for a plan, each with its number."""

from collections import Counter
from collections.abc import Sequence
from itertools import groupby

import numpy as np

from ltsim.adjustment.unmodelled import longest_range, relevant_air
from ltsim.core.errors import NetworkError
from ltsim.core.notation import listing
from ltsim.core.units import MICROMETRE, MILLIMETRE
from ltsim.physics.effects.air import air_uncertainty_text
from ltsim.planning.information import LayoutInformation
from ltsim.planning.objective import DIAGNOSIS, INSTRUMENT, TARGETS, Objective
from ltsim.planning.plan_entries import PlannedParameterEntry
from ltsim.planning.planner import LayoutEvaluation, PlannedNetwork, StationCountResult, TradeoffPoint, measure
from ltsim.planning.site import MAX_NAMED, too_near, words_of
from ltsim.planning.tolerances import is_met, loss_sentences, text_near_limit
from ltsim.planning.workshop import objective_of

GAIN = " (gain "
"""Text before the gain of a measurement; a sentence without it names no measurement."""
CRITERION_WORDS = {
    "D": "in the geometric mean of all combinations (D)",
    "A": "in the root mean square (A)",
    "E": "in the worst combination (E)",
}


def reasons(plan: PlannedNetwork) -> list[str]:
    """Sentences on the reasons for a plan, the result first."""
    sentences = [*_headline(plan), *_tolerances(plan), *_against_reference(plan), *_what_each_station_does(plan)]
    return [*sentences, *_air(plan), *_limits(plan), *_curve(plan), *_undetermined(plan), *_search(plan)]


def _quality_words(plan: PlannedNetwork) -> str:
    templates = {
        INSTRUMENT: "instrument parameters known to {:.3f} of their prior sigma "
        + CRITERION_WORDS[plan.file.goal.criterion],
        TARGETS: "targets known to {:.1f} um (root mean square)",
        DIAGNOSIS: "effects detectable from {:.2f} of their plausible size (geometric mean)",
    }
    factor = {TARGETS: 1.0 / MICROMETRE}
    return ", ".join(
        templates[name].format(factor.get(name, 1.0) * value) for name, value in plan.chosen.qualities.items()
    )


def _headline(plan: PlannedNetwork) -> list[str]:
    work = f"{plan.chosen.survey.words}; {_quality_words(plan)}"
    if plan.verdict is not None:
        return [f"{plan.verdict.words}.", f"{work}."]
    sigma = plan.chosen.information.target_sigma
    worst = int(np.argmax(sigma))
    name = plan.chosen.survey.target_names[worst]
    broken = f"The layout breaks a rule of the plan: {words_of(plan.chosen.broken)}. " if plan.chosen.broken else ""
    size = _shown(TARGETS, sigma[worst])
    return [f"{broken}{work}. The plan has no tolerance; the worst point is {name} (sigma {size})."]


def _tolerances(plan: PlannedNetwork) -> list[str]:
    return [] if plan.check is None else [*_numbers(plan), *loss_sentences(plan.losses)]


def _numbers(plan: PlannedNetwork) -> list[str]:
    """Sentences on the numbers of stations that were searched, with the result of each."""
    if not plan.tried:
        return []
    *fewer, last = plan.tried
    outcomes = _came_of(fewer, plan.site.min_sights)
    good = last.ratio is not None and is_met(last.ratio)
    count = len(plan.chosen.survey.position)
    sentences = (
        [f"{last.stations} stations are the fewest for which the search found a layout that meets the tolerances."]
        if good
        else []
    )
    if not good:
        sentences = [
            f"The search found no layout with {plan.tried[0].stations} to {last.stations} stations that meets the "
            f"tolerances (closest: {count} stations)."
        ]
        if not plan.stopped:
            if last.stations < plan.file.stations.max_count:
                sentences.append("More stations were not searched, because the last two hardly reduced the error.")
            sentences.append("Try more floor area, more rounds or wider tolerances.")
        outcomes = _came_of(plan.tried, plan.site.min_sights)
    sentences += [f"Searched: {'; '.join(outcomes)}."] if outcomes else []
    return [*sentences, f"Layouts with fewer than {plan.tried[0].stations} stations were not searched."]


def _came_of(tried: Sequence[StationCountResult], least: int) -> list[str]:
    """Clauses on the result for each number of stations; equal results are joined."""

    def words(outcome: StationCountResult) -> str:
        if outcome.ratio is not None and np.isfinite(outcome.ratio):
            return f"the best layout has an error of {text_near_limit(outcome.ratio, 1.0)} times its tolerance"
        if outcome.has_layout:
            return "the best layout does not determine every point"
        return f"no layout has every point in sight of {least} station{'s' if least > 1 else ''}"

    def came_of(text: str, same: Sequence[StationCountResult]) -> str:
        first, last = same[0].stations, same[-1].stations
        nearest = f" (the closest layout lacks sights of {same[-1].lacking})" if same[-1].lacking else ""
        return f"{first}{f' to {last}' if last > first else ''} stations: {text}{nearest}"

    return [came_of(text, list(same)) for text, same in groupby(tried, key=words)]


def _air(plan: PlannedNetwork) -> list[str]:
    """Sentence on the uncertainty of the air that the results include."""
    adjustment = plan.chosen.information.adjustment
    air = relevant_air(adjustment)
    if air is None:
        return []
    words = air_uncertainty_text(air, longest_range(adjustment))
    return [f"All point errors include the {words}; change it as [air] of the plan."]


def _against_reference(plan: PlannedNetwork) -> list[str]:
    reference, chosen = plan.reference, plan.chosen
    if plan.file.workshop is not None:
        return []
    if reference is None:
        return ["The scenario's layout does not determine its poses and targets; the layout of the plan does."]
    sentences = []
    if reference.broken:
        lost = reference.table.lost(reference.survey.station_names, reference.survey.target_names)
        why = f" ({lost[0]}{', and more' if len(lost) > 1 else ''})" if lost else ""
        sentences.append(f"The scenario's layout breaks rules of the plan: {words_of(reference.broken)}{why}.")
    for name in [name for name in chosen.qualities if name in reference.qualities]:
        factor = reference.qualities[name] / chosen.qualities[name]
        sentences.append(
            f"Compared with the scenario's layout of {len(reference.survey.position)} stations, measured in the same "
            f"way, the quality of {name} is {max(factor, 1 / factor):.2f} times "
            f"{'better' if factor >= 1 else 'worse'} ({_shown(name, reference.qualities[name])} there)."
        )
    sentences += _parameters(reference, chosen)
    if reference.expected is not None and chosen.expected is not None:
        a, b = reference.expected, chosen.expected
        sentences.append(
            "For errors within the specification, calibration is expected to reduce the paper's distance "
            f"criterion by {b.distance_improvement[0]:.0f} % and the coordinate criterion by "
            f"{b.coordinate_improvement[0]:.0f} % (scenario's layout: {a.distance_improvement[0]:.0f} % and "
            f"{a.coordinate_improvement[0]:.0f} %)."
        )
    return sentences


def _shown(name: str, value: float) -> str:
    return f"{value / MICROMETRE:.1f} um" if name == TARGETS else f"{value:.3f}"


def _parameters(reference: LayoutEvaluation, chosen: LayoutEvaluation) -> list[str]:
    pairs = list(
        zip(PlannedParameterEntry.of(reference.information), PlannedParameterEntry.of(chosen.information), strict=True)
    )
    pairs.sort(key=lambda pair: pair[0].sigma / pair[1].sigma, reverse=True)
    words = [(b.sigma / a.sigma, f"{a.name} {b.sigma:.3g} to {a.sigma:.3g} {a.unit}") for b, a in pairs]
    gained = [text for ratio, text in words[:4] if ratio > 1.05]
    lost = [text for ratio, text in words[::-1][:3] if ratio < 0.95]
    sentences = [f"Parameters whose sigma falls most: {'; '.join(gained)}."] if gained else []
    return sentences + ([f"Parameters whose sigma rises: {'; '.join(lost)}."] if lost else [])


def _what_each_station_does(plan: PlannedNetwork) -> list[str]:
    """Sentences on the loss of quality without each station, and the parameter that is affected most."""
    survey, now, qualities = plan.chosen.survey, plan.chosen.information, plan.chosen.qualities
    objective, sentences = Objective({INSTRUMENT: 1.0}, plan.file.goal.criterion), []
    for s, name in enumerate(survey.station_names):
        remaining = survey.without(s)
        try:
            without = LayoutInformation.of(remaining, now.construction)
        except NetworkError as problem:
            sentences.append(f"{name} is indispensable: without it, {problem}.")
            continue
        if INSTRUMENT in qualities:
            worse = measure(remaining, objective, now.construction)[0] / qualities[INSTRUMENT]
        else:
            worse = without.target_rms / now.target_rms
        ratio = without.instrument_sigma / now.instrument_sigma
        most = int(np.argmax(ratio))
        x, y, _ = survey.position[s]
        sentences.append(
            f"Without {name} at ({x:.2f}, {y:.2f}) m the quality is {100 * (worse - 1):.0f} % worse, most for "
            f"{now.construction.parameter_names[most]} (sigma {100 * (ratio[most] - 1):.0f} % larger)."
        )
    return sentences


def _limits(plan: PlannedNetwork) -> list[str]:
    """Sentences on rules that limit the layout: floor, elevation, spacing."""
    survey, site = plan.chosen.survey, plan.site
    names, sentences = survey.station_names, []
    near = too_near(survey.position[None], 1.02 * site.spacing) & ~too_near(survey.position[None], site.spacing)
    close = [(names[i], names[j]) for i, j in np.argwhere(near[0]).tolist()]
    if close:
        pairs = ", ".join(f"{first} and {second}" for first, second in close)
        sentences.append(f"{pairs} are at the minimum spacing of {site.spacing:g} m.")
    steps = 0.03 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    edge = [
        name
        for name, place in zip(names, survey.position, strict=True)
        if site.allowed(place[None])[0] and not site.allowed(place + steps).all()
    ]
    if edge:
        verb = "stands" if len(edge) == 1 else "stand"
        sentences.append(
            f"{', '.join(edge)} {verb} at the edge of the allowed floor; a larger floor there may improve the layout."
        )
    if site.min_sights < len(names):
        least = survey.visible.sum(axis=0).min()
        sentences.append(f"Every reflector is visible from at least {least} station{'s' if least > 1 else ''}.")
    if site.obstacles is not None:
        depth = np.linalg.norm(site.obstacles.moved_to_surface(survey.points) - survey.points, axis=1)
        if under := [name for name, d in zip(survey.target_names, depth, strict=True) if d]:
            sentences.append(
                f"{listing(under, MAX_NAMED)} lie up to {depth.max() / MILLIMETRE:.2g} mm inside a curved body, "
                "within the tolerance of its mesh, and are treated as on its surface."
            )
    lost = plan.chosen.table.lost(names, survey.target_names)
    if lost:
        more = "; and more" if len(lost) > 3 else ""
        sentences.append(f"{len(lost)} sights are blocked: {'; '.join(lost[:3])}{more}.")
    return sentences


def _same_way(plan: PlannedNetwork, option: TradeoffPoint) -> bool:
    chosen = plan.chosen.survey
    return option.survey.faces == chosen.faces and option.survey.repeats == chosen.repeats


def fewest(plan: PlannedNetwork) -> TradeoffPoint | None:
    """Trade-off point with the fewest stations that is as good as the scenario's layout, measured in the same way."""
    if plan.reference is None or not plan.reference.qualities:
        return None
    goal = _reference_value(plan)
    good = [o for o in plan.options if _same_way(plan, o) and o.value <= goal]
    return min(good, key=lambda o: (len(o.survey.position), o.value), default=None)


def _curve(plan: PlannedNetwork) -> list[str]:
    """Sentences on fewer stations that are sufficient, and on the cost of a better layout."""
    sentences, few, reference = [], fewest(plan), plan.reference
    if few is not None and reference is not None and len(few.survey.position) < len(reference.survey.position):
        goal = " ".join(plan.chosen.qualities)
        sentences.append(
            f"{len(few.survey.position)} stations suffice to match the {len(reference.survey.position)} of the "
            f"scenario's layout ({_shown(goal, few.value)} against {_shown(goal, _reference_value(plan))}) in "
            f"{few.hours:.1f} h."
        )
    count = len(plan.chosen.survey.position)
    now = next((o for o in plan.options if len(o.survey.position) == count and _same_way(plan, o)), None)
    dearer = [o for o in plan.options if o.efficient and now is not None and o.value < 0.95 * now.value]
    if now is not None and dearer:
        best = min(dearer, key=lambda o: o.hours)
        faces = "both faces" if len(best.survey.faces) == 2 else "one face"
        rounds = f"{best.survey.repeats} round{'s' if best.survey.repeats > 1 else ''}"
        change = best.hours - now.hours
        time = f"{abs(60 * change):.0f} min {'more' if change > 0 else 'less'}"
        sentences.append(
            f"A layout of {len(best.survey.position)} stations, {faces}, {rounds} is {now.value / best.value:.1f} "
            f"times better and takes {time}."
        )
    return sentences


def _reference_value(plan: PlannedNetwork) -> float:
    if plan.reference is None:
        return float("inf")
    survey = plan.reference.survey
    return measure(survey, objective_of(plan.file, survey), plan.chosen.information.construction)[0]


def _undetermined(plan: PlannedNetwork) -> list[str]:
    """Sentences on the number of undetermined combinations, and the measurement that determines most of them."""
    information = plan.chosen.information
    count = len(information.undetermined)
    if not count:
        return []
    which = f"{count} combination{'s' if count > 1 else ''} of instrument parameters {'are' if count > 1 else 'is'}"
    measured = Counter(cure.partition(GAIN)[0] for cure in information.cures() if GAIN in cure)
    cure = f"; to determine most of them, {measured.most_common(1)[0][0]}" if measured else ""
    return [f"{which} not determined by this layout (see the table){cure}."]


def _search(plan: PlannedNetwork) -> list[str]:
    count = len(plan.spread)
    if plan.stopped:
        return ["The search was stopped; this is the best layout until then."]
    if count < 2:
        return []
    close = sum(value < 1.02 * plan.spread[0] for value in plan.spread)
    return [
        f"{close} of {count} independent searches ended within 2 % of the best value, the worst at "
        f"{plan.spread[-1] / plan.spread[0]:.2f} times it; "
        + ("a much better layout is unlikely." if close > 1 else "more search.starts may find a better layout.")
    ]
