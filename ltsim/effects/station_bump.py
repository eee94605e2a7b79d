"""Station bumped: somebody touched the tripod, and the station stands elsewhere from then on.

pose(t) = pose + H(t - t_b) (translation, rotation). The parameters are the station's motion in the network frame, the
rotation a vector through its origin (no correction of a reading).

Size: 5 um and 5 urad up to millimetres; it shows from 5.6 um together with 4 urad on.
Like: station-settling (smooth), range-step (ranges only), target-swap.
Separate by: a drift check on the first three targets.
Valid: one bump a visit, three pointings or more on either side; micrometres to millimetres.
Source: the user manual of SpatialAnalyzer (drift check); the search over change points is derived here.
Status: first order validated against the exact motion.
"""

from dataclasses import dataclass
from typing import Self

from ltsim.arrays import Floats
from ltsim.effects.effect import Effect, Parameter, Stage
from ltsim.effects.motions import exact_station_change, station_design
from ltsim.effects.places import gaps_near, station_change_times
from ltsim.scene.sightings import Sightings
from ltsim.units import MICROMETRE, MICRORADIAN

SHIFT, TURN = 100 * MICROMETRE, 50 * MICRORADIAN


@dataclass(frozen=True)
class StationBump(Effect):
    """Another pose of a station from `time` [s] on."""

    time: float = 0.0

    name = "station-bump"
    stage = Stage.STATION
    covariates = ("time",)
    scope = "station"
    parameters = (
        Parameter("shift-x", "um", "motion of the station along the network's x axis", SHIFT),
        Parameter("shift-y", "um", "motion of the station along the network's y axis", SHIFT),
        Parameter("shift-z", "um", "motion of the station along the network's z axis", SHIFT),
        Parameter("turn-x", "urad", "turn of the station about the network's x axis", TURN),
        Parameter("turn-y", "urad", "turn of the station about the network's y axis", TURN),
        Parameter("turn-z", "urad", "turn of the station about the network's z axis", TURN),
    )

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Every gap of a visit with three pointings on either side."""
        return [cls((name,), time=time) for name, time in station_change_times(sightings, least=3)]

    def finer(self, sightings: Sightings) -> list[Self]:
        """The gaps between pointings around this one."""
        times = sightings.time[self.mask(sightings) > 0]
        return [self.reshaped(time=t) for t in gaps_near(times, self.time)]

    def _after(self, sightings: Sightings) -> Floats:
        return self.mask(sightings) * (sightings.time >= self.time)

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 6) of the raw readings per unit of the motion, first order."""
        return station_design(sightings) * self._after(sightings)[:, None, None]

    def shift(self, sightings: Sightings, values: Floats) -> Floats:
        """Change (n, 3) of the raw readings, exact."""
        return exact_station_change(sightings, self._after(sightings)[:, None] * values)
