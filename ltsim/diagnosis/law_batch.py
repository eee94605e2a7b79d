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
from ltsim.core.arrays import Floats, Ints, Singles
from ltsim.diagnosis.evidence import SCREENED_TIE, simulated_total
from ltsim.diagnosis.null_ensemble import NullEnsemble
from ltsim.physics.laws.places import LawPlace
from ltsim.physics.laws.regressors import Regressor
from ltsim.physics.laws.responses import Response
from ltsim.scene.sightings import Sightings

CHUNK = 1000
"""Number of pointings whose products are in memory at a time."""
PAIRS = 500_000
"""Number of products of columns in memory at a time, the size of a cache."""
AT_ONCE = 10_000
"""Number of columns at places whose products with all vectors are in memory at a time, some tens of MB."""
COLUMN_ENTRIES, SHARED_ENTRIES = 5_000_000, 16_000_000
"""Number of entries of columns of regressors that are computed at a time, 20 MB, and number up to which the batches
with the same regressors share them, 64 MB.
"""
MOST_HITS = 6
"""Largest number of hypotheses per place that are evaluated again."""


@dataclass(frozen=True)
class ScreenedLaw:
    """Screened law with its log evidence including the prior."""

    carrier: Response
    driver: Regressor
    place: LawPlace
    value: float
    log_prior: float


@dataclass(frozen=True)
class RowPartition:
    """Partition of the pointings into cells that belong to the same places: a place sums its cells.

    Attributes
    ----------
    order : (r,) int
        Pointings, cell after cell.
    edges : (cells + 1,) int
        Where each cell begins in that order, and the end.
    members : (P, cells) csr float32
        One where a cell lies in a place.
    """

    order: Ints
    edges: Ints
    members: sp.csr_array

    @classmethod
    def of(cls, places: Sequence[LawPlace], count: int) -> RowPartition:
        """Partition of `count` pointings by the places that they belong to."""
        inside = np.zeros((len(places), count), dtype=bool)
        for here, place in zip(inside, places, strict=True):
            here[place.rows] = True
        _, first, cell = np.unique(np.packbits(inside, axis=0), axis=1, return_index=True, return_inverse=True)
        order = np.argsort(cell.ravel(), kind="stable")
        edges = np.append(0, np.cumsum(np.bincount(cell.ravel())))
        return cls(order, edges, sp.csr_array(inside[:, first].astype(np.float32)))

    def parts(self, most: int) -> Iterator[tuple[slice, Ints, list[tuple[int, slice]]]]:
        """Chunks of at most `most` pointings: slice of the order, pointings, and slice of each cell in the chunk."""
        for start in range(0, len(self.order), most):
            end = min(start + most, len(self.order))
            first, last = np.searchsorted(self.edges, [start, end - 1], side="right") - 1
            cuts = np.clip(self.edges[first : last + 2] - start, 0, end - start).tolist()
            here = [(first + i, slice(*cut)) for i, cut in enumerate(pairwise(cuts))]
            yield slice(start, end), self.order[start:end], here

    def summed(self, parts: Any) -> Any:
        """Sums (P, ...) over places from the sums over cells (cells, ...)."""
        return (self.members @ parts.reshape(len(parts), -1)).reshape(-1, *parts.shape[1:])


