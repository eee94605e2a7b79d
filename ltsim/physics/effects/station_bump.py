from dataclasses import dataclass
from typing import Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICROMETRE, MICRORADIAN
from ltsim.physics.effects.effect import Stage, along_axes
from ltsim.physics.effects.motions import StationMotion
from ltsim.physics.effects.places import gaps_near, station_change_times
from ltsim.scene.sightings import Sightings


@dataclass(frozen=True)
class StationBump(StationMotion):
    """Station bumped: the tripod was touched, and the station has another pose from then on.

    pose(t) = pose + H(t - t_b) (translation, rotation). The parameters are the station's motion in the network frame,
    the rotation a vector through its origin (no correction of a reading).

    Size: 5 um and 5 urad up to millimetres; it shows from 5.6 um together with 4 urad on.
    Like: station-settling (smooth), range-step (ranges only), target-swap.
    Separate by: a drift check on the first three targets.
    Valid: one bump a visit, three pointings or more on either side; micrometres to millimetres.
    Source: the user manual of SpatialAnalyzer (drift check); the search over change points is derived here.
    Status: first order validated against the exact motion.
    """

    time: float = 0.0

    name = "station-bump"
    stage = Stage.STATION
    covariates = ("time",)
    scope = "station"
    parameters = (
        *along_axes("shift", "um", "motion of the station along", 100 * MICROMETRE),
        *along_axes("turn", "urad", "rotation of the station about", 50 * MICRORADIAN),
    )

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Candidates at every gap of a visit with three pointings on either side."""
        return [cls((name,), time=time) for name, time in station_change_times(sightings, least=3)]

    def finer(self, sightings: Sightings) -> list[Self]:
        """Bumps in the neighbouring gaps between pointings."""
        times = sightings.time[self.mask(sightings) > 0]
        return [self.reshaped(time=t) for t in gaps_near(times, self.time)]

    def motion(self, sightings: Sightings) -> Floats:
        return (self.mask(sightings) * (sightings.time >= self.time))[:, None, None] * np.eye(6)
