"""What a recording says of each instrument: its constants, and the combinations of them that are determined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import erfc

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.prior import prior_sigmas
from ltsim.arrays import Floats, Ints
from ltsim.calibration.evidence import Evidence, change_seen, determined, evidence
from ltsim.diagnosis.evidence import log_average, log_evidence
from ltsim.diagnosis.prior import log_share
from ltsim.diagnosis.schema import Estimate, InstrumentEntry
from ltsim.effects.effect import Parameter

ANYTHING = 1e3
"""Guarantees by which a constant that is known to have changed may be off, when the others are looked at."""
NOT_APART = float(np.log(100.0))
"""Log evidence that another constant is behind and may still be the one that is off."""
LEFT = 0.1
"""What a correction leaves of a constant, in the maker's guarantees: the share to which an ordinary calibration knows
it (a beam tilt of 10 urad to about 1); nobody states it, and none is exact."""
TINY = 1e-12
"""Weight under which nothing is told of a constant."""


def instrument_entries(adjustment: Adjustment) -> tuple[InstrumentEntry, ...]:
    """Constants and determined combinations of every instrument of a recording."""
    return tuple(_entry(adjustment, i) for i in range(len(adjustment.recording.instruments)))


def _entry(adjustment: Adjustment, instrument: int) -> InstrumentEntry:
    parameters = adjustment.construction.parameters
    values = adjustment.state.instrument[instrument]
    covariance = adjustment.instrument_covariance_of(instrument)
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return InstrumentEntry(
        name=adjustment.recording.instruments[instrument],
        parameters=tuple(Estimate.of(p, v, s) for p, v, s in zip(parameters, values, sigma, strict=True)),
        determined=tuple(determined(parameters, values, covariance)),
    )


@dataclass(frozen=True)
class Contradiction:
    """A constant of an instrument against what else is known of it.

    Attributes
    ----------
    instrument : str
    parameter : Parameter
    difference, sigma : float
        [SI], from the others' median, from zero for an instrument that is said to be corrected, or from its history.
    evidence : float
        Log marginal likelihood ratio, prior odds included.
    p_value : float
        Chance that any of the constants compared differs by as many standard deviations.
    against : str
        In words.
    alike : tuple of Parameter
        Other constants of the instrument that may be off in its place.
    """

    instrument: str
    parameter: Parameter
    difference: float
    sigma: float
    evidence: float
    p_value: float
    against: str
    alike: tuple[Parameter, ...] = ()


@dataclass(frozen=True)
class Expected:
    """What is expected of an instrument's constants, in the maker's guarantees, and which of them are compared.

    Attributes
    ----------
    mean, covariance : (p,), (p, p) float
    at : (k,) int
        The constants that are compared.
    further, log_weights : (k, s) float
        Variances that each of these may have beside the expected ones, and the logs of their weights.
    words : tuple of str
        What each constant (p,) is compared with.
    """

    mean: Floats
    covariance: Floats
    at: Ints
    further: Floats
    log_weights: Floats
    words: tuple[str, ...]

    @classmethod
    def of(cls, mean: Floats, covariance: Floats, words: str) -> Expected:
        """All constants (p,) compared, with no variances beside their covariance (p, p)."""
        count = len(mean)
        none = np.zeros((count, 1))
        return cls(mean, covariance, np.arange(count), none, none, (words,) * count)


def contradictions(adjustment: Adjustment, least: float) -> list[Contradiction]:
    """Constants that differ from those of the other instruments, or from zero where the instrument is corrected.

    The likelihoods of a constant that is off by a few plausible sizes and of one that is not are compared as everywhere
    else; those with more than `least` of log evidence are told.
    """
    recording = adjustment.recording
    names = recording.instruments
    stated = [recording.setup.instruments.get(name, recording.setup.instrument) for name in names]
    found = [
        one
        for i, instrument in enumerate(stated)
        if instrument.corrected
        for one in compared(adjustment, i, _corrected(adjustment), least)
    ]
    alike = [i for i, instrument in enumerate(stated) if not instrument.corrected]
    if len(alike) == 2:  # Which of two is off nobody can say; the one farther from zero is the likelier.
        size = {(names[i], p.name): abs(v) for i in alike for p, v in _constants(adjustment, i)}
        pair = [c for i in alike for c in compared(adjustment, i, _as_others(adjustment, i, alike), least)]
        found += [
            c
            for c in pair
            if size[c.instrument, c.parameter.name] >= max(size[names[i], c.parameter.name] for i in alike)
        ]
    while len(alike) > 2:  # The one that is off most has no say in what is expected of the rest.
        each = {i: compared(adjustment, i, _as_others(adjustment, i, alike), least) for i in alike}
        worst = max(alike, key=lambda i: max((c.evidence for c in each[i]), default=-np.inf))
        if not each[worst]:
            break
        found += each[worst]
        alike.remove(worst)
    return sorted(found, key=lambda c: -c.evidence)


def _corrected(adjustment: Adjustment) -> Expected:
    count = adjustment.construction.size
    return Expected.of(np.zeros(count), LEFT**2 * np.eye(count), "the correction that it is said to have")


def _as_others(adjustment: Adjustment, i: int, alike: Sequence[int]) -> Expected:
    """What the readings of the others say of constants that all have in common, within the guarantee."""
    unit = prior_sigmas(adjustment.recording, adjustment.construction)
    told = [_said(adjustment, j, unit[j], unit[i]) for j in alike if j != i]
    information = np.sum([np.eye(len(unit[i])), *(one.information for one in told)], axis=0)
    covariance: Floats = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return Expected.of(covariance @ sum(one.told for one in told), covariance, "the other instruments")


def _said(adjustment: Adjustment, i: int, prior: Floats, unit: Floats) -> Evidence:
    return evidence(adjustment.state.instrument[i], adjustment.instrument_covariance_of(i), prior, unit)


def _constants(adjustment: Adjustment, i: int) -> list[tuple[Parameter, float]]:
    return list(zip(adjustment.construction.parameters, adjustment.state.instrument[i].tolist(), strict=True))


def compared(adjustment: Adjustment, i: int, expected: Expected, least: float) -> list[Contradiction]:
    """Constants of an instrument that are not as expected, each with more than `least` of log evidence.

    One constant after the other, the one that explains most first, those before free to be anything. The readings
    alone, without the prior of the adjustment, say N x = b + noise of covariance N. Were x as expected, N(m, V), a
    change of constant k would be seen with the weight (V + 1/N)^-1[k, k], whatever the others are.
    """
    parameters, at, variance = adjustment.construction.parameters, expected.at, expected.covariance.copy()
    prior = prior_sigmas(adjustment.recording, adjustment.construction)
    unit = prior[i]
    said = _said(adjustment, i, unit, unit)
    surprise = said.told - said.information @ expected.mean
    odds = log_share("constant", prior.size)
    changed: dict[int, float] = {}
    alike: dict[int, tuple[Parameter, ...]] = {}
    while len(changed) < len(at):
        score, weight = change_seen(said.information, surprise, variance)
        if not changed:
            apart = score, weight
        seen = np.maximum(np.diag(weight)[at], TINY)
        logs = np.full(len(at), -np.inf)
        for j in np.flatnonzero((seen > TINY) & ~np.isin(at, list(changed))):
            spread = 1.0 / seen[j] + expected.further[j]
            logs[j] = odds + _change(score[at[j]] / seen[j], spread, expected.log_weights[j])
        best = int(np.argmax(np.where(np.isfinite(logs), score[at] ** 2 / seen, -np.inf)))
        if not logs[best] > least:
            break
        k = int(at[best])
        changed[k] = float(logs[best])
        alike[k] = tuple(parameters[at[j]] for j in np.flatnonzero(logs > logs[best] - NOT_APART) if j != best)
        variance[k, k] += ANYTHING**2
    told = list(changed)
    covariance = np.linalg.inv(apart[1][np.ix_(told, told)])
    gap, sigma = covariance @ apart[0][told], np.sqrt(np.diag(covariance))
    chance = np.minimum(prior.size * erfc(np.abs(gap) / sigma / np.sqrt(2.0)), 1.0)
    name = adjustment.recording.instruments[i]
    return [
        Contradiction(name, parameters[k], float(g), float(s), changed[k], float(c), expected.words[k], alike[k])
        for k, g, s, c in zip(told, gap * unit[told], sigma * unit[told], chance, strict=True)
    ]


def _change(gap: float, variance: Floats, weights: Floats) -> float:
    """Log evidence of a change behind a gap, averaged over its variances (s,) by the logs of their weights."""
    alike = weights - 0.5 * (gap**2 / variance + np.log(variance))
    changed = alike + log_evidence(((gap / variance) ** 2)[:, None], 1.0 / variance[:, None])
    return float(log_average(changed) - log_average(alike))
