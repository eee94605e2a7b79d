"""Findings from hypotheses: where, how large, how sure, and what else it could be."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ltsim.adjust.adjustment import Adjustment
from ltsim.diagnose.bank import Hypothesis
from ltsim.diagnose.detect import Detection
from ltsim.diagnose.diagnosis import Estimate, Evidence, Finding, Where
from ltsim.diagnose.flexible import FlexibleTerm
from ltsim.diagnose.gross import GrossFinding
from ltsim.diagnose.noise import NoiseHypothesis
from ltsim.diagnose.search import EffectSet, Ranking
from ltsim.diagnose.words import finding_sentence, number
from ltsim.effects.effect import Effect
from ltsim.recording.recording import OBSERVABLES

NOT_EXCLUDED = 0.01
"""Probability above which another effect is stated as an equivalent."""
MOST_EQUIVALENTS = 3


def where_of(effect: Effect) -> Where:
    """What an effect is confined to."""
    observables = tuple(effect.observables)
    return Where(
        () if set(observables) == set(OBSERVABLES) else observables,
        effect.stations,
        effect.targets,
        tuple(effect.covariates),
    )


def equivalents_of(ranking: Ranking, name: str) -> tuple[float, tuple[tuple[str, float], ...]]:
    """Probability of a name beside the others, and the others that are not excluded."""
    probability = ranking.probabilities()
    others = sorted(
        ((n, p) for n, p in probability.items() if n != name and p > NOT_EXCLUDED),
        key=lambda pair: -pair[1],
    )
    return probability.get(name, 0.0), tuple(others[:MOST_EQUIVALENTS])


def mean_finding(
    hypothesis: Hypothesis,
    estimates: Sequence[Estimate],
    others: EffectSet,
    found: EffectSet,
    ranking: Ranking,
    detection: Detection,
    separate_by: str = "",
) -> Finding:
    """The finding of a mean shift."""
    name = hypothesis.effect.name if hypothesis.known else "unknown"
    probability, equivalents = equivalents_of(ranking, name)
    drop = float(others.residual @ others.residual - found.residual @ found.residual)
    spent = found.extension.shape[1] - others.extension.shape[1]
    p_value = min(detection.p_value, float(np.exp(-max(found.score - others.score, 0.0))))
    law = "" if hypothesis.known else _law(hypothesis.effect, estimates)
    where = where_of(hypothesis.effect)
    return Finding(
        effect=name,
        known=hypothesis.known,
        where=where,
        parameters=tuple(estimates),
        evidence=Evidence(drop, spent, p_value, probability),
        sentence=finding_sentence(
            name, where, estimates, probability, law, implausible=_implausible(hypothesis, estimates)
        ),
        equivalents=equivalents,
        separate_by=separate_by,
        formula=law,
    )


MOST_TERMS = 4
"""Terms of a formula that are written with their coefficients; longer ones keep letters."""


def _law(effect: Effect, estimates: Sequence[Estimate]) -> str:
    """The formula of a flexible term, with numbers where it is short."""
    if not isinstance(effect, FlexibleTerm):
        return ""
    if not 0 < len(estimates) <= MOST_TERMS:
        return effect.formula
    return effect.written([f"({number(e.value, e.sigma)}) {e.unit}" for e in estimates])


IMPLAUSIBLE = 5.0
"""Sizes beyond so many times a bad but plausible one are remarked upon."""


def _implausible(hypothesis: Hypothesis, estimates: Sequence[Estimate]) -> bool:
    sizes = {p.name: p.prior_sigma / p.factor for p in hypothesis.effect.parameters}
    return hypothesis.known and any(
        abs(e.value) - 2 * e.sigma > IMPLAUSIBLE * sizes[e.name] for e in estimates if e.name in sizes
    )


def noise_finding(hypothesis: NoiseHypothesis, detection: Detection) -> Finding:
    """The finding of a change of the noise."""
    effect = hypothesis.effect
    name = effect.name if hypothesis.known else "unknown"
    where = where_of(effect)
    rows = [
        Estimate(p.name, v / p.factor, s / p.factor, p.unit)
        for p, v, s in zip(effect.parameters, hypothesis.values, hypothesis.sigma, strict=True)
    ]
    return Finding(
        effect=name,
        known=hypothesis.known,
        where=where,
        parameters=tuple(rows),
        evidence=Evidence(hypothesis.drop, len(rows), detection.p_value, hypothesis.probability),
        sentence=finding_sentence(name, where, rows, hypothesis.probability, "larger noise"),
        equivalents=hypothesis.equivalents,
        formula="" if hypothesis.known else "variance grows with the covariate",
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
