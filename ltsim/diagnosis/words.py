"""Sentences for people."""

from collections.abc import Sequence

import numpy as np

from ltsim.core.notation import listing, with_sigma
from ltsim.diagnosis.schema import Estimate, Finding, InstrumentEntry, Misfit, Where
from ltsim.physics.effects import card_of, find_effect

MOST_NAMED = 4
"""Estimates that a sentence names at most."""
LIKELY = 0.5
"""Probability below which a name is only a suggestion."""
COVARIATES = {
    "approach": "the move before the pointing",
    "place": "the place in the room",
    "incidence": "the direction from which the reflector is seen",
}
"""Covariates whose names need words."""


def estimates(parameters: Sequence[Estimate]) -> str:
    """The most telling estimates in a phrase; what is no larger than its uncertainty is left to the tables."""
    significant = [p for p in parameters if abs(p.value) > p.sigma]
    largest = sorted(significant, key=lambda p: -abs(p.value) / max(p.sigma, 1e-300))[:MOST_NAMED]
    chosen = [p for p in parameters if p in largest]
    return ", ".join(_estimate(p) for p in chosen)


def _estimate(parameter: Estimate) -> str:
    """One estimate in a phrase; an added variance as the factor on the stated standard deviation."""
    name, value, sigma = parameter.name.replace("_", " "), parameter.value, parameter.sigma
    if name.startswith("noise-"):
        factor = float(np.sqrt(max(1.0 + value, 0.0)))
        return f"{name[6:]}s scatter {with_sigma(factor, 0.5 * sigma / max(factor, 0.1))} times as much as stated"
    return f"{name} {with_sigma(value, sigma)} {parameter.unit}".strip()


def place(where: Where) -> str:
    """Where, in a phrase."""
    kinds = ("at station", where.stations), ("of instrument", where.instruments), ("at target", where.targets)
    parts = [f"{kind}{'s' if len(names) > 1 else ''} {listing(names)}" for kind, names in kinds if names]
    if where.observables:
        parts.append(f"in {listing(where.observables)}")
    return " ".join(parts) or "in the whole recording"


def percent(probability: float) -> str:
    """A probability for people."""
    return "more than 99 %" if probability > 0.99 else f"{100 * probability:.0f} %"


def catalogue_sentence(
    effect: str, where: Where, parameters: Sequence[Estimate], probability: float, *, p_located: float | None = None
) -> str:
    """An effect of the catalogue in a sentence: what the readings show, and what usually causes it."""
    card = card_of(find_effect(effect))
    at = place(where).removeprefix("at ").removeprefix("in the ")
    title = card.title if probability >= LIKELY else f"Perhaps {card.title[0].lower()}{card.title[1:]}"
    sizes = estimates(parameters)
    if max(probability, p_located or 0.0) < LIKELY:
        perhaps = f"{title[0].lower()}{title[1:]}{f' ({sizes})' if sizes else ''}, {percent(probability)}"
        return f"Something is off ({at}) that these readings do not tell: {perhaps}."
    located = "" if p_located is None else f"such a change here: {percent(p_located)}; "
    cause = f"usual cause: {card.cause} (probability of this name {percent(probability)})"
    return f"{title} ({at}){f': {sizes}' if sizes else ''}; {located}{cause}."


def law_sentence(where: Where, parameters: Sequence[Estimate], p_located: float, law: str) -> str:
    """A law that no card names, in one sentence: what varies with what, where, how much, how surely."""
    sizes = estimates(parameters)
    size = f" ({sizes})" if sizes else ""
    at = _at(where.model_copy(update={"observables": ()}))
    carrier, verb, driver = law.partition(" follows " if " follows " in law else " differs")
    if p_located < LIKELY:
        likeliest = f"the {carrier}{at}{verb}{driver}{size}, is one of several ({percent(p_located)})"
        return f"Physics outside the catalogue{_at(where)}, of a form that these readings do not tell: {likeliest}."
    sure = f"probability that it follows this {percent(p_located)}"
    return f"The {carrier}{at}{verb}{driver}{size}: physics outside the catalogue ({sure})."


