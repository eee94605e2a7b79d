"""What a recording says of each instrument: its constants, and the combinations of them that are determined."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erfc

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.prior import prior_sigmas
from ltsim.arrays import Floats, Ints
from ltsim.calibration.determined import determined
from ltsim.calibration.evidence import evidence
from ltsim.diagnosis.evidence import log_average, log_evidence
from ltsim.diagnosis.prior import log_share
from ltsim.diagnosis.schema import Estimate, InstrumentEntry
from ltsim.effects.effect import Parameter

MEDIAN = np.pi / 2
"""Variance of a median over that of a mean, of many normal values."""
ANYTHING = 1e3
"""Guarantees by which a constant that is known to have changed may be off, when the others are looked at."""
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
    """

    instrument: str
    parameter: Parameter
    difference: float
    sigma: float
    evidence: float
    p_value: float
    against: str


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
    def certain(cls, mean: Floats, variance: Floats, words: str) -> Expected:
        """Constants (p,) of known variances (p,) that have no others beside them."""
        count = len(mean)
        none = np.zeros((count, 1))
        return cls(mean, np.diag(variance), np.arange(count), none, none, (words,) * count)


def contradictions(adjustment: Adjustment, least: float) -> list[Contradiction]:
    """Constants that differ from those of the other instruments, or from zero where the instrument is corrected.

    The likelihoods of a constant that is off by a few plausible sizes and of one that is not are compared as everywhere
    else; those with more than `least` of log evidence are told.
    """
    recording, values = adjustment.recording, adjustment.state.instrument
    names, unit = recording.instruments, prior_sigmas(recording, adjustment.construction)
    variances = np.array([np.diag(adjustment.instrument_covariance_of(i)) for i in range(len(names))])
    found = []
    for i, name in enumerate(names):
        others = np.delete(np.arange(len(names)), i)
        if recording.setup.instruments.get(name, recording.setup.instrument).corrected:
            nothing = np.zeros(values.shape[1])
            expected = Expected.certain(nothing, nothing, "the correction that it is said to have")
        elif len(others):
            middle = np.median(values[others], axis=0) / unit[i]
            spread = np.median(variances[others], axis=0) / unit[i] ** 2 / len(others) * MEDIAN
            expected = Expected.certain(middle, spread, "the other instruments")
        else:
            continue
        found += compared(adjustment, i, expected, least)
    if len(names) == 2:  # Which of two is off nobody can say; the one farther from zero is the likelier.
        size = {(names[i], p.name): abs(v) for i in (0, 1) for p, v in _constants(adjustment, i)}
        found = [
            c for c in found if size[c.instrument, c.parameter.name] >= max(size[n, c.parameter.name] for n in names)
        ]
    return sorted(found, key=lambda c: -c.evidence)


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
    said = evidence(adjustment.state.instrument[i], adjustment.instrument_covariance_of(i), unit, unit)
    surprise = said.told - said.information @ expected.mean
    odds = log_share("constant", prior.size)
    changed: dict[int, float] = {}
    while len(changed) < len(at):
        keeps = np.linalg.inv(np.eye(len(unit)) + said.information @ variance)
        score, weight = keeps @ surprise, keeps @ said.information
        if not changed:
            apart = score, weight
        gain = score[at] ** 2 / np.maximum(np.diag(weight)[at], TINY)
        best = int(np.argmax(np.where(np.isin(at, list(changed)), -np.inf, gain)))
        k = int(at[best])
        if weight[k, k] < TINY:
            break
        spread = 1.0 / weight[k, k] + expected.further[best]
        log = odds + _change(score[k] / weight[k, k], spread, expected.log_weights[best])
        if not log > least:
            break
        changed[k] = log
        variance[k, k] += ANYTHING**2
    told = list(changed)
    covariance = np.linalg.inv(apart[1][np.ix_(told, told)])
    gap, sigma = covariance @ apart[0][told], np.sqrt(np.diag(covariance))
    chance = np.minimum(prior.size * erfc(np.abs(gap) / sigma / np.sqrt(2.0)), 1.0)
    name = adjustment.recording.instruments[i]
    return [
        Contradiction(name, parameters[k], float(g), float(s), changed[k], float(c), expected.words[k])
        for k, g, s, c in zip(told, gap * unit[told], sigma * unit[told], chance, strict=True)
    ]


def _change(gap: float, variance: Floats, weights: Floats) -> float:
    """Log evidence of a change behind a gap, averaged over its variances (s,) by the logs of their weights."""
    alike = weights - 0.5 * (gap**2 / variance + np.log(variance))
    changed = alike + log_evidence(((gap / variance) ** 2)[:, None], 1.0 / variance[:, None])
    return float(log_average(changed) - log_average(alike))
