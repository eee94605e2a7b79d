"""Gram matrices, scores and log evidence of effects given a model, without approximation, for many effects at a time.

The residuals and the basis of a model lie in the residual space. A design matrix therefore has to be projected only for
its Gram matrix (its products with itself), which is the same for every model.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.evidence import log_sum_exp
from ltsim.core.arrays import MAX_TEMPORARY_ENTRIES, Floats, Ints
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE
from ltsim.diagnosis.evidence import index_of_most_evidence, log_evidence_of_coefficients, log_evidence_of_effect
from ltsim.diagnosis.hypotheses import EffectModel
from ltsim.physics.effects.linear_effect import CandidateEffect
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.responses import RESPONSE_AND_DESIGN_BY_NAME
from ltsim.solve.gauss_newton import MAX_ITERATIONS

CandidateEffectT = TypeVar("CandidateEffectT", bound=CandidateEffect)
"""Type variable of a catalogue effect or an empirical law (error as a function of covariates)."""
StationAndTargetNames = tuple[tuple[str, ...], tuple[str, ...]]
"""Names of the stations, and names of the targets, where an effect acts; empty for all."""


class AffectedRows(NamedTuple):
    """Observation equations on which an effect acts."""

    row_indices: Ints | slice
    """Indices of the affected observation equations, or a slice of them."""
    pointing_indices: Ints
    """Index (r,) of the pointing of each of the r affected readings."""


class EvidenceCalculator:
    """Calculator of Gram matrices, scores (products with residuals) and log evidence of effects in one adjustment.

    The design columns and the residuals are projected onto the residual space.
    """

    def __init__(self, space: ResidualSpace) -> None:
        self.residual_space = space
        self._pointing = np.nonzero(space.is_used_reading)[0]
        self._grams: dict[CandidateEffect, Floats] = {}
        self._changes_by_response: dict[str, Floats] = {}
        self._rows: dict[StationAndTargetNames, AffectedRows] = {}

    def grams_and_scores(
        self, effects: Sequence[CandidateEffect], conditioning_model: EffectModel
    ) -> list[tuple[Floats, Floats]]:
        """Gram matrix (k, k) and score (k,) of each effect with k parameters, given the effects of a model.

        The Gram matrix contains the inner products of the effect's design columns, projected onto the residual space,
        and the score their products with the residuals. The residuals are those of the adjustment that also estimates
        the effects of `conditioning_model`.
        """
        moments: dict[int, tuple[Floats, Floats]] = {}
        for rows, members in self._batches_with_same_rows(effects):
            batch_effects = [effects[i] for i in members]
            designs, column_edges = self._stacked_designs(batch_effects, rows)
            self._cache_projected_grams(batch_effects, designs, column_edges, rows)
            overlap, score = (
                conditioning_model.projected_basis[rows.row_indices].T @ designs,
                conditioning_model.residual[rows.row_indices] @ designs,
            )
            for i, low, high in zip(members, column_edges[:-1], column_edges[1:], strict=True):
                part = overlap[:, low:high]
                moments[i] = self._grams[effects[i]] - part.T @ part, score[low:high]
        return [moments[i] for i in range(len(effects))]

    def log_evidence(self, effects: Sequence[CandidateEffect], conditioning_model: EffectModel) -> Floats:
        """Log Bayes factors (effects,) of effects against no effect, averaged over sizes.

        The effects of `conditioning_model` are estimated in addition.
        """
        log_evidences = np.zeros(len(effects))
        by_size: dict[int, list[int]] = {}
        moments = self.grams_and_scores(effects, conditioning_model)
        for i, (effect, (gram, score)) in enumerate(zip(effects, moments, strict=True)):
            if any(p.is_nonnegative for p in effect.parameters):
                log_evidences[i] = log_evidence_of_effect(effect, gram, score)
            else:
                by_size.setdefault(len(score), []).append(i)
        for members in by_size.values():
            spreads = np.stack([effects[i].plausible_sizes for i in members])
            grams, scores = (np.stack([moments[i][j] for i in members]) for j in (0, 1))
            log_evidences[members] = log_evidence_of_coefficients(grams, scores, spreads)
        return log_evidences

    def refine_locally(
        self, effects: Sequence[CandidateEffectT], conditioning_model: EffectModel
    ) -> list[tuple[CandidateEffectT, float]]:
        """Most probable effect near each given effect, found by a local search, with its averaged log evidence.

        The search moves from an effect to its neighbours (effects with slightly different shape parameters or places).
        It ends when a step increases the log evidence by no more than its rounding error. The log evidence is averaged
        over the most probable effect and its neighbours. The effects of `conditioning_model` are estimated in addition.
        """
        best, values = list(effects), self.log_evidence(effects, conditioning_model)
        means, moving_indices = values.copy(), list(range(len(best)))
        for _ in range(MAX_ITERATIONS):
            candidates = {
                i: neighbours
                for i in moving_indices
                if (neighbours := best[i].neighbours(self.residual_space.sightings))
            }
            means[moving_indices] = values[moving_indices]
            if not candidates:
                break
            logs = self.log_evidence(
                [neighbour for neighbours in candidates.values() for neighbour in neighbours], conditioning_model
            )
            first_indices = np.cumsum([len(neighbours) for neighbours in candidates.values()])[:-1]
            moving_indices = []
            for (i, neighbours), parts in zip(candidates.items(), np.split(logs, first_indices), strict=True):
                means[i] = log_sum_exp(np.append(parts, values[i])) - np.log(len(parts) + 1)
                top = index_of_most_evidence(parts)
                if parts[top] > values[i] + NORMAL_EQUATIONS_TOLERANCE * max(1.0, abs(values[i])):
                    best[i], values[i] = neighbours[top], parts[top]
                    moving_indices.append(i)
        return list(zip(best, means.tolist(), strict=True))

    def whitened_design(self, effect: CandidateEffect) -> Floats:
        """Whitened design matrix (m, k) of an effect with k parameters, for all m observation equations."""
        affected_rows = self._affected_rows(effect)
        design_columns = np.zeros((self.residual_space.n_equations, len(effect.parameters)))
        design_columns[affected_rows.row_indices] = self._stacked_designs([effect], affected_rows)[0]
        return design_columns

    def _batches_with_same_rows(self, effects: Sequence[CandidateEffect]) -> Iterator[tuple[AffectedRows, list[int]]]:
        """Batches of effects that act on the same observation equations: pairs of equations and effect indices.

        A batch has at most `MAX_TEMPORARY_ENTRIES` matrix elements.
        """
        by_rows: dict[int, tuple[AffectedRows, list[int]]] = {}
        for i, effect in enumerate(effects):
            rows = self._affected_rows(effect)
            by_rows.setdefault(id(rows), (rows, []))[1].append(i)
        for rows, members in by_rows.values():
            ends = np.cumsum([len(effects[i].parameters) for i in members]) * len(rows.pointing_indices)
            parts = np.split(members, np.flatnonzero(np.diff(ends // MAX_TEMPORARY_ENTRIES)) + 1)
            yield from ((rows, part.tolist()) for part in parts)

    def _affected_rows(self, effect: CandidateEffect) -> AffectedRows:
        """Observation equations on which an effect acts: for an empirical law those of its place, otherwise all.

        An empirical law describes an error as a function of covariates. The place of a law is its stations and targets.
        """
        place = (effect.stations, effect.targets) if isinstance(effect, EmpiricalLaw) else (("",), ("",))
        if place not in self._rows:
            if not isinstance(effect, EmpiricalLaw):
                self._rows[place] = AffectedRows(slice(None), self._pointing)
            elif place == ((), ()):
                self._rows[place] = AffectedRows(slice(len(self._pointing)), self._pointing)
            else:
                acting_rows = np.flatnonzero(effect.pointing_indicator(self.residual_space.sightings)[self._pointing])
                self._rows[place] = AffectedRows(acting_rows, self._pointing[acting_rows])
        return self._rows[place]

    def _stacked_designs(self, effects: Sequence[CandidateEffect], affected_rows: AffectedRows) -> tuple[Floats, Ints]:
        """Whitened design columns (r, q) of several effects side by side on r affected rows, and limits of columns.

        There is one column for each parameter of each effect, q in all. The limits are the indices of the first column
        of each effect, followed by q.
        """
        column_edges = np.append(0, np.cumsum([len(effect.parameters) for effect in effects]))
        if not isinstance(effects[0], EmpiricalLaw):
            return np.hstack([self.residual_space.whitened_design(effect) for effect in effects]), column_edges
        designs = np.empty((len(affected_rows.pointing_indices), column_edges[-1]))
        response_changes: dict[str, Floats] = {}
        for effect, low, high in zip(effects, column_edges[:-1], column_edges[1:], strict=True):
            assert isinstance(effect, EmpiricalLaw)
            name = effect.response.name
            if name not in response_changes:
                response_changes[name] = self._response_changes(name)[affected_rows.row_indices]
            moved = effect.change_by_common_coefficient(
                response_changes[name], self.residual_space.sightings, affected_rows.pointing_indices
            )
            columns = effect.columns(self.residual_space.sightings)[affected_rows.pointing_indices]
            shape = len(designs), moved.shape[1], columns.shape[1]
            np.multiply(moved[:, :, None], columns[:, None, :], out=designs[:, low:high].reshape(shape))
        return designs, column_edges

    def _response_changes(self, name: str) -> Floats:
        """Whitened change (m, c) of m observation equations per unit of each component of a response.

        An empirical law describes an error as a function of covariates. The response `name` is the quantity that an
        empirical law changes, such as the vertical index; it has c components.
        """
        if name not in self._changes_by_response:
            self._changes_by_response[name] = self.residual_space.whiten(
                RESPONSE_AND_DESIGN_BY_NAME[name][1](self.residual_space.sightings)
            )
        return self._changes_by_response[name]

    def _cache_projected_grams(
        self, effects: Sequence[CandidateEffect], designs: Floats, column_edges: Ints, affected_rows: AffectedRows
    ) -> None:
        """Computation of the Gram matrices of the design columns of new effects, which are then cached.

        The columns are projected onto the residual space. `designs` has the columns of all effects side by side, and
        `column_edges` the index of the first column of each effect.
        """
        new_indices = sorted({effect: i for i, effect in enumerate(effects) if effect not in self._grams}.values())
        if not new_indices:
            return
        columns = designs
        if len(new_indices) < len(effects):
            columns = np.hstack([designs[:, column_edges[i] : column_edges[i + 1]] for i in new_indices])
        ends = np.append(0, np.cumsum(np.diff(column_edges)[new_indices]))
        grams = self.residual_space.projector.gram_matrices(columns, ends, affected_rows.row_indices)
        self._grams.update(zip((effects[i] for i in new_indices), grams, strict=True))
