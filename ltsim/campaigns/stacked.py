"""Network adjustment of a batch of trials with a separate geometry per trial."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg.lapack import dpotrs

from ltsim.adjustment.problem import NetworkProblem
from ltsim.campaigns.network import BatchNetwork
from ltsim.core.arrays import Floats, Ints


@dataclass(frozen=True)
class Stacked(BatchNetwork):
    """Networks of the same pointings in different places, a trial each, adjusted side by side.

    Its state, its program and what is below end in the trial; `recording` is that of the first.
    """

    parts: tuple[BatchNetwork, ...] = ()
    """The network of each trial."""

    @cached_property
    def problem(self) -> NetworkProblem:
        """The problem of the first trial."""
        return self.parts[0].problem

    def step(self, gradient: Floats) -> Floats:
        """The step of each trial by its own normal matrix."""
        step = np.empty_like(gradient)
        for trial, (root, scale) in enumerate(part.root for part in self.parts):
            step[:, trial] = scale * dpotrs(root.T, scale * gradient[:, trial])[0]
        return step

    @cached_property
    def sigma_values(self) -> Floats:
        """Standard deviation (I, p, B) [SI] of the parameters."""
        return np.stack([part.sigma_values for part in self.parts], axis=-1)

    @cached_property
    def sigma(self) -> Floats:
        """Standard deviation (n, 3, B) of the readings."""
        return np.stack([part.sigma for part in self.parts], axis=-1)

    @cached_property
    def _by_point(self) -> Floats:
        return np.stack([part._by_point for part in self.parts], axis=-1)

    @cached_property
    def _expected_shift(self) -> Floats | None:
        shifts = [shift for part in self.parts if (shift := part._expected_shift) is not None]
        return np.concatenate(shifts, axis=-1) if shifts else None

    @cached_property
    def _felt(self) -> tuple[Ints, Floats, Floats]:
        count = 3 * len(self.recording)
        flat = [part._extra_design.reshape(count, -1) for part in self.parts]
        rows = np.flatnonzero(np.any([design.any(axis=1) for design in flat], axis=0))
        design = np.stack([design[rows] for design in flat])
        sigma = np.stack([part.sigma.ravel()[rows] for part in self.parts])
        return rows, design, design / sigma[:, :, None]

    @cached_property
    def _others(self) -> tuple[Floats, Floats]:
        designs, nominal = zip(*(part._others for part in self.parts), strict=True)
        return np.stack(designs), np.concatenate(nominal, axis=1)

    def _linear_start(self, deviation: Floats, gauge_error: Floats | None) -> tuple[Floats, Floats]:
        x, predicted = np.zeros((self.sizes[-1], deviation.shape[2])), np.zeros_like(deviation)
        gradient, cost = np.empty_like(x), np.empty(x.shape[1])
        arguments = deviation, gauge_error, predicted, gradient, cost
        self._gradient(x, *arguments)
        x += self.step(gradient)
        self._gradient(x, *arguments)  # the predicted readings settle
        return x, predicted
