"""One linear least-squares step with most unknowns eliminated block by block.

Unknowns come in two kinds: *kept* ones (a dense block of K columns) and *eliminated* ones, in blocks of three that
no row
shares with another such block. Normal equations then have a block-diagonal part that is inverted block by
block, and what remains is the Schur complement of size K: cost is linear in the number of blocks.

Columns are scaled to unit norm before anything is factorised, so no rank is ever decided by an absolute number.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from ltsim.arrays import Floats

ROUNDING = 1e-13
"""Squared share of a unit column that the other columns leave, below which it is rounding error."""


@dataclass(frozen=True)
class BlockSystem:
    """A whitened linear system: minimise |design @ step - residual|^2.

    Attributes
    ----------
    design : (m, K + 3 E) sparse
        Kept columns first.
    residual : (m,) float
        Observed minus predicted, over sigma.
    kept : int
        K.
    """

    design: sp.csr_array
    residual: Floats
    kept: int

    @property
    def cost(self) -> float:
        """Sum of squares."""
        return float(self.residual @ self.residual)


class SingularSystemError(Exception):
    """The reduced normal matrix is not positive definite; `direction` (K + 3 E,) spans what is missing."""


class Factor:
    """The factorised normal equations of a `BlockSystem`, with Levenberg-Marquardt damping.

    Parameters
    ----------
    system : BlockSystem
    damping : float
        Added to the unit diagonal of the scaled normal matrix.

    Raises
    ------
    SingularSystemError
        When a block or the Schur complement is not positive definite.
    """

    def __init__(self, system: BlockSystem, damping: float = 0.0) -> None:
        self._system = system
        self._scale = column_scale(system.design)
        self._design = sp.csr_array(system.design @ sp.diags_array(self._scale))
        k = system.kept
        normal = sp.csr_array(self._design.T @ self._design)
        corner = normal[k:, k:]
        blocks = _diagonal_blocks(corner) + damping * np.eye(3)
        kept = normal[:k, :k].toarray() + damping * np.eye(k)
        try:
            self._inverse = _block_inverse(blocks)
            inverse = _block_diagonal(self._inverse)
            self._carry = sp.csr_array(normal[:k, k:] @ inverse)
            schur = kept - (self._carry @ normal[k:, :k]).toarray()
            self._schur = scipy.linalg.cho_factor(schur, lower=True, check_finite=False)
            if float(np.min(np.diag(self._schur[0]) ** 2, initial=1.0)) < ROUNDING:
                raise np.linalg.LinAlgError("a pivot is rounding error")
        except np.linalg.LinAlgError as error:
            raise SingularSystemError("the normal matrix is not positive definite") from error

    def step(self) -> Floats:
        """The damped Gauss-Newton step (K + 3 E,)."""
        k = self._system.kept
        gradient = self._design.T @ self._system.residual
        front = gradient[:k] - self._carry @ gradient[k:]
        kept = scipy.linalg.cho_solve(self._schur, front, check_finite=False)
        back = gradient[k:].reshape(-1, 3, 1)
        rest = (self._inverse @ back).ravel() - self._carry.T @ kept
        step: Floats = self._scale * np.concatenate([kept, rest])
        return step

    @cached_property
    def _kept_covariance(self) -> Floats:
        size = self._system.kept
        inverse: Floats = scipy.linalg.cho_solve(self._schur, np.eye(size), check_finite=False)
        return 0.5 * (inverse + inverse.T)

    def kept_covariance(self) -> Floats:
        """Covariance (K, K) of the kept unknowns."""
        scale = self._scale[: self._system.kept]
        return self._kept_covariance * np.outer(scale, scale)

    def block_covariance(self) -> Floats:
        """Covariance (E, 3, 3) of each eliminated block."""
        carry = self._carry.toarray()
        spread = self._kept_covariance @ carry
        k, count = self._system.kept, len(self._inverse)
        inner = np.einsum("kei,kej->eij", carry.reshape(k, count, 3), spread.reshape(k, count, 3), optimize=True)
        scale = self._scale[k:].reshape(-1, 3)
        covariance: Floats = (self._inverse + inner) * scale[:, :, None] * scale[:, None, :]
        return covariance

    def covariance_columns(self, rows: Floats) -> Floats:
        """Covariance times given directions: (K + 3 E, c) for `rows` (K + 3 E, c)."""
        k = self._system.kept
        scaled = self._scale[:, None] * rows
        kept = self._kept_covariance @ (scaled[:k] - self._carry @ scaled[k:])
        blocks = scaled[k:].reshape(-1, 3, scaled.shape[1])
        rest = (self._inverse @ blocks).reshape(-1, scaled.shape[1]) - self._carry.T @ kept
        columns: Floats = self._scale[:, None] * np.concatenate([kept, rest])
        return columns

    def leverage(self, chunk: int = 4096) -> Floats:
        """Leverage (m,) of each row: the share of its own value in its fitted value; redundancy is one minus it."""
        k = self._system.kept
        front, back = self._design[:, :k], self._design[:, k:]
        reduced = sp.csr_array(front - back @ self._carry.T)
        own = (back @ _block_diagonal(self._inverse)).multiply(back).sum(axis=1)
        shared = np.empty(len(own))
        for start in range(0, len(own), chunk):
            rows = reduced[start : start + chunk]
            shared[start : start + chunk] = rows.multiply(rows @ self._kept_covariance).sum(axis=1)
        total: Floats = np.asarray(own).ravel() + shared
        return total


def column_scale(design: sp.csr_array) -> Floats:
    """One over the norm of each column; 1 for an empty column."""
    squares = np.asarray(design.multiply(design).sum(axis=0)).ravel()
    return np.where(squares > 0, 1.0 / np.sqrt(np.where(squares > 0, squares, 1.0)), 1.0)


def _diagonal_blocks(corner: sp.csr_array) -> Floats:
    """The 3 x 3 blocks (E, 3, 3) on the diagonal; other entries must not exist."""
    entries = corner.tocoo()
    blocks = np.zeros((corner.shape[0] // 3, 3, 3))
    np.add.at(blocks, (entries.row // 3, entries.row % 3, entries.col % 3), entries.data)
    return blocks


def _block_inverse(blocks: Floats) -> Floats:
    if not len(blocks):
        return blocks
    root = np.linalg.cholesky(blocks)
    inverse_root = np.linalg.inv(root)
    inverse: Floats = np.swapaxes(inverse_root, 1, 2) @ inverse_root
    return inverse


def _block_diagonal(blocks: Floats) -> sp.csr_array:
    count = len(blocks)
    if not count:
        return sp.csr_array((0, 0))
    at = np.arange(count)
    return sp.csr_array(sp.bsr_array((blocks, at, np.arange(count + 1)), shape=(3 * count, 3 * count)))
