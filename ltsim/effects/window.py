"""Window in the path (28): a pane of glass between a station and some of its targets.

With i the angle at the pane: range + w (sqrt(n^2 - sin^2 i) - cos i), lateral w sin i (1 - cos i / sqrt(n^2 - sin^2 i))
away from the normal. The parameter is the thickness w (no correction of a reading): 3 mm give 1.500 mm at normal
incidence, 1.645 mm at 30 deg, and 0.58 mm across.
Like: range-step over the whole visit (if all targets are behind it), another adaptor.
Separate by: the window taken away.
Valid: plane parallel glass of index 1.5, anywhere on the path.
Source: physics.md entry 28 [D*].
Status: validated against the numbers of the entry.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.effect import Effect, Parameter, Stage, by_displacement
from ltsim.effects.motions import exact_target_change
from ltsim.scene.sightings import Sightings
from ltsim.units import MILLIMETRE

INDEX = 1.5
SECTORS = 4


@dataclass(frozen=True)
class Window(Effect):
    """A pane with `normal` in the network frame; (0, 0, 0): across every beam."""

    normal: tuple[float, float, float] = (0.0, 0.0, 0.0)

    name = "window"
    number = 28
    stage = Stage.AIR
    covariates = ("azimuth", "incidence")
    scope = "pointing"
    parameters = (Parameter("thickness", "mm", "thickness of the glass", 3 * MILLIMETRE),)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """At every station an upright pane across each quarter of its targets, in the order of their azimuths."""
        found = []
        for s, station in enumerate(sightings.station_names):
            arm = sightings.points - sightings.position[s]
            seen = np.unique(sightings.target[sightings.station == s])
            seen = seen[np.argsort(np.arctan2(arm[seen, 1], arm[seen, 0]))]
            for block in np.array_split(seen, SECTORS):
                across = arm[block, :2].sum(axis=0)
                if len(block) < 2 or not np.linalg.norm(across) > 0:
                    continue
                x, y = (float(v) for v in across / np.linalg.norm(across))
                found.append(cls((station,), tuple(sightings.target_names[t] for t in block), (x, y, 0.0)))
        return found

    def _apparent(self, sightings: Sightings) -> Floats:
        """(n, 3): displacement of the target that the readings describe, per unit of thickness."""
        beam = sightings.unit_vectors[0]
        normal = np.broadcast_to(np.asarray(self.normal), beam.shape) if any(self.normal) else beam
        cosine = np.sum(beam * normal, axis=1)[:, None]
        normal, cosine = normal * np.sign(cosine), np.abs(cosine)
        inside = np.sqrt(INDEX**2 - 1.0 + cosine**2)
        longer = (inside - cosine) * beam
        aside = (1.0 - cosine / inside) * (cosine * beam - normal)
        apparent: Floats = (longer + aside) * self.mask(sightings)[:, None]
        return apparent

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 1) of the raw readings per unit of thickness, first order in it."""
        return by_displacement(sightings, self._apparent(sightings)[:, :, None])

    def shift(self, sightings: Sightings, values: Floats) -> Floats:
        """Change (n, 3) of the raw readings."""
        return exact_target_change(sightings, values[0] * self._apparent(sightings))
