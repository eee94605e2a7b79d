"""Hypotheses, sets of findings, rankings: what a search handles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Floats
from ltsim.diagnose.evidence import LOG_WEIGHTS, SECOND_ALIKE, SIZES, log_average
from ltsim.effects import find_effect
from ltsim.effects.signature import Tunable


@dataclass(frozen=True)
class Hypothesis:
    """One thing that may be missing from the model, and the log prior of its place and shape.

    Attributes
    ----------
    effect : Tunable
    log_prior : float
    value : float
        Log evidence beside what was found when it was examined, prior and shapes included.
    name : str
        Tunable id, or `unknown`.
    """

    effect: Tunable
    log_prior: float
    value: float
    name: str

    @property
    def spread(self) -> Floats:
        """Plausible sizes (k,) of its coefficients [SI]."""
        return np.array([p.prior_sigma for p in self.effect.parameters])

    @property
    def known(self) -> bool:
        """Whether the catalogue has a card for it."""
        return self.name != "unknown"

    @property
    def key(self) -> str:
        """What tells two findings apart."""
        return repr(self.effect)


@dataclass(frozen=True)
class Found:
    """A set of findings.

    Attributes
    ----------
    members : tuple of Hypothesis
    left : tuple of (m, k) float
        What the adjustment leaves of their signatures.
    extension : (m, e) float
        Orthonormal columns of all members.
    residual : (m,) float
    score : float
        Log evidence of the set, priors included.
    """

    members: tuple[Hypothesis, ...]
    left: tuple[Floats, ...]
    extension: Floats
    residual: Floats
    score: float


@dataclass(frozen=True)
class Ranking:
    """Hypotheses beside a set in the order of their evidence.

    Attributes
    ----------
    entries : tuple of Hypothesis
    total : float
        Log sum over them, the first computed exactly.
    statistic : float
        Log sum over everything as it was scored at once: what the simulated recordings are compared with.
    null : (trials,) float
        The same of simulated recordings.
    """

    entries: tuple[Hypothesis, ...]
    total: float
    statistic: float
    null: Floats

    def beside(self, rivals: Sequence[Hypothesis]) -> Ranking:
        """The ranking with further hypotheses in it."""
        entries = sorted([*self.entries, *rivals], key=lambda h: -h.value)
        total = float(log_average(np.array([self.total, *(h.value for h in rivals)])))
        return Ranking(tuple(entries), total, self.statistic, self.null)

    def probabilities(self) -> dict[str, float]:
        """Posterior probability of each name among everything that was tried, nothing at all included."""
        logs = np.array([h.value for h in self.entries])
        weight = np.exp(logs - np.logaddexp(log_average(logs), 0.0))
        found: dict[str, float] = {}
        for hypothesis, w in zip(self.entries, weight, strict=True):
            found[hypothesis.name] = found.get(hypothesis.name, 0.0) + float(w)
        return found


def joint(found: Found, residual: Floats, sizes: Floats) -> tuple[Floats, Floats, float]:
    """Mean, covariance and log evidence of all coefficients of a set with prior N(0, (t spread)^2) of each member."""
    left = np.hstack(found.left)
    spread = np.concatenate([t * h.spread for t, h in zip(sizes, found.members, strict=True)])
    scaled = left * spread
    inner = scaled.T @ scaled + np.eye(len(spread))
    score = scaled.T @ residual
    covariance = np.linalg.inv(inner)
    mean = covariance @ score
    weight = float(LOG_WEIGHTS[np.searchsorted(SIZES, sizes)].sum())
    evidence = 0.5 * (float(score @ mean) - float(np.linalg.slogdet(inner)[1])) + weight
    return spread * mean, covariance * np.outer(spread, spread), evidence


def sizes_of(found: Found, residual: Floats) -> Floats:
    """The size t of each member that explains most beside the others, on the grid of sizes."""
    sizes = np.ones(len(found.members))
    for _ in range(2):
        for i in range(len(sizes)):
            tried = []
            for t in SIZES:
                sizes[i] = t
                tried.append(joint(found, residual, sizes)[2])
            sizes[i] = SIZES[int(np.argmax(tried))]
    return sizes


def alike(hypothesis: Hypothesis, others: Sequence[Hypothesis]) -> float:
    """Log odds of a second effect of a kind that hardly comes twice."""
    if not hypothesis.known or hypothesis.name not in {h.name for h in others}:
        return 0.0
    return 0.0 if find_effect(hypothesis.name).plural else SECOND_ALIKE
