"""Signatures of the catalogue effects as hypotheses, at every possible place and shape.

All are scored with the same vectors and the same evidence as the empirical laws.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy.sparse as sp

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.evidence import log_evidence
from ltsim.core.arrays import Floats, Ints, Singles, batches, stack_and_release
from ltsim.diagnosis.evidence import log_means_by_group, noise_level_factor, simulated_log_evidence
from ltsim.diagnosis.null_ensemble import NullEnsemble, row_gram
from ltsim.physics.effects import BASELINE_EFFECTS, CATALOGUE
from ltsim.physics.effects.effect import Effect, LightPathStage, NoiseEffect
from ltsim.physics.effects.range_scale import RangeScale
from ltsim.physics.effects.signature import CandidateEffect
from ltsim.physics.laws.places import instrument_places
from ltsim.recordings.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings

MAX_SPARSE_FRACTION = 0.15
"""Fraction of nonzeros below which a signature is stored as a sparse matrix (speed only)."""


ORDINARY_CALIBRATION_TYPES = {type(effect) for effect in BASELINE_EFFECTS}
"""Effects of the ordinary calibration, which are always estimated; as hypotheses they mean a value
beyond their prior.
"""


def catalogue_hypotheses(sightings: Sightings, instruments: Sequence[str] = ()) -> list[CandidateEffect]:
    """Every effect of the catalogue, at every place and shape; constants of each of several `instruments` too."""
    trackers = instrument_places(sightings, instruments)
    constants = [
        kind(stations=place.stations) for kind in CATALOGUE if kind in ORDINARY_CALIBRATION_TYPES for place in trackers
    ]
    kinds = [kind for kind in CATALOGUE if not issubclass(kind, NoiseEffect)]
    return [*constants, *(e for kind in kinds for e in kind.candidates(sightings))]


@dataclass(frozen=True)
class SignatureGroup:
    """Group of effects with equal numbers k of parameters, all stored sparse, or all dense on their rows.

    It has `members` (h,), indices `places` (r,) of the rows, scaled signatures as rows (h k, r), the `row_weights` (r,)
    of each row, Gram matrices (h, k, k) of the weighted signatures, and those of their projections, computed in the
    first
    pass.
    """

    size: int
    members: Ints
    places: Ints | slice
    rows: Singles | sp.csr_array
    row_weights: Singles
    unscaled_gram: Floats
    gram: Floats

    def parts(self, vectors: int) -> Iterator[slice]:
        """Parts of the members whose products with a number of vectors are in memory at a time."""
        return batches(len(self.members), self.size * vectors)

    def weighted_products(self, members: slice, vectors: Floats | Singles) -> Floats:
        """Products (h, k, v) of some weighted signatures with vectors (m, v)."""
        rows, count = self.rows[members.start * self.size : members.stop * self.size], vectors.shape[1]
        products = np.empty((rows.shape[0], count))
        for part in batches(count, len(self.row_weights)):
            products[:, part] = rows @ np.multiply(
                vectors[self.places, part], self.row_weights[:, None], dtype=np.float32
            )
        return products.reshape(members.stop - members.start, self.size, count)

    def scaled_rows(self, ratio: Singles) -> SignatureGroup:
        """Group for rows of the space multiplied by a `ratio` (m,)."""
        weight = self.row_weights * ratio[self.places]
        if isinstance(self.rows, np.ndarray):
            parts = (self.rows[p.start * self.size : p.stop * self.size] * weight for p in self.parts(len(weight)))
            products = np.concatenate([row_gram(rows.reshape(-1, self.size, len(weight))) for rows in parts])
        else:
            data = self.rows.data * weight[self.rows.indices]
            ends = self.rows.indptr[:: self.size].tolist()
            products = np.stack([row_gram(data[low:high].reshape(self.size, -1)) for low, high in pairwise(ends)])
        return replace(
            self, row_weights=weight, unscaled_gram=products.astype(np.float64), gram=np.zeros_like(self.gram)
        )


@dataclass(frozen=True)
class CatalogueSignatures:
    """Catalogue effects with their signatures in units of plausible sizes.

    Attributes
    ----------
    effects : list of CandidateEffect
        Effects that change a reading.
    groups : list of SignatureGroup
    families : tuple of str
    family_of_effect : (h,) int
        Index of the family of each effect.
    """

    effects: list[CandidateEffect]
    groups: list[SignatureGroup]
    families: tuple[str, ...]
    family_of_effect: Ints

    @classmethod
    def from_space(cls, space: ResidualSpace, effects: Sequence[CandidateEffect]) -> CatalogueSignatures:
        """Signatures of all effects that change a reading of this recording."""
        touching: list[CandidateEffect] = []
        sparse_signatures: dict[int, list[tuple[int, Ints, Singles]]] = {}
        dense_signatures: dict[tuple[int, tuple[bool, ...]], tuple[list[int], list[Singles]]] = {}
        read = np.nonzero(space.used_readings)
        other = np.ones(space.n_rows - len(read[0]), dtype=np.int64)  # rows of no reading: one more pointing, and kind
        pointing, kind = (np.append(of, n * other) for of, n in zip(read, space.used_readings.shape, strict=True))
        for effect in effects:
            signature = space.whitened_signature(effect)
            places = np.flatnonzero(np.logical_or.reduce(np.not_equal(signature.T, 0.0, order="C")))
            if not len(places):
                continue
            touched = np.bincount(kind[places], minlength=len(OBSERVABLES) + 1) > 0
            is_sparse = len(places) < MAX_SPARSE_FRACTION * space.n_rows
            stored = places if is_sparse else np.flatnonzero(touched[kind])
            signature = signature[stored]
            signature *= effect.size_scales
            effect, coarser = _scaled_to_noise(effect, signature, pointing[stored])
            rows = np.ascontiguousarray(signature.T * coarser, dtype=np.float32)
            if is_sparse:
                sparse_signatures.setdefault(len(rows), []).append((len(touching), stored.astype(np.int32), rows))
            else:
                members, made = dense_signatures.setdefault((len(rows), tuple(touched.tolist())), ([], []))
                members.append(len(touching))
                made.append(rows)
            touching.append(effect)
        groups = [_sparse_group(size, sparse_signatures.pop(size), space.n_rows) for size in sorted(sparse_signatures)]
        groups += [
            _dense_group(size, members, stack_and_release(made), np.flatnonzero(np.array(kinds)[kind]))
            for (size, kinds), (members, made) in sorted(dense_signatures.items())
        ]
        names = tuple(dict.fromkeys(effect.name for effect in touching))
        index = {name: i for i, name in enumerate(names)}
        return cls(touching, groups, names, np.array([index[e.name] for e in touching], dtype=np.int64))

    def with_weights_of(self, old_space: ResidualSpace, new_space: ResidualSpace) -> CatalogueSignatures:
        """Signatures with the weights of another adjustment of the same readings.

        The geometry is not updated, because other weights move a network by far less than its lengths.
        """
        ratio = np.ones(new_space.n_rows, dtype=np.float32)
        ratio[: int(new_space.used_readings.sum())] = (old_space.sigma / new_space.sigma)[new_space.used_readings]
        return replace(self, groups=[group.scaled_rows(ratio) for group in self.groups])

    def log_evidence_and_trials(self, probe: NullEnsemble) -> tuple[Floats, Floats]:
        """Log evidence (h,) of each effect given the model, and of the trials by family (families, trials).

        The model reduces the Gram matrix of a projected signature. A Monte-Carlo Gram matrix is not reduced, because
        the difference of an estimate and an exact value may vanish.
        """
        values, chance = (
            np.zeros(len(self.effects)),
            FamilyMeans.without_effects(self.family_of_effect, len(self.families), probe.n_trials),
        )
        for group in self.groups:
            for part in group.parts(probe.probe_vectors.shape[1]):
                scores = group.weighted_products(part, probe.probe_vectors)
                if probe.is_first_pass:
                    group.gram[part] = probe.projected_gram(scores, group.unscaled_gram[part])
                score, trials, _ = probe.split_products(scores)
                gram = group.gram[part]
                if not probe.gram_is_monte_carlo:
                    gram = gram - row_gram(group.weighted_products(part, probe.model_basis))
                strength, turn = np.linalg.eigh(gram)
                strength, turn = np.maximum(strength, 0.0), np.swapaxes(turn, 1, 2)
                members = group.members[part]
                values[members] = log_evidence(np.einsum("hij,hj->hi", turn, score) ** 2, strength)
                if probe.n_trials:
                    chance.add(members, simulated_log_evidence(turn @ trials, strength))
        return values, chance.log_means

    def effects_by_family(self) -> list[list[Effect]]:
        """Effects of each family, without the constants of the ordinary calibration other than the scale.

        A network without a known length absorbs the scale completely, and `calibrate` gives the other constants.
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
        """Log evidence (families, ...) with places and shapes averaged, from that of each effect (h, ...)."""
        return log_means_by_group(values, self.family_of_effect, len(self.families)) if self.effects else values


