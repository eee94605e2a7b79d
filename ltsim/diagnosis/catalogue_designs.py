"""Design matrices of the effects of the catalogue as hypotheses, at every possible place and shape.

They are scored with the same vectors of the null ensemble and the same log evidence as the empirical laws. Shapes
below: h effects with k parameters each, m rows of the residual space, v vectors of the null ensemble.
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
from ltsim.core.arrays import Floats, Ints, Singles, batches, stack_and_release
from ltsim.diagnosis.evidence import log_means_by_group, noise_level_factor, simulated_log_evidence
from ltsim.diagnosis.hypotheses import Hypothesis
from ltsim.diagnosis.null_ensemble import NullEnsemble, row_gram
from ltsim.diagnosis.prior import log_prior_by_base_rate
from ltsim.physics.effects import CATALOGUE, MISALIGNMENT_EFFECTS
from ltsim.physics.effects.effect import Effect, LightPathStage, NoiseEffect
from ltsim.physics.effects.linear_effect import CandidateEffect
from ltsim.physics.effects.range_scale import RangeScale
from ltsim.physics.laws.places import instrument_places
from ltsim.recordings.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings

MAX_SPARSE_FRACTION = 0.15
"""Fraction of nonzero rows below which a design matrix is stored as sparse. It affects only the computing time."""


ORDINARY_CALIBRATION_TYPES = {type(effect) for effect in MISALIGNMENT_EFFECTS}
"""Effects of the ordinary calibration, whose constants every adjustment estimates. As a hypothesis, such an effect
means that its constants are larger than their prior permits."""


def catalogue_hypotheses(sightings: Sightings, instruments: Sequence[str] = ()) -> list[CandidateEffect]:
    """Effects of the catalogue at every place and shape, and constants of each instrument if there are several.

    `instruments` are the names of the instruments. Changes of the noise are not included.
    """
    trackers = instrument_places(sightings, instruments)
    constants = [
        kind(stations=place.stations) for kind in CATALOGUE if kind in ORDINARY_CALIBRATION_TYPES for place in trackers
    ]
    kinds = [kind for kind in CATALOGUE if not issubclass(kind, NoiseEffect)]
    return [*constants, *(e for kind in kinds for e in kind.candidates(sightings))]


@dataclass(frozen=True)
class EffectGroup:
    """Group of h effects with the same number k of parameters, whose design columns are stored in one matrix.

    The matrix is sparse, or dense on the r rows of the residual space that the effects change.
    """

    n_parameters: int
    """Number k of parameters of each effect."""
    effect_indices: Ints
    """Indices (h,) of the effects."""
    row_indices: Ints | slice
    """Indices (r,) of the rows of the residual space."""
    design_rows: Singles | sp.csr_array
    """Transposed design columns (h k, r) in units of plausible sizes, one row per parameter."""
    row_weights: Singles
    """Factors (r,) by which the design rows are multiplied, for an adjustment with other weights."""
    unscaled_gram: Floats
    """Gram matrices (h, k, k) of the weighted design columns."""
    gram: Floats
    """Gram matrices (h, k, k) of the projected design columns, computed with the empty model."""

    def parts(self, n_vectors: int) -> Iterator[slice]:
        """Ranges of members whose products with `n_vectors` vectors are in memory at a time."""
        return batches(len(self.effect_indices), self.n_parameters * n_vectors)

    def weighted_products(self, member_range: slice, vectors: Floats | Singles) -> Floats:
        """Products (h, k, v) of the weighted design columns of a range of h members with `vectors` (m, v)."""
        design_rows, count = (
            self.design_rows[member_range.start * self.n_parameters : member_range.stop * self.n_parameters],
            vectors.shape[1],
        )
        products = np.empty((design_rows.shape[0], count))
        for part in batches(count, len(self.row_weights)):
            products[:, part] = design_rows @ np.multiply(
                vectors[self.row_indices, part], self.row_weights[:, None], dtype=np.float32
            )
        return products.reshape(member_range.stop - member_range.start, self.n_parameters, count)

    def scaled_rows(self, ratio: Singles) -> EffectGroup:
        """Copy of the group for a residual space with other weights, which multiply its rows by `ratio` (m,)."""
        weight = self.row_weights * ratio[self.row_indices]
        if isinstance(self.design_rows, np.ndarray):
            parts = (
                self.design_rows[p.start * self.n_parameters : p.stop * self.n_parameters] * weight
                for p in self.parts(len(weight))
            )
            products = np.concatenate(
                [row_gram(design_rows.reshape(-1, self.n_parameters, len(weight))) for design_rows in parts]
            )
        else:
            data = self.design_rows.data * weight[self.design_rows.indices]
            ends = self.design_rows.indptr[:: self.n_parameters].tolist()
            products = np.stack(
                [row_gram(data[low:high].reshape(self.n_parameters, -1)) for low, high in pairwise(ends)]
            )
        return replace(
            self, row_weights=weight, unscaled_gram=products.astype(np.float64), gram=np.zeros_like(self.gram)
        )


@dataclass(frozen=True)
class CatalogueDesigns:
    """Effects of the catalogue with their design columns in units of plausible sizes.

    A family contains the same effect at all its places and shapes.
    """

    effects: list[CandidateEffect]
    """Effects that change a reading of the recording, h of them."""
    groups: list[EffectGroup]
    """Effects with their design columns, grouped by their number of parameters and their form of storage."""
    families: tuple[str, ...]
    """Names of the families, each of which has one effect of the catalogue at all its places and shapes."""
    family_of_effect: Ints
    """Index (h,) of the family of each effect."""

    @cached_property
    def log_family_prior(self) -> Floats:
        """Log prior (families,) of each effect of the catalogue, for all its places and shapes together."""
        return log_prior_by_base_rate("named", self.families)

    def log_prior_of(self, name: str) -> float:
        """Log prior of the effect of the catalogue with a name, for all its places and shapes together.

        The search of a large recording does not try single wrong readings; their prior is nevertheless defined.
        """
        names = self.families if name in self.families else (*self.families, name)
        return float(log_prior_by_base_rate("named", names)[names.index(name)])

    def hypotheses_of(self, effects: Sequence[CandidateEffect]) -> tuple[Hypothesis, ...]:
        """Hypotheses of effects of the catalogue; effects that are not possible in the recording are left out."""
        n_places = np.bincount(self.family_of_effect, minlength=len(self.families))
        prior = dict(zip(self.families, self.log_family_prior - np.log(n_places), strict=True))
        return tuple(Hypothesis(e, float(prior[e.name]), 0.0, e.name) for e in effects if e.name in prior)

    @classmethod
    def from_space(cls, space: ResidualSpace, effects: Sequence[CandidateEffect]) -> CatalogueDesigns:
        """Design matrices of all effects that change a reading of this recording."""
        touching: list[CandidateEffect] = []
        sparse_designs: dict[int, list[tuple[int, Ints, Singles]]] = {}
        dense_designs: dict[tuple[int, tuple[bool, ...]], tuple[list[int], list[Singles]]] = {}
        used_indices = np.nonzero(space.is_used_reading)
        other = np.ones(
            space.n_rows - len(used_indices[0]), dtype=np.int64
        )  # rows of no reading: one more pointing, and kind
        pointing, kind = (
            np.append(of, n * other) for of, n in zip(used_indices, space.is_used_reading.shape, strict=True)
        )
        for effect in effects:
            design_columns = space.whitened_design(effect)
            row_indices = np.flatnonzero(np.logical_or.reduce(np.not_equal(design_columns.T, 0.0, order="C")))
            if not len(row_indices):
                continue
            touched = np.bincount(kind[row_indices], minlength=len(OBSERVABLES) + 1) > 0
            is_sparse = len(row_indices) < MAX_SPARSE_FRACTION * space.n_rows
            stored = row_indices if is_sparse else np.flatnonzero(touched[kind])
            design_columns = design_columns[stored]
            design_columns *= effect.size_scales
            effect, coarser = _scaled_to_noise(effect, design_columns, pointing[stored])
            design_rows = np.ascontiguousarray(design_columns.T * coarser, dtype=np.float32)
            if is_sparse:
                sparse_designs.setdefault(len(design_rows), []).append(
                    (len(touching), stored.astype(np.int32), design_rows)
                )
            else:
                effect_indices, made = dense_designs.setdefault((len(design_rows), tuple(touched.tolist())), ([], []))
                effect_indices.append(len(touching))
                made.append(design_rows)
            touching.append(effect)
        effect_groups = [
            _sparse_group(n_parameters, sparse_designs.pop(n_parameters), space.n_rows)
            for n_parameters in sorted(sparse_designs)
        ]
        effect_groups += [
            _dense_group(n_parameters, effect_indices, stack_and_release(made), np.flatnonzero(np.array(kinds)[kind]))
            for (n_parameters, kinds), (effect_indices, made) in sorted(dense_designs.items())
        ]
        names = tuple(dict.fromkeys(effect.name for effect in touching))
        index = {name: i for i, name in enumerate(names)}
        return cls(touching, effect_groups, names, np.array([index[e.name] for e in touching], dtype=np.int64))

    def with_weights_of(self, old_space: ResidualSpace, new_space: ResidualSpace) -> CatalogueDesigns:
        """Design matrices with the weights of another adjustment of the same readings.

        The geometry is not updated, because other weights move a network by far less than its lengths.
        """
        ratio = np.ones(new_space.n_rows, dtype=np.float32)
        ratio[: int(new_space.is_used_reading.sum())] = (old_space.sigma / new_space.sigma)[new_space.is_used_reading]
        return replace(self, groups=[group.scaled_rows(ratio) for group in self.groups])

    def log_evidence_and_trials(self, null_ensemble: NullEnsemble) -> tuple[Floats, Floats]:
        """Log evidence (h,) of each effect given a model, and null values (families, trials) of each catalogue effect.

        The null values are log means of the evidence for simulated recordings. The design columns are projected also
        onto the residual space of the model, which reduces their Gram matrices. A Monte-Carlo Gram matrix is not
        reduced, because the difference of an estimate and an exact value may vanish.
        """
        values, chance = (
            np.zeros(len(self.effects)),
            FamilyMeans.without_effects(self.family_of_effect, len(self.families), null_ensemble.n_trials),
        )
        for group in self.groups:
            for part in group.parts(null_ensemble.probe_vectors.shape[1]):
                scores = group.weighted_products(part, null_ensemble.probe_vectors)
                if null_ensemble.is_first_pass:
                    group.gram[part] = null_ensemble.projected_gram(scores, group.unscaled_gram[part])
                score, trials, _ = null_ensemble.split_products(scores)
                gram = group.gram[part]
                if not null_ensemble.gram_is_monte_carlo:
                    gram = gram - row_gram(group.weighted_products(part, null_ensemble.model_basis))
                strength, turn = np.linalg.eigh(gram)
                strength, turn = np.maximum(strength, 0.0), np.swapaxes(turn, 1, 2)
                effect_indices = group.effect_indices[part]
                values[effect_indices] = log_evidence(np.einsum("hij,hj->hi", turn, score) ** 2, strength)
                if null_ensemble.n_trials:
                    chance.add(effect_indices, simulated_log_evidence(turn @ trials, strength))
        return values, chance.log_means

    def effects_by_family(self) -> list[list[Effect]]:
        """Effects by catalogue name at all places and shapes, with only the range scale of the ordinary constants.

        A network without a known length absorbs the scale completely. `calibrate` reports the other constants.
        """
        families: list[list[Effect]] = [[] for _ in self.families]
        for family, effect in zip(self.family_of_effect.tolist(), self.effects, strict=True):
            assert isinstance(effect, Effect)
            families[family].append(effect)
        return [
            family
            for family in families
            if isinstance(family[0], RangeScale) or type(family[0]) not in ORDINARY_CALIBRATION_TYPES
        ]

    def family_evidence(self, values: Floats) -> Floats:
        """Log evidence (f, ...) of f kinds of effect, each averaged over the places and shape constants of the kind.

        `values` (h, ...) are the log evidences of all h effects.
        """
        return log_means_by_group(values, self.family_of_effect, len(self.families)) if self.effects else values


@dataclass(frozen=True)
class FamilyMeans:
    """Log means of the evidence of each catalogue effect over its places and shapes, in simulated recordings."""

    family: Ints
    """Index (h,) of the family of each effect."""
    sums: Floats
    """Logs (families, trials) of the summed evidence of the effects that were added."""

    @classmethod
    def without_effects(cls, family: Ints, n_families: int, n_trials: int) -> FamilyMeans:
        """Means before any effect is added."""
        return cls(family, np.full((n_families, n_trials), -np.inf))

    def add(self, effect_indices: Ints, values: Floats) -> None:
        """Addition of the log evidence `values` (b, trials) of the b effects with the indices `effect_indices`."""
        present, group = np.unique(self.family[effect_indices], return_inverse=True)
        means = log_means_by_group(values, group, len(present))
        means += np.log(np.bincount(group))[:, None]
        self.sums[present] = np.logaddexp(self.sums[present], means)

    @property
    def log_means(self) -> Floats:
        """Log mean (families, trials) of the evidence over all places and shapes of each catalogue effect (family)."""
        return self.sums - np.log(np.bincount(self.family, minlength=len(self.sums)))[:, None]


def _scaled_to_noise(effect: CandidateEffect, design_columns: Floats, pointing: Ints) -> tuple[CandidateEffect, float]:
    """Effect whose plausible size is at least as large as the noise of the readings, and the factor on its size.

    The factor is 1 for effects of the air, whose size depends on the hall and not on the instrument. `design_columns`
    (r, k) are the whitened changes by the plausible sizes on r nonzero rows, and `pointing` (r,) the pointing of each
    row.
    """
    if (
        not isinstance(effect, Effect)
        or type(effect) in ORDINARY_CALIBRATION_TYPES
        or effect.stage == LightPathStage.AIR
    ):
        return effect, 1.0
    squares = np.bincount(pointing, np.einsum("rq,rq->r", design_columns, design_columns) / design_columns.shape[1])
    factor = noise_level_factor(np.sqrt(squares))
    return replace(effect, size_factor=factor) if factor > 1.0 else effect, factor


def _dense_group(
    n_parameters: int, effect_indices: Sequence[int], design_rows: Singles, row_indices: Ints
) -> EffectGroup:
    """Group of h effects with k parameters each, from `design_rows` (h, k, r) on the rows `row_indices` (r,)."""
    products, weight = row_gram(design_rows).astype(np.float64), np.ones(len(row_indices), dtype=np.float32)
    flattened = design_rows.reshape(-1, len(row_indices))
    return EffectGroup(
        n_parameters, np.array(effect_indices), row_indices, flattened, weight, products, np.zeros_like(products)
    )


def _sparse_group(n_parameters: int, designs: Sequence[tuple[int, Ints, Singles]], n_rows: int) -> EffectGroup:
    """Group of effects with k parameters each, from each effect's index, nonzero rows and transposed design (k, r).

    Each effect changes only a few of `n_rows` rows of the residual space.
    """
    products = np.stack([row_gram(design_rows) for _, _, design_rows in designs]).astype(np.float64)
    indices = np.concatenate([np.tile(row_indices, n_parameters) for _, row_indices, _ in designs])
    ends = np.cumsum([0, *(len(row_indices) for _, row_indices, _ in designs for _ in range(n_parameters))]).astype(
        np.int32
    )
    nonzero_values = np.concatenate([design_rows.ravel() for _, _, design_rows in designs])
    design_rows = sp.csr_array((nonzero_values, indices, ends), (len(designs) * n_parameters, n_rows))
    weight, effect_indices = np.ones(n_rows, dtype=np.float32), np.array([i for i, _, _ in designs])
    return EffectGroup(
        n_parameters, effect_indices, slice(None), design_rows, weight, products, np.zeros_like(products)
    )
