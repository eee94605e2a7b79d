"""Variance factors of many noise hypotheses, and their log likelihood ratios with independent readings (diagonal form).

Each observation equation has its redundancy number.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ltsim.core.arrays import Floats, Floats32, Ints, batches, stack_and_release

MIN_NONZERO_FRACTION_OF_DENSE_PATTERN = 0.5
"""Limit of the fraction of nonzero elements of a pattern (added variance of each reading per unit of a size). Above it,
the pattern is stored as a dense row; below it as sparse, which saves memory. The fraction refers to the kinds of
observations that the pattern changes."""


@dataclass(frozen=True)
class VariancePatternGroup:
    """Group of patterns of added variance, and of hypotheses of changed noise, each of which is a pattern times a size.

    A pattern is the added variance of each reading per unit of the size. Either all patterns are sparse, or all are
    dense on the same observation equations.
    """

    hypothesis_indices: Ints
    """Indices (h,) of the h hypotheses of changed noise of the group."""
    pattern_indices: Ints
    """Index (h,), in ascending order, of the pattern (added variance of each reading per unit of a size) of each of h
    hypotheses."""
    sizes: Floats32
    """Size (h,) of each of h hypotheses of changed noise. The variance factor of an observation is 1 plus the size
    times its added variance."""
    row_indices: Ints | slice
    """Indices (r,) of the r observation equations of dense patterns (added variance of each reading per unit of a
    size); all equations for sparse patterns."""
    added_variance: Floats32 | sp.csr_array
    """Added variance (p, r) of r observations per unit of the size, for p patterns of noise, divided by the declared
    variance."""

    def log_likelihood_ratios(self, squares: Floats32, redundancy: Floats) -> Iterator[tuple[Ints, Floats]]:
        """Iterator over batches: indices (b,) of b noise levels, and log likelihood ratios (b, trials) by recording.

        The log likelihood ratio is half the sum over observations of (1 - 1/s) r^2 - k log s, with the variance factors
        s, residuals r and redundancy numbers k.

        Parameters
        ----------
        squares : (m, trials) float32
            Squares r^2 of whitened residuals of m observations, of the recording or of simulated recordings (trials).
        redundancy : (m,) float
            Redundancy numbers k.
        """
        squares, redundancy = squares[self.row_indices], redundancy[self.row_indices]
        n_nonzero = self.added_variance.size if isinstance(self.added_variance, np.ndarray) else self.added_variance.nnz
        for part in batches(len(self.hypothesis_indices), n_nonzero // max(self.added_variance.shape[0], 1)):
            logs = self._log_variance_factors_of(part)
            fit = (_relative_precision_loss(logs) @ squares).astype(np.float64)
            yield self.hypothesis_indices[part], 0.5 * (fit - (logs @ redundancy)[:, None])

    def affected_rows_and_log_factors(self, member_index: int) -> tuple[Ints, Floats]:
        """Indices (r,) of the r observations with changed noise by a hypothesis, and logs (r,) of variance factors.

        `member_index` is the index of the hypothesis in this group.
        """
        log_factors = self._log_variance_factors_of(slice(member_index, member_index + 1))
        if not isinstance(log_factors, np.ndarray):
            return log_factors.indices, log_factors.data.astype(np.float64)
        changed_indices = np.flatnonzero(log_factors[0])
        row_indices = np.arange(log_factors.shape[1]) if isinstance(self.row_indices, slice) else self.row_indices
        return row_indices[changed_indices], log_factors[0, changed_indices].astype(np.float64)

    def _log_variance_factors_of(self, member_range: slice) -> Floats32 | sp.csr_array:
        """Logs (h, r) of the variance factors of r observations by the h hypotheses in `member_range`."""
        added_variance, sizes = (
            self.added_variance[self.pattern_indices[member_range]],
            self.sizes[member_range],
        )
        if isinstance(added_variance, np.ndarray):
            return np.log1p(sizes[:, None] * added_variance)
        log_factors = np.log1p(np.repeat(sizes, np.diff(added_variance.indptr)) * added_variance.data)
        return sp.csr_array((log_factors, added_variance.indices, added_variance.indptr), added_variance.shape)


def _relative_precision_loss(log_variance_factors: Floats32 | sp.csr_array) -> Floats32 | sp.csr_array:
    """Relative loss of precision, 1 - 1/s, by variance factors s of h hypotheses, from the logs (h, r) of s."""
    if isinstance(log_variance_factors, np.ndarray):
        return -np.expm1(-log_variance_factors)
    return sp.csr_array(
        (-np.expm1(-log_variance_factors.data), log_variance_factors.indices, log_variance_factors.indptr),
        log_variance_factors.shape,
    )


VariancePatternWithSizes = tuple[Floats, tuple[float, ...]]
"""Pattern of added variance (per unit of a size) of the first observation equations, and the sizes of the hypotheses
with this pattern."""


@dataclass(frozen=True)
class VarianceFactors:
    """Variance factors of noise hypotheses (changed noise), each of which is in one `VariancePatternGroup`."""

    n_hypotheses: int
    """Number h of hypotheses of changed noise."""
    groups: tuple[VariancePatternGroup, ...]
    """Groups of patterns (added variance of each reading per unit of a size), to one of which each hypothesis
    belongs."""

    @classmethod
    def from_patterns(cls, patterns: Iterable[VariancePatternWithSizes], observation_kinds: Ints) -> VarianceFactors:
        """Variance factors from the patterns of added variance of consecutive hypotheses.

        A pattern is the added variance of each observation per unit of a size. `observation_kinds` (m,) is the kind of
        each of the m observations. Dense patterns are stored for all observations of the kinds that they change.
        """
        dense: dict[tuple[bool, ...], tuple[list[Floats32], list[FirstIndexAndSizes]]] = {}
        sparse: list[tuple[Ints, Floats32]] = []
        few: list[FirstIndexAndSizes] = []
        kinds, n_hypotheses = int(observation_kinds.max(initial=0)) + 1, 0
        for added_variance, sizes in patterns:
            row_indices = np.flatnonzero(added_variance)
            touched = np.bincount(observation_kinds[row_indices], minlength=kinds) > 0
            rows = np.flatnonzero(touched[observation_kinds])
            if len(row_indices) < MIN_NONZERO_FRACTION_OF_DENSE_PATTERN * len(rows) or not len(row_indices):
                sparse.append((row_indices.astype(np.int32), added_variance[row_indices].astype(np.float32)))
                few.append((n_hypotheses, sizes))
            else:
                filled, pattern_hypotheses = dense.setdefault(tuple(touched.tolist()), ([], []))
                filled.append(
                    np.append(added_variance, np.zeros(len(observation_kinds) - len(added_variance)))[rows].astype(
                        np.float32
                    )
                )
                pattern_hypotheses.append((n_hypotheses, sizes))
            n_hypotheses += len(sizes)
        pattern_groups = (
            [_pattern_group(few, slice(None), _sparse_pattern_matrix(sparse, len(observation_kinds)))] if sparse else []
        )
        del sparse
        for touched_kinds, (filled, pattern_hypotheses) in dense.items():
            pattern_groups.append(
                _pattern_group(
                    pattern_hypotheses,
                    np.flatnonzero(np.array(touched_kinds)[observation_kinds]),
                    stack_and_release(filled),
                )
            )
        return cls(n_hypotheses, tuple(pattern_groups))

    def log_likelihood_ratios(self, squares: Floats32, redundancy: Floats) -> Floats:
        """Log likelihood ratios (h, trials) of all h changed noise levels for each recording (trial).

        `squares` (m, trials) are squares of m whitened residuals, and `redundancy` (m,) their redundancy numbers.
        """
        ratio = np.empty((self.n_hypotheses, squares.shape[1]))
        for group in self.groups:
            for members, values in group.log_likelihood_ratios(squares, redundancy):
                ratio[members] = values
        return ratio

    def affected_rows_and_log_factors(self, hypothesis: int) -> tuple[Ints, Floats]:
        """Indices (r,) of the r observations whose noise a hypothesis changes, and logs (r,) of its variance factors.

        `hypothesis` is the index of the hypothesis among all h hypotheses.
        """
        group = next(group for group in self.groups if hypothesis in group.hypothesis_indices)
        return group.affected_rows_and_log_factors(int(np.flatnonzero(group.hypothesis_indices == hypothesis)[0]))


FirstIndexAndSizes = tuple[int, tuple[float, ...]]
"""Index of the first hypothesis of a pattern (added variance of each reading per unit of a size), and the sizes of its
hypotheses."""


def _pattern_group(
    pattern_hypotheses: Sequence[FirstIndexAndSizes], row_indices: Ints | slice, added_variance: Floats32 | sp.csr_array
) -> VariancePatternGroup:
    """Group of patterns of added variance with their hypotheses, on the observation equations `row_indices`.

    A pattern is the added variance of each reading per unit of a size. `pattern_hypotheses` has the index of the first
    hypothesis and the sizes of each pattern.
    """
    members = np.concatenate([first + np.arange(len(sizes)) for first, sizes in pattern_hypotheses])
    pattern_indices = np.repeat(np.arange(len(pattern_hypotheses)), [len(sizes) for _, sizes in pattern_hypotheses])
    pattern_sizes = np.concatenate([sizes for _, sizes in pattern_hypotheses]).astype(np.float32)
    return VariancePatternGroup(members, pattern_indices, pattern_sizes, row_indices, added_variance)


def _sparse_pattern_matrix(row_entries: Sequence[tuple[Ints, Floats32]], n_rows: int) -> sp.csr_array:
    """Sparse matrix (p, n_rows) of p patterns on `n_rows` observations, from its nonzero elements.

    A pattern is the added variance of each observation per unit of a size. `row_entries` are the indices and the values
    of the nonzero elements of each pattern.
    """
    ends = np.cumsum([0, *(len(row_indices) for row_indices, _ in row_entries)]).astype(np.int32)
    row_indices, values = (np.concatenate([part[k] for part in row_entries]) for k in (0, 1))
    return sp.csr_array((values, row_indices, ends), (len(row_entries), n_rows))
