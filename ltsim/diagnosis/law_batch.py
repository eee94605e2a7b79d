"""Batch of empirical laws: all combinations of responses (changed quantities), regressors and places, scored together.

A place is the stations, targets or instruments where a law acts. The score of a response with a regressor at a place is
a sum over the pointings of the place. Its terms are (derivative of the response) x (column of the regressor) x
(residual). Pointings that belong to the same places form a cell. One matrix product for each cell gives the sums for
all laws.

Sizes of arrays below: n pointings, P places, C responses with c components each, and D regressors with k columns each,
of which d are processed at a time. The null ensemble (residuals and simulated residuals) has v vectors.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from ltsim.calibration.evidence import log_evidence, log_sum_exp
from ltsim.core.arrays import Floats, Floats32, Ints, batches
from ltsim.core.rounding import MAX_LOG_EVIDENCE_ROUNDING_ERROR
from ltsim.diagnosis.evidence import N_EXACTLY_EVALUATED_HYPOTHESES, simulated_log_total_evidence
from ltsim.diagnosis.null_ensemble import MIN_SIMULATED_RECORDINGS, NullEnsemble
from ltsim.physics.laws.places import LawPlace
from ltsim.physics.laws.regressors import Regressor
from ltsim.physics.laws.responses import Response
from ltsim.scene.sightings import Sightings

MAX_CACHED_COLUMN_ENTRIES = 16_000_000
"""Largest number of elements (64 MB) of design columns of regressors (functions of covariates) that stay in memory. The
limit applies to the columns in use during the approximate evaluation of all laws, and to all columns between two
evaluations. To compute released columns again takes a sixth of the time of an evaluation."""


class ScreenedLaw(NamedTuple):
    """Screened empirical law: changed quantity, function of covariates, place, and approximate log evidence."""

    response: Response
    """Quantity that the empirical law (error as a function of covariates) changes, such as the vertical index."""
    regressor: Regressor
    """Function of covariates that the change of the quantity follows, such as a curve over time."""
    place: LawPlace
    """Stations, targets or instruments where the empirical law (error as a function of covariates) acts."""
    log_evidence: float
    """Approximate log evidence of the empirical law (function of covariates), including its log prior probability."""
    log_prior: float
    """Log prior probability of the empirical law (function of covariates) at its stations, targets or instruments."""


@dataclass(frozen=True)
class PointingPartition:
    """Partition of the pointings into cells: pointings of the same places (stations, targets or instruments).

    A sum over the pointings of a place, where empirical laws (functions of covariates) act, is a sum over its cells.
    """

    pointing_order: Ints
    """Indices (n,) of the n pointings, sorted by cell (pointings of the same places)."""
    cell_edges: Ints
    """Limits (cells + 1,) in `pointing_order` of the cells (pointings of the same places): starts, and end of the
    last."""
    is_cell_in_place: sp.csr_array
    """Indicators (P, cells) of the cells (groups of pointings) that belong to each of P places (stations, targets or
    instruments)."""

    @classmethod
    def from_places(cls, places: Sequence[LawPlace], n_pointings: int) -> PointingPartition:
        """Partition of `n_pointings` pointings by the places (stations, targets or instruments) of empirical laws.

        An empirical law is an error as a function of covariates.
        """
        is_inside = np.zeros((len(places), n_pointings), dtype=bool)
        for here, place in zip(is_inside, places, strict=True):
            here[place.rows] = True
        _, first, cell = np.unique(np.packbits(is_inside, axis=0), axis=1, return_index=True, return_inverse=True)
        pointing_order = np.argsort(cell.ravel(), kind="stable")
        edges = np.append(0, np.cumsum(np.bincount(cell.ravel())))
        return cls(pointing_order, edges, sp.csr_array(is_inside[:, first].astype(np.float32)))

    def pointing_batches(self, n_entries_per_pointing: int) -> Iterator[tuple[slice, Ints, list[tuple[int, slice]]]]:
        """Batches of pointings for temporary arrays with `n_entries_per_pointing` elements per pointing.

        Each batch is a tuple: its slice of `pointing_order`, the indices of its pointings, and for each of its cells
        (pointings of the same places) the index of the cell and its slice in the batch.
        """
        for part in batches(len(self.pointing_order), n_entries_per_pointing):
            first, last = np.searchsorted(self.cell_edges, [part.start, part.stop - 1], side="right") - 1
            cuts = np.clip(self.cell_edges[first : last + 2] - part.start, 0, part.stop - part.start).tolist()
            here = [(first + i, slice(*cut)) for i, cut in enumerate(pairwise(cuts))]
            yield part, self.pointing_order[part], here

    def sums_over_places(self, cell_sums: Any) -> Any:
        """Sums (P, ...) over the pointings of each of P places (stations, targets or instruments).

        `cell_sums` (cells, ...) are the sums over the cells (pointings of the same places).
        """
        return (self.is_cell_in_place @ cell_sums.reshape(len(cell_sums), -1)).reshape(-1, *cell_sums.shape[1:])


class RegressorColumns:
    """Design columns of regressors (functions of covariates) at all pointings, k columns each, computed on first use.

    Several batches of laws share the columns, which stay in memory until they are released, or always if `is_cached`.
    """

    def __init__(
        self, regressors: Sequence[Regressor], sightings: Sightings, pointing_order: Ints, *, acts_on_targets: bool
    ) -> None:
        self._regressors, self._sightings, self._order, self._acts_on_targets = (
            regressors,
            sightings,
            pointing_order,
            acts_on_targets,
        )
        self._all_columns: Floats32 | None = None
        self.is_cached = False
        self.n_entries_per_regressor = regressors[0].n_columns * len(sightings)

    def model_columns(self, regressor_range: slice) -> Floats32:
        """Columns (n, d k) of the d regressors in `regressor_range`, k columns each, for n pointings.

        A regressor is a function of covariates to which the error is proportional. The pointings are sorted by place
        (stations, targets or instruments).
        """
        if self.n_entries_per_regressor * len(self._regressors) > MAX_CACHED_COLUMN_ENTRIES:
            return self._compute_columns(self._regressors[regressor_range])
        if self._all_columns is None:
            self._all_columns = self._compute_columns(self._regressors)
        n_columns = self._regressors[0].n_columns
        return self._all_columns[:, regressor_range.start * n_columns : regressor_range.stop * n_columns]

    def release_memory(self) -> None:
        """Removal of the design columns from memory, unless they are always cached."""
        if not self.is_cached:
            self._all_columns = None

    def _compute_columns(self, regressors: Sequence[Regressor]) -> Floats32:
        """Columns (n, d k) of d regressors with k columns each, for n pointings.

        A regressor is a function of covariates to which the error is proportional. The pointings are sorted by place
        (stations, targets or instruments).
        """
        n_columns = regressors[0].n_columns
        columns = np.empty((len(self._sightings), len(regressors) * n_columns), dtype=np.float32)
        for i, driver in enumerate(regressors):
            made = driver.columns(self._sightings, acts_on_targets=self._acts_on_targets)
            columns[:, i * n_columns : (i + 1) * n_columns] = made[self._order]
        return columns


@dataclass(frozen=True)
class LawBatch:
    """Batch of empirical laws: all combinations of responses (changed quantities), regressors and places.

    A regressor is a function of covariates that the change follows; a place is the stations, targets or instruments
    where it acts. The responses are of one kind. The regressors have the same number of columns and of length scales.
    """

    responses: tuple[Response, ...]
    """Quantities (C responses with c components each) that the empirical laws (functions of covariates) change."""
    regressors: tuple[Regressor, ...]
    """Functions of covariates, D regressors of k basis functions (such as sine and cosine) each; a law is a linear
    combination of the basis functions of its regressor."""
    places: tuple[LawPlace, ...]
    """Stations, targets or instruments (P places) where the empirical laws (functions of covariates) act."""
    pointing_partition: PointingPartition
    """Partition of the pointings by the stations, targets or instruments (places) where the empirical laws act."""
    whitened_response_designs: Floats32
    """Whitened change (n, 3, C, c) of the readings of n pointings by the plausible size of each of the c components of
    C responses (changed quantities)."""
    regressor_columns: RegressorColumns
    """Design columns of the regressors (functions of covariates), which batches of laws with the same regressors and
    places share."""
    log_prior_by_place: Floats
    """Log prior probability (P,) of one empirical law (function of covariates) at each of P places (stations,
    targets)."""
    _cached_eigen_decompositions: dict[int, list[tuple[Floats, Floats32]]] = field(default_factory=dict, repr=False)
    """Eigen decompositions of Gram matrices scaled by prior standard deviations, by the first index of their range of
    regressors (functions of covariates)."""

    @cached_property
    def _prior_sigmas(self) -> list[Floats]:
        """Prior standard deviations (D, c k) of the coefficients of D regressors, one array per length scale.

        A regressor is a function of covariates with k columns; each response (changed quantity) has c components.
        """
        n_components = self.whitened_response_designs.shape[3]
        return [
            np.tile(np.stack(sets), n_components)
            for sets in zip(*(d.coefficient_sigmas for d in self.regressors), strict=True)
        ]

    def best_laws_and_log_total_evidence(self, null_ensemble: NullEnsemble) -> tuple[list[ScreenedLaw], float, Floats]:
        """Empirical laws with the largest evidence at each place, log of the summed evidence of all, and null values.

        A place is the stations, targets or instruments where a law acts. The null values (trials,) are the log of the
        summed evidence for each simulated recording (trial) of the null ensemble. An empirical law is an error as a
        function of covariates.
        """
        count, size = len(self.regressors), self.regressors[0].n_columns
        products = size * self.whitened_response_designs[0, 0].size * len(self.places)
        n_entries = max(products * MIN_SIMULATED_RECORDINGS, self.regressor_columns.n_entries_per_regressor)
        batch_results = [self._log_evidence_at_places(null_ensemble, part) for part in batches(count, n_entries)]
        log_evidences = np.concatenate([log_evidences for log_evidences, _ in batch_results], axis=2).reshape(
            len(self.places), -1
        )
        null = log_sum_exp(np.stack([null for _, null in batch_results]))
        best_index = indices_of_largest(
            np.round(log_evidences / MAX_LOG_EVIDENCE_ROUNDING_ERROR), N_EXACTLY_EVALUATED_HYPOTHESES
        )
        hits = [
            ScreenedLaw(self.responses[i // count], self.regressors[i % count], place, v, prior)
            for place, prior, indices, here in zip(
                self.places, self.log_prior_by_place.tolist(), best_index, log_evidences, strict=True
            )
            for i, v in zip(indices.tolist(), here[indices].tolist(), strict=True)
        ]
        return hits, float(log_sum_exp(log_evidences.ravel())), null

    def _log_evidence_at_places(self, null_ensemble: NullEnsemble, regressor_range: slice) -> tuple[Floats, Floats]:
        """Log evidence (P, C, d), with priors, of empirical laws, and their log summed evidence in simulations.

        There are C responses (changed quantities) and d regressors (functions of covariates that they follow, those in
        `regressor_range`), at P places (stations or targets). The second result (trials,) belongs to the simulated
        recordings (trials). The Gram matrix of a law is not reduced by the effects in the model. It is therefore too
        large for a law that is correlated with them. The laws with the largest evidence are evaluated again without
        this approximation.
        """
        columns = self.regressor_columns.model_columns(regressor_range)
        scores = self._products_with_ensemble_vectors(null_ensemble, columns)
        score, trials, _ = null_ensemble.split_products(scores)
        null = np.full((1, null_ensemble.n_trials), -np.inf)
        if null_ensemble.is_first_screening:
            unprojected = None if null_ensemble.uses_monte_carlo_gram else self._unprojected_gram_matrices(columns)
            grams = null_ensemble.projected_gram(scores, unprojected)
            eigen_decompositions = self._scaled_eigen_decompositions(grams, regressor_range)
            self._cached_eigen_decompositions[regressor_range.start] = eigen_decompositions
            if null_ensemble.n_trials:
                priors = np.repeat(self.log_prior_by_place, scores.shape[1] * scores.shape[2])
                null = np.stack(
                    [
                        simulated_log_total_evidence(eigenvectors @ trials, eigenvalues, priors)
                        for eigenvalues, eigenvectors in eigen_decompositions
                    ]
                )
        log_evidences = [
            log_evidence(np.square((eigenvectors @ score[..., None])[..., 0], dtype=np.float64), eigenvalues)
            for eigenvalues, eigenvectors in self._cached_eigen_decompositions[regressor_range.start]
        ]
        return log_sum_exp(np.stack(log_evidences)) + self.log_prior_by_place[:, None, None], log_sum_exp(null)

    def _scaled_eigen_decompositions(self, gram: Floats, regressor_range: slice) -> list[tuple[Floats, Floats32]]:
        """Eigen decompositions of Gram matrices of empirical laws, scaled by prior sigmas of their coefficients.

        The list runs over the length scales of the smooth functions of a regressor, each with its own prior sigmas. An
        entry has the eigenvalues (P, C, d, c k) and matrices (P, C, d, c k, c k); the product of such a matrix with the
        scores of a law gives its scores along the eigenvectors. There are P places (stations and targets where a law
        acts), C responses (quantities that it changes) with c components, and d regressors with k columns in
        `regressor_range`. `gram` has the shape (P, C, d, c k, c k). An empirical law is an error as a function of
        covariates.
        """
        transforms = []
        for spread in (spread[regressor_range] for spread in self._prior_sigmas):
            eigenvalues, eigenvectors = np.linalg.eigh(gram * spread[:, :, None] * spread[:, None, :])
            eigenvectors = np.swapaxes(eigenvectors, -1, -2) * spread[:, None, :]
            transforms.append((np.maximum(eigenvalues, 0.0), eigenvectors.astype(np.float32)))
        return transforms

    def _products_with_ensemble_vectors(self, null_ensemble: NullEnsemble, columns: Floats32) -> Floats32:
        """Products (P, C, d, c k, v) of the design matrices of empirical laws with v vectors of the null ensemble.

        The laws act at P places (stations and targets) on C responses (changed quantities) with c components. `columns`
        (n, d k) are the k columns of each of d regressors (functions of covariates) at n pointings. The null ensemble
        consists of simulated recordings without effects.
        """
        _, _, count, n_components = self.whitened_response_designs.shape
        vectors, d = null_ensemble.probe_vectors.shape[1], columns.shape[1] // self.regressors[0].n_columns
        cell_sums = np.zeros(
            (len(self.pointing_partition.cell_edges) - 1, columns.shape[1], count * n_components * vectors),
            dtype=np.float32,
        )
        for part, rows, cells in self.pointing_partition.pointing_batches(count * n_components * vectors):
            whitened_response_designs = self.whitened_response_designs[rows].reshape(len(rows), 3, -1)
            moved = (np.swapaxes(whitened_response_designs, 1, 2) @ null_ensemble.vectors_of_pointings(rows)).reshape(
                len(rows), -1
            )
            transposed_columns = columns[part].T
            for cell, at in cells:
                cell_sums[cell] += transposed_columns[:, at] @ moved[at]
        products = self.pointing_partition.sums_over_places(cell_sums).reshape(
            len(self.places), d, -1, count, n_components, vectors
        )
        return np.ascontiguousarray(products.transpose(0, 3, 1, 4, 2, 5)).reshape(len(products), count, d, -1, vectors)

    def _unprojected_gram_matrices(self, columns: Floats32) -> Floats:
        """Gram matrices (P, C, d, c k, c k) of the designs of empirical laws, before their projection.

        The laws act at P places (stations and targets) on C responses (changed quantities) with c components. `columns`
        (n, d k) are the k columns of each of d regressors (functions of covariates) at n pointings. Projected means:
        without the part that the unknowns of the adjustment absorb.
        """
        _, _, count, n_components = self.whitened_response_designs.shape
        k = self.regressors[0].n_columns
        d = columns.shape[1] // k
        cell_sums = np.zeros(
            (len(self.pointing_partition.cell_edges) - 1, count * n_components * n_components, d * k * k)
        )
        for part, rows, cells in self.pointing_partition.pointing_batches(d * k * k):
            blocks, whitened_response_designs = (
                columns[part].reshape(len(rows), d, k),
                self.whitened_response_designs[rows],
            )
            pairs = (blocks[:, :, :, None] * blocks[:, :, None, :]).reshape(len(rows), -1)
            response_products = (
                np.einsum("nica,nicb->ncab", whitened_response_designs, whitened_response_designs)
                .reshape(len(rows), -1)
                .T
            )
            for cell, at in cells:
                cell_sums[cell] += response_products[:, at] @ pairs[at]
        grams = self.pointing_partition.sums_over_places(cell_sums).reshape(
            len(self.places), count, n_components, n_components, d, k, k
        )
        return grams.transpose(0, 1, 4, 2, 5, 3, 6).reshape(len(grams), count, d, n_components * k, n_components * k)


def indices_of_largest(values: Floats, count: int) -> Ints:
    """Indices (p, c) of the `count` largest entries of each row of `values` (p, q), or of all q if there are fewer.

    The largest is first, and the first of equal entries. This is faster than sorting the rows. `values` is overwritten.
    """
    np.nan_to_num(values, copy=False, nan=np.finfo(np.float64).min)  # above the mark of selected entries
    rows = np.arange(len(values))
    indices = np.empty((len(values), min(count, values.shape[1])), dtype=np.int64)
    for column in indices.T:
        column[:] = values.argmax(axis=1)
        values[rows, column] = -np.inf
    return indices


def evaluate_law_batches(
    law_batches: Sequence[LawBatch], null_ensemble: NullEnsemble
) -> list[tuple[list[ScreenedLaw], float, Floats]]:
    """Best laws, log of the summed evidence, and null values (trials,) of each batch of laws, in the order of batches.

    An empirical law is an error as a function of covariates. The null values are the log of the summed evidence in
    simulated recordings without effects (trials).
    """
    by_columns: dict[int, list[int]] = {}
    for i, batch in enumerate(law_batches):
        by_columns.setdefault(id(batch.regressor_columns), []).append(i)
    scores = {}
    for members in by_columns.values():
        scores.update({i: law_batches[i].best_laws_and_log_total_evidence(null_ensemble) for i in members})
        law_batches[members[0]].regressor_columns.release_memory()
    return [scores[i] for i in range(len(law_batches))]
