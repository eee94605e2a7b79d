"""Variance functions: changes of the noise that are not in the catalogue, and errors that repeat."""

from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.physics.effects.signature import NoiseSignature, Parameter
from ltsim.physics.laws.columns import CIRCULAR, MEMORY_PREFIXES
from ltsim.recordings.recording import OBSERVABLES
from ltsim.scene.regions import Region
from ltsim.scene.sightings import Sightings

REPEATS = EACH_FACE, BOTH_FACES = ("in each face", "in both faces")
"""Kinds of repetition: an error on the path to a target is in the ranges of both faces, for example."""


MIN_PATH = 0.05
"""Fraction of the longest path through a region below which a line of sight counts as outside."""


def owners_of(sightings: Sightings, each: str) -> tuple[tuple[str, ...], Ints]:
    """Names of all targets, stations, or pointings (``row 1``), and the index (n,) of the one of each pointing."""
    if each == "reading":
        return tuple(f"row {i + 1}" for i in range(len(sightings))), np.arange(len(sightings))
    if each == "station":
        return tuple(sightings.station_names), sightings.station
    return tuple(sightings.target_names), sightings.target


def size_or_value(sightings: Sightings, name: str) -> Floats:
    """Covariate (n,) that noise depends on: of moves and other memories their size."""
    values: Floats = sightings.quantities[name]
    return np.abs(values) if name.startswith(MEMORY_PREFIXES) else values


@dataclass(frozen=True)
class VarianceFunction(NoiseSignature):
    """Variance function: noise of some observables that depends on a covariate, or differs by target.

    Not in the catalogue.

    variance = sigma^2 (1 + value * pattern), the pattern running from 0 to 1 over the network. Each of its `owners`
    (targets, stations or readings) has a separate value, and with `per_observable` one for each observable. For a
    `region` of the hall the pattern is the length of the line of sight in it. With a `band` the pattern is 1 from its
    first to its second value of the covariate, round the circle for directions, from its third to its fourth and so
    on, and 0 elsewhere.
    """

    observables: tuple[str, ...] = OBSERVABLES
    covariates: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    stations: tuple[str, ...] = ()
    instruments: tuple[str, ...] = ()
    falling: bool = False
    repeating: str = ""
    each: str = ""
    owners: tuple[str, ...] = ()
    per_observable: bool = False
    region: Region | None = None
    band: tuple[float, ...] = ()

    name = "unknown"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Sizes: one, or one per group if the noise differs by group."""
        kinds = [f"-{name}" for name in self.observables] if self.per_observable else [""]
        names = [f"added-variance{kind} at {name}" for name in self.owners for kind in kinds]
        return tuple(
            Parameter(n, "", "added variance where the pattern is 1, divided by the declared variance", 3.0)
            for n in names or ["added-variance"]
        )

    @property
    def carrier(self) -> str:
        """Response: a reading for errors that repeat, the noise otherwise."""
        return self.observables[0] if self.repeating and len(self.observables) == 1 else "noise"

    @property
    def driver(self) -> str:
        """Regressor on which the variance depends, as text."""
        return "station and target" if self.repeating else self.each or " ".join(self.covariates)

    @property
    def law(self) -> str:
        """Text of the variance function."""
        if self.repeating:
            again = ", in both faces" if self.repeating == BOTH_FACES else ""
            return f"errors without a visible law that recur when a target is measured again{again}"
        if self.region is not None:
            return "larger noise on lines of sight that pass a region of the hall"
        if self.each == "reading":
            return "a fraction of the readings with a much larger scatter"
        if self.each:
            what = self.each.replace("station", "set-up")
            return f"noise that differs from {what} to {what}" + (
                ", in each observable by itself" if self.per_observable else ""
            )
        if not self.covariates:
            return "larger noise"
        if self.band:
            several = "bands" if len(self.band) > 2 else "a band"
            return f"larger noise in {several} of {self.covariates[0]}"
        return f"noise that {'falls' if self.falling else 'grows'} with {self.covariates[0]}"

    def variance(self, sightings: Sightings, sigma: Floats, values: Floats) -> Floats:
        """Variance (n, 3) of the readings."""
        if self.each:
            added = values.reshape(len(self.owners), -1)[owners_of(sightings, self.each)[1]]
            acts = [o in self.observables for o in OBSERVABLES]
            factor = np.ones(sigma.shape)
            factor[:, acts] += added
            return np.asarray(sigma**2 * factor)
        pattern = self.mask(sightings)
        if self.region is not None:
            path = self.region.path(sightings)
            share = path / max(float(path.max(initial=0.0)), 1e-12)
            pattern = pattern * np.where(share > MIN_PATH, share, 0.0)
            return self._grown(sigma, values[0] * pattern)
        if self.band:
            return self._grown(sigma, values[0] * pattern * self.inside(sightings))
        for name in self.covariates:
            x = size_or_value(sightings, name)
            x = (x - x.min()) / max(float(np.ptp(x)), 1e-12)
            pattern = pattern * ((1 - x) if self.falling else x) ** 2
        return self._grown(sigma, values[0] * pattern)

    def inside(self, sightings: Sightings) -> Bools:
        """Pointings (n,) within the band of the covariate."""
        name = self.covariates[0]
        x = size_or_value(sightings, name)
        inside = np.zeros(len(x), dtype=bool)
        for low, high in zip(self.band[::2], self.band[1::2], strict=True):
            if name in CIRCULAR:
                inside |= np.remainder(x - low, 2.0 * np.pi) <= high - low
            else:
                inside |= (x >= low) & (x <= high)
        return inside

    def _grown(self, sigma: Floats, added: Floats) -> Floats:
        """Variance (n, 3) with an added fraction (n,) in its observables."""
        acts = [float(o in self.observables) for o in OBSERVABLES]
        grown: Floats = sigma**2 * (1.0 + added[:, None] * np.array(acts))
        return grown
