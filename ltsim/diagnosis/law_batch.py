"""Batch of laws: response terms x regressors x places, scored by sums over the pointings of each place.

The score of response c with regressor d at a place is the sum over its pointings of (derivative of c) x (column of d) x
(residual): one matrix product for all pointings that belong to the same places, for any number of hypotheses.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.sparse as sp

from ltsim.calibration.evidence import log_evidence, log_sum_exp
from ltsim.core.arrays import Floats, Ints, Singles, batches
from ltsim.core.rounding import MAX_SINGLE_ROUNDING_ERROR
from ltsim.diagnosis.evidence import N_REFINED, simulated_log_total
from ltsim.diagnosis.null_ensemble import MIN_SIMULATED_RECORDINGS, NullEnsemble
from ltsim.physics.laws.places import LawPlace
from ltsim.physics.laws.regressors import Regressor
from ltsim.physics.laws.responses import Response
from ltsim.scene.sightings import Sightings

MAX_CACHED_COLUMN_ENTRIES = 16_000_000
"""Number of entries of columns of regressors up to which they stay in memory, 64 MB: those that several batches share
during a scoring, and those of all batches between scorings. Computing them anew takes a sixth of the time of a scoring.
"""


@dataclass(frozen=True)
class ScreenedLaw:
    """Screened law with its log evidence including the prior."""

    response: Response
    regressor: Regressor
    place: LawPlace
    log_evidence: float
    log_prior: float


@dataclass(frozen=True)
class RowPartition:
    """Partition of the pointings into cells that belong to the same places: a place sums its cells.

    Attributes
    ----------
    order : (r,) int
        Pointings, cell after cell.
    cell_edges : (cells + 1,) int
        Start of each cell in that order, and the end of the last one.
    is_in_place : (P, cells) csr float32
        Indicator of the cells of each place.
    """

    order: Ints
    cell_edges: Ints
    is_in_place: sp.csr_array

    @classmethod
    def from_places(cls, places: Sequence[LawPlace], n_pointings: int) -> RowPartition:
        """Partition of `n_pointings` pointings by the places that they belong to."""
        is_inside = np.zeros((len(places), n_pointings), dtype=bool)
        for here, place in zip(is_inside, places, strict=True):
            here[place.rows] = True
        _, first, cell = np.unique(np.packbits(is_inside, axis=0), axis=1, return_index=True, return_inverse=True)
        order = np.argsort(cell.ravel(), kind="stable")
        edges = np.append(0, np.cumsum(np.bincount(cell.ravel())))
        return cls(order, edges, sp.csr_array(is_inside[:, first].astype(np.float32)))

    def chunks(self, n_entries_per_pointing: int) -> Iterator[tuple[slice, Ints, list[tuple[int, slice]]]]:
        """Batches of pointings for temporary arrays: slice of the order, pointings, and slices of their cells."""
        for part in batches(len(self.order), n_entries_per_pointing):
            first, last = np.searchsorted(self.cell_edges, [part.start, part.stop - 1], side="right") - 1
            cuts = np.clip(self.cell_edges[first : last + 2] - part.start, 0, part.stop - part.start).tolist()
            here = [(first + i, slice(*cut)) for i, cut in enumerate(pairwise(cuts))]
            yield part, self.order[part], here

    def sums_over_places(self, cell_sums: Any) -> Any:
        """Sums (P, ...) over places from the sums over cells (cells, ...)."""
        return (self.is_in_place @ cell_sums.reshape(len(cell_sums), -1)).reshape(-1, *cell_sums.shape[1:])


class RegressorColumns:
    """Columns of some regressors of equal size at all pointings, computed when they are needed.

    Those of several batches are shared: they stay in memory until they are released, or always if `cached`.
    """

    def __init__(
        self, regressors: Sequence[Regressor], sightings: Sightings, order: Ints, *, acts_on_targets: bool
    ) -> None:
        self._regressors, self._sightings, self._order, self._acts_on_targets = (
            regressors,
            sightings,
            order,
            acts_on_targets,
        )
        self._all_columns: Singles | None = None
        self.is_cached = False
        self.n_entries_per_regressor = regressors[0].n_columns * len(sightings)  # of one regressor

    def columns_of(self, regressors: slice) -> Singles:
        """Columns (n, d k) of some regressors, at the pointings in the order of the cells."""
        if self.n_entries_per_regressor * len(self._regressors) > MAX_CACHED_COLUMN_ENTRIES:
            return self._compute_columns(self._regressors[regressors])
        if self._all_columns is None:
            self._all_columns = self._compute_columns(self._regressors)
        size = self._regressors[0].n_columns
        return self._all_columns[:, regressors.start * size : regressors.stop * size]

    def release(self) -> None:
        """Removal of columns that are not cached."""
        if not self.is_cached:
            self._all_columns = None

    def _compute_columns(self, regressors: Sequence[Regressor]) -> Singles:
        size = regressors[0].n_columns
        columns = np.empty((len(self._sightings), len(regressors) * size), dtype=np.float32)
        for i, driver in enumerate(regressors):
            made = driver.columns(self._sightings, acts_on_targets=self._acts_on_targets)
            columns[:, i * size : (i + 1) * size] = made[self._order]
        return columns


@dataclass(frozen=True)
class LawBatch:
    """Batch of laws: responses of one kind with c components, regressors with equal columns k and scales, P places.

    Attributes
    ----------
    weights : (n, 3, C, c) float32
        Whitened change of the readings by a plausible size of each component.
    columns : RegressorColumns
        Columns of the regressors, shared by batches with the same regressors and cells.
    log_prior : (P,) float
        Log prior of each hypothesis and scale at a place.
    """

    responses: tuple[Response, ...]
    regressors: tuple[Regressor, ...]
    places: tuple[LawPlace, ...]
    partition: RowPartition
    weights: Singles
    columns: RegressorColumns
    log_prior: Floats
    _quadratic_forms: dict[int, list[tuple[Floats, Singles]]] = field(default_factory=dict, repr=False)

    @cached_property
    def _prior_sigmas(self) -> list[Floats]:
        """Prior standard deviations (D, c k) for each scale."""
        ways = self.weights.shape[3]
        return [
            np.tile(np.stack(sets), ways) for sets in zip(*(d.coefficient_sigmas for d in self.regressors), strict=True)
        ]

    def best_laws_and_totals(self, probe: NullEnsemble) -> tuple[list[ScreenedLaw], float, Floats]:
        """Best hypotheses of every place, and log sums over all: of the recording, and of trials (trials,)."""
        count, size = len(self.regressors), self.regressors[0].n_columns
        products = size * self.weights[0, 0].size * len(self.places)
        entries = max(products * MIN_SIMULATED_RECORDINGS, self.columns.n_entries_per_regressor)
        batch_results = [self._log_evidence_at_places(probe, part) for part in batches(count, entries)]
        values = np.concatenate([values for values, _ in batch_results], axis=2).reshape(len(self.places), -1)
        null = log_sum_exp(np.stack([null for _, null in batch_results]))
        best_index = np.argsort(-np.round(values / MAX_SINGLE_ROUNDING_ERROR), axis=1, kind="stable")[:, :N_REFINED]
        hits = [
            ScreenedLaw(self.responses[i // count], self.regressors[i % count], place, v, prior)
            for place, prior, indices, here in zip(
                self.places, self.log_prior.tolist(), best_index, values, strict=True
            )
            for i, v in zip(indices.tolist(), here[indices].tolist(), strict=True)
        ]
        return hits, float(log_sum_exp(values.ravel())), null

    def _log_evidence_at_places(self, probe: NullEnsemble, regressors: slice) -> tuple[Floats, Floats]:
        """Log evidence (P, C, d) of some regressors with priors, and its log sum over trials.

        The model does not reduce the Gram matrix of a law here, which overstates it where both are correlated; the best
        laws are evaluated again without this approximation.
        """
        columns = self.columns.columns_of(regressors)
        scores = self._products_with_ensemble(probe, columns)
        score, trials, _ = probe.split_products(scores)
        null = np.full((1, probe.n_trials), -np.inf)
        if probe.is_first_pass:
            turned = self._eigen_decomposition(probe.projected_gram(scores, self._gram_matrices(columns)), regressors)
            self._quadratic_forms[regressors.start] = turned
            if probe.n_trials:
                priors = np.repeat(self.log_prior, scores.shape[1] * scores.shape[2])
                null = np.stack([simulated_log_total(turn @ trials, strength, priors) for strength, turn in turned])
        log_evidences = [
            log_evidence((turn @ score[..., None])[..., 0] ** 2, strength)
            for strength, turn in self._quadratic_forms[regressors.start]
        ]
        return log_sum_exp(np.stack(log_evidences)) + self.log_prior[:, None, None], log_sum_exp(null)

    def _eigen_decomposition(self, gram: Floats, regressors: slice) -> list[tuple[Floats, Singles]]:
        """Eigenvalues (P, C, d, k) per scale, and the matrix that transforms scores to eigenvectors."""
        transforms = []
        for spread in (spread[regressors] for spread in self._prior_sigmas):
            strength, turn = np.linalg.eigh(gram * spread[:, :, None] * spread[:, None, :])
            turn = np.swapaxes(turn, -1, -2) * spread[:, None, :]
            transforms.append((np.maximum(strength, 0.0), turn.astype(np.float32)))
        return transforms

    def _products_with_ensemble(self, probe: NullEnsemble, columns: Singles) -> Singles:
        """Products (P, C, d, c k, v) of columns (n, d k) of regressors with the ensemble's vectors at all places."""
        _, _, count, ways = self.weights.shape
        vectors, d = probe.probe_vectors.shape[1], columns.shape[1] // self.regressors[0].n_columns
        sums = np.zeros(
            (len(self.partition.cell_edges) - 1, columns.shape[1], count * ways * vectors), dtype=np.float32
        )
        for part, rows, cells in self.partition.chunks(count * ways * vectors):
            weights = self.weights[rows].reshape(len(rows), 3, -1)
            moved = (np.swapaxes(weights, 1, 2) @ probe.vectors_at(rows)).reshape(len(rows), -1)
            turned = columns[part].T
            for cell, at in cells:
                sums[cell] += turned[:, at] @ moved[at]
        products = self.partition.sums_over_places(sums).reshape(len(self.places), d, -1, count, ways, vectors)
        return np.ascontiguousarray(products.transpose(0, 3, 1, 4, 2, 5)).reshape(len(products), count, d, -1, vectors)

    def _gram_matrices(self, columns: Singles) -> Floats:
        """Gram matrices (P, C, d, c k, c k) of the columns (n, d k) of each hypothesis."""
        _, _, count, ways = self.weights.shape
        k = self.regressors[0].n_columns
        d = columns.shape[1] // k
        sums = np.zeros((len(self.partition.cell_edges) - 1, count * ways * ways, d * k * k))
        for part, rows, cells in self.partition.chunks(d * k * k):
            blocks, weights = columns[part].reshape(len(rows), d, k), self.weights[rows]
            pairs = (blocks[:, :, :, None] * blocks[:, :, None, :]).reshape(len(rows), -1)
            turned = np.einsum("nica,nicb->ncab", weights, weights).reshape(len(rows), -1).T
            for cell, at in cells:
                sums[cell] += turned[:, at] @ pairs[at]
        grams = self.partition.sums_over_places(sums).reshape(len(self.places), count, ways, ways, d, k, k)
        return grams.transpose(0, 1, 4, 2, 5, 3, 6).reshape(len(grams), count, d, ways * k, ways * k)


def score_batches(batches: Sequence[LawBatch], probe: NullEnsemble) -> list[tuple[list[ScreenedLaw], float, Floats]]:
    """Scores of each batch, in their order; columns that several batches share are computed once."""
    by_columns: dict[int, list[int]] = {}
    for i, batch in enumerate(batches):
        by_columns.setdefault(id(batch.columns), []).append(i)
    scores = {}
    for members in by_columns.values():
        scores.update({i: batches[i].best_laws_and_totals(probe) for i in members})
        batches[members[0]].columns.release()
    return [scores[i] for i in range(len(batches))]
