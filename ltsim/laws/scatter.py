"""Noise that no card describes: where it grows, and amounts that repeat; its carrier is the noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.signature import NoiseSignature, Parameter
from ltsim.laws.columns import MEMORY
from ltsim.recording.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings

REPEATS = EACH_FACE, BOTH_FACES = ("in each face", "in both faces")
"""How amounts may repeat: what errs on the way to a target is in the ranges of both faces."""


@dataclass(frozen=True)
class NoisePattern(NoiseSignature):
    """Noise of some observables that grows with a covariate, or is larger at some targets: not in the catalogue.

    variance = sigma^2 (1 + value * pattern), the pattern running from 0 to 1 over the network.
    """

    observables: tuple[str, ...] = OBSERVABLES
    covariates: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    stations: tuple[str, ...] = ()
    instruments: tuple[str, ...] = ()
    falling: bool = False
    repeating: str = ""
    each: bool = False

    name = "unknown"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """One size; one for each of the targets where `each` has its own noise."""
        names = [f"added-variance at {name}" for name in self.targets] if self.each else ["added-variance"]
        return tuple(Parameter(n, "", "variance added where the pattern is 1, over the stated", 3.0) for n in names)

    @property
    def carrier(self) -> str:
        """What errs: a reading whose amounts repeat, the noise otherwise."""
        return self.observables[0] if self.repeating and len(self.observables) == 1 else "noise"

    @property
    def driver(self) -> str:
        """What it follows, in words."""
        return "station and target" if self.repeating else "target" if self.each else " ".join(self.covariates)

    @property
    def law(self) -> str:
        """What the noise does, in words."""
        if self.repeating:
            again = ", in both faces" if self.repeating == BOTH_FACES else ""
            return f"amounts without a visible law that repeat when a target is measured again{again}"
        if self.each:
            return "noise that differs from target to target"
        if not self.covariates:
            return "larger noise"
        return f"noise that {'falls' if self.falling else 'grows'} with {self.covariates[0]}"

    def variance(self, sightings: Sightings, sigma: Floats, values: Floats) -> Floats:
        """Variance (n, 3)."""
        if self.each:
            ids = [sightings.target_names.index(name) for name in self.targets]
            added = np.bincount(ids, values, minlength=len(sightings.target_names))
            return sigma**2 * (1.0 + added[sightings.target, None])
        pattern = self.mask(sightings)
        for name in self.covariates:
            x = np.abs(sightings.quantities[name]) if name.startswith(MEMORY) else sightings.quantities[name]
            x = (x - x.min()) / max(float(np.ptp(x)), 1e-12)
            pattern = pattern * ((1 - x) if self.falling else x) ** 2
        acts = [float(o in self.observables) for o in OBSERVABLES]
        grown: Floats = sigma**2 * (1.0 + values[0] * pattern[:, None] * np.array(acts))
        return grown
