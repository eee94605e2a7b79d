"""Why a plan is as it is, in sentences, each with the number behind it."""

from collections.abc import Sequence
from itertools import groupby

import numpy as np

from ltsim.core.errors import NetworkError
from ltsim.core.notation import listing
from ltsim.core.units import MICROMETRE, MILLIMETRE
from ltsim.planning.information import LayoutInformation
from ltsim.planning.objective import DIAGNOSIS, INSTRUMENT, TARGETS, Objective
from ltsim.planning.planner import Evaluated, Option, PlannedNetwork, Tried, measure
from ltsim.planning.rules import too_near, words_of
from ltsim.planning.site import MOST_NAMED
from ltsim.planning.tolerances import against, keeps, sentences
from ltsim.planning.workshop import objective_of

CRITERION_WORDS = {
    "D": "in the geometric mean of all combinations (D)",
    "A": "in the root mean square (A)",
    "E": "in the worst combination (E)",
}


def reasons(plan: PlannedNetwork) -> list[str]:
    """The sentences, the answer first."""
    found = [*_headline(plan), *_tolerances(plan), *_against_reference(plan), *_what_each_station_does(plan)]
    return [*found, *_air(plan), *_limits(plan), *_curve(plan), *_undetermined(plan), *_search(plan)]


def _quality_words(plan: PlannedNetwork) -> str:
    said = {
        INSTRUMENT: "instrument parameters known to {:.3f} of their prior sigma "
        + CRITERION_WORDS[plan.file.goal.criterion],
        TARGETS: "targets known to {:.1f} um (root mean square)",
        DIAGNOSIS: "effects detectable from {:.2f} of their plausible size (geometric mean)",
    }
    factor = {TARGETS: 1.0 / MICROMETRE}
    return ", ".join(said[name].format(factor.get(name, 1.0) * value) for name, value in plan.chosen.qualities.items())


def _headline(plan: PlannedNetwork) -> list[str]:
    work = f"{plan.chosen.survey.words}; {_quality_words(plan)}"
    if plan.verdict is not None:
        return [f"{plan.verdict.words}.", f"{work}."]
    sigma = plan.chosen.information.target_sigma
    worst = int(np.argmax(sigma))
    name = plan.chosen.survey.target_names[worst]
    broken = f"The layout breaks a rule of the plan: {words_of(plan.chosen.broken)}. " if plan.chosen.broken else ""
    return [f"{broken}{work}; no tolerance is asked for, the worst point is {name} ({_shown(TARGETS, sigma[worst])})."]


def _tolerances(plan: PlannedNetwork) -> list[str]:
    return [] if plan.kept is None else [*_numbers(plan), *sentences(plan.losses)]


def _numbers(plan: PlannedNetwork) -> list[str]:
    """Numbers of stations that were searched, with the outcome of each."""
    if not plan.tried:
        return []
    *fewer, last = plan.tried
    found = _came_of(fewer, plan.site.least)
    good = last.ratio is not None and keeps(last.ratio)
    count = len(plan.chosen.survey.position)
    said = [f"{last.stations} stations are the fewest that were found to keep the goal."] if good else []
    if not good:
        end = "" if plan.stopped else "; more floor, more rounds or wider tolerances may"
        if not plan.stopped and last.stations < plan.file.stations.most:
            end = f"; more were not searched, since each further one brought little{end}"
        said = [f"None of {plan.tried[0].stations} to {last.stations} stations was found to keep the goal, "
                f"the nearest are {count}{end}."]  # fmt: skip
        found = _came_of(plan.tried, plan.site.least)
    said += [f"Searched: {'; '.join(found)}."] if found else []
    return [*said, f"Fewer than {plan.tried[0].stations} stations were not searched."]


def _came_of(tried: Sequence[Tried], least: int) -> list[str]:
    """Outcomes for numbers of stations, equal outcomes joined."""

    def words(one: Tried) -> str:
        if one.ratio is not None and np.isfinite(one.ratio):
            return f"the best found has an error of {against(one.ratio, 1.0)} times its tolerance"
        in_sight = f"in sight{f' of {least}' if least > 1 else ''}"
        return "the best found leaves a point open" if one.found else f"no layout was found with every point {in_sight}"

    def came_of(said: str, same: Sequence[Tried]) -> str:
        first, last = same[0].stations, same[-1].stations
        nearest = f" (the nearest one lacks {same[-1].lacking})" if same[-1].lacking else ""
        return f"{first}{f' to {last}' if last > first else ''} stations: {said}{nearest}"

    return [came_of(said, list(same)) for said, same in groupby(tried, key=words)]


