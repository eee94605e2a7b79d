"""What a calibration says without its prior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from ltsim.arrays import Floats
from ltsim.remedies.undetermined import SILENT


@dataclass(frozen=True)
class Evidence:
    """What a calibration's readings say without its prior, in units of common prior sigmas."""

    remaining: Floats
    """(p, p): covariance after the calibration."""
    information: Floats
    """(p, p): inverse covariance less that of the prior; exactly 0 for combinations with a gain under `SILENT`."""
    told: Floats
    """(p,): `information` times the estimate that the readings alone would give."""


def evidence(values: Floats, covariance: Floats, prior_sigma: Floats, unit: Floats) -> Evidence:
    """The evidence of estimates (p,) with covariance (p, p) under priors (p,) centred at 0, in units (p,), all [SI]."""
    prior = prior_sigma / unit
    remaining = covariance / np.outer(unit, unit)
    shares, vectors = linalg.eigh(remaining / np.outer(prior, prior))
    heard = 1.0 - shares > SILENT
    inverse = np.where(heard, 1.0 / np.where(heard, shares, 1.0), 0.0)
    basis = vectors / prior[:, None]
    information = (basis * np.where(heard, inverse - 1.0, 0.0)) @ basis.T
    told = (basis * inverse) @ basis.T @ (values / unit)
    return Evidence(0.5 * (remaining + remaining.T), information, told)


def change_seen(information: Floats, surprise: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Score (p,) and weight (p, p) of a change of each parameter beyond what `variance` (p, p) lets it be.

    `surprise` is `told` less `information` times what is expected; score / weight[k, k] estimates a change of
    parameter k alone, with the variance 1 / weight[k, k].
    """
    keeps = np.linalg.inv(np.eye(len(surprise)) + information @ variance)
    return keeps @ surprise, keeps @ information
