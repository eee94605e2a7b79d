"""What a recording says of each instrument: its constants, and the combinations of them that are determined."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.calibration.determined import determined
from ltsim.diagnosis.evidence import log_evidence
from ltsim.diagnosis.schema import Estimate, InstrumentEntry
from ltsim.effects.effect import Parameter

PRIOR_ODDS = 0.05
"""That some constant of some instrument is not what the others, or a correction, say; shared among all constants."""
MEDIAN = np.pi / 2
"""Variance of a median over that of a mean, of many normal values."""


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
    against : str
        In words.
    """

    instrument: str
    parameter: Parameter
    difference: float
    sigma: float
    evidence: float
    against: str


def contradictions(adjustment: Adjustment, least: float) -> list[Contradiction]:
    """Constants that differ from those of the other instruments, or from zero where the instrument is corrected.

    The likelihoods of a constant that is off by a few plausible sizes and of one that is not are compared as everywhere
    else; those with more than `least` of log evidence are told.
    """
    recording = adjustment.recording
    names, parameters = recording.instruments, adjustment.construction.parameters
    values = adjustment.state.instrument
    variances = np.array([np.diag(adjustment.instrument_covariance_of(i)) for i in range(len(names))])
    odds = float(np.log(PRIOR_ODDS / max(len(names) * len(parameters), 1)))
    found = []
    for i, name in enumerate(names):
        stated = recording.setup.instruments.get(name, recording.setup.instrument)
        for k, p in enumerate(parameters):
            if stated.corrected:
                gap, variance, against = values[i, k], variances[i, k], "the correction that it is said to have"
            elif len(names) > 1:
                others = np.delete(np.arange(len(names)), i)
                middle = float(np.median(values[others, k]))
                gap, against = values[i, k] - middle, "the other instruments"
                variance = variances[i, k] + float(np.median(variances[others, k])) / max(len(others), 1) * MEDIAN
            else:
                continue
            size = p.sigma_from(stated.prior)
            evidence = float(log_evidence(np.array([(gap * size / variance) ** 2]), np.array([size**2 / variance])))
            if evidence + odds > least:
                found.append(Contradiction(name, p, float(gap), float(np.sqrt(variance)), evidence + odds, against))
    if len(names) == 2:  # Which of two is off nobody can say; the one farther from zero is the likelier.
        largest = {c.parameter.name: float(np.abs(values[:, parameters.index(c.parameter)]).max()) for c in found}
        found = [
            c
            for c in found
            if abs(values[names.index(c.instrument), parameters.index(c.parameter)]) >= largest[c.parameter.name]
        ]
    return sorted(found, key=lambda c: -c.evidence)