def _air(plan: PlannedNetwork) -> list[str]:
    """Uncertainty of the air that the figures include."""
    survey = plan.chosen.survey
    if survey.air is None:
        return []
    longest = float(np.linalg.norm(survey.position[:, None] - survey.points, axis=2)[survey.seen].max())
    return [f"All errors of points hold the {survey.air.words(longest)}; other numbers: [air] of the plan."]


def _against_reference(plan: PlannedNetwork) -> list[str]:
    reference, chosen = plan.reference, plan.chosen
    if plan.file.workshop is not None:
        return []
    if reference is None:
        return ["The scenario's own layout does not determine its poses and targets; the plan's does."]
    found = []
    if reference.broken:
        lost = reference.table.lost(reference.survey.station_names, reference.survey.target_names)
        why = f" ({lost[0]}{', and more' if len(lost) > 1 else ''})" if lost else ""
        found.append(f"The scenario's own layout does not keep the plan's rules: {words_of(reference.broken)}{why}.")
    for name in [name for name in chosen.qualities if name in reference.qualities]:
        factor = reference.qualities[name] / chosen.qualities[name]
        found.append(
            f"That is {max(factor, 1 / factor):.2f} times {'better' if factor >= 1 else 'worse'} for {name} than the "
            f"scenario's own layout of {len(reference.survey.position)} stations, worked in the same way "
            f"({_shown(name, reference.qualities[name])} there)."
        )
    found += _parameters(reference, chosen)
    if reference.expected is not None and chosen.expected is not None:
        a, b = reference.expected, chosen.expected
        found.append(
            f"Expected improvement by the paper's criteria, for errors of the size the maker guarantees: distance "
            f"{b.distance_improvement[0]:.0f} % (there {a.distance_improvement[0]:.0f} %), coordinate "
            f"{b.coordinate_improvement[0]:.0f} % (there {a.coordinate_improvement[0]:.0f} %)."
        )
    return found


def _shown(name: str, value: float) -> str:
    return f"{value / MICROMETRE:.1f} um" if name == TARGETS else f"{value:.3f}"


def _parameters(reference: Evaluated, chosen: Evaluated) -> list[str]:
    pairs = list(zip(reference.information.parameters(), chosen.information.parameters(), strict=True))
    pairs.sort(key=lambda pair: pair[0].sigma / pair[1].sigma, reverse=True)
    words = [(b.sigma / a.sigma, f"{a.name} {b.sigma:.3g} to {a.sigma:.3g} {a.unit}") for b, a in pairs]
    gained = [text for ratio, text in words[:4] if ratio > 1.05]
    lost = [text for ratio, text in words[::-1][:3] if ratio < 0.95]
    found = [f"Parameters that gain most (sigma): {'; '.join(gained)}."] if gained else []
    return found + ([f"Parameters known less well than there: {'; '.join(lost)}."] if lost else [])


def _what_each_station_does(plan: PlannedNetwork) -> list[str]:
    """Loss without each station, and the parameter that it serves most."""
    survey, now, qualities = plan.chosen.survey, plan.chosen.information, plan.chosen.qualities
    objective, found = Objective({INSTRUMENT: 1.0}, plan.file.goal.criterion), []
    for s, name in enumerate(survey.station_names):
        left = survey.without(s)
        try:
            without = LayoutInformation.of(left, now.construction)
        except NetworkError as problem:
            found.append(f"Without {name} the plan does not hold: {problem}.")
            continue
        if INSTRUMENT in qualities:
            worse = measure(left, objective, now.construction)[0] / qualities[INSTRUMENT]
        else:
            worse = without.target_rms / now.target_rms
        ratio = without.instrument_sigma / now.instrument_sigma
        most = int(np.argmax(ratio))
        x, y, _ = survey.position[s]
        found.append(
            f"{name} at ({x:.2f}, {y:.2f}) m: without it the quality is {100 * (worse - 1):.0f} % worse, most for "
            f"{now.construction.names[most]} (sigma {100 * (ratio[most] - 1):.0f} % larger)."
        )
    return found