@dataclass(frozen=True)
class FamilyMeans:
    """Log means of the evidence of each family in each trial, from batches of its members.

    `family` (h,) is that of each effect, `sums` (families, trials) are log sums so far.
    """

    family: Ints
    sums: Floats

    @classmethod
    def without_effects(cls, family: Ints, n_columns: int, trials: int) -> FamilyMeans:
        """Means of no effect yet."""
        return cls(family, np.full((n_columns, trials), -np.inf))

    def add(self, members: Ints, values: Floats) -> None:
        """Addition of the log evidence (k, trials) of some effects (k,)."""
        present, group = np.unique(self.family[members], return_inverse=True)
        means = log_means_by_group(values, group, len(present))
        means += np.log(np.bincount(group))[:, None]
        self.sums[present] = np.logaddexp(self.sums[present], means)

    @property
    def log_means(self) -> Floats:
        """Log mean (families, trials) over the members of each family."""
        return self.sums - np.log(np.bincount(self.family, minlength=len(self.sums)))[:, None]


def _scaled_to_noise(effect: CandidateEffect, signature: Floats, pointing: Ints) -> tuple[CandidateEffect, float]:
    """Effect whose plausible size is at least as large as the noise of the readings, and the factor on its size.

    The factor is 1 for effects of the air, which belong to the hall. The arguments are the nonzero rows (r, q) of the
    whitened signature of plausible size, and the pointing (r,) of each.
    """
    if (
        not isinstance(effect, Effect)
        or type(effect) in ORDINARY_CALIBRATION_TYPES
        or effect.stage == LightPathStage.AIR
    ):
        return effect, 1.0
    squares = np.bincount(pointing, np.einsum("rq,rq->r", signature, signature) / signature.shape[1])
    factor = noise_level_factor(np.sqrt(squares))
    return replace(effect, size_factor=factor) if factor > 1.0 else effect, factor


