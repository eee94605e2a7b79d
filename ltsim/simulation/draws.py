"""Distributions and draws of the random values of trials; single recordings and campaigns use the same draws.

A draw depends only on the seed, its purpose and the number of the trial. An additional effect, method or worker process
therefore does not change any draw for another purpose.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import InputError
from ltsim.core.randomness import standard_normal_trials
from ltsim.core.units import MILLIMETRE
from ltsim.physics.effects.effect import Effect, NoiseEffect
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.recordings.recording import OBSERVABLES
from ltsim.recordings.references import ReferenceLengths
from ltsim.scene.sightings import Sightings
from ltsim.simulation.physics import incidence_error_parameters
from ltsim.simulation.scenario import Scenario

CERTIFICATE_ROUNDING_STEP = 1e-4 * MILLIMETRE
"""Step [m] to which a calibration certificate rounds its reference lengths: 0.1 um."""


@dataclass(frozen=True)
class EffectDistribution:
    """Effect of a scenario, and the normal distributions from which its parameters are drawn.

    For a parameter that is never negative, the absolute value of the draw is used.
    """

    effect: Effect
    """Physical effect, with the stations and targets where it acts."""
    parameter_means: Floats
    """Mean of each parameter of the effect, shape (parameters,) [SI]."""
    parameter_sigmas: Floats
    """Standard deviation of each parameter of the effect, shape (parameters,) [SI]; 0 for a parameter that is not
    drawn."""
    occurrence_number: int = 1
    """Running number, from 1, of the scenario's entry among all entries with the same effect, stations and targets."""

    @property
    def is_nonnegative(self) -> Bools:
        """Mask of the parameters that are never negative, such as added variances."""
        kinds = [p.is_nonnegative or isinstance(self.effect, NoiseEffect) for p in self.effect.parameters]
        return np.array(kinds, dtype=bool)


def effect_distributions(scenario: Scenario, effects: tuple[Effect, ...]) -> tuple[EffectDistribution, ...]:
    """Distributions of the parameters of `effects`, which are the scenario's effects in the order of its file.

    The last effect may be the range error of the reflectors by incidence angle, which the table `[smr]` of the scenario
    defines.
    """
    counts, laws = Counter[tuple[str, str]](), []
    for i, effect in enumerate(effects):
        entry = scenario.effects[i] if i < len(scenario.effects) else None
        given = {} if entry is None else entry.values
        mean = np.array([given.get(p.name, 0.0) * p.si_per_display_unit for p in effect.parameters])
        if entry is None:
            mean = incidence_error_parameters(scenario)
        free = [entry is not None and entry.draw and p.name not in given for p in effect.parameters]
        sigma = np.where(free, np.array([p.prior_sigma for p in effect.parameters]), 0.0)
        counts[effect.name, effect.place_text] += 1
        laws.append(EffectDistribution(effect, mean, sigma, counts[effect.name, effect.place_text]))
    return tuple(laws)


@dataclass(frozen=True)
class StandardNormalSource:
    """Generator of standard normal numbers for trials of one seed, with an independent random stream per purpose."""

    seed: int
    """Seed of the campaign or recording, from which all random streams start."""
    trial_numbers: Ints
    """Numbers of the trials in the campaign, shape (trials,)."""

    def __call__(self, n_values: int, *stream_key: str | int) -> Floats:
        """Standard normal numbers, shape (n_values, trials), from the random stream with the key `stream_key`."""
        return standard_normal_trials(self.seed, self.trial_numbers, n_values, *stream_key)

    def single_trial_sources(self) -> list[StandardNormalSource]:
        """Separate generator for each trial; all generators share a cache, so that each random number is drawn once."""
        together = lru_cache(maxsize=None)(self.__call__)
        return [
            _SingleTrialSource(self.seed, self.trial_numbers[[k]], together, k) for k in range(len(self.trial_numbers))
        ]


@dataclass(frozen=True)
class _SingleTrialSource(StandardNormalSource):
    """Generator of the standard normal numbers of one trial, taken from the cached draws of a batch of trials."""

    draw_batch_numbers: Callable[..., Floats] = standard_normal_trials
    """Function that draws the standard normal numbers, shape (n_values, trials), of all trials of the batch."""
    trial_index: int = 0
    """Index of the trial in the batch."""

    def __call__(self, n_values: int, *stream_key: str | int) -> Floats:
        """Standard normal numbers of the trial, shape (n_values, 1), from the stream with the key `stream_key`."""
        return self.draw_batch_numbers(n_values, *stream_key)[:, self.trial_index : self.trial_index + 1]


