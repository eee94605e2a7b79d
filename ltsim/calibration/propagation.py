"""How the error of parameters that were found beforehand spreads through the adjustment of the corrected readings.

With e the whitened noise of readings and gauge, A the adjustment, D its design, B the design of the parameters and
dx their error, the network errs by A e - A B dx and leaves the residuals R e - R B dx, R = 1 - D A. The parameters
come from the same readings: their error is correlated with e, and an estimator other than the adjustment's own leaves
more in the residuals than the degrees of freedom say. Both follow from the covariance of dx and its covariance with e.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import special

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.prior import prior_sigmas
from ltsim.arrays import Floats, Ints
from ltsim.calibration.distance_solver import Estimate
from ltsim.model.construction import Construction
from ltsim.model.measurement import MeasurementModel, State
from ltsim.recording.recording import Recording
from ltsim.solve.design import as_dense


@dataclass(frozen=True)
class Propagation:
    """An estimate of the parameters and the adjustment of the readings that they correct."""

    recording: Recording
    """As it was measured."""
    construction: Construction
    values: Floats
    """(I, p)."""
    estimate: Estimate
    adjustment: Adjustment
    """Of the corrected readings, without parameters."""

    @cached_property
    def _used(self) -> Ints:
        return np.flatnonzero(self.adjustment.problem.use.ravel())

    @cached_property
    def _design(self) -> Floats:
        """(m, size) whitened design of readings and gauge."""
        rows = len(self._used) + len(self.adjustment.problem.gauge)
        return as_dense(self.adjustment.solution.system.design[:rows])

    @cached_property
    def _response(self) -> Floats:
        """(size, m): A."""
        return self.adjustment.factor.covariance_columns(np.ascontiguousarray(self._design.T))

    @cached_property
    def _by_parameter(self) -> Floats:
        """(m, I p): B in units of the prior sigmas; gauge lengths do not depend on the parameters."""
        recording, (count, size) = self.recording, self.values.shape
        state = self.adjustment.state
        at = State(state.position, state.rotation, state.points, self.values)
        by_value = MeasurementModel(recording, self.construction).linearised(at).by_instrument
        prior = prior_sigmas(recording, self.construction)[recording.instrument]
        wide = np.zeros((len(recording), 3, count, size))
        wide[np.arange(len(recording)), :, recording.instrument] = by_value * prior[:, None, :]
        whitened = (wide / self.adjustment.problem.sigma[:, :, None, None]).reshape(-1, count * size)
        gauge = np.zeros((len(self.adjustment.problem.gauge), count * size))
        return np.concatenate([whitened[self._used], gauge])

    @cached_property
    def _with_noise(self) -> Floats:
        """(m, I p): covariance of the whitened noise with the parameters' error."""
        readings = 3 * len(self.recording)
        noise = self.estimate.noise
        return np.concatenate([noise[:, self._used], noise[:, readings:]], axis=1).T

    def added_covariance(self) -> Floats:
        """What the parameters' error adds to the covariance (size, size) of the adjustment."""
        through = self._response @ self._by_parameter
        crossed = (self._response @ self._with_noise) @ through.T
        return through @ self.estimate.covariance @ through.T - crossed - crossed.T

    def _residual_part(self, columns: Floats) -> Floats:
        return columns - self._design @ (self._response @ columns)

    def chi2_moments(self) -> tuple[float, float]:
        """Expected value and variance of the adjustment's chi-square, if model and stated noise hold."""
        left, noise = self._residual_part(self._by_parameter), self._residual_part(self._with_noise)
        both = np.concatenate([left, noise], axis=1)
        one = np.eye(left.shape[1])
        mixed = np.block([[self.estimate.covariance, -one], [-one, np.zeros_like(one)]]) @ (both.T @ both)
        free = float(self.adjustment.dof)
        return free + float(np.trace(mixed)), 2 * (free + 2 * float(np.trace(mixed)) + float(np.sum(mixed * mixed.T)))

    def chi2_tail(self, chi2: float) -> float:
        """Chance of a larger chi-square (Satterthwaite's approximation by a scaled chi-square)."""
        mean, variance = self.chi2_moments()
        scale = variance / (2 * mean)
        return float(special.chdtrc(mean / scale, max(chi2 / scale, 0.0)))
