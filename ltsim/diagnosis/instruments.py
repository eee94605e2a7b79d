"""Constants of each instrument by a recording, and the combinations of them that are determined."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import erfc

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.prior import LEFT, prior_sigmas
from ltsim.calibration.evidence import (
    by_plausible_sizes,
    change_seen,
    changes_found,
    determined,
    evidence,
    log_evidence,
    log_sum_exp,
)
from ltsim.core.arrays import Floats
from ltsim.core.probability import SIZE_PRIOR
from ltsim.diagnosis.evidence import shares
from ltsim.diagnosis.prior import log_share
from ltsim.diagnosis.schema import Estimate, InstrumentEntry
from ltsim.physics.effects.effect import Parameter
from ltsim.solve.design import unit_diagonal

CHANGED = sum(share * size**2 for size, share in SIZE_PRIOR.items())
"""Variance in guarantees of a constant that is taken to have changed, when the others are looked at."""
NOT_APART = 0.01
"""Share of the evidence from which another constant may be the one that is off."""
ALIKE = 1e-6
"""Least eigenvalue of the correlation of changes that the readings tell apart; of others the likelier is told."""
TINY = 1e-12
"""Weight under which nothing is told of a constant."""
WORDS = {True: "the correction that it is said to have", False: "the other instruments"}
"""Name of the reference that a constant of a corrected instrument, or of others, is compared with."""


def instrument_entries(adjustment: Adjustment) -> tuple[InstrumentEntry, ...]:
    """Constants and determined combinations of every instrument of a recording."""
    return tuple(_entry(adjustment, i) for i in range(len(adjustment.recording.instruments)))


def _entry(adjustment: Adjustment, instrument: int) -> InstrumentEntry:
    parameters = adjustment.construction.parameters
    values = adjustment.state.instrument[instrument]
    covariance = adjustment.instrument_covariance_of(instrument)
    sigma, prior = np.sqrt(np.maximum(np.diag(covariance), 0.0)), adjustment.problem.prior.sigma[instrument]
    return InstrumentEntry(
        name=adjustment.recording.instruments[instrument],
        parameters=tuple(Estimate.of(p, v, s) for p, v, s in zip(parameters, values, sigma, strict=True)),
        determined=tuple(determined(parameters, *by_plausible_sizes(parameters, values, covariance, prior))),
    )


@dataclass(frozen=True)
class Contradiction:
    """A constant of an instrument against what else is known of it.

    Attributes
    ----------
    instruments : tuple of str
    parameter : Parameter
    difference, sigma : float
        [SI], from the others' median, from zero for an instrument that is said to be corrected, or from its history.
    evidence : float
        Log marginal likelihood ratio, prior odds included.
    p_value : float
        Chance that any of the constants compared differs by as many standard deviations.
    against : str
        In words.
    rivals : mapping of Parameter to float
        Constants that may be off there, this one among them, and the shares of their evidence.
    """

    instruments: tuple[str, ...]
    parameter: Parameter
    difference: float
    sigma: float
    evidence: float
    p_value: float
    against: str
    rivals: Mapping[Parameter, float]


@dataclass(frozen=True)
class Change:
    """A constant that may be off, of one instrument or of some together.

    Attributes
    ----------
    owners : tuple of int
        The instruments.
    constant : int
    words : str
        What it is compared with.
    further, log_weights : (s,) float, or one
        Variances that it may have beside the expected one, and the logs of their weights.
    """

    owners: tuple[int, ...]
    constant: int
    words: str
    further: Floats | float = 0.0
    log_weights: Floats | float = 0.0


@dataclass(frozen=True)
class Expected:
    """Expected constants of all instruments, in units of the makers' guarantees, and changes that may have occurred.

    `mean` (I p,), `covariance` (I p, I p).
    """

    mean: Floats
    covariance: Floats
    changes: tuple[Change, ...]


def contradictions(adjustment: Adjustment, least: float) -> list[Contradiction]:
    """Constants that differ from those of the other instruments, or from zero where the instrument is corrected.

    Of two instruments that differ nobody can say which is off; the one farther from zero is the likelier. What is off
    in all corrected instruments alike is one change: of what they were compared with, perhaps.
    """
    recording = adjustment.recording
    setup, unit = recording.setup, prior_sigmas(recording, adjustment.construction)
    corrected = np.array([setup.instrument_named(name).corrected for name in recording.instruments])
    alike = ~corrected & (np.sum(~corrected) > 1)
    common = np.where(np.outer(alike, alike)[:, :, None], np.minimum(unit[:, None], unit) ** 2, 0.0)
    common /= unit[:, None] * unit  # what all have in common is within the least of their guarantees
    own = np.where(corrected, LEFT**2, np.where(alike, 0.0, 1.0))
    blocks = common + (np.eye(len(unit)) * own)[:, :, None]
    covariance = np.einsum("ijp,pq->ipjq", blocks, np.eye(unit.shape[1])).reshape(unit.size, unit.size)
    ours = tuple(np.flatnonzero(corrected).tolist())
    owners = [(i,) for i in np.flatnonzero(corrected | alike).tolist()] + ([ours] if len(ours) > 1 else [])
    words = {one: WORDS[bool(corrected[one[0]])] for one in owners}
    changes = tuple(Change(one, k, words[one]) for one in owners for k in range(unit.shape[1]))
    return compared(adjustment, Expected(np.zeros(unit.size), covariance, changes), least)


def compared(adjustment: Adjustment, expected: Expected, least: float) -> list[Contradiction]:
    """Constants that are not as expected, each with more than `least` of log evidence beside the others.

    One constant after the other, those before as free as a change is; each gives way to one that explains more in its
    place. The readings alone, without the prior of the adjustment, say N x = b + noise of covariance N. Were x as
    expected, N(m, V), a change of constant k would be seen with the weight (V + 1/N)^-1[k, k], whatever the others are.
    """
    prior = adjustment.problem.prior.sigma
    unit = prior_sigmas(adjustment.recording, adjustment.construction)
    said = evidence(adjustment.state.instrument.ravel(), adjustment.constants_covariance, prior.ravel(), unit.ravel())
    surprise, odds = said.told - said.information @ expected.mean, log_share("constant", len(expected.changes))
    ways = np.zeros((len(expected.changes), *unit.shape))
    for way, change in zip(ways, expected.changes, strict=True):
        way[list(change.owners), change.constant] = 1.0
    ways = ways.reshape(len(ways), unit.size)

    def logs(others: Collection[int]) -> Floats:
        """Log evidence (h,) of each change beside others."""
        given = ways[list(others)]
        score, weight = change_seen(said.information, surprise, expected.covariance + CHANGED * given.T @ given)
        seen, told = np.einsum("hi,ij,hj->h", ways, weight, ways), ways @ score
        found = np.full(len(ways), -np.inf)
        for k in np.flatnonzero((seen > TINY) & ~np.isin(np.arange(len(ways)), list(others))):
            change = expected.changes[k]
            found[k] = odds + _change(told[k] / seen[k], 1.0 / seen[k] + change.further, change.log_weights)
        return found

    found = changes_found(logs, least)
    score, weight = change_seen(said.information, surprise, expected.covariance)
    every = ways @ weight @ ways.T
    told: list[int] = []
    for k in sorted((k for k in found if found[k][k] > least), key=lambda k: -found[k][k]):
        square = every[np.ix_([*told, k], [*told, k])]
        if np.linalg.eigvalsh(unit_diagonal(square, np.diag(square))[0])[0] > ALIKE:
            told.append(k)
    if not told:
        return []
    covariance = np.linalg.inv(every[np.ix_(told, told)])
    gap, sigma = covariance @ ways[told] @ score, np.sqrt(np.diag(covariance))
    units = [unit[expected.changes[k].owners[0], expected.changes[k].constant] for k in told]
    chance = np.minimum(len(ways) * erfc(np.abs(gap) / sigma / np.sqrt(2.0)), 1.0)
    return [
        _contradiction(adjustment, expected.changes, found[k], k, float(g * u), float(s * u), float(c))
        for k, g, s, c, u in zip(told, gap, sigma, chance, units, strict=True)
    ]


def _contradiction(
    adjustment: Adjustment, changes: Sequence[Change], logs: Floats, k: int, gap: float, sigma: float, chance: float
) -> Contradiction:
    """A change in the words of the instruments, its gap and deviation [SI], beside what rivals it."""
    change, parameters = changes[k], adjustment.construction.parameters
    rivals = [i for i, one in enumerate(changes) if one.owners == change.owners]
    share = shares(logs[rivals])
    return Contradiction(
        instruments=tuple(adjustment.recording.instruments[i] for i in change.owners),
        parameter=parameters[change.constant],
        difference=gap,
        sigma=sigma,
        evidence=float(logs[k]),
        p_value=chance,
        against=change.words,
        rivals={
            parameters[changes[rivals[i]].constant]: float(share[i]) for i in np.argsort(-share) if share[i] > NOT_APART
        },
    )


def _change(gap: float, variance: Floats | float, weights: Floats | float) -> float:
    """Log evidence of a change behind a gap, averaged over its variances (s,) by the logs of their weights."""
    variance, weights = np.atleast_1d(variance), np.atleast_1d(weights)
    alike = weights - 0.5 * (gap**2 / variance + np.log(variance))
    changed = alike + log_evidence(((gap / variance) ** 2)[:, None], 1.0 / variance[:, None])
    return float(log_sum_exp(changed) - log_sum_exp(alike))
