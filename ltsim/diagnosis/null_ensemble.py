"""Null ensemble: residuals of simulated recordings without any effect, and the basis that projects design matrices.

A design matrix g has the Gram matrix g' P g in the residual space with projector P. It is g' g minus the squared
products of g with an orthonormal basis of the estimated parameters. In a large network the Gram matrix is instead the
mean squared product of g with simulated residuals, whose covariance is P (Monte Carlo). These residuals are independent
of the simulated recordings that give the p-value (trials). The recording and the trials are scored by the same
function, and without any effect they are exchangeable. Gram matrices and scores are sums over the pointings of g times
a few vectors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil
from typing import Any

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.shrinkage import MAX_DENSE_UNKNOWNS
from ltsim.core.arrays import Floats, Floats32, Ints, batches
from ltsim.core.randomness import random_stream
from ltsim.solve.projection import BasisResidualProjector

MIN_SIMULATED_RECORDINGS = 300
"""Smallest number of simulated recordings without any effect that give a p-value. The smallest p-value is then 1 /
301."""
MIN_SIMULATED_RECORDINGS_IN_LARGE_NETWORK = 99
"""Smallest number of simulated recordings of a large network, smaller to limit the computing time. The smallest p-value
is then 1 / 100."""
N_MONTE_CARLO_GRAM_VECTORS = 200
"""Number of simulated vectors of residuals from which Gram matrices are estimated in a large network. The relative
standard deviation of such a matrix is sqrt(2 / 200), 10 %."""


@dataclass(frozen=True)
class NullEnsemble:
    """Residuals of the recording and of simulations, and a basis, side by side, for products with designs.

    The products with residuals are the scores of a design matrix. The products with the basis give its Gram matrix.

    The products with residuals are the scores of a design matrix. The products with the basis give its Gram matrix.
    """

    residual_space: ResidualSpace
    """Residual space of the adjustment: whitened observations without the part that the unknowns absorb."""
    probe_vectors: Floats32
    """Vectors (m, 1 + t + u) side by side: the residuals given the effects of a model, the residuals of t simulated
    recordings, and an orthonormal basis of u estimated parameters. With `uses_monte_carlo_gram` the basis is replaced
    by u further simulated residuals."""
    n_trials: int
    """Number t of simulated recordings that give the p-value of a search for effects; 0 for a search without
    p-value."""
    model_basis: Floats
    """Orthonormal basis (m, e), e vectors, of the design columns of the effects in the model, projected onto the
    residual space."""
    is_first_screening: bool
    """True for the first screening (approximate evaluation of all effects) in a residual space; later screenings with a
    model use its Gram matrices again."""
    uses_monte_carlo_gram: bool
    """True if the Gram matrices of the effects are estimated as means over simulated residuals.

    This is so in a network that is too large for an orthonormal basis of its estimated parameters.
    """

    @classmethod
    def from_residual_space(cls, space: ResidualSpace, seed: int, n_trials: int) -> NullEnsemble:
        """Ensemble for an adjustment without effects, with `n_trials` recordings simulated from `seed`.

        `space` is the residual space of the adjustment (whitened observations without the part that the unknowns
        absorb).
        """
        basis = parameter_basis_of_small_network(space)
        n_basis_vectors = N_MONTE_CARLO_GRAM_VECTORS if basis is None else basis.shape[1]
        vectors = np.empty((space.n_equations, 1 + n_trials + n_basis_vectors), dtype=np.float32)
        vectors[:, 0] = space.whitened_residuals
        _simulate_residuals(space, random_stream(seed, "diagnose", "null"), vectors[:, 1 : 1 + n_trials])
        if basis is None:
            _simulate_residuals(space, random_stream(seed, "diagnose", "gauges"), vectors[:, 1 + n_trials :])
        else:
            vectors[:, 1 + n_trials :] = basis
        empty_basis = np.zeros((space.n_equations, 0))
        return cls(space, vectors, n_trials, empty_basis, is_first_screening=True, uses_monte_carlo_gram=basis is None)

    def with_model(self, residual: Floats, model_basis: Floats) -> NullEnsemble:
        """Ensemble for the residuals `residual` (m,) given a set of effects with the basis `model_basis` (m, e).

        The e orthonormal vectors of the basis span the changes by the effects. The ensemble has no simulated
        recordings, because the Gram matrices and null values of the adjustment without effects are used again.
        """
        vectors = residual[:, None].astype(np.float32)
        return replace(self, probe_vectors=vectors, n_trials=0, model_basis=model_basis, is_first_screening=False)

    @property
    def simulated_residuals(self) -> Floats32:
        """Residuals (m, t) of m observation equations in t simulated recordings."""
        return self.probe_vectors[:, 1 : 1 + self.n_trials]

    @cached_property
    def _row_of_reading(self) -> Ints:
        """Index (n, 3) of the observation equation of each reading of n pointings; 0 for unused readings."""
        use = self.residual_space.is_used_reading
        row_of_reading = np.zeros(use.shape, dtype=np.int64)
        row_of_reading[use] = np.arange(int(use.sum()))
        return row_of_reading

    def vectors_of_pointings(self, pointings: Ints) -> Floats32:
        """Elements (p, 3, v) of v vectors (residuals, simulations, basis) for p pointings; undefined if unused."""
        return self.probe_vectors[self._row_of_reading[pointings]]

    def split_products(self, scores: Floats | Floats32) -> tuple[Any, Any, Any]:
        """Products of k columns with residuals (..., k), t trials (..., k, t) and u basis vectors (..., k, u).

        The results are the parts of `scores` (..., k, v), the products of k design columns with all v vectors of the
        ensemble side by side.
        """
        edge = 1 + self.n_trials
        return scores[..., 0], scores[..., 1:edge], scores[..., edge:]

    def projected_gram(self, scores: Floats | Floats32, unprojected_gram: Floats | None) -> Floats:
        """Gram matrices (..., k, k) of the k design columns of an effect after projection onto the residual space.

        The residual space is the space of whitened observations without the part that the unknowns absorb.

        Parameters
        ----------
        scores : (..., k, v) float
            Products of the columns with the v vectors of the ensemble (residuals, simulated residuals, basis), without
            effects in the model.
        unprojected_gram : (..., k, k) float, or None
            Products of the columns with each other, without projection; not used with `uses_monte_carlo_gram`, and may
            then be None.
        """
        squares = gram_of_rows(self.split_products(scores)[2])
        if self.uses_monte_carlo_gram:
            return np.asarray(squares / (self.probe_vectors.shape[1] - 1 - self.n_trials))
        assert unprojected_gram is not None
        return np.asarray(unprojected_gram - squares)


def parameter_basis_of_small_network(space: ResidualSpace) -> Floats | None:
    """Orthonormal basis (m, u) of changes of m observations by u parameters; None in a large network."""
    projector = space.projector
    is_small = isinstance(projector, BasisResidualProjector) and projector.basis.shape[1] <= MAX_DENSE_UNKNOWNS
    return projector.basis if isinstance(projector, BasisResidualProjector) and is_small else None


def n_simulated_recordings(space: ResidualSpace, level: float) -> int:
    """Number of simulated recordings for a test with the false-alarm rate `level`."""
    usual = (
        MIN_SIMULATED_RECORDINGS_IN_LARGE_NETWORK
        if parameter_basis_of_small_network(space) is None
        else MIN_SIMULATED_RECORDINGS
    )
    return max(usual, ceil(1.0 / level))


def _simulate_residuals(space: ResidualSpace, rng: np.random.Generator, residuals: Floats32) -> None:
    """Simulation of recordings without any effect; their m whitened residuals fill `residuals` (m, recordings)."""
    white = rng.standard_normal(residuals.shape)
    for part in batches(white.shape[1], len(white)):
        residuals[:, part] = space.project(white[:, part])


def gram_of_rows(rows: Any) -> Any:
    """Gram matrices (..., k, k) of k rows with v elements each, `rows` (..., k, v): products of all pairs of rows."""
    return rows @ np.swapaxes(rows, -1, -2)
