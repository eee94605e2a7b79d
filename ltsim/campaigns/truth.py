"""The truth of a cell of a campaign, and its trials drawn block by block.

A block is `BLOCK` consecutive trials. Every draw of block b comes from ``stream(seed, "campaign", what, b)``, so a
trial depends on its number alone: not on the workers, not on how many trials are wanted, not on the methods that
are compared. Cells of a grid use the same streams: they differ by their settings, not by luck.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from ltsim.arrays import Bools, Floats
from ltsim.campaigns.kernels import readings_of
from ltsim.campaigns.program import ChainProgram
from ltsim.effects.effect import Effect, NoiseEffect
from ltsim.errors import SetupError
from ltsim.geometry.polar import wrap
from ltsim.model.construction import Construction
from ltsim.model.measurement import State
from ltsim.randomness import stream
from ltsim.recording.recording import Recording
from ltsim.scene.sightings import Sightings

BLOCK = 256
"""Trials that are drawn together; part of what a campaign's numbers are, so it never changes."""

LINEAR = 1e-3
"""Share of a reading's sigma by which an effect may miss its linear form and still be treated as linear."""


@dataclass(frozen=True)
class TrueEffect:
    """Physics beyond the instrument's errors, with values drawn from N(mean, sigma^2), fixed where sigma is 0."""

    effect: Effect
    mean: Floats
    sigma: Floats
    """(q,) [SI] each."""
    key: str = ""
    """Tells its draws from those of another one like it."""
    by_length: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """(g, q): change of the stated lengths in the workshop per unit; empty for none."""


@dataclass(frozen=True)
class Block:
    """Trials as drawn; the last index is the trial."""

    number: int
    values: Floats
    """(I, p, B) [SI]: true instrument parameters."""
    amounts: tuple[Floats, ...]
    """(q, B) [SI]: true parameters of each further effect."""
    deviation: Floats
    """(n, 3, B) [m, rad, rad]: readings less nominal readings."""
    gauge_error: Floats
    """(g, B) [m]: stated less true lengths."""


