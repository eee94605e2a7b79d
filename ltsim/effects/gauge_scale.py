"""Scale of the gauge (35): its temperature or its coefficient of expansion is wrong.

True length = stated length (1 + s); a stated length changes by -s L. An aluminium gauge one kelvin off has 23 ppm.
Like: range-scale, one index of air for all, a uniform warming of the mesh: exactly.
Separate by: a thermometer on the gauge; a bar of another material; a maker's guarantee on the range scale.
Valid: all known lengths share one gauge. No reading changes.
Source: physics.md entry 35 [S9], equality [D*].
Status: validated on the known lengths.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Floats, Ints
from ltsim.effects.effect import Effect, Parameter, Stage
from ltsim.scene.sightings import Sightings
from ltsim.units import PPM


@dataclass(frozen=True)
class GaugeScale(Effect):
    """Factor on every known length, less one."""

    name = "gauge-scale"
    number = 35
    stage = Stage.TARGET
    observables = ()
    covariates = ("temperature",)
    parameters = (Parameter("gauge-scale", "ppm", "share missing from every known length", 20 * PPM),)

    def design(self, sightings: Sightings) -> Floats:
        """No reading changes: zeros (n, 3, 1)."""
        return np.zeros((len(sightings), 3, 1))

    def gauge_design(self, first: Ints, second: Ints, points: Floats) -> Floats:
        """Change (g, 1) of the stated lengths per unit of scale."""
        lengths: Floats = np.linalg.norm(points[first] - points[second], axis=1)
        return -lengths[:, None]