def _dense_group(size: int, members: Sequence[int], rows: Singles, places: Ints) -> SignatureGroup:
    """Group of effects with equal numbers of parameters, from `rows` (h, size, r), dense on the rows `places` (r,)."""
    products, weight = row_gram(rows).astype(np.float64), np.ones(len(places), dtype=np.float32)
    flattened = rows.reshape(-1, len(places))
    return SignatureGroup(size, np.array(members), places, flattened, weight, products, np.zeros_like(products))


def _sparse_group(size: int, signatures: Sequence[tuple[int, Ints, Singles]], length: int) -> SignatureGroup:
    """Group of effects with equal numbers of parameters, each on few of `length` rows."""
    products = np.stack([row_gram(rows) for _, _, rows in signatures]).astype(np.float64)
    indices = np.concatenate([np.tile(places, size) for _, places, _ in signatures])
    ends = np.cumsum([0, *(len(places) for _, places, _ in signatures for _ in range(size))]).astype(np.int32)
    data = np.concatenate([rows.ravel() for _, _, rows in signatures])
    rows = sp.csr_array((data, indices, ends), (len(signatures) * size, length))
    weight, members = np.ones(length, dtype=np.float32), np.array([i for i, _, _ in signatures])
    return SignatureGroup(size, members, slice(None), rows, weight, products, np.zeros_like(products))
