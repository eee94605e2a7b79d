"""Prior distribution of the instrument parameters: normal, or fixed at a value."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.recordings.recording import Recording

CORRECTED_INSTRUMENT_SIGMA_FRACTION = 0.3
"""Standard deviation of a parameter of an instrument that was calibrated and corrects its readings, divided by the
standard deviation of its specification; for parameters without a declared prior. The value is a compromise: after an
ordinary calibration the ratio is 0.1 (a beam tilt of 10 urad is determined to about 1 urad); in real halls parameters
of corrected instruments scatter by half of the specification and more."""
WIDENED_PRIOR_SIGMA_FACTOR = 100.0
"""Factor by which the prior standard deviation of a parameter is multiplied if the readings contradict the prior."""


@dataclass(frozen=True)
class ParameterPrior:
    """Normal prior of the p parameters of each of I instruments; different instruments are independent."""

    mean: Floats
    """Prior means (I, p) [SI] of the p parameters of each of I instruments."""
    covariance: Floats
    """Prior covariances (I, p, p) [SI] of the p parameters of each of I instruments; infinite variances mean no prior.
    """
    is_fixed: Bools
    """Flags (I, p), True for those parameters of the I instruments that are fixed at their prior mean."""

    @classmethod
    def from_sigmas(cls, sigma: Floats) -> ParameterPrior:
        """Prior with mean zero, no correlations, and the standard deviations `sigma` (I, p) [SI].

        There are p parameters of each of I instruments; `sigma` is infinite for parameters without a prior.
        """
        covariance = np.where(np.eye(sigma.shape[1], dtype=bool), sigma[:, :, None] ** 2, 0.0)
        return cls(np.zeros(sigma.shape), covariance, np.zeros(sigma.shape, dtype=bool))

    def with_widened_sigmas(self, widened_mask: Bools) -> ParameterPrior:
        """Prior whose standard deviations are multiplied by `WIDENED_PRIOR_SIGMA_FACTOR` for some parameters.

        `widened_mask` (I, p) flags them among the p parameters of each of I instruments.
        """
        factor = np.where(widened_mask, WIDENED_PRIOR_SIGMA_FACTOR, 1.0)
        return ParameterPrior(self.mean, self.covariance * factor[:, :, None] * factor[:, None, :], self.is_fixed)

    @property
    def sigma(self) -> Floats:
        """Prior standard deviations (I, p) [SI] of p parameters of each of I instruments; infinite without a prior."""
        return np.sqrt(np.einsum("ipp->ip", self.covariance))

    @cached_property
    def has_correlations(self) -> bool:
        """True if the prior covariance of at least one instrument has a correlation."""
        return bool(np.any(self.covariance[:, ~np.eye(self.mean.shape[1], dtype=bool)]))

    @cached_property
    def whitening_matrices(self) -> Floats:
        """Matrices (I, p, p), one per instrument, that whiten deviations of its p parameters from the prior mean."""
        sigma = self.sigma
        correlation = self.covariance / (sigma[:, :, None] * sigma[:, None, :])
        lower_factor = np.linalg.cholesky(correlation)
        return np.linalg.inv(lower_factor) / sigma[:, None, :]

    def whitened_residuals(self, parameter_values: Floats) -> Floats:
        """Whitened differences (m,) prior mean minus value, for the m parameters with a prior.

        `parameter_values` (I, p) [SI] are the values of the p parameters of all I instruments.
        """
        gap = self.mean - parameter_values
        if self.has_correlations:
            return np.einsum("iqp,ip->iq", self.whitening_matrices, gap).ravel()
        finite = np.isfinite(self.sigma)
        return gap[finite] / self.sigma[finite]


def prior_sigmas(recording: Recording, construction: GeometricErrorModel) -> Floats:
    """Prior standard deviations (I, p) [SI] of the p parameters of each of I instruments, from `setup.toml`."""
    priors = [recording.setup.instrument_named(name).prior for name in recording.instruments]
    sigma_rows = [[p.prior_sigma_from(prior) for p in construction.parameters] for prior in priors]
    return np.array(sigma_rows, dtype=np.float64).reshape(len(priors), construction.n_parameters)


def expected_error_sigmas(recording: Recording, construction: GeometricErrorModel) -> Floats:
    """Expected standard deviations (I, p) [SI] of the instrument errors in the readings, p for each of I instruments.

    They equal `prior_sigmas`, except for a corrected instrument: for its parameters without a declared prior, the prior
    standard deviations are multiplied by `CORRECTED_INSTRUMENT_SIGMA_FRACTION`.
    """
    sigma, names = prior_sigmas(recording, construction), construction.parameter_names
    instruments = map(recording.setup.instrument_named, recording.instruments)
    for of_instrument, instrument in zip(sigma, instruments, strict=True):
        if instrument.corrected:
            of_instrument[[name not in instrument.prior.parameters for name in names]] *= (
                CORRECTED_INSTRUMENT_SIGMA_FRACTION
            )
    return sigma
