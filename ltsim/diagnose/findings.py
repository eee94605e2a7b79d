"""Findings from what a search found: where, how large, how sure, in which words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ltsim.adjust.adjustment import Adjustment
from ltsim.diagnose.detect import Detection
from ltsim.diagnose.diagnosis import NOT_EXCLUDED, Curve, Equivalent, Estimate, Evidence, Finding, Where
from ltsim.diagnose.evidence import carried_by
from ltsim.diagnose.gross import GrossFinding
from ltsim.diagnose.instruments import Contradiction
from ltsim.diagnose.law import Law, curve_of, describe
from ltsim.diagnose.noise import NoiseHypothesis, NoisePattern
from ltsim.diagnose.search import Searcher
from ltsim.diagnose.sets import Found, Hypothesis, Ranking
from ltsim.diagnose.words import finding_sentence, number, percent, without_clock
from ltsim.effects import BASELINE
from ltsim.effects.signature import Tunable
from ltsim.recording.recording import OBSERVABLES

MOST_EQUIVALENTS = 3


def where_of(effect: Tunable, carried: tuple[str, ...] = ()) -> Where:
    """What an effect is confined to; the observable that carries it where a law's carrier does not say."""
    observables = tuple(effect.observables)
    if (
        isinstance(effect, Law)
        and effect.carrier.kind in ("instrument", "air", "reflector")
        and not effect.carrier.observables
    ):
        observables = carried or observables
    instruments = effect.instruments if isinstance(effect, Law) else ()
    return Where(
        () if set(observables) == set(OBSERVABLES) else observables,
        () if instruments else effect.stations,
        effect.targets,
        tuple(effect.covariates),
        instruments,
    )


def equivalents_of(ranking: Ranking, name: str) -> tuple[float, tuple[Equivalent, ...]]:
    """Probability of a name beside the others, and the others that are not excluded."""
    probability = ranking.probabilities()
    others = sorted(
        (Equivalent(n, p) for n, p in probability.items() if n != name and p > NOT_EXCLUDED),
        key=lambda other: -other.probability,
    )
    return probability.get(name, 0.0), tuple(others[:MOST_EQUIVALENTS])


def mean_finding(
    hypothesis: Hypothesis,
    told: Sequence[Estimate],
    others: Found,
    found: Found,
    ranking: Ranking,
    detection: Detection,
    searcher: Searcher,
    separate_by: str = "",
    *,
    clock: bool = True,
) -> Finding:
    """The finding of a mean shift beside the `others` of what was `found`."""
    effect, name, space = hypothesis.effect, hypothesis.name, searcher.space
    probability, equivalents = equivalents_of(ranking, name)
    drop = float(others.residual @ others.residual - found.residual @ found.residual)
    spent = found.extension.shape[1] - others.extension.shape[1]
    gain = (others.residual**2 - found.residual**2)[: int(space.use.sum())]
    where = where_of(effect, carried_by(space.use, gain))
    estimates = tuple(told) if clock else tuple(without_clock(e) for e in told)
    law: str = ""
    curve: Curve | None = None
    if isinstance(effect, Law):
        law = law_words(effect, clock=clock)
        curve = curve_of(effect, space.sightings, *searcher.coefficients(effect, others))
    sentence = finding_sentence(
        name, where, estimates, probability, law, implausible=_implausible(hypothesis, estimates)
    )
    return Finding(
        effect=name,
        known=hypothesis.known,
        where=where,
        parameters=estimates,
        evidence=Evidence(drop, spent, detection.chance(ranking.total), probability),
        sentence=sentence,
        equivalents=equivalents,
        separate_by=separate_by,
        formula=law if not hypothesis.known else "",
        carrier=effect.carrier.name if isinstance(effect, Law) else "",
        driver=describe(effect.driver, clock=clock) if isinstance(effect, Law) else "",
        curve=curve,
    )


def law_words(law: Law, *, clock: bool = True) -> str:
    """A law in a line: ``distance correction follows cos(3 azimuth)``."""
    what = f"{law.carrier.name} correction" if law.carrier.kind == "reading" else law.carrier.name
    if law.driver.kind == "constant":
        return f"{what} differs"
    return f"{what} follows {describe(law.driver, clock=clock)}"


IMPLAUSIBLE = 5.0
"""Sizes beyond so many times a bad but plausible one are remarked upon."""


def _implausible(hypothesis: Hypothesis, estimates: Sequence[Estimate]) -> bool:
    known = {p.name: p for p in hypothesis.effect.parameters}
    told = [(e, known[e.name]) for e in estimates if e.name in known]
    large = any(abs(e.value) - 2 * e.sigma > IMPLAUSIBLE * p.prior_sigma / p.factor for e, p in told)
    return hypothesis.known and (large or any(p.positive and e.value + 2 * e.sigma < 0.0 for e, p in told))


def noise_finding(hypothesis: NoiseHypothesis, detection: Detection) -> Finding:
    """The finding of a change of the noise."""
    effect = hypothesis.effect
    name = effect.name if hypothesis.known else "unknown"
    where = where_of(effect)
    rows = [
        Estimate(p.name, v / p.factor, s / p.factor, p.unit)
        for p, v, s in zip(effect.parameters, hypothesis.values, hypothesis.sigma, strict=True)
    ]
    law = effect.law if isinstance(effect, NoisePattern) else ""
    return Finding(
        effect=name,
        known=hypothesis.known,
        where=where,
        parameters=tuple(rows),
        evidence=Evidence(hypothesis.drop, len(rows), detection.p_value, hypothesis.probability),
        sentence=finding_sentence(name, where, rows, hypothesis.probability, law),
        equivalents=hypothesis.equivalents,
        formula=law,
        carrier="noise" if law else "",
        driver=" ".join(effect.covariates) if law else "",
    )


def gross_finding(gross: GrossFinding, adjustment: Adjustment) -> Finding:
    """The finding of a gross error, certain by its size."""
    floor = float(adjustment.recording.sigma()[:, 0].min())
    return Finding(
        effect=gross.effect,
        known=True,
        where=Where(gross.observables, gross.stations, gross.targets, ()),
        parameters=(Estimate("size", 1e3 * gross.size, 1e3 * floor, "mm"),),
        evidence=Evidence((gross.size / floor) ** 2, 3, 0.0, 1.0),
        sentence=gross.sentence,
    )


def instrument_finding(found: Contradiction) -> Finding:
    """The finding of a constant that contradicts what else is known of its instrument."""
    p = found.parameter
    name = next(e.name for e in BASELINE if p.name in {q.name for q in e.parameters})
    estimate = Estimate(p.name, found.difference / p.factor, found.sigma / p.factor, p.unit)
    probability = 1.0 / (1.0 + float(np.exp(-found.evidence)))
    instrument = found.instrument or "the instrument"
    sentence = (
        f"The {p.name.replace('-', ' ')} of {instrument} differs by {number(estimate.value, estimate.sigma)} {p.unit} "
        f"from {found.against} (probability {percent(probability)})."
    )
    return Finding(
        effect=name,
        known=True,
        where=Where(instruments=(found.instrument,) if found.instrument else ()),
        parameters=(estimate,),
        evidence=Evidence((found.difference / found.sigma) ** 2, 1, float(np.exp(-found.evidence)), probability),
        sentence=sentence,
    )
