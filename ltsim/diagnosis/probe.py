"""Vectors by which signatures are judged: what the adjustment leaves of them, and what chance would make of them.

For columns g the Gram matrix g' P g is g' g less the products of g with an orthonormal basis of what is estimated; in a
large network it is the mean product with simulated residuals, whose covariance is P. Both, and the scores of the
recording's own residuals, are sums over the pointings of g times a few vectors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.arrays import Floats, Singles
from ltsim.randomness import stream
from ltsim.solve.projection import BasisProjection

TRIALS = 300
"""Simulated recordings without any effect, by which a search is judged."""
MOST_UNKNOWNS = 500
"""Unknowns up to which what an adjustment absorbs is computed with its basis."""


@dataclass(frozen=True)
class Probe:
    """A residual space with the vectors that scores are taken with.

    Attributes
    ----------
    space : ResidualSpace
    residual : (m,) float
        What is left beside what was found already.
    extension : (m, e) float
        Orthonormal columns of that.
    trials : (m, t) float32
        Simulated residuals.
    basis : (m, u) float32, or None
    fresh : bool
        Whether nothing was found yet.
    sampled : bool
        Whether Gram matrices are means over simulated residuals, for want of a basis.
    judged : bool
        Whether the simulated residuals are scored too, to judge a search by.
    """

    space: ResidualSpace
    residual: Floats
    extension: Floats
    trials: Singles
    basis: Singles | None
    fresh: bool
    sampled: bool
    judged: bool

    @classmethod
    def of(cls, space: ResidualSpace, seed: int, *, judged: bool) -> Probe:
        """The probe of a residual space; with simulated residuals where a search is `judged`, or there is no basis."""
        basis = None
        if isinstance(space.projection, BasisProjection) and space.projection.basis.shape[1] <= MOST_UNKNOWNS:
            basis = space.projection.basis.astype(np.float32)
        white = stream(seed, "diagnose", "null").standard_normal((space.size, TRIALS if judged or basis is None else 0))
        trials = space.project(white).astype(np.float32)
        nothing = np.zeros((space.size, 0))
        return cls(space, space.residual, nothing, trials, basis, fresh=True, sampled=basis is None, judged=judged)

    def beside(self, residual: Floats, extension: Floats) -> Probe:
        """The same beside what was found: its residual (m,) and orthonormal columns (m, e).

        What the adjustment leaves of every signature, and what chance makes of it, is known by then.
        """
        return replace(self, residual=residual, extension=extension, trials=self.trials[:, :0], basis=None, fresh=False)

    @property
    def scored(self) -> int:
        """Number of simulated recordings that are scored too."""
        return self.trials.shape[1] if self.judged else 0

    @cached_property
    def vectors(self) -> Singles:
        """Vectors (m, v): residual, trials, basis."""
        basis = self.trials[:, :0] if self.basis is None else self.basis
        return np.hstack([part.astype(np.float32) for part in (self.residual[:, None], self.trials, basis)])

    @cached_property
    def pointings(self) -> Singles:
        """Vectors (n, 3, v) by pointing; zero for readings that are not used."""
        use = self.space.use
        full = np.zeros((*use.shape, self.vectors.shape[1]), dtype=np.float32)
        full[use] = self.vectors[: int(use.sum())]
        return full

    def split(self, scores: Floats | Singles) -> tuple[Any, Any, Any]:
        """Products (..., k, v) with all vectors, as those with the residual, trials, basis."""
        edge = 1 + self.trials.shape[1]
        return scores[..., 0], scores[..., 1:edge], scores[..., edge:]

    def gram(self, scores: Floats | Singles, own: Floats) -> Floats:
        """Gram matrices (..., k, k) of what the adjustment leaves of columns.

        Parameters
        ----------
        scores : (..., k, v) float
            Products of columns with all vectors, nothing found yet.
        own : (..., k, k) float
            Products of the columns with each other.
        """
        _, trials, basis = self.split(scores)
        return own - square(basis) if self.basis is not None else square(trials) / trials.shape[-1]


def square(rows: Any) -> Any:
    """Products (..., k, k) of rows (..., k, v) with each other."""
    return rows @ np.swapaxes(rows, -1, -2)
