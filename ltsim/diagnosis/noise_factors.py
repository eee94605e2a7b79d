"""Variance factors of noise hypotheses, and their log likelihood ratios in the diagonal form."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ltsim.core.arrays import Floats, Ints, Singles, batches, stack_and_release

MIN_DENSE_FRACTION = 0.5
"""Fraction of nonzeros on the rows of its kinds from which a pattern is stored as a dense row (memory)."""


@dataclass(frozen=True)
class PatternGroup:
    """Patterns of added variance, dense on common rows or sparse on all rows, and hypotheses of several sizes of each.

    Attributes
    ----------
    members : (h,) int
        Indices of the hypotheses.
    pattern : (h,) int
        Pattern of each hypothesis, ascending.
    size : (h,) float32
        Size of each hypothesis: its variance factor is 1 + size * added.
    places : (r,) int or slice
        Rows of dense patterns; all for sparse ones.
    added : (p, r) float32
        Added variance per unit of the size, relative to the declared variance.
    """

    members: Ints
    pattern: Ints
    size: Singles
    places: Ints | slice
    added: Singles | sp.csr_array

    def log_likelihood_ratios(self, squares: Singles, redundancy: Floats) -> Iterator[tuple[Ints, Floats]]:
        """Log likelihood ratios of some members (b,), (b, trials): sums of (1 - 1/s) r^2 - k log s, halved.

        Parameters
        ----------
        squares : (m, trials) float32
            Squares r^2 of all rows.
        redundancy : (m,) float
            Redundancies k.
        """
        squares, redundancy = squares[self.places], redundancy[self.places]
        count = self.added.size if isinstance(self.added, np.ndarray) else self.added.nnz
        for part in batches(len(self.members), count // max(self.added.shape[0], 1)):
            logs = self._log_variance_factors_of(part)
            fit = (_precision_loss(logs) @ squares).astype(np.float64)
            yield self.members[part], 0.5 * (fit - (logs @ redundancy)[:, None])

    def log_variance_factors(self, member: int) -> tuple[Ints, Floats]:
        """Rows (r,) on which one of the members changes the noise, and the logs (r,) of its variance factors there."""
        logs = self._log_variance_factors_of(slice(member, member + 1))
        if not isinstance(logs, np.ndarray):
            return logs.indices, logs.data.astype(np.float64)
        changed_indices = np.flatnonzero(logs[0])
        rows = np.arange(logs.shape[1]) if isinstance(self.places, slice) else self.places
        return rows[changed_indices], logs[0, changed_indices].astype(np.float64)

    def _log_variance_factors_of(self, members: slice) -> Singles | sp.csr_array:
        """Log variance factors (h, r) of some members."""
        added, size = self.added[self.pattern[members]], self.size[members]
        if isinstance(added, np.ndarray):
            return np.log1p(size[:, None] * added)
        data = np.log1p(np.repeat(size, np.diff(added.indptr)) * added.data)
        return sp.csr_array((data, added.indices, added.indptr), added.shape)


def _precision_loss(logs: Singles | sp.csr_array) -> Singles | sp.csr_array:
    """1 - 1/s from log s."""
    if isinstance(logs, np.ndarray):
        return -np.expm1(-logs)
    return sp.csr_array((-np.expm1(-logs.data), logs.indices, logs.indptr), logs.shape)


VariancePattern = tuple[Floats, tuple[float, ...]]
"""Added variance of the first rows per unit of the size, and the sizes of the hypotheses."""


@dataclass(frozen=True)
class NoiseFactors:
    """Variance factors of `count` hypotheses, in groups of patterns; each hypothesis is in one of them."""

    count: int
    groups: tuple[PatternGroup, ...]

    @classmethod
    def from_patterns(cls, patterns: Iterable[VariancePattern], kind: Ints) -> NoiseFactors:
        """Groups of patterns, from those of consecutive hypotheses.

        `kind` (m,) is the kind of each row: dense patterns are stored on all rows of the kinds that they change.
        """
        dense: dict[tuple[bool, ...], tuple[list[Singles], list[PatternHypotheses]]] = {}
        sparse: list[tuple[Ints, Singles]] = []
        few: list[PatternHypotheses] = []
        kinds, count = int(kind.max(initial=0)) + 1, 0
        for added, sizes in patterns:
            places = np.flatnonzero(added)
            touched = np.bincount(kind[places], minlength=kinds) > 0
            rows = np.flatnonzero(touched[kind])
            if len(places) < MIN_DENSE_FRACTION * len(rows) or not len(places):
                sparse.append((places.astype(np.int32), added[places].astype(np.float32)))
                few.append((count, sizes))
            else:
                filled, owners = dense.setdefault(tuple(touched.tolist()), ([], []))
                filled.append(np.append(added, np.zeros(len(kind) - len(added)))[rows].astype(np.float32))
                owners.append((count, sizes))
            count += len(sizes)
        groups = [_pattern_group(few, slice(None), _sparse_rows(sparse, len(kind)))] if sparse else []
        del sparse
        for touched_kinds, (filled, owners) in dense.items():
            groups.append(
                _pattern_group(owners, np.flatnonzero(np.array(touched_kinds)[kind]), stack_and_release(filled))
            )
        return cls(count, tuple(groups))

    def log_likelihood_ratios(self, squares: Singles, redundancy: Floats) -> Floats:
        """Log likelihood ratios (h, trials) of all hypotheses, from squares (m, trials) and redundancies (m,)."""
        ratio = np.empty((self.count, squares.shape[1]))
        for group in self.groups:
            for members, values in group.log_likelihood_ratios(squares, redundancy):
                ratio[members] = values
        return ratio

    def log_variance_factors(self, hypothesis: int) -> tuple[Ints, Floats]:
        """Rows (r,) on which a hypothesis changes the noise, and the logs (r,) of its variance factors there."""
        group = next(group for group in self.groups if hypothesis in group.members)
        return group.log_variance_factors(int(np.flatnonzero(group.members == hypothesis)[0]))


PatternHypotheses = tuple[int, tuple[float, ...]]
"""Index of the first hypothesis of a pattern, and the sizes of its hypotheses."""


def _pattern_group(
    owners: Sequence[PatternHypotheses], places: Ints | slice, added_variance: Singles | sp.csr_array
) -> PatternGroup:
    members = np.concatenate([first + np.arange(len(sizes)) for first, sizes in owners])
    pattern = np.repeat(np.arange(len(owners)), [len(sizes) for _, sizes in owners])
    size = np.concatenate([sizes for _, sizes in owners]).astype(np.float32)
    return PatternGroup(members, pattern, size, places, added_variance)


def _sparse_rows(row_entries: Sequence[tuple[Ints, Singles]], length: int) -> sp.csr_array:
    """Sparse rows (p, length) from the places and values of each."""
    ends = np.cumsum([0, *(len(places) for places, _ in row_entries)]).astype(np.int32)
    places, values = (np.concatenate([part[k] for part in row_entries]) for k in (0, 1))
    return sp.csr_array((values, places, ends), (len(row_entries), length))