def outside_sentence(where: Where, law: str) -> str:
    """Sentence on an effect outside the catalogue: where it acts, what it depends on, the law that fits."""
    on = f", depending on {listing([COVARIATES.get(c, c) for c in where.covariates])}" if where.covariates else ""
    return f"Physics outside the catalogue{_at(where)}{on}; what fits: {law}."


def _at(where: Where) -> str:
    """The place after a blank; empty for the whole recording."""
    confined = where.stations or where.targets or where.observables or where.instruments
    return f" {place(where)}" if confined else ""


CLEAR, MOST_CONSTANTS = 5.0, 5
"""Standard deviations from which a constant is named in the answer, and how many are."""


def clear_constants(instruments: Sequence[InstrumentEntry]) -> list[str]:
    """The constants that the readings determine best, in plain names, the clearest first.

    What is known in combination alone goes by the first of its members: the vertical index, say, as large as it is at
    the elevations that were used.
    """
    ranked: list[tuple[float, str]] = []
    for entry in instruments:
        joined = {name for combination in entry.determined for name in combination.combination}
        entries = [(p.name, "", p.value, p.sigma, p.unit) for p in entry.parameters if p.name not in joined]
        for combination in entry.determined:
            name, weight = next(iter(combination.combination.items()))
            sigma = (combination.sigma or 0.0) / abs(weight)
            entries.append((name, ", at the angles used,", combination.value / weight, sigma, combination.unit))
        of = entry.name or "the instrument"
        for name, used, value, sigma, unit in entries:
            plain = f"{name.replace('-', ' ')}{used} of {of}: {with_sigma(value, sigma)} {unit}"
            ranked.append((abs(value) / max(sigma, 1e-300), plain))
    ranked.sort(key=lambda combination: -combination[0])
    return [words for times, words in ranked if times > CLEAR][:MOST_CONSTANTS]


WITHOUT_CLOCK = {"s": ("rows", 1.0), "min": ("rows", 60.0), "h": ("rows", 3600.0)}
"""Units of time where a recording has no clock and rows stand for seconds."""


def without_clock(parameter: Estimate) -> Estimate:
    """An estimate of a recording that has no clock, by rows instead of by time."""
    per, _, rate = parameter.unit.partition("/")
    if rate in WITHOUT_CLOCK:
        factor, unit = 1.0 / WITHOUT_CLOCK[rate][1], f"{per}/row"
    elif parameter.unit in WITHOUT_CLOCK:
        unit, factor = WITHOUT_CLOCK[parameter.unit]
    else:
        return parameter
    value, sigma = factor * parameter.value, factor * parameter.sigma
    return Estimate(name=parameter.name, value=value, sigma=sigma, unit=unit)


def summarise(
    verdict: str, findings: Sequence[Finding], p_value: float, before: Misfit, after: Misfit, *, untold: int = 0
) -> str:
    """The answer in a few sentences, with which a report begins; `untold` more findings are modelled alone."""
    if verdict == "consistent":
        return (
            f"The recording agrees with the model and the stated noise (chi-square {before.chi2:.0f} for "
            f"{before.dof} degrees of freedom; chance of a search like this finding as much in a clean "
            f"recording: {100 * p_value:.0f} %)."
        )
    if not findings:
        return (
            "The recording does not agree with the model and the stated noise, but no single cause stands out; "
            f"chi-square {before.chi2:.0f} for {before.dof} degrees of freedom."
        )
    first = findings[0]
    more = f" Also: {' '.join(f.sentence for f in findings[1:])}" if len(findings) > 1 else ""
    others = ["physics outside the catalogue" if e.effect == "unknown" else e.effect for e in first.equivalents]
    open_ = f" This recording cannot exclude {' or '.join(others)} instead." if others else ""
    rest = f" Modelled and not told, being smaller or in doubt: {untold}." if untold else ""
    return first.sentence + open_ + more + rest + _course(before.held_out_rms, after.held_out_rms)


def _course(before: float | None, after: float | None) -> str:
    """Sentence on the change of the error on readings that neither fit nor search has seen; empty without a change."""
    if before is None or after is None or before == after:
        return ""
    was, now = f"{before:.2f}", f"{after:.2f}"
    course = f"{'falls' if after < before else 'rises'} from {was} to {now}" if was != now else f"stays at {now}"
    return f" On readings that neither search nor fit has seen the error {course} times their noise."