@dataclass(frozen=True)
class TrueTrialValues:
    """True parameters of several trials; the last axis of each array is the trial."""

    trial_numbers: Ints
    """Numbers of the trials in the campaign, (trials,)."""
    instrument_values: Floats
    """True instrument parameters, (instruments, parameters, trials) [SI]."""
    effect_values: tuple[Floats, ...]
    """True parameters of each effect of the scenario, each (effect parameters, trials) [SI]."""


@dataclass(frozen=True)
class DrawnTrialValues(TrueTrialValues):
    """Random values drawn for several trials; the last axis of each array is the trial."""

    reading_errors: Floats
    """Random errors of the readings, shape (pointings, 3, trials) [m, rad, rad]."""
    certified_lengths: Floats
    """Reference lengths at the calibration temperature, as the certificates declare them, shape (lengths, trials) [m].
    """


@dataclass(frozen=True)
class TrialDistributions:
    """Distributions of all random values of trials, for given true positions of stations and targets."""

    sightings: Sightings
    """Pointings with the true positions of stations and targets."""
    construction: GeometricErrorModel
    """Geometric error model of the instruments, which generates the readings."""
    instrument_names: tuple[str, ...]
    """Names of the trackers, in the order of the instruments of the recording; '' for a tracker without a name."""
    instrument_error_means: Floats
    """Means of the instrument errors, shape (instruments, parameters) [SI]."""
    instrument_error_sigmas: Floats
    """Standard deviations of the (normally distributed) instrument errors, shape (instruments, parameters) [SI]."""
    noise_sigmas: Floats
    """Standard deviations of the readings before the scenario's effects change the noise, (pointings, 3) [m, rad, rad].
    """
    reference_lengths: ReferenceLengths
    """True reference lengths, with the standard deviations of their certificates."""
    length_target_names: tuple[str, ...]
    """Names of the targets to which the indices of the ends of the reference lengths refer."""
    effects: tuple[EffectDistribution, ...] = ()
    """Effects of the scenario with the distributions of their parameters."""
    certificate_error_factor: float = 1.0
    """Ratio of the true to the declared standard deviation of certified lengths."""

    def draw(
        self, normal_source: StandardNormalSource, instrument_values: Floats | None = None, *, stream_key: str = ""
    ) -> DrawnTrialValues:
        """Random values of the trials for which `normal_source` generates standard normal numbers.

        `instrument_values` (instruments, parameters, trials) [SI], if given, replaces the drawn instrument errors. Two
        calls with different `stream_key` give the same trials independent noise, for a second measurement. InputError
        is raised if an effect makes a variance negative.
        """
        effect_values = tuple(self._draw_effect_values(law, normal_source) for law in self.effects)
        noise_key = (stream_key, "noise") if stream_key else ("noise",)
        sigma, count = self.noise_sigmas_with_effects(effect_values), len(self.sightings)
        white = np.empty((count, len(OBSERVABLES), len(normal_source.trial_numbers)))
        for column, name in enumerate(OBSERVABLES):
            np.multiply(sigma[:, column], normal_source(count, *noise_key, name), out=white[:, column])
        errors = self._draw_instrument_values(normal_source) if instrument_values is None else instrument_values
        return DrawnTrialValues(
            normal_source.trial_numbers,
            errors,
            effect_values,
            white,
            self._draw_certified_lengths(effect_values, normal_source),
        )

    def _draw_instrument_values(self, normal_source: StandardNormalSource) -> Floats:
        """Drawn true instrument parameters, shape (instruments, parameters, trials) [SI]."""
        instrument_values = np.repeat(self.instrument_error_means[:, :, None], len(normal_source.trial_numbers), axis=2)
        for i, name in enumerate(self.instrument_names):
            key = ("instrument", name) if name else ("instrument",)
            for k in np.flatnonzero(self.instrument_error_sigmas[i]):
                instrument_values[i, k] += (
                    self.instrument_error_sigmas[i, k] * normal_source(1, *key, self.construction.parameter_names[k])[0]
                )
        return instrument_values

    def _draw_effect_values(self, distribution: EffectDistribution, normal_source: StandardNormalSource) -> Floats:
        """Drawn true parameters of the effect with this `distribution`, shape (parameters, trials) [SI]."""
        effect_values = np.repeat(distribution.parameter_means[:, None], len(normal_source.trial_numbers), axis=1)
        for k in np.flatnonzero(distribution.parameter_sigmas):
            key = (
                distribution.effect.name,
                distribution.effect.place_text,
                distribution.occurrence_number,
                distribution.effect.parameters[k].name,
            )
            drawn = normal_source(1, "effect", *key)[0]
            effect_values[k] += distribution.parameter_sigmas[k] * (
                np.abs(drawn) if distribution.is_nonnegative[k] else drawn
            )
        return effect_values

    def noise_sigmas_with_effects(self, effect_values: tuple[Floats, ...]) -> Floats:
        """True standard deviations of the readings, shape (pointings, 3, trials) [m, rad, rad].

        `effect_values` holds the parameters of each effect, (parameters, trials) [SI]. The last axis of the result has
        one entry if the noise is the same in all trials.
        """
        on_noise = [
            (law.effect, amount)
            for law, amount in zip(self.effects, effect_values, strict=True)
            if isinstance(law.effect, NoiseEffect)
        ]
        constant = all(np.all(amount == amount[:, :1]) for _, amount in on_noise)
        trials = range(1 if constant else on_noise[0][1].shape[1])
        return np.stack(
            [self._sigmas_with_noise_effects([(e, amount[:, k]) for e, amount in on_noise]) for k in trials], axis=2
        )

    def _sigmas_with_noise_effects(self, noise_effects: Sequence[tuple[NoiseEffect, Floats]]) -> Floats:
        """Standard deviations of the readings in one trial with effects on the noise, (pointings, 3) [m, rad, rad].

        `noise_effects` holds pairs of an effect on the noise and its parameters, shape (parameters,) [SI].
        """
        sigma = self.noise_sigmas
        for effect, amount in noise_effects:
            variance = effect.variance(self.sightings, sigma, amount)
            if not np.all(variance >= 0.0):
                raise InputError(f"effects: {effect.name} makes a variance of readings negative; give larger values")
            sigma = np.sqrt(variance)
        return sigma

    def _draw_certified_lengths(self, effect_values: tuple[Floats, ...], normal_source: StandardNormalSource) -> Floats:
        """Drawn certified lengths (lengths, trials) [m], with the true expansion coefficient and temperature."""
        lengths = self.reference_lengths
        expansion_factors = np.repeat(lengths.expansion_factors[:, None], len(normal_source.trial_numbers), axis=1)
        for name, change in lengths.shared_error_shifts.items():
            expansion_factors += (change / (lengths.lengths / lengths.expansion_factors))[:, None] * normal_source(
                1, name
            )
        true_lengths = lengths.lengths[:, None] + self.reference_length_change(effect_values)
        draws = [
            normal_source(1, "cmm", self.length_target_names[a], self.length_target_names[b])
            for a, b in zip(lengths.first_targets, lengths.second_targets, strict=True)
        ]
        unit_errors = np.reshape(draws, expansion_factors.shape)
        certificate_errors = self.certificate_error_factor * lengths.certificate_sigmas[:, None] * unit_errors
        return CERTIFICATE_ROUNDING_STEP * np.round(
            (true_lengths / expansion_factors + certificate_errors) / CERTIFICATE_ROUNDING_STEP
        )

    def reference_length_change(self, effect_values: tuple[Floats, ...]) -> Floats:
        """Change of the true reference lengths by effects with the parameters `effect_values` [SI].

        The shape is (lengths, trials) [m], or (lengths, 1) if no effect changes the lengths.
        """
        lengths, total = self.reference_lengths, np.zeros((len(self.reference_lengths.lengths), 1))
        for law, amount in zip(self.effects, effect_values, strict=True):
            design = law.effect.gauge_design(
                lengths.first_targets, lengths.second_targets, self.sightings.target_points
            )
            if np.any(design):
                total = total + design @ amount
        return total
