"""Drivers: what a carrier may follow, each as a few columns over the pointings with a prior on their coefficients."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.physics.laws.columns import (
    CIRCULAR,
    MEMORY,
    MODES,
    OVERTONES,
    curve,
    curve_spreads,
    field,
    function,
    group_means,
    has_zero,
    lagging,
    one_each,
    sized,
    waves_of,
)
from ltsim.scene.sightings import Sightings

CLOCKS = ("time", "station-time")
WORDS = {
    "station": "place",
    "x": "place",
    "y": "place",
    "z": "place",
    "station-time": "time",
    "repeat": "time",
    "parity": "approach",
    "seating-parity": "approach",
    "bearing": "azimuth",
    "circle": "azimuth",
    "vertical-circle": "elevation",
    "nest-direction": "incidence",
    "air_temperature_c": "temperature",
}
"""Names of the interface for covariates that have others here."""


POINTED = ("azimuth", "elevation", "distance", "target")


def base_of(name: str) -> str:
    """The quantity that an operator on the order of the work is applied to."""
    how, _, base = name.partition("-")
    return base if base and f"{how}-" in MEMORY else name


def words_of(names: Iterable[str]) -> tuple[str, ...]:
    """Covariates in the words of the interface: how the head came to a pointing is the approach."""
    memory = {name for name in names if name == "lapse" or (base_of(name) != name and base_of(name) in POINTED)}
    return tuple(dict.fromkeys("approach" if n in memory else WORDS.get(base_of(n), base_of(n)) for n in names))


@dataclass(frozen=True)
class Driver:
    """Regressor (driver) on which a response (carrier) depends.

    Attributes
    ----------
    kind : str
        constant, smooth, wave (cosine and sine of `constant` times a covariate), cycle (a wave of any shape), simple,
        product, pieces (the sum of steps and ramps of one covariate), lagging (what follows a covariate by and by),
        amounts (another one for each station, instrument, target, or one that was measured before), field (the same
        for all that is carried, growing across the room, and bent).
    covariates : tuple of str
    function : str
        Of a simple driver.
    constant : float
        Of a simple driver or a wave; the eigenfunctions of a smooth one; the order of a field; the number of amounts;
        the time [s] of a lag.
    factors : tuple of Driver
        Of a product; the pieces.
    around : tuple of str
        Targets about whose middle a field grows, or that have amounts of their own; empty for all.
    """

    kind: str
    covariates: tuple[str, ...] = ()
    function: str = ""
    constant: float = 0.0
    factors: tuple[Driver, ...] = ()
    around: tuple[str, ...] = ()

    def columns(self, sightings: Sightings, *, moving: bool = False) -> Floats:
        """Columns (n, k), each of rms about one over the pointings.

        Coordinates are those of some moment: what is `moving` is where it says at the start of the work, or while a
        column of the recording is at its zero, and where there is no such moment in the mean of the work.
        """
        found = self._columns(sightings, moving)
        if not moving or self.kind in ("constant", "field", "amounts", "product"):
            return found
        found = found - found[self._resting(sightings)].mean(axis=0)
        return sized(found) if self.kind == "simple" else found

    def _resting(self, sightings: Sightings) -> Bools:
        """The pointings (n,) at which what moves is where its coordinates say."""
        every = np.ones(len(sightings), dtype=bool)
        name = "".join(self.covariates)
        if name == "time" and self.kind in ("simple", "pieces"):
            return np.asarray(sightings.time == sightings.time.min())
        x = np.abs(sightings.covariates.get(name, every))
        return x == np.nanmin(x) if has_zero(x) else every

    def _columns(self, sightings: Sightings, moving: bool) -> Floats:
        name = "".join(self.covariates[:1])
        match self.kind:
            case "constant":
                return np.ones((len(sightings), 1))
            case "smooth":
                return curve(name, sightings.quantities[name], int(self.constant))
            case "wave" | "cycle":
                return waves_of(self.constant * sightings.quantities[name], self.size // 2)
            case "field":
                return field(sightings, self.covariates, self.around, bent=self.constant > 1)
            case "simple":
                return function(sightings, name, self.function, self.constant)
            case "lagging":
                return lagging(sightings, name, self.constant)
            case "amounts":
                return one_each(*self._owners(sightings))
            case "pieces":
                return np.hstack([factor.columns(sightings) for factor in self.factors])
        return self._products(sightings, moving)

    def _owners(self, sightings: Sightings) -> tuple[Ints, Ints]:
        """Station, instrument or target (n,) whose amount each pointing has, and those (k,) that have an amount."""
        if self.covariates == ("station",):
            return sightings.station, np.unique(sightings.station)
        if self.covariates == ("instrument",):
            return sightings.instrument, np.unique(sightings.instrument)
        every = np.arange(len(sightings.target_names))
        if self.covariates == ("last-target",):
            return np.where(sightings.previous >= 0, sightings.target[sightings.previous], -1), every
        own = [sightings.target_names.index(name) for name in self.around]
        return sightings.target, np.array(own) if own else every

    def _products(self, sightings: Sightings, moving: bool) -> Floats:
        found = np.ones((len(sightings), 1))
        for factor in self.factors:
            part = factor.columns(sightings, moving=moving)
            if factor.kind == "smooth" and self.owned:
                part = part - group_means(part, sightings.instrument)
            elif factor.kind == "smooth":
                part = np.hstack([np.ones((len(part), 1)), part])
            found = (found[:, :, None] * part[:, None, :]).reshape(len(sightings), -1)
        return found

    @property
    def owned(self) -> bool:
        """Whether each instrument has a curve of its own, about its mean: constants are estimated anyhow."""
        return any(factor.covariates == ("instrument",) for factor in self.factors)

    @cached_property
    def spreads(self) -> tuple[Floats, ...]:
        """Prior standard deviations (k,) of the coefficients, one set a length scale."""
        match self.kind:
            case "constant" | "simple":
                return (np.ones(1),)
            case "wave" | "lagging":
                return (np.full(2, np.sqrt(0.5)),)
            case "amounts" | "pieces":
                return (np.ones(int(self.constant)),)
            case "cycle":
                return (np.repeat(1.0 / np.arange(1, OVERTONES + 1), 2) / np.sqrt(2.0),)
            case "field":
                spread = np.concatenate([np.ones(4), np.full(6 if self.constant > 1 else 0, 0.5)])
                return (spread / np.linalg.norm(spread),)
            case "smooth":
                return curve_spreads(self.covariates[0] in CIRCULAR, int(self.constant))
        spread = np.ones(1)
        for factor in self.factors:
            part = factor.spreads[0]
            part = np.append(1.0, part) if factor.kind == "smooth" and not self.owned else part
            spread = np.outer(spread, part / np.linalg.norm(part)).ravel()
        return (spread,)

    def about(self, targets: tuple[str, ...]) -> Driver:
        """The driver with the field of some targets in the place of that of the room."""
        if all(f.kind != "field" for f in self.factors):
            return self
        factors = tuple(replace(f, around=targets) if f.kind == "field" else f for f in self.factors)
        return replace(self, factors=factors)

    def for_each(self, targets: tuple[str, ...]) -> Driver:
        """The driver with another amount for each of some targets."""
        followed = [f for f in self.factors or (self,) if f.kind != "field"]
        each = amounts("target", len(targets), targets)
        return Driver("product", factors=(*followed, each))

    @property
    def size(self) -> int:
        """Number of columns k."""
        return len(self.spreads[0])

    @property
    def told(self) -> tuple[str, ...]:
        """Quantities that it depends on, in the words of the interface."""
        names = [*self.covariates, *(name for factor in self.factors for name in factor.covariates)]
        return words_of(names)


CONSTANT = Driver("constant")
PLACE = ("x", "y", "z")


def across_the_room(drivers: Sequence[Driver], order: int) -> list[Driver]:
    """Drivers whose size may grow across the room, or bend with it."""
    grows = Driver("field", PLACE, constant=order)
    return [Driver("product", factors=(driver, grows)) for driver in drivers]


def simple(name: str, function: str, constant: float = 1.0) -> Driver:
    """A driver with one column."""
    return Driver("simple", (name,), function, constant)


def amounts(of: str, count: int, targets: tuple[str, ...] = ()) -> Driver:
    """Another amount for each `station`, `instrument`, `target`, or `last-target`; of some targets only."""
    return Driver("amounts", (of,), constant=count, around=targets)


def pieces(steps: Sequence[Driver]) -> Driver:
    """A driver that is the sum of steps and ramps of one covariate, of any sizes."""
    return Driver("pieces", steps[0].covariates, constant=len(steps), factors=tuple(steps))


def smooth(name: str, modes: int = MODES) -> Driver:
    """A smooth driver."""
    return Driver("smooth", (name,), constant=modes)
