"""Random values of a trial and their distributions: one sampler for recordings and campaigns.

A draw is keyed by the seed, what it is for, and the number of its trial. Adding an effect, a station's twin, a method
or a worker changes no other draw.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import SetupError
from ltsim.core.randomness import trials_normal
from ltsim.core.units import MILLIMETRE
from ltsim.physics.effects.effect import Effect, NoiseEffect
from ltsim.physics.model.construction import Construction
from ltsim.recordings.recording import OBSERVABLES
from ltsim.recordings.references import ReferenceLengths
from ltsim.scene.sightings import Sightings
from ltsim.simulation.physics import reflector_error
from ltsim.simulation.scenario import Scenario

CERTIFIED = 1e-4 * MILLIMETRE
"""Step of the lengths on a certificate."""


@dataclass(frozen=True)
class EffectLaw:
    """An effect whose parameters are drawn from N(mean, sigma^2), half of it where they are never negative."""

    effect: Effect
    mean: Floats
    sigma: Floats
    """(q,) [SI] each; sigma is 0 for a declared value."""
    number: int = 1
    """Index among identical effects at the same place, from 1."""

    @property
    def upward(self) -> Bools:
        """Flags of added variances and other values that are never negative, (q,)."""
        kinds = [p.positive or isinstance(self.effect, NoiseEffect) for p in self.effect.parameters]
        return np.array(kinds, dtype=bool)


def effect_laws(scenario: Scenario, effects: tuple[Effect, ...]) -> tuple[EffectLaw, ...]:
    """Distributions of the effects of a scenario, in the order of its entries, then that of the reflectors' error."""
    counts, laws = Counter[tuple[str, str]](), []
    for i, effect in enumerate(effects):
        entry = scenario.effects[i] if i < len(scenario.effects) else None
        given = {} if entry is None else entry.values
        mean = np.array([given.get(p.name, 0.0) * p.factor for p in effect.parameters])
        if entry is None:
            mean = reflector_error(scenario)
        free = [entry is not None and entry.draw and p.name not in given for p in effect.parameters]
        sigma = np.where(free, np.array([p.prior_sigma for p in effect.parameters]), 0.0)
        counts[effect.name, effect.place] += 1
        laws.append(EffectLaw(effect, mean, sigma, counts[effect.name, effect.place]))
    return tuple(laws)


@dataclass(frozen=True)
class Normal:
    """Standard normal numbers (size, B) of trials (B,) of a seed, by stream key."""

    seed: int
    trials: Ints

    def __call__(self, size: int, *what: str | int) -> Floats:
        """Numbers (size, B) of a stream key."""
        return trials_normal(self.seed, self.trials, size, *what)

    def per_trial(self) -> list[Normal]:
        """Sources of single trials; shared draws are cached."""
        together = lru_cache(maxsize=None)(self.__call__)
        return [_Column(self.seed, self.trials[[k]], together, k) for k in range(len(self.trials))]


@dataclass(frozen=True)
class _Column(Normal):
    """Standard normal numbers of one trial."""

    together: Callable[..., Floats] = trials_normal
    place: int = 0

    def __call__(self, size: int, *what: str | int) -> Floats:
        return self.together(size, *what)[:, self.place : self.place + 1]


@dataclass(frozen=True)
class Draw:
    """Values drawn for B trials; the last index is the trial."""

    trials: Ints
    """(B,): their numbers."""
    values: Floats
    """(I, p, B) [SI]: true instrument parameters."""
    amounts: tuple[Floats, ...]
    """(q, B) [SI]: true parameters of each effect."""
    noise: Floats
    """Errors of the readings, (n, 3, B) [m, rad, rad]."""
    certified: Floats
    """Known lengths as their certificates state them, at the temperature of the calibration, (g, B) [m]."""


