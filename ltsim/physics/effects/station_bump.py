from dataclasses import dataclass
from typing import Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICROMETRE, MICRORADIAN
from ltsim.physics.effects.effect import LightPathStage, axis_parameters
from ltsim.physics.effects.motions import StationMotionEffect
from ltsim.physics.effects.places import candidate_station_change_times, neighbouring_gap_times
from ltsim.scene.sightings import Sightings


@dataclass(frozen=True)
class StationBump(StationMotionEffect):
    """Station bumped: the tripod was touched, and the station has another pose from then on.

    At the time t the pose of the station is pose(t) = pose + H(t - t_b) (translation, rotation), with the unit step
    function H and the time t_b of the bump. The parameters are the station's motion in the network frame, with the
    rotation as a vector through the station's origin (no correction of a reading).

    Size: 5 um and 5 urad up to millimetres; it is detected from 5.6 um together with 4 urad on.
    Similar to: station-settling (smooth), range-step (ranges only), target-swap.
    Separate by: a repeat of the first three targets at the end of the station.
    Validity: one bump per station, with three pointings or more before and after it; micrometres to millimetres.
    Source: the user manual of SpatialAnalyzer (drift check); the search over change points is derived here.
    Validation: first-order form validated against the exact motion.
    """

    time: float = 0.0
    """Time [s] of the bump."""

    name = "station-bump"
    base_rate = 4.0
    light_path_stage = LightPathStage.STATION
    covariates = ("time",)
    scope = "station"
    parameters = (
        *axis_parameters("shift", "um", "motion of the station along", 100 * MICROMETRE),
        *axis_parameters("turn", "urad", "rotation of the station about", 50 * MICRORADIAN),
    )

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Bumps that a diagnosis tries: between pointings of a station, with three pointings or more on either side."""
        return [cls((name,), time=time) for name, time in candidate_station_change_times(sightings, min_pointings=3)]

    def neighbours(self, sightings: Sightings) -> list[Self]:
        """Copies of this bump in neighbouring gaps between pointings, which a local search tries."""
        return [self.with_shape_parameters(time=t) for t in neighbouring_gap_times(self, sightings, self.time)]

    def motion(self, sightings: Sightings) -> Floats:
        return (self.pointing_indicator(sightings) * (sightings.time >= self.time))[:, None, None] * np.eye(6)
