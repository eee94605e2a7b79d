"""Turbulence (24): the air boils, and readings scatter more the farther they reach.

var(D_t) and var(D_v) grow by C d^3, var(d) by C_r d: a change of the noise, not of its mean.
Like: a wrong statement of the noise, small drifts.
Separate by: repeats over minutes; a shielded path (40 to 23 um at 2.5 m).
Valid: white from pointing to pointing; averaging within one helps less than 1 / sqrt(N).
Source: physics.md entry 24 [S4, second hand]; C of that shop is 100 um^2/m^3.
Status: form validated; sizes second hand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.effect import NoiseEffect, Parameter, Stage
from ltsim.scene.sightings import Sightings
from ltsim.units import MICROMETRE


@dataclass(frozen=True)
class Turbulence(NoiseEffect):
    """Variance that grows with the range."""

    name = "turbulence"
    number = 24
    stage = Stage.AIR
    covariates = ("distance",)
    parameters = (
        Parameter(
            "turbulence-across", "um2/m3", "variance across the beam over the cube of the range", 9 * MICROMETRE**2
        ),
        Parameter("turbulence-along", "um2/m", "variance of the range over the range", 9 * MICROMETRE**2),
    )

    def variance(self, sightings: Sightings, sigma: Floats, values: Floats) -> Floats:
        """Variance (n, 3) of the readings."""
        range_, acts = sightings.range_, self.mask(sightings)
        across = values[0] * range_  # C d^3 over d^2: an angle
        added = np.stack([values[1] * range_, across / np.cos(sightings.elevation) ** 2, across], axis=1)
        variance: Floats = sigma**2 + acts[:, None] * added
        return variance
