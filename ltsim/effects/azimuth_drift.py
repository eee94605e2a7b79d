"""Drift of the azimuth zero (32): the base or the tripod's head turns, the circle warms.

Correction of the azimuth = r t (in every visit, or in one) or A exp(-t / tau). The station's yaw takes the mean, so
only the change within a visit is seen: a linear drift over the recording and one in every visit are the same.
Like: transit tilt (0.67, one face) where points are taken level by level.
Separate by: a random order of the targets, the first three again before leaving.
Valid: the same law at every station, or one station's own; time constants of 10 min to 4 h.
Source: physics.md entry 32 [S7, S22], correlations [D*].
Status: validated against the azimuth slot at a given time, and the equality of both linear laws up to yaw.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from ltsim.effects.drift import Drift
from ltsim.effects.effect import Parameter, Stage
from ltsim.scene.sightings import Sightings
from ltsim.units import FACTOR, MICRORADIAN


@dataclass(frozen=True)
class AzimuthDrift(Drift):
    """Azimuth zero that follows the clock."""

    name = "azimuth-drift"
    number = 32
    stage = Stage.ENCODERS
    observables = ("azimuth",)
    slot = "azimuth"
    rate = Parameter("azimuth-drift", "urad/h", "growth of the correction", 20 * FACTOR["urad/h"])
    amplitude = Parameter("azimuth-drift-amplitude", "urad", "correction at the start, dying away", 20 * MICRORADIAN)
    parameters = (rate,)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """In every visit, in one visit alone, and warm-ups."""
        names = sightings.station_names if len(sightings.station_names) > 1 else ()
        alone = [cls((name,), law="visit") for name in names]
        warm_ups = [cls(law="exponential", time_constant=t) for t in cls.shapes()]
        return [cls(law="visit"), *alone, *warm_ups]
