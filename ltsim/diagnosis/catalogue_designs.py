"""Design matrices of the catalogue effects as hypotheses, for all stations and targets and all shape parameters.

A variant of an effect has a place (stations and targets where it acts) and shape parameters (such as a period). Sizes
of arrays below: h variants with k parameters each, m observation equations, v vectors of the null ensemble (residuals
and simulated residuals).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import scipy.sparse as sp

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.evidence import log_evidence
from ltsim.core.arrays import Floats, Floats32, Ints, batches, stack_and_release
from ltsim.diagnosis.evidence import (
    MAX_LOG_EVIDENCE_DEFICIT_FOR_EXACT_EVALUATION,
    log_mean_exp_by_group,
    simulated_log_evidence,
    size_factor_to_noise_level,
)
from ltsim.diagnosis.hypotheses import Hypothesis
from ltsim.diagnosis.null_ensemble import NullEnsemble, gram_of_rows
from ltsim.diagnosis.prior import log_prior_by_base_rate
from ltsim.diagnosis.shape_parameters import are_distinct
from ltsim.physics.effects import CATALOGUE, ORDINARY_CALIBRATION_EFFECTS
from ltsim.physics.effects.effect import Effect, LightPathStage, NoiseEffect
from ltsim.physics.effects.linear_effect import CandidateEffect
from ltsim.physics.effects.range_scale import RangeScale
from ltsim.physics.laws.places import instrument_places
from ltsim.recordings.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings

MAX_NONZERO_ROW_FRACTION_OF_SPARSE_DESIGN = 0.15
"""Largest fraction of nonzero rows of a design matrix that is stored as sparse, to save computing time."""
MAX_LOCAL_OPTIMA_PER_CATALOGUE_EFFECT = 3
"""Largest number of local optima of a catalogue effect, over stations, targets and shape parameters, that are
evaluated."""
MAX_COMPARED_PLACES_AND_SHAPES = 40
"""Number of variants (places, shape parameters) of an effect among which local optima of the evidence are sought."""
ORDINARY_CALIBRATION_EFFECT_TYPES = tuple(type(effect) for effect in ORDINARY_CALIBRATION_EFFECTS)
"""Effect classes of the ordinary calibration, whose instrument constants every adjustment estimates. As a hypothesis,
such an effect means that its instrument constants are larger than their prior permits."""


def catalogue_candidate_effects(sightings: Sightings, instruments: Sequence[str] = ()) -> list[CandidateEffect]:
    """Catalogue effects at all stations and targets, and instrument constants of each of several instruments.

    `instruments` are the names of the instruments. Effects on the noise are not included.
    """
    trackers = instrument_places(sightings, instruments)
    constants = [
        kind(stations=place.stations)
        for kind in CATALOGUE
        if kind in ORDINARY_CALIBRATION_EFFECT_TYPES
        for place in trackers
    ]
    kinds = [kind for kind in CATALOGUE if not issubclass(kind, NoiseEffect)]
    return [*constants, *(e for kind in kinds for e in kind.candidates(sightings))]


@dataclass(frozen=True)
class EffectDesignGroup:
    """Group of h effects with k parameters each, whose design columns are stored in one matrix.

    The matrix is sparse, or dense on the r observation equations that the effects change.
    """

    n_parameters: int
    """Number k of parameters of each effect in the group."""
    effect_indices: Ints
    """Indices (h,) in `CatalogueDesigns.effects` of the h effects of the group."""
    row_indices: Ints | slice
    """Indices (r,) of the r observation equations for which the design columns are stored."""
    transposed_designs: Floats32 | sp.csr_array
    """Transposed design columns (h k, r) of h effects with k parameters on r observation equations, in units of
    plausible sizes."""
    row_factors: Floats32
    """Factors (r,) by which the r stored observation equations are multiplied, if an adjustment has other weights."""
    unprojected_gram: Floats
    """Gram matrices (h, k, k) of the k design columns of each of h effects, before projection onto the residual space
    (whitened equations projected off the unknowns)."""
    projected_gram: Floats
    """Gram matrices (h, k, k) of the k design columns of each of h effects, projected onto the residual space (whitened
    equations projected off the unknowns) without effects; zeros before the first screening (approximate evaluation)."""

    def effect_ranges(self, n_vectors: int) -> Iterator[slice]:
        """Ranges of effects in the group whose products with `n_vectors` vectors fit into memory at the same time."""
        return batches(len(self.effect_indices), self.n_parameters * n_vectors)

    def products_with_vectors(self, effect_range: slice, vectors: Floats | Floats32) -> Floats:
        """Products (h, k, v) of the k design columns of each of h effects in `effect_range` with v `vectors` (m, v).

        The vectors have one element per observation equation. The design columns are multiplied by `row_factors`.
        """
        transposed_designs, count = (
            self.transposed_designs[effect_range.start * self.n_parameters : effect_range.stop * self.n_parameters],
            vectors.shape[1],
        )
        products = np.empty((transposed_designs.shape[0], count))
        for part in batches(count, len(self.row_factors)):
            products[:, part] = transposed_designs @ np.multiply(
                vectors[self.row_indices, part], self.row_factors[:, None], dtype=np.float32
            )
        return products.reshape(effect_range.stop - effect_range.start, self.n_parameters, count)

    def with_rows_scaled(self, row_factors: Floats32) -> EffectDesignGroup:
        """Copy of the group whose observation equations are multiplied by factors (m,), for other weights."""
        weight = self.row_factors * row_factors[self.row_indices]
        if isinstance(self.transposed_designs, np.ndarray):
            parts = (
                self.transposed_designs[p.start * self.n_parameters : p.stop * self.n_parameters] * weight
                for p in self.effect_ranges(len(weight))
            )
            products = np.concatenate(
                [
                    gram_of_rows(transposed_designs.reshape(-1, self.n_parameters, len(weight)))
                    for transposed_designs in parts
                ]
            )
        else:
            data = self.transposed_designs.data * weight[self.transposed_designs.indices]
            ends = self.transposed_designs.indptr[:: self.n_parameters].tolist()
            products = np.stack(
                [gram_of_rows(data[low:high].reshape(self.n_parameters, -1)) for low, high in pairwise(ends)]
            )
        return replace(
            self,
            row_factors=weight,
            unprojected_gram=products.astype(np.float64),
            projected_gram=np.zeros_like(self.projected_gram),
        )


@dataclass(frozen=True)
class CatalogueDesigns:
    """Variants of catalogue effects as hypotheses, with design columns in units of plausible sizes.

    A family is the set of all variants of one catalogue effect: with other stations, targets or shape parameters.
    """

    effects: list[CandidateEffect]
    """All h variants (places, shape parameters) of catalogue effects that change at least one reading of the
    recording."""
    groups: list[EffectDesignGroup]
    """Groups of effects with the same number of parameters and the same form of storage (sparse or dense)."""
    family_names: tuple[str, ...]
    """Names of the catalogue effects, one for each family (all places and shape parameters of the effect)."""
    family_indices: Ints
    """Index (h,) of the family (catalogue effect) to which each of h variants (places, shape parameters) belongs."""
    n_equations: int
    """Number m of observation equations."""
    reading_sigmas: Floats
    """Standard deviations (n, 3) [m, rad, rad] of the readings of n pointings, by which design columns are divided."""

    @cached_property
    def log_prior_by_family(self) -> Floats:
        """Log prior probability (families,) of each catalogue effect, summed over its places and shape parameters."""
        return log_prior_by_base_rate("named", self.family_names)

    def log_prior_of_family(self, family_name: str) -> float:
        """Log prior probability of the catalogue effect named `family_name`, summed over its variants.

        It is defined also for effects that are not tried, such as wrong readings in a large recording.
        """
        names = self.family_names if family_name in self.family_names else (*self.family_names, family_name)
        return float(log_prior_by_base_rate("named", names)[names.index(family_name)])

    def hypotheses_of_effects(self, effects: Sequence[CandidateEffect]) -> tuple[Hypothesis, ...]:
        """Hypotheses for the given catalogue effects; effects that are not possible in the recording are left out."""
        n_places = np.bincount(self.family_indices, minlength=len(self.family_names))
        prior = dict(zip(self.family_names, self.log_prior_by_family - np.log(n_places), strict=True))
        return tuple(Hypothesis(e, float(prior[e.name]), 0.0, e.name) for e in effects if e.name in prior)

    @classmethod
    def from_residual_space(cls, space: ResidualSpace, effects: Sequence[CandidateEffect]) -> CatalogueDesigns:
        """Design matrices of the `effects` that change a reading; `space` has the whitened equations."""
        touching: list[CandidateEffect] = []
        sparse_designs: dict[int, list[tuple[int, Ints, Floats32]]] = {}
        dense_designs: dict[tuple[int, tuple[bool, ...]], tuple[list[int], list[Floats32]]] = {}
        used_indices = np.nonzero(space.is_used_reading)
        other = np.ones(
            space.n_equations - len(used_indices[0]), dtype=np.int64
        )  # rows that are no readings count as one further pointing and kind
        pointing, kind = (
            np.append(of, n * other) for of, n in zip(used_indices, space.is_used_reading.shape, strict=True)
        )
        for effect in effects:
            row_indices, design_columns = space.nonzero_whitened_design(effect)
            if not len(row_indices):
                continue
            touched = np.bincount(kind[row_indices], minlength=len(OBSERVABLES) + 1) > 0
            is_sparse = len(row_indices) < MAX_NONZERO_ROW_FRACTION_OF_SPARSE_DESIGN * space.n_equations
            stored = row_indices if is_sparse else np.flatnonzero(touched[kind])
            if not is_sparse:
                nonzero_rows, design_columns = design_columns, np.zeros((len(stored), design_columns.shape[1]))
                design_columns[np.searchsorted(stored, row_indices)] = nonzero_rows
            design_columns *= effect.plausible_sizes
            effect, coarser = _with_size_raised_to_noise(effect, design_columns, pointing[stored])
            transposed_designs = np.ascontiguousarray(design_columns.T * coarser, dtype=np.float32)
            if is_sparse:
                sparse_designs.setdefault(len(transposed_designs), []).append(
                    (len(touching), stored.astype(np.int32), transposed_designs)
                )
            else:
                effect_indices, made = dense_designs.setdefault(
                    (len(transposed_designs), tuple(touched.tolist())), ([], [])
                )
                effect_indices.append(len(touching))
                made.append(transposed_designs)
            touching.append(effect)
        effect_groups = [
            _sparse_designs(n_parameters, sparse_designs.pop(n_parameters), space.n_equations)
            for n_parameters in sorted(sparse_designs)
        ]
        effect_groups += [
            _dense_designs(n_parameters, effect_indices, stack_and_release(made), np.flatnonzero(np.array(kinds)[kind]))
            for (n_parameters, kinds), (effect_indices, made) in sorted(dense_designs.items())
        ]
        names = tuple(dict.fromkeys(effect.name for effect in touching))
        index = {name: i for i, name in enumerate(names)}
        family_indices = np.array([index[e.name] for e in touching], dtype=np.int64)
        return cls(touching, effect_groups, names, family_indices, space.n_equations, space.reading_sigmas)

    def with_weights_of(self, new_space: ResidualSpace) -> CatalogueDesigns:
        """Copy of the designs with the weights of the readings in another adjustment of the same recording.

        `new_space` is the residual space of that adjustment. Its slightly different poses are neglected.
        """
        ratio = np.ones(new_space.n_equations, dtype=np.float32)
        is_used = new_space.is_used_reading
        ratio[: int(is_used.sum())] = (self.reading_sigmas / new_space.reading_sigmas)[is_used]
        groups = [group.with_rows_scaled(ratio) for group in self.groups]
        return replace(self, groups=groups, reading_sigmas=new_space.reading_sigmas)

    def screen(self, null_ensemble: NullEnsemble) -> tuple[Floats, Floats, CatalogueDesigns]:
        """Approximate log evidences (h,) of h effects, null values (families, trials), and designs with Gram matrices.

        The null values are log evidences in simulated recordings without effects (trials), averaged over the variants
        (places, shape parameters) of each catalogue effect (family). The first call computes the projected Gram
        matrices, which the returned designs contain for later calls. If the ensemble has the effects of a model, their
        part of the design columns is removed, which reduces the Gram matrices. Monte-Carlo estimates of Gram matrices
        are not reduced.
        """
        values = np.zeros(len(self.effects))
        family_sums = FamilyEvidenceSums.empty(self.family_indices, len(self.family_names), null_ensemble.n_trials)
        screened_groups = []
        for group in self.groups:
            grams = []
            for part in group.effect_ranges(null_ensemble.probe_vectors.shape[1]):
                scores = group.products_with_vectors(part, null_ensemble.probe_vectors)
                gram = group.projected_gram[part]
                if null_ensemble.is_first_screening:
                    gram = null_ensemble.projected_gram(scores, group.unprojected_gram[part])
                    grams.append(gram)
                score, trials, _ = null_ensemble.split_products(scores)
                if not null_ensemble.uses_monte_carlo_gram:
                    gram = gram - gram_of_rows(group.products_with_vectors(part, null_ensemble.model_basis))
                eigenvalues, eigenvectors = np.linalg.eigh(gram)
                eigenvalues, eigenvectors = np.maximum(eigenvalues, 0.0), np.swapaxes(eigenvectors, 1, 2)
                effect_indices = group.effect_indices[part]
                values[effect_indices] = log_evidence(np.einsum("hij,hj->hi", eigenvectors, score) ** 2, eigenvalues)
                if null_ensemble.n_trials:
                    family_sums = family_sums.with_effects(
                        effect_indices, simulated_log_evidence(eigenvectors @ trials, eigenvalues)
                    )
            screened_groups.append(replace(group, projected_gram=np.concatenate(grams)) if grams else group)
        return values, family_sums.log_mean_evidence_over_variants, replace(self, groups=screened_groups)

    def effects_grouped_by_family(self) -> list[list[Effect]]:
        """Variants (places, shape parameters) of each effect that a diagnosis tries.

        Most instrument constants are left out, because `calibrate` reports them. The range scale is included, because a
        network without a known length absorbs it completely.
        """
        families: list[list[Effect]] = [[] for _ in self.family_names]
        for family, effect in zip(self.family_indices.tolist(), self.effects, strict=True):
            assert isinstance(effect, Effect)
            families[family].append(effect)
        return [
            family
            for family in families
            if isinstance(family[0], RangeScale) or type(family[0]) not in ORDINARY_CALIBRATION_EFFECT_TYPES
        ]

    def local_optima(self, effect_indices: Ints, log_evidences: Floats) -> list[int]:
        """Indices of the variant (place, shape parameters) of an effect with the largest evidence, and of other optima.

        `effect_indices` are the indices of the variants, sorted by decreasing `log_evidences` (h,) of all h effects.
        """
        chosen = [int(effect_indices[0])]
        for i in effect_indices[1:MAX_COMPARED_PLACES_AND_SHAPES]:
            is_far_behind = log_evidences[i] < log_evidences[chosen[0]] - MAX_LOG_EVIDENCE_DEFICIT_FOR_EXACT_EVALUATION
            if is_far_behind or len(chosen) == MAX_LOCAL_OPTIMA_PER_CATALOGUE_EFFECT:
                break
            if all(are_distinct(self.effects[int(i)], self.effects[j]) for j in chosen):
                chosen.append(int(i))
        return chosen

    def log_evidence_by_family(self, log_evidences: Floats) -> Floats:
        """Log evidence (f, ...) of f catalogue effects, averaged over the variants of each effect.

        `log_evidences` (h, ...) are those of all h variants (places, shape parameters).
        """
        return (
            log_mean_exp_by_group(log_evidences, self.family_indices, len(self.family_names))
            if self.effects
            else log_evidences
        )


@dataclass(frozen=True)
class FamilyEvidenceSums:
    """Sums of the evidence over the variants of each catalogue effect, in simulated recordings.

    A variant has given stations, targets and shape parameters; the variants of one effect are a family.
    """

    family_indices: Ints
    """Index (h,) of the family (catalogue effect) to which each of h variants (places, shape parameters) belongs."""
    log_sums: Floats
    """Log (families, trials) of the summed evidence of the added variants of each effect, per simulated recording."""

    @classmethod
    def empty(cls, family_indices: Ints, n_families: int, n_trials: int) -> FamilyEvidenceSums:
        """Empty sums, before variants are added, for `n_families` effects in `n_trials` simulated recordings."""
        return cls(family_indices, np.full((n_families, n_trials), -np.inf))

    def with_effects(self, effect_indices: Ints, log_evidences: Floats) -> FamilyEvidenceSums:
        """Sums after the addition of b effects with indices `effect_indices` and `log_evidences` (b, trials)."""
        present, group = np.unique(self.family_indices[effect_indices], return_inverse=True)
        means = log_mean_exp_by_group(log_evidences, group, len(present))
        means += np.log(np.bincount(group))[:, None]
        log_sums = self.log_sums.copy()
        log_sums[present] = np.logaddexp(log_sums[present], means)
        return replace(self, log_sums=log_sums)

    @property
    def log_mean_evidence_over_variants(self) -> Floats:
        """Log (families, trials) of the mean evidence over all variants of each effect, per simulated recording."""
        return self.log_sums - np.log(np.bincount(self.family_indices, minlength=len(self.log_sums)))[:, None]


def _with_size_raised_to_noise(
    effect: CandidateEffect, design_columns: Floats, pointing_indices: Ints
) -> tuple[CandidateEffect, float]:
    """Effect whose plausible size is at least as large as the noise of the readings, and the factor on its size.

    The factor is 1 for effects of the air, whose size depends on the hall. `design_columns` (r, k) are whitened changes
    of r readings by the plausible sizes of k parameters, `pointing_indices` (r,) the pointings of the readings.
    """
    if (
        not isinstance(effect, Effect)
        or type(effect) in ORDINARY_CALIBRATION_EFFECT_TYPES
        or effect.light_path_stage == LightPathStage.AIR
    ):
        return effect, 1.0
    squares = np.bincount(
        pointing_indices, np.einsum("rq,rq->r", design_columns, design_columns) / design_columns.shape[1]
    )
    factor = size_factor_to_noise_level(np.sqrt(squares))
    return replace(effect, plausible_size_factor=factor) if factor > 1.0 else effect, factor


def _dense_designs(
    n_parameters: int, effect_indices: Sequence[int], transposed_designs: Floats32, row_indices: Ints
) -> EffectDesignGroup:
    """Group of h effects with k parameters and `transposed_designs` (h, k, r) for r equations `row_indices` (r,)."""
    products, weight = gram_of_rows(transposed_designs).astype(np.float64), np.ones(len(row_indices), dtype=np.float32)
    flattened = transposed_designs.reshape(-1, len(row_indices))
    return EffectDesignGroup(
        n_parameters, np.array(effect_indices), row_indices, flattened, weight, products, np.zeros_like(products)
    )


def _sparse_designs(
    n_parameters: int, indexed_designs: Sequence[tuple[int, Ints, Floats32]], n_rows: int
) -> EffectDesignGroup:
    """Group of effects with k parameters each that change only a few of the `n_rows` observation equations.

    `indexed_designs` has the index, the r nonzero rows and the transposed design (k, r) of each effect.
    """
    products = np.stack([gram_of_rows(transposed_designs) for _, _, transposed_designs in indexed_designs]).astype(
        np.float64
    )
    indices = np.concatenate([np.tile(row_indices, n_parameters) for _, row_indices, _ in indexed_designs])
    ends = np.cumsum(
        [0, *(len(row_indices) for _, row_indices, _ in indexed_designs for _ in range(n_parameters))]
    ).astype(np.int32)
    nonzero_values = np.concatenate([transposed_designs.ravel() for _, _, transposed_designs in indexed_designs])
    transposed_designs = sp.csr_array((nonzero_values, indices, ends), (len(indexed_designs) * n_parameters, n_rows))
    weight, effect_indices = np.ones(n_rows, dtype=np.float32), np.array([i for i, _, _ in indexed_designs])
    return EffectDesignGroup(
        n_parameters, effect_indices, slice(None), transposed_designs, weight, products, np.zeros_like(products)
    )
