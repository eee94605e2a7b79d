"""Findings from hypotheses: where, how large, how sure, and what else it could be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ltsim.adjust.adjustment import Adjustment
from ltsim.diagnose.bank import Hypothesis
from ltsim.diagnose.detect import Detection
from ltsim.diagnose.diagnosis import Estimate, Evidence, Finding, Where
from ltsim.diagnose.flexible import FlexibleTerm
from ltsim.diagnose.gross import GrossFinding
from ltsim.diagnose.noise import NoiseHypothesis, NoisePattern
from ltsim.diagnose.search import EffectSet, Ranking
from ltsim.diagnose.words import finding_sentence, number
from ltsim.effects import find_effect
from ltsim.effects.signature import Tunable
from ltsim.recording.recording import OBSERVABLES

NOT_EXCLUDED = 0.01
"""Probability above which another effect is stated as an equivalent."""
MOST_EQUIVALENTS = 3


def where_of(effect: Tunable) -> Where:
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
    law = _law(hypothesis.effect, estimates)
    where = where_of(hypothesis.effect)
    return Finding(
        effect=name,
        known=hypothesis.known,
        where=where,
        parameters=tuple(estimates),
        evidence=Evidence(drop, spent, p_value, probability),
        sentence=finding_sentence(
            name, where, estimates, probability, _told(law, estimates), implausible=_implausible(hypothesis, estimates)
        ),
        equivalents=equivalents,
        separate_by=separate_by,
        formula=law,
    )


IMITATED = 0.7
"""Probability of physics outside the catalogue where it takes several effects of one kind, or one with a flexible term
beside it, to follow the readings. Of 31 explanations of the first sort in experiments/20 none was true, of 71 of the
second two; several independent causes at once are likelier in a workshop than there."""


def doubted(explained: Sequence[tuple[Finding, tuple[str, ...]]]) -> list[Finding]:
    """Findings with what each says of the others, given with the observables that carry them.

    Several windows or bumps rather imitate one law that nobody has written down; several bad targets do occur.
    """
    told = []
    for finding, carried in explained:
        alike = [f for f, _ in explained if f.effect == finding.effect]
        kinds = set(carried or finding.where.observables or OBSERVABLES)
        beside = [f for f, _ in explained if not f.known and kinds & set(f.where.observables or OBSERVABLES)]
        kind = find_effect(finding.effect) if finding.known else None
        if kind and len(alike) > 1 and not kind.plural:
            told.append(_imitating(finding, carried, "of which it would take several"))
        elif kind and beside and kind.scope != "reading":
            told.append(_imitating(finding, carried, "which does not follow it alone"))
        else:
            told.append(finding)
    return told


def _imitating(finding: Finding, observables: tuple[str, ...], reason: str) -> Finding:
    """A known effect as physics outside the catalogue that it imitates, for a reason."""
    where = replace(finding.where, observables=observables or finding.where.observables)
    others = [(finding.effect, 1.0 - IMITATED), *((n, p) for n, p in finding.equivalents if n != "unknown")]
    formula = f"like {finding.effect}, {reason}"
    return replace(
        finding,
        effect="unknown",
        known=False,
        where=where,
        evidence=replace(finding.evidence, probability=IMITATED),
        equivalents=tuple(others[:MOST_EQUIVALENTS]),
        formula=formula,
        sentence=finding_sentence("unknown", where, finding.parameters, IMITATED, formula),
    )


MOST_TERMS = 4
"""Terms of a formula that are written with their coefficients; longer ones keep letters."""


def _law(effect: Tunable, estimates: Sequence[Estimate]) -> str:
    """The formula of a flexible term, with numbers where it is short."""
    if not isinstance(effect, FlexibleTerm):
        return ""
    if not 0 < len(estimates) <= MOST_TERMS:
        return effect.formula
    return effect.written([f"({number(e.value, e.sigma)}) {e.unit}" for e in estimates])


def _told(law: str, estimates: Sequence[Estimate]) -> str:
    """A formula as a sentence tells it: a long one only by its length."""
    if law and len(estimates) > MOST_TERMS:
        return f"{law.partition(' = ')[0]} by a smooth function with {len(estimates)} coefficients"
    legendre = " (P1, P2: Legendre polynomials over the covariate's range)" if "P1(" in law or "P2(" in law else ""
    return law + legendre


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
        separate_by=hypothesis.separate_by,
        formula=law,
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
