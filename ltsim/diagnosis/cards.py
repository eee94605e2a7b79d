"""Cards: the effects of the catalogue as hypotheses, each at every place and shape that its card offers.

Cards with a geometry of their own (a window, a plume, a layer) bring their own signature; all are scored with the same
vectors and the same evidence as the space of carriers and drivers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy.sparse as sp

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.evidence import log_evidence
from ltsim.core.arrays import Floats, Ints, Singles
from ltsim.diagnosis.evidence import log_means, simulated_evidence, times_to_noise
from ltsim.diagnosis.probe import Probe, square
from ltsim.physics.effects import BASELINE, CATALOGUE
from ltsim.physics.effects.effect import Effect, NoiseEffect, Stage
from ltsim.physics.effects.signature import Tunable
from ltsim.physics.laws.places import trackers_of
from ltsim.recordings.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings

SPARSE = 0.15
"""Share of nonzeros below which the signature of an effect is kept sparse."""


ORDINARY = {type(effect) for effect in BASELINE}
"""Constants of the ordinary calibration: what they are is estimated anyhow, that they are beyond their prior is not."""


def card_hypotheses(sightings: Sightings, instruments: Sequence[str] = ()) -> list[Tunable]:
    """Every effect of the catalogue, at every place and shape; constants of each of several `instruments` too."""
    trackers = trackers_of(sightings, instruments)
    own = [kind(stations=place.stations) for kind in CATALOGUE if kind in ORDINARY for place in trackers]
    kinds = [kind for kind in CATALOGUE if not issubclass(kind, NoiseEffect)]
    return [*own, *(e for kind in kinds for e in kind.candidates(sightings))]


@dataclass(frozen=True)
class Group:
    """Effects of one number of parameters k, all kept sparse, or all dense on the rows that they may touch.

    `members` (h,), `places` (r,) of the rows, scaled signatures as rows (h k, r), their products with each other
    (h, k, k), and those of what the adjustment leaves of them, filled when they are scored first.
    """

    size: int
    members: Ints
    places: Ints | slice
    rows: Singles | sp.csr_array
    own: Floats
    gram: Floats

    def products(self, vectors: Floats | Singles) -> Floats:
        """Products (h, k, v) with vectors (m, v)."""
        found = np.asarray(self.rows @ vectors[self.places].astype(np.float32, copy=False)).astype(np.float64)
        return found.reshape(len(self.members), self.size, -1)

    def scaled(self, ratio: Singles) -> Group:
        """The same with the rows of the space times a `ratio` (m,)."""
        rows: Singles | sp.csr_array
        if isinstance(self.rows, np.ndarray):
            rows = self.rows * ratio[self.places]
            own = square(rows.reshape(len(self.members), self.size, -1))
        else:
            data = self.rows.data * ratio[self.rows.indices]
            rows = sp.csr_array((data, self.rows.indices, self.rows.indptr), self.rows.shape)
            ends = self.rows.indptr[:: self.size].tolist()
            own = np.stack([square(data[low:high].reshape(self.size, -1)) for low, high in pairwise(ends)])
        return replace(self, rows=rows, own=own.astype(np.float64), gram=np.zeros_like(self.gram))


@dataclass(frozen=True)
class Cards:
    """Cards with their signatures in units of plausible sizes.

    Attributes
    ----------
    effects : list of Tunable
        Those that touch a reading.
    groups : list of Group
    families : tuple of str
    family : (h,) int
    """

    effects: list[Tunable]
    groups: list[Group]
    families: tuple[str, ...]
    family: Ints

    @classmethod
    def of(cls, space: ResidualSpace, effects: Sequence[Tunable]) -> Cards:
        """Signatures of all effects that touch a reading of this recording."""
        kept: list[Tunable] = []
        alike: dict[tuple[int, tuple[bool, ...]], list[tuple[int, Ints, Singles]]] = {}
        read = np.nonzero(space.use)
        other = np.ones(space.size - len(read[0]), dtype=np.int64)  # rows of no reading: one more pointing, and kind
        pointing, kind = (np.append(of, n * other) for of, n in zip(read, space.use.shape, strict=True))
        for effect in effects:
            signature = space.signature(effect)
            places = np.flatnonzero(np.logical_or.reduce(np.not_equal(signature.T, 0.0, order="C")))
            if len(places):
                signature = signature[places]
                effect = _felt(effect, signature, pointing[places])
                sizes = effect.spread
                rows = np.ascontiguousarray((signature * sizes).T, dtype=np.float32)
                sparse = len(places) < SPARSE * space.size
                touched = () if sparse else tuple(np.bincount(kind[places], minlength=len(OBSERVABLES) + 1) > 0)
                alike.setdefault((len(sizes), touched), []).append((len(kept), places, rows))
                kept.append(effect)
        groups = [
            _sparse(size, made, space.size)
            if not touched
            else _dense(size, made, np.flatnonzero(np.array(touched)[kind]))
            for (size, touched), made in sorted(alike.items(), key=lambda item: item[0])
        ]
        names = tuple(dict.fromkeys(effect.name for effect in kept))
        index = {name: i for i, name in enumerate(names)}
        return cls(kept, groups, names, np.array([index[e.name] for e in kept], dtype=np.int64))

    def reweighted(self, before: ResidualSpace, after: ResidualSpace) -> Cards:
        """The same signatures with the weights of another adjustment of the same readings.

        The geometry stays as it was: adjusted again with other weights, a network moves by far less than its lengths.
        """
        ratio = np.ones(after.size, dtype=np.float32)
        ratio[: int(after.use.sum())] = (before.sigma / after.sigma)[after.use]
        return replace(self, groups=[group.scaled(ratio) for group in self.groups])

    def score(self, probe: Probe) -> tuple[Floats, Floats]:
        """Log evidence (h,) of each card, and of the trials by family (families, trials).

        What the adjustment leaves of a card is less beside what was found. Where it is only sampled, it is taken to be
        what it was, as for laws: the difference of a rough number and an exact one may be next to nothing, and a score
        over nothing looks like any evidence.
        """
        values, chance = np.zeros(len(self.effects)), np.zeros((len(self.effects), probe.trials.shape[1]))
        for group in self.groups:
            scores = group.products(probe.vectors)
            if probe.fresh:
                group.gram[:] = probe.gram(scores, group.own)
            score, trials, _ = probe.split(scores)
            gram = group.gram if probe.sampled else group.gram - square(group.products(probe.extension))
            strength, turn = np.linalg.eigh(gram)
            strength, turn = np.maximum(strength, 0.0), np.swapaxes(turn, 1, 2)
            values[group.members] = log_evidence(np.einsum("hij,hj->hi", turn, score) ** 2, strength)
            if probe.trials.shape[1]:
                chance[group.members] = simulated_evidence(turn @ trials, strength)
        return values, self.family_evidence(chance)

    def by_family(self) -> list[list[Effect]]:
        """Effects of each family, constants of the ordinary calibration apart."""
        found: list[list[Effect]] = [[] for _ in self.families]
        for family, effect in zip(self.family.tolist(), self.effects, strict=True):
            assert isinstance(effect, Effect)
            found[family].append(effect)
        return [family for family in found if type(family[0]) not in ORDINARY]

    def family_evidence(self, values: Floats) -> Floats:
        """Log evidence (families, ...) with places and shapes averaged, of that of each card (h, ...)."""
        return log_means(values, self.family, len(self.families)) if self.effects else values


def _felt(effect: Tunable, signature: Floats, pointing: Ints) -> Tunable:
    """A card with a plausible size that at least reaches the noise, as carriers have; air is the same for all.

    By the rows of its whitened signature (r, q) that are not zero, and the pointing (r,) of each.
    """
    if not isinstance(effect, Effect) or type(effect) in ORDINARY or effect.stage == Stage.AIR:
        return effect
    squares = np.bincount(pointing, np.mean((signature * effect.spread) ** 2, axis=1))
    return replace(effect, coarse=times_to_noise(np.sqrt(squares)))


def _dense(size: int, made: Sequence[tuple[int, Ints, Singles]], places: Ints) -> Group:
    """Signatures of effects of one size on some rows."""
    dense = np.zeros((len(made), size, len(places)), dtype=np.float32)
    for filled, (_, touched, rows) in zip(dense, made, strict=True):
        filled[:, np.searchsorted(places, touched)] = rows
    own = square(dense).astype(np.float64)
    return Group(
        size, np.array([i for i, _, _ in made]), places, dense.reshape(-1, len(places)), own, np.zeros_like(own)
    )


def _sparse(size: int, made: Sequence[tuple[int, Ints, Singles]], length: int) -> Group:
    """Signatures of effects of one size, each on few of `length` rows."""
    own = np.stack([square(rows) for _, _, rows in made]).astype(np.float64)
    indices = np.concatenate([np.tile(places, size) for _, places, _ in made])
    ends = np.cumsum([0, *(len(places) for _, places, _ in made for _ in range(size))])
    data = np.concatenate([rows.ravel() for _, _, rows in made])
    rows = sp.csr_array((data, indices, ends), (len(made) * size, length))
    return Group(size, np.array([i for i, _, _ in made]), slice(None), rows, own, np.zeros_like(own))