@dataclass(frozen=True)
class Truth:
    """What is true in a cell."""

    recording: Recording
    """Its readings are the nominal ones: those of an ideal tracker at `state`."""
    state: State
    """True poses and targets, in the frame in which a calibrator starts (that of the first station)."""
    sightings: Sightings
    """True geometry of the pointings, nests and all, in any frame."""
    construction: Construction
    """Of the true instrument."""
    mean: Floats
    sigma: Floats
    """(I, p) [SI]: its errors are drawn from N(mean, sigma^2)."""
    noise: Floats
    """(n, 3): true standard deviations of the readings, without what effects on the noise add."""
    gauge_sigma: Floats
    """(g,) [m]: of the certificates of the stated lengths."""
    effects: tuple[TrueEffect, ...] = ()
    step: Floats = field(default_factory=lambda: np.zeros((1, 3)))
    """(I, 3) [m, rad, rad]: resolution of the readings; 0 for none."""
    recorded: Bools = field(default_factory=lambda: np.ones(3, dtype=bool))
    """(3,): which of range, azimuth and elevation are recorded; the others do not deviate."""
    gauge_shared: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """(g, k) [m]: change of the stated lengths by one standard deviation of what several share; empty for none."""

    @cached_property
    def _programs(self) -> list[tuple[Construction, ChainProgram]]:
        return []

    def program_of(self, construction: Construction) -> ChainProgram:
        """A construction's chain around the nominal readings, laid out once."""
        for known, program in self._programs:  # comparing a few is quicker than hashing one
            if known == construction:
                return program
        self._programs.append((construction, self._laid_out(construction)))
        return self._programs[-1][1]

    def _laid_out(self, construction: Construction) -> ChainProgram:
        return ChainProgram.of(construction, self.recording.readings)

    @property
    def program(self) -> ChainProgram:
        """The true instrument's chain around the nominal readings."""
        return self.program_of(self.construction)

    @cached_property
    def _by_value(self) -> Floats:
        return self._by_value_of(self.construction)

    def _by_value_of(self, construction: Construction) -> Floats:
        return construction.reading_design(self.recording.readings, np.zeros(construction.size))[1]

    def by_value_of(self, construction: Construction) -> Floats:
        """Derivative (n, 3, p) of the readings by a construction's parameters, at none."""
        return self._by_value if construction == self.construction else self._by_value_of(construction)

    @cached_property
    def _linear_effects(self) -> list[tuple[Floats, Floats] | None]:
        """Constant part (n, 3) and design (n, 3, q) of each effect; None where it is not linear."""
        return [self._linear(entry) for entry in self.effects]

    def _linear(self, entry: TrueEffect) -> tuple[Floats, Floats] | None:
        constant = entry.effect.shift(self.sightings, entry.mean)
        if not np.any(entry.sigma):  # nothing is drawn
            return constant, np.zeros((*constant.shape, len(entry.mean)))
        design = entry.effect.design(self.sightings)
        probe = entry.mean + 3 * entry.sigma
        miss = entry.effect.shift(self.sightings, probe) - constant - design @ (3 * entry.sigma)
        return (constant, design) if np.all(np.abs(miss) <= LINEAR * self.recording.sigma()) else None

    def draw(self, seed: int, number: int, width: int = BLOCK) -> Block:
        """Draw a block.

        Parameters
        ----------
        seed : int
            Root seed of the campaign.
        number : int
            Of the block; its trials are ``width * number`` and following.
        width : int
            Number of trials; another one than `BLOCK` gives other draws.
        """
        values = self.values(seed, number, width)
        return self.read(seed, number, values, self._exact(values))

    def values(self, seed: int, number: int, width: int) -> Floats:
        """True instrument parameters (I, p, B) of a block."""
        trackers = [f"instrument {name}" if name else "instrument" for name in self.recording.instruments]
        shape = self.construction.size, width
        errors = [stream(seed, "campaign", own, number).standard_normal(shape) for own in trackers]
        return self.mean[:, :, None] + self.sigma[:, :, None] * np.stack(errors)

    def read(self, seed: int, number: int, values: Floats, deviation: Floats) -> Block:
        """The block of true parameters whose exact readings less nominal ones are `deviation` (n, 3, B), reused."""

        def normal(what: str, *shape: int) -> Floats:
            return stream(seed, "campaign", what, number).standard_normal((*shape, deviation.shape[2]))

        gauge_error = self.gauge_sigma[:, None] * normal("gauge", len(self.gauge_sigma))
        if self.gauge_shared.size:
            gauge_error += self.gauge_shared @ normal("gauge shared", self.gauge_shared.shape[1])
        amounts = []
        for place, entry in enumerate(self.effects):
            drawn = normal(f"effect {entry.effect.name} {entry.key}", len(entry.mean))
            if isinstance(entry.effect, NoiseEffect):  # variances are added
                drawn = np.abs(drawn)
            amounts.append(entry.mean[:, None] + entry.sigma[:, None] * drawn)
            deviation += self._shift(place, amounts[-1])
            if len(entry.by_length):
                gauge_error += entry.by_length @ amounts[-1]
        deviation += self._noise(amounts) * normal("noise", *self.noise.shape)
        deviation = self._quantised(deviation)
        deviation[:, ~self.recorded] = 0.0
        return Block(number, values, tuple(amounts), deviation, gauge_error)

    def _noise(self, amounts: list[Floats]) -> Floats:
        """Standard deviation (n, 3, 1) or, where effects on the noise are drawn, (n, 3, B) of the readings."""
        places = [i for i, entry in enumerate(self.effects) if isinstance(entry.effect, NoiseEffect)]
        if not any(np.any(self.effects[i].sigma) for i in places):
            return self._noise_with([self.effects[i].mean for i in places], places)[:, :, None]
        trials = range(amounts[places[0]].shape[1])
        return np.stack([self._noise_with([amounts[i][:, k] for i in places], places) for k in trials], axis=2)

    def _noise_with(self, values: list[Floats], places: list[int]) -> Floats:
        """Standard deviation (n, 3) with the effects on the noise, one after the other, at given values."""
        sigma = self.noise
        for i, value in zip(places, values, strict=True):
            effect: Any = self.effects[i].effect
            variance = effect.variance(self.sightings, sigma, value)
            if not np.all(variance >= 0.0):
                raise SetupError(f"effects: {effect.name} takes away more noise than there is; give larger values")
            sigma = np.sqrt(variance)
        return sigma

    def _exact(self, values: Floats) -> Floats:
        """Exact readings of the true instrument less nominal readings; Newton's method from the linear ones."""
        which = self.recording.instrument
        linear = [self._by_value[which == i] @ own for i, own in enumerate(values)]
        deviation = np.empty((len(which), 3, values.shape[2]))
        for i, part in enumerate(linear):
            deviation[which == i] = part
        sightings = self.sightings
        readings_of(self.program.arrays, which, sightings.local, sightings.jacobian, values, deviation)
        return deviation

    def _shift(self, place: int, amounts: Floats) -> Floats:
        """Shift (n, 3, B) of the readings by one effect."""
        entry, linear = self.effects[place], self._linear_effects[place]
        if linear is None:
            return np.stack([entry.effect.shift(self.sightings, v) for v in amounts.T], axis=2)
        constant, design = linear
        return constant[:, :, None] + np.tensordot(design, amounts - entry.mean[:, None], axes=1)

    def _quantised(self, deviation: Floats) -> Floats:
        """Deviations (n, 3, B) that make whole steps of the readings, in place."""
        of_row = np.broadcast_to(self.step[self.recording.instrument], self.noise.shape)
        for column in range(3):
            rows = np.flatnonzero(of_row[:, column])
            own: Any = rows if len(rows) < len(of_row) else slice(None)  # a slice needs no copy
            step, start = of_row[own, column, None], self.recording.readings[own, column, None]
            deviation[own, column] = step * np.round((start + deviation[own, column]) / step) - start
        return deviation

    def readings(self, block: Block, trial: int) -> Floats:
        """Readings (n, 3) of one trial of a block as an instrument gives them, azimuths within +-180 deg."""
        readings: Floats = self.recording.readings + block.deviation[:, :, trial]
        readings[:, 1] = wrap(readings[:, 1])
        readings[:, ~self.recorded] = np.nan
        return readings
