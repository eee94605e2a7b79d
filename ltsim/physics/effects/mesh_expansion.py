from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import SI_PER_UNIT
from ltsim.physics.effects.effect import LightPathStage, Parameter
from ltsim.physics.effects.motions import TargetDisplacementEffect
from ltsim.physics.effects.places import recording_start_time
from ltsim.scene.sightings import Sightings

AXIS_WEIGHTS_BY_EXPANSION_MODE = {"uniform": np.ones(3), "vertical": np.array([0.0, 0.0, 1.0])}
"""Weights (3,) of the thermal expansion along x, y and z by the mode of expansion, `uniform` or `vertical`."""


@dataclass(frozen=True)
class MeshExpansion(TargetDisplacementEffect):
    """Thermal expansion of the mesh: walls and floor move the targets as the hall warms up.

    The coordinates of a target are P(t) = P + a t A (P - centroid), with the time t since the first pointing, and A = 1
    (uniform) or diag(0, 0, 1) (vertical). The parameter is the growth rate a of the structure (no correction of a
    reading).

    Size: steel and concrete grow 11 to 12 ppm/K, 69 um over 6 m and 1 K: often more than all errors of the tracker.
    Similar to: refractivity-drift and station-weather (uniform mode, exactly if it grows only between stations),
    range-drift (correlation 0.955).
    Separate by: thermometers on the structure; a gauge of another material measured from each station; a repeat of the
    first station.
    Validity: growth that is linear in time. The choice of the fixed point does not matter, because poses absorb a
    common motion.
    Source: Bryan 1990, International status of thermal error research, CIRP Annals 39, 645-656; the law is derived
    here.
    Validation: first-order form validated against the exact motion, and against the range scale drift in the network.
    """

    mode: Literal["uniform", "vertical"] = "uniform"
    """Mode of the expansion: `uniform` (equal along all axes) or `vertical`."""

    name = "mesh-expansion"
    base_rate = 2.0
    light_path_stage = LightPathStage.TARGET
    covariates = ("time", "place")
    parameters = (Parameter("mesh-expansion", "ppm/h", "growth rate of the structure", 10 * SI_PER_UNIT["ppm/h"]),)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Expansions that a diagnosis tries: a uniform one and a vertical one."""
        return [cls(mode="uniform"), cls(mode="vertical")]

    def displacement(self, sightings: Sightings) -> Floats:
        time_since_start = self.pointing_indicator(sightings) * (sightings.time - recording_start_time(sightings))
        relative_position = sightings.target_points[sightings.target] - sightings.target_points.mean(axis=0)
        return (time_since_start[:, None] * relative_position * AXIS_WEIGHTS_BY_EXPANSION_MODE[self.mode])[:, :, None]