@dataclass(frozen=True)
class TrialDraws:
    """The trials that a geometry can have."""

    sightings: Sightings
    construction: Construction
    instruments: tuple[str, ...]
    """Names of the trackers; '' for one without."""
    mean: Floats
    sigma: Floats
    """The instruments' errors are drawn from N(mean, sigma^2), (I, p) [SI]."""
    noise: Floats
    """Standard deviations of the readings, without what effects on the noise add, (n, 3) [m, rad, rad]."""
    lengths: ReferenceLengths
    """True lengths, with the sigmas of their certificates."""
    names: tuple[str, ...]
    """Names of the targets between which the lengths are."""
    effects: tuple[EffectLaw, ...] = ()
    certificate_factor: float = 1.0
    """Ratio of the true standard deviation of a certificate's error to the declared one."""

    def draw(self, numbers: Normal, values: Floats | None = None, *, stream_key: str = "") -> Draw:
        """Draw trials; `values` (I, p, B) [SI] are those of instruments that are given.

        `apart` is a word that tells the noise from that of the same trials in another place.

        Raises SetupError when an effect leaves a variance below zero.
        """
        amounts = tuple(self._amounts(law, numbers) for law in self.effects)
        noise_key = (stream_key, "noise") if stream_key else ("noise",)
        sigma, count = self.noise_sigma(amounts), len(self.sightings)
        white = np.empty((count, len(OBSERVABLES), len(numbers.trials)))
        for column, name in enumerate(OBSERVABLES):
            np.multiply(sigma[:, column], numbers(count, *noise_key, name), out=white[:, column])
        errors = self._values(numbers) if values is None else values
        return Draw(numbers.trials, errors, amounts, white, self._certified(amounts, numbers))

    def _values(self, numbers: Normal) -> Floats:
        values = np.repeat(self.mean[:, :, None], len(numbers.trials), axis=2)
        for i, name in enumerate(self.instruments):
            key = ("instrument", name) if name else ("instrument",)
            for k in np.flatnonzero(self.sigma[i]):
                values[i, k] += self.sigma[i, k] * numbers(1, *key, self.construction.names[k])[0]
        return values

    def _amounts(self, law: EffectLaw, numbers: Normal) -> Floats:
        amounts = np.repeat(law.mean[:, None], len(numbers.trials), axis=1)
        for k in np.flatnonzero(law.sigma):
            key = (law.effect.name, law.effect.place, law.number, law.effect.parameters[k].name)
            drawn = numbers(1, "effect", *key)[0]
            amounts[k] += law.sigma[k] * (np.abs(drawn) if law.upward[k] else drawn)
        return amounts

    def noise_sigma(self, amounts: tuple[Floats, ...]) -> Floats:
        """True standard deviation of the noise, (n, 3, 1) or, where effects on it differ by trial, (n, 3, B)."""
        on_noise = [
            (law.effect, amount)
            for law, amount in zip(self.effects, amounts, strict=True)
            if isinstance(law.effect, NoiseEffect)
        ]
        constant = all(np.all(amount == amount[:, :1]) for _, amount in on_noise)
        trials = range(1 if constant else on_noise[0][1].shape[1])
        return np.stack([self._with_effects([(e, amount[:, k]) for e, amount in on_noise]) for k in trials], axis=2)

    def _with_effects(self, on_noise: Sequence[tuple[NoiseEffect, Floats]]) -> Floats:
        sigma = self.noise
        for effect, amount in on_noise:
            variance = effect.variance(self.sightings, sigma, amount)
            if not np.all(variance >= 0.0):
                raise SetupError(f"effects: {effect.name} takes away more noise than there is; give larger values")
            sigma = np.sqrt(variance)
        return sigma

    def _certified(self, amounts: tuple[Floats, ...], numbers: Normal) -> Floats:
        """The certificates: of the true coefficient and temperature, which are not those that are stated."""
        lengths = self.lengths
        growth = np.repeat(lengths.factor[:, None], len(numbers.trials), axis=1)
        for name, change in lengths.shared.items():
            growth += (change / (lengths.length / lengths.factor))[:, None] * numbers(1, name)
        length = lengths.length[:, None] + self.longer(amounts)
        draws = [
            numbers(1, "cmm", self.names[a], self.names[b]) for a, b in zip(lengths.first, lengths.second, strict=True)
        ]
        white = np.reshape(draws, growth.shape)
        error = self.certificate_factor * lengths.certificate[:, None] * white
        return CERTIFIED * np.round((length / growth + error) / CERTIFIED)

    def longer(self, amounts: tuple[Floats, ...]) -> Floats:
        """(g, B) or (g, 1) [m]: what effects add to the true lengths."""
        lengths, total = self.lengths, np.zeros((len(self.lengths.length), 1))
        for law, amount in zip(self.effects, amounts, strict=True):
            design = law.effect.gauge_design(lengths.first, lengths.second, self.sightings.points)
            if np.any(design):
                total = total + design @ amount
        return total
