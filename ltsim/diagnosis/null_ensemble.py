"""Null ensemble: simulated residuals without any effect, and the basis that projects signatures.

For columns g the Gram matrix g' P g is g' g less the products of g with an orthonormal basis of the estimated
parameters; in a large network it is the mean product with simulated residuals, whose covariance is P. These are
independent of the trials: given them, the recording and the trials are scored by the same function and, without any
effect, exchangeable. Grams and scores are sums over the pointings of g times a few vectors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil
from typing import Any

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.shrinkage import MAX_DENSE_UNKNOWNS
from ltsim.core.arrays import Floats, Ints, Singles, batches
from ltsim.core.randomness import stream
from ltsim.solve.projection import BasisProjection

MIN_SIMULATED_RECORDINGS = 300
"""Smallest number of simulated recordings without any effect: p-values down to 1 / 301."""
MIN_SIMULATED_RECORDINGS_IN_LARGE_NETWORK = 99
"""Smallest number of simulated recordings of a large network (cost): p-values down to 1 / 100."""
N_GRAM_DRAWS = 200
"""Number of simulated residuals for Monte-Carlo Gram matrices: relative standard deviation sqrt(2 / 200), 10 %."""


@dataclass(frozen=True)
class NullEnsemble:
    """Null ensemble: a residual space with the vectors whose products with signatures give scores and Gram matrices.

    Attributes
    ----------
    space : ResidualSpace
    probe_vectors : (m, 1 + t + u) float32
        Residual of the model; residuals of t simulated recordings, by which a search is judged; orthonormal basis of
        the estimated parameters, or with `gram_is_monte_carlo` further simulated residuals.
    n_trials : int
        Number t of simulated recordings; 0 where the search is not judged.
    model_basis : (m, e) float
        Orthonormal basis of the model.
    is_first_pass : bool
        True while the model is empty.
    gram_is_monte_carlo : bool
        True where Gram matrices are means over simulated residuals, for want of a basis.
    """

    space: ResidualSpace
    probe_vectors: Singles
    n_trials: int
    model_basis: Floats
    is_first_pass: bool
    gram_is_monte_carlo: bool

    @classmethod
    def from_space(cls, space: ResidualSpace, seed: int, trials: int) -> NullEnsemble:
        """Ensemble of a residual space, with `simulated_residuals` simulated recordings."""
        basis = exact_basis(space)
        others = N_GRAM_DRAWS if basis is None else basis.shape[1]
        vectors = np.empty((space.n_rows, 1 + trials + others), dtype=np.float32)
        vectors[:, 0] = space.residuals
        _simulate_residuals(space, stream(seed, "diagnose", "null"), vectors[:, 1 : 1 + trials])
        if basis is None:
            _simulate_residuals(space, stream(seed, "diagnose", "gauges"), vectors[:, 1 + trials :])
        else:
            vectors[:, 1 + trials :] = basis
        nothing = np.zeros((space.n_rows, 0))
        return cls(space, vectors, trials, nothing, is_first_pass=True, gram_is_monte_carlo=basis is None)

    def with_model(self, residual: Floats, model_basis: Floats) -> NullEnsemble:
        """Ensemble given a model, with its residual (m,) and orthonormal basis (m, e).

        Gram matrices and null statistics are those of the first pass.
        """
        vectors = residual[:, None].astype(np.float32)
        return replace(self, probe_vectors=vectors, n_trials=0, model_basis=model_basis, is_first_pass=False)

    @property
    def simulated_residuals(self) -> Singles:
        """Residuals (m, t) of simulated recordings."""
        return self.probe_vectors[:, 1 : 1 + self.n_trials]

    @cached_property
    def _row_of_reading(self) -> Ints:
        """Row (n, 3) of each reading; any row for readings that are not used, whose weight is zero."""
        use = self.space.used_readings
        rows = np.zeros(use.shape, dtype=np.int64)
        rows[use] = np.arange(int(use.sum()))
        return rows

    def vectors_at(self, pointings: Ints) -> Singles:
        """Vectors (p, 3, v) at some pointings; only those of used readings are defined."""
        return self.probe_vectors[self._row_of_reading[pointings]]

    def split_products(self, scores: Floats | Singles) -> tuple[Any, Any, Any]:
        """Products (..., k, v) with all vectors, split into those with residual, trials and basis."""
        edge = 1 + self.n_trials
        return scores[..., 0], scores[..., 1:edge], scores[..., edge:]

    def projected_gram(self, scores: Floats | Singles, products: Floats) -> Floats:
        """Gram matrices (..., k, k) of projected columns.

        Parameters
        ----------
        scores : (..., k, v) float
            Products of columns with all vectors, in the first pass.
        products : (..., k, k) float
            Products of the columns with each other.
        """
        squares = row_gram(self.split_products(scores)[2])
        return (
            squares / (self.probe_vectors.shape[1] - 1 - self.n_trials)
            if self.gram_is_monte_carlo
            else products - squares
        )


def exact_basis(space: ResidualSpace) -> Floats | None:
    """Orthonormal basis (m, u) of the estimated parameters; None in a network that is too large for it."""
    projection = space.projector
    is_small = isinstance(projection, BasisProjection) and projection.basis.shape[1] <= MAX_DENSE_UNKNOWNS
    return projection.basis if isinstance(projection, BasisProjection) and is_small else None


def n_simulated_recordings(space: ResidualSpace, level: float) -> int:
    """Number of simulated recordings for a test of false-alarm rate `level`."""
    usual = MIN_SIMULATED_RECORDINGS_IN_LARGE_NETWORK if exact_basis(space) is None else MIN_SIMULATED_RECORDINGS
    return max(usual, ceil(1.0 / level))


def _simulate_residuals(space: ResidualSpace, rng: np.random.Generator, residuals: Singles) -> None:
    """Computation of the residuals (m, count) of simulated recordings, in place."""
    white = rng.standard_normal(residuals.shape)
    for part in batches(white.shape[1], len(white)):
        residuals[:, part] = space.project(white[:, part])


def row_gram(rows: Any) -> Any:
    """Gram matrices (..., k, k) of rows (..., k, v)."""
    return rows @ np.swapaxes(rows, -1, -2)
