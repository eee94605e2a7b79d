"""Null ensemble: simulated residuals without any effect, and the basis that projects signatures.

For columns g the Gram matrix g' P g is g' g less the products of g with an orthonormal basis of the estimated
parameters; in a large network it is the mean product with simulated residuals, whose covariance is P. These are
independent of the trials: given them, the recording and the trials are scored by the same function and, without any
effect, exchangeable. Grams and scores are sums over the pointings of g times a few vectors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Floats, Singles
from ltsim.core.randomness import stream
from ltsim.solve.projection import BasisProjection

TRIALS = 300
"""Smallest number of simulated recordings without any effect: p-values down to 1 / 301."""
GRAM_DRAWS = 200
"""Number of simulated residuals for Monte-Carlo Gram matrices: relative standard deviation sqrt(2 / 200), 10 %."""
MOST_UNKNOWNS = 500
"""Largest number of unknowns of a network whose Gram matrices use the basis (cost)."""


@dataclass(frozen=True)
class NullEnsemble:
    """Null ensemble: a residual space with the vectors whose products with signatures give scores and Gram matrices.

    Attributes
    ----------
    space : ResidualSpace
    residual : (m,) float
        Residual of the model.
    model_basis : (m, e) float
        Orthonormal basis of the model.
    trials : (m, t) float32
        Residuals of simulated recordings, by which a search is judged; none where it is not.
    basis : (m, u) float32
        Orthonormal basis of the estimated parameters; with `gram_is_monte_carlo` simulated residuals instead, drawn
        independently of the `trials`.
    is_first_pass : bool
        True while the model is empty.
    gram_is_monte_carlo : bool
        True where Gram matrices are means over simulated residuals, for want of a basis.
    """

    space: ResidualSpace
    residual: Floats
    model_basis: Floats
    trials: Singles
    basis: Singles
    is_first_pass: bool
    gram_is_monte_carlo: bool

    @classmethod
    def of(cls, space: ResidualSpace, seed: int, trials: int) -> NullEnsemble:
        """Ensemble of a residual space, with `trials` simulated recordings."""
        projection = space.projector
        sampled = not (isinstance(projection, BasisProjection) and projection.basis.shape[1] <= MOST_UNKNOWNS)
        null = _simulated(space, stream(seed, "diagnose", "null"), trials)
        basis = _simulated(space, stream(seed, "diagnose", "gauges"), GRAM_DRAWS) if sampled else None
        if isinstance(projection, BasisProjection) and basis is None:
            basis = projection.basis.astype(np.float32)
        assert basis is not None
        nothing = np.zeros((space.n_rows, 0))
        return cls(space, space.residuals, nothing, null, basis, is_first_pass=True, gram_is_monte_carlo=sampled)

    def with_model(self, residual: Floats, model_basis: Floats) -> NullEnsemble:
        """Ensemble given a model, with its residual (m,) and orthonormal basis (m, e).

        Gram matrices and null statistics are those of the first pass.
        """
        none = self.trials[:, :0]
        return replace(self, residual=residual, model_basis=model_basis, trials=none, basis=none, is_first_pass=False)

    @cached_property
    def vectors(self) -> Singles:
        """Vectors (m, v): residual, trials, basis."""
        return np.hstack([part.astype(np.float32) for part in (self.residual[:, None], self.trials, self.basis)])

    @cached_property
    def pointings(self) -> Singles:
        """Vectors (n, 3, v) by pointing; zero for readings that are not used."""
        use = self.space.used_readings
        full = np.zeros((*use.shape, self.vectors.shape[1]), dtype=np.float32)
        full[use] = self.vectors[: int(use.sum())]
        return full

    def split(self, scores: Floats | Singles) -> tuple[Any, Any, Any]:
        """Products (..., k, v) with all vectors, split into those with residual, trials and basis."""
        edge = 1 + self.trials.shape[1]
        return scores[..., 0], scores[..., 1:edge], scores[..., edge:]

    def gram(self, scores: Floats | Singles, products: Floats) -> Floats:
        """Gram matrices (..., k, k) of projected columns.

        Parameters
        ----------
        scores : (..., k, v) float
            Products of columns with all vectors, in the first pass.
        products : (..., k, k) float
            Products of the columns with each other.
        """
        squares = square(self.split(scores)[2])
        return squares / self.basis.shape[1] if self.gram_is_monte_carlo else products - squares


def _simulated(space: ResidualSpace, rng: np.random.Generator, count: int) -> Singles:
    """Residuals (m, count) of simulated recordings."""
    white = rng.standard_normal((space.n_rows, count))
    return (space.project(white) if count else white).astype(np.float32)


def square(rows: Any) -> Any:
    """Gram matrices (..., k, k) of rows (..., k, v)."""
    return rows @ np.swapaxes(rows, -1, -2)
