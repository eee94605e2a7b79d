"""Prior distribution of the instrument parameters, normal or fixed at a value."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.recordings.recording import Recording

CORRECTED_INSTRUMENT_SIGMA_FRACTION = 0.3
"""Standard deviation of an instrument parameter of a corrected instrument, divided by that of its specification, for
parameters without a declared prior. The value is a compromise: after an ordinary calibration the ratio is 0.1 (a beam
tilt of 10 urad is determined to about 1 urad); in real halls parameters of corrected instruments scatter by half of the
specification and more."""
WIDENED_SIGMA_FACTOR = 100.0
"""Factor on the prior standard deviation of a parameter whose prior the readings contradict."""


@dataclass(frozen=True)
class ParameterPrior:
    """Normal prior of the p parameters of each of I instruments; instruments are independent."""

    mean: Floats
    """Prior mean of each of p parameters of each of I instruments, (I, p) [SI]."""
    covariance: Floats
    """Prior covariance of the p parameters of each of I instruments, (I, p, p) [SI]."""
    is_fixed: Bools
    """Flags (I, p), True for those of the p parameters of each of I instruments that are fixed at their mean."""

    @classmethod
    def from_sigmas(cls, sigma: Floats) -> ParameterPrior:
        """Uncorrelated priors of p parameters of each of I instruments, with mean zero and standard deviations `sigma`.

        `sigma` (I, p) [SI] is infinite for parameters without a prior.
        """
        covariance = np.where(np.eye(sigma.shape[1], dtype=bool), sigma[:, :, None] ** 2, 0.0)
        return cls(np.zeros(sigma.shape), covariance, np.zeros(sigma.shape, dtype=bool))

    def with_widened_sigmas(self, widened_mask: Bools) -> ParameterPrior:
        """Prior with `WIDENED_SIGMA_FACTOR` times larger standard deviations of the parameters in `widened_mask`.

        The mask (I, p) has one flag for each of p parameters of each of I instruments.
        """
        factor = np.where(widened_mask, WIDENED_SIGMA_FACTOR, 1.0)
        return ParameterPrior(self.mean, self.covariance * factor[:, :, None] * factor[:, None, :], self.is_fixed)

    @property
    def sigma(self) -> Floats:
        """Prior standard deviations (I, p) [SI] of p parameters of each of I instruments; infinite without a prior."""
        return np.sqrt(np.einsum("ipp->ip", self.covariance))

    @cached_property
    def has_correlations(self) -> bool:
        """True if at least two parameters of an instrument are correlated."""
        return bool(np.any(self.covariance[:, ~np.eye(self.mean.shape[1], dtype=bool)]))

    @cached_property
    def whitening_matrices(self) -> Floats:
        """Matrices (I, p, p), one of p parameters for each of I instruments, that whiten deviations from the mean."""
        sigma = self.sigma
        correlation = self.covariance / (sigma[:, :, None] * sigma[:, None, :])
        lower_factor = np.linalg.cholesky(correlation)
        return np.linalg.inv(lower_factor) / sigma[:, None, :]

    def whitened_residuals(self, parameter_values: Floats) -> Floats:
        """Whitened deviations (m,) of the m parameters with a prior from their prior means.

        `parameter_values` (I, p) [SI] are the values of the p parameters of all I instruments.
        """
        gap = self.mean - parameter_values
        if self.has_correlations:
            return np.einsum("iqp,ip->iq", self.whitening_matrices, gap).ravel()
        finite = np.isfinite(self.sigma)
        return gap[finite] / self.sigma[finite]


def prior_sigmas(recording: Recording, construction: GeometricErrorModel) -> Floats:
    """Prior standard deviations (I, p) [SI] of the p geometric error parameters of each of I instruments."""
    priors = [recording.setup.instrument_named(name).prior for name in recording.instruments]
    sigma_rows = [[p.prior_sigma_from(prior) for p in construction.parameters] for prior in priors]
    return np.array(sigma_rows, dtype=np.float64).reshape(len(priors), construction.n_parameters)


def expected_error_sigmas(recording: Recording, construction: GeometricErrorModel) -> Floats:
    """Expected standard deviations (I, p) [SI] of the p errors of each of I instruments that the readings contain.

    They equal `prior_sigmas`, except for parameters of a corrected instrument without a declared prior: these standard
    deviations are multiplied by `CORRECTED_INSTRUMENT_SIGMA_FRACTION`.
    """
    sigma, names = prior_sigmas(recording, construction), construction.parameter_names
    instruments = map(recording.setup.instrument_named, recording.instruments)
    for of_instrument, instrument in zip(sigma, instruments, strict=True):
        if instrument.corrected:
            of_instrument[[name not in instrument.prior.parameters for name in names]] *= (
                CORRECTED_INSTRUMENT_SIGMA_FRACTION
            )
    return sigma
