"""Findings from what a search found: where, how large, how sure, in which words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ltsim.adjust.adjustment import Adjustment
from ltsim.adjust.gross import GrossFinding
from ltsim.diagnose.detect import Detection
from ltsim.diagnose.evidence import carried_by
from ltsim.diagnose.instruments import Contradiction
from ltsim.diagnose.law import Law, curve_of, describe
from ltsim.diagnose.noise import NoiseHypothesis, NoisePattern
from ltsim.diagnose.schema import Equivalent, Estimate, Evidence, Finding, Where
from ltsim.diagnose.search import Searcher
from ltsim.diagnose.sets import Found, Hypothesis, Ranking
from ltsim.diagnose.words import finding_sentence, number, percent, without_clock
from ltsim.effects import BASELINE
from ltsim.effects.signature import Tunable
from ltsim.recording.recording import OBSERVABLES

MOST_EQUIVALENTS = 3
NOT_EXCLUDED = 0.01
"""Probability above which another effect is stated as an equivalent."""


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
        observables=() if set(observables) == set(OBSERVABLES) else observables,
        stations=() if instruments else effect.stations,
        targets=effect.targets,
        instruments=instruments,
        covariates=tuple(effect.covariates),
    )


def equivalents(probability: Mapping[str, float], name: str = "") -> tuple[Equivalent, ...]:
    """The likeliest of the other names that are not excluded."""
    others = [Equivalent(effect=n, probability=p) for n, p in probability.items() if n != name and p > NOT_EXCLUDED]
    return tuple(sorted(others, key=lambda other: -other.probability)[:MOST_EQUIVALENTS])


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
    probabilities = ranking.probabilities()
    probability = probabilities.get(name, 0.0)
    drop = float(others.residual @ others.residual - found.residual @ found.residual)
    spent = found.extension.shape[1] - others.extension.shape[1]
    gain = (others.residual**2 - found.residual**2)[: int(space.use.sum())]
    where = where_of(effect, carried_by(space.use, gain))
    estimates = tuple(told) if clock else tuple(without_clock(e) for e in told)
    law = law_words(effect, clock=clock) if isinstance(effect, Law) else ""
    more: dict[str, Any] = {"separate_by": separate_by, "formula": law if not hypothesis.known else ""}
    if isinstance(effect, Law):
        curve = curve_of(effect, space.sightings, *searcher.coefficients(effect, others))
        more |= {"carrier": effect.carrier.name, "driver": describe(effect.driver, clock=clock), "curve": curve}
    sentence = finding_sentence(
        name, where, estimates, probability, law, implausible=_implausible(hypothesis, estimates)
    )
    return Finding(
        effect=name,
        known=hypothesis.known,
        where=where,
        parameters=estimates,
        evidence=Evidence(
            chi2_drop=drop, parameters=spent, p_value=detection.chance(ranking.total), probability=probability
        ),
        sentence=sentence,
        equivalents=equivalents(probabilities, name),
        **{key: value for key, value in more.items() if value},
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
    rows = [Estimate.of(*told) for told in zip(effect.parameters, hypothesis.values, hypothesis.sigma, strict=True)]
    law = effect.law if isinstance(effect, NoisePattern) else ""
    more: dict[str, Any] = {"formula": law, "carrier": "noise"} if law else {}
    if law and effect.covariates:
        more["driver"] = " ".join(effect.covariates)
    return Finding(
        effect=name,
        known=hypothesis.known,
        where=where,
        parameters=tuple(rows),
        evidence=Evidence(
            chi2_drop=hypothesis.drop,
            parameters=len(rows),
            p_value=detection.p_value,
            probability=hypothesis.probability,
        ),
        sentence=finding_sentence(name, where, rows, hypothesis.probability, law),
        equivalents=hypothesis.equivalents,
        **more,
    )


def gross_finding(gross: GrossFinding, adjustment: Adjustment) -> Finding:
    """The finding of a gross error, certain by its size."""
    floor = float(adjustment.recording.sigma()[:, 0].min())
    return Finding(
        effect=gross.effect,
        known=True,
        where=Where(
            observables=gross.observables,
            stations=gross.stations,
            targets=gross.targets,
            instruments=(),
            covariates=(),
        ),
        parameters=(Estimate(name="size", value=1e3 * gross.size, sigma=1e3 * floor, unit="mm"),),
        evidence=Evidence(chi2_drop=(gross.size / floor) ** 2, parameters=3, p_value=0.0, probability=1.0),
        sentence=gross.sentence,
        equivalents=(),
    )


def instrument_finding(found: Contradiction) -> Finding:
    """The finding of a constant that contradicts what else is known of its instrument."""
    p = found.parameter
    name = next(e.name for e in BASELINE if p.name in {q.name for q in e.parameters})
    estimate = Estimate.of(p, found.difference, found.sigma)
    probability = 1.0 / (1.0 + float(np.exp(-found.evidence)))
    instrument = found.instrument or "the instrument"
    sentence = (
        f"The {p.name.replace('-', ' ')} of {instrument} differs by ({number(estimate.value, estimate.sigma)}) "
        f"{p.unit} from {found.against}, probability {percent(probability)}."
    )
    return Finding(
        effect=name,
        known=True,
        where=Where(
            observables=(),
            stations=(),
            targets=(),
            instruments=(found.instrument,) if found.instrument else (),
            covariates=(),
        ),
        parameters=(estimate,),
        evidence=Evidence(
            chi2_drop=(found.difference / found.sigma) ** 2,
            parameters=1,
            p_value=float(np.exp(-found.evidence)),
            probability=probability,
        ),
        sentence=sentence,
        equivalents=(),
    )
