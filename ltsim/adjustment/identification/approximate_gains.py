"""Gains of log evidence by shifts of readings: from decreases of chi-square, and approximately for all candidates.

The approximation uses only the readings that a shift changes, weighted by their redundancy numbers. Sums over the
pointings of a candidate are computed for all candidates of a family of shifts at once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ltsim.adjustment.identification.evidence import log_occam_factor_of_shift
from ltsim.adjustment.identification.hypothesis_library import ShiftCandidate
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Bools, Floats, Ints, batches


def log_evidence_gain(chi2_drop: float, rank: int) -> float:
    """Gain of log evidence, without prior, by a shift of `rank` components that decreases chi-square."""
    return float(log_evidence_gains(np.array([chi2_drop]), np.array([rank]))[0])


def log_evidence_gains(chi2_drops: Floats, ranks: Ints) -> Floats:
    """Gains (h,) of log evidence, without priors, by h shifts of `ranks` (h,) components that decrease chi-square.

    `chi2_drops` (h,) are the decreases of chi-square. The gain of a shift without components is minus infinity.
    """
    gains = np.full(len(chi2_drops), -np.inf)
    for rank in np.unique(ranks[ranks > 0]).tolist():
        drops = chi2_drops[ranks == rank]
        gains[ranks == rank] = 0.5 * drops + log_occam_factor_of_shift(np.sqrt(drops), rank)
    return gains


def log_evidence_gains_of_scores(grams: Floats, scores: Floats, min_eigenvalue: float) -> Floats:
    """Gains (h,) of log evidence by each of h shifts of readings with q components, without prior probabilities.

    `grams` (h, q, q) are the Gram matrices of the projected design columns with unit length, `scores` (h, q) their
    products with the whitened residuals. Combinations of components with an eigenvalue below `min_eigenvalue` do not
    count, because the readings do not determine them.
    """
    strength, turn = np.linalg.eigh(grams)
    along = np.einsum("hij,hi->hj", turn, scores)
    visible = strength > min_eigenvalue
    drop = np.sum(np.where(visible, along**2 / np.where(visible, strength, 1.0), 0.0), axis=1)
    return log_evidence_gains(drop, visible.sum(axis=1))


def weighted_family_designs(candidates: Sequence[ShiftCandidate], reading_mask: Bools, sigmas: Floats) -> list[Floats]:
    """Design (n, 3, p) of each candidate as if it shifted all pointings, divided by `sigmas`; 0 for unused readings.

    `sigmas` (n, 3) are the standard deviations of n pointings, `reading_mask` (n, 3) flags used readings. Candidates of
    one `ShiftFamily` have the same array in the result, which is computed once.
    """
    families = {id(c.family): c.family for c in candidates}
    weighted = {
        key: np.where(reading_mask[:, :, None], family.design / sigmas[:, :, None], 0.0)
        for key, family in families.items()
    }
    return [weighted[id(c.family)] for c in candidates]


def approximate_log_evidence_gains(space: ResidualSpace, candidates: Sequence[ShiftCandidate]) -> Floats:
    """Approximate gains (h,) of log evidence by each of h candidate shifts, without projection.

    Each gain uses only residuals (from `space`) of readings that the candidate shifts, weighted by redundancy.
    """
    use, count = space.is_used_reading, int(space.is_used_reading.sum())
    residual, share = np.zeros(use.shape), np.zeros(use.shape)
    residual[use], share[use] = space.whitened_residuals[:count], np.maximum(space.redundancy[:count], 1e-3)
    gains, members = np.empty(len(candidates)), dict[int, list[int]]()
    for i, c in enumerate(candidates):
        members.setdefault(id(c.family), []).append(i)
    for group in members.values():
        (design,) = weighted_family_designs([candidates[group[0]]], use, space.reading_sigmas)
        grams = np.einsum("nki,nk,nkj->nij", design, share, design)
        scores = np.einsum("nki,nk->ni", design, residual)
        most_rows = max(len(candidates[i].affected_rows) for i in group)
        for batch in (group[part] for part in batches(len(group), most_rows * grams[0].size)):
            rows = [candidates[i].affected_rows for i in batch]
            starts = np.cumsum([0, *(len(indices) for indices in rows[:-1])])
            every = np.concatenate(rows)
            gram, score = np.add.reduceat(grams[every], starts), np.add.reduceat(scores[every], starts)
            scale = np.sqrt(np.maximum(np.einsum("hii->hi", gram), 1e-300))
            unit_gram = gram / (scale[:, :, None] * scale[:, None, :])
            gains[batch] = log_evidence_gains_of_scores(unit_gram, score / scale, 1e-3) + candidates[batch[0]].log_prior
    return gains
