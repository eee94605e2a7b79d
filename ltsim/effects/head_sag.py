"""Gravity sag of the head (11): the scope bends under its own weight.

Delta_elevation = -g (e_up . vertical), for an upright tracker -g cos(el): the same on both faces.
Like: the cosine part of the elevation eccentricity, exactly for upright trackers; the vertical index (0.96, one face).
Separate by: the tracker on its side or hanging (0.84).
Valid: any mounting; the vertical is the z axis of the network frame.
Source: physics.md entry 11 [S18], correlations [D*].
Status: validated against the eccentricity's cosine column for upright stations.
"""

from __future__ import annotations

from dataclasses import dataclass

from ltsim.arrays import Floats
from ltsim.effects.effect import Effect, Parameter, Stage, on_readings
from ltsim.scene.sightings import Sightings
from ltsim.units import MICRORADIAN


@dataclass(frozen=True)
class HeadSag(Effect):
    """Sag of a level scope."""

    name = "head-sag"
    number = 11
    stage = Stage.AXES
    observables = ("elevation",)
    covariates = ("elevation",)
    parameters = (Parameter("sag", "urad", "droop of a level beam", 5 * MICRORADIAN),)

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 1) of the raw readings per unit of sag."""
        upright = sightings.unit_vectors[2][:, 2]
        return on_readings(sightings, elevation=-self.mask(sightings) * upright)[:, :, None]
