"""A linear least-squares step with most unknowns eliminated block by block.

Unknowns come in two kinds: *reduced* ones (K columns) and *eliminated* ones, in blocks of three that no row shares with
another such block. Normal equations then have a block-diagonal part that is inverted block by block, and what remains
is the Schur complement of size K: cost is linear in the number of blocks.

Columns are scaled to unit norm before anything is factorised, so no rank is ever decided by an absolute number.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import NetworkError
from ltsim.solve.design import DOUBTFUL, RANK, Design
from ltsim.solve.elimination import DenseElimination, SparseElimination
from ltsim.solve.threads import single_threaded

UNDETERMINED = "the observations leave some unknowns undetermined: let stations share more targets, check stated noise"


@dataclass(frozen=True)
class BlockSystem:
    """A whitened linear system: minimise |design @ step - residual|^2."""

    design: Design
    """Reduced columns first, (m, K + 3 E)."""
    residual: Floats
    """Observed minus predicted, over sigma, (m,)."""
    n_reduced: int
    """K, the number of unknowns that are not eliminated: the size of the Schur complement."""

    @property
    def cost(self) -> float:
        """Sum of squares."""
        return float(self.residual @ self.residual)


class SingularSystemError(NetworkError):
    """The rows leave a direction of the unknowns undetermined (`ltsim.solve.design`)."""


class BlockFactor:
    """The factorised normal equations of a `BlockSystem`, with Levenberg-Marquardt damping.

    SingularSystemError when the rows and the damping leave a direction undetermined.

    Parameters
    ----------
    system : BlockSystem
    damping : float
        Added to the unit diagonal of the scaled normal matrix.
    """

    @single_threaded
    def __init__(self, system: BlockSystem, damping: float = 0.0) -> None:
        self._system, self._damping, design = system, damping, system.design
        self._elimination: DenseElimination | SparseElimination
        try:
            if isinstance(design, np.ndarray):
                self._elimination = DenseElimination(design, system.n_reduced, damping)
            else:
                self._elimination = SparseElimination(design, system.n_reduced, damping)
        except np.linalg.LinAlgError as error:
            raise SingularSystemError(UNDETERMINED) from error
        self._scale = self._elimination.scale
        if self._elimination.smallest_pivot < DOUBTFUL and damping + self._weakest() <= RANK:
            raise SingularSystemError(UNDETERMINED)

    def __reduce__(self) -> tuple[type[BlockFactor], tuple[BlockSystem, float]]:
        """Constructor and arguments for pickling: the system, which is smaller than its factor."""
        return BlockFactor, (self._system, self._damping)

    def _weakest(self) -> float:
        """Squared length of the image of the weakest direction, by inverse iteration; accurate however small."""
        vector = np.cos(np.arange(len(self._scale), dtype=np.float64))[:, None]
        for _ in range(3):
            vector = self._elimination.solve(vector / np.linalg.norm(vector))
        image = self._system.design @ (self._scale * vector[:, 0] / np.linalg.norm(vector))
        return float(image @ image)

    def step(self, residual: Floats | None = None) -> Floats:
        """The damped Gauss-Newton step (K + 3 E,) for the system's residual, or another (m,) of the same design."""
        right = self._system.design.T @ (self._system.residual if residual is None else residual)
        return self.covariance_columns(right[:, None])[:, 0]

    @single_threaded
    def reduced_covariance(self) -> Floats:
        """Covariance (K, K) of the reduced unknowns."""
        scale = self._scale[: self._system.n_reduced]
        return self._elimination.reduced_inverse * np.outer(scale, scale)

    @single_threaded
    def inverse_of_sets(self, columns: Ints) -> Floats:
        """Covariance (c, k, k) of sets (c, k) of reduced unknowns; cheap where a row of the design holds each set."""
        scale = self._scale[columns]
        return self._elimination.inverse_of_sets(columns) * scale[:, :, None] * scale[:, None, :]

    @single_threaded
    def block_covariance(self) -> Floats:
        """Covariance (E, 3, 3) of each eliminated block."""
        scale = self._scale[self._system.n_reduced :].reshape(-1, 3)
        return self._elimination.blocks_and_leverage[0] * scale[:, :, None] * scale[:, None, :]

    @single_threaded
    def covariance_columns(self, rows: Floats) -> Floats:
        """Covariance times given directions: (K + 3 E, c) for `rows` (K + 3 E, c)."""
        return self._scale[:, None] * self._elimination.solve(self._scale[:, None] * rows)

    @property
    def smallest_pivot(self) -> float:
        """The smallest pivot for unit columns."""
        return self._elimination.smallest_pivot

    def forms(self, rows: sp.csr_array, edges: Ints) -> Iterator[Floats]:
        """Covariance R N^-1 R' of groups of functions (q, K + 3 E): group i are the rows edges[i] to edges[i + 1]."""
        return self._elimination.forms(rows, edges)

    @single_threaded
    def leverage(self) -> Floats:
        """Leverage (m,) of each row: the share of its own value in its fitted value; redundancy is one minus it."""
        return self._elimination.blocks_and_leverage[1]
