"""A bank of hypotheses: every signature that a diagnosis tries, projected off the adjustment once.

Scoring all of them against residuals, real or simulated, is then one matrix product.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp

from ltsim.adjust.residual_space import VISIBLE, ResidualSpace
from ltsim.arrays import Floats, Ints, Singles
from ltsim.diagnose.evidence import log_evidence
from ltsim.effects.signature import Tunable

BATCH = 64
LARGE = 4000
"""Rows of a residual space from which signatures with few entries are kept sparse."""
LOCAL = 0.1
"""Share of the rows that such a signature touches at most."""
COLLINEAR = 1e-3
"""Share of a direction left by the effects already accepted, below which it says nothing of its own."""


@dataclass(frozen=True)
class Hypothesis:
    """One thing that may be missing from the model: an effect at a place with a shape, or a flexible term.

    Attributes
    ----------
    family : str
        Hypotheses of one family are places and shapes of the same thing.
    effect : Tunable
        A catalogued effect, or a flexible term (`diagnose.flexible.FlexibleTerm`).
    known : bool
        In the catalogue.
    tuning : float
        Log evidence that moving its shape and place to the optimum has cost: a peak fills little of the room it was
        sought in.
    """

    family: str
    effect: Tunable
    known: bool = True
    tuning: float = 0.0


@dataclass(frozen=True)
class Group:
    """Hypotheses of one rank r: `members` (k,) indices, `rows` (k r, m) that score residuals.

    Dense rows are orthonormal within each hypothesis. Those of hypotheses about a few readings are sparse: what the
    adjustment leaves of them is orthonormal, and their products with residuals are the same.
    """

    rank: int
    members: Ints
    rows: Singles | sp.csr_array


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
        made = _Maker(space)
        for start in range(0, len(hypotheses), BATCH):
            made.add(hypotheses[start : start + BATCH])
        return cls(space, made.hypotheses, made.groups(), np.array(made.visible))

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
            score = (group.rows @ residual.astype(np.float32)).astype(np.float64).reshape(k, r)
            if extension is None or extension.shape[1] == 0:
                drop[group.members], rank[group.members] = (score**2).sum(axis=1), r
                continue
            overlap = (group.rows @ extension.astype(np.float32)).astype(np.float64).reshape(k, r, -1)
            gram = np.eye(r) - overlap @ np.swapaxes(overlap, 1, 2)
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
            score = group.rows @ white
            drop = (score.reshape(k, r, trials) ** 2).sum(axis=1)
            evidence = log_evidence(drop, np.full((k, 1), r))
            for f in np.unique(self.family[group.members]):
                rows = evidence[self.family[group.members] == f]
                np.logaddexp(best[f], np.logaddexp.reduce(rows, axis=0), out=best[f])
        return best - np.log(np.maximum(count, 1))[:, None]


@dataclass(frozen=True)
class _Signature:
    """A signature by its columns of unit length: hypothesis, rows touched, norms (q,), columns on all or these rows."""

    index: int
    places: Ints
    norm: Floats
    scaled: Floats

    @classmethod
    def of(cls, index: int, places: Ints, rows: Floats) -> _Signature:
        norm = np.sqrt(np.einsum("mq,mq->q", rows, rows))
        return cls(index, places, norm, rows / np.where(norm > 0, norm, 1.0))


class _Maker:
    """Makes the groups of a bank batch by batch."""

    def __init__(self, space: ResidualSpace) -> None:
        self._space = space
        self.hypotheses: list[Hypothesis] = []
        self.visible: list[float] = []
        self._dense: dict[int, list[tuple[int, Singles]]] = {}
        self._sparse: dict[int, list[tuple[int, Ints, Singles]]] = {}

    def add(self, hypotheses: Sequence[Hypothesis]) -> None:
        """Add those that touch a reading: what is left of them is normalised by its small Gram matrix."""
        dense: list[_Signature] = []
        local: list[_Signature] = []
        for hypothesis in hypotheses:
            rows = self._space.signature(hypothesis.effect)
            places = _touched(rows)
            if not len(places):
                continue
            few = self._space.size > LARGE and len(places) < LOCAL * self._space.size
            made = _Signature.of(len(self.hypotheses), places, rows[places] if few else rows)
            (local if few else dense).append(made)
            self.hypotheses.append(hypothesis)
            self.visible.append(0.0)
        self._add_dense(dense)
        self._add_local(local)

    def _add_dense(self, signatures: list[_Signature]) -> None:
        if not signatures:
            return
        left = self._space.project(np.hstack([s.scaled for s in signatures]))
        at = 0
        for s in signatures:
            part = left[:, at : at + len(s.norm)]
            at += len(s.norm)
            whitener = self._whitener(s, part.T @ part)
            if whitener.shape[1]:
                rows = np.ascontiguousarray((part @ whitener).T, dtype=np.float32)
                self._dense.setdefault(whitener.shape[1], []).append((s.index, rows))

    def _add_local(self, signatures: list[_Signature]) -> None:
        if not signatures:
            return
        edges = np.cumsum([0, *(len(s.norm) for s in signatures)])
        vectors = sparse_rows([(s.places, s.scaled.T) for s in signatures], self._space.size)
        for s, gram in zip(signatures, self._space.projection.left_grams(vectors, edges), strict=True):
            whitener = self._whitener(s, gram)
            if whitener.shape[1]:
                rows = (s.scaled @ whitener).T.astype(np.float32)
                self._sparse.setdefault(whitener.shape[1], []).append((s.index, s.places, rows))

    def _whitener(self, signature: _Signature, gram: Floats) -> Floats:
        """Matrix (q, r) that makes what is left of a scaled signature orthonormal; notes how much that is."""
        squares = signature.norm**2
        self.visible[signature.index] = float(np.diag(gram) @ squares / squares.sum())
        values, vectors = np.linalg.eigh(gram)
        keep = values > VISIBLE
        whitener: Floats = vectors[:, keep] / np.sqrt(values[keep])
        return whitener

    def groups(self) -> list[Group]:
        """The groups, by rank; what they were made of is given up."""
        made = []
        for rank in sorted({*self._dense, *self._sparse}):
            if dense := self._dense.pop(rank, []):
                members = np.array([i for i, _ in dense], dtype=np.int64)
                made.append(Group(rank, members, np.concatenate([rows for _, rows in dense])))
            if local := self._sparse.pop(rank, []):
                members = np.array([i for i, _, _ in local], dtype=np.int64)
                rows = sparse_rows([(places, values) for _, places, values in local], self._space.size)
                made.append(Group(rank, members, rows.astype(np.float32)))
        return made


def _touched(rows: Floats) -> Ints:
    """Rows with an entry."""
    touched = rows[:, 0] != 0.0 if rows.shape[1] else np.zeros(len(rows), dtype=bool)
    for column in rows.T[1:]:
        touched |= column != 0.0
    return np.flatnonzero(touched)


def sparse_rows(parts: Sequence[tuple[Ints, Floats | Singles]], size: int) -> sp.csr_array:
    """Rows (sum r, size) from values (r, k) at places (k,)."""
    if not parts:
        return sp.csr_array((0, size))
    indices = np.concatenate([np.tile(places, len(values)) for places, values in parts])
    lengths = np.concatenate([np.full(len(values), len(places)) for places, values in parts])
    data = np.concatenate([values.ravel() for _, values in parts])
    return sp.csr_array((data, indices, np.append(0, np.cumsum(lengths))), (len(lengths), size))