def _limits(plan: PlannedNetwork) -> list[str]:
    """Rules that hold the layout: the floor's edge, the elevation limits, the spacing."""
    survey, site = plan.chosen.survey, plan.site
    names, found = survey.station_names, []
    near = too_near(survey.position[None], 1.02 * site.spacing) & ~too_near(survey.position[None], site.spacing)
    close = [f"{names[i]} and {names[j]}" for i, j in np.argwhere(near[0]).tolist()]
    if close:
        found.append(f"The least distance of {site.spacing:g} m holds {', '.join(close)} apart.")
    steps = 0.03 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    edge = [
        name
        for name, place in zip(names, survey.position, strict=True)
        if site.allowed(place[None])[0] and not site.allowed(place + steps).all()
    ]
    if edge:
        verb = "stands" if len(edge) == 1 else "stand"
        found.append(f"{', '.join(edge)} {verb} at the edge of the allowed floor; more room there may help.")
    if site.least < len(names):
        least = survey.seen.sum(axis=0).min()
        found.append(f"Every reflector is seen from at least {least} station{'s' if least > 1 else ''}.")
    if site.obstacles is not None:
        depth = np.linalg.norm(site.obstacles.over_skin(survey.points) - survey.points, axis=1)
        if under := [name for name, d in zip(survey.target_names, depth, strict=True) if d]:
            found.append(
                f"Up to {depth.max() / MILLIMETRE:.2g} mm under the triangles of a curved body, within what they leave "
                f"open, and taken to be on it: {listing(under, MOST_NAMED)}."
            )
    lost = plan.chosen.table.lost(names, survey.target_names)
    if lost:
        more = "; and more" if len(lost) > 3 else ""
        found.append(f"{len(lost)} pairs do not see each other: {'; '.join(lost[:3])}{more}.")
    return found


def _same_way(plan: PlannedNetwork, option: Option) -> bool:
    chosen = plan.chosen.survey
    return option.survey.faces == chosen.faces and option.survey.repeats == chosen.repeats


def fewest(plan: PlannedNetwork) -> Option | None:
    """The option with the fewest stations that is as good as the scenario's own layout, worked in the same way."""
    if plan.reference is None or not plan.reference.qualities:
        return None
    goal = _reference_value(plan)
    good = [o for o in plan.options if _same_way(plan, o) and o.value <= goal]
    return min(good, key=lambda o: (len(o.survey.position), o.value), default=None)


def _curve(plan: PlannedNetwork) -> list[str]:
    """Fewer stations that are enough, and what a better layout costs."""
    found, few, reference = [], fewest(plan), plan.reference
    if few is not None and reference is not None and len(few.survey.position) < len(reference.survey.position):
        goal = " ".join(plan.chosen.qualities)
        found.append(
            f"{len(few.survey.position)} stations are enough to match the {len(reference.survey.position)} of the "
            f"scenario's own layout ({_shown(goal, few.value)} against {_shown(goal, _reference_value(plan))}) in "
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
        found.append(
            f"{now.value / best.value:.1f} times better still with {len(best.survey.position)} stations, {faces}, "
            f"{rounds}: {time}."
        )
    return found


def _reference_value(plan: PlannedNetwork) -> float:
    if plan.reference is None:
        return float("inf")
    survey = plan.reference.survey
    return measure(survey, objective_of(plan.file, survey), plan.chosen.information.construction)[0]


def _undetermined(plan: PlannedNetwork) -> list[str]:
    information = plan.chosen.information
    found = []
    for direction, cure in zip(information.undetermined, information.cures(), strict=True):
        terms = " ".join(f"{v:+.2f} {n}" for n, v in direction.coefficients(information.construction.names).items())
        found.append(f"Not determined (gain {direction.gain:.2f}): {terms}{f'; cure: {cure}' if cure else ''}.")
    return found


def _search(plan: PlannedNetwork) -> list[str]:
    count = len(plan.spread)
    if plan.stopped:
        return ["The search was stopped: this is the best layout that it had found by then."]
    if count < 2:
        return []
    close = sum(value < 1.02 * plan.spread[0] for value in plan.spread)
    return [
        f"Of {count} independent searches {close} ended within 2 % of the best, the last at "
        f"{plan.spread[-1] / plan.spread[0]:.2f} times it: "
        + ("no much better layout is to be expected." if close > 1 else "more starts may find a better one.")
    ]