class RegressorColumns:
    """Columns of some regressors of equal size at all pointings, computed when they are needed.

    Those of several batches are shared: they stay in memory until they are released, or always if `cached`.
    """

    def __init__(self, drivers: Sequence[Regressor], sightings: Sightings, order: Ints, *, moving: bool) -> None:
        self._drivers, self._sightings, self._order, self._moving = drivers, sightings, order, moving
        self._whole: Singles | None = None
        self.cached = False
        self.entries = drivers[0].n_columns * len(sightings)  # of one regressor

    def of(self, part: slice) -> Singles:
        """Columns (n, d k) of some regressors, at the pointings in the order of the cells."""
        if self.entries * len(self._drivers) > SHARED_ENTRIES:
            return self._computed(self._drivers[part])
        if self._whole is None:
            self._whole = self._computed(self._drivers)
        size = self._drivers[0].n_columns
        return self._whole[:, part.start * size : part.stop * size]

    def release(self) -> None:
        """Removal of columns that are not cached."""
        if not self.cached:
            self._whole = None

    def _computed(self, drivers: Sequence[Regressor]) -> Singles:
        size = drivers[0].n_columns
        columns = np.empty((len(self._sightings), len(drivers) * size), dtype=np.float32)
        for i, driver in enumerate(drivers):
            made = driver.columns(self._sightings, acts_on_targets=self._moving)
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
        Of each hypothesis and scale at a place.
    """

    carriers: tuple[Response, ...]
    drivers: tuple[Regressor, ...]
    places: tuple[LawPlace, ...]
    cells: RowPartition
    weights: Singles
    columns: RegressorColumns
    log_prior: Floats
    _forms: dict[int, list[tuple[Floats, Singles]]] = field(default_factory=dict, repr=False)

    @cached_property
    def _spreads(self) -> list[Floats]:
        """Prior standard deviations (D, c k) for each scale."""
        ways = self.weights.shape[3]
        return [
            np.tile(np.stack(sets), ways) for sets in zip(*(d.coefficient_sigmas for d in self.drivers), strict=True)
        ]

    def score(self, probe: NullEnsemble) -> tuple[list[ScreenedLaw], float, Floats]:
        """Best hypotheses of every place, and log sums over all: of the recording, and of trials (trials,)."""
        count, size = len(self.drivers), self.drivers[0].n_columns
        products = size * self.weights[0, 0].size * len(self.places)
        step = max(1, min(AT_ONCE // products, COLUMN_ENTRIES // self.columns.entries))
        parts = [self._at(probe, slice(i, min(i + step, count))) for i in range(0, count, step)]
        values = np.concatenate([values for values, _ in parts], axis=2).reshape(len(self.places), -1)
        null = log_sum_exp(np.stack([null for _, null in parts]))
        best = np.argsort(-np.round(values / SCREENED_TIE), axis=1, kind="stable")[:, :MOST_HITS]
        hits = [
            ScreenedLaw(self.carriers[i // count], self.drivers[i % count], place, v, prior)
            for place, prior, indices, here in zip(self.places, self.log_prior.tolist(), best, values, strict=True)
            for i, v in zip(indices.tolist(), here[indices].tolist(), strict=True)
        ]
        return hits, float(log_sum_exp(values.ravel())), null

    def _at(self, probe: NullEnsemble, part: slice) -> tuple[Floats, Floats]:
        """Log evidence (P, C, d) of some regressors with priors, and its log sum over trials.

        The model does not reduce the Gram matrix of a law here, which overstates it where both are correlated; the best
        laws are evaluated again without this approximation.
        """
        columns = self.columns.of(part)
        scores = self._sums(probe, columns)
        score, trials, _ = probe.split(scores)
        null = np.full((1, probe.count), -np.inf)
        if probe.is_first_pass:
            turned = self._turned(probe.gram(scores, self._self_products(columns)), part)
            self._forms[part.start] = turned
            if probe.count:
                priors = np.repeat(self.log_prior, scores.shape[1] * scores.shape[2])
                null = np.stack([simulated_total(turn @ trials, strength, priors) for strength, turn in turned])
        each = [
            log_evidence((turn @ score[..., None])[..., 0] ** 2, strength) for strength, turn in self._forms[part.start]
        ]
        return log_sum_exp(np.stack(each)) + self.log_prior[:, None, None], log_sum_exp(null)

    def _turned(self, gram: Floats, part: slice) -> list[tuple[Floats, Singles]]:
        """Eigenvalues (P, C, d, k) per scale, and the matrix that transforms scores to eigenvectors."""
        turned = []
        for spread in (spread[part] for spread in self._spreads):
            strength, turn = np.linalg.eigh(gram * spread[:, :, None] * spread[:, None, :])
            turn = np.swapaxes(turn, -1, -2) * spread[:, None, :]
            turned.append((np.maximum(strength, 0.0), turn.astype(np.float32)))
        return turned

    def _sums(self, probe: NullEnsemble, columns: Singles) -> Singles:
        """Products (P, C, d, c k, v) of columns (n, d k) of regressors with the ensemble's vectors at all places."""
        _, _, count, ways = self.weights.shape
        vectors, d = probe.vectors.shape[1], columns.shape[1] // self.drivers[0].n_columns
        sums = np.zeros((len(self.cells.edges) - 1, columns.shape[1], count * ways * vectors), dtype=np.float32)
        for part, rows, cells in self.cells.parts(CHUNK):
            weights = self.weights[rows].reshape(len(rows), 3, -1)
            moved = (np.swapaxes(weights, 1, 2) @ probe.at(rows)).reshape(len(rows), -1)
            turned = columns[part].T
            for cell, at in cells:
                sums[cell] += turned[:, at] @ moved[at]
        shaped = self.cells.summed(sums).reshape(len(self.places), d, -1, count, ways, vectors)
        return np.ascontiguousarray(shaped.transpose(0, 3, 1, 4, 2, 5)).reshape(len(shaped), count, d, -1, vectors)

    def _self_products(self, columns: Singles) -> Floats:
        """Gram matrices (P, C, d, c k, c k) of the columns (n, d k) of each hypothesis."""
        _, _, count, ways = self.weights.shape
        k = self.drivers[0].n_columns
        d = columns.shape[1] // k
        sums = np.zeros((len(self.cells.edges) - 1, count * ways * ways, d * k * k))
        for part, rows, cells in self.cells.parts(max(1, min(CHUNK, PAIRS // (d * k * k)))):
            blocks, weights = columns[part].reshape(len(rows), d, k), self.weights[rows]
            pairs = (blocks[:, :, :, None] * blocks[:, :, None, :]).reshape(len(rows), -1)
            turned = np.einsum("nica,nicb->ncab", weights, weights).reshape(len(rows), -1).T
            for cell, at in cells:
                sums[cell] += turned[:, at] @ pairs[at]
        shaped = self.cells.summed(sums).reshape(len(self.places), count, ways, ways, d, k, k)
        return shaped.transpose(0, 1, 4, 2, 5, 3, 6).reshape(len(shaped), count, d, ways * k, ways * k)


def scored(batches: Sequence[LawBatch], probe: NullEnsemble) -> list[tuple[list[ScreenedLaw], float, Floats]]:
    """Scores of each batch, in their order; columns that several batches share are computed once."""
    by_columns: dict[int, list[int]] = {}
    for i, batch in enumerate(batches):
        by_columns.setdefault(id(batch.columns), []).append(i)
    scores = {}
    for members in by_columns.values():
        scores.update({i: batches[i].score(probe) for i in members})
        batches[members[0]].columns.release()
    return [scores[i] for i in range(len(batches))]
