"""Prior of the instrument parameters: a normal distribution, or a value that is held."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.physics.model.construction import Construction
from ltsim.recordings.recording import Recording

CORRECTED_SHARE = 0.3
"""Prior sigma of a corrected constant, in the maker's guarantees; nobody declares it, and no correction is exact. It
is between the share to which an ordinary calibration determines it on the day (0.1: a beam tilt of 10 urad to about 1)
and all of it: the constants of instruments reported as corrected scatter in real halls by half a guarantee and more."""
FREED = 100.0
"""Stated sigmas that a parameter may be off once the readings contradict its prior; no instrument's are off more."""


@dataclass(frozen=True)
class ParameterPrior:
    """A normal prior of the parameters of each instrument; instruments are independent of each other."""

    mean: Floats
    """(I, p) [SI]."""
    covariance: Floats
    """(I, p, p) [SI]."""
    held: Bools
    """Parameters that stay at their mean whatever the readings say, (I, p)."""

    @classmethod
    def independent(cls, sigma: Floats) -> ParameterPrior:
        """Independent priors around zero with standard deviations (I, p) [SI]; infinite for none."""
        covariance = np.where(np.eye(sigma.shape[1], dtype=bool), sigma[:, :, None] ** 2, 0.0)
        return cls(np.zeros(sigma.shape), covariance, np.zeros(sigma.shape, dtype=bool))

    def widened(self, freed: Bools) -> ParameterPrior:
        """The prior with some parameters (I, p) practically free."""
        factor = np.where(freed, FREED, 1.0)
        return ParameterPrior(self.mean, self.covariance * factor[:, :, None] * factor[:, None, :], self.held)

    @property
    def sigma(self) -> Floats:
        """Standard deviations (I, p) [SI]."""
        return np.sqrt(np.einsum("ipp->ip", self.covariance))

    @cached_property
    def correlated(self) -> bool:
        """True if any two parameters are correlated."""
        return bool(np.any(self.covariance[:, ~np.eye(self.mean.shape[1], dtype=bool)]))

    @cached_property
    def roots(self) -> Floats:
        """Matrices (I, p, p) that make the parameters' deviations from their mean standard normal."""
        sigma = self.sigma
        correlation = self.covariance / (sigma[:, :, None] * sigma[:, None, :])
        lower = np.linalg.cholesky(correlation)
        return np.linalg.inv(lower) / sigma[:, None, :]

    def residual(self, values: Floats) -> Floats:
        """Whitened rows (m,) of values (I, p): one a parameter with a prior."""
        gap = self.mean - values
        if self.correlated:
            return np.einsum("iqp,ip->iq", self.roots, gap).ravel()
        finite = np.isfinite(self.sigma)
        return gap[finite] / self.sigma[finite]


def prior_sigmas(recording: Recording, construction: Construction) -> Floats:
    """Prior standard deviations (I, p) [SI] of the construction's parameters for each instrument of a recording."""
    chosen = [recording.setup.instrument_named(name).prior for name in recording.instruments]
    rows = [[p.sigma_from(prior) for p in construction.parameters] for prior in chosen]
    return np.array(rows, dtype=np.float64).reshape(len(chosen), construction.size)


def expected_sigmas(recording: Recording, construction: Construction) -> Floats:
    """The same (I, p), where an instrument is said to be corrected what that leaves, unless a parameter's is stated."""
    sigma, names = prior_sigmas(recording, construction), construction.names
    instruments = map(recording.setup.instrument_named, recording.instruments)
    for of_instrument, instrument in zip(sigma, instruments, strict=True):
        if instrument.corrected:
            of_instrument[[name not in instrument.prior.parameters for name in names]] *= CORRECTED_SHARE
    return sigma
