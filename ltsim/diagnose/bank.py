"""A bank of hypotheses: every signature that a diagnosis tries, projected off the adjustment once.

Scoring all of them against residuals, real or simulated, is then one matrix product.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ltsim.arrays import Floats, Ints
from ltsim.diagnose.evidence import log_evidence
from ltsim.diagnose.residual_space import VISIBLE, ResidualSpace
from ltsim.effects.effect import Effect

BATCH = 256
COLLINEAR = 1e-3
"""Share of a direction left by the effects already accepted, below which it says nothing of its own."""


@dataclass(frozen=True)
class Hypothesis:
    """One thing that may be missing from the model: an effect at a place with a shape, or a flexible term.

    Attributes
    ----------
    family : str
        Hypotheses of one family are places and shapes of the same thing.
    effect : Effect
        A catalogued effect, or a flexible term (`diagnose.flexible.FlexibleTerm`).
    known : bool
        In the catalogue.
    """

    family: str
    effect: Effect
    known: bool = True


@dataclass(frozen=True)
class Group:
    """Hypotheses of one rank r: `members` (k,) indices, `columns` (m, k r) orthonormal within each."""

    rank: int
    members: Ints
    columns: Floats


@dataclass(frozen=True)
class Bank:
    """Hypotheses with the visible part of their signatures.

    Attributes
    ----------
    hypotheses : list of Hypothesis
    groups : list of Group
    visible : (h,) float
        Share of each signature's squared size that the adjustment leaves.
    """

    space: ResidualSpace
    hypotheses: list[Hypothesis]
    groups: list[Group]
    visible: Floats
    families: tuple[str, ...] = field(init=False)
    family: Ints = field(init=False)
    rank: Ints = field(init=False)

    def __post_init__(self) -> None:
        names = tuple(dict.fromkeys(h.family for h in self.hypotheses))
        index = {name: i for i, name in enumerate(names)}
        rank = np.zeros(len(self.hypotheses), dtype=np.int64)
        for group in self.groups:
            rank[group.members] = group.rank
        object.__setattr__(self, "families", names)
        object.__setattr__(self, "family", np.array([index[h.family] for h in self.hypotheses], dtype=np.int64))
        object.__setattr__(self, "rank", rank)

    @classmethod
    def of(cls, space: ResidualSpace, hypotheses: Sequence[Hypothesis]) -> Bank:
        """Build a bank: signatures, what the adjustment leaves of them, orthonormal columns by rank.

        Hypotheses that touch no reading of this recording are left out.
        """
        kept: list[Hypothesis] = []
        visible: list[float] = []
        columns: dict[int, list[Floats]] = {}
        members: dict[int, list[int]] = {}
        for start in range(0, len(hypotheses), BATCH):
            batch = list(hypotheses[start : start + BATCH])
            whole = [space.signature(h.effect) for h in batch]
            left = space.project(np.hstack(whole))
            at = 0
            for hypothesis, rows in zip(batch, whole, strict=True):
                part = left[:, at : at + rows.shape[1]]
                at += rows.shape[1]
                size = float((rows**2).sum())
                if size == 0.0:
                    continue
                basis = _orthonormal(part, rows)
                if basis.shape[1]:
                    columns.setdefault(basis.shape[1], []).append(basis.astype(np.float32))
                    members.setdefault(basis.shape[1], []).append(len(kept))
                kept.append(hypothesis)
                visible.append(float((part**2).sum()) / size)
        groups = [
            Group(rank, np.array(members[rank], dtype=np.int64), np.hstack(columns[rank])) for rank in sorted(members)
        ]
        return cls(space, kept, groups, np.array(visible))

    def drops(self, residual: Floats, extension: Floats | None = None) -> tuple[Floats, Ints]:
        """Drop of chi2 (h,) and visible directions (h,) of each hypothesis beside what is accepted already.

        Parameters
        ----------
        residual : (m,) float
            Whitened residuals orthogonal to the adjustment and to `extension`.
        extension : (m, e) float, optional
            Orthonormal columns of accepted effects.
        """
        drop = np.zeros(len(self.hypotheses))
        rank = np.zeros(len(self.hypotheses), dtype=np.int64)
        for group in self.groups:
            k, r = len(group.members), group.rank
            score = (residual.astype(np.float32) @ group.columns).astype(np.float64).reshape(k, r)
            if extension is None or extension.shape[1] == 0:
                drop[group.members], rank[group.members] = (score**2).sum(axis=1), r
                continue
            overlap = (extension.astype(np.float32).T @ group.columns).astype(np.float64)
            overlap = overlap.reshape(-1, k, r)
            gram = np.eye(r) - np.einsum("eki,ekj->kij", overlap, overlap)
            values, vectors = np.linalg.eigh(gram)
            along = np.einsum("kij,ki->kj", vectors, score)
            own = values > COLLINEAR
            drop[group.members] = np.sum(np.where(own, along**2 / np.maximum(values, COLLINEAR), 0.0), axis=1)
            rank[group.members] = own.sum(axis=1)
        return drop, rank

    def simulated_evidence(self, noise: Floats) -> Floats:
        """Log evidence (families, trials) of each family for white noise (m, trials)."""
        trials = noise.shape[1]
        count = np.bincount(self.family, minlength=len(self.families))
        # What the adjustment absorbs whole has evidence one, whatever the residuals.
        blind = np.bincount(self.family[self.rank == 0], minlength=len(self.families))
        with np.errstate(divide="ignore"):
            best = np.tile(np.log(blind.astype(np.float64))[:, None], (1, trials))
        white = noise.astype(np.float32)
        for group in self.groups:
            k, r = len(group.members), group.rank
            score = group.columns.T @ white
            drop = (score.reshape(k, r, trials) ** 2).sum(axis=1)
            evidence = log_evidence(drop, np.full((k, 1), r))
            for f in np.unique(self.family[group.members]):
                rows = evidence[self.family[group.members] == f]
                np.logaddexp(best[f], np.logaddexp.reduce(rows, axis=0), out=best[f])
        return best - np.log(np.maximum(count, 1))[:, None]


def _orthonormal(left: Floats, whole: Floats) -> Floats:
    """Orthonormal columns of what is left of a signature, through its small Gram matrix (fast for thin ones)."""
    norm = np.sqrt((whole**2).sum(axis=0))
    norm[norm == 0] = 1.0
    scaled = left / norm
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    keep = values > VISIBLE
    basis: Floats = scaled @ (vectors[:, keep] / np.sqrt(values[keep]))
    return basis
